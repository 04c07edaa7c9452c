"""REST: ``/api/v1/...``. Nothing is computed in a request; missing results are requested as jobs."""

import asyncio
import base64
import io
import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import Annotated, Any, Literal, TypeVar

import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from pydantic import AfterValidator, BaseModel, Field
from starlette.concurrency import run_in_threadpool

from pipeline.base.json_object import JsonObject
from pipeline.base.provenance import __version__
from pipeline.records.results import AgainstResult, ComparisonResult
from pipeline.records.tables import COLUMNS, unit_of_column
from pipeline.service import documents
from pipeline.service.catalogue import SORTED, WORDS, Catalogue, Device, Experiment, Selection
from pipeline.service.database import NEWEST, Job
from pipeline.service.problems import Later, Problem
from pipeline.service.rest import answers
from pipeline.service.shared import MOST_REPORTS, ComparisonRequest, Kept, Service, Shared, Who
from pipeline.service.uploads import Accepted, Check, received
from pipeline.store.names import name_of_folder
from pipeline.store.storage import natural_key

api = APIRouter(prefix="/api/v1", responses=answers.EVERYWHERE)

MOST = 1000
"""Number of items on a page."""

EVENTS = "text/event-stream"
EVENT = {"type": "object", "required": ["event", "data"], "properties": {"event": {}, "data": {"type": "string"}}}
EVENT_S = 0.3
"""Polling interval for a job that a user watches [s]."""

REPORT_POLICY = (
    "sandbox allow-scripts allow-popups allow-downloads; default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "script-src 'unsafe-inline'"
)

BACK = (
    '<p style="margin: 0; padding: .75rem 1.25rem 0"><a href="/reports">All reports</a> · '
    '<a href="/">Experiments</a></p>'
)
"""Link back to the pages, added to a report because a report has no reference to a server."""

Limit = Annotated[int, Query(ge=1, le=MOST, description="Number of items on a page.")]
Name = Annotated[str, Query(max_length=500)]
CURSOR = "^[A-Za-z0-9_=-]+$"
Place = Annotated[str, Field(max_length=2000, pattern=CURSOR, description="`next_cursor` of the previous page.")]
Cursor = Annotated[Place | None, Query(alias="cursor")]
Segment = Annotated[str, AfterValidator(name_of_folder)]
"""A name in an address: a name with a slash or % is converted by `names.folder_name` and then quoted."""

Word = Annotated[str, Field(max_length=500)]
FiniteNumber = Annotated[float, Field(allow_inf_nan=False)]
RANGES = ("stiffness_min", "stiffness_max", "damping_min", "damping_max")
"""Fields of a `TrialQuery` that limit the range of properties."""


