"""Test the velocity of the identified device in free runs over windows of logs that were not used in its fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.identification.likelihood import Device, Fit, columns_of, free_motion, portions_of
from pipeline.measured.identification.motion import GRAVITY, matrices_of
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.recordings import SHORTEST, LogUnits, Recording
from pipeline.measured.identification.scatter import FOLDS, inverse
from pipeline.measured.identification.segments import Segments, segments_of
from pipeline.records.trials import Floats

FRICTIONS = ("coulomb", "load_coulomb")
"""Numbers of the friction of motor and load."""

STILL = 3.0
"""Largest standard deviation of the velocity of a log without motion, relative to the error of the velocity."""

TIME_CONSTANTS = 6.0
"""Length of a window, in units of the longest time constant of the device. It is about one period of a spring, and long
enough for a motor to reach its speed. In a longer window, a small constant force causes drift. In a shorter window, any
device fits."""

INTEGRATOR = 1e-6
"""Largest magnitude [1/sample] of an eigenvalue that is treated as an integrator."""

SMOOTHED = 4
"""Smallest length of a window, as a multiple of the rows on each side over which the velocity is smoothed."""

NOISES = 2.0
"""Mean squared velocity error that is attributed to the readings, relative to the variance due to their noise."""

MOST_REPLAYED = 40
"""Largest number of logs that are replayed, spread evenly over all logs."""

HALVED = 0.5
"""Largest error of a device that follows its command, relative to the error of a motion without the command."""


@dataclass(frozen=True, eq=False)
class FreeRun:
    """Free run over a window of a log, with time [s], command [N, Nm], measured and simulated position [m, rad].

    All arrays have the shape (rows,).
    """

    time: Floats
    command: Floats
    position: Floats
    simulated: Floats

    def velocities(self, half: int) -> tuple[Floats, Floats]:
        """Return the measured and the simulated velocity [m/s, rad/s], smoothed over ``half`` rows on each side.

        The shape is (rows - 2 half,). It is (0,) for a window without enough rows.
        """
        period = float(np.ptp(self.time)) / max(len(self.time) - 1, 1) or 1.0
        measured, simulated = (smoothed_velocity([each], half) / period for each in (self.position, self.simulated))
        return measured, simulated


@dataclass(frozen=True, eq=False)
class Replay:
    """Free runs of one log, and their fit.

    Parameters
    ----------
    log : str
    fit_percent, naive_percent : float
        Fit of the free runs, and fit of a naive motion that does not follow the command (`_naive_errors`) [%].
    half : int
        Number of rows on each side over which the velocity is smoothed.
    windows : tuple of FreeRun
    """

    log: str
    fit_percent: float
    naive_percent: float
    half: int
    windows: tuple[FreeRun, ...]


def follows(fit_percent: float | None, naive_percent: float | None) -> bool:
    """Return whether the error of free runs is at most `HALVED` of the error of a motion without the command."""
    if fit_percent is None or naive_percent is None:
        return False
    return 100 - fit_percent <= HALVED * (100 - naive_percent)


def medians(replay: Sequence[Replay]) -> tuple[float | None, float | None]:
    """Return the median fits of the device and of the naive prediction without the command, or None without motion."""
    fits = np.array([(each.fit_percent, each.naive_percent) for each in replay if np.isfinite(each.fit_percent)])
    return (float(np.median(fits[:, 0])), float(np.median(fits[:, 1]))) if len(fits) else (None, None)


def window_rows(device: Device) -> float:
    """Return the length of a window [samples]; infinite for a device without damping and spring."""
    matrices, sensors = matrices_of(device.shape, ())
    rates = np.abs(np.linalg.eigvals(matrices[0, : sensors.shape[1], : sensors.shape[1]]))
    rates = rates[rates > INTEGRATOR]
    return TIME_CONSTANTS / float(rates.min()) if len(rates) else np.inf


def replays(recordings: Sequence[Recording], units: LogUnits, lead: int, device: Device) -> list[Replay]:
    """Return the fit of free runs to each log, over windows from their best initial states.

    e is the error of the velocity, and v is the velocity, both smoothed as in `Recording.motion`. The fit is
    100 (1 - |e|/|v - mean v|). It is NaN for a log without motion or with constant acceleration.
    """
    whole = segments_of(list(recordings), units, lead, False, whole=True)
    halves = np.array([each.motion.half for each in recordings])
    rows = max(window_rows(device), SMOOTHED * float(halves.max(initial=1)), 2 * SHORTEST)
    windows = whole.split(int(min(rows, whole.rows.max(initial=1))))
    if not len(windows):
        return []
    ends = np.cumsum(windows.rows)[:-1]
    times, commands, readings = (
        np.split(each[windows.places], ends) for each in (windows.time, windows.command, windows.position)
    )
    errors = np.split(_errors(windows, device), ends)
    result = []
    for trial in np.unique(windows.trial).tolist():
        inside, half = np.flatnonzero(windows.trial == trial), int(halves[trial])
        naive = _naive_errors([times[s] for s in inside], [readings[s] for s in inside])
        of_device, *of_naive, velocity = (
            smoothed_velocity(each, half)
            for each in ([errors[s] for s in inside], *naive, [readings[s] for s in inside])
        )
        size = float(np.linalg.norm(velocity - velocity.mean())) if len(velocity) else 0.0
        noise = recordings[trial].motion.error / units.position * np.sqrt(max(len(velocity), 1))
        # the errors of the smoothed readings and of an initial state from them are not errors of the device
        lefts = [max(float(each @ each) - NOISES * noise**2, 0.0) ** 0.5 for each in (of_device, *of_naive)]
        # a log cannot test a device if its readings hide the changes of the motion
        moves = size > max(STILL * noise, 1e-9) and min(lefts[1:]) > 0
        fit, without = (100 * (1 - left / size) if moves else np.nan for left in (lefts[0], min(lefts[1:])))
        origin = float(recordings[trial].position[0]) if units.origin is None else units.origin
        runs = tuple(
            FreeRun(
                units.period * times[s],
                units.command * commands[s],
                origin + units.position * readings[s],
                origin + units.position * (readings[s] - errors[s]),
            )
            for s in inside.tolist()
        )
        result.append(Replay(recordings[trial].name, fit, without, half, runs))
    return result


def devices_without_folds(segments: Segments, fit: Fit) -> list[Device]:
    """Return the device without each fold of trials, by one Newton step from the fit to all trials."""
    portions, solved = portions_of(segments), fit.solved
    trials = np.repeat(segments.trial, portions) if portions else None
    steps = [_sliding_step(fit.device, step, solved.total - left) for left, _, step in solved.folds(trials)]
    return [replace(fit.device.stepped(step), effects=None) for step in steps]


def _sliding_step(device: Device, step: Floats, information: Floats) -> Floats:
    """Return a step without negative friction, which no free run can have.

    The other numbers have their most likely values for this friction.
    """
    result = step.copy()
    for place, name in enumerate(device.names):
        if name in FRICTIONS and (value := device.numbers[name] + result[place]) < 0:
            others = np.arange(len(result)) != place
            result[place] -= value
            result[others] += inverse(information[np.ix_(others, others)]) @ information[others, place] * value
    return result


def replays_left_out(
    recordings: Sequence[Recording], units: LogUnits, lead: int, segments: Segments, fit: Fit
) -> list[Replay]:
    """Return the free runs of logs by the device that was fitted without them, for two or more logs.

    ``segments`` are those of the fit.
    """
    places = np.unique(np.linspace(0, len(recordings) - 1, min(MOST_REPLAYED, len(recordings))).round().astype(int))
    found: list[Replay] = []
    for fold, device in enumerate(devices_without_folds(segments, fit)):
        if logs := [recordings[i] for i in places if i % FOLDS == fold]:
            found += replays(logs, units, lead, device)
    return found


def _errors(windows: Segments, device: Device) -> Floats:
    """Return the position errors of free runs from their best initial states."""
    if any(device.numbers.get(name) for name in (*FRICTIONS, *GRAVITY)):
        motion, _, _ = free_motion(windows, device, windows.white, windows.largest)
        return np.asarray(windows.position[windows.places] - motion)
    columns = columns_of(windows, replace(device, noise=WHITE), ())
    return np.asarray(columns.values[np.arange(len(windows.places)) + columns.starts * windows.segment, -1])


def _naive_errors(times: list[Floats], readings: list[Floats]) -> tuple[list[Floats], list[Floats]]:
    """Return the position errors of two naive motions in the windows of a log.

    The first motion has a constant speed in each window. The second motion also has the mean acceleration of the log,
    the same in all windows.
    """
    moved, bent = [], []
    for time, position in zip(times, readings, strict=True):
        since = (time - time.mean()) / max(float(np.ptp(time)), 1e-300)
        lines = np.stack([np.ones(len(since)), since], axis=1)
        curve = 0.5 * (time - time.mean()) ** 2
        moved.append(position - lines @ np.linalg.lstsq(lines, position, rcond=None)[0])
        bent.append(curve - lines @ np.linalg.lstsq(lines, curve, rcond=None)[0])
    curves, errors = np.concatenate(bent), np.concatenate(moved)
    acceleration = float(curves @ errors) / max(float(curves @ curves), 1e-300)
    return moved, [error - acceleration * curve for error, curve in zip(moved, bent, strict=True)]


def smoothed_velocity(windows: list[Floats], half: int) -> Floats:
    """Return the smoothed velocity [1/row] of all windows, from parabolas over ``half`` rows on each side."""
    about = np.arange(half, -half - 1, -1.0)
    return np.concatenate(
        [np.convolve(each, about / (about @ about), mode="valid") for each in windows if len(each) > 2 * half]
        or [np.empty(0)]
    )
