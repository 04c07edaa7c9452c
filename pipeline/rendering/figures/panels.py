"""What one panel of a figure shows: boundary curves, contour lines of a cost, its front view.

Numbers come and are drawn in SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.transforms import IdentityTransform
from matplotlib.tri import Triangulation
from matplotlib.typing import CapStyleType

from pipeline.records.batch import Booleans, Floats
from pipeline.records.criteria import criterion_of
from pipeline.records.figure_records import CostMap, Curve, Figure
from pipeline.rendering.figures import style
from pipeline.rendering.figures.shown import tell
from pipeline.rendering.labels import cost_text, printed_scale, significant, with_unit

LINES_PER_DOUBLING = 2
"""Contour lines of costs without levels of their own, as in Figs. 6.5 to 6.7."""
DOUBLINGS = 5
"""Contours end at 32 times the optimum; beyond, they merge with the stability boundary."""
FRONT_RANGE = 4.0
"""The front view reaches to this multiple of the highest optimum: all that matters for a choice."""
LONGEST_EDGE = 2.3
"""Longest side, in grid steps, of a triangle that contours cross: spans one missing trial at most."""
LABEL_SIZE = (0.12, 0.042)
"""Width and height of a direct label [fraction of the axes]; closer ones overlap and go into the legend."""
SHORT_LABEL = 9
"""Longest text [characters] that is written at a curve."""
KINDS = (
    "use",
    "stable",
    "unstable",
    "envelope",
    "passive",
    "robust",
    "measured",
    "theory",
    "linear",
    "bound",
    "friction",
    "band",
)
"""Kinds of curves in the order in which they are drawn: areas first."""
LINE_WIDTHS = {
    "theory": 1.4,
    "linear": 1.6,
    "bound": 1.6,
    "friction": 1.2,
    "band": 1.0,
    "passive": 0.8,
    "robust": 0.8,
    "use": 1.4,
}
THIN = 0.9
"""Width of theory curves where there is one to each of many measured ones."""
SHADES = {"envelope": 0.13, "use": 0.3, "passive": 0.22, "measured": 0.45}
"""Opacity of filled areas: light enough for the lines and dots on them, apart from each other in grey."""
INTERVAL = 6.0
"""Width of the bar of an interval [px]."""
LABELLED_KINDS = ("measured", "theory")
"""Kinds of curves whose tip may bear a label; linear conditions and bands have none of their own."""


def theory_colour(curves: Sequence[Curve]) -> str:
    """Return the colour of theory curves: that of text where they have no partners, empty where each has one.

    One theory curve to each of several measured ones share their colour; otherwise theory would borrow that of an
    experiment which it does not belong to.
    """
    measured, theory = (sum(curve.kind == kind for curve in curves) for kind in ("measured", "theory"))
    return "" if measured == 0 or measured == theory > 1 else style.INK


def draw_curves(axes: Axes, curves: Sequence[Curve], *, thin: bool = False) -> dict[str, list[Artist]]:
    """Draw boundaries, on request with thin theory; return by kind what needs a legend: curves without a label."""
    alone = theory_colour(curves)
    entries: dict[str, list[Artist]] = {}
    for kind in KINDS:
        group = [curve for curve in curves if curve.kind == kind]
        # All of a kind or none: a legend with some of the curves would be read as complete.
        places = _label_places(group, axes.get_xlim()[1], axes.get_ylim())
        for index, curve in enumerate(group):
            number = index if curve.number is None else curve.number
            own = alone if kind == "theory" and alone else style.SERIES[number % len(style.SERIES)]
            colour = own if kind in LABELLED_KINDS else style.GREEN if kind == "use" else style.INK
            artist = _draw_curve(axes, curve, colour, style.MARKERS[number % len(style.MARKERS)], thin=thin)
            if places:
                look: dict[str, Any] = {"color": colour, "va": "center", "fontsize": 9.5, "bbox": style.BEHIND_TEXT}
                axes.annotate(curve.label, places[index], (4, 0), "axes fraction", textcoords="offset points", **look)
            elif not curve.label.startswith("_"):
                entries.setdefault(kind, []).append(artist)
    return entries


def _draw_curve(axes: Axes, curve: Curve, colour: str, marker: str = "o", *, thin: bool = False) -> Artist:
    look: dict[str, Any] = {"color": colour, "ls": style.LINES[curve.kind], "label": curve.label}
    k = curve.stiffness
    if curve.kind == "envelope":
        return _fill_between(axes, curve, colour)
    if curve.kind in style.DOTS:
        return _draw_trials(axes, curve, look)
    if curve.kind == "use":
        axes.fill(k, curve.damping, color=colour, alpha=SHADES["use"], lw=0)
    if curve.kind == "passive":
        axes.fill(k, curve.damping, color=colour, alpha=SHADES["passive"], lw=0)
    if curve.kind != "measured":
        width = THIN if thin and curve.kind == "theory" else LINE_WIDTHS[curve.kind]
        return axes.plot(k, curve.damping, lw=width, **look)[0]
    _draw_intervals(axes, curve, colour)
    where = np.zeros(len(k), dtype=bool) if curve.censored is None else np.asarray(curve.censored, dtype=bool)
    # a lower bound is no limit: a line through it would claim one
    (line,) = axes.plot(np.where(where, np.nan, k), curve.damping, lw=1.4, marker=marker, ms=3.4, mew=0, **look)
    if where.any():
        hollow: dict[str, Any] = {"mfc": style.PAPER, "mec": colour, "mew": 1.1}
        ended = f"{curve.label}: at least"
        axes.plot(k[where], curve.damping[where], ls="none", marker=marker, ms=5, label=ended, **hollow)
    return line


def _draw_trials(axes: Axes, curve: Curve, look: dict[str, Any]) -> Artist:
    """Draw one mark a trial; the many stable ones as dots of one path, which stand in the legend by themselves."""
    mark = style.DOTS[curve.kind]
    x, y = curve.stiffness, curve.damping
    if curve.kind == "stable":
        dots(axes, x, y, look["color"], mark["ms"])
        tell(axes, curve.label, x, y)
        x = y = np.empty(0)
    return axes.plot(x, y, **look, **mark)[0]


def _draw_intervals(axes: Axes, curve: Curve, colour: str) -> None:
    """Draw what measured limits leave open as a pale bar at each damping; none where nothing bounds it from below."""
    if curve.low is None or curve.high is None:
        return
    known = np.isfinite(curve.low) & np.isfinite(curve.high)
    low, high, b = (values[known] for values in (curve.low, curve.high, curve.damping))
    for side, stiffness in (("from", low), ("to", high)):
        tell(axes, f"{curve.label}: 95 % {side}", stiffness, b)
    bounded = low > 0
    low, high, b = low[bounded], high[bounded], b[bounded]
    if len(b):
        x, y = (np.stack([*ends, np.full(len(b), np.nan)], axis=1).ravel() for ends in ((low, high), (b, b)))
        axes.plot(x, y, color=colour, alpha=SHADES["measured"], lw=INTERVAL, solid_capstyle="butt", label="_interval")


def _fill_between(axes: Axes, curve: Curve, colour: str) -> Artist:
    """Fill what lies between the two stiffnesses at each damping."""
    assert curve.low is not None, "an envelope has both sides"
    assert curve.high is not None, "an envelope has both sides"
    known = np.isfinite(curve.low) & np.isfinite(curve.high)
    low, high, b = curve.low[known], curve.high[known], curve.damping[known]
    outline = (np.append(low, high[::-1]), np.append(b, b[::-1]))
    return axes.fill(*outline, color=colour, alpha=SHADES[curve.kind], lw=0, label=curve.label)[0]


def legend_entries(curves: Sequence[Curve], reach: tuple[float, float, float]) -> int:
    """Return how many curves have no room for their label and need a legend; ``reach`` is that of `canvas.reach`."""
    kinds = {curve.kind for curve in curves}
    shown = [curve for curve in curves if not curve.label.startswith("_")]
    groups = [[curve for curve in shown if curve.kind == kind] for kind in kinds]
    return sum(len(group) for group in groups if not _label_places(group, reach[0], reach[1:]))


def _label_places(curves: Sequence[Curve], largest: float, damping: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the tips of the curves [axes fraction] if a short label fits at each of them, else nothing."""
    places: list[tuple[float, float]] = []
    for curve in curves:
        known = np.isfinite(curve.stiffness) & np.isfinite(curve.damping)
        hidden = curve.label.startswith("_")
        if hidden or curve.kind not in LABELLED_KINDS or len(curve.label) > SHORT_LABEL or not known.any():
            return []
        tip = int(np.argmax(np.where(known, curve.stiffness, -np.inf)))
        x = float(curve.stiffness[tip]) / largest
        y = (float(curve.damping[tip]) - damping[0]) / (damping[1] - damping[0])
        if x > 1 or any(abs(x - a) < LABEL_SIZE[0] and abs(y - b) < LABEL_SIZE[1] for a, b in places):
            return []
        places.append((x, y))
    return places


