"""Reader of numpy archives (``.npz``) and sheets (XLSX, ODS).

Arrays of a numpy archive keep their names. Columns of a sheet have the names in its line of names. Arrays of Python
objects are not read, because they could run code. A single number is an attribute.
"""

from __future__ import annotations

from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import Array, FileColumns, library


def read_npz(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the arrays of a numpy archive."""
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            if contents.wants(name) or archive[name].size == 1:
                contents.add(name, partial(archive.__getitem__, name))


def read_sheet(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the columns of the first sheet that has a line of names with rows of numbers below it."""
    book: Any = library("python_calamine", "sheets").CalamineWorkbook.from_filelike(BytesIO(path.read_bytes()))
    for title in book.sheet_names:
        rows = book.get_sheet_by_name(title).to_python(skip_empty_area=False)
        top = next((i for i, row in enumerate(rows) if sum(map(_is_text, row)) > 1), None)
        if top is None or len(rows) < top + 3:
            continue
        names = [str(cell).strip() for cell in rows[top]]
        units = rows[top + 1] if not any(isinstance(cell, float) for cell in rows[top + 1]) else []
        first = top + 1 + bool(units)
        for row in rows[:top]:  # these rows are labels above the table
            if len(row) > 1 and row[0] != "" and row[1] != "":
                contents.note(str(row[0]).strip(" :"), row[1])
        contents.row_name = "row"
        contents.row = np.arange(first + 1, len(rows) + 1)
        for at, name in enumerate(names):
            if name and contents.wants(name):
                cells = [row[at] if at < len(row) else "" for row in rows[first:]]
                contents.add(name, _column(cells), str(units[at]).strip(" []()") if at < len(units) else "")
        return
    raise refusal("header-missing", contents.name, "no sheet has a line of names above numbers", "a table of columns")


def _is_text(cell: object) -> bool:
    return isinstance(cell, str) and cell != ""


def _column(cells: list[Any]) -> Array:
    """Return cells as numbers, with NaN for blank cells, or as texts if any cell is a text."""
    if any(map(_is_text, cells)):
        return np.array([str(cell) for cell in cells], np.str_)
    return np.array([np.nan if cell == "" else float(cell) for cell in cells])
