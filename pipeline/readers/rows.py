"""Rows of one trial of a foreign file: numbers, missing cells, order of time, doubled stamps, as the profile says.

Rows are left out only where the profile says so, and each kind is counted.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import LogError
from pipeline.profiles.profile_columns import Source, TimeSource
from pipeline.profiles.profile_model import Profile
from pipeline.readers.frame import Frame
from pipeline.readers.refusals import refusal
from pipeline.readers.time_axis import distinct, in_order, read_stamps
from pipeline.records.batch import Booleans, Floats, Integers

SENTINEL_TOLERANCE = 1e-6
"""Relative distance at which a number is the sentinel: single precision rounds by 6e-8, the next sensor reading lies
farther away (a count of 16 bits by 1.5e-5)."""


_CLOCK = re.compile(r"\d:\d\d|\d-\d\d?-\d")
"""What dates and times of day have, and numbers do not."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a trial that are kept, in order of time.

    Parameters
    ----------
    time : float64, shape (rows,)
        Seconds.
    raw_time : float64 or int64, shape (rows,), or None
        Stamps as in the file.
    columns : dict of float64 or int64 arrays, shape (rows,)
        The other columns, as numbers of the file.
    number : int64, shape (rows,)
        Row of the trial as read, counted from 0.
    row : int64, shape (rows,)
        Row of the file, counted from 1.
    counts : dict of str to int
        What was found and settled; nothing where it is zero.
    raw_decimals : int
        Digits behind the decimal sign that whole numbers in ``raw_time`` had.
    """

    time: Floats
    raw_time: Floats | Integers | None
    columns: dict[str, NDArray[Any]]
    number: Integers
    row: Integers
    counts: dict[str, int]
    raw_decimals: int = 0


@dataclass(frozen=True, eq=False)
class _Column:
    """A column of the trial: file, source in the profile, numbers, and where there is none."""

    where: str
    frame: Frame
    source: Source
    values: NDArray[Any]
    missing: Booleans


def rows_of(
    profile: Profile, where: str, names: Sequence[str], frames: Sequence[Frame], index: Integers, period: float
) -> Rows:
    """Return the rows of a trial with time in seconds, in its order, without missing values.

    Parameters
    ----------
    profile : Profile
    where : str
        File and trial, for messages.
    names, frames : sequence of str and Frame
        Files of the log and what was read of them.
    index : int64, shape (rows,)
        Rows of the trial in the frames.
    period : float
        Sampling period [s].

    Raises
    ------
    LogError
        If a cell is no number or has no value, or time is not as the profile says.
    """
    source = profile.column_sources()["time"]
    assert isinstance(source, TimeSource), "the record says so"
    columns = _columns(profile, where, names, frames, index)
    stamps_column = columns.pop("time", None)
    row, counts = frames[0].row[index], dict[str, int]()
    keep = np.ones(len(index), dtype=np.bool_)
    everything = columns if stamps_column is None else {"time": stamps_column, **columns}
    for key, column in everything.items():
        if column.source.blanks == "skip" and column.missing.any():
            counts[f"skipped_{key}"] = int(column.missing.sum())
            keep &= ~column.missing
    for key, column in everything.items():
        if column.source.blanks == "refuse" and (column.missing & keep).any():
            raise _no_value(key, column, row, int(np.argmax(column.missing & keep)))

    # a row without a stamp is nowhere in time; other rows that are left out still tell what holds on
    stamped = np.arange(len(index)) if stamps_column is None else np.flatnonzero(~stamps_column.missing)
    place = f"{where}, column {source.key!r} (columns.time)"
    fraction = None
    if source.fraction is not None:
        fraction = frames[0 if source.file == "source" else 1].columns[source.fraction.name][index][stamped]
    values, decimals = None if stamps_column is None else stamps_column.values[stamped], 0
    if stamps_column is not None and source.key in stamps_column.frame.dates:
        dates, decimals = stamps_column.frame.dates[source.key]
        values = dates[index][stamped]
    stamps = read_stamps(source, values, fraction, period, place, row[stamped], decimals)
    order, late = in_order(source, stamps.time, place, row[stamped])
    counts |= {"wraps": stamps.wraps, "out_of_order": late}

    number, keep = stamped[order], keep[stamped[order]]
    numbers = {}
    for key, column in columns.items():
        numbers[key] = column.values[number]
        if column.source.blanks == "hold" and column.missing.any():
            numbers[key], known = _held(numbers[key], column.missing[number])
            counts[f"held_{key}"] = int((column.missing[number] & known).sum())
            counts[f"before_first_{key}"] = int((~known & keep).sum())
            keep &= known
    kept = np.flatnonzero(keep)
    alone = distinct(source, stamps.time[order[kept]], place, row[number[kept]])
    counts["duplicates"] = int((~alone).sum())
    kept = kept[alone]
    return Rows(
        stamps.time[order[kept]],
        None if stamps.raw is None else stamps.raw[order[kept]],
        {key: values[kept] for key, values in numbers.items()},
        number[kept],
        row[number[kept]],
        {key: count for key, count in counts.items() if count},
        decimals,
    )


def _columns(
    profile: Profile, where: str, names: Sequence[str], frames: Sequence[Frame], index: Integers
) -> dict[str, _Column]:
    """Return the columns of the trial by SI name, without the time where there are no stamps."""
    columns = {}
    for key, source in profile.column_sources().items():
        if not source.in_file:  # rows are counted, or the value is stated
            continue
        file = 0 if source.file == "source" else 1
        place, frame = where if file == 0 else names[1], frames[file]
        values = frame.columns[source.key][index]
        if values.dtype.kind not in "iufb":
            raise _no_number(profile, place, frame, values, index, key, source)
        # 64 bits without sign may hold more than 64 bits with one
        large = values > np.iinfo(np.int64).max if values.dtype.kind == "u" else np.zeros(len(values), dtype=np.bool_)
        whole = values.dtype.kind in "iub" and not large.any()
        if key == "time" and large.any():
            row = int(frame.row[index[int(np.argmax(large))]])
            found = f"the stamp {values[large][0]} (column {source.key!r}{_called(frame, row)}) has more than 63 bits"
            raise refusal("time-wrong", place, found, cure="Export stamps from the start of the log.", row=row)
        values = values.astype(np.int64) if whole else values.astype(np.float64)
        missing = np.zeros(len(values), dtype=np.bool_) if whole else np.isnan(values)
        for sentinel in source.sentinels:
            missing |= np.abs(values - sentinel) <= SENTINEL_TOLERANCE * abs(sentinel)
        columns[key] = _Column(place, frame, source, values, missing)
    return columns


def _held(values: NDArray[Any], missing: Booleans) -> tuple[NDArray[Any], Booleans]:
    """Return values with the one before it in place of each missing one, and where there is one."""
    last = np.maximum.accumulate(np.where(missing, -1, np.arange(len(values))))
    return values[np.maximum(last, 0)], last >= 0


def _no_number(
    profile: Profile, where: str, frame: Frame, values: NDArray[Any], index: Integers, key: str, source: Source
) -> LogError:
    """Return the refusal that names the first cell of a text column that is no number."""
    cells = [str(value).strip() for value in values.tolist()]
    at = next((i for i, cell in enumerate(cells) if not _reads_as_number(cell, profile)), 0)
    cell, row, sign = cells[at], int(frame.row[index[at]]), profile.decimal_sign
    found = f"{key} must be a number (column {source.key!r}, decimal sign {sign!r}), found {cell[:200]!r}"
    line, other = "", "," if sign == "." else "."
    if key == "time" and _CLOCK.search(cell):
        found, line = f"{found}: dates and times of day are not read", '[columns.time]\nkind = "sampled"'
    elif profile.format == "delimited" and other in cell:
        line = f'decimal = "{other}"'
    # a cell with digits is a number written in another way, such as "1 234" or "5 N", which must not get lost
    elif profile.format == "delimited" and not any(sign.isdigit() for sign in cell):
        line = f"missing = [{json.dumps(cell[:40], ensure_ascii=False)}]"
    return refusal("not-a-number", where, found + _called(frame, row), row=row, line=line)


def _reads_as_number(cell: str, profile: Profile) -> bool:
    try:
        float(cell.replace(profile.decimal_sign, ".").replace("_", "?") or "nan")
    except ValueError:
        return False
    return not ("." in cell and profile.decimal_sign == ",")


def _no_value(key: str, column: _Column, row: Integers, at: int) -> LogError:
    """Return the refusal that names the first cell that is blank or a sentinel."""
    found = column.values[at]
    what = "is blank, or no number" if np.isnan(found) else f"is {found}, a sentinel"
    found = f"{key} has no value: column {column.source.key!r} {what}{_called(column.frame, int(row[at]))}"
    hold = "" if key == "time" else ', or "hold" for the value before it'
    line = f'[columns.{key}]\nblanks = "skip" # leaves such rows out{hold}'
    return refusal("no-value", column.where, found, row=int(row[at]), line=line)


def _called(frame: Frame, row: int) -> str:
    """Return the place of a row in words, where it is not a line."""
    return "" if frame.row_name == "line" else f" ({frame.row_name} {row})"
