"""Columns of a file by name, as read by a format module. Units and signs are not applied, and nothing is guessed.

A format module has a function ``read(path, settings, contents)`` that adds the arrays of a file to a `FileColumns`.
The method `frame` selects the columns that a profile names, and `mapping` converts them to logs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from importlib import import_module
from itertools import islice
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import LogError, refusal
from pipeline.records.trials import Integers

LARGEST_LOG = 256 << 20
"""Largest size [byte] of a file that is read, compressed or not. A larger file is not a log."""

MOST_VALUES = 1 << 26
"""Largest number of values in a file. It corresponds to 10^7 rows of six columns, and is limited by the memory of a
worker process."""

SMALL_FILE = 64 << 20
"""Unpacked size [byte] that is allowed for any file, whatever its packed size: 10^6 rows of eight columns. A constant
column may be compressed by a factor of 1000 or more.
"""

EXPANSION = 30
"""Largest ratio of the unpacked to the packed size, for files above this size. Recorded samples are compressed by a
factor of 1 to 20."""

LONGEST_HEADER = 1 << 16
"""Number of bytes at the start of a file in which the column line is searched for. A header has a few hundred bytes. A
file without a column line may be huge, and is not searched to its end."""

KEPT_ATTRIBUTES, LONGEST_ATTRIBUTE = 100, 10_000
"""Largest number of file attributes stored with each trial, and their largest length [characters].

