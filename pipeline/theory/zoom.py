"""Search for the smallest cost along many lines at once, and from there in the plane.

Pole radius and damping ratio have valleys without a floor: where two or three poles meet, the cost rises as the square
or cube root of the distance to either side, and a grid in the plane stalls in front of the bend. Along a line such a
valley is a plain dip. So the best point of each line is found first, all lines at once, and the plane is searched as a
line of lines: the best cost of a line is a function of one variable without any valley.

Why it finds the global optimum of a line: all of it is looked at, in steps of 1/120 of the region, and the lowest
dips are followed by grids that shrink around the best point, which a jump or a kink cannot stop. A dip narrower than a
step that gives no sign of itself to either side would be missed; where costs have steps (discrete settling time), a
continuous quantity is searched in their place (`pipeline.theory.curves`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers

LineCost = Callable[[Integers, Floats, float], Floats]
"""Cost of points given by the index of their line and their place on it; infinity where there is none. Points
that are worse than the last argument may be given infinity."""

COARSE = 121
"""Points of the first look at a line."""

_STARTS = 3
"""Dips that are followed."""

_FINE = 9
"""Points of each following look, over two cells of the one before: half a cell between neighbours."""

_SHRINK = 0.35
"""Length of a look relative to the one before: 1.4 cells to either side of the best point."""

LEVELS = 20
"""0.35^20 = 1e-9 of a first step."""


@dataclass(frozen=True, eq=False)
class LineOptima:
    """Best place of each line and the cost there; NaN and infinity where no point of a line has a cost."""

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
) -> LineOptima:
    """Return the smallest cost of each line.

    Parameters
    ----------
    cost : LineCost
    low, high : float64, shape (n,)
        Ends of each line.
    coarse, starts, levels : int
        Points of the first look, dips that are followed, and looks at each.
    """
    lines = len(low)
    share = np.linspace(0.0, 1.0, coarse)
    places = low[:, None] + share * (high - low)[:, None]
    values = cost(np.repeat(np.arange(lines), coarse), places.ravel(), np.inf).reshape(lines, coarse)
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=np.inf)
    dips = np.where((values <= padded[:, :-2]) & (values <= padded[:, 2:]), values, np.inf)
    chosen = np.argsort(dips, axis=1, kind="stable")[:, :starts]
    line = np.repeat(np.arange(lines), chosen.shape[1])
    centre, best = places[line, chosen.ravel()], dips[line, chosen.ravel()]
    alive = np.flatnonzero(np.isfinite(best))
    line, centre, best = line[alive], centre[alive], best[alive]
    half = 2 * (high - low)[line] / (coarse - 1)
    offsets = np.linspace(-1.0, 1.0, _FINE)
    row = np.arange(len(line))
    for _ in range(levels):
        if not len(line):
            break
        around = centre[:, None] + half[:, None] * offsets
        found = cost(np.repeat(line, _FINE), around.ravel(), float(best.max())).reshape(around.shape)
        index = found.argmin(axis=1)
        better = found[row, index] < best
        centre = np.where(better, around[row, index], centre)
        best = np.where(better, found[row, index], best)
        at_rim = better & ((index == 0) | (index == _FINE - 1))
        half = np.where(at_rim, half, half * _SHRINK)
    place, cheapest = np.full(lines, np.nan), np.full(lines, np.inf)
    order = np.lexsort((best, line))
    first = order[np.unique(line[order], return_index=True)[1]] if len(line) else order
    place[line[first]], cheapest[line[first]] = centre[first], best[first]
    return LineOptima(place, cheapest)


def search_plane(
    cost: Callable[[Floats, Floats, float], Floats],
    low: Floats,
    high: Floats,
    *,
    coarse: tuple[int, int] = (61, COARSE),
    levels: int = LEVELS,
) -> tuple[float, float, float]:
    """Return the two coordinates and the cost of the best point of a rectangle, as a line of lines.

    Parameters
    ----------
    cost : callable
        Cost of points given by their two coordinates, infinity where there is none.
    low, high : float64, shape (2,)
        Corners.
    coarse : tuple of int
        Lines, and points of each, of the first look.
    levels : int
        Looks that follow.
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
    """Return the ends of the stretch around each best place whose cost is at most the best one.

    Gaps that are narrower than a step of the look (1/240 of a line) are passed over.
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


def bisect(holds: Callable[[Floats], Booleans], good: Floats, bad: Floats, halvings: int = 60) -> tuple[Floats, Floats]:
    """Return the last values towards ``bad`` at which a condition holds, and the next ones, to the last bit.

    Parameters
    ----------
    holds : callable
    good, bad : float64, shape (n,)
        Where it holds, and where it does not.
    halvings : int
    """
    for _ in range(halvings):
        middle = 0.5 * (good + bad)
        fine = holds(middle)
        good, bad = np.where(fine, middle, good), np.where(fine, bad, middle)
    return good, bad
