"""What the time stamps of a log say of its rows: some are missing, the stamps scatter, or the period is another one.

Stamps count rows, they do not time them: an operating system writes them late, while control goes on. A row that is
missing moves all stamps behind it, a late stamp only itself.
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
"""Part of a period by which the distance of two stamps differs from it where rows are looked for between them."""

UNEVEN = 0.1
"""Part of a period by which distances of stamps are off whole numbers of it where they scatter."""

WINDOW = 7
"""Rows among which half may have stamps of a wrong row; fewer have no usual distance."""

CATCH_UP = 40
"""Rows after which stamps that were written late are in time again."""

FOLLOWED = 0.1
"""Part of what a stamp is off by that the next ones are expected to be off by, too: two clocks drift apart."""


@dataclass(frozen=True, eq=False)
class Stamps:
    """What the stamps of a log say.

    Parameters
    ----------
    skipped : int64, shape (N - 1,)
        Rows that are missing before each row but the first.
    period : float
        Their usual distance where it is not the sampling period [s], else the sampling period.
    scatter : float
        Standard deviation from even distances, in periods.
    odd : int
        Distances that are off by more than half a period though no row is missing.
    scatters : bool
        Whether each stamp is off by itself: where control is uneven, what one distance is too long is not made up for.
    """

    skipped: Integers
    period: float
    scatter: float = 0.0
    odd: int = 0
    scatters: bool = False


def read_stamps(time: Floats, period: float) -> Stamps:
    """Return what the stamps of a log of a sampling period say, both in seconds.

    Notes
    -----
    A row is late by as many periods as rows are missing before it, and by what its stamp is late and clocks differ.
    What is left of that among the stamps behind it, at the least, are rows that are missing; the rest comes and goes.
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
    if ((np.abs(steps / period - whole) > UNEVEN) | (whole < 1)).any():  # what is late comes back, lost rows do not
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
    """Return the standard deviation of most values: among stamps that scatter a gap is found a few rows off."""
    return float(np.median(np.abs(values - np.median(values))) / NORMAL_QUARTILE)


def even(trial: Trial) -> Trial:
    """Return a trial with the stamps of its samples where those of the log scatter; rows that are missing stay so."""
    period = trial.sampling_period_s
    if not (np.abs(np.diff(trial.time) / period - 1) > EVEN).any():
        return trial
    stamps = read_stamps(trial.time, period)
    if not stamps.scatters:
        return trial
    return replace(trial, time=trial.time[0] + period * np.append(0, np.cumsum(stamps.skipped + 1)))


def _behind(values: Floats, rows: int, of: Callable[..., Floats]) -> Floats:
    """Return a statistic of each value and those behind it, so many in all."""
    return of(np.lib.stride_tricks.sliding_window_view(values, rows), axis=1)
