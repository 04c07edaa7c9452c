"""Responses of the API for its OpenAPI schema: a record for each document, and the problems that any route may
return."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Generic, Literal, TypeVar

from fastapi import FastAPI, Request
from fastapi.openapi.utils import get_openapi

from pipeline.base.json_object import JsonObject
from pipeline.records.findings import BoundaryPoint, Estimate, Optimum, Record
from pipeline.records.results import Cause
from pipeline.service.catalogue import Trial
from pipeline.service.database import ProblemDocument
from pipeline.service.problems import MEDIA, TITLES, Problem
from pipeline.service.profiles import Question

Item = TypeVar("Item")


class Page(Record, Generic[Item]):
    """A page of a list. The last page has no `next_cursor`."""

    items: list[Item]
    next_cursor: str | None


class Health(Record):
    """State of the server, and the number of jobs in each state."""

    state: Literal["ok"]
    version: str
    read_only: bool
    jobs: dict[str, int]


class NotedTrial(Trial):
    """A trial with its notes and tags."""

    notes: str


class TrialPage(Page[Trial]):
    """A page of a list of trials, with the total number, and the number of trials for each property."""

    total: int
    facets: dict[str, dict[str, int]]


class Samples(Record):
    """Samples of a trial, as columns in SI. A row without a value has null."""

    trial: Trial
    units: dict[str, str]
    columns: dict[str, list[float | None]]


class Queued(Record):
    """The job that makes the requested document, and the future key of a comparison."""

    job: str
    key: str | None = None


class Made(Record):
    """The key of an existing comparison."""

    key: str


class Comparison(Record):
    """A finished comparison: key, time, user and request."""

    key: str
    made: float
    author: str
    asked: JsonObject


class Deleted(Record):
    """A trial in the bin."""

    trial_id: str
    device: str
    experiment: str
    source: str


class Draft(Record):
    """A drafted profile as TOML, its open questions with their lines and keys, and the name of the sample for
    previews."""

    sample: str
    profile: str
    questions: list[Question]


class Refused(Record):
    """A refused log."""

    id: str
    name: str
    since: float
    author: str | None
    row: int | None
    reason: str
    code: str
    profile: str | None
    profile_line: str | None


PARTS: dict[str, object] = {
    "estimates": dict[str, Estimate],
    "boundary": list[BoundaryPoint],
    "optima": dict[str, Optimum],
    "causes": list[Cause],
}
"""Parts of the document of an experiment, with their descriptions."""


def problems(*statuses: int) -> dict[int | str, JsonObject]:
    """Return the OpenAPI responses for these statuses. Each response is a problem document."""
    schema = {"$ref": f"#/components/schemas/{ProblemDocument.__name__}"}
    return {status: {"description": TITLES[status], "content": {MEDIA: {"schema": schema}}} for status in statuses}


EVERYWHERE = problems(400, 401, 403, 408, 409, 413, 422, 429, 503, 507)
"""Responses that every route may give."""

NAMED = problems(404)
"""Response of a route whose address names a resource."""

LATER: dict[int | str, JsonObject] = {202: {"description": "It takes longer.", "model": Queued}, **NAMED}
"""Responses of a route that waits for a job."""


def only_known(request: Request) -> None:
    """Refuse an unknown query parameter, because a mistyped filter would select everything."""
    operation = request.app.openapi()["paths"][request.scope["route"].path][request.method.lower()]
    refuse_unknown(request.query_params, [p["name"] for p in operation.get("parameters", ()) if p["in"] == "query"])


def refuse_unknown(given: Iterable[str], known: Collection[str]) -> None:
    """Refuse the first unknown parameter name."""
    for name in given:
        if name not in known:
            raise Problem(422, "There is no such parameter.", where=name, expected=sorted(known) or "none", found=name)


def describe(app: FastAPI) -> JsonObject:
    """Return the schema of the API. The schema of problems belongs to no route, and is therefore added here."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, routes=app.routes)
        schema["components"]["schemas"][ProblemDocument.__name__] = ProblemDocument.model_json_schema()
        schema["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        schema["security"] = [{"token": []}, {}]
        app.openapi_schema = schema
    return app.openapi_schema
