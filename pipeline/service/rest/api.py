"""REST: ``/api/v1/...``. Nothing is computed in a request; what is not stored yet is asked for as a job."""

import asyncio
import base64
import json
import time
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from pydantic import AfterValidator, BaseModel, Field
from starlette.concurrency import run_in_threadpool

from pipeline import __version__
from pipeline.records.against_records import AgainstResult
from pipeline.records.criteria import REPORTED
from pipeline.records.results import ComparisonResult
from pipeline.service.catalogue import SORTED, WORDS, Catalogue, Selection, page_of
from pipeline.service.database import ENDED
from pipeline.service.jobs import documents
from pipeline.service.problems import Problem
from pipeline.service.rest import answers
from pipeline.service.rest.sample_forms import FORMS, form_of
from pipeline.service.shared import ComparisonRequest, Service, Shared
from pipeline.service.uploads import Upload
from pipeline.store.names import name_of_folder

api = APIRouter(prefix="/api/v1", responses=answers.EVERYWHERE)

MOST = 1000
"""Items of a page."""

EVENTS = "text/event-stream"
EVENT = {"type": "object", "required": ["event", "data"], "properties": {"event": {}, "data": {"type": "string"}}}
EVENT_S = 0.3
"""Time between two looks at a job that somebody watches [s]."""

REPORT_POLICY = (
    "sandbox allow-scripts allow-popups allow-downloads; default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "script-src 'unsafe-inline'"
)

BACK = '<p class="layout"><a href="/reports">All reports</a> · <a href="/">Experiments</a></p>'
"""The way back from a report, which knows of no server."""

Limit = Annotated[int, Query(ge=1, le=MOST, description="Items of a page.")]
Name = Annotated[str, Query(max_length=500)]
CURSOR = "^[A-Za-z0-9_=-]+$"
Place = Annotated[str, Field(max_length=2000, pattern=CURSOR, description="`next_cursor` of the page before.")]
Cursor = Annotated[Place | None, Query(alias="cursor")]
Segment = Annotated[str, AfterValidator(name_of_folder)]
"""A name in an address: one with a slash or % is written as `names.folder_name` has it, and then quoted."""

Word = Annotated[str, Field(max_length=500)]
Asked = tuple[dict[str, Any] | None, str | None]
"""A document, or the job that makes it."""
FiniteNumber = Annotated[float, Field(allow_inf_nan=False)]
RANGES = ("stiffness_min", "stiffness_max", "damping_min", "damping_max")
"""Parts of a `TrialQuery` that bound properties."""


LOGS = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["files"],
                "properties": {
                    "files": {"type": "array", "minItems": 1, "items": {"type": "string", "format": "binary"}},
                    "profile": {"type": "string", "maxLength": 100},
                },
            }
        }
    },
}
"""Body of an upload; `uploads` reads it."""


def cursor(value: object) -> str | None:
    """Return a place in a list as a word for an address; None stays so."""
    return None if value is None else base64.urlsafe_b64encode(json.dumps(value).encode()).decode()


def place(word: str | None, kinds: tuple[type, ...]) -> Any:
    """Return the place that a cursor names: a list of parts of some kinds, or None."""
    if word is None:
        return None
    try:
        value = json.loads(base64.urlsafe_b64decode(word.encode()))
    except ValueError:
        value = None
    right = isinstance(value, list) and len(value) == len(kinds)
    if not right or not all(isinstance(part, kind) for part, kind in zip(value, kinds, strict=True)):
        raise Problem(400, "The cursor is none of this list. Begin without one.", where="cursor")
    return value


def numbered(word: str | None) -> int:
    """Return the number below which a list goes on, by its cursor."""
    before: int = (place(word, (int,)) or [2**62])[0]
    if not 0 <= before < 2**63:
        raise Problem(400, "The cursor is none of this list. Begin without one.", where="cursor")
    return before


class TrialQuery(BaseModel):
    """Which trials are asked for, and in which order."""

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
    limit: Annotated[int, Field(ge=1, le=MOST, description="Items of a page.")] = 100
    cursor: Place | None = None


def trial_list(catalogue: Catalogue, query: TrialQuery) -> dict[str, Any]:
    """Return a page of trials with facets, as the API and the pages show it."""
    name = query.sort.lstrip("-")
    texts = name in (*WORDS, "uploader")
    kind = (type(None),) if name == "id" else (str, type(None)) if texts else (float, int, type(None))
    after = place(query.cursor, (kind, str))  # type: ignore[arg-type]
    given = {key: value for key, value in query if value not in ("", None)}
    words = {key: None if given[key] == "none yet" else given[key] for key in WORDS if key in given}
    chosen = Selection(words, {key: given[key] for key in RANGES if key in given}, query.q)
    total, facets = catalogue.selected(chosen)
    items, more = catalogue.page(chosen, query.sort, query.limit, after)
    last = items[-1] if more else {}
    at = last.get("costs", {}).get(name, {}).get("value") if name in REPORTED else last.get(name)
    following = cursor([None if name == "id" else at, last["id"]]) if more else None
    return {"items": items, "next_cursor": following, "total": total, "facets": facets}


