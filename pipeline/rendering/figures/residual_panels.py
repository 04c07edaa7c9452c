"""Where measured costs depart from theory: one mark a cell, its size the departure, filled above and open below.

Size and filling tell all, so that the map can be read in grey; the colours are the pair of the palette that all common
kinds of colour blindness tell apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from pipeline.base.wording import counted
from pipeline.records.batch import Floats
from pipeline.records.criteria import criterion_of
from pipeline.records.figure_records import Figure, ResidualMap
from pipeline.records.models import Motion
from pipeline.rendering.figures import canvas, panels, style
from pipeline.rendering.figures.shown import Panel, tell
from pipeline.rendering.labels import percent_text

RATIO_STEPS = (1.05, 1.1, 1.25, 1.5)
"""Ratios of costs, one way or the other, from which marks grow: from the scatter of single trials to half as much
again."""
OVERSHOOT_STEPS = (0.01, 0.02, 0.05, 0.1)
"""Differences of overshoot from which marks grow: one percentage point is what a sensor's step makes of it."""
SIZES = (2.0, 4.0, 6.0, 8.5, 11.0)
"""Sizes of the marks [px], from no departure to the largest."""
RING = 2.6
"""Difference between an open mark and its hole [px]."""
SIZE = (350.0, 300.0)
KEY = 34.0
"""Height of the key below the axes [px]."""


def residuals(figure: Figure[ResidualMap], motion: Motion = "translation") -> tuple[Panel, ...]:
    """Draw residual maps of one criterion on equal axes."""
    reach = canvas.reach([m.boundary for m in figure.panels])
    names = canvas.plane_labels(motion)

    def paint(shown: ResidualMap, axes: Axes) -> tuple[str, str]:
        edge = shown.boundary
        canvas.plane(axes, reach)
        axes.plot(edge.stiffness, edge.damping, color=style.INK, lw=1.2, ls=style.LINES["theory"])
        _marks(axes, shown.stiffness, shown.damping, _classes(shown.residual, figure.criterion))
        points = _differs(figure.criterion)
        percent = 100 * (shown.residual if points else 2.0**shown.residual - 1)
        unit = "points" if points else "%"
        tell(axes, "measured against theory", shown.stiffness, shown.damping, percent, f"departure [{unit}]")
        title = f"{shown.label}: median {departure(shown.median, figure.criterion)}"
        canvas.frame(axes, *names, title=title)
        _key(axes, figure.criterion)
        return f" {shown.label}", _describe(shown, figure.criterion)

    return canvas.draw_panels(figure, SIZE, [(52, 44 + KEY, 12, 26)], paint)


def departure(residual: float, criterion: str, places: int = 1) -> str:
    """Return a residual as a reader says it: percent of theory, or percentage points of overshoot."""
    if not np.isfinite(residual):
        return "not known"
    value = 100 * (residual if _differs(criterion) else 2.0**residual - 1)
    text = percent_text(value, places)
    return f"{text} {'points' if _differs(criterion) else '%'}"


def _differs(criterion: str) -> bool:
    """Tell whether costs are compared by their difference."""
    return bool(criterion_of(criterion).family.levels)


def _steps(criterion: str) -> Floats:
    return np.array(OVERSHOOT_STEPS) if _differs(criterion) else np.log2(RATIO_STEPS)


def _classes(residual: Floats, criterion: str) -> Floats:
    """Signed class of each residual: 0 for none, up to +-4."""
    size = np.searchsorted(_steps(criterion), np.abs(residual), side="right")
    return np.asarray(np.sign(residual) * size)


def _marks(axes: Axes, x: Floats, y: Floats, classes: Floats, *, clip: bool = True) -> None:
    for value in range(-len(SIZES) + 1, len(SIZES)):
        at = classes == value
        size = SIZES[abs(value)]
        colour = style.INK if value == 0 else style.VERMILLION if value > 0 else style.BLUE
        panels.dots(axes, x[at], y[at], colour, size, square=value != 0, clip=clip)
        if value < 0:
            panels.dots(axes, x[at], y[at], style.PAPER, size - RING, square=True, clip=clip)


def _key(axes: Axes, criterion: str) -> None:
    """Draw what the marks mean below the axes."""
    names = {sign: [departure(sign * step, criterion, 0) for step in _steps(criterion)] for sign in (-1, 1)}
    box = axes.bbox
    room = (box.x1 - box.x0) / 9.0
    places = box.x0 + room * (np.arange(9) + 0.5)
    back = axes.transData.inverted()
    points = back.transform(np.column_stack([places, np.full(9, box.y0 - 50.0)]))
    _marks(axes, points[:, 0], points[:, 1], np.arange(-4.0, 5.0), clip=False)
    look: dict[str, Any] = {"transform": None, "fontsize": 9, "ha": "center", "va": "top"}
    for place, value in zip(places, range(-4, 5), strict=True):
        text = "less" if value == 0 else names[1 if value > 0 else -1][abs(value) - 1]
        last = value == 4 and not _differs(criterion)  # the unit once: there is no room for nine
        axes.text(place, box.y0 - 59.0, text if last else text.split(" ")[0], **look)


def _describe(shown: ResidualMap, criterion: str) -> str:
    steps = _steps(criterion)
    above, below = int((shown.residual >= steps[0]).sum()), int((shown.residual <= -steps[0]).sum())
    same = len(shown.residual) - above - below
    return (
        f"Measured against theory in {counted(len(shown.residual), 'cell')} with {counted(shown.trials, 'trial')}: "
        f"median {departure(shown.median, criterion)}; larger in {counted(above, 'cell')}, smaller in {below}, about "
        f"equal in {same}."
    )
