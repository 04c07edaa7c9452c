"""Pages for people: made here, whole without scripts, with their state in the address."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from markupsafe import Markup
from pydantic import ConfigDict, field_validator
from starlette.concurrency import run_in_threadpool

from pipeline.intake.quarantine import list_quarantine
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.records.criteria import REPORTED
from pipeline.rendering.labels import UNITS
from pipeline.service.catalogue import SORTS
from pipeline.service.jobs.results import uploaded_name
from pipeline.service.metrics import MEDIA
from pipeline.service.pages.frame import HERE, busy, check, fields_of, kept, page_of, part_of, style_sheet
from pipeline.service.pages.page_figures import plane, units_of
from pipeline.service.pages.plots import Layer, figure
from pipeline.service.problems import Problem
from pipeline.service.rest import api
from pipeline.service.rest.api import Segment
from pipeline.service.rest.sample_forms import FORMS
from pipeline.service.shared import Service, Shared

pages = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

SHOWN = 100
"""Trials in a table."""

_STATE = {*api.WORDS, *api.RANGES, "q", "sort"}
"""What of an address says which trials are listed."""

PLOTTED = 3000
"""Trials in a plane: more are no longer told apart."""


@pages.get("/static/{name}")
def static(name: str) -> Response:
    """Return the style sheet or the script."""
    if name == "service.css":
        return Response(style_sheet(), media_type="text/css")
    if name != "service.js":
        raise Problem(404, "There is no such file.", found=name)
    return FileResponse(HERE / "static" / name, media_type="text/javascript")


@pages.get("/")
def home(service: Shared, request: Request) -> Response:
    """Show the devices and their experiments."""
    trials = service.catalogue.trials()
    by_device = {d["device"]: [e for e in trials.experiments if e["device"] == d["device"]] for d in trials.devices}
    return page_of(service, request, "home.html.j2", devices=by_device, trials=trials.rows, damaged=trials.damaged)


@pages.get("/devices/{device}")
def one_device(service: Shared, request: Request, device: Segment) -> Response:
    """Show the experiments of a device."""
    own = [e for e in service.catalogue.trials().experiments if e["device"] == device]
    if not own:
        raise Problem(404, "There are no trials of this device.", found=device)
    return page_of(service, request, "device.html.j2", device=device, experiments=own, criteria=REPORTED)


@pages.get("/devices/{device}/experiments/{experiment}")
def one_experiment(service: Shared, request: Request, device: Segment, experiment: Segment) -> Response:
    """Show the trials of an experiment in their plane, and what was found."""
    document, job, problem = kept(service, lambda: service.experiment(device, experiment))
    trials = service.catalogue.trials()
    mask, facets = trials.selected({"device": device, "experiment": experiment}, {})
    rows = np.flatnonzero(mask)[:PLOTTED].tolist()
    shown = trials.items(rows)
    found = document["experiments"][0] if document else None
    words = {kind: service.database.words(kind, ["experiment", device, experiment]) for kind in ("notes", "tags")}
    return page_of(
        service, request, "experiment.html.j2", device=device, experiment=experiment, trials=shown,
        total=int(mask.sum()), facets=facets, units=units_of(shown),
        plot=plane(shown, found), found=found, job=job, problem=problem,
        causes=document["causes"][experiment] if document else [],
        excluded=service.excluded_of(device, experiment),
        remarks=[note for note in service.notes(device, experiment) if note.trial_id], **words,
    )  # fmt: skip


class TrialForm(api.TrialQuery):
    """The same as a form sends it: an empty field asks for nothing, and one that is not here is refused."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["", "csv"] = ""

    @field_validator(*api.RANGES, "cursor", mode="before")
    @classmethod
    def _nothing(cls, value: Any) -> Any:
        return value or None


@pages.get("/trials")
def trials(service: Shared, request: Request, asked: Annotated[TrialForm, Query()]) -> Response:
    """Show a list of trials, or its CSV."""
    all_, shown = service.catalogue.trials(), asked.model_copy(update={"limit": SHOWN})
    if asked.format == "csv":
        return _csv(api.trial_list(all_, shown)["items"])

    def listing() -> tuple[int, Markup]:
        found = api.trial_list(all_, shown)
        state = {"sort": asked.sort} | {k: v for k, v in request.query_params.items() if v and k in _STATE}
        following = urlencode({**state, "cursor": found["next_cursor"]}) if found["next_cursor"] else None
        more = {"state": state, "following": following, "query": urlencode(state), "sorts": SORTS}
        return found["total"], part_of("trial_list.html.j2", **found, **more)

    total, body = all_.once(f"page {request.url.query}", listing)
    return page_of(service, request, "trials.html.j2", total=total, listing=body)


@pages.get("/trials/{trial}")
def one_trial(service: Shared, request: Request, trial: str) -> Response:
    """Show the response of a trial beside theory and fitted loop, and what is known of it."""
    trials, row = service.found(trial)
    (about,) = trials.items([row])
    drawn, job, problem = kept(service, lambda: service.drawn(about["device"], about["experiment"], trial))
    figures = [Markup(panel) for panel in drawn["panels"]] if drawn else [_plain_response(service, trial)]
    words = {kind: service.database.words(kind, ["trial", trial]) for kind in ("notes", "tags")}
    return page_of(
        service, request, "trial.html.j2", trial=about, units=UNITS[about["motion"]], panels=figures,
        caption=drawn["caption"] if drawn else "", job=job, problem=problem,
        source=uploaded_name(service.database, about["source"]), **words,
    )  # fmt: skip