def files_of(**fields: JsonObject) -> JsonObject:
    """Return the schema of a form with files and other fields, which `uploads` reads."""
    files = {"type": "array", "minItems": 1, "items": {"type": "string", "format": "binary"}}
    schema = {"type": "object", "required": ["files"], "properties": {"files": files, **fields}}
    return {"requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}}


LOGS = files_of(profile={"type": "string", "maxLength": 100})


def cursor(value: object) -> str | None:
    """Return a place in a list, encoded for an address. None stays None."""
    return None if value is None else base64.urlsafe_b64encode(json.dumps(value).encode()).decode()


def place(word: str | None, kinds: tuple[type, ...]) -> Any:
    """Return the place that a cursor encodes: a list with items of the given types. None stays None."""
    if word is None:
        return None
    with suppress(ValueError):
        value = json.loads(base64.urlsafe_b64decode(word.encode()))
        if isinstance(value, list) and len(value) == len(kinds) and all(map(isinstance, value, kinds)):
            return value
    raise Problem(400, "The cursor does not belong to this list. Start without a cursor.", where="cursor")


def latest(
    read: Callable[[int, int], tuple[list[answers.Item], int | None]], limit: int, word: str | None
) -> answers.Page[answers.Item]:
    """Return a page of a list ordered by number (`Database.latest`), and the cursor of the next page."""
    items, last = read((place(word, (int,)) or [NEWEST])[0], limit)
    return answers.Page(items=items, next_cursor=cursor(None if last is None else [last]))


Named = TypeVar("Named", Device, Experiment)


def parted(items: list[Named], names: tuple[str, ...], limit: int, word: str | None) -> answers.Page[Named]:
    """Return the page after a cursor of a list sorted by names, and the cursor of the next page."""
    after = place(word, (str,) * len(names))
    keys = [tuple(natural_key(getattr(item, name)) for name in names) for item in items]
    behind = None if after is None else tuple(map(natural_key, after))
    left = [item for item, key in zip(items, keys, strict=True) if behind is None or key > behind]
    last = [getattr(left[limit - 1], name) for name in names] if len(left) > limit else None
    return answers.Page(items=left[:limit], next_cursor=cursor(last))


class TrialQuery(BaseModel):
    """Selection and order of requested trials."""

    device: Word | None = None
    experiment: Word | None = None
    verdict: Word | None = None
    outcome: Word | None = None
    stiffness_min: FiniteNumber | None = None
    stiffness_max: FiniteNumber | None = None
    damping_min: FiniteNumber | None = None
    damping_max: FiniteNumber | None = None
    q: Word = ""
    sort: Literal[SORTED] = "id"  # type: ignore[valid-type]
    limit: Annotated[int, Field(ge=1, le=MOST, description="Number of items on a page.")] = 100
    cursor: Place | None = None


def trial_list(catalogue: Catalogue, query: TrialQuery, limit: int, word: str | None) -> answers.TrialPage:
    """Return a page of trials with facets, as the API and the pages show it.

    The page has at most ``limit`` trials, starting at the cursor ``word``.
    """
    name = query.sort.lstrip("-")
    texts = name in (*WORDS, "uploader")
    kind = (type(None),) if name == "id" else (str, type(None)) if texts else (float, int, type(None))
    after = place(word, (kind, str))  # type: ignore[arg-type]
    given = {key: value for key, value in query if value not in ("", None)}
    words = {key: None if given[key] == "none yet" else given[key] for key in WORDS if key in given}
    chosen = Selection(words, {key: given[key] for key in RANGES if key in given}, query.q)
    total, facets = catalogue.selected(chosen)
    items, more = catalogue.page(chosen, query.sort, limit, after)
    following = cursor([None if name == "id" else items[-1].number_or_word(name), items[-1].id]) if more else None
    return answers.TrialPage(items=items, next_cursor=following, total=total, facets=facets)


@api.get("/health")
def health(service: Shared) -> answers.Health:
    """Report that the server answers, and the number of jobs in each state."""
    jobs, read_only = service.database.job_counts(), service.settings.read_only
    return answers.Health(state="ok", version=__version__, read_only=read_only, jobs=jobs)


@api.get("/devices")
def devices(service: Shared, limit: Limit = 100, cursor_: Cursor = None) -> answers.Page[Device]:
    """List the devices that have trials."""
    return parted(service.catalogue.devices, ("device",), limit, cursor_)


@api.get("/experiments")
def experiments(
    service: Shared, device: Name | None = None, limit: Limit = 100, cursor_: Cursor = None
) -> answers.Page[Experiment]:
    """List the experiments of one device or of all devices."""
    items = [e for e in service.catalogue.experiments if device in (None, e.device)]
    return parted(items, ("device", "experiment"), limit, cursor_)


@api.get("/trials", response_model=answers.TrialPage)
def trials(service: Shared, asked: Annotated[TrialQuery, Query()]) -> Response:
    """List trials by their properties, with the number of trials for each property."""
    all_ = service.catalogue
    content = all_.once(
        f"document {asked.model_dump_json()}",
        lambda: trial_list(all_, asked, asked.limit, asked.cursor).model_dump_json(),
    )
    return Response(content, media_type=JSONResponse.media_type)


@api.get("/trials/{trial}", responses=answers.NAMED)
def one_trial(service: Shared, trial: str) -> answers.NotedTrial:
    """Return a trial with its conditions, verdict, costs, notes and tags."""
    return answers.NotedTrial(
        **dict(service.found(trial)), notes=service.database.words("notes", ["trial", trial]).value
    )


def _write_arrow(table: pa.Table, stream: io.BytesIO) -> None:
    with pa.ipc.new_stream(stream, table.schema) as writer:
        writer.write_table(table)


FORMS: dict[str, tuple[str, Callable[[pa.Table, io.BytesIO], object] | None]] = {
    "json": ("application/json", None),
    "csv": ("text/csv", pa_csv.write_csv),
    "parquet": ("application/vnd.apache.parquet", pq.write_table),
    "arrows": ("application/vnd.apache.arrow.stream", _write_arrow),
}
"""Media type and writer of each format of samples."""

MEDIA = {media: form for form, (media, _) in FORMS.items()} | dict.fromkeys(("*/*", "application/*", ""), "json")


@api.get(
    "/trials/{trial}/samples",
    response_model=answers.Samples,
    responses={200: {"content": {media: {} for media, _ in FORMS.values()}}, **answers.problems(404, 406)},
)
def samples(
    service: Shared,
    request: Request,
    trial: str,
    format: Literal[tuple(FORMS)] | None = None,  # type: ignore[valid-type]
) -> Response:
    """Return the samples of a trial in the format of the Accept header, or with `format` as a download."""
    accept = request.headers.get("accept", "*/*")
    taken = [format] if format else [MEDIA.get(one.partition(";")[0].strip().lower()) for one in accept.split(",")]
    form = next(filter(None, taken), None)
    if form is None:
        raise Problem(
            406, "Samples are not available in this format.", where="Accept", expected=list(MEDIA), found=accept
        )
    about, table = service.samples(trial)
    headers = {"content-disposition": f'attachment; filename="{about.id}.{form}"'} if format else None
    media, write = FORMS[form]
    if write is not None:
        stream = io.BytesIO()
        write(table, stream)
        return Response(stream.getvalue(), headers=headers, media_type=media)
    units = {name: unit_of_column(COLUMNS[name], about.motion) for name in table.column_names}
    columns = {name: [None if x != x else x for x in table.column(name).to_pylist()] for name in table.column_names}
    document = answers.Samples(trial=about, units=units, columns=columns).model_dump_json()
    return Response(document, headers=headers, media_type=media)


@api.post("/logs", status_code=202, openapi_extra=LOGS)
async def logs(service: Shared, request: Request) -> Accepted:
    """Store uploaded logs and queue their ingest."""
    return await receive(service, request)


@api.get("/jobs")
def jobs(service: Shared, limit: Limit = 100, cursor_: Cursor = None) -> answers.Page[Job]:
    """List jobs, latest first."""
    return latest(service.database.jobs, limit, cursor_)


@api.get("/jobs/{job}", responses=answers.NAMED)
def one_job(service: Shared, job: str) -> Job:
    """Return a job with its state, progress and result."""
    shown = service.database.job(job)
    if shown is None:
        raise Problem(404, "There is no such job.", where="job", found=job)
    return shown


@api.delete("/jobs/{job}", responses=answers.NAMED)
def cancel(service: Shared, request: Request, job: str) -> Job:
    """Cancel a job that has not ended. Permitted for the user who requested the job, and for admins."""
    shown, who = one_job(service, job), request.state.who
    if request.state.role != "admin" and shown.author != who:
        raise Problem(
            403,
            "Only the user who requested a job, or an administrator, can cancel it.",
            expected=shown.author,
            found=who,
        )
    service.database.cancel(job)
    service.database.note(who, "cancelled", {"job": job, "kind": shown.kind})
    return one_job(service, job)


@api.get(
    "/jobs/{job}/events",
    response_class=StreamingResponse,
    responses={200: {"description": "Events.", "content": {EVENTS: {"schema": EVENT}}}, **answers.NAMED},
)
async def events(service: Shared, job: str, request: Request) -> StreamingResponse:
    """Send each change of a job as a server-sent event, until the job ends."""
    await run_in_threadpool(one_job, service, job)

    async def told() -> AsyncIterator[str]:
        former = None
        while not await request.is_disconnected():
            shown = await run_in_threadpool(one_job, service, job)
            if shown != former:
                yield f"event: {shown.state}\ndata: {shown.model_dump_json(exclude_unset=True)}\n\n"
            former = shown
            if shown.has_ended:
                return
            await asyncio.sleep(EVENT_S)

    return StreamingResponse(told(), media_type=EVENTS)


@api.post(
    "/comparisons",
    response_model=answers.Made,
    responses={202: {"description": "A job makes it.", "model": answers.Queued}, **answers.NAMED},
)
def compare(service: Shared, who: Who, asked: ComparisonRequest) -> JSONResponse:
    """Request a comparison. An existing comparison is returned immediately."""
    key, job = service.comparison(asked, who)
    return JSONResponse({"key": key}) if job is None else JSONResponse({"job": job, "key": key}, 202)


@api.get("/comparisons")
def comparisons(service: Shared) -> list[answers.Comparison]:
    """List finished comparisons, latest first. Of equal comparisons, only the newest is listed."""
    jobs = [job for job, earlier in service.database.reports(MOST_REPORTS) if not earlier]
    return [
        answers.Comparison(key=j.result["key"], made=j.changed, author=j.author, asked=j.request["asked"]) for j in jobs
    ]


@api.get("/comparisons/{key}", response_model=ComparisonResult | AgainstResult, responses=answers.NAMED)
def comparison(service: Shared, key: Annotated[str, Path(pattern="^[0-9a-f]{16}$")]) -> Response:
    """Return the document of a comparison."""
    return _file(service, key, ".json", "application/json")


@api.get("/comparisons/{key}/report", response_class=HTMLResponse, responses=answers.NAMED)
def report(service: Shared, key: Annotated[str, Path(pattern="^[0-9a-f]{16}$")]) -> Response:
    """Return the page of a comparison."""
    return _file(service, key, ".html", "text/html; charset=utf-8")


def _add_part(part: str, shape: Any) -> None:
    """Add the route of a part of an experiment's documents."""

    @api.get(
        f"/experiments/{{device}}/{{experiment}}/{part}",
        response_model=shape,
        responses=answers.LATER,
        description=f"Return the {part} of an experiment, or 202 with a job if the result is not computed in time.",
    )
    async def experiment_part(service: Shared, device: Segment, experiment: Segment) -> Response:
        document = await awaited(service, lambda: service.experiment(device, experiment))
        found = document["causes"] if part == "causes" else document["experiments"][0]
        name = {"causes": experiment, "optima": "optimum"}.get(part, part)
        return JSONResponse(found[name])


for part, shape in answers.PARTS.items():
    _add_part(part, shape)


async def awaited(service: Service, ask: Callable[[], Kept]) -> JsonObject:
    """Return a document if it is stored or computed in time. Otherwise, raise `Later` with the job that computes it."""
    until = time.monotonic() + service.settings.wait_s
    while True:
        document, job = await run_in_threadpool(ask)
        if document is not None or job is None:
            return document or {}
        while not (shown := await run_in_threadpool(one_job, service, job)).has_ended:
            if time.monotonic() > until:
                raise Later(job)
            await asyncio.sleep(0.1)
        if shown.problem:
            status = shown.problem.status  # a defect of a job is shown with the job and has no status here
            raise Problem(503 if status == 500 else status, shown.problem.detail, where="job", found=job)


async def receive(service: Service, request: Request, check: Check = lambda _: None) -> Accepted:
    """Store the logs of a request and queue their job."""
    async with received(service.settings, request, check) as upload:
        accepted = await run_in_threadpool(upload.accept, service.database, request.state.who)
    service.workers.wake()
    return accepted


def _file(service: Service, key: str, ending: str, media: str) -> Response:
    """Return a file of a comparison. The scripts of a page run in isolation, like those of a different site."""
    file = documents.document_file(service.settings, key, report=True).with_suffix(ending)
    if not file.is_file():
        raise Problem(404, "There is no such comparison. Request one with POST comparisons.", where="key", found=key)
    if ending == ".json":
        return FileResponse(file, media_type=media)
    whole = file.read_text("utf-8").replace("<body>", f"<body>{BACK}", 1)
    return HTMLResponse(whole, headers={"content-security-policy": REPORT_POLICY})