A workspace dump may have thousands of attributes, and an attribute may contain a complete file.
"""

LISTED_ELEMENTS, LISTED_NAMES = 64, 40
"""Largest number of listed elements of a vector, and of names in a message. The vectors of a robot have fewer elements,
and an image has more."""


def allowed_bytes(size: int) -> int:
    """Return the number of bytes to which a file of this size [byte] may unpack."""
    return min(4 * LARGEST_LOG, max(SMALL_FILE, EXPANSION * size))


Scalar = str | float | int
Array = NDArray[Any]

ARRAY = 800
"""Smallest number of values that is counted for an array, because a damaged file may declare millions of empty
arrays."""


@dataclass
class FileColumns:
    """Columns and attributes of a file.

    Parameters
    ----------
    name : str
        Name of the file, for messages.
    wanted : tuple of str
        Names that a profile needs. Other columns are skipped. If it is empty, all columns are read.
    most : int
        Largest number of values that the file may contain.
    row_name : str
        Word for a row of the file: "line", "record", "sample" or "message".
    columns : dict of str to array, shape (rows,)
        float64, integers (a counter stays an integer) or str (a text column, such as the label of a trial) by the name
        in the file. In a file without names, the names are ``"1"``, ``"2"``, .... A nested name has dots
        (``"state.q"``). Elements of a matrix have an index in brackets, counted from 0 (``"state.q[3]"``). A missing
        cell, for example in a file with several sampling rates, is NaN, or an empty text in a text column. Nothing is
        interpolated.
    hints : dict of str to str
        Units and descriptions. They are only displayed.
    units : dict of str to str
        Time units that the data type in the file determines, such as ns of a ROS stamp. A profile that contradicts them
        is refused. Units in names, headers and attributes are not included here, because they are only displayed.
    attributes : dict of str to str, float or int
        Scalars and texts in the file, such as HDF5 attributes or lines "label: value". A profile may read conditions
        from them.
    refused : dict of str to str
        Parts of the file that cannot be read, with the reasons.
    warnings : tuple of str
        Irregularities that were accepted, such as an incomplete last row.
    row : int64, shape (rows,)
        Position of each row in the file, counted from 1. Empty as long as the positions are unknown.
    keys : dict of str to str
        Keys that a profile for this file needs, with their values as TOML.
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
    warnings: tuple[str, ...] = ()
    row: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    keys: dict[str, str] = field(default_factory=dict)
    values: int = 0

    def wants(self, path: str) -> bool:
        """Return True if a column or one of its elements is requested. The first slash of a path may be omitted."""
        return not self.wanted or any(_is_part(key, path) for key in self.wanted)

    def add(
        self, path: str, values: Array | Callable[[], Any], hint: str = "", unit: str = "", axis: int | None = None
    ) -> None:
        """Add an array, or the reason why it cannot be read. Other arrays remain available.
        ----------
        path : str
        values : array, or callable that loads one
            An array with one axis longer than 1 is a column. A matrix has a column for each element: ``path[0]``, ...
        hint, unit : str
            Description in the file, and the time unit that its data type determines.
        axis : int, optional
            Time axis. The default is the longest axis.

        Raises
        ------
        LogError
            If the file contains more arrays or values than a log may have.
        """
        try:
            array = np.asarray(values() if callable(values) else values)
            unit = "ns" if array.dtype.kind in "mM" else unit
            array = plain_column(array)
        except (LogError, MemoryError, OSError, TypeError, ValueError) as error:
            if self.wanted and self.wants(path) and not isinstance(error, TypeError | ValueError):
                raise
            large = "contains more values than a file of this size may contain"
            self.refused[path] = f"{large if isinstance(error, MemoryError) else error}."
            return
        self.values += array.size + ARRAY
        self.claim(self.values)
        if array.size == 1:
            self.note(path, array)
        for name, column in islice(_elements(path, array, axis), None if self.wanted else LISTED_ELEMENTS):
            self.columns[name] = column
            self.hints |= {name: hint} if hint else {}
            self.units |= {name: unit} if unit else {}

    def claim(self, values: int) -> None:
        """Refuse a file with more values than allowed, if possible before the values are unpacked."""
        if values > self.most:
            text = f"has more than {self.most} values"
            raise refusal("unpacks-too-large", self.name, text, "a log of one step response")

    def note(self, key: str, value: Any) -> None:
        """Store a single value as an attribute if it is a number or text."""
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        value = value.item() if isinstance(value, np.generic) else value
        value = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        if isinstance(value, str | int | float):
            self.attributes[key] = value[:LONGEST_ATTRIBUTE] if isinstance(value, str) else value

    def cut_row(self, text: str, row: int) -> None:
        """Add a warning that the incomplete last row was omitted, and store its text."""
        self.note("cut_last_row", text)
        self.warnings += (f"the last row (line {row}) is incomplete and was omitted: {text[:200]!r}",)

    def find(self, wanted: str) -> str | None:
        """Return the name of a wanted column, or None.

        A first slash, and the index of a single element, may be omitted.
        """
        names = (wanted, re.sub(r"(\[0\])+$", "", wanted))
        return next((known for name in names for known in (name, f"/{name}") if known in self.columns), None)

    def of_group(self, group: str, wanted: tuple[str, ...] = ()) -> Self:
        """Return the contents of a group by the names inside it, with its attributes and those of the file."""

        def inside(name: str) -> str:
            rest = name.removeprefix(group)
            if rest == name:
                return ""
            return rest if _ELEMENT.fullmatch(rest) else rest[1:] if rest[:1] in _INSIDE else ""

        return replace(
            self,
            wanted=wanted,
            columns={inside(name): values for name, values in self.columns.items() if inside(name)},
            hints={inside(name): hint for name, hint in self.hints.items() if inside(name)},
            units={inside(name): unit for name, unit in self.units.items() if inside(name)},
            attributes={inside(name) or name: value for name, value in self.attributes.items()},
            row=np.empty(0, np.int64),
        )

    def lacks(self) -> bool:
        """Return True if a wanted column is missing and not listed as unreadable."""
        refused = [key for key in self.wanted if any(_is_part(key, path) for path in self.refused)]
        return any(self.find(key) is None and key not in refused for key in self.wanted)

    def frame(self) -> Self:
        """Return only the wanted columns, under the wanted names. By default, return all columns with several rows.

        Raises
        ------
        LogError
            If a column is missing or unreadable, or the lengths differ.
        """
        vectors = {name: column for name, column in self.columns.items() if len(column) != 1} or self.columns
        columns = {key: self._column(key) for key in self.wanted} or vectors
        if not columns:
            raise refusal("empty", self.name, f"contains no columns{self._reasons()}", "recorded signals")
        rows = {key: len(column) for key, column in columns.items()}
        if len(set(rows.values())) > 1:
            listing = ", ".join(f"{key!r}: {count}" for key, count in list(rows.items())[:LISTED_NAMES])
            text = f"columns have different lengths ({listing})"
            line = '[columns.time]\nkind = "sampled" # one row per sampling period, without a column of time'
            raise refusal("lengths-differ", self.name, text, "one length", row=min(rows.values()) + 1, line=line)
        units, hints = (
            {key: source[name] for key in columns if (name := self.find(key)) in source}
            for source in (self.units, self.hints)
        )
        row = self.row if len(self.row) else np.arange(1, next(iter(rows.values())) + 1)
        return replace(self, columns=columns, units=units, hints=hints, row=row)

    def __len__(self) -> int:
        return len(self.row)

    def _column(self, wanted: str) -> Array:
        if (found := self.find(wanted)) is not None:
            return self.columns[found]
        for key, reason in self.refused.items():
            if _is_part(wanted, key):
                raise LogError(f"{self.name}: {key!r} {reason}", code="unsupported")
        known, near = [*self.columns], get_close_matches(wanted, self.columns, 3)
        nearest = f" Nearest: {', '.join(near)}." if near else ""
        stem = wanted.removeprefix("/").partition("[")[0]
        if elements := [name for name in known if name.removeprefix("/").startswith(f"{stem}[")]:
            nearest = f" Name one element in columns.*.name: {elements[0]} to {elements[-1]}."
        listing = ", ".join(known[:LISTED_NAMES]) + (", ..." if len(known) > LISTED_NAMES else "") or "none"
        text = f"no column {wanted!r}.{nearest} Columns of the file: {listing}.{self._reasons()}"
        raise refusal("column-missing", self.name, text)

    def _reasons(self) -> str:
        """Return a text that lists the unreadable parts of the file, with the reason for the first part."""
        names = ", ".join(map(repr, list(self.refused)[:LISTED_NAMES]))
        return f" Not readable: {names}; {next(iter(self.refused.values()))}" if names else ""


