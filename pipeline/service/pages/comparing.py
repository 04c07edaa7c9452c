"""The page that lays experiments beside each other, its file for other computers, and the form for a report."""

from __future__ import annotations

import time
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from pipeline.records.criteria import REPORTED
from pipeline.service.pages.frame import busy, fields_of, page_of
from pipeline.service.pages.page_figures import differences, limits, planes
from pipeline.service.problems import Problem
from pipeline.service.shared import ComparisonRequest, Service, Shared, run_of
from pipeline.store.names import name_of_folder

comparing = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

MOST_RUNS = 6

Runs = Annotated[list[str], Query(max_length=50)]
Plane = Annotated[Literal["", "physical", "normalised"], Query()]


@comparing.get("/compare")
def compare(service: Shared, request: Request, runs: Runs = [], plane: Plane = "") -> Response:  # noqa: B006
    """Show up to six experiments beside each other."""
    return page_of(service, request, "compare.html.j2", **_content(service, runs, plane))


@comparing.get("/compare.html")
def file(service: Shared, request: Request, runs: Runs = [], plane: Plane = "") -> Response:  # noqa: B006
    """Return the same as one file that needs no server; the page itself where something is still computed."""
    content = _content(service, runs, plane)
    if content["waiting"] or not content["runs"]:
        return RedirectResponse(f"/compare?{content['query']}", 303)
    response = page_of(service, request, "compare.html.j2", **content, offline=True)
    response.headers["content-disposition"] = 'attachment; filename="compare.html"'
    return response


@comparing.post("/compare")
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


def _content(service: Service, asked: list[str], plane: str) -> dict[str, Any]:
    """Return what the template shows of some experiments, each as `frame.run_of` names it."""
    names = [word for part in asked for word in part.split(",") if word]
    chosen = [tuple(map(name_of_folder, name.split("/"))) for name in dict.fromkeys(names)]
    if len(chosen) > MOST_RUNS or any(len(run) != 2 for run in chosen):
        raise Problem(
            422, "Compare up to six experiments.", where="runs", expected="device/experiment, ...", found=names
        )
    found = [(device, experiment, *service.experiment(device, experiment)) for device, experiment in chosen]
    runs = [(d, e, document) for d, e, document, _ in found if document]
    waiting = [(d, e, service.database.job(job)) for d, e, _, job in found if job]
    possible = planes(runs)
    shown = plane if plane in possible else next(iter(possible), "")
    query = [("runs", run_of(d, e)) for d, e in chosen]
    return {
        "runs": runs,
        "waiting": waiting,
        "busy": any(busy(job) for *_, job in waiting),
        "planes": possible,
        "plane": shown,
        "plot": limits(runs, shown) if shown else None,
        "pairs": [(d, e, *differences(runs[0], (d, e, document))) for d, e, document in runs[1:]],
        "criteria": REPORTED,
        "all": service.catalogue.trials().experiments,
        "chosen": {run_of(*run) for run in chosen},
        "query": urlencode([*query, *([("plane", plane)] if plane else [])]),
        "switch": {name: urlencode([*query, ("plane", name)]) for name in possible},
        "now": time.time(),
    }