@api.get("/health", response_model=answers.Health)
def health(service: Shared) -> dict[str, Any]:
    """Tell that the server answers, and how many jobs are in which state."""
    jobs = service.database.job_counts()
    return {"state": "ok", "version": __version__, "read_only": service.settings.read_only, "jobs": jobs}


@api.get("/devices", response_model=answers.Page[answers.Device])
def devices(service: Shared, limit: Limit = 100, cursor_: Cursor = None) -> dict[str, Any]:
    """List the devices that have trials."""
    items, last = page_of(service.catalogue.devices, ("device",), limit, place(cursor_, (str,)))
    return {"items": items, "next_cursor": cursor(last)}


@api.get("/experiments", response_model=answers.Page[answers.Experiment])
def experiments(
    service: Shared,
    device: Name | None = None,
    limit: Limit = 100,
    cursor_: Cursor = None,
) -> dict[str, Any]:
    """List the experiments, of one device where one is named."""
    all_ = [e for e in service.catalogue.experiments if device in (None, e["device"])]
    items, last = page_of(all_, ("device", "experiment"), limit, place(cursor_, (str, str)))
    return {"items": items, "next_cursor": cursor(last)}


@api.get("/trials", response_model=answers.TrialPage)
def trials(service: Shared, asked: Annotated[TrialQuery, Query()]) -> Response:
    """List trials by their properties, with how many there are of each."""
    all_ = service.catalogue
    content = all_.once(f"document {asked.model_dump_json()}", lambda: JSONResponse(trial_list(all_, asked)).body)
    return Response(content, media_type=JSONResponse.media_type)


@api.get("/trials/{trial}", response_model=answers.NotedTrial, responses=answers.NAMED)
def one_trial(service: Shared, trial: str) -> dict[str, Any]:
    """Return a trial: conditions, verdict, costs, notes and tags."""
    words = {kind: service.database.words(kind, ["trial", trial])["value"] for kind in ("notes", "tags")}
    return {**service.found(trial), **words}


@api.get(
    "/trials/{trial}/samples",
    response_model=answers.Samples,
    responses={200: {"content": {kind: {} for kind in FORMS}}, **answers.problems(404, 406)},
)
def samples(service: Shared, trial: str, request: Request) -> Response:
    """Return the samples of a trial in the form that Accept names."""
    write = form_of(request.headers.get("accept", "*/*"))
    about, table = service.samples(trial)
    response: Response = write(about, table)
    return response


@api.post("/logs", status_code=202, response_model=answers.Accepted, openapi_extra={"requestBody": LOGS})
async def logs(service: Shared, request: Request) -> dict[str, Any]:
    """Store uploaded logs and queue their ingest."""
    return await receive(service, request)


@api.get("/jobs", response_model=answers.Page[answers.Job])
def jobs(service: Shared, limit: Limit = 100, cursor_: Cursor = None) -> dict[str, Any]:
    """List jobs, the latest first."""
    found = service.database.jobs(numbered(cursor_), limit + 1)
    last = [found[limit - 1]["number"]] if len(found) > limit else None
    return {"items": found[:limit], "next_cursor": cursor(last)}


@api.get("/jobs/{job}", response_model=answers.Job, responses=answers.NAMED)
def one_job(service: Shared, job: str) -> dict[str, Any]:
    """Return a job: its state, progress and result."""
    shown = service.database.job(job)
    if shown is None:
        raise Problem(404, "There is no such job.", where="job", found=job)
    return shown


@api.delete("/jobs/{job}", response_model=answers.Job, responses=answers.NAMED)
def cancel(service: Shared, request: Request, job: str) -> dict[str, Any]:
    """Cancel a job that has not ended; for who asked for it, and admins."""
    cancel_job(service, job, request.state.role, request.state.who)
    return one_job(service, job)


@api.get(
    "/jobs/{job}/events",
    response_class=StreamingResponse,
    responses={200: {"description": "Events.", "content": {EVENTS: {"schema": EVENT}}}, **answers.NAMED},
)
async def events(service: Shared, job: str, request: Request) -> StreamingResponse:
    """Tell each change of a job as a server-sent event, to its end."""
    await run_in_threadpool(one_job, service, job)

    async def told() -> AsyncIterator[str]:
        former = None
        while not await request.is_disconnected():
            shown = await run_in_threadpool(one_job, service, job)
            if shown != former:
                yield f"event: {shown['state']}\ndata: {json.dumps(shown)}\n\n"
            former = shown
            if shown["state"] in ENDED:
                return
            await asyncio.sleep(EVENT_S)

    return StreamingResponse(told(), media_type=EVENTS)


