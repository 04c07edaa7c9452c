"""Columns of a file by name, as a format reader finds them: without units, signs or guesses.

A format is a function ``read(path, settings, contents)`` that adds the arrays of a file to a `FileColumns`. Its method
`frame` takes the columns that a profile names; `mapping` turns them into logs.
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
"""Bytes above which a file is not read, packed or not: 10^6 times a usual log, so it is something else."""

MOST_VALUES = 1 << 26
"""Values of a file: 10^7 rows of six columns; the worker that reads has no memory for many more."""

SMALL_FILE = 64 << 20
"""Bytes that reading any file may take: 10^6 rows of eight columns; a constant column packs 1000 times and more."""

EXPANSION = 30
"""Times its own size that reading a larger file may take; recorded samples pack 1 to 20 times."""

LONGEST_HEADER = 1 << 16
"""Bytes searched for the column line; a header is some hundred bytes, a file without one may be huge."""

KEPT_ATTRIBUTES, LONGEST_ATTRIBUTE = 100, 10_000
"""Most attributes of a file that are stored with each of its trials, and characters of each: a workspace dump may have
thousands of attributes, and one of them may be a whole file."""

LISTED_ELEMENTS, LISTED_NAMES = 64, 40
"""Elements of one vector that are listed, and names in a message: a robot has fewer, an image has more."""


def allowed_bytes(size: int) -> int:
    """Return how many bytes a file of this size [byte] may unpack to."""
    return min(4 * LARGEST_LOG, max(SMALL_FILE, EXPANSION * size))


Scalar = str | float | int
Array = NDArray[Any]

ARRAY = 800
"""Values for which an array counts by itself: a damaged file may claim millions of empty ones."""


@dataclass
class FileColumns:
    """FileColumns of a file: columns and attributes.

    Parameters
    ----------
    name : str
        The file, for messages.
    wanted : tuple of str
        Names that a profile asks for; others are left out. Empty means all.
    most : int
        Most values that the file may contain.
    row_name : str
        What a row is called there: "line", "record", "sample", "message".
    columns : dict of str to array, shape (rows,)
        float64, integers (a counter keeps its integers) or str (a text column, such as the label of a trial), by the
        name in the file: ``"1"``, ``"2"``, ... in a file without names; a path with dots where it is nested
        (``"state.q"``), elements of a matrix in brackets, counted from 0 (``"state.q[3]"``). NaN (an empty text in a
        text column) is a missing cell, as in sparse files of several rates. Nothing is interpolated.
    hints : dict of str to str
        Units and descriptions that are shown only.
    units : dict of str to str
        Units of times that their type in the file states beyond doubt, such as ns of a ROS stamp; a profile that says
        otherwise is refused. Units in names, headers and attributes are no such units: they are shown only.
    attributes : dict of str to str, float or int
        Scalars and texts found in the file, such as HDF5 attributes or lines "label: value"; a profile may take
        conditions from them.
    refused : dict of str to str
        What is in the file but cannot be read, and why.
    warnings : tuple of str
        What was accepted and should be known, such as a last row that was cut.
    row : int64, shape (rows,)
        Where each row stands in the file, counted from 1; empty before it is known.
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
    warnings: tuple[str, ...] = ()
    row: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    keys: dict[str, str] = field(default_factory=dict)
    values: int = 0

    def asks(self, path: str) -> bool:
        """Return whether a column, or an element of it, is wanted; the first slash of a path may be left out."""
        return not self.wanted or any(_is_part(key, path) for key in self.wanted)

    def add(
        self, path: str, values: Array | Callable[[], Any], hint: str = "", unit: str = "", axis: int | None = None
    ) -> None:
        """Keep an array, or the reason why it cannot be read: one that cannot must not hide the others.

        Parameters
        ----------
        path : str
        values : array, or callable that loads one
            An array with one axis longer than 1 is one column; of a matrix, each element ``path[0]``, ``path[1]``, ...
        hint, unit : str
            What the file says of it, and the unit of times that its type states.
        axis : int, optional
            The axis that is time; the longest one where the format does not say it.

        Raises
        ------
        LogError
            If the file contains more arrays or values than a log has.
        """
        try:
            array = np.asarray(values() if callable(values) else values)
            unit = "ns" if array.dtype.kind in "mM" else unit
            array = plain_column(array)
        except (LogError, MemoryError, OSError, TypeError, ValueError) as error:
            if self.wanted and self.asks(path) and not isinstance(error, TypeError | ValueError):
                raise
            large = "claims more values than this file may unpack to"
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
        """Refuse a file that claims more values than allowed, if possible before they are unpacked."""
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
        self.warnings += (f"last row is cut: {text[:200]!r} (line {row}) was left out and is kept verbatim",)

    def find(self, wanted: str) -> str | None:
        """Return the name of a column that is wanted, or None: slash and index of a single element may be left out."""
        names = (wanted, re.sub(r"(\[0\])+$", "", wanted))
        return next((known for name in names for known in (name, f"/{name}") if known in self.columns), None)

    def of_group(self, group: str, wanted: tuple[str, ...] = ()) -> Self:
        """Return the contents of a group, by the names in it, with its attributes and those of the whole file."""

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
        """Return whether a wanted column is not there, and not known to be unreadable."""
        refused = [key for key in self.wanted if any(_is_part(key, path) for path in self.refused)]
        return any(self.find(key) is None and key not in refused for key in self.wanted)

    def frame(self) -> Self:
        """Return the wanted columns alone, by the names that are wanted; without any, all that are no single values.

        Raises
        ------
        LogError
            If a name is not there or cannot be read, or lengths differ.
        """
        vectors = {name: column for name, column in self.columns.items() if len(column) != 1} or self.columns
        columns = {key: self._column(key) for key in self.wanted} or vectors
        if not columns:
            raise refusal("empty", self.name, f"contains no columns{self._reasons()}", "recorded signals")
        rows = {key: len(column) for key, column in columns.items()}
        if len(set(rows.values())) > 1:
            listing = ", ".join(f"{key!r}: {count}" for key, count in list(rows.items())[:LISTED_NAMES])
            text = f"columns have different lengths ({listing})"
            line = '[columns.time]\nkind = "sampled" # one row each sampling period, without the column of time'
            raise refusal("lengths-differ", self.name, text, "one length", row=min(rows.values()) + 1, line=line)
        units, hints = (
            {key: told[name] for key in columns if (name := self.find(key)) in told}
            for told in (self.units, self.hints)
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
        text = f"no column {wanted!r}.{nearest} It has: {listing}.{self._reasons()}"
        raise refusal("column-missing", self.name, text)

    def _reasons(self) -> str:
        """Return which parts of the file cannot be read, and why the first of them."""
        names = ", ".join(map(repr, list(self.refused)[:LISTED_NAMES]))
        return f" Not readable: {names}; {next(iter(self.refused.values()))}" if names else ""


_INSIDE = ("/", ".", "@")
"""Signs between a group and what is in it: a column, a field, an attribute."""


_ELEMENT = re.compile(r"\[\d+\]$")
"""An element of a matrix whose columns are a trial."""


def groups_of(names: Collection[str], wanted: Collection[str]) -> list[str]:
    """Return the groups that have all wanted columns, in the order in which they are found.

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
    """Return how the names of columns in groups end whose name in the group is this one."""
    return (name,) if _ELEMENT.fullmatch(name) else tuple(f"{sign}{name}" for sign in _INSIDE[:2])


_REFERENCE = re.compile(r"desired|target|ref|soll|set_?point|cmd|command|raw|filtered", re.IGNORECASE)
"""Groups of what was wanted, or of the same motion once more, are no trials."""


def trial_groups(contents: FileColumns) -> list[str]:
    """Return groups that look like trials of one kind, with the same columns of several rows.

    They are numbered, or were recorded at other times, or each has another value in a column that is constant.

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
    """Return the columns of several rows in each group by their names in it: fields, or the elements of a matrix."""
    leaves: dict[str, list[str]] = {}
    for name, values in contents.columns.items():
        element = None if whole else _ELEMENT.search(name)
        at = max(name.rfind(sign) for sign in _INSIDE[:2]) if element is None else element.start()
        if at > 0 and len(values) > 2 and values.dtype.kind != "U" and (whole or element):
            leaves.setdefault(name[:at], []).append(name[at + (element is None) :])
    # a matrix is a trial where it has a clock; else it is a vector
    timed = (
        group for group, inside in leaves.items() if whole or any(_rises(contents.columns[group + e]) for e in inside)
    )
    return {group: leaves[group] for group in timed}


def _are_trials(contents: FileColumns, groups: Sequence[str], inside: Sequence[str]) -> bool:
    """Return whether groups of the same columns are trials, and no two devices at the same time."""
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
    """Return whether a column is what stands at a path, or in it; the first slash may be left out."""
    column, path = column.removeprefix("/"), path.removeprefix("/")
    return column == path or column.startswith((f"{path}[", f"{path}."))


def _elements(path: str, array: Array, axis: int | None) -> Iterator[tuple[str, Array]]:
    """Yield the columns of an array by name: one, whatever its axis, or the elements of a matrix."""
    shape = array.shape
    if array.size == 0 or sum(length != 1 for i, length in enumerate(shape) if i != axis) <= (axis is None):
        yield path, array.reshape(-1)
        return
    moved = np.moveaxis(array, int(np.argmax(shape)) if axis is None else axis, -1)
    for index in np.ndindex(moved.shape[:-1]):
        yield path + "".join(f"[{i}]" for i in index), np.ascontiguousarray(moved[index])


def plain_column(values: Array) -> Array:
    """Return values in one of the types of columns: float64, integers of 64 bits, or str.

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
        raise TypeError("contains complex numbers; save real and imaginary part: re = real(x); im = imag(x)")
    if kind in "mM":
        return values.astype(f"{kind}8[ns]").astype(np.int64)
    if kind in "UT" or (kind in "SO" and all(isinstance(value, str | bytes) for value in values.flat)):
        return np.array([v.decode() if isinstance(v, bytes) else v for v in values.flat], np.str_).reshape(values.shape)
    raise TypeError(f"is of type {values.dtype}; expected numbers or texts")


def with_gaps(values: Array, place: Sequence[int] | Integers, rows: int) -> Array:
    """Return values at their places among so many rows, NaN or an empty text at the others."""
    full = len(values) == rows or values.dtype.kind == "U"
    result: Array = np.zeros(rows, values.dtype) if full else np.full(rows, np.nan)
    result[place] = values
    return result


def library(module: str, extra: str) -> Any:
    """Import a module that needs a library which only some formats need.

    Raises
    ------
    LogError
        If it is not installed; says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        found = f"reading this format needs {error.name or module}, which is not installed"
        cure = f"Run pip install '.[{extra}]' in the project's folder, then ingest with --rehash."
        raise refusal("library-missing", "", found, cure=cure) from error
