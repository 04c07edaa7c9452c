"""Identify a device from recordings: parameters, parts, unidentifiable parameters, replay, and values of each trial."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.progress import part_of_work, report
from pipeline.base.wording import counted, listed
from pipeline.measured.identification.departures import departure
from pipeline.measured.identification.estimated import ESTIMATED, Numbers, Quantity, estimated_names
from pipeline.measured.identification.final_fit import Choice, fit_parts
from pipeline.measured.identification.free_search import LOAD_PARTS, SENSED
from pipeline.measured.identification.identifiability import (
    FEWEST_COUNTS,
    IdentifiableCombination,
    Recorded,
    combinations,
    is_identifiable,
    largest_command,
    reasons,
    sensor_resolution,
    stuck,
    unidentifiable,
)
from pipeline.measured.identification.intervals import Errors, Interval, OwnEstimates
from pipeline.measured.identification.likelihood import groups_of
from pipeline.measured.identification.motion import GRAVITY
from pipeline.measured.identification.open_parts import over_gains, with_open_parts
from pipeline.measured.identification.parts import ChosenParts, choose_parts
from pipeline.measured.identification.quasi_static import damping_without_inertia
from pipeline.measured.identification.recordings import SHORTEST, LogUnits, Recording
from pipeline.measured.identification.replay import (
    Replay,
    devices_without_folds,
    follows,
    medians,
    replays,
    replays_left_out,
)
from pipeline.measured.identification.scatter import FEWEST, inverse
from pipeline.measured.identification.search import refined
from pipeline.measured.identification.segments import segments_of
from pipeline.records.trials import Floats

EXPLAINS = 0.5
"""Smallest weight of a trial that the device explains (see `scatter.OWN_ROWS`)."""

PRECISE = 95.0
"""Threshold for the fit of free runs [%]. Above it, the errors are too small to matter, whatever they depend on."""

SLOW_ROWS = 10.0
"""Threshold for the time constant [rows]. Above it, rows show the inertia of a device."""

SAME_PERIOD = 0.05
"""Largest relative difference between sampling periods that are treated as equal."""

SMALLEST_UNIT = 1e-60
"""Smallest unit of position, command and time in SI. Its inverse is the largest unit, since squares of larger numbers
overflow."""

LAST = 0.4
"""Share of the velocity changes of a single log in its last part, which is replayed. The device is fitted to the first
part."""


REMEDY = (
    "Another force acts, a part is missing, or the recorded command does not drive the device. "
    "Record smaller and slower steps."
)
"""Remedy for logs that no device explains, if the errors do not depend on a known quantity."""

NO_FIT = "no single device fits these logs ({}). Exclude logs of other devices or walls, or record more trials"
"""Reason if the equations of a fit have no solution."""


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of the identification of a device. Parameters are in SI, with the names of `ESTIMATED` as keys.

    Parameters
    ----------
    parameters : dict of str to Interval
    unidentifiable : set of str
        Names of the parameters whose values are not identifiable.
    reasons : dict of str to str
        One sentence for each unidentifiable parameter.
    parts : dict of str to float
        Gain of cross-validated log-likelihood of each part.
    assumed : tuple of str
        Names of parameters that are assumed to be zero.
    combinations : list of IdentifiableCombination
        Identifiable combinations of unidentifiable parameters.
    scatter : dict of str to float
        Standard deviations from trial to trial by name.
    noise : float
        Standard deviation of a reading [m, rad].
    disturbance : float
        Standard deviation of a random force that is constant over each sample [N, Nm].
    replay : list of Replay
        Fit of the free runs. Each log is replayed by a device that is identified without this log.
    units : LogUnits
    names : list of str
        Names of all recordings.
    drive : dict of str to Interval
        "positive" and "negative": mass per unit of a positive and of a negative command. "asymmetry": half the
        difference between the two gains, divided by their mean. "small" and "large": mass per unit of a small command
        and of the largest command. "curvature": share of the force that is missing at the largest command. Empty if the
        gain depends on neither direction nor size, or if no device explains the logs.
    gravity : dict of str to Interval
        "torque": largest torque of gravity per unit of command [Nm]. "angle": recorded angle at which the device would
        hang at rest [rad]. Empty without gravity, and if the interval of its torque contains 0.
    covariance : float64, shape (P, P)
        Covariance of the parameters, in the order of `parameters`.
    folds : list of dict of str to float
        Values of the parameters if one fold of the logs is left out (every fifth log, starting at the first, the second
        and so on). Empty for fewer than `FEWEST` logs.
    departure : str
        Sentence that names the quantity on which the errors depend, or empty (see `departures.departure`).
    quasi_static : bool
        Whether the damping is from displacements over windows, because rows do not show the inertia.
    recorded : Recorded
        Content of the recordings.
    choice : Choice
    """

    parameters: dict[str, Interval]
    unidentifiable: set[str]
    reasons: dict[str, str]
    parts: dict[str, float]
    assumed: tuple[str, ...]
    combinations: list[IdentifiableCombination]
    scatter: dict[str, float]
    noise: float
    disturbance: float
    replay: list[Replay]
    units: LogUnits
    names: list[str]
    drive: dict[str, Interval]
    gravity: dict[str, Interval]
    covariance: Floats
    folds: list[dict[str, float]]
    departure: str
    quasi_static: bool
    recorded: Recorded
    choice: Choice

    @property
    def explained(self) -> int:
        """Number of logs that the device and its noise explain. Their residual is below twice the usual residual."""
        fit = self.choice.fit
        return len(self.names) if fit.few else int((fit.solved.weight > EXPLAINS).sum())

    @property
    def fit_percent(self) -> float | None:
        """Median fit of the free runs, or None if no log could be replayed."""
        return medians(self.replay)[0]

    @property
    def naive_percent(self) -> float | None:
        """Median fit of a motion with constant velocity or acceleration, or None if no log could be replayed."""
        return medians(self.replay)[1]


