"""Select the parts of a device by cross-validation. A part is accepted if trials that were left out are more likely
with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.progress import part_of_work, report
from pipeline.measured.identification.drive import DRIVE, applied_command
from pipeline.measured.identification.first_fit import (
    SHORTER,
    UNSEEN_FRICTION,
    Selection,
    base_numbers,
    devices_of,
    first_devices,
    first_fit,
    loss_without,
    some_of,
    springless,
    upper_end,
)
from pipeline.measured.identification.first_guess import BALANCED
from pipeline.measured.identification.force_limit import LIMIT_DELAY, exceeds_noise, saturated
from pipeline.measured.identification.free_search import LOAD_PARTS, MODE, SENSED, required_gain, with_mode
from pipeline.measured.identification.likelihood import LIMITS, ROUNDED_ROW, WORTH, Device, Fit, moments_of
from pipeline.measured.identification.motion import GRAVITY
from pipeline.measured.identification.noise import WHITE, Noise
from pipeline.measured.identification.part_table import CLOSER, NEARBY, OPEN_PARTS, PARTS, Decision, Part, TriedPart
from pipeline.measured.identification.recordings import LogUnits, Recording
from pipeline.measured.identification.replay import medians, replays, replays_left_out
from pipeline.measured.identification.scatter import Solved, inverse, solve
from pipeline.measured.identification.search import climbed, refined
from pipeline.measured.identification.segments import Segments, segments_of
from pipeline.records.trials import Integers

MOST_TRIALS = 100
"""Largest number of trials that are used to choose parts. All trials are used for the final fit."""

LONGEST_DELAY = 48
"""Longest delay [samples] in the search."""


BESIDE = 1.92
"""Drop of the log-likelihood at the ends of a 95 % profile interval."""

WEIGHED = 0.1
"""Share of the fitted random force that is assumed in the search for a starting value of a part."""

EXPLAINED = 95.0
"""Threshold for the fit of free runs without gravity [%]. Above it, gravity is small enough to be added later."""


FIRST_STEPS, SOME_STEPS = 4, 10
"""Number of steps of the first search for a part: with the noise of readings only, and with all noise."""

IMITATING = {"gain by direction", "gain by size", "gravity", "saturation"}
"""Parts that may imitate a slow mode, friction or each other in the first search. After the last search, each of them
is removed on trial."""

LEFT = 0.5
"""Largest share of the random force's variance that may remain after a part is added. It was 0.85 for a force limit
that imitated a stiffening hand, and less than 0.01 for real parts."""

AS_WELL = 1.05
"""Largest error of free runs with a part, relative to the error without it, at which both predict equally well."""

HEAVY = 0.5
"""Smallest share of the mass for which the load of a mode may actually be the base of a spring."""

SLOW = 4 * np.pi
"""Largest phase [rad] of a mode over a log for which the load hardly moves (two periods)."""

FEW_PERIODS = 20 * np.pi
"""Threshold for the phase [rad] of a mode over a segment. Below it, the unknown initial states hide the mode (ten
periods)."""

APART = 10.0
"""Largest range of the initial positions of logs that begin in the same place, in standard deviations of the noise of a
reading."""


@dataclass(frozen=True, eq=False)
class ChosenParts:
    """Parts of a device and starting point for a fit to its logs.

    Parameters
    ----------
    numbers : dict of str to float
        Numbers of the device by name, in ``units``.
    noise : Noise
    reading : float
        Variance of a reading, in ``units``.
    units : LogUnits
    lead : int
        Number of rows before a segment whose commands may still act in it due to the delay.
    parts : dict of str to float
        Gain of cross-validated log-likelihood of each part, or 0 if undecided.
    assumed : tuple of str
        Names of parameters that are assumed to be zero.
    bounds : dict of str to float
        Upper ends of friction and spring [SI], from a fit with both.
    free : tuple of float
        Filter that whitens the errors of free runs, as in `Segments`, if free runs determine the device.
    open : tuple of str
        Names of those `OPEN_PARTS` that logs left out require, but free runs do not confirm.
    tried : dict of str to TriedPart
        Test of each part that was tried. Empty if the parts were read from a stored table.
    """

    numbers: dict[str, float]
    noise: Noise
    reading: float
    units: LogUnits
    lead: int
    parts: dict[str, float]
    assumed: tuple[str, ...]
    bounds: dict[str, float]
    free: tuple[float, ...] = ()
    open: tuple[str, ...] = ()
    tried: dict[str, TriedPart] = field(default_factory=dict)

    @property
    def device(self) -> Device:
        """Initial device for a fit."""
        return Device(self.numbers, self.noise, reading=self.reading)


Logs = tuple[list[Recording], LogUnits, int]
"""Recordings, their units, and the number of rows before a segment whose commands may still act in it."""


def held_out(fit: Fit) -> float:
    """Return the cross-validated log-likelihood. The fit without a fold is one Newton step away from the fit to all
    units.

    With few logs, each portion is a fold, and the step is of first order (Takeuchi's criterion).
    """
    solved = fit.solved
    if fit.few:
        return fit.likelihood - float(np.einsum("ti,ij,tj->", solved.score, inverse(solved.total), solved.score))
    # positive only by rounding, if a direction is hardly identified
    losses = (float(score @ step - 0.5 * step @ information @ step) for information, score, step in solved.folds())
    return fit.likelihood + sum(min(loss, 0.0) for loss in losses)


def subset(recordings: list[Recording]) -> list[Recording]:
    """Return the recordings that are used to choose parts, in the order of their ranks.

    If there are more than `MOST_TRIALS`, the recordings with the smallest hashes of their samples are used. Then, an
    additional log replaces at most one of these recordings, and neither its motion nor its wall influences the choice.
    """
    some = sorted(recordings, key=lambda each: each.rank[2:])[:MOST_TRIALS]
    return sorted(some, key=lambda each: each.rank)


def choose_parts(recordings: list[Recording], without: Sequence[str] = ()) -> ChosenParts:
    """Choose the parts of a device that cross-validation over the `subset` of the recordings requires.

    The spring of a device is relaxed at a fixed position, and the spring of a hand where each log begins. Logs that
    begin in several places decide between the two.

    Parameters
    ----------
    recordings : list of Recording
        At least one recording with `recordings.SHORTEST` rows.
    without : sequence of str
        Names of parts that are not tried.

    Raises
    ------
    ParameterError
        If no part of a log is long enough or in motion, or if the device moves against its command.
    numpy.linalg.LinAlgError
        If no device fits.
    """
    some = subset(recordings)
    with part_of_work("", 0.0, 0.95):
        chosen, fit, rows = _search(some, LogUnits.of(some), without)
    starts, noise = [each.position[0] for each in some], max(each.noise for each in some)
    if np.ptp(starts) <= APART * noise or not ("stiffness" in chosen.parts or _is_like_ground(chosen, rows)):
        return chosen
    with part_of_work("", 0.95, 1.0):
        by_start, other, _ = _search(some, replace(chosen.units, origin=None), without)
    return by_start if _worthiness(other) > _worthiness(fit) + WORTH else chosen


def _is_like_ground(chosen: ChosenParts, rows: float) -> bool:
    """Return whether the load of a mode may be the base of a spring, i.e. is heavy or hardly moves in a log."""
    turn = chosen.numbers.get("mode_frequency", np.inf)
    return chosen.numbers.get("load_mass_fraction", 0.0) > HEAVY or turn * rows < SLOW


def _worthiness(fit: Fit) -> float:
    """Return the likelihood of a fit minus the gain required for each of its numbers."""
    return fit.likelihood - WORTH * len(fit.device.names)


def _search(some: list[Recording], units: LogUnits, without: Sequence[str]) -> tuple[ChosenParts, Fit, float]:
    """Return the parts of a device whose spring is relaxed at the origin of the units, the fit, and the segment length.

    The segment length is the median number of rows.
    """
    rows = int(np.median([len(each.time) for each in some]))
    base, assumed = base_numbers(some)
    most = int(np.clip(rows // 8, 2, LONGEST_DELAY))
    begin = first_devices(some, units, base, most)
    lead = int(np.ceil(max(each.numbers.get("delay", 0.0) for each in begin))) + 3
    with part_of_work("", 0.1, 0.5):
        state, bounds = first_fit(some, units, lead, begin)
    if state.segments.scale:
        heavy = _with_gravity((some, units, lead), (*base, *GRAVITY), most, state)
        lead, state, bounds = heavy or (lead, state, bounds)
    with part_of_work("", 0.5, 1.0):
        parts = {name: part for name, part in PARTS.items() if name not in without}
        state = _further((some, units, lead), state, parts)
    if set(state.parts) - {"friction", "stiffness"}:
        state = _pruned((some, units, lead), state)
    state = _without_imitations((some, units, lead), _swinging((some, units, lead), state))
    state = _from_applied_command(state)
    device, segments = state.fit.device, state.segments
    # a part that was accepted but is absent from the result imitated a part that was found later
    tried = {
        name: replace(test, decision="imitated") if test.decision == "accepted" and name not in state.parts else test
        for name, test in state.tried.items()
    }
    found = device.numbers, device.noise, device.reading
    unconfirmed = tuple(name for name in OPEN_PARTS if name in tried and tried[name].decision == "free runs")
    chosen = ChosenParts(*found, units, lead, state.parts, assumed, bounds, segments.free, unconfirmed, tried)
    return chosen, state.fit, float(np.median(segments.rows))


def _from_applied_command(state: Selection) -> Selection:
    """Return the selection after a further search, from first guesses with the command that a limited drive applies.

    Before a limit or a gain of the drive was known, a long delay and a random force may have replaced the time constant
    of the device.
    """
    segments, fit = state.segments, state.fit
    drive = {name: value for name, value in fit.device.numbers.items() if name in DRIVE}
    if not drive or segments.free or fit.device.noise == WHITE:
        return state
    names = [name for name in fit.device.names if name in BALANCED or name == "delay"]
    applied = replace(segments, command=applied_command(segments.command, drive)[0])
    parts = [applied, *(applied.split(rows) for rows in SHORTER if applied.rows.max() > 2 * rows)]
    try:
        begin = [guess for part in parts for guess in devices_of(part, names, LIMIT_DELAY)]
    except ParameterError:
        return state
    starts = [Device(dict(fit.device.numbers) | guess.numbers) for guess in begin]
    best = max((climbed(segments, device) for device in starts), key=lambda each: each.likelihood)
    other = refined(segments, best.device, far=False)
    return replace(state, fit=other) if other.likelihood > fit.likelihood + WORTH else state


def _with_gravity(
    logs: Logs, base: tuple[str, ...], most: int, plain: Selection
) -> tuple[int, Selection, dict[str, float]] | None:
    """Return the first fit of an arm under gravity, or None if gravity does not explain the logs.

    A search without gravity may end far from the device that explains the motion, so that gravity cannot be added
    later. Free runs of logs left out decide, since both fits may use different rows. For a single log, the random
    forces decide. ``most`` is the longest delay of the search. The result is the number of rows before a segment whose
    commands may still act in it, the selection, and its bounds (see `first_fit`).
    """
    some, units, _ = logs
    without = _velocity_fit(logs, plain.segments, plain.fit)
    if without is None or without > EXPLAINED:
        return None
    begin = first_devices(some, units, base, most)
    lead = int(np.ceil(max(each.numbers.get("delay", 0.0) for each in begin))) + 3
    state, bounds = first_fit(some, units, lead, begin)
    found = _velocity_fit((some, units, lead), state.segments, state.fit)
    if "stiffness" in state.parts:
        # a spring may imitate gravity over a few degrees, and then changes wildly if one of the logs is left out
        alone = refined(state.segments, springless(state.fit.device), far=False)
        without_spring = _velocity_fit((some, units, lead), state.segments, alone)
        if found is None or (without_spring is not None and without_spring >= found):
            found = without_spring
            parts = {name: gain for name, gain in state.parts.items() if name != "stiffness"}
            state = replace(state, fit=alone, parts=parts)
    if found is None or 100 - found > LEFT**0.5 * (100 - without):
        return None
    if len(some) == 1 and not _takes_away(plain.fit, state.fit):
        return None
    gain = sum(loss_without(state.fit, name, signed=True) for name in GRAVITY)
    test = TriedPart("accepted", gain, PARTS["gravity"].threshold)
    return lead, replace(state, parts=state.parts | {"gravity": gain}, tried=state.tried | {"gravity": test}), bounds


def _velocity_fit(logs: Logs, segments: Segments, fit: Fit) -> float | None:
    """Return the median fit of free runs to logs left out [%], or to the log itself if there is only one."""
    if len(logs[0]) == 1:
        return medians(replays(*logs, replace(fit.device, effects=None)))[0]
    return medians(replays_left_out(*logs, segments, fit))[0]


def _swinging(logs: Logs, state: Selection) -> Selection:
    """Return the selection after free runs decide on a mode, for logs with friction or a slow mode.

    With at least `FEWEST` logs of walls, segments show the mode, since walls reverse the motion at different rows.
    """
    segments, fit, parts = state.segments, state.fit, state.parts
    numbers = fit.device.numbers
    if not fit.few and any(any(each.wall) for each in logs[0]):
        return state
    phase = numbers.get("mode_frequency", np.inf) * float(np.median(segments.rows))
    rubs = parts.get("friction", 0.0) > 0 and numbers["coulomb"] > 0
    swings = rubs or ("coulomb" not in numbers and phase < FEW_PERIODS)
    if not swings or "delay" not in numbers or fit.device.noise.jitter:
        return state
    found = with_mode(logs, fit, parts)
    modes = SENSED.values()
    if not isinstance(found, TriedPart):
        gains = {name: gain for name, gain in found[2].items() if name in (*modes, *LOAD_PARTS)}
        tests = {name: TriedPart("accepted" if gain else "undecided", gain, WORTH) for name, gain in gains.items()}
        for name in tests.keys() & set(modes):
            tests[name] = replace(tests[name], required=required_gain(name))
        return Selection(*found, state.tried | tests)
    mode = next((name for name in modes if name in parts), SENSED["motor"])
    if "mode_frequency" not in numbers:
        # the test on segments is more precise if free runs show no error
        return state if found.decision == "small errors" else replace(state, tried=state.tried | {mode: found})
    left = {name: value for name, value in numbers.items() if name not in (*MODE, "load_damping")}
    fit = refined(segments, replace(fit.device, numbers=left, effects=None))
    rest = {name: gain for name, gain in parts.items() if name not in (*modes, *LOAD_PARTS)}
    without = {name: replace(test, decision="imitated") for name, test in state.tried.items() if name in LOAD_PARTS}
    # a mode on the wrong side may hide the true mode
    return _swinging(logs, Selection(segments, fit, rest, state.tried | without | {mode: found}))


def _pruned(logs: Logs, state: Selection) -> Selection:
    """Remove friction and spring if they only imitated another part, and return the selection.

    Friction that another part has hidden is added.
    """
    recordings, units, lead = logs
    segments, fit, parts, tried = state.segments, state.fit, state.parts, dict(state.tried)
    for name, number in (("friction", "coulomb"), ("stiffness", "gamma")):
        if name not in parts:
            continue
        if (gain := loss_without(fit, number)) > WORTH:
            tried[name] = TriedPart("accepted", parts[name] or gain, WORTH)
            parts = parts | {name: parts[name] or gain}
            continue
        if name == "friction":
            if upper_end(fit, "friction.coulomb", units) >= UNSEEN_FRICTION * units.command:
                tried[name] = TriedPart("undecided", gain, WORTH)
                parts = parts | {"friction": 0.0}
                continue
            segments = segments_of(recordings, units, lead, False)
        left = {key: value for key, value in fit.device.numbers.items() if key != number}
        fit = refined(segments, replace(fit.device, numbers=left, effects=None), far=False)
        tried[name] = TriedPart("imitated", gain, WORTH)
        parts = {key: value for key, value in parts.items() if key != name}
    return Selection(segments, fit, parts, tried)


def _without_imitations(logs: Logs, state: Selection) -> Selection:
    """Remove parts of the drive and gravity that only imitated a part found after them, and return the selection.

    A part is removed if the likelihood hardly falls, or if free runs of logs left out have less than `LEFT` of the
    variance of the error without it. If all commands of a log have the same size, a single log shows neither a gain by
    size nor, next to a constant force, a gain by direction.
    """
    segments, fit, parts = state.segments, state.fit, state.parts
    judged = len(logs[0]) > 1 and not any(any(each.wall) for each in logs[0])
    for name in sorted(IMITATING & parts.keys()):
        left = {key: value for key, value in fit.device.numbers.items() if key not in PARTS[name].numbers}
        device = replace(fit.device, numbers=left, effects=None)
        other = climbed(segments, device) if segments.free else refined(segments, device, far=False)
        needless = other.likelihood > fit.likelihood - PARTS[name].threshold
        if name == "saturation":
            needless = needless or not exceeds_noise(segments, fit.device.numbers["limit"])
        if judged and not needless:
            found, alone = (_velocity_fit(logs, segments, each) for each in (fit, other))
            needless = alone is not None and (found is None or 100 - alone < LEFT**0.5 * (100 - found))
        if needless:
            fit, parts = other, {key: value for key, value in parts.items() if key != name}
    return replace(state, fit=fit, parts=parts)


def _further(logs: Logs, state: Selection, optional: Mapping[str, Part]) -> Selection:
    """Add optional parts to a selection. The most likely part is added first, since each may replace another."""
    segments, fit, parts, tried = state.segments, state.fit, state.parts, dict(state.tried)
    some, left, rounds = some_of(segments), dict(optional), 0
    accepted = True
    while accepted and left and "delay" in fit.device.numbers:
        alone, candidates = replace(fit.device, effects=None), dict[str, Fit]()
        plain = fit if some is segments else refined(some, alone, far=False)
        white = climbed(some, replace(plain.device, noise=WHITE, effects=None))
        for number, (name, part) in enumerate(left.items()):
            report(1 - 0.5**rounds * (1 - 0.5 * number / len(left)))
            if part.numbers[0] in alone.names or (part.needs and part.needs not in parts):
                continue
            if part.turning and not segments.scale:
                continue
            other, tried[name] = _tested(some, alone, part, (plain, white))
            if other is not None:
                candidates[name] = other
        rounds += 1
        if candidates and some is not segments:
            fit = refined(segments, alone, far=False)
        accepted = False
        while candidates and not accepted:
            name = max(candidates, key=lambda each: candidates[each].likelihood - PARTS[each].threshold)
            part = left.pop(name)
            # far from the solution, noise may replace the residual, so it is estimated again
            other = refined(segments, replace(candidates.pop(name).device, effects=None), far=False)
            tried[name] = _judged(logs, segments, name, part, (fit, other))
            if tried[name].decision == "accepted":
                accepted, fit, parts = True, other, parts | {name: tried[name].gain}
    if fit.device.noise.jitter and set(parts) - {"friction", "stiffness"}:
        # jitter may have replaced the residual before the search for a part ended
        fit = refined(segments, replace(fit.device, effects=None), far=False)
    return Selection(segments, fit, parts, tried)


def _judged(logs: Logs, segments: Segments, name: str, part: Part, fits: tuple[Fit, Fit]) -> TriedPart:
    """Return the test of a part by logs that were left out and by free runs. The second fit has the part."""
    fit, other = fits
    gain, required = held_out(other) - held_out(fit), WORTH * len(part.numbers)
    decision: Decision = "left out" if gain <= required else "at a limit"
    if gain > required and "limit" in part.numbers and not exceeds_noise(segments, other.device.numbers["limit"]):
        decision = "command noise"
    elif gain > required and _is_inside(segments, other.device, part):
        decision = "accepted" if _predicts(logs, segments, name, fits) else "free runs"
    return TriedPart(decision, gain, required)


def _tested(some: Segments, alone: Device, part: Part, fits: tuple[Fit, Fit]) -> tuple[Fit | None, TriedPart]:
    """Return the fit with an additional part, or None if the part is not required, and the test.

    The search begins near the device ``alone``. The ``fits`` without the part are one with all noise (``plain``) and
    one with only the measurement noise (``white``). A real part makes the motion more likely in both cases.
    """
    plain, white = fits
    start, noise = _having(some, alone, part), plain.device.noise
    if noise == WHITE:
        # if only reading noise remains, most parts can be excluded at the start of their search
        least = ROUNDED_ROW * float(some.rows.sum())
        required = min(least, CLOSER) if part.needs else least
        if (gain := _promise(some, start, part) - _promise(some, plain.device, part)) < required:
            return None, TriedPart("no start", gain, required)
    climb = climbed(some, start, FIRST_STEPS)
    if (gain := climb.likelihood - white.solved.here) < WORTH:
        return None, TriedPart("white noise", gain, WORTH)
    within = refined(some, replace(climb.device, noise=noise), SOME_STEPS, far=False, noisy=False)
    if climb.likelihood > within.likelihood:
        # the random force only replaced the part
        within = climb
    if (gain := within.likelihood - plain.likelihood) < BESIDE:
        return None, TriedPart("random force", gain, BESIDE)
    # a part does not cause jitter, so none is searched for if the fit without the part has none
    found = refined(some, replace(within.device, effects=None), SOME_STEPS, far=False, jitters=noise.jitter > 0)
    if part.size and (gain := loss_without(found, part.size)) < WORTH:
        return None, TriedPart("size", gain, WORTH)
    gain = found.likelihood - plain.likelihood
    return (found if gain >= part.threshold else None), TriedPart("gain", gain, part.threshold)


def _is_inside(segments: Segments, device: Device, part: Part) -> bool:
    """Return whether all numbers of a part are inside their search limits. A force limit that is never reached is
    outside.

    The share of damping in the spring is not tested, since readings at the load hardly show it. Half a period of a mode
    must fit into the longest segment, because a slower vibration looks like a slow force.
    """
    if "mode_frequency" in part.numbers and device.numbers["mode_frequency"] * segments.rows.max() < np.pi:
        return False
    limits = {name: LIMITS[name] for name in part.numbers if name in LIMITS and name != "spring_damping_fraction"}
    values = {name: device.numbers[name] for name in limits}
    return all(limits[name][0] < value < limits[name][1] or value == 0 for name, value in values.items())


def _predicts(logs: Logs, segments: Segments, name: str, fits: tuple[Fit, Fit]) -> bool:
    """Return whether the second fit, which has one more part, predicts more of the motion than the first fit.

    One of two conditions must be met: the fit leaves less random force (`_takes_away`), or its free runs of logs left
    out have at most `LEFT` of the variance of the error. The second condition is for devices with a ripple of the force
    at each turn, which acts as a random force that no part removes. A mode must not make the free runs worse. For logs
    of walls and for a single log, only the random force is judged.
    """
    recordings, units, lead = logs
    taken = _takes_away(*fits)
    judged = len(recordings) > 1 and not any(any(each.wall) for each in recordings)
    if not judged or (taken and name not in {*SENSED.values(), *LOAD_PARTS}):
        return taken
    before, behind = (medians(replays_left_out(recordings, units, lead, segments, fit))[0] for fit in fits)
    if before is None or behind is None:
        return taken
    return 100 - behind <= (AS_WELL if taken else LEFT**0.5) * (100 - before)


def _takes_away(fit: Fit, other: Fit) -> bool:
    """Return whether ``other`` has at most `LEFT` of the random force of ``fit``, or of its jitter if there is no
    force."""
    before, behind = fit.device.noise, other.device.noise
    if before.force > 0:
        return bool(behind.force * other.solved.noise <= LEFT * before.force * fit.solved.noise)
    return (behind.force == 0 or before.jitter > 0) and behind.jitter**2 <= LEFT * before.jitter**2


def _having(segments: Segments, device: Device, part: Part) -> Device:
    """Return the best starting device with an additional part, judged with a small random force.

    Jitter or the full random force would replace the part. Without any noise, the slowest component of the residual
    would dominate.
    """
    device = replace(device, noise=Noise(WEIGHED * device.noise.force))
    starts = part.starts(device.numbers)
    found = _best(segments, device, part, starts)
    if part.near:
        near = [found.numbers[part.near] * factor for factor in NEARBY]
        found = _best(segments, found, part, [{part.near: value} for value in near if value < LIMITS[part.near][1]])
    found = replace(found, noise=WHITE)
    if "limit" in part.numbers:
        climbs = (climbed(segments, each, FIRST_STEPS) for each in (found, saturated(segments, device)))
        found = max(climbs, key=lambda each: each.likelihood).device
    return found


def _best(segments: Segments, device: Device, part: Part, starts: list[dict[str, float]]) -> Device:
    """Return the best device for several values of a part's numbers. All other numbers are optimised for each value."""
    devices = (replace(device, numbers=device.numbers | each) for each in starts)
    return max(devices, key=lambda each: _promise(segments, each, part))


def _promise(segments: Segments, device: Device, part: Part) -> float:
    """Return the likelihood of a device after optimisation of the numbers that do not belong to a part."""
    return other_numbers(segments, device, part, np.empty(0, dtype=np.int64)).likelihood


def other_numbers(segments: Segments, device: Device, part: Part, random: Integers) -> Solved:
    """Return the estimate of the numbers that do not belong to a part. The numbers at ``random`` vary between
    trials."""
    others = tuple(name for name in device.names if name not in part.numbers)
    return solve(moments_of(segments, device, others), random)
