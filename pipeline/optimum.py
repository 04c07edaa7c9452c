"""Optimal points of the loop for each criterion.

Energy costs are smooth with one minimum. Settling time jumps where an extremum of the response crosses the band, and
its optimum sits in the corner of such a jump; the region without overshoot ends in cusps. Smooth optimisers miss both.
The search here only compares values: a grid over the whole stable region, then grids that shrink around the best
points found. A corner looks the same at every scale, so each grid finds points inside it and the search converges to
the corner; several of the best cells are followed, so that a better valley is not lost to a lucky grid point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from pipeline.batch import Floats
from pipeline.energy import energy_costs
from pipeline.errors import ParameterError
from pipeline.loop import Loop
from pipeline.stability import boundary, is_stable, surely_stable
from pipeline.transient import NO_OVERSHOOT, late_deviation, transient_costs

Cost = Callable[[Floats, Floats, float], Floats]
"""Cost of points; the last argument is the best cost known, points that are worse may be given infinity."""

STEP_CRITERIA = (
    "settle_1pct",
    "settle_2pct",
    "settle_5pct",
    "overshoot",
    *(f"energy_step_w{w}" for w in (0, 1, 2)),
)
"""Criteria with an optimum here; each also as ``_discrete``."""


@dataclass(frozen=True)
class _Grids:
    """Points along each axis of the first and of each following grid, and how many of the best cells are followed."""

    coarse: int
    fine: int
    starts: int


_SMOOTH = _Grids(coarse=25, fine=9, starts=1)
"""For costs that are smooth and have one minimum."""

_JUMPING = _Grids(coarse=61, fine=15, starts=3)
"""For costs with jumps: a corner must hold grid points at every scale, and a better valley must not be missed."""

_SHRINK = 0.45
"""Size of a grid relative to the one before; with 15 (9) points, it spans 6 (4) cells of its predecessor."""

_LEVELS = 24
"""0.45^24 = 5e-9 of a first cell: the optimum is located to 1e-10 of the stable region."""

_ENDLESS = 60
"""Samples, times d + 1, after which a response counts as not settled in a search; optima settle in about 5 (d + 1)."""


_FLOORS = (0.2, 0.05, 0.01)
"""Shares of the stable stiffness from which on the edge is looked for; it lies near 0.35, and softer walls creep."""

_RIDGE = 73
"""Samples of the edge of the region without overshoot around its highest part."""

_TIPS = 3
"""Tips of that edge that are followed."""

_CLIMBS = 7
"""Zooms onto a tip: its damping is found to 0.4^7 = 2e-3 of a sample of the ridge, its stiffness to 1e-8."""

_EQUAL = 1e-4
"""Relative stiffness within which two tips count as equal; the thesis's tables print four digits."""


@dataclass(frozen=True)
class OptimalPoint:
    """Optimal normalised stiffness and damping with the cost there, and the bounding box of equally good points."""

    alpha: float
    beta: float
    cost: float
    box: tuple[float, float, float, float] | None = None
    """alpha_low, alpha_high, beta_low, beta_high where the optimum is a region."""


@lru_cache(maxsize=512)
def optimal_point(loop: Loop, criterion: str) -> OptimalPoint:
    """Return the optimal point of a criterion for the step response.

    Parameters
    ----------
    loop : Loop
    criterion : str
        One of `STEP_CRITERIA`, with ``_discrete`` appended for the costs of the sampled response.

    Returns
    -------
    OptimalPoint
        For the discrete settling time the centre of the bounding box of all points with the smallest cost; for
        overshoot the stiffest point whose overshoot is at most 1e-12.

    Raises
    ------
    ParameterError
        For an unknown criterion.

    Source: Hulin 2017, secs. 5.2.1 to 5.2.3; reproduces the step rows of C.1 to C.3 and the theory rows of D.1 to D.6.
    """
    base = criterion.removesuffix("_discrete")
    if base not in STEP_CRITERIA:
        raise ParameterError(f"criterion {criterion!r} is unknown; expected one of {list(STEP_CRITERIA)}.")
    if base == "overshoot":
        return _stiffest_without_overshoot(loop, criterion)
    if base.startswith("energy"):
        return _search(loop, lambda a, b, _: energy_costs(loop, a, b)[criterion], _SMOOTH)
    band = float(base.removeprefix("settle_").removesuffix("pct")) / 100
    if criterion == base:
        return _search(loop, lambda a, b, best: _settling(loop, a, b, band, best)[base])
    return _settling_region(loop, band, criterion)


def _settling(loop: Loop, alpha: Floats, beta: Floats, band: float, best: float) -> dict[str, Floats]:
    longest = int(_ENDLESS * (loop.delay + 1))
    return transient_costs(loop, alpha, beta, (band,), overshoot=False, longest=longest, cutoff=best)