def identified(recordings: list[Recording], chosen: ChosenParts | None = None) -> Identification:
    """Identify a device from recordings. The result does not depend on their order.

    Parameters
    ----------
    recordings : list of Recording
    chosen : ChosenParts, optional
        Parts of the device, if they have already been chosen from the `subset` of these recordings.

    Raises
    ------
    ParameterError
        If the recordings contain no motion or no command, are too short, or no device fits them.
    """
    check_recordings(recordings)
    recordings = sorted(recordings, key=lambda each: each.rank)
    try:
        if chosen is None:
            with part_of_work("", 0.0, 0.9):
                chosen = choose_parts(recordings)
        report(0.9)
        choice = fit_parts(recordings, chosen)
        report(0.95)
        return described(recordings, choice)
    except np.linalg.LinAlgError as error:
        raise no_fit(error) from error


def no_fit(error: np.linalg.LinAlgError) -> ParameterError:
    """Return the error for a fit whose equations have no solution."""
    return ParameterError(NO_FIT.format(str(error).rstrip(".").lower()))


def described(recordings: list[Recording], choice: Choice) -> Identification:
    """Return the identification for chosen parts, from recordings in the order of their ranks."""
    fit, units, errors = choice.fit, choice.units, Errors.of(choice.fit)
    replay = _replay(recordings, choice)
    walls = any(any(each.wall) for each in recordings)
    fit_percent = medians(replay)[0]
    if not walls and fit_percent is not None and fit_percent <= PRECISE:
        errors = replace(errors, own=OwnEstimates.of(fit, groups_of(choice.segments)))
    names = estimated_names(errors.numbers)
    parameters = with_open_parts(_opened({name: errors.parameter(name, units) for name in names}, choice), choice)
    unknown = unidentifiable(parameters, choice)
    alone = damping_without_inertia(recordings) if "mass" in unknown and not _shows_inertia(errors) else None
    if alone is not None:
        parameters["damping"] = alone
        unknown.discard("damping")
    recorded = Recorded.of(recordings)
    where = "" if walls or fit_percent is None or fit_percent > PRECISE else departure(choice)
    misfit = "" if walls else _misfit(replay, where, known="mass" not in unknown)
    parts = dict.fromkeys(choice.parts, 0.0) if misfit else dict(choice.parts)
    if misfit and alone is None:
        # the intervals of a model that does not predict the motion have no meaning
        unknown = set(parameters)
    load = parameters.get("mode.mass")
    shared = walls or "spring_damping_fraction" in choice.fit.device.numbers
    weightless = load is not None and load.low <= 0 and not shared
    if weightless or (not walls and fit_percent is None):
        # without a replay, nothing tests whether a vibration predicts the motion, and a load that may have no mass
        # only absorbs errors of the model
        unknown |= {name for name in parameters if name.startswith("mode.")}
        parts |= dict.fromkeys(parts.keys() & {*SENSED.values(), *LOAD_PARTS}, 0.0)
    gravity = {} if misfit else _gravity(errors, units)
    if "gravity" in parts and not gravity:
        parts["gravity"] = 0.0
    why = reasons(unknown, choice, recordings, recorded, slow_rows=alone is not None, misfit=misfit)
    noise = float(np.sqrt(fit.solved.noise))
    folds = [] if len(recordings) < FEWEST else devices_without_folds(choice.segments, fit)
    return Identification(
        parameters,
        unknown,
        why,
        parts,
        choice.assumed,
        [] if misfit or weightless else combinations(choice, errors, recorded, unknown),
        {} if len(recordings) < FEWEST else _scatter(choice),
        noise * units.position,
        float(np.sqrt(fit.device.noise.force)) * noise / abs(fit.device.numbers["gain"] or 1.0) * units.command,
        replay,
        units,
        [each.name for each in recordings],
        {} if misfit else _drive(errors, units),
        gravity,
        errors.covariance(names, units),
        [{name: ESTIMATED[name].quantity(units)(device.numbers) for name in names} for device in folds],
        where,
        alone is not None,
        recorded,
        choice,
    )


