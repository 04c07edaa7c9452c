"""Figures of a report, drawn, with the words around them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from pipeline.records.criteria import OVERSHOOT, criterion_of
from pipeline.records.figure_records import CostMap, Figure, Limits
from pipeline.records.models import FigureKind, Motion
from pipeline.records.results import ReportData
from pipeline.rendering.labels import criterion_name

if TYPE_CHECKING:  # matplotlib behind it takes its time
    from pipeline.rendering.figures.shown import Panel

_MARKS = (
    "Filled marks: the measured cost is larger; open marks: smaller; dots: less than the smallest step; their size is "
    "the departure. Dashed: stability boundary of theory."
)


@dataclass(frozen=True)
class Drawing:
    """A figure on the page: panels as ``<svg>`` elements, and the words around them.

    ``show`` and ``criterion`` are what a figure of costs is chosen by among the others.
    """

    identifier: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    key: str
    show: str = ""
    criterion: str = ""

    @property
    def shown(self) -> list[dict[str, Any]]:
        """What each panel shows, in numbers; see `figures.shown.Panel`."""
        return [panel.shown for panel in self.panels]


def drawings(data: ReportData) -> dict[FigureKind, list[Drawing]]:
    """Return the figures of a report by their kind; empty where there is nothing to draw."""
    motion = data.result.motion
    return {kind: [draw(f, motion) for f in data.figures if f.kind == kind] for kind in get_args(FigureKind)}


def draw(figure: Figure[Any], motion: Motion) -> Drawing:
    """Draw a figure and put the words around it."""
    # matplotlib takes 0.6 s, which a report without figures need not wait for
    from pipeline.rendering.figures import figures, residual_panels, response_drawing, trend_panels

    kinds: dict[str, tuple[Callable[[Figure[Any], Motion], tuple[Panel, ...]], Callable[[Figure[Any]], str]]] = {
        "boundaries": (figures.boundaries, _line_key),
        "plane": (figures.boundaries, _line_key),
        "maps": (figures.cost_maps, _map_key),
        "delay": (figures.delays, lambda _: ""),
        "response": (response_drawing.responses, lambda _: ""),
        "trend": (trend_panels.trends, lambda _: ""),
        "residuals": (residual_panels.residuals, lambda _: _MARKS),
    }
    panels, key = kinds[figure.kind]
    title = (figure.title[:1].upper() + figure.title[1:]).rstrip(".")  # the page adds a full stop
    criterion = criterion_name(figure.criterion) if figure.criterion else ""
    drawn = panels(figure, motion)
    return Drawing(figure.identifier, title, figure.caption, drawn, key(figure), figure.group, criterion)


def _line_key(figure: Figure[Limits]) -> str:
    """What the lines of a boundary figure mean, as far as it has them."""
    curves = [curve for _, panel in figure.panels for curve in panel]
    kinds = {curve.kind for curve in curves}
    names = (("measured", "solid: measured"), ("theory", "dashed: theory"), ("linear", "dotted: linear condition"))
    text = "; ".join(name for kind, name in names if kind in kinds)
    text = f"{text[:1].upper()}{text[1:]}." if text else ""
    if any(curve.censored is not None and curve.censored.any() for curve in curves):
        text += " Open markers: the tested range ended before an unstable trial."
    return text.strip()


def _map_key(figure: Figure[CostMap]) -> str:
    """What lines and marks of a cost figure mean."""
    overshoot = criterion_of(figure.criterion).family is OVERSHOOT
    lines = (
        "every 10 percentage points, the heavy one at 0.1 % around the region without"
        if overshoot
        else "two for each doubling, starting at the optimum"
    )
    curves = ""
    if any(m.best_damping is not None for m in figure.panels):
        curves = " Lines across: best damping for each stiffness (solid), best stiffness for each damping (dashed)."
    tried = any(m.trial_cost.size for m in figure.panels)
    smooth = "; measured costs are smoothed over the trials around" if tried else ""
    single = ", of experiments the best single trial" if tried else ""
    dots = " and all trials (dots)" if any(m.trial_cost.size for m in figure.panels) else ""
    calm = " Dots in the map: trials without overshoot." if overshoot and len(figure.panels) > 1 else ""
    return (
        f"Outer curve: stability boundary. Green: lines of equal cost, {lines}{smooth}.{curves} Plus: optimum{single}. "
        f"Below: least cost for each stiffness (line){dots}.{calm}"
    )
