"""What a format reader hands on: named arrays as they stand in a file, without units, signs or guesses.

A format is a function ``read(path, settings, contents)`` that adds what it finds to a `Contents`. `Contents.frame`
takes the columns that a profile wants, `Contents.listed` says what there is; `mapping` turns frames into logs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import islice, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import LogError
from pipeline.readers.limits import EXACT, LISTED_ELEMENTS, LISTED_NAMES, LONGEST_ATTRIBUTE, MOST_ARRAYS, MOST_VALUES
from pipeline.readers.refusals import refusal
from pipeline.records.batch import Integers

Scalar = str | float | int
Array = NDArray[Any]

_ELEMENT = re.compile(r"(.+?)((?:\[\d+\])+)", re.DOTALL)
_KINDS = {"f": "number", "U": "text"}


@dataclass(frozen=True, eq=False)
class Frame:
    """Columns of a file as they stand there.

    Parameters
    ----------
    columns : mapping of str to array, shape (rows,)
        float64, integers (a counter keeps its integers) or str (a text column, such as the label of a trial), by the
        name in the file: ``"1"``, ``"2"``, ... in a file without names; a path with dots where it is nested
        (``"state.q"``), elements of a vector in brackets, counted from 0 (``"state.q[3]"``). NaN (an empty text in a
        text column) is a missing cell, as in sparse files of several rates. Nothing is interpolated.
    row : int64, shape (rows,)
        Where each row stands in the file, counted from 1.
    row_name : str
        What a row is called there: "line", "record", "sample", "message".
    attributes : mapping of str to str, float or int
        Scalars and texts found in the file, such as HDF5 attributes or lines "label: value"; a profile may take
        conditions from them.
    warnings : tuple of str
        What was accepted and should be known, such as a last row that was cut.
    dates : mapping of str to (int64 array of shape (rows,), int)
        Stamps as `pipeline.readers.dates.whole_dates` has them, of a column that is float64 in ``columns``.
    units : mapping of str to str
        Units of times that their type in the file states beyond doubt, such as ns of a ROS stamp; a profile that says
        otherwise is refused. Units in names, headers and attributes are no such units: they are shown only.
    """

    columns: Mapping[str, Array]
    row: Integers
    row_name: str
    attributes: Mapping[str, Scalar] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    dates: Mapping[str, tuple[Integers, int]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True)
class ColumnInfo:
    """A column that a file offers.

    Parameters
    ----------
    name : str
        As in `Frame.columns`.
    dtype : str
        "number", "integer" or "text".
    rows : int
        Number of its values.
    first : tuple of str
        First values, as text.
    hint : str
        Unit or description found in the file; empty where there is none. A hint is shown, never used.
    """

    name: str
    dtype: str
    rows: int
    first: tuple[str, ...] = ()
    hint: str = ""


@dataclass
class Contents:
    """What a file holds.

    Parameters
    ----------
    name : str
        The file, for messages.
    wanted : tuple of str
        Names that a profile asks for; a reader may leave out others. Empty means all.
    most : int
        Values that the file may hold.
    row_name : str
        What a row is called.
    columns : dict of str to array
        float64, integers of 64 bits or str, of any shape: of a matrix one axis is time. Single values are attributes.
    hints, units, attributes, warnings, dates
        As in `Frame`; hints are units and descriptions that are shown only.
    refused : dict of str to str
        What is in the file but cannot be read, and why.
    row : int64, shape (rows,), or None
        As in `Frame`; None where rows are counted from 1.
    keys : dict of str to str
        Keys of a profile that this file needs, as TOML.
    """

    name: str
    wanted: tuple[str, ...] = ()
    most: int = MOST_VALUES
    row_name: str = "sample"
    columns: dict[str, Array] = field(default_factory=dict)
    hints: dict[str, str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, Scalar] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    dates: dict[str, tuple[Integers, int]] = field(default_factory=dict)
    row: Integers | None = None
    keys: dict[str, str] = field(default_factory=dict)
    arrays: int = 0
    values: int = 0

    def asks(self, path: str) -> bool:
        """Return whether a column, or an element of it, is wanted; the first slash of a path may be left out."""
        bare, keys = path.removeprefix("/"), (key.removeprefix("/") for key in self.wanted)
        return not self.wanted or any(key == bare or key.startswith((f"{bare}[", f"{bare}.")) for key in keys)

    def add(self, path: str, values: Array | Callable[[], Any], hint: str = "", unit: str = "") -> None:
        """Keep an array, or the reason why it cannot be read: one that cannot must not hide the others.

        Parameters
        ----------
        path : str
        values : array, or callable that loads one
        hint, unit : str
            What the file says of it, and the unit of times that its type states.

        Raises
        ------
        LogError
            If the file holds more arrays or values than a log has.
        """
        self.arrays += 1
        if self.arrays > MOST_ARRAYS:
            raise refusal("too-many-columns", self.name, f"has more than {MOST_ARRAYS} arrays", "recorded signals")
        try:
            column = plain_column(np.asarray(values() if callable(values) else values))
        except (LogError, MemoryError, OSError, TypeError, ValueError) as error:
            if self.wanted and self.asks(path) and not isinstance(error, TypeError | ValueError):
                raise
            large = "claims more values than this file may unpack to"
            self.refused[path] = f"{large if isinstance(error, MemoryError) else error}."
            return
        self.values += column.size
        self.claim(self.values)
        self.columns[path] = column
        self.hints |= {path: hint} if hint else {}
        self.units |= {path: unit} if unit else {}
        if column.size == 1:
            self.note(path, column.reshape(-1)[0])

    def claim(self, values: int) -> None:
        """Refuse a file that claims more values than it may hold, where it can before they are unpacked.

        Raises
        ------
        LogError
        """
        if values > self.most:
            text = f"claims more than {self.most} values"
            raise refusal("unpacks-too-large", self.name, text, "a log of one step response")

    def note(self, key: str, value: Any) -> None:
        """Keep a single value as an attribute, if it is a number or a text."""
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        value = value.item() if isinstance(value, np.generic) else value
        value = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        if isinstance(value, str | int | float):
            self.attributes[key] = value[:LONGEST_ATTRIBUTE] if isinstance(value, str) else value

    def cut_row(self, text: str, row: int) -> None:
        """Say that the last row is cut and left out, and keep it verbatim."""
        self.note("cut_last_row", text)
        said = f"last row is cut: {text[:200]!r} (line {row}) was left out and is kept verbatim"
        self.warnings.append(said)

    def lacks(self) -> bool:
        """Return whether a wanted column is not there."""
        try:
            return not all(self._find(key) for key in self.wanted)
        except LogError as error:
            return error.code == "column-missing"

    def frame(self) -> Frame:
        """Return the wanted columns; without any, all that are no single values.

        An array with one axis longer than 1 is one column. Of a matrix, the axis that is as long as the wanted columns
        (without any: as the vectors of the file) is time, the first one where both fit, and the longer one where
        nothing fits; the other axes give elements ``name[0]``, ``name[1]``, ..., counted from 0.

        Raises
        ------
        LogError
            If a name is not there, cannot be read, is a matrix without an element named, or lengths differ.
        """
        single = self.attributes.keys() if any(a.size != 1 for a in self.columns.values()) else ()
        found = {key: self._find(key) for key in self.wanted} or {
            key: (base, index)
            for base in self.columns
            if base not in single
            for key, index in _elements(base, self.columns[base], self._lengths(self.columns))
        }
        if not found:
            raise refusal("empty", self.name, f"holds no columns{self._reasons()}", "recorded signals")
        lengths = self._lengths({base for base, _ in found.values()}) or self._lengths(self.columns)
        columns = {key: self._take(key, base, index, lengths) for key, (base, index) in found.items()}
        rows = {key: len(column) for key, column in columns.items()}
        if len(set(rows.values())) > 1:
            listing = ", ".join(f"{key!r}: {count}" for key, count in list(rows.items())[:LISTED_NAMES])
            text = f"columns have different lengths ({listing})"
            raise refusal("lengths-differ", self.name, text, "one length", row=min(rows.values()) + 1)
        row = np.arange(1, next(iter(rows.values())) + 1) if self.row is None else self.row
        return Frame(columns, row, self.row_name, self.attributes, tuple(self.warnings), self.dates, self.units)

    def listed(self) -> list[ColumnInfo]:
        """Return what `frame` can take, with first values; what cannot be read has no rows, and the reason as hint."""
        if not self.columns and not self.refused:
            raise refusal("empty", self.name, "holds no columns", "recorded signals")
        infos, lengths = [], self._lengths(self.columns)
        for base, array in self.columns.items():
            for key, index in _elements(base, array, lengths):
                values = self._take(key, base, index, lengths)
                kind = _KINDS.get(array.dtype.kind, "integer")
                hint = self.units.get(base) or self.hints.get(base, "")
                infos.append(ColumnInfo(key, kind, len(values), tuple(map(str, values[:3])), hint))
        return infos + [ColumnInfo(path, "text", 0, (), reason) for path, reason in self.refused.items()]

    def _lengths(self, bases: Any) -> set[int]:
        """Return the lengths of vectors; single numbers do not count."""
        return {self.columns[base].size for base in bases if is_vector(self.columns[base].shape)} - {0, 1}

    def _take(self, key: str, base: str, index: tuple[int, ...], lengths: set[int]) -> Array:
        values = self.columns[base]
        if is_vector(values.shape) and not any(index):
            return values.reshape(-1)
        axis = time_axis(values.shape, lengths)
        others = [length for i, length in enumerate(values.shape) if i != axis]
        if len(index) != len(others) or any(i >= length for i, length in zip(index, others, strict=True)):
            first, last = _element(base, [0] * len(others)), _element(base, [n - 1 for n in others])
            text = f"{base!r} has shape {values.shape}, so its columns are {first!r} to {last!r}; asked for is {key!r}"
            raise refusal("column-missing", self.name, text, cure="Name one element in columns.*.name.")
        selection: Any = (slice(None), *index)
        return np.ascontiguousarray(np.moveaxis(values, axis, 0)[selection])

    def _find(self, wanted: str) -> tuple[str, tuple[int, ...]]:
        """Return the array that holds a column, and which element of it."""
        match = _ELEMENT.fullmatch(wanted)
        stem, index = (match[1], re.findall(r"\d+", match[2])) if match else (wanted, [])
        # the name itself may end in brackets, as elements of a struct array do
        for own in range(len(index), -1, -1):
            for base in (_element(stem, index[:own]), "/" + _element(stem, index[:own])):
                if base in self.columns:
                    return base, tuple(int(i) for i in index[own:])
        for key, reason in self.refused.items():
            bare = key.removeprefix("/")
            if wanted.removeprefix("/") == bare or wanted.removeprefix("/").startswith((f"{bare}.", f"{bare}[")):
                raise LogError(f"{self.name}: {key!r} {reason}", code="unsupported")
        known = [info.name for info in self.listed() if info.rows] if self.columns else []
        near = get_close_matches(wanted, known, 3)
        nearest = f" Nearest: {', '.join(near)}." if near else ""
        listing = ", ".join(known[:LISTED_NAMES]) + (", ..." if len(known) > LISTED_NAMES else "") or "none"
        text = f"no column {wanted!r}.{nearest} It has: {listing}.{self._reasons()}"
        raise refusal("column-missing", self.name, text)

    def _reasons(self) -> str:
        """Return which parts of the file cannot be read, and why the first of them."""
        names = ", ".join(map(repr, list(self.refused)[:LISTED_NAMES]))
        return f" Not readable: {names}; {next(iter(self.refused.values()))}" if names else ""


def plain_column(values: Array) -> Array:
    """Return values as a frame holds them: float64, integers of 64 bits, or str.

    Raises
    ------
    TypeError
        If they are none of these.
    """
    kind = values.dtype.kind
    if kind == "f":
        return values.astype(np.float64, copy=False)
    if kind in "biu":
        # a counter of 64 bits may be above the largest signed number
        return values.astype(np.uint64 if kind == "u" and values.dtype.itemsize == 8 else np.int64, copy=False)
    if kind == "c":
        raise TypeError("holds complex numbers; save real and imaginary part: re = real(x); im = imag(x)")
    if kind in "mM":
        return values.astype(f"{kind}8[ns]").astype(np.int64)
    if kind in "UT" or (kind in "SO" and all(isinstance(value, str | bytes) for value in values.flat)):
        return np.array([v.decode() if isinstance(v, bytes) else v for v in values.flat], np.str_).reshape(values.shape)
    raise TypeError(f"is of type {values.dtype}; expected numbers or texts")


def with_gaps(where: str, values: Array, place: Integers, rows: int, row: Integers | None = None) -> Array:
    """Return values at their places among so many rows, NaN or an empty text at the others.

    Raises
    ------
    LogError
        If they are whole numbers of more than 15 digits, which a float with gaps would not keep.
    """
    if len(values) == rows:
        result: Array = np.empty_like(values)
    elif values.dtype.kind == "U":
        result = np.zeros(rows, values.dtype)
    else:
        large = values.dtype.kind in "iu" and np.any(np.abs(values.astype(np.float64)) > EXACT)
        if large:
            at = int(np.setdiff1d(np.arange(rows), place)[0])
            text = f"{where} has whole numbers of more than 15 digits, and rows without a value"
            raise refusal("no-value", "", text, "a value in each row", row=at + 1 if row is None else int(row[at]))
        result = np.full(rows, np.nan)
    result[place] = values
    return result


def is_vector(shape: Sequence[int]) -> bool:
    """Return whether at most one axis is longer than 1 (or the array is empty): one column, whatever the axis."""
    return sum(length != 1 for length in shape) <= 1 or 0 in shape


def time_axis(shape: tuple[int, ...], lengths: set[int]) -> int:
    """Return the axis that is time: the first or the last that has one of the lengths, else the longer one of both."""
    ends = (0, len(shape) - 1)
    return next((axis for axis in ends if shape[axis] in lengths), max(ends, key=lambda axis: shape[axis]))


def _elements(base: str, array: Array, lengths: set[int]) -> list[tuple[str, tuple[int, ...]]]:
    if is_vector(array.shape):
        return [(base, ())]
    axis = time_axis(array.shape, lengths)
    others = [range(length) for i, length in enumerate(array.shape) if i != axis]
    return [(_element(base, i), i) for i in islice(product(*others), LISTED_ELEMENTS)]


def _element(base: str, index: Sequence[int | str]) -> str:
    return base + "".join(f"[{i}]" for i in index)
