"""Select the best trial of an experiment by a criterion."""

from __future__ import annotations

import numpy as np

from pipeline.measured.student import ROUNDING
from pipeline.records.criteria import OVERSHOOT
from pipeline.records.findings import Optimum
from pipeline.records.trials import Booleans, Floats

LARGEST_OVERSHOOT_FLOOR = 0.01
"""Largest uncertainty of the overshoot for which a trial can count as free of overshoot. It is a tenth of the distance
between contour lines in the published maps (10 percentage points)."""


def without_overshoot(overshoot: Floats, floor: Floats) -> Booleans:
    """Return whether each trial is free of overshoot within the sensor resolution, if the resolution is below 1 %.

    Parameters
    ----------
    overshoot, floor : float64, shape (n,)
        Overshoot, and apparent overshoot due to the sensor, as fractions of the final displacement.
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
    """Return the trial with the smallest cost, or None if no trial has a cost.

    Parameters
    ----------
    cost : float64, shape (n,)
        Cost of each trial, or NaN if it has none.
    stiffness, damping : float64, shape (n,)
        K [N/m, Nm/rad] and B [Ns/m, Nms/rad].
    trial_id : tuple of str
    unstable : bool, shape (n,)
        Whether each trial is unstable. Unstable trials are part of the tested range.
    floor : float64, shape (n,), optional
        Apparent overshoot due to sensor and chatter, for the overshoot only. The stiffest trial without overshoot is
        then chosen, or the trial with the smallest overshoot if there is none. A trial whose floor exceeds
        `LARGEST_OVERSHOOT_FLOOR` is not treated as free of overshoot.

    Notes
    -----
    Of several trials with equal cost, the trial closest to the centre of their bounding box is chosen. Distances are
    relative to the tested ranges. The optimum is censored if no stiffer trial was tested at its damping, or if its
    damping is the smallest or the largest tested damping. A smallest damping of 0 is an exception: it is the end of the
    useful range.

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
