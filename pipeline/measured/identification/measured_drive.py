"""Identify a drive from its command and a measured force or torque: gain, delay, lag and largest command.

The model is f(t) = g z(t) + f_0. Here z is the command, clipped to its limit, behind a delay of d samples and a lag of
first order. Between two rows, the command is constant.

Source: Ljung 1999, "System Identification", sec. 4.2 (output error model).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from pipeline.measured.identification.intervals import Interval
from pipeline.measured.identification.likelihood import WORTH
from pipeline.measured.identification.recordings import Recording, reading_noise, rounding
from pipeline.measured.student import student_95
from pipeline.records.trials import Floats

LONGEST_DELAY = 48
"""Longest delay [samples] in the search."""

LAGS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Lags [samples] from which the search starts."""

UNSEEN_LAGS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
"""Actuator lags [samples] to test when the fit finds no lag. The estimated delay may absorb a short lag."""

LARGEST_LAG = 300.0
"""Longest lag [samples]."""

LIMITS = 40
"""Number of limits of the command from which the search starts, from 5 % to 99 % of the largest command."""

BLOCKS = 16
"""Number of blocks of rows for a jackknife."""

SETTLED = 3.0
"""Number of lags after which the force no longer depends on the commands before a log."""

PROFILE_DROP = 1.92
"""Drop of the log-likelihood at the ends of a 95 % profile interval."""

FOLLOWS = 50.0
"""Smallest fit of the measured force [%] at which a drive counts as identified."""

EVEN = 0.1
"""Largest difference between the time steps of evenly spaced rows, relative to the sampling period."""

NUDGE = 1e-4
"""Relative perturbation for numerical derivatives."""


@dataclass(frozen=True, eq=False)
class MeasuredDrive:
    """Drive between command and measured force.

    Parameters
    ----------
    gain : Interval
        Force per unit of command.
    delay_samples : Interval
        Delay of the force behind the command. Without a lag, it is known only to within a sample.
    lag_samples : Interval
        Time constant. The value is 0 if a lag is not required. The interval then contains lags that may be hidden in
        the delay.
    limit : Interval or None
        Largest command that the drive follows, or None if no limit is visible.
    fit_percent : float
        Fit of the model to the measured force [%].
    noise_share : float
        Variance of the noise of a force reading, relative to the variance of the force.
    reason : str
        Sentence that states why the drive is not identified. Empty if it is identified.
    """

    gain: Interval
    delay_samples: Interval
    lag_samples: Interval
    limit: Interval | None
    fit_percent: float
    noise_share: float
    reason: str = ""


