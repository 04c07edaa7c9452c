"""What trials tell of the limit at each damping: brackets by verdicts, and growth rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.plan.verdicts import Tried
from pipeline.records.batch import Floats

RATE_TRUST = 0.2
"""Error of a limit that one growth rate tells, relative to its distance from the trial. In simulations of Falcons with
filter, lag, mode and friction 0.05 to 0.3; the rate is convex over K."""

CREEP = 0.8
"""Share of the rate K/B of a creeping motion: a mode that decays nearly so fast is that motion, and tells nothing."""

APART = 0.03
"""Distance of two walls relative to K from which on their rates tell a slope."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was seen at dampings, shape (n,) each.

    Ends of the bracket by verdicts (0 and infinite where there is none), the wall whose growth rate is nearest to 0,
    that rate [1/s], and how it rises over K as two trials show; NaN where there is none.
    """

    damping: Floats
    low: Floats
    high: Floats
    wall: Floats
    rate: Floats
    slope: Floats


def informative(tried: Tried) -> Floats:
    """Return the growth rates that tell of the limit, NaN elsewhere: a creeping motion does not."""
    creep = CREEP * tried.stiffness / np.maximum(np.abs(tried.damping), 1e-300)
    decay = -tried.growth
    known = np.isfinite(tried.growth) & ((decay < 0) | (decay < creep) & (tried.verdict == "stable"))
    return np.where(known, tried.growth, np.nan)


def evidence(tried: Tried, dampings: Floats, brackets: list[tuple[float, float]]) -> Evidence:
    """Return what the trials at each damping tell of its limit.

    Parameters
    ----------
    tried : Tried
    dampings : float64, shape (n,)
    brackets : list of (float, float), n of them
        Ends by the verdicts, 0 and infinity where there is none.
    """
    count = len(dampings)
    wall, rate, slope = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    rates = informative(tried)
    for place, damping in enumerate(dampings):
        own = np.flatnonzero((tried.damping == damping) & np.isfinite(rates))
        own = own[np.argsort(np.abs(rates[own]), kind="stable")]
        if not len(own):
            continue
        first = own[0]
        wall[place], rate[place] = tried.stiffness[first], rates[first]
        for other in own[1:]:
            apart = tried.stiffness[other] - wall[place]
            if abs(apart) > APART * wall[place]:
                rise = (rates[other] - rate[place]) / apart
                slope[place] = rise if rise > 0 else np.nan
                break
    ends = np.array(brackets, dtype=np.float64).reshape(count, 2)
    return Evidence(dampings, ends[:, 0], ends[:, 1], wall, rate, slope)


def told_by_rates(seen: Evidence, slope: Floats) -> tuple[Floats, Floats]:
    """Return the limits that growth rates tell and their errors, NaN where there is none; shape of the slope.

    A slope that two trials show is better than one of a model, which holds near the limit alone. A limit below zero is
    one at zero, the surer the farther below.
    """
    own = np.isfinite(seen.slope)
    away = seen.rate / np.where(own, seen.slope, slope)
    error = RATE_TRUST * np.abs(away) * np.where(own, 1, 1 + 2 * np.abs(away) / seen.wall)
    told = seen.wall - away
    below = np.maximum(-told, 0.0)
    return np.maximum(told, 0.0), error / (1 + below / np.maximum(error, 1e-300))
