"""Stiffness that the operator's arm adds to the device, by the stability limit at negative virtual stiffness."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.base.wording import counted
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate


def by_limit(stiffness: Floats, damping: Floats, growth_per_s: Floats, unit: str = "N/m") -> Estimate:
    """Return k = -K at the lower stability limit, from trials with K <= 0 at a fixed B.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad]; only trials with K <= 0 are used.
    growth_per_s : float64, shape (n,)
        Growth rate as `verdict.judge` returns it [1/s]; NaN where it is not known.
    unit : str

    Returns
    -------
    Estimate
        Value where the growth rate crosses zero; its interval is -K of the last stable and of the first unstable trial.

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
    known: dict[str, Any] = {"unit": unit, "trials": len(K), "method": "stability limit at K < 0"}
    if not (K < 0).any():
        return Estimate(value=None, reason="no usable trial with K < 0: record some at a fixed B > 0", **known)
    found = [(level, at) for level in np.unique(B) if (at := _at(K[level == B], rate[level == B]))]
    if not found:
        side = "unstable" if (rate >= 0).all() else "stable" if (rate < 0).all() else "one"
        trials = f"{counted(len(K), 'trial')} with K <= 0, at each B on {side} side of the limit only"
        return Estimate(value=None, reason=f"{trials}; it needs both at the same B", **known)
    level, (value, low, high) = min(found, key=lambda one: (one[1][2] - one[1][1], -one[0]))
    known["method"] = f"stability limit at K < 0, B = {level:g}"
    reason = f"between {low:g} and {high:g}: no second trial on either side that would tell where; record one"
    return Estimate(value=value, low=low, high=high, reason=reason if value is None else None, **known)


def _at(K: Floats, rate: Floats) -> tuple[float | None, float, float] | None:
    """Return the limit -K at one B with its bracket, without a value where the rates do not tell it, and None where the
    trials do not bracket it once."""
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
        return None, low, high
    return float(np.clip(0.0 - crossing, low, high)), low, high
