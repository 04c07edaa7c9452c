"""Search for the smallest cost over the stable region, by grids that contract around the best points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Floats, Integers
from pipeline.theory.boundary import boundary, is_well_inside, limits
from pipeline.theory.crossings import bisect

Cost = Callable[[Floats, Floats, float], Floats]
"""Cost of points; the last argument is the best known cost: the cost of worse points may be infinity."""


@dataclass(frozen=True)
class OptimalPoint:
    """Optimal normalised stiffness and damping with the cost there, and the bounding box of equally good points."""

    alpha: float
    beta: float
    cost: float
    box: tuple[float, float, float, float] | None = None
    """alpha_low, alpha_high, beta_low, beta_high where the optimum is a region."""
    attained: bool = True
    """False where the optimum is a limit on the edge of the stable region, which no stable point reaches."""


@dataclass(frozen=True)
class Grids:
    """Sizes of the grids of a search.

    Parameters
    ----------
    coarse : int
        Number of lines of the first scan, and of points on each.
    looks : int
        Number of refinements of the best two minima on each line.
    closer : int
        Number of refinements of the lines around the best point.
    fine : int
        Number of points per axis of each later grid.
    starts : int
        Number of best points that are refined.
    """

    coarse: int
    looks: int
    closer: int
    fine: int
    starts: int


SMOOTH = Grids(coarse=25, looks=0, closer=0, fine=9, starts=2)
"""For costs that are smooth and have few minima: a mode may bring a second."""

JUMPING = Grids(coarse=61, looks=8, closer=6, fine=11, starts=2)
"""For costs with jumps: a corner must contain grid points at every scale, and a better valley must not be missed. A
valley ends in a cliff along a curve, on which many corners lie: only floors of lines across it show the lowest."""

SHRINK = 0.45
"""Size of a grid relative to its predecessor; with 15 (9) points, it spans 6 (4) cells of its predecessor."""

LEVELS_IN_PLANE = 24
"""0.45^24 = 5e-9 of a first cell: the optimum is located to 1e-10 of the stable region."""

_INSET = 0.05
"""Initial distance of a search from alpha = -gamma, as a share of the width: every step response creeps there."""


_SOFTEST = 0.0005
"""The same for costs with jumps: a mode's limit may be a hundred times the stiffness that settles soonest."""


_LINES = 11
"""Number of lines of each refinement next to the best line minimum."""

_NARROWER = 0.25
"""Range that they cover, relative to the previous one: 2.5 lines of it."""

_REACH = 8
"""Number of cells of the first scan along a line over which minima move from one line to the next."""

_NEAR_BEST = 1.1
"""Largest cost, relative to the best, of a point that is refined to the end; refinement gains less than that."""

_DEAR = 2.0
"""Cost, relative to the lowest known, above which the minimum of a line is not needed."""


def where_stable(loop: NormalisedLoop, cost: Callable[..., Floats]) -> Callable[..., Floats]:
    """Return the cost, replaced by infinity if the loop or a softer wall is unstable, or the cost is not defined.

    Arguments after the best known cost have one number per point.
    """

    def guarded(alpha: Floats, beta: Floats, best: float, *more: Floats) -> Floats:
        result = np.full(len(alpha), np.inf)
        usable = np.flatnonzero(is_well_inside(loop, alpha, beta, islands=False))
        if len(usable):
            values = cost(alpha[usable], beta[usable], best, *(each[usable] for each in more))
            result[usable] = np.where(np.isnan(values), np.inf, values)
        return result

    return guarded


def grid(low: Floats, high: Floats, size: int) -> tuple[Floats, Floats]:
    """Return the points of a grid between two corners, each of shape (size^2,)."""
    first, second = np.meshgrid(np.linspace(low[0], high[0], size), np.linspace(low[1], high[1], size))
    return first.ravel(), second.ravel()


def box(loop: NormalisedLoop, inset: float = _INSET) -> tuple[Floats, Floats]:
    """Return the lower and upper corner (alpha, beta) of the stable region, a little inside the line alpha = -gamma."""
    border = boundary(loop)
    width = border.alpha_max + loop.gamma
    return (
        np.array([-loop.gamma + inset * width, min(float(np.nanmin(border.beta)), 0.0)]),
        np.array([border.alpha_max, border.beta_max]),
    )