def _where_stable(loop: Loop, cost: Cost) -> Cost:
    """Cost with infinity where the loop is unstable or the cost is not defined."""

    def guarded(alpha: Floats, beta: Floats, best: float) -> Floats:
        result = np.full(len(alpha), np.inf)
        stable = surely_stable(loop, alpha, beta)
        open_points = np.flatnonzero(~stable & (alpha + loop.gamma > 0))
        stable[open_points] = is_stable(loop, alpha[open_points], beta[open_points])
        usable = np.flatnonzero(stable)
        if len(usable):
            values = cost(alpha[usable], beta[usable], best)
            result[usable] = np.where(np.isnan(values), np.inf, values)
        return result

    return guarded


def _grid(low: Floats, high: Floats, size: int) -> tuple[Floats, Floats]:
    alpha, beta = np.meshgrid(np.linspace(low[0], high[0], size), np.linspace(low[1], high[1], size))
    return alpha.ravel(), beta.ravel()


def _region(loop: Loop) -> tuple[Floats, Floats]:
    """Bounding box of the stable region, a little inside the line alpha = -gamma."""
    border = boundary(loop)
    width = border.alpha_max + loop.gamma
    # 5 % in from alpha = -gamma: closer to it every step response creeps, and no optimum of a step criterion is there
    return (
        np.array([-loop.gamma + 0.05 * width, min(float(border.beta.min()), 0.0)]),
        np.array([border.alpha_max, border.beta_max]),
    )


def _search(loop: Loop, cost: Cost, grids: _Grids | None = None) -> OptimalPoint:
    """Global minimum of a cost over the stable region."""
    grids = grids or _JUMPING
    guarded = _where_stable(loop, cost)
    low, high = _region(loop)
    alpha, beta = _grid(low, high, grids.coarse)
    values = guarded(alpha, beta, np.inf)
    cell = (high - low) / (grids.coarse - 1)
    best: OptimalPoint | None = None
    left = np.ones(len(values), dtype=bool)
    for _ in range(grids.starts):
        if not np.isfinite(values[left]).any():
            break
        index = int(np.flatnonzero(left)[np.argmin(values[left])])
        found = _refine(guarded, np.array([alpha[index], beta[index]]), float(values[index]), 2 * cell, size=grids.fine)
        if best is None or found.cost < best.cost:
            best = found
        left &= (np.abs(alpha - alpha[index]) > 3 * cell[0]) | (np.abs(beta - beta[index]) > 3 * cell[1])
    if best is None:
        raise ParameterError(f"{loop}: no point of the stable region has this cost.")
    return best


def _refine(
    cost: Cost, centre: Floats, value: float, half: Floats, levels: int = _LEVELS, size: int = 15
) -> OptimalPoint:
    """Grids that shrink around the best point found; one whose best point lies at its rim moves instead."""
    for _ in range(levels):
        alpha, beta = _grid(centre - half, centre + half, size)
        values = cost(alpha, beta, value)
        index = int(np.argmin(values))
        row, column = divmod(index, size)
        if values[index] < value:
            centre, value = np.array([alpha[index], beta[index]]), float(values[index])
            if min(row, column) == 0 or max(row, column) == size - 1:
                continue
        half = half * _SHRINK
    return OptimalPoint(float(centre[0]), float(centre[1]), value)


def _settling_region(loop: Loop, band: float, criterion: str) -> OptimalPoint:
    """Smallest discrete settling time and the bounding box of all points that have it.

    A number of samples n can be reached where the largest deviation of samples n, n+1, ... can be brought into the
    band; that deviation is continuous, so its minimum can be searched for where the settling time itself has steps.
    """
    longest = int(_ENDLESS * (loop.delay + 1))

    def deviation(alpha: Floats, beta: Floats, _: float, first: int) -> Floats:
        return late_deviation(loop, alpha, beta, first, longest)

    def samples_to_settle(alpha: Floats, beta: Floats, _: float) -> Floats:
        costs = transient_costs(loop, alpha, beta, (band,), overshoot=False, continuous=False, longest=longest)
        return costs[criterion]

    # a first number that can surely be had; below it, each number is tried in turn
    alpha, beta = _grid(*_region(loop), _JUMPING.coarse)
    tried = _where_stable(loop, samples_to_settle)(alpha, beta, np.inf)
    index = int(np.argmin(tried))
    if not np.isfinite(tried[index]):
        raise ParameterError(f"{loop}: no response settles into a band of {band} within {longest} samples.")
    samples = int(tried[index])
    point = OptimalPoint(float(alpha[index]), float(beta[index]), float(samples))
    while samples > 1:
        better = _search(loop, partial(deviation, first=samples - 1))
        if better.cost > band:
            break
        samples, point = samples - 1, better

    def feasible(alpha: Floats, beta: Floats, _: float) -> Floats:
        return np.where(deviation(alpha, beta, np.inf, samples) <= band, 0.0, np.inf)

    box = _bounding_box(_where_stable(loop, feasible), np.array([point.alpha, point.beta]), _region(loop))
    return OptimalPoint(0.5 * (box[0] + box[1]), 0.5 * (box[2] + box[3]), float(samples), box)