_INSIDE = ("/", ".", "@")
"""Characters between a group and its members (columns, fields, attributes)."""


_ELEMENT = re.compile(r"\[\d+\]$")
"""Pattern of the element index of a matrix whose elements are the columns of a trial."""


def groups_of(names: Collection[str], wanted: Collection[str]) -> list[str]:
    """Return the groups that have all wanted columns, in the order of the file.

    >>> groups_of(["/a/t", "/a/x", "/b/t", "/b/x", "/c/t"], ["t", "x"])
    ['/a', '/b']
    >>> groups_of(["up[0]", "up[1]", "down[0]", "down[1]"], ["[0]", "[1]"])
    ['up', 'down']
    """
    known = set(names)
    first = next(iter(wanted), "")
    found = (name[: -len(end)] for name in names for end in _ends(first) if name.endswith(end))
    return [
        group
        for group in dict.fromkeys(found)
        if all(any(f"{group}{end}" in known for end in _ends(name)) for name in wanted)
    ]


def _ends(name: str) -> tuple[str, ...]:
    """Return the possible endings of a full column name, given the name inside its group."""
    return (name,) if _ELEMENT.fullmatch(name) else tuple(f"{sign}{name}" for sign in _INSIDE[:2])


_REFERENCE = re.compile(r"desired|target|ref|soll|set_?point|cmd|command|raw|filtered", re.IGNORECASE)
"""Pattern of names of groups that are not trials, such as reference signals or a second recording of a motion."""


def trial_groups(contents: FileColumns) -> list[str]:
    """Return the groups that seem to be trials. They have the same columns with several rows each. In addition, their
    names are numbered, their recording times differ, or a constant column differs between them.

    >>> names = ("run1.t", "run1.x", "run2.t", "run2.x", "setup.t")
    >>> trial_groups(FileColumns("a", columns=dict.fromkeys(names, np.zeros(9))))
    ['run1', 'run2']
    """
    families: dict[tuple[str, ...], list[str]] = {}
    others: dict[tuple[str, ...], list[str]] = {}
    for group, inside in (_leaves(contents, whole=True) | _leaves(contents, whole=False)).items():
        key = tuple(sorted(inside))
        if len(inside) > 1 and re.search(r"\d\]?$", group):
            families.setdefault(key, []).append(group)
        elif len(inside) > 2 and not _REFERENCE.search(group):
            others.setdefault(key, []).append(group)
    best = max(families.values(), key=len, default=[])
    if len(best) > 1:
        return best
    names, best = max(others.items(), key=lambda family: len(family[1]), default=((), []))
    return best if len(best) > 1 and _are_trials(contents, best, names) else []


