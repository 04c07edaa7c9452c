"""Pages for people: made here, whole without scripts, with their state in the address."""

from __future__ import annotations

import csv
import io
import secrets
import time
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote, urlencode

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.concurrency import run_in_threadpool

from pipeline.intake.quarantine import list_quarantine
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.records.criteria import REPORTED
from pipeline.rendering.labels import UNITS, criterion_name, significant
from pipeline.rendering.report.page_template import TEMPLATES
from pipeline.service import api
from pipeline.service.api import Finite, Name, Segment
from pipeline.service.catalogue import SORTS
from pipeline.service.database import ENDED
from pipeline.service.page_figures import limits, plane, units_of
from pipeline.service.plots import Layer, figure
from pipeline.service.problems import Problem
from pipeline.service.results import uploaded_name
from pipeline.service.sample_forms import FORMS
from pipeline.service.security import FORM, SESSION, cookie, cookies_of, form_token, is_form
from pipeline.service.shared import ComparisonRequest, Service
from pipeline.store.names import folder_name, name_of_folder

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
        "name": lambda word: criterion_name(word),
        "when": _when,
    }
    found.globals |= {"experiment_url": experiment_url, "device_url": device_url, "run_of": run_of}
    return found


def _name(word: str) -> str:
    return criterion_name(word)


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


