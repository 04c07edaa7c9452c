"""Rectangles of tested walls around the best ones, of nothing but usable trials and far from the stability limit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.comparison.scores.overlap import MeasuredLimits
from pipeline.records.batch import Booleans, Floats

GOOD = (1.25, 1.5, 2.0)
"""Level relative to the least one up to which a wall counts as good, the first one with a region of `FEWEST` trials:
nobody feels a quarter of a settling time, but valleys of settling time are narrower than the steps of many courses."""

MOSTLY = 0.9
"""Share of a region's trials that must be good."""

NEIGHBOURS = 8
"""Trials around one whose median cost is its level. Its own cost does not count: the best trial of many is the
luckiest, and a range of costs that were chosen by themselves says nothing of a further trial."""

FEWEST = 5
"""Trials below which no region is named: a further one would lie outside their range with a chance of a third."""

Rectangle = tuple[float, float, float, float]
"""Least and largest stiffness, least and largest damping."""


@dataclass(frozen=True, eq=False)
class WallTrials:
    """Stiffness, damping, cost (NaN where there is none) and usability of trials, shape (n,) each.

    ``level`` is what they are judged by, inf where nothing tells it. A region holds usable trials only, and begins at
    one that is ``finished``: the wall to set is such a one.
    """

    stiffness: Floats
    damping: Floats
    cost: Floats
    level: Floats
    usable: Booleans
    finished: Booleans

    def inside(self, region: Rectangle) -> Booleans:
        """Tell which trials lie in a rectangle, its edges included."""
        K, B = self.stiffness, self.damping
        return (region[0] <= K) & (region[1] >= K) & (region[2] <= B) & (region[3] >= B)

    def favoured(self, region: Rectangle, room: Floats) -> int:
        """Return the trial of a region whose own cost and level are low; of equal ones that far from the limit."""
        at = np.flatnonzero(self.inside(region) & np.isfinite(self.level) & self.finished)
        worse = np.maximum(self.cost[at], self.level[at])
        return int(at[np.lexsort([-room[at] / self.stiffness[at], worse])[0]])


def levels(stiffness: Floats, damping: Floats, cost: Floats, usable: Booleans) -> Floats:
    """Return the median cost of the `NEIGHBOURS` of each usable trial with a cost; inf for the others."""
    from scipy.spatial import cKDTree

    judged = usable & np.isfinite(cost)
    level = np.full(len(cost), np.inf)
    if judged.sum() < FEWEST:
        return level
    points = np.stack([stiffness, damping], axis=1)[judged]
    spread = points.std(axis=0)
    points = points / np.where(spread > 0, spread, 1.0)
    nearest = cKDTree(points).query(points, k=range(2, min(NEIGHBOURS + 1, len(points)) + 1))[1]
    level[judged] = np.median(cost[judged][nearest], axis=1)
    return level


def room_at(limits: MeasuredLimits, damping: Floats) -> Floats:
    """Return the lower end of the limit [N/m, Nm/rad] at some dampings; 0 where no limit is known."""
    known = limits.known
    if not known.any():
        return np.zeros_like(damping)
    found: Floats = np.interp(damping, limits.damping[known], limits.low[known], left=0.0, right=0.0)
    return found


def room_of(limits: MeasuredLimits, region: Rectangle) -> tuple[float, bool]:
    """Return the least lower end of the limit over the dampings of a rectangle, and whether it is a bound only."""
    ends, known = np.array(region[2:]), limits.known
    B, low = limits.damping[known], limits.low[known]
    between = (ends[0] <= B) & (ends[1] >= B)
    least = np.concatenate([room_at(limits, ends), low[between]]).min()
    return float(least), bool(limits.censored[known][between].any())


def best_rectangle(tested: WallTrials, limits: MeasuredLimits, margin: float) -> Rectangle | None:
    """Return a rectangle of good walls, or None where no `FEWEST` neighbours are good.

    Parameters
    ----------
    tested : WallTrials
    limits : MeasuredLimits
    margin : float
        Least lower end of the limit over the stiffness of a wall.

    Notes
    -----
    It starts at the trial of the least level that keeps the margin, and grows by the next tested stiffness or damping,
    on the side with the least median level, while all its trials are usable, `MOSTLY` of them are good, and its
    stiffest wall keeps the margin. Where it stays too small, the next good trial outside it is the start.
    """
    starts = tested.usable & tested.finished & (margin * tested.stiffness <= room_at(limits, tested.damping))
    order = np.argsort(np.where(starts, tested.level, np.inf), kind="stable")
    least = tested.level[order[0]] if starts.any() else np.inf
    for factor in GOOD if np.isfinite(least) else ():
        good = tested.level <= factor * least
        tried = np.zeros(len(good), dtype=bool)
        for start in order[(starts & good)[order]]:
            if tried[start]:
                continue
            region = _grown(tested, good, limits, margin, int(start))
            inside = tested.inside(region)
            if inside.sum() >= FEWEST:
                return region
            tried |= inside
    return None


def _grown(tested: WallTrials, good: Booleans, limits: MeasuredLimits, margin: float, start: int) -> Rectangle:
    """Return the rectangle around a trial that no side can be moved out of any more."""
    K, B = float(tested.stiffness[start]), float(tested.damping[start])
    region = (K, K, B, B)

    def holds(side: Rectangle) -> bool:
        at = tested.inside(side)
        kept = margin * side[1] <= room_of(limits, side)[0]
        return kept and bool(tested.usable[at].all()) and float(good[at].mean()) >= MOSTLY

    while sides := [side for side in _wider(region, tested) if holds(side)]:
        region = min(sides, key=lambda side: float(np.median(tested.level[tested.inside(side)])))
    return region


def _wider(region: Rectangle, tested: WallTrials) -> Iterator[Rectangle]:
    """Yield the rectangle with the next trial's stiffness or damping on each side that has one."""
    k0, k1, b0, b1 = region
    K, B = tested.stiffness, tested.damping
    along, across = K[(b0 <= B) & (b1 >= B) & (K > 0)], B[(k0 <= K) & (k1 >= K)]
    if (along < k0).any():
        yield float(along[along < k0].max()), k1, b0, b1
    if (along > k1).any():
        yield k0, float(along[along > k1].min()), b0, b1
    if (across < b0).any():
        yield k0, k1, float(across[across < b0].max()), b1
    if (across > b1).any():
        yield k0, k1, b0, float(across[across > b1].min())
