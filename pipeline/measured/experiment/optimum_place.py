"""Estimate the uncertainty of the location of an optimum from nearly optimal walls and the scatter of the cost map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.records.findings import BoundaryPoint, DampingRange, NearOptimum
from pipeline.records.trials import Booleans, Floats, Integers

NEAR = 0.05
"""Largest relative difference from the best wall at which a wall is nearly as good. The difference is that of the
costs, or of the stiffnesses if walls without overshoot are compared."""

NEIGHBOURS = 20
"""Number of trials to which a parabola is fitted: a wall and its neighbours on a grid, three trials for each
coefficient."""

AROUND, FEWEST_AROUND = 8, 2
"""Number of walls next to a wall on a grid, and smallest number of them that connect it to a region. One of them may be
as lucky as the wall itself."""

_TO_DEVIATION = 1.482602218505602
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""


def nearly_as_good(cost: Floats, stiffness: Floats, best: float, stiffest: float, free: Booleans) -> Booleans:
    """Return whether each trial is nearly as good as the best trial.

    Parameters
    ----------
    cost, stiffness : float64, shape (n,)
        NaN if a trial has no cost.
    best : float
        Cost of the best trial.
    stiffest : float
        Stiffness of the best trial [N/m, Nm/rad].
    free : bool, shape (n,)
        Trials without overshoot. If there are any, the stiffest of them is the best trial.
    """
    if free.any():
        return free & (stiffness >= (1 - NEAR) * stiffest)
    return np.isfinite(cost) & (cost <= (1 + NEAR) * best)


def near_optimum(near: Booleans, stiffness: Floats, damping: Floats) -> NearOptimum:
    """Return the bounding box of the walls that are nearly as good as the best wall. There must be at least one."""
    K, B = stiffness[near], damping[near]
    return NearOptimum(
        stiffness_low=float(K.min()),
        stiffness_high=float(K.max()),
        damping_low=float(B.min()),
        damping_high=float(B.max()),
        trials=int(near.sum()),
    )


def is_alone(member: Booleans, stiffness: Floats, damping: Floats, of_stiffness: float, of_damping: float) -> bool:
    """Return whether a wall has too few members of a region next to it to be part of the region.

    A wall without neighbours is not alone, because nothing shows that a region ends next to it.

    Parameters
    ----------
    member : bool, shape (n,)
        Trials in the region.
    stiffness, damping : float64, shape (n,)
        K [N/m, Nm/rad] and B [Ns/m, Nms/rad] of the trials, which include the wall.
    of_stiffness, of_damping : float
        K and B of the wall.
    """
    away = np.hypot((stiffness - of_stiffness) / _step_of(stiffness), (damping - of_damping) / _step_of(damping))
    order = np.lexsort((damping, stiffness, np.round(away, 9)))
    nearest = order[away[order] > 0][:AROUND]
    return bool(member[nearest].sum() < min(FEWEST_AROUND, len(nearest)))


def cost_scatter(cost: Floats, stiffness: Floats, damping: Floats) -> float | None:
    """Return the scatter of a cost map: the deviation of trials from their neighbours, in percent of the cost.

    Parameters
    ----------
    cost : float64, shape (n,)
        NaN if a trial has no cost. Zeros are left out.
    stiffness, damping : float64, shape (n,)

    Returns
    -------
    float or None
        Robust standard deviation (1.48 times the median) of the relative residuals, corrected for the degrees of
        freedom of the fit, or None for fewer trials than `NEIGHBOURS`.

    Notes
    -----
    For each trial and its nearest neighbours (distances in units of the tested steps), a parabola in K and B is fitted
    to the logarithm of the cost. The residuals of a smooth map are small. In a noisy map (6.1.4), the residuals are the
    noise of single trials.
    """
    some = np.isfinite(cost) & (cost > 0)
    if some.sum() < NEIGHBOURS:
        return None
    K, B, value = stiffness[some], damping[some], np.log(cost[some])
    place = np.stack([K / _step_of(K), B / _step_of(B)], axis=1)
    around = _neighbours(place)
    u, v = np.moveaxis(place[around] - place[:, None], 2, 0)
    parabola = np.stack([np.ones(u.shape), u, v, u * u, u * v, v * v], axis=2)
    # only the fitted value at the centre (first term) and the leverage of the central trial are needed
    weight = np.linalg.pinv(parabola)[:, 0]
    free = 1 - (weight * (around == np.arange(len(value))[:, None])).sum(axis=1)
    left = value - (weight * value[around]).sum(axis=1)
    residual = np.where(free > 1e-6, left / np.sqrt(np.maximum(free, 1e-6)), np.nan)
    known = np.abs(residual[np.isfinite(residual)])
    return float(100 * _TO_DEVIATION * np.median(known)) if len(known) else None


def _neighbours(place: Floats) -> Integers:
    """Return the nearest `NEIGHBOURS` of each point (n, 2), including itself, shape (n, `NEIGHBOURS`).

    Ties are resolved by location, independently of the order of the trials.
    """
    from scipy.spatial import cKDTree

    order = np.lexsort(place.T)
    away, near = cKDTree(place[order]).query(place, k=min(2 * NEIGHBOURS, len(place)))
    first = np.lexsort((near, np.round(away, 9)))[:, :NEIGHBOURS]
    return np.asarray(order[np.take_along_axis(near, first, axis=1)])


def _step_of(values: Floats) -> float:
    """Return the median distance between neighbouring tested values, or 1 if there is only one value."""
    levels = np.unique(values)
    return float(np.median(np.diff(levels))) if len(levels) > 1 else 1.0


def stable_damping_range(boundary: Sequence[BoundaryPoint], stiffness: float, damping: float) -> DampingRange | None:
    """Return the dampings around a wall at which its stiffness is stable, or None if no limit is known there.

    Parameters
    ----------
    boundary : sequence of BoundaryPoint
        Measured limits in order of damping.
    stiffness, damping : float
        K [N/m, Nm/rad] and B [Ns/m, Nms/rad] of the wall.

    Returns
    -------
    DampingRange or None
        Ends in the unit of ``damping``.

    Notes
    -----
    The lower ends of the limits, a lower bound of the boundary of Hulin 2017, sec. 6.1.3, are interpolated linearly.
    The range ends at the first damping on each side where the limits fall to the stiffness, or at the last damping
    before an unknown limit.
    """
    B = np.array([point.damping for point in boundary])
    K = np.array([_lower_end(point, stiffness) for point in boundary])
    above, below = int(np.searchsorted(B, damping)), int(np.searchsorted(B, damping, side="right")) - 1
    if below < 0 or above == len(B) or np.isnan(K[[below, above]]).any():
        return None
    at = float(np.interp(damping, B[[below, above]], K[[below, above]]))
    low, low_is_limit = _end(stiffness, damping, at, B[below::-1], K[below::-1])
    high, high_is_limit = _end(stiffness, damping, at, B[above:], K[above:])
    factors = [high / damping] if damping > 0 else []
    factors += [damping / low] if low > 0 else []
    return DampingRange(
        low=low,
        high=high,
        low_is_limit=low_is_limit,
        high_is_limit=high_is_limit,
        margin=min(factors) if factors else None,
    )


def _lower_end(point: BoundaryPoint, stiffness: float) -> float:
    """Return the lower end of a limit, 0 if the stiffness is above an unstable trial without a limit, or NaN."""
    if point.limit is not None:
        return point.limit.low
    return 0.0 if point.unstable is not None and point.unstable <= stiffness else np.nan


def _end(stiffness: float, damping: float, limit: float, dampings: Floats, limits: Floats) -> tuple[float, bool]:
    """Return the first damping, in one direction from a given damping, at which the limits fall to a stiffness.

    ``limit`` is the limit at the given damping. The second value is False if a limit is unknown before the limits fall
    to the stiffness.
    """
    last = damping
    for B, K in zip(dampings.tolist(), limits.tolist(), strict=True):
        if np.isnan(K):
            return last, False
        if stiffness > K:
            share = (limit - stiffness) / (limit - K) if limit > stiffness else 0.0
            return last + share * (B - last), True
        last, limit = B, K
    return last, False
