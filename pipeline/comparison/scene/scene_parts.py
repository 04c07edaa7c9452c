"""Which figures, tables and overlays of a report a scene asks for, and why the others are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pipeline.comparison.scene.scene import LEAVE_OUT, RUN, PlannedStage, SceneData
from pipeline.comparison.tables_d import layouts
from pipeline.records.figure_records import Figure, Limits
from pipeline.records.models import FigureKind, Overlay, Shown
from pipeline.rendering.labels import criterion_name

FIGURE_NAMES: dict[FigureKind, str] = {
    "response": "first response",
    "boundaries": "stability boundaries",
    "plane": "boundaries in the normalised plane",
    "maps": "cost maps",
    "residuals": "measured minus theory",
    "delay": "costs over delay",
    "trend": "limits and estimates over experiments",
    "trials": "trials to look into",
}

ESTIMATES = "boundaries-estimates"
"""Boundary figure that is asked for by an overlay."""

_KINDS: dict[str, Overlay] = {
    "theory": "theory",
    "band": "theory",
    "envelope": "band",
    "linear": "linear",
    "passive": "passive",
    "bound": "bound",
    "friction": "friction",
    "robust": "robust",
}
"""Overlay that a kind of curve belongs to; measured curves are always drawn."""


def plan_parts(data: SceneData) -> list[PlannedStage]:
    """Return for each figure and table of the report what is done with it, and why."""
    shown = data.scene.shown
    plan = []
    for kind, name in FIGURE_NAMES.items():
        if not shown.has_figure(kind):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "the scene does not ask for it"))
        elif kind == "delay" and not any(table.kind == "delay" for table in layouts(data)):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "no experiment has added delay"))
        elif (kind == "plane" and len(data.experiments) < 2) or (kind == "trend" and len(data.experiments) < 2):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "there is one experiment only"))
        else:
            plan.append(PlannedStage(f"figure: {name}", RUN, "with the report, where there is data for it"))
    for table in layouts(data):
        asked = shown.has_table(table.name)
        reason = "; ".join(map(criterion_name, table.criteria)) if asked else "the scene does not ask for it"
        plan.append(PlannedStage(f"table: {table.name}", RUN if asked else LEAVE_OUT, reason))
    return plan


def with_overlays(figures: Sequence[Figure[Limits]], shown: Shown) -> tuple[Figure[Limits], ...]:
    """Return boundary figures with the curves that are asked for.

    A figure without measured curve, or that is not asked for as a whole, is left out; so is a panel without curves.
    """
    kept = []
    for figure in figures:
        if not shown.has_figure(figure.kind) or (figure.identifier == ESTIMATES and not shown.has_overlay("estimates")):
            continue
        panels = [
            (title, tuple(curve for curve in curves if _is_asked(curve.kind, figure, shown)))
            for title, curves in figure.panels
        ]
        kept.append(replace(figure, panels=tuple((title, curves) for title, curves in panels if curves)))
    return tuple(figure for figure in kept if figure.panels)


def _is_asked(kind: str, figure: Figure[Limits], shown: Shown) -> bool:
    if kind in ("measured", "use", "stable", "unstable") or (kind == "theory" and figure.identifier == ESTIMATES):
        return True
    return shown.has_overlay(_KINDS[kind])
