"""Determine the delay that explains a measured boundary, and whether the upper part of the boundary is straight.

Source: Hulin 2017, eq. 3.25 and secs. 6.1.3 and 6.5 (delay near the origin and as a whole; the straight upper part).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.comparison.limits import measured_limits
from pipeline.comparison.loops.loop_basis import LoopBasis
from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.student import NORMAL_95, ROUNDING, student_95
from pipeline.planning.loop_limits import linear_limits
from pipeline.records.findings import Quantity
from pipeline.records.results import ImpliedDelay, MeasuredExperiment, StraightBound
from pipeline.records.trials import Floats

NEAR = 0.5
"""Largest damping near the origin, relative to that of the stiffest wall. In the thesis it is 50 of 94 Ns/m."""

FEWEST = 3
"""Smallest number of limits for a delay estimate. A line and a parabola need one more limit."""

DELAYS = np.concatenate([np.linspace(0, 4, 17), np.geomspace(4.5, LARGEST_DELAY, 24)])
"""Grid of delays [samples] for the search of the least-squares delay."""

STEP = 1e-3
"""Step of the delay [samples] for the numerical derivative of limits with respect to delay."""


@dataclass(frozen=True, eq=False)
class _Limits:
    """Measured limits that are not censored, with damping, stiffness and standard error in SI units, shape (n,)."""

    damping: Floats
    stiffness: Floats
    error: Floats

    def part(self, which: np.ndarray) -> _Limits:
        """Return a subset of the limits."""
        return _Limits(self.damping[which], self.stiffness[which], self.error[which])

    def __len__(self) -> int:
        return len(self.damping)


def _limits(result: MeasuredExperiment) -> _Limits:
    """Return the limits of an experiment that a stable and an unstable trial enclose."""
    found = measured_limits(result.boundary)
    which = found.known & ~found.censored & (found.limit > 0)
    error = (found.high - found.low)[which] / (2 * NORMAL_95)
    return _Limits(found.damping[which], found.limit[which], np.maximum(error, ROUNDING * found.limit[which]))


def implied_delay(result: MeasuredExperiment, basis: LoopBasis | None) -> ImpliedDelay:
    """Return the pure delay with which theory fits the measured boundary best, near its origin and for all limits.

    Parameters
    ----------
    result : MeasuredExperiment
        Experiment with measured limits.
    basis : LoopBasis or None
        Source of mass, damping and stiffness. Lag, filter, mode and friction are neglected, so the delay includes their
        effect.

    Notes
    -----
    Near the origin a limit is (B + b)/(T (d + 1/2)) by (3.25), except for theory's small curvature. Least squares
    weight each limit by its interval. The 95 % intervals include the scatter of the limits about the curve, and the
    errors of mass and damping.
    """
    limits, reason = _limits(result), "mass and damping are unknown, so theory gives no limits"
    if basis is None:
        return ImpliedDelay(origin=_none(reason), whole=_none(reason))
    loops = _ideal(basis)
    near = _near_origin(limits)
    return ImpliedDelay(
        origin=_delay(near, loops, "slope of the boundary near its origin (3.25)"),
        whole=_delay(limits, loops, "fit of theory's boundary to all limits"),
    )


def _near_origin(limits: _Limits) -> _Limits:
    """Return the limits near the origin. The result is empty if ``limits`` is empty."""
    if not len(limits):
        return limits
    stiffest = limits.damping[np.argmax(limits.stiffness)]
    return limits.part(limits.damping <= NEAR * stiffest)


def _ideal(basis: LoopBasis) -> list[Loop]:
    """Return loops with only mass, damping, stiffness and delay.

    The first loop has the estimated values. In the other loops, mass or damping is at an end of its interval.
    """
    of = basis.loop.apparent()
    ideal = Loop(
        mass=of.mass,
        damping=of.damping,
        stiffness=of.stiffness,
        motion=of.motion,
        sampling_period_s=of.sampling_period_s,
        delay_samples=0.0,
    )
    loops = [ideal]
    for name in ("mass", "damping"):
        interval = basis.interval(name)
        for end in (interval.low, interval.high):
            if np.isfinite(end) and end > 0 and end != ideal.value(name):
                loops.append(ideal.replace({name: float(end)}))
    return loops


def _none(reason: str) -> Quantity:
    return Quantity(value=None, unit="samples", reason=reason)


def _delay(limits: _Limits, loops: list[Loop], method: str) -> Quantity:
    """Return the delay with which the first loop fits the limits best.

    The interval includes the fits of other loops.
    """
    if len(limits) < FEWEST:
        have = f"{len(limits)} such limits are enclosed by a stable and an unstable trial"
        return _none(f"{have}; {FEWEST} are needed. Record walls on both sides of the limit at more dampings.")

    def curve(loop: Loop) -> Callable[[float], Floats]:
        return lambda delay: linear_limits(loop.replace({"delay_samples": delay}), limits.damping)

    of, *others = (curve(loop) for loop in loops)
    value = _nearest(of, limits, 0)
    low, high = max(value - STEP, 0.0), min(value + STEP, LARGEST_DELAY)
    slope = (of(high) - of(low)) / (high - low) / limits.error
    rest = (limits.stiffness - of(value)) / limits.error
    freedom = len(limits) - 1
    scatter = float(rest @ rest) / freedom
    factor = NORMAL_95 if scatter <= 1 else float(student_95(freedom)) * np.sqrt(scatter)
    if not float(slope @ slope) > 0:
        return _none("theory's limits do not depend on delay at these dampings. Record walls with less damping.")
    own = factor / np.sqrt(float(slope @ slope))
    near = int(np.abs(DELAYS - value).argmin())
    off = np.array([_nearest(each, limits, near) - value for each in others])
    less, more = np.hypot(own, off.min(initial=0.0)), np.hypot(own, off.max(initial=0.0))
    low, high = max(value - float(less), 0.0), value + float(more)
    return Quantity(value=value, low=low, high=high, unit="samples", method=method)


def _nearest(curve: Callable[[float], Floats], limits: _Limits, start: int) -> float:
    """Return the delay with the least sum of squared residuals of the limits, in units of their standard errors.

    The grid is searched upwards from an index, and downwards from it as long as the residuals decrease. A longer delay
    lowers every limit, so the search ends at the first delay for which all limits of theory are below the measured
    limits.
    """
    from scipy.optimize import minimize_scalar

    def lost(theory: Floats) -> float:
        rest = (limits.stiffness - theory) / limits.error
        return float(rest @ rest)

    lost_at = np.full(len(DELAYS), np.inf)
    for index in range(start, len(DELAYS)):
        theory = curve(DELAYS[index])
        lost_at[index] = lost(theory)
        if (theory < limits.stiffness).all():
            break
    best = int(np.argmin(lost_at))
    while 0 < best <= start:
        lost_at[best - 1] = lost(curve(DELAYS[best - 1]))
        if lost_at[best - 1] >= lost_at[best]:
            break
        best -= 1
    ends = DELAYS[max(best - 1, 0)], DELAYS[min(best + 1, len(DELAYS) - 1)]
    found = minimize_scalar(lambda delay: lost(curve(delay)), bounds=ends, method="bounded", options={"xatol": 1e-9})
    return float(found.x) if found.fun < lost_at[best] else float(DELAYS[best])


def straight_bound(result: MeasuredExperiment, basis: LoopBasis | None) -> StraightBound | None:
    """Return the line through the measured limits at and beyond the damping of the stiffest wall.

    The result is None if there are fewer than four limits.

    Parameters
    ----------
    result : MeasuredExperiment
    basis : LoopBasis or None
        Loop whose limits at the same dampings give the theoretical curvature.

    Notes
    -----
    The line is K <= stiffness + slope B (6.5), by least squares weighted by the intervals of the limits and by their
    scatter about the line. The curvature is half the second derivative of a parabola through the
    same limits. It is compared with theory at the dampings where theory has a stable wall.
    """
    limits = _limits(result)
    if not len(limits):
        return None
    upper = limits.part(limits.damping >= limits.damping[np.argmax(limits.stiffness)])
    if len(upper) <= FEWEST:
        return None
    line, reach = _polynomial(upper, upper.stiffness, 1)
    bound = {"stiffness": line[0], "slope": line[1], "slope_low": line[1] - reach[1], "slope_high": line[1] + reach[1]}
    bound |= {"damping_first": upper.damping.min(), "damping_last": upper.damping.max()}
    curvature = _curvature(upper, None if basis is None else linear_limits(basis.loop, upper.damping))
    numbers = {name: float(value) for name, value in (bound | curvature).items()}
    return StraightBound(**numbers, limits=len(upper))


def _curvature(upper: _Limits, theory: Floats | None) -> dict[str, float]:
    """Return the curvature of measured limits with its interval, and that of theory at the same dampings.

    Dampings at which theory has no stable wall are left out if enough other dampings remain. The result is empty for
    too few limits.
    """
    stable = np.zeros(len(upper), dtype=np.bool_) if theory is None else theory > 0
    compared = theory is not None and int(stable.sum()) > FEWEST
    shown = upper.part(stable) if compared else upper
    if len(shown) <= FEWEST:
        return {}
    parabola, reach = _polynomial(shown, shown.stiffness, 2)
    found = {
        "curvature": parabola[2],
        "curvature_low": parabola[2] - reach[2],
        "curvature_high": parabola[2] + reach[2],
    }
    if theory is None or not compared:
        return found
    of_theory = _polynomial(shown, theory[stable], 2)[0][2]
    return found | {"curvature_theory": of_theory, "curvature_last": shown.damping.max()}


def _polynomial(limits: _Limits, stiffness: Floats, degree: int) -> tuple[Floats, Floats]:
    """Return the coefficients of a polynomial over damping, the constant first, and the half widths of 95 %
    intervals.

    If the limits scatter more than their errors, a common variance is added to the squared errors, with which chi^2
    equals its expectation. Otherwise a few precise limits would determine a line that the others miss.

    Source: Paule and Mandel 1982, "Consensus values and weighting factors".
    """
    freedom = len(limits) - degree - 1

    def fit(extra: float) -> tuple[Floats, Floats, float]:
        error = np.sqrt(limits.error**2 + extra)
        found, known = np.polyfit(limits.damping, stiffness, degree, w=1 / error, cov="unscaled")
        rest = (stiffness - np.polyval(found, limits.damping)) / error
        return found, known, float(rest @ rest) / freedom

    extra, most = 0.0, len(limits) * float(np.ptp(stiffness)) ** 2
    if fit(0.0)[2] > 1 and most > 0:
        from scipy.optimize import brentq

        extra = float(brentq(lambda variance: fit(variance)[2] - 1, 0.0, most))
    found, known, _ = fit(extra)
    factor = NORMAL_95 if not extra else float(student_95(freedom))
    return found[::-1], factor * np.sqrt(known.diagonal()[::-1])
