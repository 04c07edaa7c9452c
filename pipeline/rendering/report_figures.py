"""Figures of a report, drawn, with the words around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.records.figure_records import BoundaryFigure, CostFigure
from pipeline.records.results import ReportData

_MARKS = (
    "Filled marks: the measured cost is larger; open marks: smaller; dots: less than the smallest step; their size is "
    "the departure. Dashed: stability boundary of theory."
)


@dataclass(frozen=True)
class Drawing:
    """A figure on the page: panels as ``<svg>`` elements, and the words around them."""

    identifier: str
    title: str
    caption: str
    panels: tuple[str, ...]
    key: str


def drawings(data: ReportData) -> dict[str, Sequence[Drawing]]:
    """Return the figures of a report by the names that its templates use; empty where there is nothing to draw."""
    if not (data.boundaries or data.costs or data.delays or data.responses or data.residuals):
        names = ("boundary", "cost", "delay", "response", "residual")
        return {f"{name}_figures": () for name in names}
    # matplotlib takes 0.6 s, which a report without figures need not wait for
    from pipeline.rendering import figures, residual_panels, response_drawing

    motion = data.result.motion

    def drawn(figure: Any, panels: tuple[str, ...], key: str = "") -> Drawing:
        return Drawing(figure.identifier, _title(figure.title), figure.caption, panels, key)

    return {
        "boundary_figures": [drawn(f, figures.boundaries(f, motion), _line_key(f)) for f in data.boundaries],
        "cost_figures": [drawn(f, figures.cost_maps(f, motion), _map_key(f)) for f in data.costs],
        "delay_figures": [drawn(f, figures.delays(f)) for f in data.delays],
        "response_figures": [drawn(f, response_drawing.response(f, motion)) for f in data.responses],
        "residual_figures": [drawn(f, residual_panels.residuals(f, motion), _MARKS) for f in data.residuals],
    }


def _line_key(figure: BoundaryFigure) -> str:
    """What the lines of a boundary figure mean, as far as it has them."""
    curves = [curve for _, panel in figure.panels for curve in panel]
    kinds = {curve.kind for curve in curves}
    names = (("measured", "solid: measured"), ("theory", "dashed: theory"), ("linear", "dotted: linear condition"))
    text = "; ".join(name for kind, name in names if kind in kinds)
    text = f"{text[:1].upper()}{text[1:]}." if text else ""
    if any(curve.censored is not None and curve.censored.any() for curve in curves):
        text += " Open markers: the tested range ended before an unstable trial."
    return text.strip()


def _map_key(figure: CostFigure) -> str:
    """What lines and marks of a cost figure mean."""
    overshoot = figure.criterion == "overshoot"
    lines = (
        "every 10 percentage points, the heavy one at 0.1 % around the region without"
        if overshoot
        else "two for each doubling, starting at the optimum"
    )
    curves = ""
    if any(m.best_damping is not None for m in figure.maps):
        curves = " Lines across: best damping for each stiffness (solid), best stiffness for each damping (dashed)."
    dots = " and all trials (dots)" if any(m.trial_cost.size for m in figure.maps) else ""
    calm = " Dots in the map: trials without overshoot." if overshoot and len(figure.maps) > 1 else ""
    return (
        f"Outer curve: stability boundary. Green: lines of equal cost, {lines}.{curves} Plus: optimum. "
        f"Below: least cost for each stiffness (line){dots}.{calm}"
    )


def _title(text: str) -> str:
    """Return a title with its first letter raised and without the full stop that the page adds."""
    return (text[:1].upper() + text[1:]).rstrip(".")