def region(inset: float = _INSET) -> tuple[Floats, Floats]:
    """Return the corners of the stable region in the coordinates of `chart`."""
    return np.array([np.sqrt(inset), 0.0]), np.ones(2)


@dataclass(frozen=True, eq=False)
class Chart:
    """Coordinates of a loop's searches, both from 0 to 1.

    The root of the share of alpha's stable interval, from alpha = -gamma if it begins there, which is uniform in the
    frequency of oscillation, since a mode's limit may be many times the stiffness with the fastest settling; and the
    path along the outline as a share of its length, with the region's height and width as units.

    Parameters
    ----------
    loop : NormalisedLoop
    beta, way : float64, shape (n,)
        Sorted dampings of the outline, and the path length to each.
    """

    loop: NormalisedLoop
    beta: Floats
    way: Floats

    def wall(self, root: Floats, way: Floats) -> tuple[Floats, Floats]:
        """Return alpha and beta of coordinates, shape (n,) each."""
        rows, of = np.unique(way, return_inverse=True)
        beta = np.interp(rows, self.way, self.beta)
        edge = limits(self.loop, beta, exact=False)
        return edge.low[of] + np.square(root) * (edge.alpha - edge.low)[of], beta[of]


def chart(loop: NormalisedLoop) -> Chart:
    """Return the coordinates of a loop's searches."""
    beta = np.sort(boundary(loop).beta)
    beta = beta[np.isfinite(beta)]
    alpha = limits(loop, beta, exact=False).alpha
    kept = np.isfinite(alpha) & np.append(True, np.diff(beta) > 0)
    beta, alpha = beta[kept], alpha[kept]
    way = np.abs(np.diff(beta)) / (beta[-1] - beta[0]) + np.abs(np.diff(alpha)) / (alpha.max() + loop.gamma)
    return Chart(loop, beta, np.append(0.0, np.cumsum(way) / way.sum()))


@dataclass(frozen=True, eq=False)
class Landscape:
    """Cost over the coordinates of a chart; infinity off it, and where the loop is not stable."""

    chart: Chart
    cost: Callable[..., Floats]

    def __call__(self, root: Floats, way: Floats, best: float) -> Floats:
        """Return the cost of points in these coordinates."""
        return np.where((way >= 0) & (way <= 1), self.cost(*self.chart.wall(root, way), best), np.inf)

    def along(self, way: Floats, line: Integers, root: Floats, best: float) -> Floats:
        """Return the cost along lines, each at one position along the outline."""
        return self(root, way[line], best)


@dataclass(frozen=True, eq=False)
class Starts:
    """Starting points of a search: coordinates, costs, and half the size of the region to examine around each."""

    root: Floats
    way: Floats
    cost: Floats
    half: Floats


def search(
    loop: NormalisedLoop, cost: Cost, grids: Grids = JUMPING, bounds: tuple[Floats, Floats] | None = None
) -> OptimalPoint:
    """Return the global minimum of a cost over the stable region.

    Parameters
    ----------
    loop : NormalisedLoop
    cost : Cost
        Asked for stable points only.
    grids : Grids
    bounds : tuple of float64, shape (2,), optional
        Corners of the first grid, in coordinates of the chart; the stable region if not given.

    Raises
    ------
    ParameterError
        If no point of the first grid is stable and has this cost.
    """
    landscape, corners = Landscape(chart(loop), where_stable(loop, cost)), bounds or region(_SOFTEST)
    cell = (corners[1] - corners[0]) / (grids.coarse - 1)
    starts = _first_look(landscape, grids, corners, cell)
    for _ in range(grids.closer):
        starts = _closer_look(landscape, grids, corners, cell[0], starts)
    near = np.flatnonzero(starts.cost <= max(_NEAR_BEST * starts.cost.min(), starts.cost.min()))
    done = (np.log(starts.half[:, 0] / cell[0]) / np.log(SHRINK)).astype(int)
    best = min(
        (
            refine(
                landscape,
                np.array([starts.root[i], starts.way[i]]),
                float(starts.cost[i]),
                2 * starts.half[i],
                grids.fine,
                LEVELS_IN_PLANE - int(done[i]),
            )
            for i in near
        ),
        key=lambda point: point.cost,
    )
    alpha, beta = landscape.chart.wall(np.array([best.alpha]), np.array([best.beta]))
    return OptimalPoint(float(alpha[0]), float(beta[0]), best.cost)