def _plain_response(service: Service, trial: str) -> Markup:
    """Return the response of a trial as it was measured."""
    about, table = service.samples(trial)
    time_s, position = (table.column(name).to_numpy() for name in ("time_s", "position"))
    unit = "rad" if about["motion"] == "rotation" else "m"
    layers = [Layer("response", time_s, position, "position")]
    return figure(layers, "time [s]", f"position [{unit}]", f"Response of trial {trial}", zero=False)


@pages.get("/trials/{trial}/samples.{ending}")
def download(service: Shared, trial: str, ending: str) -> Response:
    """Return the samples of a trial as a file."""
    media = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet", "json": "application/json",
             "arrows": "application/vnd.apache.arrow.stream"}  # fmt: skip
    if ending not in media:
        raise Problem(404, "Samples have no such form.", expected=list(media), found=ending)
    response: Response = FORMS[media[ending]](*service.samples(trial))
    response.headers["content-disposition"] = f'attachment; filename="{quote(trial)}.{ending}"'
    return response


@pages.get("/upload")
def upload(service: Shared, request: Request) -> Response:
    """Show the form for logs."""
    return page_of(
        service, request, "upload.html.j2", profiles=[p.name for p in shipped_profiles()], settings=service.settings
    )


@pages.post("/upload")
async def receive(service: Shared, request: Request) -> Response:
    """Take logs."""
    accepted = await api.receive(service, request, lambda fields: check(service, request, fields.get("form", "")))
    return RedirectResponse(f"/jobs/{accepted['job']}", 303)


@pages.get("/jobs")
def jobs(service: Shared, request: Request, before: int = 2**62) -> Response:
    """List jobs."""
    found = service.database.jobs(min(max(before, 0), 2**62), SHOWN + 1)
    last = found[SHOWN - 1]["number"] if len(found) > SHOWN else None
    return page_of(
        service, request, "jobs.html.j2", jobs=found[:SHOWN], last=last, busy=any(busy(job) for job in found)
    )


@pages.get("/jobs/{job}")
def one_job(service: Shared, request: Request, job: str) -> Response:
    """Show a job."""
    found = service.database.job(job)
    if found is None:
        raise Problem(404, "There is no such job.", found=job)
    return page_of(service, request, "job.html.j2", job=found, busy=busy(found))


@pages.post("/jobs/{job}/cancel")
async def cancel(service: Shared, request: Request, job: str) -> Response:
    """Cancel a job."""
    await fields_of(service, request)
    if request.state.role != "admin":
        raise Problem(403, "Only an admin cancels jobs.", expected="admin", found=request.state.role)
    await run_in_threadpool(service.database.cancel, job)
    return RedirectResponse(f"/jobs/{quote(job)}", 303)


@pages.get("/quarantine")
def quarantine(service: Shared, request: Request) -> Response:
    """List what could not be ingested."""
    damaged: dict[Path, str] = {}
    records = [
        (uploaded_name(service.database, r.path), r) for r in list_quarantine(service.settings.processed, damaged)
    ]
    return page_of(service, request, "quarantine.html.j2", records=records, damaged=damaged)


@pages.get("/reports")
def reports(service: Shared, request: Request) -> Response:
    """List reports."""
    rows = service.database.run(
        "SELECT * FROM jobs WHERE kind = 'comparison' AND state = 'done' ORDER BY number DESC LIMIT ?", SHOWN
    )
    jobs = [job for row in rows if (job := service.database.job(row["id"]))]
    asked = [json.dumps(job["request"].get("asked", job["id"])) for job in jobs]
    earlier = {job["id"] for place, job in enumerate(jobs) if asked[place] in asked[:place]}
    files = (
        sorted(file.name for file in service.settings.reports.glob("*.html"))
        if service.settings.reports.is_dir()
        else []
    )
    return page_of(
        service, request, "reports.html.j2", jobs=jobs, earlier=earlier, files=files, folder=service.settings.reports
    )


@pages.get("/metrics")
def metrics(service: Shared) -> Response:
    """Tell a monitor what was asked for and done."""
    return Response(service.metrics.text(), media_type=MEDIA)


def _csv(items: Sequence[Mapping[str, Any]]) -> Response:
    stream = io.StringIO()
    writer = csv.writer(stream)
    plain = ("id", "device", "experiment", "stiffness", "damping", "verdict", "outcome", "excluded")
    writer.writerow([*plain, *(f"{c}{end}" for c in REPORTED for end in ("", "_low", "_high"))])
    for item in items:
        costs = (item["costs"].get(c, {}).get(key) for c in REPORTED for key in ("value", "low", "high"))
        writer.writerow([*(item[name] for name in plain), *costs])
    return Response(stream.getvalue(), media_type="text/csv; charset=utf-8")
