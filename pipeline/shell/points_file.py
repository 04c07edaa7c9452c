"""Reader of CSV files with points whose costs are to be computed."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.theory.cases import CASE_COLUMNS, Cases


def read_cases(path: Path, columns: tuple[str, ...] = CASE_COLUMNS) -> Cases:
    """Read points from a CSV file with a header. Columns may be in any order, and additional columns are ignored.

    Parameters
    ----------
    path : Path
    columns : tuple of str
        Names of the columns. The default is the normalised parameters of a wall and its loop.

    Raises
    ------
    ParameterError
        If the file cannot be read, a column is missing, or a cell is not a finite number. The message has the row,
        counted from 1 with the header.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, strict=True)
            header = [name.strip() for name in next(reader, [])]
            lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except OSError as error:
        raise ParameterError(
            f"{path}: cannot be read ({error.strerror or error}). Name a CSV file with points."
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ParameterError(f"{path}: is not a CSV file in UTF-8 ({error}).") from error
    missing = [name for name in columns if name not in header]
    if missing:
        raise ParameterError(
            f"{path}, row 1: no column {', '.join(missing)}; expected a header with "
            f"{', '.join(columns)}, found {', '.join(header) or 'nothing'}."
        )
    double = [name for name in columns if header.count(name) > 1]
    if double:
        raise ParameterError(f"{path}, row 1: column {double[0]} occurs twice. Remove one of them.")
    places = [header.index(name) for name in columns]
    values = np.empty((len(lines), len(columns)))
    for value, (row, cells) in zip(values, lines, strict=True):
        if len(cells) != len(header):
            raise ParameterError(
                f"{path}, row {row}: expected {len(header)} cells as in the header, found {len(cells)}."
            )
        for i, place in enumerate(places):
            try:
                value[i] = float(cells[place])
            except ValueError:
                value[i] = math.nan
            if not math.isfinite(value[i]):
                raise ParameterError(
                    f"{path}, row {row}, column {columns[i]}: expected a finite number, found {cells[place]!r}."
                )
    return Cases(path, values, tuple(row for row, _ in lines))