def _first_look(landscape: Landscape, grids: Grids, corners: tuple[Floats, Floats], cell: Floats) -> Starts:
    """Return the lowest local minima among the minima of lines over the whole region."""
    (low, start), (high, end) = corners
    way, one = np.linspace(start, end, grids.coarse), np.ones(grids.coarse)
    floors = search_lines(
        partial(landscape.along, way),
        low * one,
        high * one,
        coarse=grids.coarse,
        starts=2,
        levels=grids.looks,
        dear=_DEAR,
    )
    padded = np.pad(floors.cost, 1, constant_values=np.inf)
    left = np.isfinite(floors.cost) & (floors.cost <= np.minimum(padded[:-2], padded[2:]))
    chosen: list[int] = []
    while left.any() and len(chosen) < grids.starts:
        index = int(np.flatnonzero(left)[np.argmin(floors.cost[left])])
        chosen.append(index)
        left &= (np.abs(floors.place - floors.place[index]) > 3 * cell[0]) | (np.abs(way - way[index]) > 3 * cell[1])
    if not chosen:
        raise ParameterError("no point of the stable region has this cost.")
    return Starts(floors.place[chosen], way[chosen], floors.cost[chosen], np.tile(cell, (len(chosen), 1)))


def _closer_look(
    landscape: Landscape, grids: Grids, corners: tuple[Floats, Floats], cell: float, starts: Starts
) -> Starts:
    """Return the lowest minima of lines next to each start, over all starts, with smaller regions around them."""
    ways = starts.way[:, None] + starts.half[:, 1:] * np.linspace(-1, 1, _LINES)
    begin, end = (np.clip(starts.root + side * _REACH * cell, corners[0][0], corners[1][0]) for side in (-1, 1))
    floors = search_lines(
        partial(landscape.along, ways.ravel()),
        np.repeat(begin, _LINES),
        np.repeat(end, _LINES),
        coarse=2 * _LINES,
        starts=2,
        levels=grids.looks,
        dear=_DEAR,
        known=float(starts.cost.min()),
    )
    place, cost, each = floors.place.reshape(ways.shape), floors.cost.reshape(ways.shape), np.arange(len(ways))
    at = cost.argmin(axis=1)
    better = cost[each, at] < starts.cost
    smaller = np.where(better & np.isin(at, (0, _LINES - 1)), 1.0, _NARROWER)[:, None]
    return Starts(
        np.where(better, place[each, at], starts.root),
        np.where(better, ways[each, at], starts.way),
        np.where(better, cost[each, at], starts.cost),
        starts.half * smaller,
    )


def refine(
    cost: Cost, centre: Floats, value: float, half: Floats, size: int = JUMPING.fine, levels: int = LEVELS_IN_PLANE
) -> OptimalPoint:
    """Return the best point of contracting grids; a grid moves instead of contracting if its best point lies on its
    rim.

    Grids are sheared along the best points of their rows, since a valley that ends in a cliff is narrow and inclined.
    """
    lean = 0.0
    for _ in range(levels):
        first, second = grid(centre - half, centre + half, size)
        first += lean * (second - centre[1])
        values = cost(first, second, value)
        index = int(np.argmin(values))
        row, column = divmod(index, size)
        lean = _lean(values.reshape(size, size), first.reshape(size, size), second[::size], row, lean)
        if values[index] < value:
            centre, value = np.array([first[index], second[index]]), float(values[index])
            if min(row, column) == 0 or max(row, column) == size - 1:
                continue
        half = half * SHRINK
    return OptimalPoint(float(centre[0]), float(centre[1]), value)


