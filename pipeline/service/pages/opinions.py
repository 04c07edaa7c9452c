"""Forms by which people write notes and tags on trials and experiments, and exclude them."""

from __future__ import annotations

from urllib.parse import quote

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from pipeline.service.pages.frame import experiment_url, fields_of
from pipeline.service.problems import Problem
from pipeline.service.rest.remarks import Exclusion, Notes, Tags
from pipeline.service.shared import Service, Shared

opinions = APIRouter(include_in_schema=False)


@opinions.post("/words")
async def words(service: Shared, request: Request) -> Response:
    """Store notes and tags."""
    fields = await fields_of(service, request)
    of, back = await run_in_threadpool(_meant, service, fields)
    notes = Notes(text=fields.get("notes", [""])[0].replace("\r\n", "\n"))
    tags = Tags(tags=[word.strip() for word in fields.get("tags", [""])[0].split(",") if word.strip()])
    await run_in_threadpool(service.database.set_words, "notes", of, notes.text)
    await run_in_threadpool(service.database.set_words, "tags", of, tags.tags)
    return RedirectResponse(back, 303)


@opinions.post("/exclusions")
async def exclusions(service: Shared, request: Request) -> Response:
    """Exclude a trial or all of an experiment for a reason; without one, use it again."""
    fields = await fields_of(service, request)
    of, back = await run_in_threadpool(_meant, service, fields)
    again = fields.get("again", [""])[0] == "yes"
    asked = Exclusion(reason=None if again else " ".join(fields.get("reason", [""])[0].split()))
    if of[0] == "trial":
        await run_in_threadpool(service.exclude, of[1], asked.reason)
    else:
        await run_in_threadpool(service.exclude_experiment, of[1], of[2], asked.reason)
    return RedirectResponse(back, 303)


def _meant(service: Service, fields: dict[str, list[str]]) -> tuple[list[str], str]:
    """Return the trial or experiment that a form is about, and the address of its page."""
    of = fields.get("of", [""])
    if of[0] == "trial" and len(of) == 2:
        service.found(of[1])
        return of, f"/trials/{quote(of[1])}"
    if of[0] == "experiment" and len(of) == 3:
        service.experiments(of[1], [of[2]])
        return of, experiment_url(of[1], of[2])
    raise Problem(422, "This belongs to a trial or an experiment.", where="of", found=of)