def draw_map(axes: Axes, cost_map: CostMap, criterion: str) -> None:
    """Draw the stability boundary, the contour lines of the cost and the optimum as a blue plus."""
    _draw_curve(axes, replace(cost_map.boundary, label="_"), style.INK)
    if not np.isfinite(cost_map.cost).any():
        few = "too few trials" if np.isfinite(cost_map.trial_cost).any() else "no trial"
        axes.text(0.5, 0.5, f"{few} with this cost", transform=axes.transAxes, ha="center")
        return
    family = criterion_of(criterion).family
    if family.none:
        calm = cost_map.trial_cost <= family.none
        dots(axes, cost_map.trial_stiffness[calm], cost_map.trial_damping[calm], style.INK, 2.4)
    _draw_contours(axes, cost_map, criterion)
    for curve, line in ((cost_map.best_damping, "-"), (cost_map.best_stiffness, style.LINES["theory"])):
        if curve is not None:
            axes.plot(curve.stiffness, curve.damping, color=style.INK, lw=1.1, ls=line, label=curve.label)
    best = cost_map.optimum
    if best is not None:
        axes.plot(best.stiffness, best.damping, "+", color=style.BLUE, ms=13, mew=2.4, label="optimum")


def _draw_contours(axes: Axes, cost_map: CostMap, criterion: str) -> None:
    """Draw lines of equal cost, heavier at whole doublings, which can be counted also in grey; theory has numbers."""
    known = np.isfinite(cost_map.cost)
    levels = _levels(criterion, cost_map.cost[known])
    if not levels.size:
        return
    edge = criterion_of(criterion).family.levels[:1]
    if edge:
        wide, labelled = np.where(levels <= edge, 1.8, 1.0), levels[levels > edge][::2]
    else:
        whole = np.arange(levels.size) % LINES_PER_DOUBLING == LINES_PER_DOUBLING - 1
        wide, labelled = np.where(whole, 1.3, 0.8), levels[1::LINES_PER_DOUBLING]
    shade = [(*to_rgb(style.GREEN), alpha) for alpha in np.linspace(1.0, 0.45, levels.size)]
    look: dict[str, Any] = {"levels": levels, "colors": shade, "linewidths": wide}
    if cost_map.kind == "theory":
        shown = cost_map.cost if cost_map.lines is None else cost_map.lines
        lines = axes.contour(cost_map.stiffness, cost_map.damping, shown, **look)
        text: dict[str, Any] = {"fontsize": 8.5, "colors": style.INK, "inline_spacing": 2}
        factor = printed_scale(criterion)
        axes.clabel(lines, labelled[:2], fmt=lambda level: significant(level * factor, 3), **text)
        return
    triangles = _triangles(cost_map, known)
    if triangles is not None:
        axes.tricontour(triangles, cost_map.cost[known], **look)