def _bounding_box(
    feasible: Cost, inside: Floats, region: tuple[Floats, Floats], size: int = 61
) -> tuple[float, float, float, float]:
    """Bounding box of the connected feasible set around a point of it."""
    half = (region[1] - region[0]) * 1e-4
    corner = np.array([inside, inside])
    for _ in range(40):  # grow by 1.6 until the set no longer touches the rim: 1.6^40 covers any region
        alpha, beta = _grid(corner[0] - half, corner[1] + half, size)
        good = feasible(alpha, beta, np.inf) == 0
        found = (
            np.array([[alpha[good].min(), beta[good].min()], [alpha[good].max(), beta[good].max()]])
            if good.any()
            else corner
        )
        touches = (found[0] <= corner[0] - half * 0.999) | (found[1] >= corner[1] + half * 0.999)
        corner = np.array([np.minimum(corner[0], found[0]), np.maximum(corner[1], found[1])])
        if not touches.any():
            break
        half = np.maximum(half, 0.3 * (corner[1] - corner[0]))
    span = corner[1] - corner[0]
    known_alpha, known_beta = alpha[good], beta[good]
    # twice: in the thin sliver of a corner the grids of one edge may stall; the point of another edge leads on
    for _ in range(2):
        edges = []
        for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)):

            def distance(alpha: Floats, beta: Floats, _: float, axis: int = axis, sign: float = sign) -> Floats:
                return feasible(alpha, beta, np.inf) + sign * (alpha if axis == 0 else beta)

            values = distance(known_alpha, known_beta, np.inf)
            index = int(np.argmin(values))
            start = np.array([known_alpha[index], known_beta[index]])
            edges.append(_refine(distance, start, float(values[index]), 0.1 * span, levels=16))
        known_alpha, known_beta = (np.array([getattr(e, name) for e in edges]) for name in ("alpha", "beta"))
    return edges[0].alpha, edges[1].alpha, edges[2].beta, edges[3].beta


def _stiffest_without_overshoot(loop: Loop, criterion: str) -> OptimalPoint:
    """Stiffest point of the region without overshoot: its edge over beta, followed to the higher of its cusps."""
    _, high = _region(loop)

    def clean(alpha: Floats, beta: Floats, _: float) -> Floats:
        costs = transient_costs(
            loop, alpha, beta, (), continuous=not criterion.endswith("_discrete"), enough=NO_OVERSHOOT
        )
        return np.where(costs[criterion] <= NO_OVERSHOOT, 0.0, np.inf)

    guarded = _where_stable(loop, clean)

    def edge(beta: Floats, floor: Floats, top: Floats, passes: int) -> Floats:
        """Largest alpha without overshoot at each beta in [floor, top] (floor if none), by 24 sections a pass.

        Seen from small alpha, the region is left once: its lower part is clean throughout (checked by test).
        """
        lower, upper = floor.copy(), top.copy()
        share, row = np.linspace(0, 1, 25), np.arange(len(beta))
        for _ in range(passes):
            alpha = lower[:, None] + share * (upper - lower)[:, None]
            good = np.isfinite(guarded(alpha.ravel(), np.repeat(beta, 25), np.inf)).reshape(alpha.shape)
            last = np.where(good.all(axis=1), 24, good.argmin(axis=1) - 1)
            lower = alpha[row, np.maximum(last, 0)]
            upper = np.where(last < 0, lower, alpha[row, np.minimum(last + 1, 24)])
        return lower

    betas = np.linspace(0.0, high[1], 61)[1:]
    for share in _FLOORS:
        lowest = share * high[0] - (1 - share) * loop.gamma
        edges = edge(betas, np.full(60, lowest), np.full(60, high[0]), 2)
        highest = float(edges.max())
        if highest > lowest:
            break
    else:
        raise ParameterError(f"{loop}: no point without overshoot was found.")
    ridge = betas[np.argmax(edges)] + np.linspace(-3, 3, _RIDGE) * (betas[1] - betas[0])
    edges = edge(ridge, np.full(_RIDGE, 0.8 * highest), np.full(_RIDGE, min(1.1 * highest, high[0])), 3)
    tips = _local_maxima(edges)[:_TIPS]
    alpha, beta = edges[tips], ridge[tips]
    half, width = 1.5 * (ridge[1] - ridge[0]), 0.01 * highest
    for _ in range(_CLIMBS):
        window = beta[:, None] + half * np.linspace(-1, 1, 19)
        middle = np.repeat(alpha, 19)
        values = edge(window.ravel(), middle - width, middle + width, 2).reshape(window.shape)
        peak, tip = values.argmax(axis=1), np.arange(len(alpha))
        better = values[tip, peak] > alpha
        alpha = np.where(better, values[tip, peak], alpha)
        beta = np.where(better, window[tip, peak], beta)
        half, width = half * 0.4, width * 0.35
    # tips of practically equal stiffness: the least damping is reported, so that rounding cannot decide between them
    equal = np.flatnonzero(alpha >= alpha.max() * (1 - _EQUAL))
    best = equal[np.argmin(beta[equal])]
    return OptimalPoint(float(alpha[best]), float(beta[best]), 0.0)


def _local_maxima(values: Floats) -> list[int]:
    """Indices of inner local maxima, highest first."""
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] > values[2:])) + 1
    if not len(inner):
        inner = np.array([int(np.argmax(values))])
    return [int(i) for i in inner[np.argsort(values[inner])[::-1]]]
