"""The best trial of an experiment by a criterion."""

from __future__ import annotations

import numpy as np

from pipeline.measured.student import ROUNDING
from pipeline.records.criteria import OVERSHOOT
from pipeline.records.findings import Optimum
from pipeline.records.trials import Booleans, Floats

LARGEST_OVERSHOOT_FLOOR = 0.01
"""Uncertainty of the overshoot from which on "none" is no finding: a tenth of the distance between contour
lines in the published maps (10 percentage points)."""


def without_overshoot(overshoot: Floats, floor: Floats) -> Booleans:
    """Return which trials count as free of overshoot: none above their sensor's resolution, if that is below 1 %.

    Parameters
    ----------
    overshoot, floor : float64, shape (n,)
        Overshoot and the one that the sensor alone can cause, as fractions of the final displacement.
    """
    free: Booleans = (floor <= LARGEST_OVERSHOOT_FLOOR) & (overshoot <= np.maximum(OVERSHOOT.none, floor))
    return free


def choose_optimum(
    cost: Floats,
    stiffness: Floats,
    damping: Floats,
    trial_id: tuple[str, ...],
    *,
    unstable: Booleans,
    floor: Floats | None = None,
) -> Optimum | None:
    """Return the trial with the smallest cost, or None where no trial has one.

    Parameters
    ----------
    cost : float64, shape (n,)
        Cost of each trial; NaN where there is none.
    stiffness, damping : float64, shape (n,)
        K [N/m, Nm/rad] and B [Ns/m, Nms/rad].
    trial_id : tuple of str
    unstable : bool, shape (n,)
        Trials that are unstable: next to them the tested range has not ended.
    floor : float64, shape (n,), optional
        Given for the overshoot: overshoot that sensor and chatter can feign. Then the stiffest trial without
        overshoot is chosen, and only where there is none the smallest overshoot. A trial whose floor exceeds
        `LARGEST_OVERSHOOT_FLOOR` is not known to be without overshoot.

    Notes
    -----
    Of tied trials the one nearest to the centre of their bounding box is taken, distances relative to the
    tested ranges. The optimum is censored where it lies at the smallest or largest tested damping (a smallest
    damping of 0 excepted: it is the end of what can be wanted, not of what was tested), or where no stiffer
    trial was tested at its damping.

    Source: Hulin 2017, sec. 6.1.4 (maximum stiffness without overshoot) and Tables D.1 to D.6.
    """
    candidates = np.isfinite(cost) & ~unstable
    if not candidates.any():
        return None
    tested = stiffness > 0
    free = np.zeros_like(candidates)
    if floor is not None:
        free = candidates & without_overshoot(cost, floor)
    if free.any():
        tied = free & (stiffness == stiffness[free].max())
    else:
        least = cost[candidates].min()
        tied = candidates & (cost <= least + ROUNDING * abs(least))
    index = np.flatnonzero(tied)
    distance = np.zeros(len(index))
    for axis in (stiffness, damping):
        span = np.ptp(axis[tested]) or 1.0
        distance += ((axis[index] - 0.5 * (axis[index].min() + axis[index].max())) / span) ** 2
    best = int(index[np.argmin(distance)])
    levels = damping[tested]
    at_end = damping[best] == levels.max() or (damping[best] == levels.min() and levels.min() != 0)
    stiffer = (damping == damping[best]) & (stiffness > stiffness[best])
    return Optimum(
        stiffness=float(stiffness[best]),
        damping=float(damping[best]),
        cost=float(cost[best]),
        trial_id=trial_id[best],
        ties=len(index),
        censored=bool(at_end or not stiffer.any()),
    )
