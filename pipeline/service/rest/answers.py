"""Answers of the API, for its schema: a record of each document, and the problems that any route may return."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, Generic, Literal, TypeVar

from fastapi import FastAPI, Request
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, ConfigDict

from pipeline.records.findings import BoundaryPoint, Estimate, Optimum
from pipeline.records.results import Cause
from pipeline.service.problems import MEDIA, TITLES, Problem

Item = TypeVar("Item")


class Answer(BaseModel):
    """Base of all answers; an undeclared field is a defect."""

    model_config = ConfigDict(extra="forbid")


class Page(Answer, Generic[Item]):
    """A page of a list; without `next_cursor` the last one."""

    items: list[Item]
    next_cursor: str | None


class Health(Answer):
    """State of the server, and numbers of jobs by state."""

    state: Literal["ok"]
    version: str
    read_only: bool
    jobs: dict[str, int]


class Device(Answer):
    """A device that has trials."""

    device: str
    experiments: int
    trials: int


class Experiment(Answer):
    """An experiment, with numbers of its trials by verdict, and the time of its last log."""

    device: str
    experiment: str
    motion: str
    trials: int
    verdicts: dict[str, int]
    last: float


class Cost(Answer):
    """A cost with its 95 % interval."""

    value: float
    low: float | None
    high: float | None


class RecordingFinding(Answer):
    """A fault of the recording of a trial: kind, place, evidence, remedy, and the sentence shown on pages."""

    code: str
    first_row: int | None
    rows: int
    evidence: str
    remedy: str
    severity: str
    sentence: str


class Trial(Answer):
    """A trial; stiffness and damping in SI. A trial ``excluded`` by hand (with the reason) has that word as verdict."""

    id: str
    device: str
    experiment: str
    verdict: str | None
    outcome: str | None
    motion: str
    grip: str | None
    excluded: str | None
    stiffness: float | None
    damping: float | None
    costs: dict[str, Cost]
    source: str
    recorded: float
    uploader: str | None
    findings: list[RecordingFinding]
    tags: list[str]


class NotedTrial(Trial):
    """A trial with its notes and tags."""

    notes: str


class Written(Answer):
    """Author and time of the last change."""

    author: str | None
    changed: float | None


class WrittenNotes(Written):
    """A text on a trial or experiment."""

    text: str


class WrittenTags(Written):
    """Short words on a trial or experiment."""

    tags: list[str]


class TrialPage(Page[Trial]):
    """A page of a list of trials, with the total number, and the number for each property."""

    total: int
    facets: dict[str, dict[str, int]]


class Samples(Answer):
    """Samples of a trial, columns in SI; null if a row has none."""

    trial: Trial
    units: dict[str, str]
    columns: dict[str, list[float | None]]


class ProblemDocument(BaseModel):
    """Reason why a request failed (RFC 9457)."""

    model_config = ConfigDict(extra="allow")
    title: str
    status: int
    detail: str
    type: str = "about:blank"
    where: str | None = None
    expected: Any = None
    found: Any = None


class Job(Answer):
    """A job; `result` is null until it is done, `problem` until it failed."""

    id: str
    number: int
    kind: str
    author: str
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    created: float
    changed: float
    request: dict[str, Any]
    progress: Any
    result: Any
    problem: ProblemDocument | None


class UploadedFile(Answer):
    """Outcome for a file of an upload."""

    name: str
    size: int
    sha256: str
    state: Literal["queued", "skipped"]


class Accepted(Answer):
    """An upload that is stored, and the job that ingests it."""

    job: str
    files: list[UploadedFile]


class Queued(Answer):
    """The job that makes the requested document, and the future key of a comparison."""

    job: str
    key: str | None = None


class Made(Answer):
    """The key of an existing comparison."""

    key: str


class Comparison(Answer):
    """A finished comparison: key, time, user and request."""

    key: str
    made: float
    author: str
    asked: dict[str, Any]


class Deleted(Answer):
    """A trial in the bin."""

    trial_id: str
    device: str
    experiment: str
    source: str


class Deed(Answer):
    """A manual action, with its time and user."""

    number: int
    time: float
    who: str
    did: str
    what: dict[str, Any]


class Draft(Answer):
    """A drafted profile as TOML, its open questions with line and key, and the name of the sample for previews."""

    sample: str
    profile: str
    questions: list[dict[str, Any]]


class Refused(Answer):
    """A refused log."""

    id: str
    name: str
    since: float
    author: str | None
    row: int | None
    reason: str
    code: str | None
    profile: str | None
    profile_line: str | None


PARTS: dict[str, Any] = {
    "estimates": dict[str, Estimate],
    "boundary": list[BoundaryPoint],
    "optima": dict[str, Optimum],
    "causes": list[Cause],
}
"""Parts of an experiment's document, with a description of each."""


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return answers by status that are problem documents, for the schema of a route."""
    schema = {"$ref": f"#/components/schemas/{ProblemDocument.__name__}"}
    return {status: {"description": TITLES[status], "content": {MEDIA: {"schema": schema}}} for status in statuses}


EVERYWHERE = problems(400, 401, 403, 408, 409, 413, 422, 429, 503, 507)
"""Answers that every route may give."""

NAMED = problems(404)
"""Answer of a route whose address names a resource."""

LATER: dict[int | str, dict[str, Any]] = {202: {"description": "It takes longer.", "model": Queued}, **NAMED}
"""Answers of a route that waits for a job."""


def only_known(request: Request) -> None:
    """Refuse an unknown query parameter: a mistyped filter would select everything."""
    operation = request.app.openapi()["paths"][request.scope["route"].path][request.method.lower()]
    refuse_unknown(request.query_params, [p["name"] for p in operation.get("parameters", ()) if p["in"] == "query"])


def refuse_unknown(given: Iterable[str], known: Collection[str]) -> None:
    """Refuse the first unknown parameter name."""
    for name in given:
        if name not in known:
            raise Problem(422, "There is no such parameter.", where=name, expected=sorted(known) or "none", found=name)


def describe(app: FastAPI) -> dict[str, Any]:
    """Return the schema of the API; that of problems belongs to no route, and is added here."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, routes=app.routes)
        schema["components"]["schemas"][ProblemDocument.__name__] = ProblemDocument.model_json_schema()
        schema["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        schema["security"] = [{"token": []}, {}]
        app.openapi_schema = schema
    return app.openapi_schema