def _lean(values: Floats, first: Floats, second: Floats, row: int, known: float) -> float:
    """Return the shear of the best points in the rows next to a given one; the known shear if fewer than two rows have
    any."""
    some = np.arange(max(row - 2, 0), min(row + 3, len(second)))
    some = some[np.isfinite(values[some]).any(axis=1)]
    if len(some) < 2:
        return known
    return float(np.polyfit(second[some], first[some, values[some].argmin(axis=1)], 1)[0])


def bounding_box(
    feasible: Cost, inside: Floats, corners: tuple[Floats, Floats], size: int = 61
) -> tuple[float, float, float, float]:
    """Return alpha_low, alpha_high, beta_low, beta_high of the connected set of cost 0 around a point of it."""
    half = (corners[1] - corners[0]) * 1e-4
    corner = np.array([inside, inside])
    for _ in range(40):  # grow by 1.6 until the set no longer touches the rim: 1.6^40 covers any region
        alpha, beta = grid(corner[0] - half, corner[1] + half, size)
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
    # twice: in the thin tip of a corner the grids of one edge may stall; the point of another edge helps
    for _ in range(2):
        edges = []
        for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)):
            distance = partial(_distance, feasible, axis, sign)
            values = distance(known_alpha, known_beta, np.inf)
            index = int(np.argmin(values))
            start = np.array([known_alpha[index], known_beta[index]])
            edges.append(refine(distance, start, float(values[index]), 0.1 * span, levels=16))
        known_alpha, known_beta = (np.array([getattr(e, name) for e in edges]) for name in ("alpha", "beta"))
    return edges[0].alpha, edges[1].alpha, edges[2].beta, edges[3].beta


def _distance(feasible: Cost, axis: int, sign: float, alpha: Floats, beta: Floats, best: float) -> Floats:
    return feasible(alpha, beta, best) + sign * (beta if axis else alpha)


LineCost = Callable[[Integers, Floats, float], Floats]
"""Cost of points given by the index of their line and their place on it; infinity without a cost. The cost of points
worse than the last argument may be infinity."""

COARSE = 121
"""Number of points of the first scan of a line."""

_STARTS = 3
"""Number of local minima that are refined."""

_FINE = 9
"""Number of points of each refinement, over two cells of the previous scan: half a cell between neighbours."""

_SHRINK = 0.35
"""Length of a refinement relative to the previous one: 1.4 cells to either side of the best point."""

LEVELS = 20
"""0.35^20 = 1e-9 of a first step."""


@dataclass(frozen=True, eq=False)
class LineOptima:
    """Best point of each line and its cost; NaN and infinity if no point of a line has a cost."""

    place: Floats
    cost: Floats


def search_lines(
    cost: LineCost,
    low: Floats,
    high: Floats,
    *,
    coarse: int = COARSE,
    starts: int = _STARTS,
    levels: int = LEVELS,
    dear: float | None = None,
    known: float = np.inf,
) -> LineOptima:
    """Return the smallest cost of each line.

    Parameters
    ----------
    cost : LineCost
    low, high : float64, shape (n,)
        Ends of each line.
    coarse, starts, levels : int
        Number of points of the first scan, of refined local minima, and of refinements of each.
    dear : float, optional
        Cost, relative to the lowest of all lines and the known one, above which the minimum of a line is not needed.
    known : float
    """
    lines = len(low)
    share = np.linspace(0.0, 1.0, coarse)
    places = low[:, None] + share * (high - low)[:, None]
    first = np.inf if dear is None else dear * known
    values = cost(np.repeat(np.arange(lines), coarse), places.ravel(), first).reshape(lines, coarse)
    hopes = _hopes(values) if levels else values
    padded = np.pad(hopes, ((0, 0), (1, 1)), constant_values=np.inf)
    dips = np.where((hopes <= padded[:, :-2]) & (hopes <= padded[:, 2:]), hopes, np.inf)
    chosen = np.argsort(dips, axis=1, kind="stable")[:, :starts]
    line = np.repeat(np.arange(lines), chosen.shape[1])
    centre = places[line, chosen.ravel()]
    best = np.where(np.isfinite(dips[line, chosen.ravel()]), values[line, chosen.ravel()], np.inf)
    alive = np.flatnonzero(np.isfinite(best))
    line, centre, best = line[alive], centre[alive], best[alive]
    half = 2 * (high - low)[line] / (coarse - 1)
    offsets = np.linspace(-1.0, 1.0, _FINE)
    row = np.arange(len(line))
    for _ in range(levels):
        if not len(line):
            break
        around = centre[:, None] + half[:, None] * offsets
        enough = np.inf if dear is None else dear * min(known, best.min())
        found = cost(np.repeat(line, _FINE), around.ravel(), float(min(best.max(), enough))).reshape(around.shape)
        index = found.argmin(axis=1)
        better = found[row, index] < best
        centre = np.where(better, around[row, index], centre)
        best = np.where(better, found[row, index], best)
        at_rim = better & ((index == 0) | (index == _FINE - 1))
        half = np.where(at_rim, half, half * _SHRINK)
    place, cheapest = np.full(lines, np.nan), np.full(lines, np.inf)
    order = np.lexsort((best, line))
    lowest = order[np.unique(line[order], return_index=True)[1]] if len(line) else order
    place[line[lowest]], cheapest[line[lowest]] = centre[lowest], best[lowest]
    return LineOptima(place, cheapest)


