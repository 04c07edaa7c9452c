"""Which figures and tables of a report a scene asks for, and why the others are left out."""

from __future__ import annotations

from pipeline.comparison.scene.scene import LEAVE_OUT, RUN, PlannedStage, SceneData
from pipeline.comparison.tables_d import layouts
from pipeline.records.models import FigureKind
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
