"""Records inside each other (JSON objects, messages of a bag) as columns: ``state.q[3]``, ``1``, ``2`` of plain lists.

A value that is null or not there is NaN, or an empty text; true and false are 1 and 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from pipeline.base.errors import Code
from pipeline.readers.frame import Array, with_gaps
from pipeline.readers.limits import EXACT
from pipeline.readers.refusals import refusal
from pipeline.records.batch import Integers


class Cells(NamedTuple):
    """Values of a column, and the numbers of their records from 0."""

    place: list[int]
    values: list[Any]

    def array(self, where: str, rows: int, row: Integers | None = None) -> Array:
        """Return a value for each of so many rows, where ``row`` says where each stands in the file.

        Raises
        ------
        LogError
            If texts stand beside numbers, or whole numbers of more than 15 digits beside fractions or gaps.
        """
        place = np.array(self.place, np.int64)
        texts = [isinstance(value, str) for value in self.values]
        large = [isinstance(value, int) and abs(value) > EXACT for value in self.values]
        code: Code
        beyond = any(large) and not any(texts) and max(self.values) >= 1 << 63
        if any(texts) != all(texts):
            at, code, found = texts.index(False), "not-a-number", "mixes texts and numbers"
        elif any(large) and any(isinstance(value, float) for value in self.values):
            at, code, found = large.index(True), "no-value", "mixes fractions and whole numbers of more than 15 digits"
        else:
            values = np.array(self.values, np.uint64 if beyond else None)
            return with_gaps(where, values.astype(np.int64) if values.dtype == np.bool_ else values, place, rows, row)
        at_row = int(place[at] + 1 if row is None else row[place[at]])
        raise refusal(code, where, f"{found}, such as {self.values[at]!r}", row=at_row)


def columns_of(records: Sequence[Any]) -> dict[str, Cells]:
    """Return what records hold by path, in the order in which the paths are found."""
    columns: dict[str, Cells] = {}
    for number, record in enumerate(records):
        for path, value in flat(record):
            if value is None:
                continue
            cells = columns.setdefault(path, Cells([], []))
            if cells.place and cells.place[-1] == number:
                raise ValueError(f"{path!r} stands twice in one record")
            cells.place.append(number)
            cells.values.append(value)
    return columns


def flat(value: Any, path: str = "", lists: bool = True) -> Iterator[tuple[str, Any]]:
    """Yield path and value of all that is inside objects, and inside lists where ``lists``."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from flat(part, f"{path}.{key}" if path else key, lists)
    elif isinstance(value, list) and lists:
        for number, part in enumerate(value):
            yield from flat(part, f"{path}[{number}]" if path else str(number + 1), lists)
    else:
        yield path, value