def _shows_inertia(errors: Errors) -> bool:
    """Return whether the logs show a time constant of at least `SLOW_ROWS` rows, and thus an inertia."""
    rate = errors.interval(lambda n: n["delta"])
    return is_identifiable(rate) and 0 < SLOW_ROWS * rate.high < 1


def _drive(errors: Errors, units: LogUnits) -> dict[str, Interval]:
    """Return the mass per unit of command for each direction and for small and large commands, with the asymmetry and
    the curvature.

    The result is empty if the gain depends on neither. If it depends on both, the intervals of each direction span
    small and large commands.
    """
    mass, quantities = ESTIMATED["mass"].quantity(units), dict[str, Quantity]()
    if "asymmetry" in errors.numbers:
        quantities |= {
            "asymmetry": lambda n: n["asymmetry"],
            "positive": lambda n: mass(n) / (1 + n["asymmetry"]),
            "negative": lambda n: mass(n) / (1 - n["asymmetry"]),
        }
    if "curvature" in errors.numbers:
        quantities |= {
            "curvature": lambda n: n["curvature"],
            "small": mass,
            "large": lambda n: mass(n) / (1 - n["curvature"]),
        }
    drive = {name: errors.interval(quantity) for name, quantity in quantities.items()}
    if "positive" in drive and "large" in drive:
        # the gain may fall with the command or with the force, which differs by direction
        more = drive["large"].high / drive["small"].value
        for name in ("positive", "negative"):
            drive[name] = replace(drive[name], high=drive[name].high * more)
    return drive


def _gravity(errors: Errors, units: LogUnits) -> dict[str, Interval]:
    """Return the largest torque of gravity and the angle at which the device would hang at rest.

    The result is empty without gravity, and if the interval of the torque contains 0. The torque is
    -(a sin q + b cos q) = -c sin(q - q_0), with c = hypot(a, b) and q_0 = atan2(-b, a).
    """
    if GRAVITY[0] not in errors.numbers:
        return {}

    def angle(n: Numbers) -> float:
        return float(np.arctan2(-n[GRAVITY[1]], n[GRAVITY[0]]))

    about = angle(errors.numbers)

    def near(n: Numbers) -> float:
        return about + float(np.remainder(angle(n) - about + np.pi, 2 * np.pi)) - np.pi

    torque = errors.interval(lambda n: float(np.hypot(n[GRAVITY[0]], n[GRAVITY[1]])) / n["gain"] * units.command)
    return {"torque": torque, "angle": errors.interval(near)} if torque.low > 0 else {}


