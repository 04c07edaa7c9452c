"""Arrays of a file as columns: which axis is time, how vector elements are called, which lengths fit together.

MATLAB, HDF5 and TDMS files hold arrays of any shape and length under names. A frame takes those that the profile
asks for.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import product
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import LogError
from pipeline.readers.frame import ColumnInfo, Frame, Scalar

LISTED_ELEMENTS = 64
"""Elements of one vector that are listed: a robot has fewer, an image has more and is no column."""

LISTED_NAMES = 40
"""Names that a message lists."""

_ELEMENT = re.compile(r"(.+?)((?:\[\d+\])+)", re.DOTALL)

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class StoredArray:
    """An array in a file, not loaded yet.

    Parameters
    ----------
    shape : tuple of int
        Rows of a file that is read as written: one axis is time.
    kind : {"number", "integer", "text"}
    load : callable
        Returns the array.
    hint : str
        Unit or description found in the file.
    """

    shape: tuple[int, ...]
    kind: str
    load: Callable[[], Array]
    hint: str = ""


def stored(values: Array, hint: str = "") -> StoredArray:
    """Return an array in memory as a stored one."""
    kind = {"f": "number", "U": "text", "O": "text"}.get(values.dtype.kind, "integer")
    return StoredArray(values.shape, kind, lambda: values, hint)


def plain_column(values: Array) -> Array:
    """Return values as a frame holds them: float64, integers of 64 bits, or str."""
    if values.dtype.kind == "f":
        return np.ascontiguousarray(values, dtype=np.float64)
    if values.dtype.kind in "bi":
        return np.ascontiguousarray(values, dtype=np.int64)
    if values.dtype.kind == "u":
        # a counter of 64 bits may be above the largest signed number
        return np.ascontiguousarray(values, dtype=np.uint64 if values.dtype.itemsize == 8 else np.int64)
    return np.asarray(values, dtype=np.str_)


def frame_of_arrays(
    name: str,
    arrays: Mapping[str, StoredArray],
    wanted: Sequence[str],
    attributes: Mapping[str, Scalar],
    refused: Mapping[str, str] | None = None,
) -> Frame:
    """Return the wanted arrays as a frame.

    An array with one axis longer than 1 is one column; the axes of length 1 do not matter. Of a matrix, the axis
    that is as long as the wanted columns (without any: as the vectors of the file) is time, the first one where
    both fit, and the longer one where nothing fits; the other axes give elements ``name[0]``, ``name[1]``, ..., counted
    from 0.

    Parameters
    ----------
    name : str
        The file.
    arrays : mapping of str to StoredArray
    wanted : sequence of str
        Names of arrays and of elements; empty means all.
    attributes : mapping
        Passed on.
    refused : mapping of str to str, optional
        What is in the file but cannot be read, with the reason.

    Raises
    ------
    LogError
        If a name is not there, cannot be read, is a matrix without an element named, or lengths differ.
    """
    refused = refused or {}
    found = {key: _find(name, arrays, refused, key) for key in wanted}
    if not wanted:
        found = {key: (base, index) for base in arrays for key, index in _elements(arrays, base)}
        if not found:
            raise LogError(f"{name} holds no columns; expected recorded signals.{_reasons(refused)}", code="empty")
    lengths = {_length(arrays[base].shape) for base, _ in found.values() if is_vector(arrays[base].shape)}
    lengths = lengths or vector_lengths(arrays)
    loaded: dict[str, Array] = {}
    columns: dict[str, Array] = {}
    for key, (base, index) in found.items():
        shape = arrays[base].shape
        if base not in loaded:
            loaded[base] = arrays[base].load()
        axis = time_axis(shape, lengths)
        others = [length for i, length in enumerate(shape) if i != axis]
        if is_vector(shape) and not any(index):
            columns[key] = plain_column(loaded[base].reshape(-1))
            continue
        if len(index) != len(others) or any(i >= length for i, length in zip(index, others, strict=True)):
            first, last = _element(base, [0] * len(others)), _element(base, [n - 1 for n in others])
            raise LogError(
                f"{name}: {base!r} has shape {shape}, so its columns are {first!r} to {last!r}; the profile asks for "
                f"{key!r}. Name one element in columns.*.name.",
                code="column-missing",
            )
        columns[key] = plain_column(_element_values(loaded[base], axis, index))
    rows = {key: len(column) for key, column in columns.items()}
    if len(set(rows.values())) > 1:
        listing = ", ".join(f"{key!r}: {count}" for key, count in list(rows.items())[:LISTED_NAMES])
        raise LogError(
            f"{name}: columns have different lengths ({listing}); expected one length. "
            "Choose in columns.*.name signals that were recorded together, with the time that belongs to them.",
            min(rows.values()) + 1,
            code="lengths-differ",
        )
    count = next(iter(rows.values()))
    return Frame(columns, np.arange(1, count + 1, dtype=np.int64), "sample", dict(attributes))


def list_arrays(arrays: Mapping[str, StoredArray]) -> list[ColumnInfo]:
    """Return what `frame_of_arrays` can take, with first values; long vectors of elements are cut short."""
    lengths = vector_lengths(arrays)
    infos = []
    for base, array in arrays.items():
        axis = time_axis(array.shape, lengths)
        try:
            values = array.load() if prod(array.shape) else None
        except LogError as error:
            # one array that cannot be had must not hide the others
            infos.append(ColumnInfo(base, array.kind, 0, (), error.reason))
            continue
        for key, index in _elements(arrays, base):
            if values is None or is_vector(array.shape):
                column = np.empty(0) if values is None else values.reshape(-1)
            else:
                column = _element_values(values, axis, index)
            first = tuple(str(value) for value in column[:3])
            infos.append(ColumnInfo(key, array.kind, len(column), first, array.hint))
    return infos


@dataclass
class Contents:
    """What a file holds.

    Parameters
    ----------
    arrays : dict of str to StoredArray
        Numbers and texts by path.
    attributes : dict of str to str, float or int
        Single numbers and texts.
    refused : dict of str to str
        What cannot be read, and why.
    """

    arrays: dict[str, StoredArray] = field(default_factory=dict)
    attributes: dict[str, Scalar] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    def keep(self, path: str, array: StoredArray) -> None:
        """Add an array; a single value is an attribute, too."""
        self.arrays[path] = array
        if prod(array.shape) == 1:
            value = array.load().reshape(-1)[0]
            self.attributes[path] = value.item() if isinstance(value, np.generic) else str(value)

    def frame(self, name: str, wanted: Sequence[str]) -> Frame:
        """Return the wanted arrays as a frame; of all, those that are no single values."""
        plain = {path: array for path, array in self.arrays.items() if path not in self.attributes}
        return frame_of_arrays(name, self.arrays if wanted else plain, wanted, self.attributes, self.refused)

    def listed(self) -> list[ColumnInfo]:
        """Return what `frame` can take; what cannot be read has no rows, and the reason as hint."""
        refused = [ColumnInfo(path, "text", 0, (), reason) for path, reason in self.refused.items()]
        return list_arrays(self.arrays) + refused


def is_vector(shape: tuple[int, ...]) -> bool:
    """Return whether at most one axis is longer than 1 (or the array is empty): one column, whatever the axis."""
    return sum(length != 1 for length in shape) <= 1 or 0 in shape


def vector_lengths(arrays: Mapping[str, StoredArray]) -> set[int]:
    """Return the lengths of the vectors of a file; single numbers do not count."""
    return {_length(a.shape) for a in arrays.values() if is_vector(a.shape)} - {0, 1}


def time_axis(shape: tuple[int, ...], lengths: set[int]) -> int:
    """Return the axis that is time: the first or the last that has one of the lengths, else the longer one of both.

    A matrix alone, such as Simulink's "To File" writes with one signal in each row, says no length; a log has more
    samples than signals.
    """
    if not shape:
        return 0
    ends = (0, len(shape) - 1)
    return next((axis for axis in ends if shape[axis] in lengths), max(ends, key=lambda axis: shape[axis]))


def unknown_column(name: str, wanted: str, known: Sequence[str], more: str = "") -> LogError:
    """Return the error for a column that a file does not have, with the nearest names."""
    near = get_close_matches(wanted, known[:1000], 3, 0.5)
    listing = ", ".join(known[:LISTED_NAMES]) + (", ..." if len(known) > LISTED_NAMES else "")
    nearest = f" Nearest: {', '.join(near)}." if near else ""
    return LogError(
        f"{name} has no column {wanted!r}.{nearest} "
        f"It has: {listing or 'none at all'}.{more} Correct columns.*.name in the profile.",
        code="column-missing",
    )


def _reasons(refused: Mapping[str, str]) -> str:
    """Return which parts of a file cannot be read, and why the first of them."""
    if not refused:
        return ""
    names = list(refused)
    listing = ", ".join(map(repr, names[:LISTED_NAMES])) + (", ..." if len(names) > LISTED_NAMES else "")
    return f" Not readable: {listing}; {names[0]!r} {refused[names[0]]}"


def _find(
    name: str, arrays: Mapping[str, StoredArray], refused: Mapping[str, str], wanted: str
) -> tuple[str, tuple[int, ...]]:
    """Return the array that holds a column, and which element of it."""
    if wanted in arrays:
        return wanted, ()
    match = _ELEMENT.fullmatch(wanted)
    stem, index = (match[1], re.findall(r"\d+", match[2])) if match else (wanted, [])
    # the name itself may end in brackets, as elements of a struct array do
    for own in range(len(index)):
        base = _element(stem, index[:own])
        if base in arrays:
            return base, tuple(int(i) for i in index[own:])
    for key, reason in refused.items():
        if wanted == key or wanted.startswith((f"{key}.", f"{key}[", f"{key}/")):
            raise LogError(f"{name}: {key!r} {reason}", code="unsupported")
    raise unknown_column(name, wanted, list(arrays), _reasons(refused))


def _elements(arrays: Mapping[str, StoredArray], base: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    shape = arrays[base].shape
    if is_vector(shape):
        yield base, ()
        return
    axis = time_axis(shape, vector_lengths(arrays))
    others = [range(length) for i, length in enumerate(shape) if i != axis]
    for number, index in enumerate(product(*others)):
        if number == LISTED_ELEMENTS:
            return
        yield _element(base, index), index


def _element(base: str, index: Sequence[int | str]) -> str:
    return base + "".join(f"[{i}]" for i in index)


def _element_values(values: Array, axis: int, index: tuple[int, ...]) -> Array:
    """Return one element of a vector or matrix at all times."""
    selection: Any = (slice(None), *index)
    element: Array = np.moveaxis(values, axis, 0)[selection]
    return element


def _length(shape: tuple[int, ...]) -> int:
    return prod(shape)
