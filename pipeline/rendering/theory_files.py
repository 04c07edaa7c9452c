"""Write results of theory to files, as rows in CSV or Parquet and as a figure of walls over stiffness and damping."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.disk import replacing
from pipeline.base.errors import UsageError
from pipeline.base.paths import check_output
from pipeline.base.provenance import stamp
from pipeline.rendering.figures.drawing import PICTURES, Figure, Panel, Series, write_picture
from pipeline.rendering.labels import UNITS
from pipeline.theory.cases import Boundary, Case, Optimum, PointCosts, limits_of_walls

TABLES = ("csv", "parquet")
"""File extensions for rows."""


def check_files(out: Path | None, picture: Path | None) -> None:
    """Check, before any computation, that files have valid extensions and can be written.

    Raises
    ------
    UsageError
        If a file has another extension or is a folder.
    PipelineError
        If a folder is not writable.
    """
    for path, option, endings in ((out, "--out", TABLES), (picture, "--picture", PICTURES)):
        if path is None:
            continue
        if path.suffix.lower().removeprefix(".") not in endings:
            known = f".{', .'.join(endings[:-1])} or .{endings[-1]}"
            raise UsageError(f"{option} {path}: expected a name that ends with {known}.")
        check_output(path, option)


def unit_of(case: Case | None, name: str) -> str:
    """Return the unit of a result column, which is 1 if the column has no unit."""
    if case is not None and case.motion is not None and name.startswith(case.axes):
        return str(getattr(UNITS[case.motion], name.split("_")[0]))
    return "samples" if name.startswith(("settle", "rise_time")) else "1"


def write_rows(path: Path, columns: Mapping[str, Sequence[Any]], case: Case | None = None) -> None:
    """Write columns as CSV, or as Parquet with their units. A missing number is an empty cell in CSV and null in
    Parquet.

    Parameters
    ----------
    path : Path
        Ends with .csv or .parquet.
    columns : mapping of sequence
        Columns by name, all of equal length.
    case : Case, optional
        Case that determines the units of walls. Normalised walls have no units.
    """
    if path.suffix.lower() == ".csv":
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([list(columns), *zip(*columns.values(), strict=True)])
        content = text.getvalue().encode()
    else:
        import pyarrow as pa
        import pyarrow.parquet as pq

        from pipeline.records.table_files import WRITING

        arrays = [pa.array(list(values)) for values in columns.values()]
        fields = [
            pa.field(
                name,
                pa.string() if pa.types.is_null(array.type) else array.type,
                metadata={"unit": unit_of(case, name)},
            )
            for name, array in zip(columns, arrays, strict=True)
        ]
        schema = pa.schema(fields, metadata=dict(stamp()))
        sink = io.BytesIO()
        pq.write_table(pa.table([a.cast(f.type) for a, f in zip(arrays, fields, strict=True)], schema), sink, **WRITING)
        content = sink.getvalue()
    with replacing(path) as stream:
        stream.write(content)


def limit_series(case: Case, points: int = 400) -> Series:
    """Return the limit of walls as a series to draw."""
    limits = limits_of_walls(case, points)
    return Series("limit of stability", "edge", limits.stiffness, limits.damping)


def robust_series(answer: Boundary) -> Series:
    """Return the limit of the walls that are stable with every spring, as a series to draw."""
    return Series("stable with every spring", "robust", answer.stiffness, answer.damping)


def point_series(answer: PointCosts) -> Iterator[Series]:
    """Yield stable and unstable walls as series to draw."""
    for kind, some in (("stable", answer.stable), ("unstable", ~answer.stable)):
        if some.any():
            yield Series(kind, kind, answer.walls[some, 0], answer.walls[some, 1])


def optimum_series(answer: Optimum) -> Series:
    """Return the best wall as a series to draw."""
    return Series(answer.criterion, "optimum", np.array([answer.stiffness]), np.array([answer.damping]))


def draw_walls(path: Path, title: str, case: Case, series: Sequence[Series]) -> None:
    """Draw walls as SVG, PDF or PNG. As in the thesis, the stiffness is on the abscissa."""
    units = [unit_of(case, name) for name in case.axes]
    names = [name if unit == "1" else f"{name} [{unit}]" for name, unit in zip(case.axes, units, strict=True)]
    words = [f"{each.label}: {len(each.x)} points" for each in series]
    top = max((float(np.nanmax(each.x)) for each in series if len(each.x)), default=1.0)
    floor = min((float(np.nanmin(each.x)) for each in series if len(each.x)), default=0.0)
    limits = (min(0.0, floor), 1.05 * top if top > 0 else 1.0), None
    panel = Panel("", (names[0], names[1]), tuple(series), f"{title}. {'; '.join(words)}.", limits)
    write_picture(Figure("boundaries", "walls", title, "", (panel,)), path)