@dataclass(frozen=True)
class _Shape:
    """Delay and lag [samples] and limit of a drive, in units of the command. The limit is infinite if absent."""

    delay: float
    lag: float = 0.0
    limit: float = np.inf

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the numbers that change the force continuously."""
        return (*(("delay", "lag") if self.lag else ()), *(("limit",) if np.isfinite(self.limit) else ()))

    def moved(self, values: Sequence[float]) -> _Shape:
        """Return the shape with other values of `free`."""
        return replace(self, **dict(zip(self.free, map(float, values), strict=True)))

    @property
    def values(self) -> Floats:
        """Values of `free`."""
        return np.array([getattr(self, name) for name in self.free])


def unknown_drive(reason: str) -> MeasuredDrive:
    """Return an unidentified drive, with the reason."""
    none = Interval(np.nan, np.nan, np.nan, np.nan)
    return MeasuredDrive(none, none, none, None, np.nan, 0.0, reason)


def identified_drive(recordings: Sequence[Recording]) -> MeasuredDrive:
    """Identify a drive from recordings with a measured force."""
    logs = [(each.command, each.force) for each in recordings if each.force is not None]
    forces = np.concatenate([force for _, force in logs])
    share = _noise_share([force for _, force in logs])
    unknown = replace(unknown_drive(""), noise_share=share)
    for each in recordings:
        steps = np.diff(each.time)
        if len(steps) and float(np.ptp(steps)) > EVEN * each.period:
            return replace(unknown, reason="The rows are not evenly spaced, so the drive is not identified.")
    if not np.ptp(forces) > 0 or not any(np.ptp(command) > 0 for command, _ in logs):
        return replace(
            unknown, reason="The measured force or the command does not change, so the drive is not identifiable."
        )
    shape = _searched(logs)
    rows = _rows(logs, shape)
    fit = _Fit.of(logs, shape, rows)
    fit_percent = 100 * (1 - float(np.linalg.norm(fit.errors)) / float(np.linalg.norm(fit.force - fit.force.mean())))
    if not fit_percent >= FOLLOWS or fit.gain <= 0:
        sign = " Its sign is opposite to that of the command." if fit.gain < 0 else ""
        reason = (
            f"The measured force does not follow the command: gain, delay, lag and limit explain {fit_percent:.0f} % "
            f"of it.{sign} Check sign, unit and time of both columns."
        )
        return replace(unknown, fit_percent=fit_percent, reason=reason)
    return replace(_described(logs, fit, rows), fit_percent=fit_percent, noise_share=share)


def _noise_share(forces: Sequence[Floats]) -> float:
    """Return the variance of the noise of force readings, relative to the variance of the force."""
    whole = np.concatenate(forces)
    variance = float(whole.var())
    noise = [reading_noise(force, rounding(force)) ** 2 for force in forces if len(force) > 3]
    return float(np.median(noise)) / variance if noise and variance > 0 else 0.0


Logs = Sequence[tuple[Floats, Floats]]
"""Commands and measured forces of logs."""


def _applied(command: Floats, shape: _Shape) -> Floats:
    """Return the command of a log behind limit, delay and lag. Before the log, the first command is assumed."""
    clipped = np.clip(command, -shape.limit, shape.limit)
    whole = int(np.floor(shape.delay))
    part = shape.delay - whole
    late = np.concatenate([np.full(whole + 2, clipped[0]), clipped])
    if not shape.lag:
        return late[1 : len(command) + 1]
    decay, after = np.exp(-1 / shape.lag), np.exp(-(1 - part) / shape.lag)
    # the older command acts for the first part of an interval, the newer command for its rest
    state = lfilter([1 - after, after - decay], [1, -decay], late - clipped[0]) + clipped[0]
    return np.asarray(state[1 : len(command) + 1])


def _rows(logs: Logs, shape: _Shape) -> list[int]:
    """Return the first row of each log whose force does not depend on commands before the log."""
    settled = int(np.ceil(shape.delay + SETTLED * shape.lag)) + 1
    firsts = []
    for command, _ in logs:
        constant = np.flatnonzero(command != command[0])
        at_rest = int(constant[0]) if len(constant) else len(command)
        firsts.append(0 if at_rest > settled else min(settled, len(command) // 2))
    return firsts


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of a shape, with gain and offset by linear least squares.

    Parameters
    ----------
    shape : _Shape
    gain, offset : float
    force, errors : float64, shape (rows,)
        Measured force, and measured less modelled force.
    """

    shape: _Shape
    gain: float
    offset: float
    force: Floats
    errors: Floats

    @classmethod
    def of(cls, logs: Logs, shape: _Shape, rows: Sequence[int]) -> _Fit:
        """Return the fit of a shape to the rows of logs from a first row onward."""
        applied, force = _columns(logs, shape, rows)
        columns = np.stack([applied, np.ones(len(applied))], axis=1)
        gain, offset = np.linalg.lstsq(columns, force, rcond=None)[0]
        return cls(shape, float(gain), float(offset), force, force - columns @ np.array([gain, offset]))

    @property
    def squares(self) -> float:
        """Sum of the squared errors."""
        return float(self.errors @ self.errors)

    @property
    def independent_rows(self) -> float:
        """Number of independent errors with the same information, from the correlation of errors over one row."""
        errors = self.errors - self.errors.mean()
        total = float(errors @ errors)
        correlation = float(errors[1:] @ errors[:-1]) / total if total > 0 else 0.0
        correlation = min(max(correlation, 0.0), 0.999)
        return len(errors) * (1 - correlation) / (1 + correlation)

    def gain_over(self, other: _Fit) -> float:
        """Return the gain of log-likelihood over another fit to the same rows."""
        tiny = np.finfo(np.float64).eps ** 2 * float(self.force @ self.force)
        return 0.5 * self.independent_rows * float(np.log((other.squares + tiny) / (self.squares + tiny)))


def _columns(logs: Logs, shape: _Shape, rows: Sequence[int]) -> tuple[Floats, Floats]:
    """Return applied commands and measured forces of all logs from a first row onward."""
    applied = [_applied(command, shape)[first:] for (command, _), first in zip(logs, rows, strict=True)]
    return np.concatenate(applied), np.concatenate(
        [force[first:] for (_, force), first in zip(logs, rows, strict=True)]
    )