def routes(service: Service) -> APIRouter:
    """Return the routes of all pages."""
    pages = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)
    database, settings = service.database, service.settings

    page = partial(page_of, service)

    def check(request: Request, token: str) -> None:
        if not is_form(database, cookies_of(request.scope), token):
            raise Problem(403, "The form is not one of this server, or too old. Load its page again.", where="form")

    async def fields_of(request: Request) -> dict[str, list[str]]:
        form = await request.form()
        fields: dict[str, list[str]] = {}
        for name, value in form.multi_items():
            fields.setdefault(name, []).append(str(value))
        check(request, fields.get("form", [""])[0])
        return fields

    @pages.get("/static/{name}")
    def static(name: str) -> Response:
        if name == "service.css":
            sheets = (TEMPLATES / "report.css", HERE / "static" / "service.css")
            return Response("\n".join(sheet.read_text("utf-8") for sheet in sheets), media_type="text/css")
        if name != "service.js":
            raise Problem(404, "There is no such file.", found=name)
        return FileResponse(HERE / "static" / name, media_type="text/javascript")

    @pages.get("/")
    def home(request: Request) -> Response:
        trials = service.catalogue.trials()
        by_device = {d["device"]: [e for e in trials.experiments if e["device"] == d["device"]] for d in trials.devices}
        return page(request, "home.html.j2", devices=by_device, trials=trials.rows, damaged=trials.damaged)

    @pages.get("/devices/{device}")
    def one_device(request: Request, device: Segment) -> Response:
        own = [e for e in service.catalogue.trials().experiments if e["device"] == device]
        if not own:
            raise Problem(404, "There are no trials of this device.", found=device)
        return page(request, "device.html.j2", device=device, experiments=own, criteria=REPORTED)

    @pages.get("/devices/{device}/experiments/{experiment}")
    def one_experiment(request: Request, device: Segment, experiment: Segment) -> Response:
        document: dict[str, Any] | None = None
        job = problem = None
        try:
            document, job = service.experiment(device, experiment)
            problem = _problem_of(database.job(job)) if job else None
        except Problem as error:
            if error.status == 404:
                raise
            problem = str(error)
        trials = service.catalogue.trials()
        mask, facets = trials.selected({"device": device, "experiment": experiment}, {})
        rows = np.flatnonzero(mask)[:PLOTTED].tolist()
        shown = trials.items(rows)
        found = document["experiments"][0] if document else None
        words = {kind: database.words(kind, ["experiment", device, experiment]) for kind in ("notes", "tags")}
        return page(
            request, "experiment.html.j2", device=device, experiment=experiment, trials=shown, total=int(mask.sum()),
            plot=plane(shown, found), found=found, job=job, problem=problem, facets=facets, **words,
            causes=document["causes"][experiment] if document else [], units=units_of(shown),
        )  # fmt: skip

    @pages.get("/trials")
    def trials(
        request: Request,
        device: Name = "", experiment: Name = "", verdict: Name = "", outcome: Name = "",
        stiffness_min: Finite | str = None, stiffness_max: Finite | str = None, damping_min: Finite | str = None,
        damping_max: Finite | str = None, q: Name = "", sort: Name = "id", cursor: str | None = None, format: Name = "",
    ) -> Response:  # fmt: skip
        words = {"device": device, "experiment": experiment, "verdict": verdict, "outcome": outcome}
        given = {"stiffness_min": stiffness_min, "stiffness_max": stiffness_max, "damping_min": damping_min,
                 "damping_max": damping_max}  # fmt: skip
        ranges = {name: _limit(name, value) for name, value in given.items()}
        found = api.trial_list(service, dict(words), ranges, q, sort, SHOWN, cursor)
        if format == "csv":
            return _csv(found["items"])
        state = {k: v for k, v in {**words, **given, "q": q, "sort": sort}.items() if v not in ("", None)}
        following = urlencode({**state, "cursor": found["next_cursor"]}) if found["next_cursor"] else None
        return page(
            request,
            "trials.html.j2",
            **found,
            state=state,
            following=following,
            query=urlencode(state),
            sorts=SORTS,
        )

    @pages.get("/trials/{trial}")
    def one_trial(request: Request, trial: str) -> Response:
        about, table = service.samples(trial)
        time_s, position = (table.column(name).to_numpy() for name in ("time_s", "position"))
        unit, metres = UNITS[about["motion"]], "rad" if about["motion"] == "rotation" else "m"
        layers = [Layer("response", time_s, position, "position")]
        drawing = figure(layers, "time [s]", f"position [{metres}]", f"Response of trial {trial}", zero=False)
        words = {kind: database.words(kind, ["trial", trial]) for kind in ("notes", "tags")}
        source = uploaded_name(database, about["source"])
        about_all = {"trial": about, "plot": drawing, "units": unit, "samples": table.num_rows, "source": source}
        return page(request, "trial.html.j2", **about_all, **words)

    @pages.get("/trials/{trial}/samples.{ending}")
    def download(trial: str, ending: str) -> Response:
        media = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet", "json": "application/json",
                 "arrows": "application/vnd.apache.arrow.stream"}  # fmt: skip
        if ending not in media:
            raise Problem(404, "Samples have no such form.", expected=list(media), found=ending)
        response: Response = FORMS[media[ending]](*service.samples(trial))
        response.headers["content-disposition"] = f'attachment; filename="{quote(trial)}.{ending}"'
        return response

    @pages.get("/compare")
    def compare(request: Request, runs: Annotated[list[str], Query(max_length=50)] = []) -> Response:  # noqa: B006
        names = [word for part in runs for word in part.split(",") if word]
        chosen = [tuple(map(name_of_folder, name.split("/"))) for name in dict.fromkeys(names)]
        if len(chosen) > MOST_RUNS or any(len(run) != 2 for run in chosen):
            raise Problem(
                422, "Compare up to six experiments.", where="runs", expected="device/experiment, ...", found=names
            )
        found = [(device, experiment, *service.experiment(device, experiment)) for device, experiment in chosen]
        documents = [(d, e, document) for d, e, document, _ in found if document]
        waiting = [(d, e, database.job(job)) for d, e, _, job in found if job]
        return page(
            request, "compare.html.j2", runs=documents, waiting=waiting, busy=any(_busy(job) for *_, job in waiting),
            plots=limits(documents), criteria=REPORTED, all=service.catalogue.trials().experiments,
            chosen={run_of(*run) for run in chosen},
        )  # fmt: skip

    @pages.post("/compare")
    async def ask_comparison(request: Request) -> Response:
        fields = await fields_of(request)
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
    def upload(request: Request) -> Response:
        return page(request, "upload.html.j2", profiles=[p.name for p in shipped_profiles()], settings=settings)

    @pages.post("/upload")
    async def receive(request: Request) -> Response:
        accepted = await api.receive(service, request, lambda fields: check(request, fields.get("form", "")))
        return RedirectResponse(f"/jobs/{accepted['job']}", 303)

    @pages.get("/jobs")
    def jobs(request: Request, before: int = 2**62) -> Response:
        found = database.jobs(min(max(before, 0), 2**62), SHOWN + 1)
        last = found[SHOWN - 1]["number"] if len(found) > SHOWN else None
        return page(request, "jobs.html.j2", jobs=found[:SHOWN], last=last, busy=any(_busy(job) for job in found))

    @pages.get("/jobs/{job}")
    def one_job(request: Request, job: str) -> Response:
        found = database.job(job)
        if found is None:
            raise Problem(404, "There is no such job.", found=job)
        return page(request, "job.html.j2", job=found, busy=_busy(found))

    @pages.post("/jobs/{job}/cancel")
    async def cancel(request: Request, job: str) -> Response:
        await fields_of(request)
        if request.state.role != "admin":
            raise Problem(403, "Only an admin cancels jobs.", expected="admin", found=request.state.role)
        await run_in_threadpool(database.cancel, job)
        return RedirectResponse(f"/jobs/{quote(job)}", 303)

    @pages.post("/words")
    async def words(request: Request) -> Response:
        fields = await fields_of(request)
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
        await run_in_threadpool(database.set_words, "notes", of, notes.text)
        await run_in_threadpool(database.set_words, "tags", of, tags.tags)
        return RedirectResponse(back, 303)

    @pages.get("/quarantine")
    def quarantine(request: Request) -> Response:
        damaged: dict[Path, str] = {}
        records = [(uploaded_name(database, r.path), r) for r in list_quarantine(settings.processed, damaged)]
        return page(request, "quarantine.html.j2", records=records, damaged=damaged)

    @pages.get("/reports")
    def reports(request: Request) -> Response:
        rows = database.run(
            "SELECT * FROM jobs WHERE kind = 'comparison' AND state = 'done' ORDER BY number DESC LIMIT ?", SHOWN
        )
        jobs = [job for row in rows if (job := database.job(row["id"]))]
        files = sorted(file.name for file in settings.reports.glob("*.html")) if settings.reports.is_dir() else []
        return page(request, "reports.html.j2", jobs=jobs, files=files, folder=settings.reports)

    @pages.get("/login")
    def login(request: Request) -> Response:
        return page(request, "login.html.j2", wrong=False)

    @pages.post("/login")
    async def enter(request: Request) -> Response:
        fields = await fields_of(request)
        session = await run_in_threadpool(database.login, fields.get("secret", [""])[0].strip())
        if session is None:
            return page(request, "login.html.j2", 401, wrong=True)
        secure = request.headers.get("x-forwarded-proto") == "https"
        return RedirectResponse("/", 303, {"set-cookie": cookie(SESSION, session, secure)})

    @pages.post("/logout")
    async def leave(request: Request) -> Response:
        await fields_of(request)
        await run_in_threadpool(database.logout, cookies_of(request.scope).get(SESSION, ""))
        return RedirectResponse("/login", 303)

    return pages


def _busy(job: Mapping[str, Any] | None) -> bool:
    return job is not None and job["state"] not in ENDED


def _problem_of(job: Mapping[str, Any] | None) -> str | None:
    return job["problem"]["detail"] if job and job["problem"] else None


def _limit(name: str, value: float | str | None) -> float | None:
    """Return a limit of a range as a form sends it; an empty one is none."""
    if value in ("", None):
        return None
    try:
        number = float(value)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise Problem(422, "A limit is a finite number.", where=name, found=value)
    return number


def _csv(items: Sequence[Mapping[str, Any]]) -> Response:
    stream = io.StringIO()
    writer = csv.writer(stream)
    plain = ("id", "device", "experiment", "stiffness", "damping", "verdict", "outcome")
    writer.writerow([*plain, *(f"{c}{end}" for c in REPORTED for end in ("", "_low", "_high"))])
    for item in items:
        costs = (item["costs"].get(c, {}).get(key) for c in REPORTED for key in ("value", "low", "high"))
        writer.writerow([*(item[name] for name in plain), *costs])
    return Response(stream.getvalue(), media_type="text/csv; charset=utf-8")