@api.post(
    "/comparisons",
    response_model=answers.Made,
    responses={202: {"description": "A job makes it.", "model": answers.QueuedComparison}, **answers.NAMED},
)
def compare(service: Shared, request: Request, asked: ComparisonRequest) -> JSONResponse:
    """Ask for a comparison; one that is there is named at once."""
    key, job = service.comparison(asked, request.state.who)
    return JSONResponse({"key": key}) if job is None else JSONResponse({"job": job, "key": key}, 202)


@api.get("/comparisons", response_model=list[answers.Comparison])
def comparisons(service: Shared) -> list[dict[str, Any]]:
    """List the comparisons that were made, the latest first; of equal ones the newest."""
    found: dict[str, dict[str, Any]] = {}
    for job in service.database.reports(MOST):
        asked = job["request"].get("asked") or {}
        shown = {"key": job["result"]["key"], "made": job["changed"], "author": job["author"], "asked": asked}
        found.setdefault(json.dumps(asked), shown)
    return list(found.values())


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
        responses={202: {"description": "It takes longer.", "model": answers.Queued}, **answers.NAMED},
        description=f"Return the {part} of an experiment; 202 with a job where it is not computed in time.",
    )
    async def experiment_part(service: Shared, device: Segment, experiment: Segment) -> Response:
        document, job = await experiment_document(service, device, experiment)
        if document is None:
            return later(job)
        return JSONResponse(part_of(document, part))


for part, shape in answers.PARTS.items():
    _add_part(part, shape)


async def experiment_document(
    service: Service, device: str, experiment: str
) -> tuple[dict[str, Any] | None, str | None]:
    """Return the document of an experiment, or the job that makes it where that takes long."""
    return await awaited(service, lambda: service.experiment(device, experiment), f"{device}, experiment {experiment}")


async def awaited(service: Service, ask: Callable[[], Asked], where: str) -> Asked:
    """Return a document, or the job that makes it where that takes long."""
    document, job = await run_in_threadpool(ask)
    until = time.monotonic() + service.settings.wait_s
    while document is None and time.monotonic() < until:
        assert job is not None, "there is a document or a job"
        shown = await run_in_threadpool(service.database.job, job)
        if shown is not None and shown["state"] in ENDED:
            if shown["problem"]:
                raise Problem(503, shown["problem"]["detail"], where=where)
            document, job = await run_in_threadpool(ask)
        else:
            await asyncio.sleep(0.1)
    return document, job


def later(job: str | None) -> Response:
    """Return the answer where a job takes longer than a request waits."""
    return JSONResponse({"job": job}, 202, {"Retry-After": "5", "Location": f"/api/v1/jobs/{job}"})


def cancel_job(service: Service, job: str, role: str, who: str) -> None:
    """Cancel a job; only who asked for it may, and an admin."""
    shown = one_job(service, job)
    if role != "admin" and shown["author"] != who:
        raise Problem(403, "Only who asked for a job, or an admin, cancels it.", expected=shown["author"], found=who)
    service.database.cancel(job)
    service.database.note(who, "cancelled", {"job": job, "kind": shown["kind"]})


async def receive(service: Service, request: Request, check: Any = lambda _: None) -> dict[str, Any]:
    """Store the logs of a request and queue their job; `check` looks at the fields of the form before."""
    upload = Upload(service.settings)
    try:
        await upload.receive(request)
        check(upload.fields)
        accepted = await run_in_threadpool(upload.accept, service.database, request.state.who)
    except BaseException:
        upload.discard()
        raise
    service.workers.wake()
    return accepted


def part_of(document: dict[str, Any], part: str) -> Any:
    """Return a part of an experiment's document."""
    (found,) = document["experiments"]
    if part == "causes":
        return document["causes"][found["experiment"]]
    return found["optimum" if part == "optima" else part]


def _file(service: Service, key: str, ending: str, media: str) -> Response:
    """Return a file of a comparison; the scripts of a page run as those of a site of its own."""
    file = documents.document_file(service.settings, key, report=True).with_suffix(ending)
    if not file.is_file():
        raise Problem(404, "There is no such comparison. POST comparisons makes one.", where="key", found=key)
    if ending == ".json":
        return FileResponse(file, media_type=media)
    whole = file.read_text("utf-8").replace("<body>", f"<body>{BACK}", 1)
    return HTMLResponse(whole, headers={"content-security-policy": REPORT_POLICY})
