"""Pages and forms for human users. Pages are rendered on the server and can be used without scripts. The address of a
page contains its state."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote, unquote, urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse, Response
from markupsafe import Markup
from pydantic import BaseModel, field_validator, model_validator
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.types import Message

from pipeline.base.json_object import JsonObject
from pipeline.device_data.devices import known_devices
from pipeline.explorer import page as explorer
from pipeline.explorer.entries import device_entries
from pipeline.intake.quarantine import list_quarantine
from pipeline.records.criteria import REPORTED
from pipeline.records.models import Motion
from pipeline.records.results import Answer, ComparisonResult
from pipeline.rendering.labels import UNITS, printed_scale
from pipeline.rendering.report.page_template import PLOT, PLOT_STYLE, TEMPLATES
from pipeline.service import device_files, profiles
from pipeline.service.catalogue import SORTED, WORDS, Experiment, Selection, Trial
from pipeline.service.database import NEWEST, Words
from pipeline.service.pages.frame import HERE, Fields, busy, check, kept, page_of, part_of, segment, style_sheet
from pipeline.service.problems import Problem
from pipeline.service.profiles import LONGEST
from pipeline.service.rest import api, lab, remarks
from pipeline.service.rest.answers import refuse_unknown
from pipeline.service.rest.api import Segment
from pipeline.service.security import SESSION, cookie
from pipeline.service.shared import Service, Shared, Who
from pipeline.store.corrections import in_bin

pages = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

PLOTTABLE = ("stiffness", "damping", *REPORTED)
"""Quantities of a trial that can be plotted against each other."""

SHOWN, LISTED, OVERLAID = 100, 20, 6
"""Largest number of trials in a table, on the page of an experiment, and in an overlay."""

_STATE = {*WORDS, *api.RANGES, "q", "sort"}
"""Query parameters that select the listed trials."""

WAITED_S = 0.9
"""Longest time for which a page waits for its drawing [s]. A worker that has already loaded the experiment takes less
time."""

PLOTTED = 3000
"""Largest number of trials in a plane for which they are linked to their pages. More trials could not be
distinguished."""


_STATIC = {"service.js": "text/javascript", "trial.js": "text/javascript", "icon.svg": "image/svg+xml"}
_VENDORED = {"uplot.js": (PLOT, "text/javascript"), "uplot.css": (PLOT_STYLE, "text/css")}


@pages.get("/static/{name}")
def static(name: str) -> Response:
    """Return the style sheet, the script or the icon."""
    if name == "service.css":
        return Response(style_sheet(), media_type="text/css")
    if name == "explorer.css":
        return Response(explorer.style(), media_type="text/css")
    if name in _VENDORED:
        return FileResponse(TEMPLATES / _VENDORED[name][0], media_type=_VENDORED[name][1])
    if name == "explorer.js":
        return Response(explorer.script(), media_type="text/javascript")
    if name not in _STATIC:
        raise Problem(404, "There is no such file.", found=name)
    return FileResponse(HERE / "static" / name, media_type=_STATIC[name])


@pages.get("/")
def home(service: Shared, request: Request) -> Response:
    """Show the devices and their experiments. Each experiment is shown with a picture, its tags, and a statement about
    the agreement with theory."""
    all_ = service.catalogue

    def cards() -> Markup:
        tags = {tuple(of): value for kind, of, value in service.database.all_words() if kind == "tags"}
        by_device: dict[str, list[tuple[Experiment, bool, Answer | None, list[str]]]] = {}
        for e in all_.experiments:
            document = service.peek(e.device, e.experiment)
            picture = bool(document and document["figures"].get("limits"))
            own = tags.get(("experiment", e.device, e.experiment), [])
            by_device.setdefault(e.device, []).append((e, picture, answer_of(document), own))
        return part_of("cards.html.j2", devices=by_device)

    done = service.database.job_counts("kind = 'experiment'").get("done")
    return page_of(service, request, "home.html.j2", body=all_.once(f"home {done}", cards),
                   devices=len(all_.devices), trials=all_.rows, damaged=all_.damaged,
                   folder=service.settings.processed)  # fmt: skip


@pages.get("/devices/{device}")
def one_device(service: Shared, request: Request, device: Segment) -> Response:
    """Show the limits of all experiments of a device in one plane."""
    own = [e for e in service.catalogue.experiments if e.device == device]
    if not own:
        raise Problem(404, "There are no trials of this device.", found=device)
    places = [(device, e.experiment) for e in own[:OVERLAID]]
    shown = kept(service, lambda: service.drawn("limits", places, plane="physical"))
    return page_of(service, request, "device.html.j2", device=device, experiments=own, criteria=REPORTED,
                   **shown._asdict())  # fmt: skip


@pages.get("/devices/{device}/file")
def one_device_file(service: Shared, request: Request, device: Segment, download: bool = False) -> Response:
    """Show the file of a device, or a draft made from the logs, for editing. With ``download``, return the text as a
    file."""
    try:
        text, problem = device_files.text_of(device), ""
    except Problem as none:
        own = [e.experiment for e in service.catalogue.experiments if e.device == device]
        document = service.peek(device, own[0]) if own else None
        if not own or download:
            raise
        plain = {name: part for name, part in (document or {}).items() if name not in ("causes", "figures", "told")}
        text = device_files.draft(device, ComparisonResult.model_validate(plain) if plain else None)
        problem = f"{none} A draft made from its logs is shown below."
    if download:
        name = {"content-disposition": f"attachment; filename*=UTF-8''{quote(device, safe='')}.toml"}
        return Response(text, media_type="application/toml", headers=name)
    return _device_file(service, request, device, text, problem)


def _device_file(
    service: Service, request: Request, device: str, text: str, problem: str, status: int = 200
) -> Response:
    own = device_files.is_of_the_lab(device)
    return page_of(service, request, "device_file.html.j2", status, device=device, text=text, problem=problem, own=own,
                   known=device in known_devices())  # fmt: skip


@pages.post("/devices/{device}/file")
async def keep_device_file(service: Shared, request: Request, who: Who, device: Segment) -> Response:
    """Store the edited or uploaded file of a device. An invalid file is shown again with its mistakes."""
    form = await request.form()
    check(service, request, str(form.get("form", "")))
    sent, text = form.get("upload"), str(form.get("file", "")).replace("\r\n", "\n")
    if isinstance(sent, UploadFile) and sent.filename:
        text = (await sent.read(LONGEST + 1)).decode("utf-8", "replace")
    try:
        if request.state.role == "viewer" or service.settings.read_only or len(text) > LONGEST:
            raise Problem(403 if len(text) <= LONGEST else 413, "This file cannot be stored here.", where="file")
        await run_in_threadpool(lab.put_device, service, who, device, lab.DeviceText(file=text))
    except Problem as error:
        return _device_file(service, request, device, text, str(error), error.status)
    return RedirectResponse(f"/devices/{segment(device)}/file", 303)


class TrialView(BaseModel):
    """Selection of the trials that the page of an experiment lists, and of the quantities that it plots."""

    verdict: str = ""
    tag: str = ""
    x: Literal[PLOTTABLE] = "stiffness"  # type: ignore[valid-type]
    y: Literal[PLOTTABLE] = "settle_2pct"  # type: ignore[valid-type]
    column: list[Literal[tuple(REPORTED)]] = ["settle_2pct", "overshoot"]  # type: ignore[valid-type]
    all: bool = False


@pages.get("/devices/{device}/experiments/{experiment}")
def one_experiment(
    service: Shared, request: Request, device: Segment, experiment: Segment, view: Annotated[TrialView, Query()]
) -> Response:
    """Show the trials of an experiment in their plane with theory, the results, and the next wall."""
    shown = kept(service, lambda: service.experiment(device, experiment))
    document = shown.drawn
    chosen = Selection({"device": device, "experiment": experiment}, {})
    total, facets = service.catalogue.selected(chosen)
    trials, _ = service.catalogue.page(chosen, "stiffness", PLOTTED, None)
    found = document["experiments"][0] if document else None
    drawn = document["figures"].get("limits") if document else None
    motion: Motion = trials[0].motion if trials else "translation"
    of, told = ["experiment", device, experiment], (document or {}).get("told")
    return page_of(
        service, request, "experiment.html.j2", device=device, experiment=experiment, listed=chosen_of(trials, view),
        view=view, quantities=PLOTTABLE, scatter=scatter(chosen_of(trials, view), view.x, view.y), few=LISTED,
        tags=sorted({tag for trial in trials for tag in trial.tags}), criteria=REPORTED,
        total=total, facets=facets, motion=motion, units=UNITS[motion],
        period=told["sampling_period_s"] if told else None,
        plot=clickable(drawn, trials) if drawn else None, found=found, answer=answer_of(document),
        drawn=drawn, job=shown.job, problem=shown.problem,
        causes=document["causes"][experiment] if document else [],
        excluded=service.excluded(of), words=words_of(service, of), of=of,
        remarks=[note for note in service.notes(device, experiment) if note.trial_id],
    )  # fmt: skip


def chosen_of(trials: Sequence[Trial], view: TrialView) -> list[Trial]:
    """Return the trials with the requested verdict and tag."""
    return [
        trial
        for trial in trials
        if (not view.verdict or trial.verdict == view.verdict) and (not view.tag or view.tag in trial.tags)
    ]


def number_of(trial: Trial, quantity: str) -> float | None:
    """Return a quantity of a trial: K, B, or a cost in printed units."""
    if quantity in REPORTED:
        cost = trial.costs.get(quantity)
        return None if cost is None else cost.value * printed_scale(quantity)
    return trial.stiffness if quantity == "stiffness" else trial.damping


def scatter(trials: Sequence[Trial], x: str, y: str) -> Markup:
    """Return a plot of two quantities of trials in which each mark is a link to its trial.

    The text is empty if no trial has both quantities.
    """
    both = [(number_of(trial, x), number_of(trial, y), trial) for trial in trials]
    points = [(a, b, trial) for a, b, trial in both if a is not None and b is not None]
    if not points:
        return Markup("")
    ends = [(min(values), max(values)) for values in zip(*((a, b) for a, b, _ in points), strict=True)]
    (x0, x1), (y0, y1) = (((low, high) if high > low else (low - 1, high + 1)) for low, high in ends)
    left, right, top, bottom = 80, 620, 15, 345
    parts = [f'<path class="axis" d="M{left} {top}V{bottom}H{right}" />']
    for share in (0.0, 0.5, 1.0):
        across, up = left + share * (right - left), bottom - share * (bottom - top)
        below, beside = (f"{low + share * (high - low):.4g}" for low, high in ((x0, x1), (y0, y1)))
        parts.append(f'<text x="{across:.0f}" y="{bottom + 20}" text-anchor="middle">{below}</text>')
        parts.append(f'<text x="{left - 8}" y="{up + 5:.0f}" text-anchor="end">{beside}</text>')
    for a, b, trial in points:
        at = left + (a - x0) / (x1 - x0) * (right - left), bottom - (b - y0) / (y1 - y0) * (bottom - top)
        name = escape(f"trial {trial.id}: {a:.4g}, {b:.4g}, {trial.verdict or 'no verdict yet'}")
        parts.append(f'<a href="/trials/{quote(trial.id)}" aria-label="{name}"><title>{name}</title>'
                     f'<circle class="point" cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="4"/></a>')  # fmt: skip
    return Markup(f'<svg class="scatter" viewBox="0 0 640 380" role="group" aria-label="Trials">{"".join(parts)}</svg>')


@pages.post("/marked")
def marked(service: Shared, who: Who, fields: Fields) -> Response:
    """Superimpose, exclude or tag the chosen trials."""
    chosen, act = fields.get("trial", []), fields.get("act", [""])[0]
    if act == "overlay":
        return RedirectResponse(f"/overlay?{urlencode({'trial': chosen}, doseq=True)}", 303)
    words = fields.get("words", [""])[0].strip()
    tags = [tag.strip() for tag in words.split(",") if tag.strip()]
    reason, own = (words or None, ()) if act == "exclude" else (None, tuple(tags))
    remarks.mark(service, who, remarks.Chosen(trials=chosen, reason=reason, tags=own))
    return RedirectResponse(_own(fields.get("next", ["/"])[0]), 303)


def answer_of(document: Mapping[str, Any] | None) -> Answer | None:
    """Return the answer in a document of the service, or None if the document has not been computed yet."""
    told = (document or {}).get("answer")
    return Answer.model_validate(told) if told else None


def words_of(service: Service, of: list[str]) -> dict[str, Words]:
    """Return notes and tags with their authors."""
    return {kind: service.database.words(kind, of) for kind in ("notes", "tags")}


def clickable(drawn: Mapping[str, Any], trials: Sequence[Trial]) -> Markup:
    """Return the drawing of a plane of K and B in which a click on a trial leads to its page."""
    panel, axes = drawn["panels"][0], drawn["shown"][0]["axes"][0]
    left, top, right, bottom = axes["box"]
    (k_low, k_high), (b_low, b_high) = axes["x"], axes["y"]
    links = []
    for trial in trials:
        if trial.stiffness is None or trial.damping is None:
            continue
        x = left + (trial.stiffness - k_low) / (k_high - k_low) * (right - left)
        y = bottom - (trial.damping - b_low) / (b_high - b_low) * (bottom - top)
        if left <= x <= right and top <= y <= bottom:
            name = escape(f"trial {trial.id}, {trial.verdict or 'no verdict yet'}")
            links.append(f'<a href="/trials/{quote(trial.id)}" aria-label="{name}"><title>{name}</title>'
                         f'<circle class="hit" cx="{x:.0f}" cy="{y:.0f}" r="60"/></a>')  # fmt: skip
    whole = panel.replace('role="img"', 'role="group"', 1)
    return Markup(whole.removesuffix("</svg>") + "".join(links) + "</svg>")


class TrialForm(api.TrialQuery):
    """Query of the list of trials, as sent by a form. An empty field is ignored, and an unknown field is refused."""

    sort: Literal[SORTED] = "-recorded"  # type: ignore[valid-type]
    format: Literal["", "csv", "all"] = ""

    @model_validator(mode="before")
    @classmethod
    def _known(cls, values: Any) -> Any:
        refuse_unknown(values, cls.model_fields)
        return values

    @field_validator(*api.RANGES, "cursor", mode="before")
    @classmethod
    def _nothing(cls, value: Any) -> Any:
        return value or None


@pages.get("/trials")
def trials(service: Shared, request: Request, asked: Annotated[TrialForm, Query()]) -> Response:
    """Show a list of trials, or its CSV."""
    all_ = service.catalogue
    if asked.format:
        limit, place = (SHOWN, asked.cursor) if asked.format == "csv" else (max(all_.rows, 1), None)
        return _csv(api.trial_list(all_, asked, limit, place).items)

    def listing() -> tuple[int, Markup]:
        found = api.trial_list(all_, asked, SHOWN, asked.cursor)
        state = {"sort": asked.sort} | {k: v for k, v in request.query_params.items() if v and k in _STATE}
        following = urlencode({**state, "cursor": found.next_cursor}) if found.next_cursor else None
        more = {"state": state, "following": following, "query": urlencode(state)}
        return found.total, part_of("trial_list.html.j2", **dict(found), **more)

    total, body = all_.once(f"page {request.url.query}", listing)
    return page_of(service, request, "trials.html.j2", total=total, listing=body)


@pages.get("/overlay")
def overlay(service: Shared, request: Request, trial: Annotated[list[str], Query(max_length=50)] = []) -> Response:  # noqa: B006
    """Show the superimposed responses of chosen trials, with the theoretical responses."""
    chosen = list(dict.fromkeys(trial))
    if not 1 <= len(chosen) <= OVERLAID:
        raise Problem(422, "Choose one to six trials by their check boxes.", where="trial", found=len(chosen))
    found = [service.found(one) for one in chosen]
    places = [(one.device, one.experiment, one.id) for one in found]
    return page_of(
        service,
        request,
        "overlay.html.j2",
        trials=found,
        **kept(service, lambda: service.drawn("trials", places))._asdict(),
    )


@pages.get("/trials/{trial}")
def one_trial(service: Shared, request: Request, trial: str) -> Response:
    """Show the response of a trial with theory and with the fitted loop, and the results of the trial."""
    about = service.found(trial)
    place = about.device, about.experiment, trial
    shown = kept(service, lambda: service.drawn("trials", [place]), WAITED_S)
    return page_of(service, request, "trial.html.j2", trial=about, units=UNITS[about.motion],
                   words=words_of(service, ["trial", trial]), **shown._asdict())  # fmt: skip


@pages.get("/upload")
def upload(service: Shared, request: Request, profile: str = "") -> Response:
    """Show the form for uploading logs, with a preselected profile."""
    known = profiles.names(service.settings)
    return page_of(service, request, "upload.html.j2", profiles=known, profile=profile, settings=service.settings)


@pages.post("/upload")
async def receive(service: Shared, request: Request) -> Response:
    """Store the uploaded logs, and redirect to the page of their job."""
    accepted = await api.receive(service, request, lambda fields: check(service, request, fields.get("form", "")))
    return RedirectResponse(f"/jobs/{accepted.job}", 303)


@pages.post("/draft")
async def draft(service: Shared, request: Request) -> Response:
    """Draft a profile for a sample, and show it with its questions."""
    found = await lab.drafted(service, request, lambda fields: check(service, request, fields.get("form", "")))
    return page_of(service, request, "profile.html.j2", **dict(found), name="", checked=None, problem="", unclear="",
                   confirmation="")  # fmt: skip


@pages.post("/profile")
def profile(service: Shared, request: Request, who: Who, fields: Fields) -> Response:
    """Try a profile on its sample, or store the profile."""
    answers = {int(key[7:]): value for key, (value, *_) in fields.items() if re.fullmatch(r"answer-\d+", key)}
    given = {name: fields.get(name, [""])[0] for name in ("profile", "sample", "name", "act", "confirmation")}
    text = profiles.answered(given["profile"].replace("\r\n", "\n"), answers)
    words = given["confirmation"].strip()
    asked = lab.KeptProfile(profile=text, sample=given["sample"], confirmation=words)
    checked, problem, unclear, name = None, "", "", given["name"].strip()
    try:
        if given["act"] == "keep":
            lab.put_profile(service, who, lab.NamedProfile(name=name).name, asked)
            return RedirectResponse(f"/upload?profile={name}", 303)
        checked = lab.preview(service, lab.Tried(profile=text, sample=given["sample"]))
    except Problem as error:
        problem, unclear = str(error), _unclear(error)
    if checked and profiles.contradictions(checked):
        unclear = "The command of a sample log contradicts the wall that the profile states."
    return page_of(
        service, request, "profile.html.j2", profile=text, sample=given["sample"], name=name, checked=checked,
        questions=profiles.questions(text), problem=problem, unclear=unclear, confirmation=words,
    )  # fmt: skip


def _unclear(problem: Problem) -> str:
    """Return the reason why a profile needs a confirmation, or an empty text if a confirmation would not help."""
    about = problem.document
    if problem.status == 404 and about.get("where") == "sample":
        return "The sample is no longer stored, so the profile cannot be tried on it."
    if problem.status in (503, 504):
        return "The profile could not be tried on the sample in time."
    return "The command of a sample log contradicts the wall that the profile states." if "expected" in about else ""


@pages.get("/jobs")
def jobs(service: Shared, request: Request, before: int = NEWEST) -> Response:
    """List jobs."""
    found, last = service.database.jobs(before, SHOWN)
    return page_of(service, request, "jobs.html.j2", jobs=found, last=last, busy=any(map(busy, found)))


@pages.get("/jobs/{job}")
def one_job(service: Shared, request: Request, job: str) -> Response:
    """Show a job."""
    return page_of(service, request, "job.html.j2", job=(found := api.one_job(service, job)), busy=busy(found))


@pages.get("/quarantine")
def quarantine(service: Shared, request: Request) -> Response:
    """List the logs that could not be ingested."""
    damaged: dict[Path, str] = {}
    list_quarantine(service.settings.processed, damaged)
    return page_of(service, request, "quarantine.html.j2", records=lab.quarantine(service), damaged=damaged,
                   profiles=profiles.names(service.settings))  # fmt: skip


@pages.get("/reports")
def reports(service: Shared, request: Request) -> Response:
    """List reports."""
    folder = service.settings.reports
    files = sorted(file.name for file in folder.glob("*.html")) if folder.is_dir() else []
    jobs = service.database.reports(SHOWN)
    return page_of(service, request, "reports.html.j2", jobs=jobs, files=files, folder=folder)


@pages.get("/theory")
def theory(service: Shared, request: Request) -> Response:
    """Show the explorer, which presents the theory of a loop with sliders, starting from any known device."""
    panel = Markup(explorer.panel(device_entries(known_devices().values())))
    return page_of(service, request, "theory.html.j2", panel=panel)


@pages.get("/audit")
def audit(service: Shared, request: Request, before: int = NEWEST) -> Response:
    """List the recorded actions with their users, and the trials in the bin."""
    found, last = service.database.audit(before, SHOWN)
    rubbish = Counter((one.device, one.experiment) for one in in_bin(service.settings.processed))
    return page_of(service, request, "audit.html.j2", actions=found, last=last, rubbish=rubbish)


@pages.get("/api")
def readable(service: Shared, request: Request) -> Response:
    """Show the documentation of the API, made from its schema."""
    return page_of(service, request, "api.html.j2", schema=request.app.openapi())


def _csv(items: Sequence[Trial]) -> Response:
    stream = io.StringIO()
    writer = csv.writer(stream)
    plain = ("id", *WORDS[:2], "stiffness", "damping", *WORDS[2:], "excluded", "source", "uploader")
    writer.writerow([*plain, *(f"{c}{end}" for c in REPORTED for end in ("", "_low", "_high"))])
    for item in items:
        known = (item.costs.get(c) for c in REPORTED)
        costs = (end for cost in known for end in ((cost.value, cost.low, cost.high) if cost else (None, None, None)))
        writer.writerow([*(getattr(item, name) for name in plain), *costs])
    return Response(stream.getvalue(), media_type="text/csv; charset=utf-8")


_KEPT = (b"host", b"cookie", b"origin", b"x-forwarded-proto")
"""Headers of a form request that are copied to the REST request."""


@pages.post("/do")
async def do(service: Shared, request: Request, fields: Fields) -> Response:
    """Execute the REST request of a form, and redirect to the next page. An error is shown as a page.

    The form has the fields of the document (`_document`), and the fields ``method``, ``path`` below the API, ``match``
    (the known ETag) and ``next``, in which ``{field}`` is replaced by the value of a field.
    """
    method, path, token = (fields.pop(name, [""])[0] for name in ("method", "path", "form"))
    known, following = (fields.pop(name, [usual])[0] for name, usual in (("match", "*"), ("next", "/")))
    document = _document(fields)
    body = json.dumps(document).encode()
    more = {"content-type": "application/json", "content-length": len(body), "x-csrf-token": token, "if-match": known}
    headers = [each for each in request.scope["headers"] if each[0] in _KEPT]
    headers += [(name.encode(), str(value).encode("latin-1", "replace")) for name, value in more.items()]
    asked = {name: request.scope[name] for name in ("type", "asgi", "http_version", "scheme", "server", "client")}
    asked |= {"method": method, "path": f"/api/v1/{unquote(path)}", "query_string": b"", "root_path": ""}
    status, answer = 0, b""

    async def receive() -> Message:
        return {"type": "http.request", "body": body}

    async def send(message: Message) -> None:
        nonlocal status, answer
        status = message.get("status", status)
        answer += message.get("body", b"")

    await request.app.state.guard({**asked, "headers": headers}, receive, send)
    found = json.loads(answer) if answer else {}
    if status >= 400:
        return page_of(service, request, "problem.html.j2", status, problem=found)
    if "job" in found:
        following = f"/jobs/{found['job']}"
    elif "key" in found:
        following = f"/api/v1/comparisons/{found['key']}/report"
    named = re.sub(r"\{(\w+)\}", lambda name: segment(document.get(name[1], "")), following)
    return RedirectResponse(_own(named), 303)


def _document(fields: Mapping[str, list[str]]) -> JsonObject:
    """Return a form as a document.

    The end of a field name determines the type: all values (``x[]``), an object from values name=text (``x{}``), a list
    of words separated by commas (``x,``), or null for an empty field (``x?``).
    """
    found: JsonObject = {}
    for name, values in fields.items():
        text = values[0].replace("\r\n", "\n")
        if name.endswith("[]"):
            found[name[:-2]] = values
        elif name.endswith("{}"):
            found[name[:-2]] = dict(value.partition("=")[::2] for value in values)
        elif name.endswith(","):
            found[name[:-1]] = [word.strip() for word in text.split(",") if word.strip()]
        elif name.endswith("?"):
            found[name[:-1]] = text.strip() or None
        else:
            found[name] = text
    return found


@pages.get("/login")
def login(service: Shared, request: Request) -> Response:
    """Show the form that asks for a token."""
    return _door(service, request, 200)


@pages.post("/login")
def enter(service: Shared, request: Request, fields: Fields) -> Response:
    """Begin a session with a token."""
    session = service.database.login(fields.get("secret", [""])[0].strip())
    if session is None:
        return _door(service, request, 401)
    secure = request.headers.get("x-forwarded-proto") == "https"
    following = _own(request.query_params.get("next", "/"))
    return RedirectResponse(following, 303, {"set-cookie": cookie(SESSION, session, secure)})


@pages.post("/logout")
def leave(service: Shared, request: Request, fields: Fields) -> Response:
    """End a session."""
    service.database.logout(request.cookies.get(SESSION, ""))
    return RedirectResponse("/login", 303)


def _door(service: Shared, request: Request, status: int) -> Response:
    following = _own(request.query_params.get("next", "/"))
    return page_of(service, request, "login.html.j2", status, wrong=status != 200, following=following)


def _own(address: str) -> str:
    """Return the address of the requested page if it belongs to this server, otherwise that of the start page.

    Browsers read a backslash as a slash, drop blanks, and read two slashes as another server.
    """
    own = address.startswith("/") and address[1:2] not in ("/", "\\") and all(" " < sign != "\\" for sign in address)
    return address if own else "/"