def _hopes(values: Floats) -> Floats:
    """Return a lower estimate of costs along lines before the next point: a decrease by the factor of the previous
    step.

    A cost with jumps decreases towards a cliff, beyond which it is high again. Its minimum usually lies between two
    examined points, neither of which need be lower than its neighbours.
    """
    known = np.isfinite(values) & (values > 0)
    step = np.divide(values[:, 1:], values[:, :-1], out=np.ones_like(values[:, 1:]), where=known[:, 1:] & known[:, :-1])
    fall = np.ones_like(values)
    fall[:, 1:] = np.minimum(step, 1.0)
    fall[:, :-1] = np.minimum(fall[:, :-1], 1 / step)
    return np.asarray(values * fall)


def search_plane(
    cost: Callable[[Floats, Floats, float], Floats],
    low: Floats,
    high: Floats,
    *,
    coarse: tuple[int, int] = (61, COARSE),
    levels: int = LEVELS,
) -> tuple[float, float, float]:
    """Return the two coordinates and the cost of the best point of a rectangle, by nested line searches.

    Parameters
    ----------
    cost : callable
        Cost of points given by their two coordinates; infinity without a cost.
    low, high : float64, shape (2,)
        Corners.
    coarse : tuple of int
        Number of lines, and of points on each, of the first scan.
    levels : int
        Number of refinements.
    """

    def best_of(first: Floats) -> LineOptima:
        count = len(first)
        return search_lines(
            lambda line, place, best: cost(first[line], place, best),
            np.full(count, low[1]),
            np.full(count, high[1]),
            coarse=coarse[1],
            levels=levels,
        )

    def outer(_: Integers, first: Floats, __: float) -> Floats:
        return best_of(first).cost

    found = search_lines(outer, low[:1], high[:1], coarse=coarse[0], starts=2, levels=levels)
    inner = best_of(found.place)
    return float(found.place[0]), float(inner.place[0]), float(found.cost[0])


def extents(
    cost: LineCost, found: LineOptima, low: Floats, high: Floats, coarse: int = 241, halvings: int = 40
) -> tuple[Floats, Floats]:
    """Return the ends of the range around each best point with at most the best cost.

    Gaps narrower than a step of the scan (1/240 of a line) are ignored.
    """
    lines = np.arange(len(low))
    limit = found.cost
    ends = []
    share = np.linspace(0.0, 1.0, coarse)
    for end in (low, high):
        start = np.nan_to_num(found.place)
        places = start[:, None] + share * (end - start)[:, None]
        values = cost(np.repeat(lines, coarse), places.ravel(), np.inf).reshape(places.shape)
        good = values <= limit[:, None]
        good[:, 0] = True
        first_bad = np.where(good.all(axis=1), coarse, good.argmin(axis=1))
        inside = places[lines, first_bad - 1]
        outside = places[lines, np.minimum(first_bad, coarse - 1)]
        inside, _ = bisect(lambda places: cost(lines, places, np.inf) <= limit, inside, outside, halvings)
        ends.append(np.where(np.isnan(found.place), np.nan, inside))
    return ends[0], ends[1]
