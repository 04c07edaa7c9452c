"""Viscous damping of the device: by the stability limit at K = 0, by each trial's momentum balance, by the decay of
its velocity at K = 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.wording import counted
from pipeline.measured.device.momentum import balance
from pipeline.measured.intervals import student_95
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.findings import Estimate

FEWEST_INTERVALS = 20
"""Two unknowns with fewer samples follow the noise."""

LARGEST_CONDITION = 1e4
"""Condition of the scaled normal equations beyond which 0.1 % of quantum in the position makes 10 % in b."""

ZERO_RATE = 1e-6
"""Growth rate, relative to the range of the rates, that is zero but for rounding."""

ZERO_RATE_AT_END = 0.01
"""As `ZERO_RATE` for the largest B tested, with noise: an error of 1 % of the tested range of B."""


@dataclass(frozen=True)
class DecayDamping:
    """Viscous damping by the decay of the velocity at K = 0 [Ns/m, Nms/rad], with its 95 % interval.

    Parameters
    ----------
    value : float or None
    low, high : float or None
        By the scatter of the trials, which tells no error that they share; None for a single one.
    trials : int
    significant : bool or None
        Whether the interval leaves out 0; None where there is no interval.
    reason : str or None
        Why there is no value or no interval, or that the value is not significantly different from 0.
    """

    value: float | None
    low: float | None
    high: float | None
    trials: int
    significant: bool | None
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class TrialDamping:
    """Viscous damping and mass of each trial by least squares, shape (n,), NaN where there is a reason."""

    viscous_damping: Floats
    mass: Floats
    reason: tuple[str, ...]


def by_limit(damping: Floats, stiffness: Floats, growth_per_s: Floats, unit: str = "Ns/m") -> Estimate:
    """Return b = -B at the stability limit with K = 0.

    Parameters
    ----------
    damping, stiffness : float64, shape (n,)
        Virtual damping B [Ns/m, Nms/rad] and stiffness K of the trials; only those with K = 0 are used.
    growth_per_s : float64, shape (n,)
        Growth rate of the acceleration, as `verdict.judge` returns it [1/s]; NaN where it is not known.
    unit : str

    Returns
    -------
    Estimate
        Value where the growth rate crosses zero; its interval is -B of the last stable and of the first unstable trial.

    Notes
    -----
    Near the limit the rate is -(b + B)/m, linear in B, and is interpolated between the trials on both sides
    of the zero. A rate of exactly zero on one side is a zero found.

    Source: Hulin 2017, eq. 3.25 for K = 0 and sec. 6.1.2.
    """
    used = (stiffness == 0) & np.isfinite(growth_per_s)
    B, rate = damping[used], growth_per_s[used]

    def told(value: float | None, low: float | None, high: float | None, reason: str | None = None) -> Estimate:
        method = "stability limit at K = 0, interpolated between its neighbours"
        return Estimate(value=value, low=low, high=high, unit=unit, method=method, reason=reason, trials=len(B))

    if not len(B):
        return told(None, None, None, "no usable trial at K = 0: record some with B <= 0")
    levels, member = np.unique(B, return_inverse=True)
    mean = np.bincount(member, weights=rate) / np.bincount(member)
    size = np.abs(mean) / (np.ptp(mean) or 1.0)
    # an undamped device has its limit at B = 0, the end of the range, where noise decides the sign
    at_limit = np.flatnonzero((size <= ZERO_RATE) | ((size <= ZERO_RATE_AT_END) & (levels == levels[-1])))
    if len(at_limit) and at_limit[-1] > 0:
        at = at_limit[-1]
        return told(0.0 - float(levels[at]), 0.0 - float(levels[at]), 0.0 - float(levels[at - 1]))
    stable, unstable = levels[mean < 0], levels[mean >= 0]
    if not len(stable) or not len(unstable):
        trials, side = counted(len(B), "trial"), "stable" if len(stable) else "unstable"
        reason = f"{trials} at K = 0, on the {side} side of the limit only; it needs trials on both sides"
        return told(None, None, None, reason)
    first_unstable = unstable.max()
    above = stable[stable > first_unstable]
    if not len(above):
        return told(None, None, None, "growth rates at K = 0 do not fall with B; the limit is not a single crossing")
    last_stable = above.min()
    low, high = mean[levels == last_stable][0], mean[levels == first_unstable][0]
    crossing = last_stable + (first_unstable - last_stable) * low / (low - high)
    return told(0.0 - float(crossing), 0.0 - float(last_stable), 0.0 - float(first_unstable))


def by_decay(
    damping: Floats,
    stiffness: Floats,
    growth_per_s: Floats,
    mass: float,
    *,
    delay_samples: float,
    sampling_period_s: float,
) -> DecayDamping:
    """Return b by how fast the velocity settles in the trials with K = 0.

    Parameters
    ----------
    damping, stiffness : float64, shape (n,)
        Virtual damping B [Ns/m, Nms/rad] and stiffness K of the trials; only those with K = 0 are used.
    growth_per_s : float64, shape (n,)
        Growth rate s of the acceleration, as `verdict.judge` returns it [1/s]; NaN where it is not known.
    mass : float
        [kg, kg m^2].
    delay_samples : float
        Delay of the virtual damping in sampling periods; hold and difference add one more.
    sampling_period_s : float
        T [s].

    Returns
    -------
    DecayDamping

    Raises
    ------
    ParameterError
        If the mass is not positive.

    Notes
    -----
    b = -m s - B exp(-s (d + 1) T): at B = 0 that is exact, else it neglects terms of (s T)^2/12. A negative
    value is reported as it is: an interval that holds 0 says that the damping is not significant, one below 0
    that the drive, not friction, acts. It is the trials at K = 0 that tell b: with K > 0 the decay of the
    oscillation (the logarithmic decrement) is that of the loop, to which the delayed wall adds more than b; a
    free device, without a wall, does not oscillate.

    Source: Hulin 2017, eq. 3.25 for K = 0.
    """
    if not mass > 0:
        raise ParameterError(f"mass of {mass:g}: expected more than 0.")
    used = (stiffness == 0) & np.isfinite(growth_per_s)
    s, B = growth_per_s[used], damping[used]
    if not len(s):
        return DecayDamping(None, None, None, 0, None, "no usable trial at K = 0: record some")
    each = -mass * s - B * np.exp(-s * (delay_samples + 1) * sampling_period_s)
    value, n = float(each.mean()), len(s)
    if n == 1:
        return DecayDamping(value, None, None, 1, None, "one trial at K = 0: no interval; record more of them")
    half = float(student_95(n - 1) * each.std(ddof=1) / np.sqrt(n))
    low, high = value - half, value + half
    significant = not low <= 0 <= high
    return DecayDamping(value, low, high, n, significant, None if significant else "not significantly different from 0")


def from_trials(batch: TrialBatch, response: Response, delay_samples: int) -> TrialDamping:
    """Return viscous damping and mass of each trial by least squares of its momentum balance.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    delay_samples : int
        Integer delay factor by which the command is shifted.

    Returns
    -------
    TrialDamping

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    m v_k + b (x_k - x_0) = integral of the delayed command, over all intervals from the command edge to the
    end of the log. The balance integrates once, so that an offset or friction of the drive grows with time:
    for such drives use `by_limit`. At rest the balance alone gives b, in motion mass and b.

    Source: Hulin 2017, eq. 6.4 with the viscous term.
    """
    momentum = balance(batch, response.edge_row, delay_samples)
    v, x, p = (np.where(momentum.inside, a, 0.0) for a in (momentum.velocity, momentum.displacement, momentum.impulse))
    count = momentum.inside.sum(axis=1)
    vv, xx, vx = (v * v).sum(axis=1), (x * x).sum(axis=1), (v * x).sum(axis=1)
    vp, xp = (v * p).sum(axis=1), (x * p).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = vx / np.sqrt(vv * xx)
        condition = (1 + np.abs(correlation)) / (1 - np.abs(correlation))
        determinant = vv * xx - vx * vx
        b = (vv * xp - vx * vp) / determinant
        m = (xx * vp - vx * xp) / determinant
    conditioned = np.nan_to_num(condition, nan=np.inf) < LARGEST_CONDITION
    good = response.has_edge & (count >= FEWEST_INTERVALS) & conditioned & (np.nan_to_num(m) > 0)
    reasons = []
    for i in range(len(batch)):
        if good[i]:
            reasons.append("")
        elif not response.has_edge[i]:
            reasons.append(f"no start of the balance: {response.edge_reason[i]}")
        elif count[i] < FEWEST_INTERVALS:
            reasons.append(f"{count[i]} samples after the edge; at least {FEWEST_INTERVALS} are needed")
        elif not conditioned[i]:
            reasons.append("velocity and position are too much alike to tell mass from damping")
        else:
            reasons.append("no positive mass explains the motion with this delay")
    return TrialDamping(np.where(good, b, np.nan), np.where(good, m, np.nan), tuple(reasons))
