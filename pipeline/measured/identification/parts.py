"""Select the parts of a device by cross-validation. A part is accepted if trials that were left out are more likely
with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.progress import part_of_work, report
from pipeline.measured.identification.drive import DRIVE, applied_command
from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.identification.first_guess import BALANCED, first_guesses
from pipeline.measured.identification.free_search import LOAD_PARTS, MODE, SENSED, free_fit, required_gain, with_mode
from pipeline.measured.identification.intervals import Errors
from pipeline.measured.identification.likelihood import (
    DONE,
    LIMITS,
    ROUNDED_ROW,
    WORTH,
    Device,
    Fit,
    moments_of,
)
from pipeline.measured.identification.motion import GRAVITY
from pipeline.measured.identification.noise import WHITE, Noise
from pipeline.measured.identification.part_table import CLOSER, NEARBY, OPEN_PARTS, PARTS, Decision, Part, TriedPart
from pipeline.measured.identification.recordings import SHORTEST, LogUnits, Recording, reading_noise
from pipeline.measured.identification.replay import medians, replays, replays_left_out
from pipeline.measured.identification.scatter import FEWEST, Solved, inverse, solve
from pipeline.measured.identification.search import climbed, ended, refined
from pipeline.measured.identification.segments import Segments, segments_of
from pipeline.records.trials import Integers

BASE = ("gain", "delta", "delay", "force")
"""Numbers that every device has."""

SHORTER = (150,)
"""Largest number of rows of short segments, which give additional starting values. It is about ten time constants of a
fast motor at 1 kHz."""

STARTS = 2
"""Number of initial devices for a search on whole segments. One has a spring, and one does not."""

MOST_TRIALS = 100
"""Largest number of trials that are used to choose parts. All trials are used for the final fit."""

LONGEST_DELAY = 48
"""Longest delay [samples] that is searched for."""

LIMIT_DELAY, LIMIT_ROWS = 3.0, 4
"""Longest delay [samples] in the search for a force limit and from the applied command, and number of rows on each side
for the speed."""

LIMITS_SOUGHT = 0.05, 0.99, 150
"""Smallest and largest limit of the command in the search for a force limit, and number of trial values (2 % apart)."""

CLEARLY, RANDOM_COMMAND = 3.0, 0.3
"""Smallest rms excess of commands over a force limit, relative to the noise of the command, and noise of a command,
relative to its standard deviation, above which the command itself is random. The excess of pure noise has an rms of 1.
Independent levels of every row have a noise of about 1, and the noise of measured currents is below 0.1."""

LIMIT_SPREADS = (0.015, 0.005, 0.0015)
"""Relative steps of the search for a force limit near the best value. The force balances of a ramp far beyond the limit
are accurate only to a percent."""

DELAYS, FRICTIONS = 4, (0.3, 2.0)
"""Number of delays over their range, and factors of the best friction, from which other optima are searched for."""

UNSEEN = (0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2, 3.2)
"""Lags [samples] that may be part of a delay. Rounding can make shorter lags more likely than none."""

IMITATED = 0.75
"""Threshold for the lag [samples]. Below it, a fast mode, beyond the range of the search, has the same effect. A mode
at 1.9 rad/sample acts like a lag of 0.38 samples with a delay that is shorter by the same amount."""

BESIDE = 1.92
"""Drop of the log-likelihood at the ends of a 95 % profile interval."""

WEIGHED = 0.1
"""Share of the fitted random force that is assumed in the search for a starting value of a part."""

EXPLAINED = 95.0
"""Threshold for the fit of free runs without gravity [%]. Above it, gravity is small enough to be added later."""

LOOKED_AT = 9000
"""Number of rows used in the first search for parts, in segments spread over all rows. More rows would
not change any decision."""

FIRST_STEPS, SOME_STEPS = 4, 10
"""Number of steps of the first search for a part: with the noise of readings only, and with all noise."""

IMITATING = {"gain by direction", "gain by size", "gravity", "saturation"}
"""Parts that may imitate a slow mode, friction or each other in the first search, and are tried again without after the
last."""

LEFT = 0.5
"""Largest share of the random force's variance that may remain after a part is added. It was 0.85 for a force limit
that imitated a stiffening hand, and less than 0.01 for real parts."""

AS_WELL = 1.05
"""Largest error of free runs with a part, relative to that without, at which both predict equally well."""

HEAVY = 0.5
"""Smallest share of the mass for which the load of a mode may actually be the base of a spring."""

SLOW = 4 * np.pi
"""Largest phase [rad] of a mode over a log for which the load hardly moves (two periods)."""

FEW_PERIODS = 20 * np.pi
"""Threshold for the phase [rad] of a mode over a segment. Below it, the unknown initial states hide the mode (ten
periods)."""

APART = 10.0
"""Largest range of the initial positions of logs that begin in the same place, in noise standard deviations of a
reading."""

UNSEEN_FRICTION = 0.02
"""Friction that may remain undetected, relative to the largest command. Beyond it, unknown friction is included in the
fit. The relative error of the mass equals this ratio."""

SLIGHT = 1e-6
"""Threshold for the force of a spring or of friction, relative to the largest command. Below it, the force counts as
zero. The value separates rounding from real forces in exact logs."""

CONSTANT = 1e-3
"""Threshold for the change of the commands, relative to the largest one. Below it, the commands are treated as one
constant command."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Fit of a device with its parts, and the gain of cross-validated likelihood of each part.

    A part with a gain of 0 is undecided, and its number is included as unknown. ``assumed`` contains the names of
    parameters that are assumed to be zero. ``bounds`` contains upper ends for absent friction, spring and lag. For a
    delay that cannot be separated from a lag, it contains the other end of the delay's range. Keys are names of
    `ESTIMATED`. ``open`` contains the names of parts as in `ChosenParts`, and ``tried`` the test of each part that was
    tried.
    """

    fit: Fit
    segments: Segments
    units: LogUnits
    parts: dict[str, float]
    assumed: tuple[str, ...]
    bounds: dict[str, float] = field(default_factory=dict)
    open: tuple[str, ...] = ()
    tried: dict[str, TriedPart] = field(default_factory=dict)

    @property
    def moving(self) -> bool:
        """Whether rows with an unknown direction of motion are excluded."""
        return "friction" in self.parts


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


@dataclass(frozen=True, eq=False)
class Selection:
    """Intermediate result of the selection: a fit to segments, its parts with their gains, and all tests so far."""

    segments: Segments
    fit: Fit
    parts: dict[str, float]
    tried: dict[str, TriedPart]


def held_out(fit: Fit) -> float:
    """Return the cross-validated log-likelihood. Fits without one fold are one Newton step from the fit to all units.

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

    If there are more than `MOST_TRIALS`, those with the smallest hashes of their samples are used. Then, an additional
    log replaces at most one of these recordings, and neither its motion nor its wall influences the choice.
    """
    some = sorted(recordings, key=lambda each: each.rank[2:])[:MOST_TRIALS]
    return sorted(some, key=lambda each: each.rank)


def choose_parts(recordings: list[Recording], without: Sequence[str] = ()) -> ChosenParts:
    """Choose the parts of a device that cross-validation over the `subset` of the recordings requires.

    The spring of a device is relaxed at a fixed position, and the spring of a hand where each log begins. Logs that
    begin in several places decide between both.

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
    """Return the parts of a device with a spring relaxed at the origin of the units, its fit, and the segment length.

    The segment length is the median number of rows.
    """
    rows = int(np.median([len(each.time) for each in some]))
    base, assumed = _base(some)
    most = int(np.clip(rows // 8, 2, LONGEST_DELAY))
    begin = _begin(some, units, base, most)
    lead = int(np.ceil(max(each.numbers.get("delay", 0.0) for each in begin))) + 3
    with part_of_work("", 0.1, 0.5):
        state, bounds = _first(some, units, lead, begin)
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
    # a part that was accepted and is absent from the result imitated a later one
    tried = {
        name: replace(test, decision="imitated") if test.decision == "accepted" and name not in state.parts else test
        for name, test in state.tried.items()
    }
    found = device.numbers, device.noise, device.reading
    unconfirmed = tuple(name for name in OPEN_PARTS if name in tried and tried[name].decision == "free runs")
    chosen = ChosenParts(*found, units, lead, state.parts, assumed, bounds, segments.free, unconfirmed, tried)
    return chosen, state.fit, float(np.median(segments.rows))


def _from_applied_command(state: Selection) -> Selection:
    """Return a selection that is also searched from first guesses with the command that a limited drive applies.

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
        begin = [guess for part in parts for guess in _first_devices(part, names, LIMIT_DELAY)]
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

    Without gravity, no device may be near the one that explains the motion, so that gravity cannot be added later.
    Free runs of logs left out decide, since both fits may use different rows. For a single log, the random forces
    decide. ``most`` is the longest delay of the search. The result is the number of rows before a segment whose
    commands may still act in it, the selection, and its bounds (see `_first`).
    """
    some, units, _ = logs
    without = _velocity_fit(logs, plain.segments, plain.fit)
    if without is None or without > EXPLAINED:
        return None
    begin = _begin(some, units, base, most)
    lead = int(np.ceil(max(each.numbers.get("delay", 0.0) for each in begin))) + 3
    state, bounds = _first(some, units, lead, begin)
    found = _velocity_fit((some, units, lead), state.segments, state.fit)
    if "stiffness" in state.parts:
        # a spring may take up a few degrees of gravity, and is wild without one of the logs
        alone = refined(state.segments, _springless(state.fit.device), far=False)
        springless = _velocity_fit((some, units, lead), state.segments, alone)
        if found is None or (springless is not None and springless >= found):
            found = springless
            parts = {name: gain for name, gain in state.parts.items() if name != "stiffness"}
            state = replace(state, fit=alone, parts=parts)
    if found is None or 100 - found > LEFT**0.5 * (100 - without):
        return None
    if len(some) == 1 and not _takes_away(plain.fit, state.fit):
        return None
    gain = sum(_loss(state.fit, name, signed=True) for name in GRAVITY)
    test = TriedPart("accepted", gain, PARTS["gravity"].threshold)
    return lead, replace(state, parts=state.parts | {"gravity": gain}, tried=state.tried | {"gravity": test}), bounds


def _velocity_fit(logs: Logs, segments: Segments, fit: Fit) -> float | None:
    """Return the median fit of free runs to logs left out [%], or to the log itself if there is only one."""
    if len(logs[0]) == 1:
        return medians(replays(*logs, replace(fit.device, effects=None)))[0]
    return medians(replays_left_out(*logs, segments, fit))[0]


def _swinging(logs: Logs, state: Selection) -> Selection:
    """Return the selection after free runs decide on a mode, for logs with friction or a slow mode.

    From `FEWEST` logs behind walls on, segments show the mode, since walls reverse the motion at different rows.
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
        # the test on segments is the more precise one if free runs show no error
        return state if found.decision == "small errors" else replace(state, tried=state.tried | {mode: found})
    left = {name: value for name, value in numbers.items() if name not in (*MODE, "load_damping")}
    fit = refined(segments, replace(fit.device, numbers=left, effects=None))
    rest = {name: gain for name, gain in parts.items() if name not in (*modes, *LOAD_PARTS)}
    without = {name: replace(test, decision="imitated") for name, test in state.tried.items() if name in LOAD_PARTS}
    # a mode on the wrong side may hide the true one
    return _swinging(logs, Selection(segments, fit, rest, state.tried | without | {mode: found}))


def fit_parts(recordings: list[Recording], chosen: ChosenParts) -> Choice:
    """Fit a device with chosen parts to recordings in the order of their ranks.

    Raises
    ------
    numpy.linalg.LinAlgError
        If no device fits.
    """
    units, lead = chosen.units, chosen.lead
    if chosen.free:
        segments = segments_of(recordings, units, lead, False, chosen.free)
        segments, fit = free_fit(segments, chosen.device, errors=chosen.free)
        fit = ended(segments, fit.device)
    else:
        segments = segments_of(recordings, units, lead, "friction" in chosen.parts)
        fit = ended(segments, chosen.device)
    if fit.few and not segments.free and "coulomb" in fit.device.numbers and "delay" in fit.device.numbers:
        fit = _spanned(segments, fit, lead)
    numbers = fit.device.numbers
    absent = (name for name in chosen.bounds if ESTIMATED[name].number not in numbers)
    bounds = {name: chosen.bounds[name] for name in absent if chosen.bounds[name] <= _largest_bound(name, units)}
    if lag := _unseen_lag(segments, fit):
        bounds |= {"actuator_lag_s": lag * units.period, "delay_samples": numbers["delay"] - lag}
    elif numbers.get("lag", np.inf) < IMITATED:
        bounds["delay_samples"] = numbers["delay"] + numbers["lag"]
    return Choice(fit, segments, units, chosen.parts, chosen.assumed, bounds, chosen.open, chosen.tried)


def _largest_bound(name: str, units: LogUnits) -> float:
    """Return the largest meaningful upper end of friction or of a spring [SI].

    Friction larger than the largest command would fix the device. A spring stiffer than twice the largest command over
    the largest displacement would not have allowed this displacement.
    """
    return {"friction.coulomb": units.command, "stiffness": 2 * units.command / units.position}[name]


def _spanned(segments: Segments, fit: Fit, lead: int) -> Fit:
    """Return the best of several optima, with intervals that include all optima that the logs do not exclude.

    With friction and few logs there are several optima, because a reversal depends on both friction and delay. The
    search starts from delays over the whole range, with less and with more friction.
    """
    numbers = fit.device.numbers
    starts = [
        replace(fit.device, numbers=numbers | {"delay": float(delay), "coulomb": share * numbers["coulomb"]})
        for delay in np.unique(np.linspace(0, max(lead - 3, 1), DELAYS).round())
        for share in FRICTIONS
    ]
    fits = [fit, *(climbed(segments, device, SOME_STEPS) for device in starts)]
    best = max(fits, key=lambda each: each.likelihood)
    best = fit if best.likelihood < fit.likelihood + DONE else ended(segments, best.device)
    # the last search may find a better optimum than all others
    near = [each for each in fits if each.likelihood > best.likelihood - BESIDE * best.repeats]
    steps = [np.array(list(each.device.numbers.values())) - list(best.device.numbers.values()) for each in near]
    return replace(best, optima=np.stack([*best.optima, *steps]))


def _unseen_lag(segments: Segments, fit: Fit) -> float:
    """Return the longest lag [samples] that cannot be distinguished from an equal additional delay.

    Up to second order in its length, a lag acts like a delay. The result is 0 if the device has a lag or a mode.
    """
    numbers = fit.device.numbers
    if "delay" not in numbers or {"lag", "mode_frequency"} & set(numbers):
        return 0.0
    some, alone = _some(segments), replace(fit.device, effects=None)

    def likelihood(lag: float) -> float:
        late = {"delay": numbers["delay"] - lag} | ({"lag": lag} if lag else {})
        device = replace(alone, numbers=numbers | late)
        # start at the optimum of the other numbers for this lag, because predictions from far away are too optimistic
        step = np.zeros(len(device.names))
        step[: len(numbers)] = _others(some, device, PARTS["lag"], fit.places).step
        return _others(some, device.stepped(step), PARTS["lag"], fit.places).likelihood

    most, end = likelihood(0.0), 0.0
    for lag in (lag for lag in UNSEEN if lag <= numbers["delay"]):
        likely = likelihood(lag)
        if likely < most - BESIDE * fit.repeats:
            return lag if end else 0.0
        end, most = lag, max(most, likely)
    return end


def _first(
    recordings: list[Recording], units: LogUnits, lead: int, begin: list[Device]
) -> tuple[Selection, dict[str, float]]:
    """Return the selection with friction and spring if present or possible, and bounds.

    The search starts from each of the given devices. Bounds are the upper ends of friction and spring [SI], from a fit
    with both.
    """
    bounds, fit, tried = {}, None, dict[str, TriedPart]()
    if "coulomb" in begin[0].numbers and len(segments := segments_of(recordings, units, lead, True)):
        whole = _searched(segments, begin)
        bounds = {name: _upper(whole, name, units) for name in ("friction.coulomb", "stiffness")}
        fit, spring = _worth(segments, whole, begin[0])
        gain, numbers = _loss(fit, "coulomb"), fit.device.numbers
        rubs = gain > WORTH and numbers["coulomb"] / numbers["gain"] > SLIGHT
        if rubs or _upper(fit, "friction.coulomb", units) >= UNSEEN_FRICTION * units.command:
            tried = {"friction": TriedPart("accepted" if rubs else "undecided", gain, WORTH), "stiffness": spring}
            return Selection(segments, fit, {"friction": gain if rubs else 0.0} | _found(spring), tried), bounds
        tried = {"friction": TriedPart("size", gain, WORTH)}
    segments = segments_of(recordings, units, lead, False)
    starts = [_sliding(each) for each in begin]
    fit = refined(segments, _sliding(fit.device), far=False) if fit is not None else _searched(segments, starts)
    bounds["stiffness"] = _upper(fit, "stiffness", units)
    fit, spring = _worth(segments, fit, starts[0])
    return Selection(segments, fit, _found(spring), tried | {"stiffness": spring}), bounds


def _found(spring: TriedPart) -> dict[str, float]:
    """Return the part of a spring with its gain if it is accepted."""
    return {"stiffness": spring.gain} if spring.decision == "accepted" else {}


def _upper(fit: Fit, name: str, units: LogUnits) -> float:
    """Return the upper end of the interval of a nonnegative quantity."""
    return Errors.of(fit).interval(ESTIMATED[name].quantity(units), ends_at_zero=True).high


def _worth(segments: Segments, fit: Fit, begin: Device) -> tuple[Fit, TriedPart]:
    """Return the fit with its spring if the logs show a spring, otherwise the fit without a spring, and the test.

    If the logs seem to show a spring, the search is repeated without it from the same start. With a single wall, a
    spring may imitate the command.
    """
    gain, numbers = _loss(fit, "gamma"), fit.device.numbers
    # relative to the largest command, at the largest displacement
    if gain > WORTH and abs(numbers["gamma"] / numbers["gain"]) > SLIGHT:
        free = refined(segments, _springless(begin))
        if free.likelihood > fit.likelihood - WORTH:
            return free, TriedPart("gain", fit.likelihood - free.likelihood, WORTH)
        return fit, TriedPart("accepted", gain, WORTH)
    return refined(segments, _springless(fit.device), far=False, noisy=False), TriedPart("size", gain, WORTH)


def _springless(device: Device) -> Device:
    return Device({name: value for name, value in device.numbers.items() if name != "gamma"}, device.noise)


def _sliding(device: Device) -> Device:
    """Return a device without friction and with a spring."""
    numbers = {name: value for name, value in device.numbers.items() if name != "coulomb"}
    return Device({"gamma": 0.0} | numbers, device.noise)


def _base(recordings: list[Recording]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the numbers that the commands make identifiable, and the parameters that are assumed to be zero."""
    largest = max(float(np.abs(each.command).max()) for each in recordings)
    if any(np.ptp(each.command) > CONSTANT * largest for each in recordings):
        return BASE, ()
    if any(each.edge is not None for each in recordings):
        return ("gain", "delta", "delay"), ("constant_force",)
    levels = np.array([float(each.command[0]) for each in recordings])
    if np.ptp(levels) > CONSTANT * largest:
        return ("gain", "delta", "force"), ("delay_samples",)
    return ("gain", "delta"), ("delay_samples", "constant_force")


def _begin(recordings: list[Recording], units: LogUnits, base: tuple[str, ...], lead: int) -> list[Device]:
    """Return initial devices for a search, with a spring, and with friction if directions of motion are known.

    Force balances are integrated over whole and over short segments. In a whole segment, a long plateau outweighs the
    fast motion before it; in short segments, a slow motion is hardly visible.

    Raises
    ------
    ParameterError
        If no part of a log is long enough or in motion, or if the device moves against its command.
    """
    segments, names = segments_of(recordings, units, lead, True), (*base, "gamma", "coulomb")
    if not len(segments):
        names, segments = (*base, "gamma"), segments_of(recordings, units, lead, False)
    if not len(segments):
        raise ParameterError(
            f"no log has {SHORTEST} consecutive rows after the first {lead} rows, whose commands are needed for the "
            "delay. Record longer logs, with the step closer to the start"
        )
    parts = [segments, *(segments.split(rows) for rows in SHORTER if segments.rows.max() > 2 * rows)]
    return [device for part in parts for device in _first_devices(part, names, lead)]


def _first_devices(segments: Segments, names: Sequence[str], most_delay: float) -> list[Device]:
    """Return two initial devices from the force balance, one with and one without a spring. The more likely one comes
    first.

    With a single wall, the command is that of a spring and a damper. Except for the delay, a device with a spring and a
    damper but no gain moves in the same way. Reading errors then decide between the two devices.
    """
    some = _some(segments)
    return sorted(first_guesses(segments, names, most_delay), key=lambda device: -_likelihood(some, device))


def _searched(segments: Segments, begin: list[Device]) -> Fit:
    """Return the maximum-likelihood fit, starting from the first device.

    If the best model includes a random force, the search is repeated from all devices without a random force. A random
    force that is included too early may replace friction, a delay, or a fast motion.
    """
    fit = refined(segments, begin[0])
    if not fit.solved.information.any():
        raise ParameterError(
            "no motion follows the edge of the command, so the logs contain no information on the device. Record for a "
            "longer time after the edge, and start at rest"
        )
    if segments.trials < FEWEST and len(begin) > 1:
        first, second = (climbed(segments, device).solved.here for device in begin[:2])
        # one fit suffices if both starts lead to the same optimum without a random force
        if abs(first - second) >= WORTH:
            fit = max(fit, refined(segments, begin[1]), key=lambda each: each.likelihood)
    if fit.device.noise == WHITE or (len(begin) <= STARTS and segments.trials >= FEWEST):
        return fit
    some = _some(segments)
    climbs = [climbed(some, device) for device in begin]
    here = climbed(some, replace(fit.device, noise=WHITE, effects=None))
    # if all have the same optimum without a random force, the random force has replaced nothing
    best = max(climbs, key=lambda each: each.solved.here)
    if best.solved.here < here.solved.here + WORTH:
        return fit
    if segments.trials >= FEWEST:
        climbs = [best]
    other = max((refined(some, each.device, far=False) for each in climbs), key=lambda each: each.likelihood)
    if some is not segments:
        whole = refined(some, replace(fit.device, effects=None), far=False)
        if other.likelihood <= whole.likelihood + WORTH:
            return fit
        other = refined(segments, replace(other.device, effects=None), far=False)
    return other if other.likelihood > fit.likelihood else fit


def _likelihood(segments: Segments, device: Device) -> float:
    """Return the likelihood of a device without a further search."""
    return solve(moments_of(segments, device), np.empty(0, dtype=np.int64)).here


def _pruned(logs: Logs, state: Selection) -> Selection:
    """Remove friction and spring if they only imitated another part, and return the selection.

    Friction that another part has hidden is added.
    """
    recordings, units, lead = logs
    segments, fit, parts, tried = state.segments, state.fit, state.parts, dict(state.tried)
    for name, number in (("friction", "coulomb"), ("stiffness", "gamma")):
        if name not in parts:
            continue
        if (gain := _loss(fit, number)) > WORTH:
            tried[name] = TriedPart("accepted", parts[name] or gain, WORTH)
            parts = parts | {name: parts[name] or gain}
            continue
        if name == "friction":
            if _upper(fit, "friction.coulomb", units) >= UNSEEN_FRICTION * units.command:
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


def _loss(fit: Fit, name: str, *, signed: bool = False) -> float:
    """Return the loss of likelihood if a number in which the motion is linear is set to 0.

    A negative number has no meaning and no loss, unless it may be ``signed``.
    """
    found = Errors.of(fit).interval(lambda n: n[name])
    return 0.5 * (found.value / found.error) ** 2 if (signed or found.value > 0) and found.error > 0 else 0.0


def _further(logs: Logs, state: Selection, optional: Mapping[str, Part]) -> Selection:
    """Add optional parts to a selection. The most likely part is added first, since each may replace another."""
    segments, fit, parts, tried = state.segments, state.fit, state.parts, dict(state.tried)
    some, left, rounds = _some(segments), dict(optional), 0
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
    elif gain > required and _is_inside(other.device, part):
        decision = "accepted" if _predicts(logs, segments, name, fits) else "free runs"
    return TriedPart(decision, gain, required)


def _tested(some: Segments, alone: Device, part: Part, fits: tuple[Fit, Fit]) -> tuple[Fit | None, TriedPart]:
    """Return the fit with an additional part, or None if the part is not required, and the test.

    The search begins near the device ``alone``. The ``fits`` without the part are one with all noise (``plain``) and
    one with the noise of the readings alone (``white``). A real part makes the motion more likely in both cases.
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
    if part.size and (gain := _loss(found, part.size)) < WORTH:
        return None, TriedPart("size", gain, WORTH)
    gain = found.likelihood - plain.likelihood
    return (found if gain >= part.threshold else None), TriedPart("gain", gain, part.threshold)


def _some(segments: Segments) -> Segments:
    """Return segments with about `LOOKED_AT` rows in total, or all segments if they have fewer."""
    return segments.subset(int(LOOKED_AT / np.mean(segments.rows)) + 1)


def _is_inside(device: Device, part: Part) -> bool:
    """Return whether all numbers of a part are inside their search limits. A force limit that is never reached is not.

    The share of damping in the spring is not tested, since readings at the load hardly show it.
    """
    limits = {name: LIMITS[name] for name in part.numbers if name in LIMITS and name != "spring_damping_fraction"}
    values = {name: device.numbers[name] for name in limits}
    return all(limits[name][0] < value < limits[name][1] or value == 0 for name, value in values.items())


def exceeds_noise(segments: Segments, limit: float) -> bool:
    """Return whether commands exceed a force limit [units of the command] by more than their noise.

    In a measured command, such as a current, the noise does not drive the device. A limit inside the noise of a
    plateau removes half of it, and is more likely than none. The noise is that of third differences. A command that
    changes as much in every row has none.
    """
    command = segments.command[segments.places]
    noise = reading_noise(command, 0.0)
    beyond = np.abs(command) - limit
    beyond = beyond[beyond > 0]
    if noise > RANDOM_COMMAND * float(np.std(command)) or not len(beyond):
        return True
    return bool(np.sqrt(np.mean(beyond**2)) > CLEARLY * noise)


def _predicts(logs: Logs, segments: Segments, name: str, fits: tuple[Fit, Fit]) -> bool:
    """Return whether the second fit, which has one more part, predicts more of the motion than the first one.

    There are two ways: the fit leaves less random force (`_takes_away`), or its free runs of logs left out have at most
    `LEFT` of the variance of the error. The second one is for a ripple of the force at each turn, a random force that
    no part removes. A mode must not make the free runs worse. Only the random force is judged for walls, and for a
    single log.
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
    """Return whether ``other`` has at most `LEFT` of the random force of ``fit``, or of its jitter without a force."""
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
        climbs = (climbed(segments, each, FIRST_STEPS) for each in (found, _saturated(segments, device)))
        found = max(climbs, key=lambda each: each.likelihood).device
    return found


def _saturated(segments: Segments, device: Device) -> Device:
    """Return the most likely device with a force limit, from force balances with a clipped command.

    If most commands exceed the limit, the numbers of a device without a limit are far from the true ones. The search
    starts at the limit above which the velocity no longer follows the command.
    """
    known = [name for name in (*BALANCED, "delay") if name in device.names]

    def guessed(limit: float) -> tuple[float, Device]:
        clipped = replace(segments, command=np.clip(segments.command, -limit, limit))
        devices = [replace(device, noise=WHITE, effects=None, numbers=device.numbers | {"limit": limit})]
        with suppress(ParameterError):
            for guess in first_guesses(clipped, known, LIMIT_DELAY):
                numbers = devices[0].numbers | {name: guess.numbers[name] for name in known}
                devices.append(replace(devices[0], numbers=numbers))
        return max(((_likelihood(segments, each), each) for each in devices), key=lambda pair: pair[0])

    best = guessed(_static_limit(segments))
    for reach in LIMIT_SPREADS:
        near = (best[1].numbers["limit"] * (1 + reach * way) for way in (-2, -1, 1, 2))
        best = max([best, *(guessed(limit) for limit in near if limit < 1)], key=lambda pair: pair[0])
    return best[1]


def _static_limit(segments: Segments) -> float:
    """Return the command limit for which the speed is closest to a linear function of the command clipped at this
    limit."""
    ahead = segments.places[LIMIT_ROWS:-LIMIT_ROWS]
    inside = segments.segment[: -2 * LIMIT_ROWS] == segments.segment[2 * LIMIT_ROWS :]
    row = ahead[inside]
    speed = segments.position[row + LIMIT_ROWS] - segments.position[row - LIMIT_ROWS]
    command, limits = segments.command[row], np.geomspace(*LIMITS_SOUGHT)

    def left(limit: float) -> float:
        clipped = np.clip(command, -limit, limit)
        columns = np.stack([clipped, np.sign(speed), np.ones(len(clipped))], axis=1)
        return float(((speed - columns @ np.linalg.lstsq(columns, speed, rcond=None)[0]) ** 2).sum())

    return min(limits.tolist(), key=left) if len(row) else 1.0


def _best(segments: Segments, device: Device, part: Part, starts: list[dict[str, float]]) -> Device:
    """Return the best device for several values of a part's numbers. All other numbers are optimised for each."""
    devices = (replace(device, numbers=device.numbers | each) for each in starts)
    return max(devices, key=lambda each: _promise(segments, each, part))


def _promise(segments: Segments, device: Device, part: Part) -> float:
    """Return the likelihood of a device after optimisation of the numbers that do not belong to a part."""
    return _others(segments, device, part, np.empty(0, dtype=np.int64)).likelihood


def _others(segments: Segments, device: Device, part: Part, random: Integers) -> Solved:
    """Return the estimate of the numbers that do not belong to a part. Those at ``random`` vary between trials."""
    others = tuple(name for name in device.names if name not in part.numbers)
    return solve(moments_of(segments, device, others), random)