def _levels(criterion: str, cost: Floats) -> Floats:
    """Return the contour levels inside the range of the costs: those of its family, else two a doubling."""
    low, high = float(cost.min()), float(cost.max())
    levels = np.array(criterion_of(criterion).family.levels)
    if not levels.size:
        # A level that equals many costs exactly (settling times are whole numbers) would fray into plateaus.
        exponents = np.arange(1, DOUBLINGS * LINES_PER_DOUBLING + 1) / LINES_PER_DOUBLING
        levels = low * 2.0**exponents * (1 + 1e-6)
    return np.asarray(levels[(levels > low) & (levels < high)])


def draw_front(axes: Axes, cost_map: CostMap, criterion: str, top: float) -> None:
    """Draw the least cost for each stiffness, all trials as dots, and the optimum with its cost."""
    factor = printed_scale(criterion)
    axes.set_ylim(0, top * factor)
    inside = cost_map.trial_cost <= top
    dots(axes, cost_map.trial_stiffness[inside], cost_map.trial_cost[inside] * factor, style.GREEN, 2.6)
    axes.plot(*_least(cost_map, factor), color=style.INK, lw=1.3, label="least cost")
    best = cost_map.optimum
    if best is None:
        return
    place = (best.stiffness, best.cost * factor)
    axes.plot(*place, "+", color=style.BLUE, ms=11, mew=2.2, zorder=5, label="optimum")
    text = cost_text(criterion, best.cost) + (" %" if factor != 1 else "")
    offset = (0, -15 if best.cost > 0.2 * top else 14)  # else the value would collide with the axis
    look: dict[str, Any] = {"va": "center", "color": style.BLUE, "fontweight": "bold", "bbox": style.BEHIND_TEXT}
    look["ha"] = "left" if place[0] < 0.1 * axes.get_xlim()[1] else "center"
    axes.annotate(text, place, offset, "data", textcoords="offset points", **look)


