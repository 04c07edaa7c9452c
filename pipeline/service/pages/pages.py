"""Pages for people: made here, whole without scripts, with their state in the address."""

from __future__ import annotations

import csv
import io
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from pydantic import field_validator
from starlette.concurrency import run_in_threadpool

from pipeline.intake.quarantine import list_quarantine
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.records.criteria import REPORTED
from pipeline.rendering.labels import UNITS, criterion_name, significant
from pipeline.rendering.report.page_template import TEMPLATES
from pipeline.service.catalogue import SORTS
from pipeline.service.database import ENDED
from pipeline.service.jobs.results import uploaded_name
from pipeline.service.metrics import MEDIA
from pipeline.service.pages.page_figures import limits, plane, units_of
from pipeline.service.pages.plots import Layer, figure
from pipeline.service.problems import Problem
from pipeline.service.rest import api
from pipeline.service.rest.api import Segment
from pipeline.service.rest.sample_forms import FORMS
from pipeline.service.security import FORM, cookies_of, form_token, is_form
from pipeline.service.shared import ComparisonRequest, Service, Shared
from pipeline.store.names import folder_name, name_of_folder

pages = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

HERE = Path(__file__).parent
SHOWN = 100
"""Trials in a table."""

PLOTTED = 3000
"""Trials in a plane: more are no longer told apart."""

MOST_RUNS = 6


