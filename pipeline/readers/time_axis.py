"""Time stamps of foreign logs as seconds, and how regular they are. Nothing is interpolated.

Wraps of a declared counter are undone; time that runs backwards or stands still is refused unless the profile says what
to do with it. What was found is counted and stored beside the trial, gaps and jitter as `step_flags` finds them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.units import factor_to_si
from pipeline.profiles.profile_columns import TimeSource
from pipeline.readers.dates import are_dates
from pipeline.readers.refusals import refusal
from pipeline.records.batch import Booleans, Floats, Integers

GAP = 1.5
"""Step between samples, in sampling periods, from which on samples are missing: the nearest multiple is 2 or more."""

ROUNDING = 1e-3
"""Part of a sampling period by which two stamps that are one period apart may differ from it: two dates in floats, the
coarsest stamps, by 2.4e-7 s."""

_BACKWARDS = (
    'Add to [columns.time] kind = "counter" and wrap = <counts> if a counter starts again, order = "sort" if rows are '
    "out of order; or give trial_column or [[steps]] if several trials follow each other."
)
_STANDS = (
    'Add to [columns.time] kind = "sampled" (one row each sampling period) if stamps are printed coarsely, '
    'duplicates = "keep first" or "keep last" if rows are doubled.'
)
_TWO_PARTS = "whole numbers where a stamp has two parts (columns.time.fraction)"

FractionValues = NDArray[Any] | None


@dataclass(frozen=True, eq=False)
class Stamps:
    """Time of each row in the order of the file.

    Parameters
    ----------
    time : float64, shape (rows,)
        Seconds.
    raw : float64 or int64, shape (rows,), or None
        As in the file; with a fraction, both parts in the unit of the fraction; dates with decimals without their
        decimal sign; None where there are no stamps.
    wraps : int
        Times that the counter started again.
    """

    time: Floats
    raw: Floats | Integers | None
    wraps: int = 0


def read_stamps(
    source: TimeSource,
    values: NDArray[Any] | None,
    fraction: FractionValues,
    period: float | None,
    place: str,
    row: Integers,
    decimals: int = 0,
) -> Stamps:
    """Turn the time column into seconds.

    Stamps that count from a date (`dates.DATE_S`) count from the earliest row instead: as floats they would be wrong by
    up to 0.12 us. Whole numbers lose nothing by it; the stamps themselves are kept as ``raw``.

    Parameters
    ----------
    source : TimeSource
    values : float64 or integers, shape (rows,), or None
        Stamps, none of them missing; None where the profile names no column (``kind = "sampled"``).
    fraction : integers, shape (rows,), or None
    period : float or None
        Sampling period [s]; needed for ``kind = "sampled"``.
    place : str
        File and column, for messages.
    row : int64, shape (rows,)
        Where the rows stand in the file.
    decimals : int
        Digits behind the decimal sign that was taken out of ``values`` (`dates.whole_dates`).

    Raises
    ------
    LogError
        If a counter exceeds its wrap, stamps disagree with sampled time, or parts are no whole numbers.
    """
    if values is None:
        assert period is not None, "a profile without sampling period is refused"
        return Stamps(np.arange(len(row), dtype=np.float64) * period, None)
    assert source.unit is not None, "validated: a column of stamps has a unit"
    unit = factor_to_si(source.unit, ("time",))
    if source.fraction is not None:
        values, unit = _joined(source, values, fraction, place, row), factor_to_si(source.fraction.unit, ("time",))
    unit /= 10**decimals
    raw = values.astype(np.int64) if values.dtype.kind in "iu" else values.astype(np.float64)
    ticks: NDArray[Any] = raw
    wraps = 0
    if source.kind == "steps":
        # the first row has no row before it
        ticks = np.cumsum(raw) - raw[:1]
    if source.wrap is not None:
        ticks, wraps = _unwrapped(raw, source.wrap, place, row)
    counts = source.counts_per_unit or 1.0
    if source.kind == "counter" and len(ticks):
        ticks = ticks - ticks[0]
    elif source.kind in ("absolute", "sampled") and are_dates(ticks, unit / counts):
        ticks = ticks - ticks.min()
    time: Floats = ticks * unit / counts
    if source.kind == "sampled":
        assert period is not None, "a profile without sampling period is refused"
        return Stamps(_sampled(time, period, place, row), raw)
    return Stamps(time, raw, wraps)


def _joined(source: TimeSource, values: NDArray[Any], fraction: FractionValues, place: str, row: Integers) -> Integers:
    """Return stamps of two parts (seconds and nanoseconds) as whole numbers of the smaller unit, without rounding."""
    assert source.fraction is not None, "the caller has looked"
    assert source.unit is not None, "validated"
    assert fraction is not None, "the profile asks for the column"
    ratio = factor_to_si(source.unit, ("time",)) / factor_to_si(source.fraction.unit, ("time",))
    for part in (values, fraction):
        if part.dtype.kind not in "iu" and not (part == np.rint(part)).all():
            at = int(np.argmax(part != np.rint(part)))
            raise refusal("time-wrong", place, f"{part[at]} is no whole number", _TWO_PARTS, row=int(row[at]))
    return values.astype(np.int64) * round(ratio) + fraction.astype(np.int64)


def _unwrapped(raw: NDArray[Any], wrap: float, place: str, row: Integers) -> tuple[NDArray[Any], int]:
    outside = (raw < 0) | (raw >= wrap)
    if outside.any():
        at = int(np.argmax(outside))
        expected = f"0 to {wrap:.17g}, where it starts again"
        raise refusal("time-wrong", place, f"the counter is {raw[at]}", expected, row=int(row[at]))
    # half a turn back is a turn forward: a shorter way back is a row out of order
    again = np.diff(raw) < -wrap / 2
    turns = np.concatenate(([0], np.cumsum(again)))[: len(raw)]
    modulus = int(wrap) if raw.dtype.kind == "i" and wrap == int(wrap) else wrap
    return raw + turns * modulus, int(again.sum())


def _sampled(stamps: Floats, period: float, place: str, row: Integers) -> Floats:
    """Return one row each sampling period if the stamps agree with it."""
    time: Floats = np.arange(len(stamps), dtype=np.float64) * period
    steps = np.abs(np.diff(stamps))
    # a sample is late by less than one period; a stamp that is printed so coarsely that several samples share it lies
    # up to its own last digit beside the true one. Where none is shared, each step is seen, and so is a lost sample
    coarse = (steps == 0).any() and (steps > 0).any()
    allowed = (steps[steps > 0].min() if coarse else 0.0) + period
    apart = np.abs(stamps - stamps[:1] - time) > allowed - ROUNDING * period
    if apart.any():
        at = int(np.argmax(apart))
        found = f"the stamp is {stamps[at] - stamps[0]:.9g} s after the first, by its row it were {time[at]:.9g} s"
        cure = 'Correct sampling_period_s, or use kind = "absolute": samples may be missing.'
        raise refusal("time-wrong", place, found, cure=cure, row=int(row[at]))
    return time


def in_order(source: TimeSource, time: Floats, place: str, row: Integers) -> tuple[Integers, int]:
    """Return the order of the rows by time, and how many stood behind a later one.

    Raises
    ------
    LogError
        If time runs backwards and the profile does not allow to sort.
    """
    late = time < np.maximum.accumulate(time) if len(time) else np.zeros(0, dtype=np.bool_)
    if not late.any():
        return np.arange(len(time)), 0
    if source.order == "sort":
        return np.argsort(time, kind="stable"), int(late.sum())
    at = int(np.argmax(late))
    found = f"time runs backwards, {time[at]:.17g} s after {time[at - 1]:.17g} s"
    line = '[columns.time]\norder = "sort"'
    raise refusal("time-backwards", place, found, "", _BACKWARDS, int(row[at]), line)


def distinct(source: TimeSource, time: Floats, place: str, row: Integers) -> Booleans:
    """Return which rows to keep of those with one and the same stamp.

    Raises
    ------
    LogError
        If a stamp stands in two rows and the profile does not say which to keep.
    """
    same = np.diff(time) == 0
    if source.duplicates == "refuse" and same.any():
        at = int(np.argmax(same)) + 1
        found, line = f"time is {time[at]:.17g} s in two rows", '[columns.time]\nkind = "sampled"'
        raise refusal("time-backwards", place, found, "", _STANDS, int(row[at]), line)
    edge = np.ones(min(len(time), 1), dtype=np.bool_)
    return np.concatenate((edge, ~same) if source.duplicates != "keep last" else (~same, edge))


def step_flags(time: Floats, rows: Integers, period: Floats) -> list[dict[str, float | int | None]]:
    """Return how regular the samples of trials are.

    Parameters
    ----------
    time : float64, shape (m,)
        Strictly increasing time stamps [s] of trial after trial.
    rows : int64, shape (n,)
        Number of samples of each trial, at least 2.
    period : float64, shape (n,)
        Sampling period T [s] that each trial states.

    Returns
    -------
    list of dict, length n
        ``gaps``: steps longer than `GAP` periods; ``dropped``: samples missing in them, by the nearest multiple of T;
        ``dropped_fraction``: of all that should be there; ``longest_step_s``; ``mean_step_s``, ``jitter_rms_s`` and
        ``jitter_max_s``: mean of the other steps, and their deviation from T; None where all are gaps.
    """
    inside = np.ones(max(len(time) - 1, 0), dtype=np.bool_)
    inside[np.cumsum(rows)[:-1] - 1] = False
    steps = np.diff(time)[inside]
    nominal = np.repeat(period, rows - 1)
    gap = steps > GAP * nominal

    first = np.cumsum(rows - 1) - (rows - 1)

    def total(values: Floats | Booleans) -> Floats:
        return np.add.reduceat(values, first, dtype=np.float64)

    deviation = np.where(gap, 0.0, steps - nominal)
    gaps = total(gap)
    dropped = total(np.where(gap, np.rint(steps / nominal) - 1, 0.0))
    regular = np.maximum(rows - 1 - gaps, 1)
    columns = {
        "dropped_fraction": dropped / (rows + dropped),
        "longest_step_s": np.maximum.reduceat(steps, first),
        "mean_step_s": total(np.where(gap, 0.0, steps)) / regular,
        "jitter_rms_s": np.sqrt(total(deviation**2) / regular),
        "jitter_max_s": np.maximum.reduceat(np.abs(deviation), first),
    }
    flags = []
    for index, values in enumerate(zip(*(column.tolist() for column in columns.values()), strict=True)):
        entry: dict[str, float | int | None] = {"gaps": int(gaps[index]), "dropped": int(dropped[index])}
        entry |= dict(zip(columns, values, strict=True))
        if gaps[index] == rows[index] - 1:
            entry |= dict.fromkeys(("mean_step_s", "jitter_rms_s", "jitter_max_s"))
        flags.append(entry)
    return flags
