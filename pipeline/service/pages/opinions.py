"""Forms by which people write notes and tags, exclude, move and delete."""

from __future__ import annotations

from urllib.parse import quote

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from pipeline.service.pages.frame import device_url, experiment_url, fields_of
from pipeline.service.problems import Problem
from pipeline.service.rest.remarks import Change, Exclusion, Notes, Tags, keep_words
from pipeline.service.shared import Service, Shared

opinions = APIRouter(include_in_schema=False)


@opinions.post("/words")
async def words(service: Shared, request: Request) -> Response:
    """Store notes and tags, unless somebody changed them since the form was loaded."""
    fields = await fields_of(service, request)
    of, back = await run_in_threadpool(_meant, service, fields)
    notes = Notes(text=fields.get("notes", [""])[0].replace("\r\n", "\n"))
    tags = Tags(tags=[word.strip() for word in fields.get("tags", [""])[0].split(",") if word.strip()])
    who = request.state.who
    for kind, value in (("notes", notes.text), ("tags", tags.tags)):
        known = fields.get(f"{kind}_known", ["*"])[0]
        await run_in_threadpool(keep_words, service, kind, of, value, who, known)
    return RedirectResponse(back, 303)


@opinions.post("/exclusions")
async def exclusions(service: Shared, request: Request) -> Response:
    """Exclude a trial or all of an experiment for a reason; without one, use it again."""
    fields = await fields_of(service, request)
    of, back = await run_in_threadpool(_meant, service, fields)
    again = fields.get("again", [""])[0] == "yes"
    asked = Exclusion(reason=None if again else " ".join(fields.get("reason", [""])[0].split()))
    await run_in_threadpool(service.exclude, of, asked.reason, request.state.who)
    return RedirectResponse(back, 303)


@opinions.post("/moves")
async def moves(service: Shared, request: Request) -> Response:
    """Rename or move an experiment, or a device."""
    fields = await fields_of(service, request)
    of, _ = await run_in_threadpool(_meant, service, fields)
    names = {name: fields.get(name, [""])[0].strip() or None for name in ("device", "experiment")}
    asked = Change(**names)
    to = (asked.device or of[1], *((asked.experiment or of[2],) if len(of) > 2 else ()))
    await run_in_threadpool(service.move, of, to, request.state.who)
    return RedirectResponse(experiment_url(*to) if len(to) > 1 else device_url(*to), 303)


@opinions.post("/deletions")
async def deletions(service: Shared, request: Request) -> Response:
    """Put a trial, an experiment or a device into the bin."""
    fields = await fields_of(service, request)
    of, _ = await run_in_threadpool(_meant, service, fields)
    await run_in_threadpool(service.delete, of, request.state.who)
    return RedirectResponse("/audit", 303)


@opinions.post("/bin")
async def bin_(service: Shared, request: Request) -> Response:
    """Take an experiment out of the bin, or empty it."""
    fields = await fields_of(service, request)
    if fields.get("act") == ["empty"]:
        await run_in_threadpool(service.empty_bin, request.state.who)
    else:
        await run_in_threadpool(service.restore, fields.get("of", [""]), request.state.who)
    return RedirectResponse("/audit", 303)


def _meant(service: Service, fields: dict[str, list[str]]) -> tuple[list[str], str]:
    """Return the trial, experiment or device that a form is about, and the address of its page."""
    of = fields.get("of", [""])
    if of[0] == "trial" and len(of) == 2:
        service.found(of[1])
        return of, f"/trials/{quote(of[1])}"
    if of[0] == "experiment" and len(of) == 3:
        service.experiments(of[1], [of[2]])
        return of, experiment_url(of[1], of[2])
    if of[0] == "device" and len(of) == 2:
        service.experiments(of[1], None)
        return of, device_url(of[1])
    raise Problem(422, "This belongs to a trial, an experiment or a device.", where="of", found=of)
