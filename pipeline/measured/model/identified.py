"""From recordings to an identified device: parameters, parts, what is not told apart, replay; and each trial alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.wording import counted, listed
from pipeline.measured.model.intervals import BOUNDED, NEEDED, Errors, Interval, physical
from pipeline.measured.model.likelihood import Device, Fit, refined
from pipeline.measured.model.parts import Choice, chosen
from pipeline.measured.model.quasi_static import damping_without_inertia
from pipeline.measured.model.recordings import SHORTEST, Recording, Scales, stretches
from pipeline.measured.model.replay import Replay, replayed
from pipeline.measured.model.scatter import FEWEST, inverse
from pipeline.measured.model.told import (
    FEWEST_COUNTS,
    Combination,
    Recorded,
    combinations,
    largest_command,
    reasons,
    sensor_resolution,
    stuck,
    unidentifiable,
)
from pipeline.records.batch import Floats

FOLDS = 5

MOST_REPLAYED = 40
"""Logs that are replayed, spread over all."""

EXPLAINS = 0.5
"""Weight of a trial from which on the device explains it; see `scatter.OWN_ROWS`."""

SAME_PERIOD = 0.05
"""Difference of sampling periods, relative to them, up to which logs are those of one."""

SMALLEST_UNIT = 1e-60
"""Smallest unit of position, command and time in SI, and the inverse of the largest: squares of more overflow."""

LAST = 0.4
"""Share of a single log that is replayed by the device fitted to what came before."""


@dataclass(frozen=True, eq=False)
class Identified:
    """What recordings say of a device.

    ``parameters``: intervals in SI by name. ``untold``: names among them whose value cannot be identified, for which
    ``reasons`` has a sentence each; ``parts``: gain of
    held-out log-likelihood by part; ``assumed``: what had to be taken as none, by name; ``noise``: standard deviation
    of a reading [m, rad]; ``disturbance``: of the random force, held over a sample [N, Nm]; ``scatter``: standard
    deviations from trial to trial by name. ``covariance`` of the parameters, in their order; ``folds``: their values
    by the logs but every fifth from the first, the second ... on; empty below `FEWEST` logs.
    """

    parameters: dict[str, Interval]
    untold: set[str]
    reasons: dict[str, str]
    parts: dict[str, float]
    assumed: tuple[str, ...]
    combinations: list[Combination]
    scatter: dict[str, float]
    noise: float
    disturbance: float
    replay: Replay
    replay_names: list[str]
    scales: Scales
    trials: int
    covariance: Floats
    folds: list[dict[str, float]]
    choice: Choice
    names: list[str]
    bounds: dict[str, float]

    @property
    def explained(self) -> int:
        """Logs that the device and its noise explain: what is left of them is less than twice as much as of most."""
        return self.trials if self.choice.fit.few else int((self.choice.fit.solved.weight > EXPLAINS).sum())


def identified(recordings: list[Recording]) -> Identified:
    """Return the device that made recordings.

    Raises
    ------
    ParameterError
        If nothing moves in them, no command is given, or they are too short.
    """
    check_recordings(recordings)
    choice = chosen(recordings)
    errors = Errors.of(choice.fit)
    quantities = physical(choice.scales)
    names = [name for name, number in NEEDED.items() if number in errors.numbers]
    mass, period = quantities["mass"](errors.numbers), choice.scales.period
    units = {"damping": mass / period, "load_damping": mass / period, "stiffness": mass / period**2, "delay": period}
    units |= dict.fromkeys(("friction", "constant_force"), choice.scales.command)
    parameters = {name: errors.interval(quantities[name], name in BOUNDED, units.get(name, 0.0)) for name in names}
    parameters = _opened(parameters, choice)
    untold = unidentifiable(parameters, choice)
    alone = damping_without_inertia(recordings) if "mass" in untold else None
    if alone is not None:
        parameters["damping"] = alone
        untold.discard("damping")
    recorded = Recorded.of(recordings)
    command = choice.scales.command
    scatter = np.sqrt(choice.fit.solved.scatter)
    gain = choice.fit.device.numbers["gain"]
    scattered = {"delay": period, "coulomb": command / gain, "force": command / gain}
    named = {"delay": "delay", "coulomb": "friction", "force": "constant_force"}
    replay, replay_names = _replay(recordings, choice)
    noise = float(np.sqrt(choice.fit.solved.noise))
    return Identified(
        parameters,
        untold,
        reasons(untold, choice, recordings, recorded, slow_rows=alone is not None),
        choice.parts,
        choice.assumed,
        combinations(choice, errors, recorded, untold),
        {
            named[name]: float(scatter[i] * scattered[name])
            for i, name in enumerate(choice.fit.device.names)
            if name in named and len(recordings) >= FEWEST
        },
        noise * choice.scales.position,
        float(np.sqrt(choice.fit.device.noise.force)) * noise / abs(gain or 1.0) * command,
        replay,
        replay_names,
        choice.scales,
        len(recordings),
        errors.covariance([quantities[name] for name in names]),
        [{name: quantities[name](device.numbers) for name in names} for device in _without_folds(choice.fit)]
        if len(recordings) >= FEWEST
        else [],
        choice,
        [each.name for each in recordings],
        choice.bounds,
    )


def _opened(parameters: dict[str, Interval], choice: Choice) -> dict[str, Interval]:
    """Return intervals with what the likelihood of this device does not say."""
    result = dict(parameters)
    if "delay" in choice.bounds:
        delay, more = parameters["delay"], choice.bounds["delay"] - parameters["delay"].value
        low, high = max(delay.low + min(more, 0.0), 0.0), delay.high + max(more, 0.0)
        result["delay"] = replace(delay, low=low, high=high)
    if "within" in choice.fit.device.numbers:
        # with damping on both sides any share moves the far mass alike
        result["mode_mass"] = replace(parameters["mode_mass"], low=0.0, high=parameters["mass"].high)
    if "constant_force" in choice.assumed and "friction" in parameters:
        result = _held_before(result, choice.scales.command)
    return result


def _held_before(parameters: dict[str, Interval], command: float) -> dict[str, Interval]:
    """Return intervals without the assumption of no constant force: at rest before, friction may have held one.

    It is anywhere between both directions of friction, and all that is told per command is off by its share of it.
    """
    share = parameters["friction"].value / command / np.sqrt(3.0)
    result = dict(parameters)
    for name in ("mass", "damping", "stiffness", "friction", "mode_mass", "load_damping"):
        if name in parameters:
            each = parameters[name]
            more = 1.96 * share * each.value
            low = each.value - float(np.hypot(each.value - each.low, more))
            high = each.value + float(np.hypot(each.high - each.value, more))
            result[name] = Interval(each.value, max(low, 0.0), high, float(np.hypot(each.error, share * each.value)))
    return result


def check_recordings(recordings: list[Recording]) -> None:
    """Refuse recordings from which no device can be identified.

    Raises
    ------
    ParameterError
        As `identified`: too few rows, several sampling periods, no motion, no command, or numbers in no unit.
    """
    rows = sum(len(each.time) for each in recordings if len(each.time) >= SHORTEST)
    if rows < 4 * SHORTEST:
        raise ParameterError(f"the logs have {rows} usable rows; expected at least {4 * SHORTEST}. Record longer ones.")
    _check_periods(recordings)
    if not any(np.ptp(each.position) > 0 for each in recordings):
        raise ParameterError(
            "the position does not change in any log; expected a device in motion. Record larger steps."
        )
    if not any(np.any(each.command != 0) for each in recordings):
        raise ParameterError(
            "the command is 0 in all rows; a motion without a force tells no mass. Record steps of the command, or "
            "name the column of the force in the profile (columns.command)."
        )
    travel = max(float(np.ptp(each.position)) for each in recordings)
    resolution, largest = sensor_resolution(recordings), largest_command(recordings)
    if travel <= FEWEST_COUNTS * resolution:
        raise ParameterError(stuck(travel / resolution, largest))
    units = [travel, largest, travel / largest, travel / largest / recordings[0].period ** 2]
    if not all(SMALLEST_UNIT < unit < 1 / SMALLEST_UNIT for unit in units):
        raise ParameterError(
            f"the position changes by {travel:.3g} under a command of {largest:.3g} at T = {recordings[0].period:.3g} "
            "s; expected numbers in SI. Correct the units in the profile."
        )


def _check_periods(recordings: list[Recording]) -> None:
    """Refuse logs whose sampling periods differ, or are none."""
    periods = np.array([each.period for each in recordings])
    low, high = float(periods.min()), float(periods.max())
    if not low > SMALLEST_UNIT or not high < 1 / SMALLEST_UNIT:
        raise ParameterError(
            f"sampling periods of {low:g} to {high:g} s; expected some between a microsecond and a day."
        )
    if high - low <= SAME_PERIOD * low:
        return
    names = [
        f"{period:g} s ({counted(len(some), 'log')}, such as {some[0]})"
        for period in np.unique(np.round(periods, 12)).tolist()
        if (some := [each.name for each in recordings if abs(each.period - period) <= 1e-9 * period + 1e-12])
    ]
    raise ParameterError(
        f"the logs have {len(names)} sampling periods: {listed(names[:4])}. A delay counts in samples, so that logs of "
        "one period are identified together. Give those of one."
    )


def _replay(recordings: list[Recording], choice: Choice) -> tuple[Replay, list[str]]:
    """Return free runs of logs by the device without their fold, or of the last part of few logs by the first."""
    lead = choice.held.lead
    places = np.unique(np.linspace(0, len(recordings) - 1, min(MOST_REPLAYED, len(recordings))).round().astype(int))
    if len(recordings) < FEWEST:
        cuts = [int((1 - LAST) * len(each.time)) for each in recordings]
        before = [_cut(each, 0, cut) for each, cut in zip(recordings, cuts, strict=True)]
        held = stretches(before, choice.scales, lead, choice.moving)
        device = replace(choice.fit.device, effects=None)
        if len(held):
            device = refined(held, device, len(before), steps=8, far=False).device
        last = [_cut(each, cut, len(each.time)) for each, cut in zip(recordings, cuts, strict=True)]
        whole = stretches(last, choice.scales, lead, False)
        return replayed(whole, replace(device, effects=None)), [recordings[i].name for i in whole.trial]
    found: list[Replay] = []
    order: list[Recording] = []
    for fold, device in enumerate(_without_folds(choice.fit)):
        some = [recordings[i] for i in places if i % FOLDS == fold]
        if some:
            found.append(replayed(stretches(some, choice.scales, lead, False), device))
            order += some
    rows = max(len(each.position) for each in found)
    position = np.concatenate([_padded(each.position, rows) for each in found], axis=1)
    whole = stretches(order, choice.scales, lead, False)
    names = [order[i].name for i in whole.trial]
    return Replay(whole, position, np.concatenate([each.fit for each in found])), names


def _padded(values: np.ndarray, rows: int) -> np.ndarray:
    return np.pad(values, ((0, rows - len(values)), (0, 0)), constant_values=np.nan)


def _cut(each: Recording, first: int, behind: int) -> Recording:
    inside = slice(first, behind)
    return replace(each, time=each.time[inside], command=each.command[inside], position=each.position[inside])


def _without_folds(fit: Fit) -> list[Device]:
    """Return the device without each fold of units: one Newton step from the whole fit."""
    solved, units = fit.solved, len(fit.solved.score)
    devices = []
    for fold in range(FOLDS):
        inside = np.arange(units) % FOLDS == fold
        rest = solved.total - solved.information[inside].sum(axis=0)
        step = -inverse(rest) @ solved.score[inside].sum(axis=0)
        devices.append(replace(fit.device.stepped(step), effects=None))
    return devices


OWN = {"mass": "gain", "damping": "delta", "delay": "delay"}
"""Quantities that are told by trial; the others stay as they are in it."""


def own_numbers(found: Identified) -> dict[str, list[float]]:
    """Return mass [kg, kg m^2], damping [Ns/m, Nms/rad] and delay [samples] of each trial, each with its error.

    Friction, a constant force and all other parts are those of the trial by the model, or common.
    """
    fit, scales = found.choice.fit, found.scales
    names, numbers = list(fit.device.names), fit.device.numbers
    places = [names.index(number) for number in OWN.values() if number in names]
    quantities, effects = physical(scales), fit.device.effects
    if fit.few:
        return {}
    result = {}
    for trial, (product, weight) in enumerate(zip(fit.moments.products, fit.solved.weight, strict=True)):
        information, score = product[:-1, :-1], product[:-1, -1]
        if effects is not None:
            held = effects[trial].copy()
            held[places] = 0.0
            score = score - information @ held
        own = information[np.ix_(places, places)]
        if not (np.diagonal(own) > 0).all():
            continue
        known = inverse(own)
        step, covariance = known @ score[places], known * fit.solved.noise / weight
        told: list[float] = []
        base, size = np.array([numbers[names[place]] for place in places]), np.sqrt(np.diagonal(covariance))
        near = np.minimum(size, 1e-3 * np.abs(base) + 1e-9)
        for name, number in OWN.items():
            if number not in names:
                told += [0.0, 0.0]
                continue
            factor = 1 / scales.period if name == "delay" else 1.0
            changed = [base, *(base + sign * each for each in np.diag(near) for sign in (1, -1))]
            value, *ends = (
                factor * quantities[name](numbers | dict(zip((names[p] for p in places), at.tolist(), strict=True)))
                for at in changed
            )
            slope = np.array([(up - down) for up, down in zip(ends[::2], ends[1::2], strict=True)]) / (2 * near)
            told += [value + float(slope @ step), float(np.sqrt(slope @ covariance @ slope))]
        result[found.names[trial]] = told
    return result