def _least(cost_map: CostMap, factor: float) -> tuple[Floats, Floats]:
    """Return the least cost of a map over stiffness, nowhere above a single trial; nothing without a map."""
    known = np.isfinite(cost_map.cost).any(axis=0)
    K = cost_map.stiffness[known]
    lowest = np.where(np.isfinite(cost_map.cost), cost_map.cost, np.inf).min(axis=0)[known]
    told = np.isfinite(cost_map.trial_cost) & (cost_map.trial_cost >= 0)
    if not len(K) or not told.any():
        return K, lowest * factor
    every = np.union1d(K, cost_map.trial_stiffness[told])
    single = np.full(len(every), np.inf)
    np.minimum.at(single, np.searchsorted(every, cost_map.trial_stiffness[told]), cost_map.trial_cost[told])
    line = np.minimum(np.interp(every, K, lowest, left=np.inf, right=np.inf), single)
    return every, np.where(np.isfinite(line), line, np.nan) * factor


def front_top(figure: Figure[CostMap]) -> float:
    """Return the upper end of the cost axis of the front views, the same for all maps of a figure."""
    levels = criterion_of(figure.criterion).family.levels
    if levels:
        return levels[-1]
    lowest = [float(np.nanmin(m.cost)) for m in figure.panels if np.isfinite(m.cost).any()]
    return FRONT_RANGE * max(lowest, default=1.0)


def cost_axis_label(criterion: str) -> str:
    """Return quantity and unit of the cost axis of a front view."""
    family = criterion_of(criterion).family
    return with_unit(family.title, family.printed_unit)


def _triangles(cost_map: CostMap, known: Booleans) -> Triangulation | None:
    """Triangulate the tested points of a map with holes; None where they span no area.

    Distances count in grid steps, so that the very different numbers of stiffness and damping do not matter.
    """
    rows, columns = np.nonzero(known)
    k, b = cost_map.stiffness[columns], cost_map.damping[rows]
    # Columns may be shifted against each other: the step is the usual one inside a column.
    same = np.diff(rows) == 0
    k_step = float(np.median(np.diff(k)[same])) if same.any() else 1.0
    b_steps = np.diff(np.unique(b))
    b_step = float(np.median(b_steps)) if b_steps.size else 1.0
    points = np.column_stack([k / k_step, b / b_step])
    if len(points) < 3 or np.linalg.matrix_rank(points - points[0]) < 2:
        return None
    triangles = Triangulation(points[:, 0], points[:, 1])
    corners = points[triangles.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    if (longest > LONGEST_EDGE).all():
        return None
    return Triangulation(k, b, triangles.triangles, mask=longest > LONGEST_EDGE)


def dots(
    axes: Axes, x: Floats, y: Floats, colour: str, size: float, *, square: bool = False, clip: bool = True
) -> None:
    """Draw points as one path of dots of a size in pixels, one a pixel at most: small however many trials there are.

    Rejected: `scatter` (one element a point) and a raster image (does not follow the page's colours).
    """
    cap: CapStyleType = "projecting" if square else "round"
    pixels = axes.transData.transform(np.column_stack([x, y]))
    pixels = np.unique(np.round(pixels), axis=0)
    if not len(pixels):
        return
    # Neighbours one above the other make a short line: the same picture from one pair of points.
    joined = (np.diff(pixels[:, 0]) == 0) & (np.diff(pixels[:, 1]) == 1)
    first, last = np.append(True, ~joined), np.append(~joined, True)
    ends = np.stack([pixels[first], pixels[last]], axis=1).reshape(-1, 2)
    path = Path(ends, np.tile(np.array([Path.MOVETO, Path.LINETO], dtype=np.uint8), len(ends) // 2))
    look: dict[str, Any] = {"fill": False, "edgecolor": colour, "lw": size, "capstyle": cap, "clip_on": clip}
    # `add_patch` would search the path for limits of the axes, which are set already
    axes.add_artist(PathPatch(path, transform=IdentityTransform(), **look))
