"""Band of stability boundaries that the intervals of mass, damping and delay leave open, and what lies outside it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.comparison.scores.overlap import MeasuredLimits
from pipeline.loop.device_loop import loop_of, wall_units
from pipeline.records.batch import Booleans, Floats
from pipeline.records.findings import Estimate
from pipeline.records.loop_parts import LoopParts
from pipeline.records.score_records import BandScore, Departure
from pipeline.theory.limits import stiffness_limit

MASSES = 5
"""Masses that are tried: over m alone the limit may have an extremum inside the interval. It is flat there: for +-10 %
of m the band misses less than 1e-3 of the limit."""


IDEAL = LoopParts()


@dataclass(frozen=True)
class ParameterBox:
    """Intervals of m [kg, kg m^2], b [Ns/m, Nms/rad] and d [samples], with T [s] and k [N/m, Nm/rad]."""

    mass: tuple[float, float]
    viscous_damping: tuple[float, float]
    delay_samples: tuple[float, float]
    sampling_period_s: float
    stiffness: float = 0.0
    loop: LoopParts = IDEAL


def parameter_box(
    mass: Estimate,
    viscous_damping: Estimate,
    delay: Estimate,
    sampling_period_s: float,
    *,
    stiffness: float = 0.0,
    model_holds: bool = True,
) -> ParameterBox | None:
    """Return what the estimates of an experiment leave open, or None where one of them has no value.

    Parameters
    ----------
    mass, viscous_damping, delay : Estimate
        Intervals of 95 %; the value itself where there is none. Damping below zero counts as zero: theory asks for
        b >= 0.
    sampling_period_s, stiffness : float
        T [s] and the physical stiffness k, which is not estimated.
    model_holds : bool
        Whether the model explains the logs, so that its delay may be used.

    Notes
    -----
    The delay runs over the integer factors that occurred (its interval without the open upper end of (6.3)): jitter
    makes a boundary between that of the shortest and the longest delay. The delay by the model, which has a fraction,
    is added. Without it the upper end of (6.3) stays in: between the rows of a log nothing tells the delay.

    Source: Hulin 2017, eqs. 6.2, 6.3 and sec. 6.1.3.
    """
    if mass.value is None or viscous_damping.value is None or delay.value is None:
        return None
    m_low, m_high = _interval(mass)
    b_low, b_high = _interval(viscous_damping)
    d_low, d_high = _interval(delay)
    model = delay.by_method.get("model")
    if model_holds and model is not None and model.value is not None:
        low, high = _interval(model)
        d_low, d_high = min(d_low, low), max(d_high - 1, d_low, high)
    return ParameterBox(
        (m_low, m_high),
        (max(b_low, 0.0), max(b_high, 0.0)),
        (max(d_low, 0.0), max(d_high, 0.0)),
        sampling_period_s,
        stiffness,
    )


def theory_band(box: ParameterBox, damping: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and the highest stability limit [N/m, Nm/rad] over a box of parameters.

    Parameters
    ----------
    box : ParameterBox
    damping : float64, shape (n,)
        B [Ns/m, Nms/rad].

    Returns
    -------
    low, high : float64, shape (n,)
        Largest stable stiffness at each damping, 0 where none is stable.

    Raises
    ------
    ParameterError
        If an interval is reversed or a parameter outside what theory allows.

    Notes
    -----
    At given B the limit falls with d and grows with b, so that the ends of these intervals give the ends of the band.
    With m it grows on the upper part of a boundary and falls a little on the lower one; `MASSES` are tried.

    Source: Hulin 2017, sec. 3.4 (boundary); band ours.
    """
    for name in ("mass", "viscous_damping", "delay_samples"):
        low, high = getattr(box, name)
        if not low <= high:
            raise ParameterError(f"{name} from {low} to {high}: expected an interval, its lower end first.")

    def limits(b: float, d: float) -> Floats:
        found = []
        for m in np.linspace(*box.mass, MASSES):
            scale = wall_units(float(m), box.sampling_period_s, box.loop)
            loop = loop_of(float(m), b, box.stiffness, d, box.sampling_period_s, box.loop)
            alpha = stiffness_limit(loop, damping / scale.damping)
            found.append(np.maximum(alpha, 0.0) * scale.stiffness)
        return np.stack(found)

    (b_low, b_high), (d_low, d_high) = box.viscous_damping, box.delay_samples
    return limits(b_low, d_high).min(axis=0), limits(b_high, d_low).max(axis=0)


def band_score(limits: MeasuredLimits, box: ParameterBox) -> BandScore | None:
    """Return how many measured limits lie inside the band, and where they leave it; None without a limit.

    Parameters
    ----------
    limits : MeasuredLimits
        Censored ones count only where even their lower bound lies above the band.
    box : ParameterBox
    """
    low, high = theory_band(box, limits.damping)
    above = limits.known & (limits.low > high)
    below = ~limits.censored & (limits.high < low)
    # where no trial is stable, the limit is only known to lie below the softest one
    counted = (limits.known & ~limits.censored) | above | below
    if not counted.any():
        return None
    return BandScore(
        mass=box.mass,
        viscous_damping=box.viscous_damping,
        delay_samples=box.delay_samples,
        damping=tuple(limits.damping.tolist()),
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        points=int(counted.sum()),
        inside=int((counted & ~above & ~below).sum()),
        departures=_departures(limits.damping[counted], above[counted], below[counted]),
    )


def _departures(damping: Floats, above: Booleans, below: Booleans) -> tuple[Departure, ...]:
    """Runs of neighbouring dampings outside the band on one side."""
    side = above.astype(np.int64) - below
    starts = [0, *(np.flatnonzero(np.diff(side)) + 1).tolist(), len(side)]
    return tuple(
        Departure(
            side="above" if side[first] > 0 else "below",
            damping_low=float(damping[first]),
            damping_high=float(damping[end - 1]),
            dampings=end - first,
        )
        for first, end in pairwise(starts)
        if side[first] != 0
    )


def _interval(estimate: Estimate) -> tuple[float, float]:
    """Interval of an estimate that has a value; the value itself where it has none."""
    value = estimate.value or 0.0
    return (
        value if estimate.low is None else min(estimate.low, value),
        value if estimate.high is None else max(estimate.high, value),
    )
