"""What a format reader hands on: the columns of a file as they stand in it, without units, signs or guesses.

A format module ``pipeline/readers/<format>.py`` has two functions:

``read_frame(profile, name, data, wanted) -> Frame``
    Columns of a file. ``wanted`` are the names the profile asks for; others may be left out. Empty means all.
``list_columns(name, data, profile=None) -> list[ColumnInfo]``
    What there is, for checking and drafting profiles and for messages.

Both raise `LogError` with what is wrong, where, expected, found and what to do. `pipeline.readers.mapping` turns frames
into logs in SI.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from pipeline.records.batch import Integers

Scalar = str | float | int


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

    columns: Mapping[str, NDArray[Any]]
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
