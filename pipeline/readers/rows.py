"""Read the rows of a trial in a foreign file as described by the profile: numbers, missing cells, time in seconds, and
order.

Nothing is interpolated. Rows are omitted only if the profile requests this, and omitted rows are counted by kind.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import LogError, refusal
from pipeline.base.units import factor_to_si
from pipeline.profiles.profile_model import Profile, Source, TimeSource
from pipeline.readers.file_columns import FileColumns
from pipeline.records.trials import Booleans, Floats, Integers

SENTINEL_TOLERANCE = 1e-6
"""Relative tolerance within which a number equals a sentinel.

Single precision rounds by 6e-8. The next sensor reading is farther away (1.5e-5 for a count of 16 bits).
"""

DATE_S = 2.0**28
"""Threshold [s] (8.5 years) above which a stamp is treated as a date.

No machine runs that long, and the usual origins of dates (1904, 1970, 1980, 2000) are longer ago. Below the threshold,
seconds in double precision are accurate to 30 ns.
"""

ROUNDING = 1e-3
"""Tolerance, in sampling periods, of the difference between two stamps that are one period apart.

Dates stored as floats, the coarsest stamps, have errors of 2.4e-7 s.
"""

_CLOCK = re.compile(r"\d:\d\d|\d-\d\d?-\d")
"""Pattern that occurs in dates and times of day but not in numbers."""

_BACKWARDS = (
    'Add to [columns.time] kind = "counter" and wrap = <counts> if a counter restarts, or order = "sort" if rows are '
    "out of order. If the file contains several trials in succession, set trial_column or [[steps]]."
)
_STANDS = (
    'Add to [columns.time] kind = "sampled" (one row per sampling period) if stamps are printed coarsely, or '
    'duplicates = "keep first" or "keep last" if rows are duplicated.'
)

Table = dict[str, NDArray[Any]]
"""Columns of shape (rows,) by name."""


def rows_of(
    profile: Profile, where: str, names: Sequence[str], frames: Sequence[FileColumns], index: Integers, period: float
) -> tuple[Table, dict[str, int]]:
    """Return the rows of a trial in order of time, without missing values, and the number of repairs by kind.

    Parameters
    ----------
    profile : Profile
    File and trial, for messages.
        File and trial, for messages.
    names, frames : sequence of str and FileColumns
        Files of the log, with their columns.
    index : int64, shape (rows,)
        Rows of the trial in the frames.
    period : float
        Sampling period [s].

    Returns
    -------
    tuple of dict and dict
        Table with ``time`` [s], ``raw_time`` (stamps as in the file, if there are any; if they have a fraction, both
        parts are in its unit), the other columns in the units of the file, ``number`` (row of the trial as read, from
        0), and ``row`` (row of the file, from 1). Nonzero counts by name.

    Raises
    ------
    LogError
        If a cell is not a number or has no value, or the time contradicts the profile.
    """
    sources, gaps = profile.column_sources(), dict[str, Booleans]()
    table: Table = {"number": np.arange(len(index)), "row": frames[0].row[index]}
    keep, counts = np.ones(len(index), dtype=np.bool_), dict[str, int]()
    homes = dict(zip(("source", "partner"), zip((where, *names[1:]), frames, strict=False), strict=False))
    for key, source in sources.items():
        if source.in_file:  # without a column, rows are counted or the profile states the value
            table[key], gaps[key] = _numbers(profile, *homes[source.file], index, key)
    for key, missing in gaps.items():
        if sources[key].blanks == "skip":
            counts[f"skipped_{key}"] = int(missing.sum())
            keep &= ~missing
    for key, missing in gaps.items():
        if sources[key].blanks == "refuse" and (missing & keep).any():
            raise _no_value(key, sources[key], *homes[sources[key].file], table, int(np.argmax(missing & keep)))

    time = sources["time"]
    assert isinstance(time, TimeSource), "columns.time is a TimeSource"
    place = f"{where}, column {time.key!r} (columns.time)"
    gaps[""] = ~keep
    if time.in_file:
        if time.fraction is not None:
            table["fraction"] = homes[time.file][1].columns[time.fraction.name][index]
        # Rows without a time stamp are removed first. Other rows are omitted later, because they still provide the last
        # valid value.
        table, gaps = _taken(table, ~gaps["time"]), _taken(gaps, ~gaps["time"])
    counts |= add_seconds(time, table, period, place)
    order, counts["out_of_order"] = in_order(time, table, place)
    table, gaps = _taken(table, order), _taken(gaps, order)
    keep = ~gaps.pop("")
    for key, missing in gaps.items():
        if sources[key].blanks == "hold" and missing.any():
            # Replace each missing value by the last valid value.
            last = np.maximum.accumulate(np.where(missing, -1, np.arange(len(missing))))
            table[key], known = table[key][np.maximum(last, 0)], last >= 0
            counts |= {f"held_{key}": int((missing & known).sum()), f"before_first_{key}": int((~known & keep).sum())}
            keep &= known
    table = _taken(table, keep)
    alone = distinct(time, table, place)
    counts["duplicates"] = int((~alone).sum())
    return _taken(table, alone), {key: count for key, count in counts.items() if count}


def _taken(table: Table, rows: Integers | Booleans) -> Table:
    return {key: values[rows] for key, values in table.items()}


def _numbers(
    profile: Profile, place: str, frame: FileColumns, index: Integers, key: str
) -> tuple[NDArray[Any], Booleans]:
    """Return a column as numbers, and a mask of its missing values."""
    source = profile.column_sources()[key]
    values = frame.columns[source.key][index]
    if values.dtype.kind not in "iufb":
        raise _no_number(profile, place, frame, values, index, key, source)
    # Unsigned 64-bit integers may exceed the range of signed integers.
    beyond = values.dtype.kind == "u" and (values > np.iinfo(np.int64).max).any()
    values = values - values.min() if beyond and key == "time" else values
    whole = values.dtype.kind in "iub" and not (beyond and key != "time")
    values = values.astype(np.int64 if whole else np.float64)
    missing = np.isnan(values)
    for sentinel in source.sentinels:
        missing |= np.abs(values - sentinel) <= SENTINEL_TOLERANCE * abs(sentinel)
    return values, missing


def _no_number(
    profile: Profile, where: str, frame: FileColumns, values: NDArray[Any], index: Integers, key: str, source: Source
) -> LogError:
    """Return the error for the first cell of a text column that is not a number."""
    cells = [str(value).strip() for value in values.tolist()]
    at = next((i for i, cell in enumerate(cells) if not _reads_as_number(cell, profile)), 0)
    cell, row, sign = cells[at], int(frame.row[index[at]]), profile.decimal_sign
    found = f"{key} must be a number (column {source.key!r}, decimal sign {sign!r}), but the cell is {cell[:200]!r}"
    line, other = "", "," if sign == "." else "."
    if key == "time" and _CLOCK.search(cell):
        found, line = f"{found}: dates and times of day are not read", '[columns.time]\nkind = "sampled"'
    elif profile.format == "delimited" and other in cell:
        line = f'decimal = "{other}"'
    # A cell with digits may be a number in a different notation, such as "1 234" or "5 N", and must not count as
    # missing.
    elif profile.format == "delimited" and not any(sign.isdigit() for sign in cell):
        line = f"missing = [{json.dumps(cell[:40], ensure_ascii=False)}]"
    return refusal("not-a-number", where, found + _called(frame, row), row=row, line=line)


def _reads_as_number(cell: str, profile: Profile) -> bool:
    try:
        float(cell.replace(profile.decimal_sign, ".").replace("_", "?") or "nan")
    except ValueError:
        return False
    return not ("." in cell and profile.decimal_sign == ",")


def _no_value(key: str, source: Source, place: str, frame: FileColumns, table: Table, at: int) -> LogError:
    """Return the error for the first cell that is blank or a sentinel."""
    found, row = table[key][at], int(table["row"][at])
    what = "is blank or not a number" if np.isnan(found) else f"is {found}, a sentinel"
    found = f"{key} has no value: column {source.key!r} {what}{_called(frame, row)}"
    repeat = "" if key == "time" else ', or "hold" to repeat the preceding value'
    line = f'[columns.{key}]\nblanks = "skip" # omits such rows{repeat}'
    return refusal("no-value", place, found, row=row, line=line)


def _called(frame: FileColumns, row: int) -> str:
    """Return a text with the word for a row and its position, such as "message 5", or "" if the rows are lines."""
    return "" if frame.row_name == "line" else f" ({frame.row_name} {row})"


def add_seconds(source: TimeSource, table: Table, period: float, place: str) -> dict[str, int]:
    """Convert stamps to seconds, keep the originals as ``raw_time``, and return the number of counter wraps.

    Stamps that are dates (`DATE_S`) are made relative to the earliest row. As floats, dates would have errors of up to
    0.12 us. Integers are converted without loss."""
    if not source.in_file:
        table["time"] = np.arange(len(table["row"])) * period
        return {}
    assert source.unit is not None, "a column of stamps has a unit, as validated"
    raw, unit, wraps = table["time"], factor_to_si(source.unit, ("time",)), 0
    if source.fraction is not None:
        part = factor_to_si(source.fraction.unit, ("time",))
        parts = [_whole(values, table, place) for values in (raw, table.pop("fraction"))]
        raw, unit = parts[0] * round(unit / part) + parts[1], part
    unit /= source.counts_per_unit or 1.0
    ticks = raw
    if source.kind == "steps":
        # The first row has no previous row.
        ticks = np.cumsum(raw) - raw[:1]
    elif source.wrap is not None:
        ticks, wraps = _unwrapped(raw, source.wrap, table, place)
    elif len(raw) and float(np.abs(raw.astype(np.float64)).min()) * unit > DATE_S:
        ticks = raw - raw.min()
    table |= {"raw_time": raw, "time": (ticks - ticks[:1] if source.kind == "counter" else ticks) * unit}
    if source.kind == "sampled":
        table["time"] = _sampled(table, period, place)
    return {"wraps": wraps}


def _whole(part: NDArray[Any], table: Table, place: str) -> Integers:
    if (broken := part != np.rint(part)).any():
        at = int(np.argmax(broken))
        expected = "integers, because a stamp has two parts (columns.time.fraction)"
        raise refusal("time-wrong", place, f"{part[at]} is not an integer", expected, row=int(table["row"][at]))
    return part.astype(np.int64)


def _unwrapped(raw: NDArray[Any], wrap: float, table: Table, place: str) -> tuple[NDArray[Any], int]:
    if (outside := (raw < 0) | (raw >= wrap)).any():
        at = int(np.argmax(outside))
        expected = f"0 to {wrap:.17g}, where the counter restarts from 0"
        raise refusal("time-wrong", place, f"the counter is {raw[at]}", expected, row=int(table["row"][at]))
    # A step back by more than half the range is a wrap. A smaller step back is a row out of order.
    again = np.diff(raw, prepend=raw[:1]) < -wrap / 2
    modulus = int(wrap) if raw.dtype.kind == "i" and wrap == int(wrap) else wrap
    return raw + np.cumsum(again) * modulus, int(again.sum())


def _sampled(table: Table, period: float, place: str) -> Floats:
    """Return times for one row per sampling period, if the stamps agree with them."""
    stamps: Floats = table["time"]
    time = np.arange(len(stamps)) * np.float64(period)
    steps = np.abs(np.diff(stamps))
    # A sample may be late by less than one period. In addition, a coarse stamp that several samples share has an error
    # of up to one unit of its last digit. If no stamp is shared, every lost sample is visible.
    coarse = (steps == 0).any() and (steps > 0).any()
    allowed = (steps[steps > 0].min() if coarse else 0.0) + period
    apart = np.abs(stamps - stamps[:1] - time) > allowed - ROUNDING * period
    if apart.any():
        at = int(np.argmax(apart))
        found = (
            f"the stamp is {stamps[at] - stamps[0]:.9g} s after the first stamp, but its row implies {time[at]:.9g} s"
        )
        cure = 'Correct sampling_period_s. If samples are missing, use kind = "absolute".'
        raise refusal("time-wrong", place, found, cure=cure, row=int(table["row"][at]))
    return time


def in_order(source: TimeSource, table: Table, place: str) -> tuple[Integers, int]:
    """Return the order of the rows by time, and the number of rows that come after a row with a later time."""
    time = table["time"]
    late = time < np.maximum.accumulate(time)
    if late.any() and source.order != "sort":
        at = int(np.argmax(late))
        found = f"time runs backwards, {time[at]:.17g} s after {time[at - 1]:.17g} s"
        line = '[columns.time]\norder = "sort"'
        raise refusal("time-backwards", place, found, "", _BACKWARDS, int(table["row"][at]), line)
    return np.argsort(time, kind="stable"), int(late.sum())


def distinct(source: TimeSource, table: Table, place: str) -> Booleans:
    """Return a mask of the rows to keep. Of rows with equal time stamps, one is kept."""
    time = table["time"]
    same = np.diff(time) == 0
    if source.duplicates == "refuse" and same.any():
        at = int(np.argmax(same)) + 1
        found, line = f"time is {time[at]:.17g} s in two rows", '[columns.time]\nkind = "sampled"'
        raise refusal("time-backwards", place, found, "", _STANDS, int(table["row"][at]), line)
    edge = np.ones(min(len(time), 1), dtype=np.bool_)
    return np.concatenate((edge, ~same) if source.duplicates != "keep last" else (~same, edge))
