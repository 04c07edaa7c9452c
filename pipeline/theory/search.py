"""Search for the smallest cost over the stable region with grids that contract around the best points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.boundary import MARGIN, boundary, is_well_inside, limits, soft_interval
from pipeline.theory.crossings import bisect

Cost = Callable[[Floats, Floats, Any], Floats]
"""Cost of points. The last argument is the best known cost, as one value or one value per point. The cost of worse
points may be infinite."""


@dataclass(frozen=True)
class OptimalPoint:
    """Optimal normalised stiffness and damping, the cost there, and the bounding box of equally good points."""

    alpha: float
    beta: float
    cost: float
    box: tuple[float, float, float, float] | None = None
    """alpha_low, alpha_high, beta_low, beta_high if the optimum is a region."""
    attained: bool = True
    """Whether a stable point has the optimal cost. Otherwise, the optimum is a limit on the edge of the stable
    region."""


@dataclass(frozen=True)
class Grids:
    """Sizes of the grids of a search.

    Parameters
    ----------
    coarse : int
        Number of lines of the first scan, and number of points on each line.
    looks : int
        Number of refinements of the best two minima on each line.
    closer : int
        Number of refinements of the lines around the best point.
    fine : int
        Number of points per axis in each later grid.
    starts : int
        Number of best points that are refined.
    """

    coarse: int
    looks: int
    closer: int
    fine: int
    starts: int


SMOOTH = Grids(coarse=25, looks=0, closer=0, fine=9, starts=2)
"""Grids for smooth costs with few minima. A mode may cause a second minimum."""

JUMPING = Grids(coarse=61, looks=8, closer=6, fine=11, starts=2)
"""Grids for costs with jumps. Grids of every scale need points in a corner, and must not miss a deeper valley.
A valley ends in a cliff along a curve with many corners. Only the minima of lines across the cliff show the lowest
minimum."""

SHRINK = 0.45
"""Size of a grid relative to the previous one. With 11 (9) points, it spans 4.5 (3.6) cells of the previous grid."""

LEVELS_IN_PLANE = 24
"""Number of levels of a search, 0.45^24 = 5e-9 of a first cell. The optimum has an accuracy of 1e-10 of the region."""

_INSET = 0.05
"""Initial distance of a search from alpha = -gamma, as a share of the width. Closer to it, every step response
creeps."""


_SOFTEST = 0.0005
"""The same distance for costs with jumps. The limit of a loop with a mode may be a hundred times as stiff as the
optimum."""


_LINES = 11
"""Number of lines in each refinement next to the best line minimum."""

_NARROWER = 0.25
"""Range of these lines relative to the previous range, i.e. 2.5 previous line distances."""

_REACH = 8
"""Number of cells of the first scan along a line by which minima may move between two lines."""

_NEAR_BEST = 1.1
"""Largest cost, relative to the best, of a point that is refined to the end. A refinement improves a cost by less."""

_DEAR = 2.0
"""Threshold for the cost, relative to the lowest known cost. Above it, the minimum of a line is not needed."""


def where_stable(loop: NormalisedLoop, cost: Callable[..., Floats]) -> Callable[..., Floats]:
    """Return the cost, with infinity if the loop or a softer wall is unstable or the cost is not defined.

    Arguments after the best known cost have one value per point.
    """

    def guarded(alpha: Floats, beta: Floats, best: float | Floats, *more: Floats) -> Floats:
        return _cost_where(is_well_inside(loop, alpha, beta, islands=False), cost, alpha, beta, best, *more)

    return guarded


def _cost_where(
    is_usable: Booleans, cost: Callable[..., Floats], alpha: Floats, beta: Floats, best: float | Floats, *more: Floats
) -> Floats:
    """Return the cost of usable points. It is infinite for other points, and where it is not defined."""
    result, usable = np.full(len(alpha), np.inf), np.flatnonzero(is_usable)
    if len(usable):
        limits = np.broadcast_to(best, alpha.shape)[usable]
        values = cost(alpha[usable], beta[usable], limits, *(each[usable] for each in more))
        result[usable] = np.where(np.isnan(values), np.inf, values)
    return result


def grid(low: Floats, high: Floats, size: int) -> tuple[Floats, Floats]:
    """Return the points of a grid between two corners, each of shape (size^2,)."""
    first, second = np.meshgrid(np.linspace(low[0], high[0], size), np.linspace(low[1], high[1], size))
    return first.ravel(), second.ravel()


def box(loop: NormalisedLoop, inset: float = _INSET) -> tuple[Floats, Floats]:
    """Return the lower and upper corners (alpha, beta) of the stable region, slightly inside alpha = -gamma."""
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
    """Coordinates for the searches of a loop, both from 0 to 1.

    The first coordinate is the square root of the position of alpha in its stable interval, which starts at alpha =
    -gamma if it begins there. It is uniform in the oscillation frequency, since the limit of a mode may be many times
    the stiffness of the fastest settling. The second coordinate is the path along the outline as a share of its length,
    relative to the height and the width of the region.

    Parameters
    ----------
    loop : NormalisedLoop
    beta, way : float64, shape (n,)
        Sorted dampings of the outline, and path lengths up to them.
    """

    loop: NormalisedLoop
    beta: Floats
    way: Floats

    def wall(self, root: Floats, way: Floats) -> tuple[Floats, Floats, Booleans]:
        """Return alpha and beta for coordinates, and whether a wall is well inside of its interval, shape (n,) each."""
        rows, of = np.unique(way, return_inverse=True)
        beta = np.interp(rows, self.way, self.beta)
        low, high = (end[of] for end in soft_interval(self.loop, beta))
        alpha = np.where(high > 0, low + np.square(root) * (high - low), np.nan)
        away = MARGIN * (alpha + self.loop.gamma)
        return alpha, beta[of], (away > 0) & (np.minimum(alpha - low, high - alpha) > away)


def chart(loop: NormalisedLoop) -> Chart:
    """Return the coordinates for the searches of a loop."""
    beta = np.sort(boundary(loop).beta)
    beta = beta[np.isfinite(beta)]
    alpha = limits(loop, beta, exact=False).alpha
    kept = np.isfinite(alpha) & np.append(True, np.diff(beta) > 0)
    beta, alpha = beta[kept], alpha[kept]
    way = np.abs(np.diff(beta)) / (beta[-1] - beta[0]) + np.abs(np.diff(alpha)) / (alpha.max() + loop.gamma)
    return Chart(loop, beta, np.append(0.0, np.cumsum(way) / way.sum()))


@dataclass(frozen=True, eq=False)
class Landscape:
    """Cost over the coordinates of a chart. It is infinite outside the chart and for unstable loops."""

    chart: Chart
    cost: Cost

    def __call__(self, root: Floats, way: Floats, best: float | Floats) -> Floats:
        """Return the cost of points in these coordinates."""
        alpha, beta, inside = self.chart.wall(root, way)
        return _cost_where(inside & (way >= 0) & (way <= 1), self.cost, alpha, beta, best)

    def along(self, way: Floats, line: Integers, root: Floats, best: float | Floats) -> Floats:
        """Return the cost at positions along lines. All points of a line have the same position along the outline."""
        return self(root, way[line], best)


@dataclass(frozen=True, eq=False)
class Starts:
    """Starting points of a search, with coordinates, costs, and half the size of the region to examine around each
    point."""

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
        Function that is evaluated at stable points only.
    grids : Grids
    bounds : tuple of float64, shape (2,), optional
        Corners of the first grid in coordinates of the chart. By default, they are those of the stable region.

    Raises
    ------
    ParameterError
        If no stable point of the first grid has this cost.
    """
    landscape, corners = Landscape(chart(loop), cost), bounds or region(_SOFTEST)
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
    alpha, beta, _ = landscape.chart.wall(np.array([best.alpha]), np.array([best.beta]))
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
    """Refine all starts by the minima of lines next to them, with smaller regions around the new starts."""
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
    """Return the best point of contracting grids. A grid moves instead if its best point is on its rim.

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
    """Return the shear of the best points in rows near the given row, or ``known`` if fewer than two rows have a best
    point."""
    some = np.arange(max(row - 2, 0), min(row + 3, len(second)))
    some = some[np.isfinite(values[some]).any(axis=1)]
    if len(some) < 2:
        return known
    return float(np.polyfit(second[some], first[some, values[some].argmin(axis=1)], 1)[0])


def bounding_box(
    feasible: Cost, inside: Floats, corners: tuple[Floats, Floats], size: int = 61
) -> tuple[float, float, float, float]:
    """Return alpha_low, alpha_high, beta_low, beta_high of the connected set of cost 0 around a point inside it."""
    half = (corners[1] - corners[0]) * 1e-4
    corner = np.array([inside, inside])
    for _ in range(40):  # grow by a factor of 1.6 until the set no longer touches the rim; 1.6^40 covers any region
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
    # this is done twice, because the grids of one edge may stall in the thin tip of a corner until another edge yields
    # a better point
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


LineCost = Callable[[Integers, Floats, Any], Floats]
"""Cost of points given by the index of their line and their position on it. It is infinite if a point has no cost. The
last argument is the best known cost, as one value or one value per point. The cost of worse points may be infinite."""

COARSE = 121
"""Number of points of the first scan of a line."""

_STARTS = 3
"""Number of local minima that are refined."""

_FINE = 9
"""Number of points of each refinement. The first refinement covers four cells of the scan with two points in each
cell."""

_SHRINK = 0.35
"""Length of a refinement relative to the previous one, i.e. 1.4 cells on either side of the best point."""

LEVELS = 20
"""Number of levels of a line search, 0.35^20 = 1e-9 of a first step."""


@dataclass(frozen=True, eq=False)
class LineOptima:
    """Best point of each line and its cost. They are NaN and infinity if no point of the line has a cost."""

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
        Number of points of the first scan, number of local minima that are refined, and number of refinements of each.
    dear : float, optional
        Cost above which the minimum of a line is not needed, relative to the lowest cost of all lines and ``known``.
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
        limit = np.repeat(np.minimum(best, enough), _FINE)
        found = cost(np.repeat(line, _FINE), around.ravel(), limit).reshape(around.shape)
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
    """Return a lower estimate of costs along lines before the next point. It assumes a decrease by the ratio of the
    previous step.

    A cost with jumps decreases towards a cliff, beyond which it is high again. Its minimum usually lies between two
    examined points, and neither of them need be lower than its neighbours.
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
        Cost of points given by two coordinates. It is infinite if a point has no cost.
    low, high : float64, shape (2,)
        Corners of the rectangle.
    coarse : tuple of int
        Number of lines of the first scan, and number of points on each line.
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
    """Return the ends of the range around each best point in which the cost is at most the best cost.

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
