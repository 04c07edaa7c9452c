"""REST of samples, in the form that a client takes."""

import io
from collections.abc import Callable
from typing import Literal

import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response

from pipeline.records.tables import COLUMNS
from pipeline.service.problems import Problem
from pipeline.service.rest import answers
from pipeline.service.shared import Shared

samples = APIRouter(prefix="/api/v1", responses=answers.EVERYWHERE)


def _write_arrow(table: pa.Table, stream: io.BytesIO) -> None:
    with pa.ipc.new_stream(stream, table.schema) as writer:
        writer.write_table(table)


FORMS: dict[str, tuple[str, Callable[[pa.Table, io.BytesIO], object] | None]] = {
    "json": ("application/json", None),
    "csv": ("text/csv", pa_csv.write_csv),
    "parquet": ("application/vnd.apache.parquet", pq.write_table),
    "arrows": ("application/vnd.apache.arrow.stream", _write_arrow),
}
"""Media type and writer of each form of samples."""

MEDIA = {media: form for form, (media, _) in FORMS.items()} | dict.fromkeys(("*/*", "application/*", ""), "json")


@samples.get(
    "/trials/{trial}/samples",
    response_model=answers.Samples,
    responses={200: {"content": {media: {} for media, _ in FORMS.values()}}, **answers.problems(404, 406)},
)
def of_trial(
    service: Shared,
    request: Request,
    trial: str,
    format: Literal[tuple(FORMS)] | None = None,  # type: ignore[valid-type]
) -> Response:
    """Return the samples of a trial in the form that Accept names; by `format` as a file to keep."""
    accept = request.headers.get("accept", "*/*")
    taken = [format] if format else [MEDIA.get(one.partition(";")[0].strip().lower()) for one in accept.split(",")]
    form = next(filter(None, taken), None)
    if form is None:
        raise Problem(406, "Samples have no such form.", where="Accept", expected=list(MEDIA), found=accept)
    about, table = service.samples(trial)
    headers = {"content-disposition": f'attachment; filename="{about["id"]}.{form}"'} if format else None
    media, write = FORMS[form]
    if write is not None:
        stream = io.BytesIO()
        write(table, stream)
        return Response(stream.getvalue(), headers=headers, media_type=media)
    which = "unit_rotation" if about["motion"] == "rotation" else "unit"
    units = {name: getattr(COLUMNS[name], which) for name in table.column_names}
    columns = {name: [None if x != x else x for x in table.column(name).to_pylist()] for name in table.column_names}
    return JSONResponse({"trial": about, "units": units, "columns": columns}, headers=headers)