def _misfit(replay: list[Replay], where: str, *, known: bool) -> str:
    """Return why no device is identified, if the fitted device does not predict its logs.

    The text is empty if the device predicts the logs, or if there is no replay. If the mass is not ``known``, the text
    is also empty unless ``where`` names a quantity on which the errors depend: the wide intervals are then the better
    reason.
    """
    fit, naive = medians(replay)
    if fit is None or naive is None or follows(fit, naive):
        return ""
    words = f"No device with these parts predicts logs left out: free runs fit {fit:.0f} % of the velocity"
    return f"{words}, and a motion without the command fits {naive:.0f} %. {where or REMEDY}" if known or where else ""


def _scatter(choice: Choice) -> dict[str, float]:
    """Return the standard deviations of the parameters that may vary from trial to trial."""
    device, size = choice.fit.device, np.sqrt(choice.fit.solved.scatter)
    force = choice.units.command / device.numbers["gain"]
    unit = {"delay_samples": 1.0, "friction.coulomb": force, "constant_force": force}
    places = {name: device.names.index(ESTIMATED[name].number) for name in estimated_names(device.numbers)}
    return {name: float(size[place] * unit[name]) for name, place in places.items() if name in unit}


def _opened(parameters: dict[str, Interval], choice: Choice) -> dict[str, Interval]:
    """Return intervals that include the uncertainty that the likelihood of the device does not contain."""
    result = dict(parameters)
    if "delay_samples" in choice.bounds:
        delay, more = parameters["delay_samples"], choice.bounds["delay_samples"] - parameters["delay_samples"].value
        low, high = max(delay.low + min(more, 0.0), 0.0), delay.high + max(more, 0.0)
        result["delay_samples"] = replace(delay, low=low, high=high)
    if "spring_damping_fraction" in choice.fit.device.numbers:
        # if both sides have damping, a load of any mass gives the same motion
        result["mode.mass"] = replace(parameters["mode.mass"], low=0.0, high=parameters["mass"].high)
    if "constant_force" in choice.assumed and "friction.coulomb" in parameters:
        result = _stuck_before(result, choice.units.command)
    return over_gains(result, choice.fit.device.numbers)


