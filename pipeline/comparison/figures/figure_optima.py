"""Optimal curves of a cost map: the best damping for each stiffness and the best stiffness for each damping.

They are read from the map that is drawn, so that curve and contour lines belong together; `curves` computes those of
theory to full accuracy.
"""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Booleans, Floats

SAME = 1e-9
"""Relative difference of costs that counts as none: whole settling times, and overshoots of zero."""


def optimal_curve(values: Floats, cost: Floats, *, smooth: bool) -> tuple[Floats, Booleans]:
    """Return the best value of one wall parameter for each value of the other.

    Parameters
    ----------
    values : float64, shape (q,)
        Grid of the parameter that is chosen, increasing.
    cost : float64, shape (q, p)
        Costs over that parameter (rows) and the given one (columns); NaN where there is none.
    smooth : bool
        Whether the cost is smooth along a column: a parabola through the smallest cost and its two neighbours then
        places the minimum between grid points.

    Returns
    -------
    best : float64, shape (p,)
        Where several neighbouring costs are equally small, the middle of the first such stretch; NaN where a column
        has no cost.
    inside : bool, shape (p,)
        Where the stretch does not touch an end of the column's costs: the minimum is one and not the end of a range.
    """
    known = np.isfinite(cost)
    level = np.where(known, cost, np.inf)
    least = level.min(axis=0)
    has = np.isfinite(least)
    equal = known & (level <= least + SAME * np.abs(np.where(has, least, 0.0)))
    first = equal.argmax(axis=0)
    rows = np.arange(len(values))[:, None]
    after = np.where((rows > first) & ~equal, rows, len(values)).min(axis=0)
    last = after - 1
    best = 0.5 * (values[first] + values[np.maximum(last, 0)])
    columns = np.arange(cost.shape[1])
    below, above = np.maximum(first - 1, 0), np.minimum(last + 1, len(values) - 1)
    inside = has & (first > 0) & (after < len(values)) & known[below, columns] & known[above, columns]
    if smooth:
        single = inside & (first == last)
        at = columns[single]
        moved = _vertex(values, cost, first[single], at)
        best[single] = moved
    return np.where(has, best, np.nan), inside


def _vertex(values: Floats, cost: Floats, row: np.ndarray, column: np.ndarray) -> Floats:
    """Place of the vertex of the parabola through three neighbouring costs; steps may differ."""
    x0, x1, x2 = (values[row + i] for i in (-1, 0, 1))
    y0, y1, y2 = (cost[row + i, column] for i in (-1, 0, 1))
    left, right = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    curvature = (right - left) / (x2 - x0)
    slope_at_middle = left + curvature * (x1 - x0)
    return np.asarray(x1 - slope_at_middle / (2 * curvature))
