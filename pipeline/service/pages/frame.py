"""Templates, addresses and forms that all pages share. A form is valid only for this server and this browser."""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote, urlencode

from fastapi import Depends, Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from pipeline.base.json_object import JsonObject
from pipeline.base.wording import counted
from pipeline.records.findings import Estimate
from pipeline.rendering import labels
from pipeline.rendering.report.page_template import FILTERS, TEMPLATES
from pipeline.rendering.report.report_against import value_name
from pipeline.service.database import Job
from pipeline.service.problems import Problem
from pipeline.service.rest.remarks import tag_of
from pipeline.service.security import FORM, form_token, is_form
from pipeline.service.shared import Kept, Service, run_of, service_of
from pipeline.store.names import folder_name

HERE = Path(__file__).parent

LONGEST_REASON = 90
"""Largest number of characters of the reason for a refusal in the list of jobs."""

LOOK_S = 0.02
"""Polling interval for a job that a page waits for [s]."""


@cache
def _environment() -> Environment:
    found = Environment(
        loader=FileSystemLoader([HERE / "templates", TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    own = {"short": _short, "when": _when, "ago": _ago, "about": _about, "sorting": _sorting}
    own |= {
        "etag": tag_of,
        "rest": _rest,
        "page": _page,
        "in_digits": _in_digits,
        "value_name": value_name,
        "did": _did,
        "lasted": _lasted,
    }
    own |= {"cost_of": labels.cost_text, "quantity": labels.quantity_name, "label": labels.criterion_label}
    found.filters |= FILTERS | own
    found.globals |= {each.__name__: each for each in (experiment_url, device_url, run_of)} | {"unit_of": labels.UNITS}
    return found


def style_sheet() -> str:
    """Return the style sheet of reports with additions for pages of the service."""
    sheets = (TEMPLATES / "report.css", HERE / "static" / "service.css")
    return "\n".join(sheet.read_text("utf-8") for sheet in sheets)


def _short(value: float | None) -> str:
    return "–" if value is None else labels.significant(value, 4)


def _in_digits(estimate: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return the value of an estimate and the ends of its interval, with as many digits as the width of the interval
    justifies."""
    return labels.estimate_texts(Estimate.model_validate(estimate))


def _when(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def _did(job: Job) -> str:
    """Return the outcome of a job in a few words. The text is empty until the job has ended."""
    result = job.result or {}
    if job.state == "failed":
        return job.problem.detail if job.problem else ""
    if job.kind == "upload" and result:
        parts = [f"{result[name]} {name}" for name in ("ingested", "skipped") if result[name]]
        reasons = Counter(each["reason"] for each in result["quarantined"])
        parts += [f"{n} refused: {labels.shortened(reason, LONGEST_REASON)}" for reason, n in reasons.most_common(2)]
        return "; ".join(parts) or "no logs"
    if job.kind == "stages" and result:
        failed = f", {len(result['failed'])} failed" if result["failed"] else ""
        return f"{counted(result['computed'], 'experiment')} computed{failed}"
    return ""


def _ago(since: float) -> str:
    """Return the time elapsed since an event, in words."""
    return _lasted(max(time.time() - since, 0.0))


def _lasted(passed: float) -> str:
    """Return a duration [s] in words."""
    if passed < 100:
        return f"{passed:.0f} s"
    return f"{passed / 60:.0f} min" if passed < 6000 else f"{passed / 3600:.0f} h"


_WORDS = {
    "upload": "Ingest of logs", "stages": "Verdicts and costs", "experiment": "Comparison with theory",
    "plan": "Next wall", "comparison": "Report", "optimum": "Optimum by theory", "drawing": "Figure",
}  # fmt: skip


def _about(job: Job) -> str:
    """Return a description of a job."""
    asked = job.request.get("request", {})
    places = asked.get("places") or [[asked.get("device", ""), *asked.get("experiments", ())]]
    places += [list(asked["against"].values())] if asked.get("against") else []
    where = "; ".join(", ".join([", experiment ".join(place[:2]), *place[2:]]) for place in places if place[0])
    return f"{_WORDS[job.kind]}{' of ' if where else ''}{where}"


def _sorting(state: Mapping[str, str], name: str) -> str:
    """Return the address of the same trials sorted by a column. If the trials are already sorted by this column, the
    order is reversed.
    """
    return urlencode({**state, "sort": f"-{name}" if state["sort"] == name else name})


@lru_cache(maxsize=4096)  # each row of a list has two names
def segment(name: str) -> str:
    """Return a name as a part of an address. A name with special characters is quoted twice."""
    return quote(folder_name(name), safe="")


def device_url(device: str) -> str:
    """Return the address of the page of a device."""
    return f"/devices/{segment(device)}"


def experiment_url(device: str, experiment: str) -> str:
    """Return the address of the page of an experiment."""
    return f"{device_url(device)}/experiments/{segment(experiment)}"


def _rest(of: Sequence[str]) -> str:
    """Return the REST address of a trial, an experiment or a device, given by the kind of object and its names."""
    return "/".join((f"{of[0]}s", *map(segment, of[1:])))


def _page(of: Sequence[str]) -> str:
    return experiment_url(*of[1:]) if of[0] == "experiment" else f"/{_rest(of)}"


def page_of(service: Service, request: Request, template: str, status: int = 200, **content: object) -> HTMLResponse:
    """Return a page rendered from its template. The forms of the page contain the token of the browser."""
    browser = request.cookies.get(FORM) or request.scope["state"].setdefault("form", secrets.token_urlsafe(16))
    who = {"login": not service.settings.loopback, "form": form_token(service.database, browser)}
    given = {"role": request.state.role, "who": request.state.who, "path": request.url.path, **who, **content}
    return HTMLResponse(_environment().get_template(template).render(**given), status)


def part_of(template: str, **content: object) -> Markup:
    """Render a part of a page that is the same for all users."""
    return Markup(_environment().get_template(template).render(**content))


def check(service: Service, request: Request, token: str) -> None:
    """Raise a problem if this server did not issue a form to this browser."""
    if not is_form(service.database, request.cookies, token):
        raise Problem(403, "The form is not from this server, or is too old. Reload the page.", where="form")


async def fields_of(request: Request) -> dict[str, list[str]]:
    """Return the fields of a form that this server issued."""
    form = await request.form()
    fields: dict[str, list[str]] = {}
    for name, value in form.multi_items():
        fields.setdefault(name, []).append(str(value))
    check(service_of(request), request, fields.get("form", [""])[0])
    return fields


Fields = Annotated[dict[str, list[str]], Depends(fields_of)]


class Waited(NamedTuple):
    """A stored document (``drawn``), or the job that makes it, or the problem if there is neither."""

    drawn: JsonObject | None = None
    job: str | None = None
    problem: str | None = None


def kept(service: Service, ask: Callable[[], Kept], wait_s: float = 0.0) -> Waited:
    """Return a stored document, or the job that makes it. Wait for up to `wait_s` for the job."""
    until = time.monotonic() + wait_s
    try:
        document, job = ask()
        while job and time.monotonic() < until and busy(service.database.job(job)):
            time.sleep(LOOK_S)
        if job and wait_s and not busy(service.database.job(job)):
            document, job = ask()
    except Problem as error:
        if error.status == 404:
            raise
        return Waited(problem=str(error))
    found = service.database.job(job) if job else None
    return Waited(document, job, found.problem.detail if found and found.problem else None)


def busy(job: Job | None) -> bool:
    """Return True if a job has not ended."""
    return job is not None and not job.has_ended