@cache
def _environment() -> Environment:
    found = Environment(
        loader=FileSystemLoader([HERE / "templates"]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {
        "short": _short,
        "name": criterion_name,
        "when": _when,
    }
    found.globals |= {"experiment_url": experiment_url, "device_url": device_url, "run_of": run_of}
    return found


def _short(value: float | None) -> str:
    return "–" if value is None else significant(value, 4)


def _when(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def _segment(name: str) -> str:
    """Return a name as a part of an address; one that is written in signs of its own is quoted twice."""
    return quote(folder_name(name), safe="")


def device_url(device: str) -> str:
    """Return the address of the page of a device."""
    return f"/devices/{_segment(device)}"


def experiment_url(device: str, experiment: str) -> str:
    """Return the address of the page of an experiment."""
    return f"{device_url(device)}/experiments/{_segment(experiment)}"


def run_of(device: str, experiment: str) -> str:
    """Return an experiment as one word of an address."""
    return f"{folder_name(device)}/{folder_name(experiment)}"


def page_of(service: Service, request: Request, template: str, status: int = 200, **content: object) -> HTMLResponse:
    """Return a page by its template; its forms bear the token of the browser that asks."""
    browser = cookies_of(request.scope).get(FORM)
    if browser is None:
        browser = request.scope["state"]["form"] = secrets.token_urlsafe(16)
    who = {"login": not service.settings.loopback, "form": form_token(service.database, browser)}
    text = (
        _environment().get_template(template).render(role=request.state.role, path=request.url.path, **who, **content)
    )
    return HTMLResponse(text, status)


def check(service: Service, request: Request, token: str) -> None:
    """Refuse a form that is not of this server and this browser."""
    if not is_form(service.database, cookies_of(request.scope), token):
        raise Problem(403, "The form is not one of this server, or too old. Load its page again.", where="form")


async def fields_of(service: Service, request: Request) -> dict[str, list[str]]:
    """Return the fields of a form of ours."""
    form = await request.form()
    fields: dict[str, list[str]] = {}
    for name, value in form.multi_items():
        fields.setdefault(name, []).append(str(value))
    check(service, request, fields.get("form", [""])[0])
    return fields


@pages.get("/static/{name}")
def static(name: str) -> Response:
    """Return the style sheet or the script."""
    if name == "service.css":
        sheets = (TEMPLATES / "report.css", HERE / "static" / "service.css")
        return Response("\n".join(sheet.read_text("utf-8") for sheet in sheets), media_type="text/css")
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
    document, job, problem = _asked(service, lambda: service.experiment(device, experiment))
    trials = service.catalogue.trials()
    mask, facets = trials.selected({"device": device, "experiment": experiment}, {})
    rows = np.flatnonzero(mask)[:PLOTTED].tolist()
    shown = trials.items(rows)
    found = document["experiments"][0] if document else None
    words = {kind: service.database.words(kind, ["experiment", device, experiment]) for kind in ("notes", "tags")}
    return page_of(
        service, request, "experiment.html.j2", device=device, experiment=experiment, trials=shown,
        total=int(mask.sum()),
        plot=plane(shown, found), found=found, job=job, problem=problem, facets=facets, **words,
        causes=document["causes"][experiment] if document else [], units=units_of(shown),
    )  # fmt: skip


class TrialForm(api.TrialQuery):
    """The same as a form sends it: an empty field asks for nothing."""

    format: Literal["", "csv"] = ""

    @field_validator(*api.RANGES, "cursor", mode="before")
    @classmethod
    def _nothing(cls, value: Any) -> Any:
        return value or None


@pages.get("/trials")
def trials(service: Shared, request: Request, asked: Annotated[TrialForm, Query()]) -> Response:
    """Show a list of trials, or its CSV."""
    found = api.trial_list(service, asked.model_copy(update={"limit": SHOWN}))
    if asked.format == "csv":
        return _csv(found["items"])
    kept = {*api.WORDS, *api.RANGES, "q", "sort"}
    state = {"sort": asked.sort} | {k: v for k, v in request.query_params.items() if v and k in kept}
    following = urlencode({**state, "cursor": found["next_cursor"]}) if found["next_cursor"] else None
    more: dict[str, Any] = {"state": state, "following": following, "query": urlencode(state), "sorts": SORTS}
    return page_of(service, request, "trials.html.j2", **found, **more)


@pages.get("/trials/{trial}")
def one_trial(service: Shared, request: Request, trial: str) -> Response:
    """Show the response of a trial beside theory and fitted loop, and what is known of it."""
    trials, row = service.found(trial)
    (about,) = trials.items([row])
    drawn, job, problem = _asked(service, lambda: service.drawn(about["device"], about["experiment"], trial))
    figures = [Markup(panel) for panel in drawn["panels"]] if drawn else [_plain_response(service, trial)]
    words = {kind: service.database.words(kind, ["trial", trial]) for kind in ("notes", "tags")}
    return page_of(
        service, request, "trial.html.j2", trial=about, units=UNITS[about["motion"]], panels=figures,
        caption=drawn["caption"] if drawn else "", job=job, problem=problem,
        source=uploaded_name(service.database, about["source"]), **words,
    )  # fmt: skip


def _asked(service: Service, ask: Callable[[], Any]) -> tuple[dict[str, Any] | None, str | None, str | None]:
    """Return what is kept, or the job that makes it, or why there is neither."""
    try:
        document, job = ask()
    except Problem as error:
        if error.status == 404:
            raise
        return None, None, str(error)
    return document, job, _problem_of(service.database.job(job)) if job else None


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


@pages.get("/compare")
def compare(service: Shared, request: Request, runs: Annotated[list[str], Query(max_length=50)] = []) -> Response:  # noqa: B006
    """Show up to six experiments beside each other."""
    names = [word for part in runs for word in part.split(",") if word]
    chosen = [tuple(map(name_of_folder, name.split("/"))) for name in dict.fromkeys(names)]
    if len(chosen) > MOST_RUNS or any(len(run) != 2 for run in chosen):
        raise Problem(
            422, "Compare up to six experiments.", where="runs", expected="device/experiment, ...", found=names
        )
    found = [(device, experiment, *service.experiment(device, experiment)) for device, experiment in chosen]
    documents = [(d, e, document) for d, e, document, _ in found if document]
    waiting = [(d, e, service.database.job(job)) for d, e, _, job in found if job]
    return page_of(
        service, request, "compare.html.j2", runs=documents, waiting=waiting,
        busy=any(_busy(job) for *_, job in waiting),
        plots=limits(documents), criteria=REPORTED, all=service.catalogue.trials().experiments,
        chosen={run_of(*run) for run in chosen},
    )  # fmt: skip


@pages.post("/compare")
async def ask_comparison(service: Shared, request: Request) -> Response:
    """Ask for a report."""
    fields = await fields_of(service, request)
    asked = ComparisonRequest.model_validate(
        {
            "device": fields.get("device", [""])[0],
            "experiments": fields.get("experiments"),
            "criteria": fields.get("criteria"),
        }
    )
    key, job = await run_in_threadpool(service.comparison, asked)
    return RedirectResponse(f"/jobs/{job}" if job else f"/api/v1/comparisons/{key}/report", 303)


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
        service, request, "jobs.html.j2", jobs=found[:SHOWN], last=last, busy=any(_busy(job) for job in found)
    )


@pages.get("/jobs/{job}")
def one_job(service: Shared, request: Request, job: str) -> Response:
    """Show a job."""
    found = service.database.job(job)
    if found is None:
        raise Problem(404, "There is no such job.", found=job)
    return page_of(service, request, "job.html.j2", job=found, busy=_busy(found))


@pages.post("/jobs/{job}/cancel")
async def cancel(service: Shared, request: Request, job: str) -> Response:
    """Cancel a job."""
    await fields_of(service, request)
    if request.state.role != "admin":
        raise Problem(403, "Only an admin cancels jobs.", expected="admin", found=request.state.role)
    await run_in_threadpool(service.database.cancel, job)
    return RedirectResponse(f"/jobs/{quote(job)}", 303)


@pages.post("/words")
async def words(service: Shared, request: Request) -> Response:
    """Store notes and tags."""
    fields = await fields_of(service, request)
    of = fields.get("of", [""])
    if of[0] == "trial" and len(of) == 2:
        await run_in_threadpool(service.found, of[1])
        back = f"/trials/{quote(of[1])}"
    elif of[0] == "experiment" and len(of) == 3:
        await run_in_threadpool(service.experiments, of[1], [of[2]])
        back = experiment_url(of[1], of[2])
    else:
        raise Problem(422, "Notes belong to a trial or an experiment.", where="of", found=of)
    notes = api.Notes(text=fields.get("notes", [""])[0].replace("\r\n", "\n"))
    tags = api.Tags(tags=[word.strip() for word in fields.get("tags", [""])[0].split(",") if word.strip()])
    await run_in_threadpool(service.database.set_words, "notes", of, notes.text)
    await run_in_threadpool(service.database.set_words, "tags", of, tags.tags)
    return RedirectResponse(back, 303)


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
    files = (
        sorted(file.name for file in service.settings.reports.glob("*.html"))
        if service.settings.reports.is_dir()
        else []
    )
    return page_of(service, request, "reports.html.j2", jobs=jobs, files=files, folder=service.settings.reports)


@pages.get("/metrics")
def metrics(service: Shared) -> Response:
    """Tell a monitor what was asked for and done."""
    return Response(service.metrics.text(), media_type=MEDIA)


def _busy(job: Mapping[str, Any] | None) -> bool:
    return job is not None and job["state"] not in ENDED


def _problem_of(job: Mapping[str, Any] | None) -> str | None:
    return job["problem"]["detail"] if job and job["problem"] else None


def _csv(items: Sequence[Mapping[str, Any]]) -> Response:
    stream = io.StringIO()
    writer = csv.writer(stream)
    plain = ("id", "device", "experiment", "stiffness", "damping", "verdict", "outcome")
    writer.writerow([*plain, *(f"{c}{end}" for c in REPORTED for end in ("", "_low", "_high"))])
    for item in items:
        costs = (item["costs"].get(c, {}).get(key) for c in REPORTED for key in ("value", "low", "high"))
        writer.writerow([*(item[name] for name in plain), *costs])
    return Response(stream.getvalue(), media_type="text/csv; charset=utf-8")