def _leaves(contents: FileColumns, whole: bool) -> dict[str, list[str]]:
    """Return the columns that have several rows in each group, by their names in the group.

    They are fields or matrix elements.
    """
    leaves: dict[str, list[str]] = {}
    for name, values in contents.columns.items():
        element = None if whole else _ELEMENT.search(name)
        at = max(name.rfind(sign) for sign in _INSIDE[:2]) if element is None else element.start()
        if at > 0 and len(values) > 2 and values.dtype.kind != "U" and (whole or element):
            leaves.setdefault(name[:at], []).append(name[at + (element is None) :])
    # A matrix with a time column is a trial. A matrix without a time column is a vector signal.
    timed = (
        group for group, inside in leaves.items() if whole or any(_rises(contents.columns[group + e]) for e in inside)
    )
    return {group: leaves[group] for group in timed}


def _are_trials(contents: FileColumns, groups: Sequence[str], inside: Sequence[str]) -> bool:
    """Return True if groups with the same columns are trials, and not devices recorded at the same time."""
    clocks_differ = []
    for name in inside:
        places = (f"{group}{end}" for group in groups for end in _ends(name))
        columns = [contents.columns[place] for place in places if place in contents.columns]
        if all(map(_rises, columns)):
            clocks_differ.append(not any(np.array_equal(columns[0], column) for column in columns[1:]))
        elif all(column[0] and not np.ptp(column) for column in columns) and len({column[0] for column in columns}) > 1:
            return True
    return bool(clocks_differ) and all(clocks_differ)


def _rises(values: Array) -> bool:
    return bool((np.diff(values) > 0).all())


def _is_part(column: str, path: str) -> bool:
    """Return True if a column is at a path or below it. The first slash may be omitted."""
    column, path = column.removeprefix("/"), path.removeprefix("/")
    return column == path or column.startswith((f"{path}[", f"{path}."))


def _elements(path: str, array: Array, axis: int | None) -> Iterator[tuple[str, Array]]:
    """Yield the columns of an array by name: one column for a vector of any orientation, or one column for each matrix
    element.
    """
    shape = array.shape
    if array.size == 0 or sum(length != 1 for i, length in enumerate(shape) if i != axis) <= (axis is None):
        yield path, array.reshape(-1)
        return
    moved = np.moveaxis(array, int(np.argmax(shape)) if axis is None else axis, -1)
    for index in np.ndindex(moved.shape[:-1]):
        yield path + "".join(f"[{i}]" for i in index), np.ascontiguousarray(moved[index])


def plain_column(values: Array) -> Array:
    """Convert values to the type of a column: float64, 64-bit integers or str.

    Raises
    ------
    TypeError
        If the values cannot be converted.
    """
    kind = values.dtype.kind
    if kind == "f":
        return values.astype(np.float64, copy=False)
    if kind in "biu":
        # A 64-bit counter may exceed the largest signed integer.
        return values.astype(np.uint64 if kind == "u" and values.dtype.itemsize == 8 else np.int64, copy=False)
    if kind == "c":
        raise TypeError("contains complex numbers; save real and imaginary parts: re = real(x); im = imag(x)")
    if kind in "mM":
        return values.astype(f"{kind}8[ns]").astype(np.int64)
    if kind in "UT" or (kind in "SO" and all(isinstance(value, str | bytes) for value in values.flat)):
        return np.array([v.decode() if isinstance(v, bytes) else v for v in values.flat], np.str_).reshape(values.shape)
    raise TypeError(f"is of type {values.dtype}; expected numbers or texts")


def with_gaps(values: Array, place: Sequence[int] | Integers, rows: int) -> Array:
    """Return a column of ``rows`` rows with values at the given places, and NaN or an empty text elsewhere."""
    full = len(values) == rows or values.dtype.kind == "U"
    result: Array = np.zeros(rows, values.dtype) if full else np.full(rows, np.nan)
    result[place] = values
    return result


def library(module: str, extra: str) -> Any:
    """Import a module that needs an optional library.

    Raises
    ------
    LogError
        If the library is not installed. The message explains how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        found = f"reading this format needs {error.name or module}, which is not installed"
        cure = f"Run pip install '.[{extra}]' in the project's folder, then ingest with --rehash."
        raise refusal("library-missing", "", found, cure=cure) from error
