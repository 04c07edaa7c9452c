"""Stiffness that the operator's arm adds to the device, by the stability limit at negative virtual stiffness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted
from pipeline.records.batch import Floats


@dataclass(frozen=True)
class LimitStiffness:
    """Physical stiffness k by the stability limit [N/m, Nm/rad], with the bracket that the trials give.

    Parameters
    ----------
    value : float or None
        -K where the growth rate crosses zero; None also where there is a bracket alone.
    low, high : float or None
        -K of the last stable and of the first unstable trial.
    damping : float or None
        Virtual damping B of the trials that it comes from [Ns/m, Nms/rad].
    trials : int
        Trials used, those of all B.
    reason : str or None
    """

    value: float | None
    low: float | None
    high: float | None
    damping: float | None
    trials: int
    reason: str | None = None


def by_limit(stiffness: Floats, damping: Floats, growth_per_s: Floats) -> LimitStiffness:
    """Return k = -K at the lower stability limit, from trials with K <= 0 at a fixed B.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad]; only trials with K <= 0 are used.
    growth_per_s : float64, shape (n,)
        Growth rate as `verdict.judge` returns it [1/s]; NaN where it is not known.

    Returns
    -------
    LimitStiffness

    Notes
    -----
    Below K = -k the device runs away from the wall's rest, whatever B, mass and delay. Close to the limit the
    rate is -(k + K)/(b + B), linear in K, and is interpolated between the trials on both sides. At K = 0 the
    rate is that of the acceleration, which can be another mode: its sign counts, its size does not, and the value
    is extrapolated from the two nearest unstable trials. Of several B the one with the narrowest bracket is taken,
    of equal ones the largest B, where the slow mode stands out. A device without an arm gives a bracket
    that begins at 0.

    Source: Hulin 2017, eq. 3.22.
    """
    used = (stiffness <= 0) & np.isfinite(growth_per_s)
    K, B, rate = stiffness[used], damping[used], growth_per_s[used]
    if not (K < 0).any():
        return LimitStiffness(
            None, None, None, None, len(K), "no usable trial with K < 0: record some at a fixed B > 0"
        )
    found = [result for level in np.unique(B) if (result := _at(K[level == B], rate[level == B], float(level), len(K)))]
    if not found:
        side = "unstable" if (rate >= 0).all() else "stable" if (rate < 0).all() else "one"
        return LimitStiffness(
            None,
            None,
            None,
            None,
            len(K),
            f"{counted(len(K), 'trial')} with K <= 0, at each B on {side} side of the limit only; "
            "it needs both at the same B",
        )
    return min(found, key=lambda r: ((r.high or 0.0) - (r.low or 0.0), -(r.damping or 0.0)))


def _at(K: Floats, rate: Floats, damping: float, trials: int) -> LimitStiffness | None:
    """Limit at one B, None where the trials do not bracket it once."""
    levels, member = np.unique(K, return_inverse=True)
    mean = np.bincount(member, weights=rate) / np.bincount(member)
    stable, unstable = levels[mean < 0], levels[mean >= 0]
    if not len(stable) or not len(unstable) or unstable.max() >= stable.min():
        return None
    first, last = unstable.max(), stable.min()
    above, below = mean[levels == last][0], mean[levels == first][0]
    low, high = 0.0 - float(last), 0.0 - float(first)
    if last < 0:
        crossing = last + (first - last) * above / (above - below)
    elif len(unstable) > 1 and mean[levels == unstable[-2]][0] > below:
        crossing = first + (first - unstable[-2]) * below / (mean[levels == unstable[-2]][0] - below)
    else:
        reason = f"between {low:g} and {high:g}: no second trial on either side that would tell where; record one"
        return LimitStiffness(None, low, high, damping, trials, reason)
    return LimitStiffness(float(np.clip(0.0 - crossing, low, high)), low, high, damping, trials)