def _stuck_before(parameters: dict[str, Interval], command: float) -> dict[str, Interval]:
    """Return intervals that allow for a constant force that friction balanced while the device was at rest.

    The constant force lies anywhere between minus and plus the Coulomb friction. Quantities identified per unit of
    command have the same relative error.
    """
    share = parameters["friction.coulomb"].value / command / np.sqrt(3.0)
    result = dict(parameters)
    for name in ("mass", "damping", "stiffness", "friction.coulomb", "mode.mass", "mode.load_damping"):
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
        If there are too few rows, several sampling periods, no motion, no command, or values out of range.
    """
    rows = sum(len(each.time) for each in recordings if len(each.time) >= SHORTEST)
    if rows < 4 * SHORTEST:
        raise ParameterError(f"the logs have {rows} usable rows; expected at least {4 * SHORTEST}. Record longer logs.")
    _check_periods(recordings)
    if not any(np.ptp(each.position) > 0 for each in recordings):
        raise ParameterError(
            "the position does not change in any log; expected a device in motion. Record larger steps."
        )
    if not any(np.any(each.command != 0) for each in recordings):
        raise ParameterError(
            "the command is 0 in all rows, and a motion without a force does not show the mass. Record steps of the "
            "command, or set the column of the force in the profile (columns.command)."
        )
    travel = max(float(np.ptp(each.position)) for each in recordings)
    resolution, largest = sensor_resolution(recordings), largest_command(recordings)
    if travel <= FEWEST_COUNTS * resolution:
        raise ParameterError(stuck(travel / resolution, largest))
    units = [travel, largest, travel / largest, travel / largest / recordings[0].period ** 2]
    if not all(SMALLEST_UNIT < unit < 1 / SMALLEST_UNIT for unit in units):
        raise ParameterError(
            f"the position changes by {travel:.3g} under a command of {largest:.3g} at T = {recordings[0].period:.3g} "
            "s; expected values in SI. Correct the units in the profile."
        )


def _check_periods(recordings: list[Recording]) -> None:
    """Refuse logs whose sampling periods differ or are invalid."""
    periods = np.array([each.period for each in recordings])
    low, high = float(periods.min()), float(periods.max())
    if not low > SMALLEST_UNIT or not high < 1 / SMALLEST_UNIT:
        raise ParameterError(
            f"sampling periods of {low:g} to {high:g} s; expected values between a microsecond and a day."
        )
    if high - low <= SAME_PERIOD * low:
        return
    names = [
        f"{period:g} s ({counted(len(some), 'log')}, such as {some[0]})"
        for period in np.unique(np.round(periods, 12)).tolist()
        if (some := [each.name for each in recordings if abs(each.period - period) <= 1e-9 * period + 1e-12])
    ]
    raise ParameterError(
        f"the logs have {len(names)} sampling periods: {listed(names[:4])}. Delays are identified in samples, so "
        "only logs with the same sampling period can be identified together. Pass the logs of one period only."
    )


def _replay(recordings: list[Recording], choice: Choice) -> list[Replay]:
    """Return the fit of free runs of each log by a device that is fitted without the fold of the log.

    For a single log, the device is fitted to the first part of the log, and the last part is replayed.
    """
    lead, free = choice.segments.lead, choice.segments.free
    if len(recordings) == 1:
        cuts = [_first_part(each) for each in recordings]
        before = [_cut(each, 0, cut) for each, cut in zip(recordings, cuts, strict=True)]
        segments = segments_of(before, choice.units, lead, choice.moving and not free, free)
        device = replace(choice.fit.device, effects=None)
        if len(segments):
            device = refined(segments, device, steps=8, far=False, noisy=False).device
        last = [_cut(each, cut, len(each.time)) for each, cut in zip(recordings, cuts, strict=True)]
        return replays(last, choice.units, lead, replace(device, effects=None))
    return replays_left_out(recordings, choice.units, lead, choice.segments, choice.fit)


def _first_part(each: Recording) -> int:
    """Return the row up to which a single log contains the share `1 - LAST` of its velocity changes."""
    changes = np.cumsum(np.abs(np.diff(each.motion.velocity)))
    return int(np.searchsorted(changes, (1 - LAST) * changes[-1]))


def _cut(each: Recording, first: int, behind: int) -> Recording:
    inside = slice(first, behind)
    return replace(each, time=each.time[inside], command=each.command[inside], position=each.position[inside])


OWN = ("mass", "damping", "delay_samples")
"""Parameters that are identified for each trial. The other parameters keep their common values."""


def own_numbers(found: Identification) -> dict[str, list[float]]:
    """Return mass [kg, kg m^2], damping [Ns/m, Nms/rad] and delay [samples] of each trial, each followed by its error.

    Friction and constant force are the model's values for the trial. All other parts have common values.
    """
    fit, units = found.choice.fit, found.units
    if fit.few:
        return {}
    names, numbers, effects = list(fit.device.names), fit.device.numbers, fit.device.effects
    own = [(ESTIMATED[name].number, ESTIMATED[name].quantity(units)) for name in OWN]
    places = [names.index(number) for number, _ in own if number in names]
    products = fit.moments.products
    information, score = products[:, :-1, :-1], products[:, :-1, -1]
    if effects is not None:
        others = effects.copy()
        others[:, places] = 0.0
        score = score - (information @ others[..., None])[..., 0]
    of_places = information[:, places][:, :, places]
    known = inverse(of_places)
    step = (known @ score[:, places, None])[..., 0]
    base = np.array([numbers[names[place]] for place in places])

    def quantity_at(quantity: Quantity, at: Floats) -> float:
        return quantity(numbers | dict(zip((names[place] for place in places), at.tolist(), strict=True)))

    estimates = np.zeros((len(products), 2 * len(own)))
    for column, (number, quantity) in enumerate(own):
        if number in names:
            near = np.diag(1e-4 * np.abs(base) + 1e-10)
            ends = [(quantity_at(quantity, base + each), quantity_at(quantity, base - each)) for each in near]
            slope = np.array([up - down for up, down in ends]) / (2 * np.diagonal(near))
            variance = np.einsum("i,tij,j->t", slope, known, slope) * fit.solved.noise / fit.solved.weight
            estimates[:, 2 * column] = quantity_at(quantity, base) + step @ slope
            estimates[:, 2 * column + 1] = np.sqrt(variance)
    moves = (np.diagonal(of_places, axis1=1, axis2=2) > 0).all(axis=1)
    return {found.names[trial]: estimates[trial].tolist() for trial in np.flatnonzero(moves).tolist()}
