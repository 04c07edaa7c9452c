"""Evaluate the time stamps of a log to find missing rows, scattering stamps, or a different sampling period.

Time stamps count rows, but they do not time them exactly, because an operating system writes them late while control
continues. A missing row shifts all later stamps, and a late stamp shifts only itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.student import NORMAL_QUARTILE
from pipeline.measured.wall_command.log_rows import SET_DIGITS
from pipeline.recording.timing import EVEN, other_period
from pipeline.records.trials import Floats, Integers, Trial

ODD = 0.5
"""Smallest deviation of a stamp distance from a period, in periods, for which missing rows are considered."""

UNEVEN = 0.1
"""Smallest deviation of a stamp distance from whole periods, in periods, at which the stamps count as scattered."""

WINDOW = 7
"""Number of rows in a window. Up to half of them may have a wrong stamp. Fewer rows do not show the usual distance."""

CATCH_UP = 40
"""Number of rows after which late stamps are on time again."""

FOLLOWED = 0.1
"""Share of the deviation of a stamp that persists in the following stamps, because two clocks drift apart."""


@dataclass(frozen=True, eq=False)
class Stamps:
    """Result of the evaluation of the time stamps of a log.

    Parameters
    ----------
    skipped : int64, shape (N - 1,)
        Number of missing rows before each row except the first.
    period : float
        Median distance of the stamps if it differs from the sampling period [s], otherwise the sampling period.
    scatter : float
        Standard deviation from even distances, in periods.
    odd : int
        Number of distances that deviate by more than half a period although no row is missing.
    scatters : bool
        Whether the stamps deviate independently. The next distance then compensates a distance that is too long. If
        control is uneven, deviations accumulate instead.
    """

    skipped: Integers
    period: float
    scatter: float = 0.0
    odd: int = 0
    scatters: bool = False


def read_stamps(time: Floats, period: float) -> Stamps:
    """Evaluate the time stamps of a log for a given sampling period, both in seconds.

    Notes
    -----
    The lateness of a row is the number of missing rows before it, in periods, plus the lateness of its stamp and the
    clock drift. The smallest lateness of the following stamps is due to missing rows. The remainder is transient.
    """
    steps = np.diff(time)
    none = np.zeros(len(steps), dtype=np.int64)
    if len(time) < WINDOW or (np.abs(steps / period - 1) <= EVEN).all():
        return Stamps(none, period)
    other = other_period(time, period)
    if other is not None:
        usual = float(f"{other:.{SET_DIGITS}g}")
        return Stamps(read_stamps(time, usual).skipped, usual)
    late = (time - time[0]) / period - np.arange(len(time))
    stays = late
    whole = np.rint(steps / period)
    if ((np.abs(steps / period - whole) > UNEVEN) | (whole < 1)).any():  # late stamps recover, but lost rows do not
        stays = _behind(np.append(late, np.full(WINDOW - 1, np.median(late[-WINDOW:]))), WINDOW, np.median)
        stays = _behind(np.append(stays, np.full(CATCH_UP - 1, np.inf)), CATCH_UP, np.min)
    skipped, level = none, float(np.median(late[:WINDOW]) if stays is not late else late[0])
    for row, (stay, stamp) in enumerate(zip(stays[1:].tolist(), late[1:].tolist(), strict=True)):
        lost = max(round(stay - level), 0)
        skipped[row] = lost
        level += lost
        level += FOLLOWED * min(max(stamp - level, -ODD), ODD)
    rest = late - np.append(0, np.cumsum(skipped))
    changes = np.diff(rest)
    odd, scatter = int((np.abs(changes) > ODD).sum()), _scatter(rest)
    return Stamps(skipped, period, scatter, odd, scatter < _scatter(changes))


def _scatter(values: Floats) -> float:
    """Return a robust standard deviation, from the median absolute deviation.

    If the stamps scatter, a gap can be located only to within a few rows, and these rows must not affect the result.
    """
    return float(np.median(np.abs(values - np.median(values))) / NORMAL_QUARTILE)


def even(trial: Trial) -> Trial:
    """Return a trial with evenly spaced stamps if the stamps of the log scatter. Missing rows remain missing."""
    period = trial.sampling_period_s
    if not (np.abs(np.diff(trial.time) / period - 1) > EVEN).any():
        return trial
    stamps = read_stamps(trial.time, period)
    if not stamps.scatters:
        return trial
    return replace(trial, time=trial.time[0] + period * np.append(0, np.cumsum(stamps.skipped + 1)))


def _behind(values: Floats, rows: int, of: Callable[..., Floats]) -> Floats:
    """Return a statistic over each value and its successors, with the given number of rows."""
    return of(np.lib.stride_tricks.sliding_window_view(values, rows), axis=1)