def _searched(logs: Logs) -> _Shape:
    """Return the most likely shape with a lag and a limit if the measured force requires them."""
    longest = min(LONGEST_DELAY, max(len(command) for command, _ in logs) // 4)
    largest = max(float(np.abs(command).max()) for command, _ in logs)
    rows = _rows(logs, _Shape(longest))
    score = partial(_squares, logs, rows)
    # half a sample: without a lag, all delays between two samples give the same force
    delays = [number + 0.5 for number in range(longest + 1)]
    plain = min((_Shape(delay) for delay in delays), key=score)
    lagged = min((_Shape(delay, lag) for delay in delays for lag in LAGS if delay <= plain.delay + 1), key=score)
    best = _accepted(logs, _Fit.of(logs, plain, rows), lagged, rows)
    limits = np.geomspace(0.05, 0.99, LIMITS) * largest
    clipped = min((replace(best.shape, limit=limit) for limit in limits.tolist()), key=score)
    limited = _accepted(logs, best, clipped, rows)
    if limited is best or best.shape.lag:
        return limited.shape
    # the missing limit may have hidden a lag
    again = (
        replace(limited.shape, delay=delay, lag=lag) for delay in delays for lag in LAGS if delay <= plain.delay + 1
    )
    return _accepted(logs, limited, min(again, key=score), rows).shape


def _squares(logs: Logs, rows: Sequence[int], shape: _Shape) -> float:
    return _Fit.of(logs, shape, rows).squares


def _accepted(logs: Logs, without: _Fit, start: _Shape, rows: Sequence[int]) -> _Fit:
    """Return the fit near a shape with a further part, or the fit without it if the part is not required."""
    found = _refined(logs, start, rows)
    return found if found.gain_over(without) > WORTH * len(found.shape.free) else without


def _refined(logs: Logs, start: _Shape, rows: Sequence[int]) -> _Fit:
    """Return the least-squares fit near a shape."""
    largest = max(float(np.abs(command).max()) for command, _ in logs)
    bounds = {"delay": (0.0, LONGEST_DELAY + 1.0), "lag": (1e-3, LARGEST_LAG), "limit": (1e-3 * largest, largest)}
    low, high = np.array([bounds[name] for name in start.free]).T
    size = float(np.linalg.norm(_Fit.of(logs, start, rows).force)) or 1.0

    def errors(values: Floats) -> Floats:
        return _Fit.of(logs, start.moved(values.tolist()), rows).errors / size

    found = least_squares(
        errors, np.clip(start.values, low, high), bounds=(low, high), x_scale=np.maximum(start.values, 0.1)
    )
    return _Fit.of(logs, start.moved(found.x.tolist()), rows)


def _described(logs: Logs, fit: _Fit, rows: Sequence[int]) -> MeasuredDrive:
    """Return the drive of a fit with its intervals."""
    shape = fit.shape
    errors = dict(zip(("gain", "offset", *shape.free), _standard_errors(logs, fit, rows), strict=True))
    reach = float(student_95(BLOCKS - 1.0))

    def interval(name: str, value: float) -> Interval:
        return Interval(value, max(value - reach * errors[name], 0.0), value + reach * errors[name], errors[name])

    gain = interval("gain", fit.gain)
    limit = interval("limit", shape.limit) if np.isfinite(shape.limit) else None
    if shape.lag:
        return MeasuredDrive(gain, interval("delay", shape.delay), interval("lag", shape.lag), limit, np.nan, np.nan)
    whole, hidden = np.floor(shape.delay), _hidden_lag(logs, fit, rows)
    error = 1 / np.sqrt(12.0)
    delay = Interval(shape.delay, max(float(whole) - hidden, 0.0), float(whole) + 1.0, error)
    return MeasuredDrive(gain, delay, Interval(0.0, 0.0, hidden, hidden / 2), limit, np.nan, np.nan)


def _standard_errors(logs: Logs, fit: _Fit, rows: Sequence[int]) -> Floats:
    """Return the standard errors of gain, offset and the free numbers of the shape.

    Each is the larger of two standard errors: from the information, and from a jackknife over blocks of rows, within
    which errors may be correlated.
    """
    applied, _ = _columns(logs, fit.shape, rows)
    columns = [applied, np.ones(len(applied))]
    for name, value in zip(fit.shape.free, fit.shape.values.tolist(), strict=True):
        step = NUDGE * max(abs(value), 0.1)
        moved, _ = _columns(logs, replace(fit.shape, **{name: value + step}), rows)
        columns.append(fit.gain * (moved - applied) / step)
    along = np.stack(columns, axis=1)
    size = np.linalg.norm(along, axis=0)
    along = along / np.where(size > 0, size, 1.0)
    information = along.T @ along
    inverse = np.linalg.pinv(information)
    variance = fit.squares / max(len(along) - along.shape[1], 1)
    of_information = np.diagonal(inverse) * variance
    steps = []
    for block in np.array_split(np.arange(len(along)), BLOCKS):
        part, errors = along[block], fit.errors[block]
        steps.append(-np.linalg.pinv(information - part.T @ part) @ (part.T @ errors))
    spread = np.array(steps)
    of_blocks = (BLOCKS - 1) / BLOCKS * ((spread - spread.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(of_information, of_blocks)) / np.where(size > 0, size, np.nan))


def _hidden_lag(logs: Logs, fit: _Fit, rows: Sequence[int]) -> float:
    """Return the longest lag [samples] that the measured force does not exclude, for a drive without a lag."""
    longest = 0.0
    for lag in UNSEEN_LAGS:
        trials = (
            replace(fit.shape, delay=max(fit.shape.delay + shift, 0.0), lag=lag) for shift in np.linspace(-2, 1, 13)
        )
        least = min((_Fit.of(logs, each, rows) for each in trials), key=lambda each: each.squares)
        if fit.gain_over(least) > PROFILE_DROP:
            return longest
        longest = lag
    return longest
