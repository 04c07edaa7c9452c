"""Pages that compare experiments and plan the next walls, and the form for a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, Response

from pipeline.comparison.against import compare_pair
from pipeline.records.criteria import REPORTED
from pipeline.records.models import Motion
from pipeline.records.results import PairDifference, Side, SourcedLoop
from pipeline.rendering.labels import UNITS
from pipeline.service.catalogue import Selection
from pipeline.service.pages.frame import Waited, busy, kept, page_of
from pipeline.service.problems import Problem
from pipeline.service.shared import Shared, run_of
from pipeline.store.names import name_of_folder
from pipeline.theory.predictions import Theory

comparing = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

MOST_RUNS = 6

Run = tuple[str, str, Mapping[str, Any]]
"""Device, experiment, and the document of its comparison with theory."""

Runs = Annotated[list[str], Query(max_length=50)]
Plane = Annotated[Literal["", "physical", "normalised"], Query()]


@comparing.get("/compare")
def compare(service: Shared, request: Request, runs: Runs = [], plane: Plane = "") -> Response:  # noqa: B006
    """Compare up to six experiments, whose names are those of `frame.run_of`."""
    names = [word for part in runs for word in part.split(",") if word]
    chosen = [tuple(map(name_of_folder, name.split("/"))) for name in dict.fromkeys(names)]
    if len(chosen) > MOST_RUNS or any(len(run) != 2 for run in chosen):
        raise Problem(
            422, "Compare up to six experiments.", where="runs", expected="device/experiment, ...", found=names
        )
    found = [(device, experiment, *service.experiment(device, experiment)) for device, experiment in chosen]
    compared = [(d, e, document) for d, e, document, _ in found if document]
    waiting = [(d, e, service.database.job(job)) for d, e, _, job in found if job]
    possible = planes(compared)
    shown = plane if plane in possible else next(iter(possible), "")
    drawn, job = None, None
    if shown and not waiting:
        drawn, job = service.drawn("limits", [(d, e) for d, e, _ in compared], plane=shown)
    waiting += [("limits", "", service.database.job(job))] if job else []
    query = [("runs", run_of(d, e)) for d, e in chosen]
    return page_of(
        service, request, "compare.html.j2", runs=compared, waiting=waiting, busy=any(busy(job) for *_, job in waiting),
        planes=possible, plane=shown, plot=drawn,
        pairs=[(d, e, *differences(compared[0], (d, e, document))) for d, e, document in compared[1:]],
        criteria=REPORTED, all=service.catalogue.experiments, chosen={run_of(*run) for run in chosen},
        switch={name: urlencode([*query, ("plane", name)]) for name in possible},
    )  # fmt: skip


@comparing.get("/plan")
def plan(
    service: Shared, request: Request, run: str = "", goal: Literal["boundary", "optimum"] = "boundary"
) -> Response:
    """Show the next walls of an experiment, their purpose, and the current accuracy of the limits."""
    known = [run_of(e.device, e.experiment) for e in service.catalogue.experiments]
    chosen = run or next(iter(known), "")
    if run and run not in known:
        raise Problem(404, "There are no trials of this experiment.", where="run", expected=known, found=run)
    shown, device, experiment = Waited(), "", ""
    motion: Motion = "translation"
    if chosen:
        device, experiment = map(name_of_folder, chosen.split("/"))
        shown = kept(service, lambda: service.plan(device, experiment, goal))
        own = Selection({"device": device, "experiment": experiment}, {})
        trials, _ = service.catalogue.page(own, "stiffness", 1, None)
        motion = trials[0].motion if trials else motion
    return page_of(
        service, request, "plan.html.j2", known=known, chosen=chosen, goal=goal, units=UNITS[motion], device=device,
        experiment=experiment, plan=shown.drawn, job=shown.job, problem=shown.problem,
    )  # fmt: skip


def planes(runs: Sequence[Run]) -> dict[str, str]:
    """Return the titles of the planes in which limits can be superimposed, keyed by the names of the planes. The plane
    of K and B requires that all experiments have the same kind of motion. The plane of alpha and beta requires that all
    masses are known.
    """
    found = {}
    if runs and len({document["motion"] for *_, document in runs}) == 1:
        found["physical"] = "stiffness K and damping B"
    if runs and all(_units(document) for *_, document in runs):
        found["normalised"] = "α and β, normalised by mass and sampling period"
    return found


def differences(first: Run, second: Run) -> tuple[PairDifference | None, str]:
    """Return the differences of two experiments, second minus first. If the experiments are not comparable, return None
    and the reason.
    """
    scales = None
    if first[0] != second[0]:
        own, others = _units(first[2]), _units(second[2])
        if own is None or others is None:
            return None, (
                "two devices are compared in the plane of α and β, which requires the mass of both, but one of them "
                "has neither a device file nor an estimated mass"
            )
        scales = own, others
    one, other = (
        Side(
            device=device,
            experiment=experiment,
            version=document["provenance"].get("version", "?"),
            code=document["provenance"].get("code", "?"),
            simulated=document["simulated"],
        )
        for device, experiment, document in (first, second)
    )
    documents = first[2]["experiments"][0], second[2]["experiments"][0]
    return compare_pair((one, other), documents, first[2]["motion"], scales), ""


def _units(document: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the stiffness and damping for alpha = 1 and beta = 1, or None without a theory."""
    theory = document["experiments"][0]["theory"]
    if theory is None:
        return None
    units = Theory(SourcedLoop.model_validate(theory)).units
    return units.stiffness, units.damping
