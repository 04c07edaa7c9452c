"""From single trials to one value per experiment: estimates with 95 % intervals, and the best trial."""

from __future__ import annotations

import numpy as np

from pipeline.measured.experiment.combine import with_sign_warning
from pipeline.measured.intervals import CONFIDENCE
from pipeline.records.batch import Booleans, Floats
from pipeline.records.findings import Estimate, Optimum

NO_OVERSHOOT = 1e-12
"""Overshoot that counts as none (footnote 4 of 5.2.2): part of the definition, it gives the printed edges."""

LARGEST_OVERSHOOT_FLOOR = 0.01
"""Uncertainty of the overshoot from which on "none" is no finding: a tenth of the distance between contour
lines in the published maps (10 percentage points)."""

TIE_TOLERANCE = 1e-12
"""Relative difference of costs that rounding alone makes."""


def estimate_median(values: Floats, unit: str, method: str, reason: str) -> Estimate:
    """Return the median of the trials with its distribution-free 95 % interval.

    Parameters
    ----------
    values : float64, shape (n,)
        One value per trial; NaN where there is none.
    unit, method : str
    reason : str
        What to say where no trial has a value.

    Notes
    -----
    The interval lies between the order statistics l and n + 1 - l, where l is the largest for which a
    binomial (n, 1/2) count falls below l with a chance of at most 2.5 %. Fewer than six trials cannot give
    95 %: then it is the range, and the method says so. It tells the scatter of the trials, not a bias that
    they share.
    """
    known = np.sort(values[np.isfinite(values)])
    n = len(known)
    if not n:
        return Estimate(value=None, unit=unit, method=method, reason=reason)
    rank = _median_rank(n)
    if rank == 0:
        method, rank = f"{method}; interval is the range of {n} trials", 1
    return Estimate(
        value=float(np.median(known)),
        low=float(known[rank - 1]),
        high=float(known[n - rank]),
        unit=unit,
        method=method,
        trials=n,
    )


def _median_rank(n: int) -> int:
    """Largest l with P(binomial(n, 1/2) < l) <= 2.5 %, 0 where there is none."""
    k = np.arange(n + 1)
    logarithm = np.concatenate([[0.0], np.cumsum(np.log((n - k[:-1]) / (k[:-1] + 1)))]) - n * np.log(2)
    below = np.cumsum(np.exp(logarithm))
    return int((below <= 0.5 * (1 - CONFIDENCE)).sum())


def estimate_mass(corrected: Floats, mass_momentum: Floats, unit: str = "kg") -> Estimate:
    """Return the mass of an experiment: the corrected balance, beside the one that the thesis used.

    Parameters
    ----------
    corrected, mass_momentum : float64, shape (n,)
        Mass of each trial with and without correction for viscous damping [kg, kg m^2]; NaN where there is
        none.

    Source: Hulin 2017, eq. 6.4.
    """
    thesis = estimate_median(
        mass_momentum,
        unit,
        "momentum balance (6.4), median of trials",
        "no trial allows a momentum balance; the reasons stand with the trials",
    )
    best = estimate_median(
        corrected,
        unit,
        "momentum balance corrected for viscous damping, median of trials",
        "no trial allows a momentum balance and an estimate of the viscous damping",
    )
    return best.model_copy(update={"by_method": {"thesis_momentum_balance": thesis}})


def estimate_damping(limit: Estimate, from_trials: Floats, unit: str = "Ns/m") -> Estimate:
    """Return the viscous damping of an experiment: by the limit at K = 0, else the median of the trials.

    A value whose interval reaches zero or lies below it bears a ``warning``.

    Parameters
    ----------
    limit : Estimate
        By `damping.by_limit`.
    from_trials : float64, shape (n,)
        Least squares of each trial [Ns/m, Nms/rad]; NaN where there is none.

    Source: Hulin 2017, eq. 3.25 and sec. 6.1.2.
    """
    by_limit = with_sign_warning(limit)
    by_trials = with_sign_warning(
        estimate_median(
            from_trials,
            unit,
            "least squares of the momentum balance, median of trials",
            "no trial allows a momentum balance over its response",
        )
    )
    best = by_limit if by_limit.value is not None or by_trials.value is None else by_trials
    return best.model_copy(update={"by_method": {"stability_limit": by_limit, "momentum_balance": by_trials}})


def without_overshoot(overshoot: Floats, floor: Floats) -> Booleans:
    """Return which trials count as free of overshoot: none above what their sensor can tell, if it can tell 1 %.

    Parameters
    ----------
    overshoot, floor : float64, shape (n,)
        Overshoot and the one that the sensor alone can cause, as fractions of the final displacement.
    """
    free: Booleans = (floor <= LARGEST_OVERSHOOT_FLOOR) & (overshoot <= np.maximum(NO_OVERSHOOT, floor))
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
        Trials that are unstable: beside them the tested range has not ended.
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
        tied = candidates & (cost <= least + TIE_TOLERANCE * abs(least))
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
