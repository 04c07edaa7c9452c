"""The stable region: stable intervals of stiffness, verdicts and limits, without eigenvalues.

Source: Hulin 2017, sec. 3.4; counting of crossings (`device.crossings`) in place of gridding and poles.
"""

from __future__ import annotations

import numpy as np

from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.device.crossings import Stretches, stretches


def stable_intervals(loop: Loop, beta: object) -> Stretches:
    """Return the intervals of alpha that are stable at each beta, array_like of shape (n,)."""
    return stretches(loop, as_points(0.0, beta)[1])


def is_inside(loop: Loop, alpha: object, beta: object) -> Booleans:
    """Return which points are stable: all poles inside the unit circle.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping.

    Notes
    -----
    Right up to rounding of the boundary: nothing is promised for spectral radii nearer to 1 than 1e-12.

    Source: Hulin 2017, sec. 3.4.
    """
    return np.asarray(_margins(loop, *as_points(alpha, beta)) > 0)


def is_well_inside(loop: Loop, alpha: Floats, beta: Floats, share: float = 1e-9, *, islands: bool = True) -> Booleans:
    """Return where points are stable and stay so when alpha is moved either way by a share of alpha + gamma, (n,).

    Costs of points closer to the boundary are sums over billions of samples, and rounding errors. Without ``islands``
    a wall counts only if every softer one at its damping is stable too, down to alpha -> 0.
    """
    away = share * (alpha + loop.gamma)
    return np.asarray((away > 0) & (_margins(loop, alpha, beta, islands=islands) > away))


def stiffness_limit(loop: Loop, beta: object, *, islands: bool = True) -> Floats:
    """Return the largest stable alpha at each beta, -inf where there is none; both (n,), errors as of `is_inside`.

    Without ``islands`` up to which every softer wall is stable too, down to alpha -> 0.

    Source: Hulin 2017, sec. 3.4.
    """
    _, b = as_points(0.0, beta)
    found = stretches(loop, b)
    kept = np.flatnonzero(islands | (found.low <= 0))
    result = np.full(len(b), -np.inf)
    np.maximum.at(result, found.index[kept], found.high[kept])
    return result


def _margins(loop: Loop, alpha: Floats, beta: Floats, *, islands: bool = True) -> Floats:
    """Return the distance of alpha to the nearer end of its stable interval, below zero where it is in none, (n,)."""
    levels, of = np.unique(beta, return_inverse=True)
    found = stretches(loop, levels)
    kept = np.flatnonzero(islands | (found.low <= 0))
    index, low, high = found.index[kept], found.low[kept], found.high[kept]
    result = np.full(len(alpha), -np.inf)
    counts = np.bincount(index, minlength=len(levels))
    start = np.cumsum(counts) - counts
    for number in range(int(counts.max(initial=0))):  # as many rounds as a line has stable intervals: few
        has = np.flatnonzero(counts[of] > number)
        row = start[of[has]] + number
        result[has] = np.maximum(result[has], np.minimum(alpha[has] - low[row], high[row] - alpha[has]))
    return result
