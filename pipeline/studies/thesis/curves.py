"""Numbers that several theory figures share: optimal curves, maps, outlines; each computed once a process."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.records.criteria import DISCRETE, OVERSHOOT, SETTLING, criterion_of
from pipeline.studies.figure import Area, Panel, Trace
from pipeline.studies.thesis.outline import outline
from pipeline.theory.cost.pointcosts import point_costs_by_name
from pipeline.theory.cost.settling_overshoot import transient_costs
from pipeline.theory.optimum.curves import Curve, best_damping, best_stiffness
from pipeline.theory.stability.extent import damping_range, stiffest_point
from pipeline.theory.stability.region import is_inside

ALPHA, BETA, DELAY = "stiffness α", "damping β", "delay factor d"
"""Labels of axes."""

MAP_SIZE = 101
"""Grid points along each axis of a map; the thesis has 251, which contour lines at this size do not show."""

_LONGEST = 120
"""Samples after which a response on a map gets no settling time: the highest contour line is below half of it."""

_POINTS = 80
"""Points of an optimal curve."""

_DISCRETE_POINTS = 50
"""Points of a curve of the best damping for the discrete settling time."""

_DISCRETE_STIFFNESS_POINTS = 20
"""Points of the curve of best stiffness for the discrete settling time, whose search takes a hundred times as long."""

_QUIET = 1e-6
"""Motion down to which a map looks for overshoot: far below its lowest contour line at 1e-3."""


def plain_loop(delay: float) -> Loop:
    """Return the loop without physical stiffness and damping, of which most figures are."""
    return Loop(0.0, 0.0, delay)


@lru_cache(maxsize=64)
def damping_curve(loop: Loop, criterion: str) -> Curve:
    """Return the best damping over stiffness."""
    count = _DISCRETE_POINTS if criterion == "settle_2pct_discrete" else _POINTS
    inner = np.concatenate([[0.003], np.linspace(0, 1, count + 2)[1:-1], [0.997]])
    return best_damping(loop, criterion, -loop.gamma + (stiffest_point(loop)[0] + loop.gamma) * inner)


@lru_cache(maxsize=64)
def stiffness_curve(loop: Loop, criterion: str) -> Curve:
    """Return the best stiffness over damping."""
    bottom, top = damping_range(loop)
    count = _DISCRETE_STIFFNESS_POINTS if criterion == "settle_2pct_discrete" else _POINTS
    return best_stiffness(loop, criterion, bottom + (top - bottom) * np.linspace(0, 1, count + 2)[1:-1])


@lru_cache(maxsize=64)
def closed_outline(loop: Loop) -> tuple[Floats, Floats]:
    """Return the outline of the stable region."""
    return outline(loop)


def outline_trace(loop: Loop, colour: str = "ink", label: str = "", width: float = 1.4, dash: str = "solid") -> Trace:
    """Return the outline of the stable region as a line of a figure."""
    return Trace(*closed_outline(loop), colour, dash, label, width=width)


def box(loop: Loop, margin: float = 0.04) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return ranges of alpha and beta around the stable region."""
    top, (bottom, above) = stiffest_point(loop)[0], damping_range(loop)
    width, height = top + loop.gamma, above - bottom
    return (-loop.gamma - 0.5 * margin * width, top + margin * width), (
        bottom - margin * height,
        above + margin * height,
    )


def plane(loop: Loop, title: str, traces: Sequence[Trace]) -> Panel:
    """Return lines over the walls around the stable region."""
    return Panel(title, ALPHA, BETA, *box(loop), tuple(traces))


@lru_cache(maxsize=64)
def cost_grid(loop: Loop, criterion: str) -> tuple[Floats, Floats, Floats]:
    """Return alpha, beta and the cost (beta by alpha, NaN where not stable) over the box of the stable region."""
    top, (bottom, above) = stiffest_point(loop)[0], damping_range(loop)
    alpha = -loop.gamma + (top + loop.gamma) * np.linspace(0, 1, MAP_SIZE)
    beta = np.linspace(bottom, above, MAP_SIZE)
    points = tuple(axis.ravel() for axis in np.meshgrid(alpha, beta))
    at = np.flatnonzero(is_inside(loop, *points))
    cost = np.full(len(points[0]), np.nan)
    cost[at] = point_cost(loop, points[0][at], points[1][at], criterion)
    return alpha, beta, cost.reshape(len(beta), len(alpha))


def point_cost(loop: Loop, alpha: Floats, beta: Floats, criterion: str) -> Floats:
    """Return the cost of stable points, shape (n,)."""
    base = criterion_of(criterion)
    if base.family not in (SETTLING, OVERSHOOT):
        return point_costs_by_name(loop, alpha, beta, (criterion,), _LONGEST)[criterion]
    bands = () if base.band is None else (base.band,)
    return transient_costs(
        loop,
        alpha,
        beta,
        bands,
        overshoot=not bands,
        continuous=not criterion.endswith(DISCRETE),
        longest=_LONGEST,
        quiet=_QUIET,
        unfinished_overshoot=not bands,
    )[criterion]


def found_points(curve: Curve) -> tuple[Floats, Floats, Floats]:
    """Return given, best and cost of a curve where it exists."""
    return curve.given[curve.found], curve.best[curve.found], curve.cost[curve.found]


def flat_region(loop: Loop, criterion: str) -> Area:
    """Return the region without overshoot, or without oscillation: between the ends of the equally good dampings."""
    curve = damping_curve(loop, criterion)
    flat = curve.found & (curve.cost == (1.0 if criterion == "damping" else 0.0))
    x = np.concatenate([curve.given[flat], curve.given[flat][::-1]])
    y = np.concatenate([curve.low[flat], curve.high[flat][::-1]])
    return Area(x, y, "sky", "ζ = 1" if criterion == "damping" else "no overshoot")
