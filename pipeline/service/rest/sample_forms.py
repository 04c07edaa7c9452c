"""Samples of a trial in the form that a client takes."""

from __future__ import annotations

import io
from typing import Any

import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from fastapi.responses import JSONResponse, Response

from pipeline.records.tables import COLUMNS
from pipeline.service.problems import Problem


def form_of(accept: str) -> Any:
    """Return the writer of the first form that a client takes."""
    for kind in (part.partition(";")[0].strip().lower() for part in accept.split(",")):
        if kind in FORMS:
            return FORMS[kind]
        if kind in ("*/*", "application/*", ""):
            return _as_json
    raise Problem(406, "Samples have no such form.", where="Accept", expected=list(FORMS), found=accept)


def _as_json(about: dict[str, Any], table: pa.Table) -> Response:
    which = "unit_rotation" if about["motion"] == "rotation" else "unit"
    units = {name: getattr(COLUMNS[name], which) for name in table.column_names}
    columns = {name: [None if x != x else x for x in table.column(name).to_pylist()] for name in table.column_names}
    return JSONResponse({"trial": about, "units": units, "columns": columns})


def _as_bytes(write: Any, media: str) -> Any:
    def response(_about: dict[str, Any], table: pa.Table) -> Response:
        stream = io.BytesIO()
        write(table, stream)
        return Response(stream.getvalue(), media_type=media)

    return response


def _write_arrow(table: pa.Table, stream: io.BytesIO) -> None:
    with pa.ipc.new_stream(stream, table.schema) as writer:
        writer.write_table(table)


FORMS = {
    "application/json": _as_json,
    "text/csv": _as_bytes(pa_csv.write_csv, "text/csv; charset=utf-8"),
    "application/vnd.apache.parquet": _as_bytes(pq.write_table, "application/vnd.apache.parquet"),
    "application/vnd.apache.arrow.stream": _as_bytes(_write_arrow, "application/vnd.apache.arrow.stream"),
}
"""Forms of samples by their media type."""
