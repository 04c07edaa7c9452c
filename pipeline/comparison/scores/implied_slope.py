"""Delay that a measured stability boundary implies by its slope near the origin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import counted, percent
from pipeline.measured.intervals import NORMAL_95, student_95
from pipeline.records.batch import Booleans, Floats
from pipeline.records.findings import BoundaryPoint, Estimate

LOW_DAMPING = 0.5
"""Part of the damping of the stiffest limit up to which a boundary is near the origin: over it (b + B)/K is a parabola
to within 0.02 samples for d <= 4.5, and 0.04 for d = 8."""

FEWEST_FOR_PARABOLA = 6
"""Limits from which on a parabola is fitted; a line, with fewer, is off by up to 0.2 samples for d <= 4.5."""

FEWEST_POINTS = 3
"""Limits that a line and its error need."""


@dataclass(frozen=True)
class DeviceParameters:
    """What the theoretical limit depends on beside the delay, with standard errors of what is estimated.

    Parameters
    ----------
    mass, viscous_damping : float
        m [kg, kg m^2] and b [Ns/m, Nms/rad].
    sampling_period_s : float
        T [s].
    mass_error, damping_error : float
        Standard errors of m and b; they are carried into the intervals.
    """

    mass: float
    viscous_damping: float
    sampling_period_s: float
    mass_error: float = 0.0
    damping_error: float = 0.0


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits K of a measured boundary and their standard errors [N/m, Nm/rad] at dampings B [Ns/m, Nms/rad].

    All of shape (n,). ``censored`` marks those that are lower bounds only; their error is that of a typical limit.
    """

    damping: Floats
    stiffness: Floats
    error: Floats
    censored: Booleans


def implied_by_slope(points: Sequence[BoundaryPoint], device: DeviceParameters) -> Estimate:
    """Return the delay factor by the slope of the boundary where stiffness and damping tend to their origin.

    Parameters
    ----------
    points : sequence of BoundaryPoint
    device : DeviceParameters
        The mass is needed for a correction only, which vanishes with b.

    Returns
    -------
    Estimate
        In samples; ``trials`` is the number of limits used. ``by_method`` holds the line through the origin, K
        proportional to b + B, over the same limits.

    Notes
    -----
    By (3.25) the ratio (b + B)/K is the effective delay t_r = (d + 1/2) T. Along the exact boundary it grows with B;
    so it is extrapolated to b + B = 0 by a parabola over the limits up to `LOW_DAMPING` of the damping of the stiffest
    one. A line through the origin over the same limits, beside it, is biased by this (0.8 samples at d = 4, b = 0).
    Lower bounds are left out.

    At the origin the exact ratio is t_0 = t_r (1 - b t_r/(2 (m + b t_r))): the expansion of the characteristic
    equation (3.19) for small frequency, with exp(-s t_r) kept to second order. It is solved for t_r, which
    leaves 0.03 samples up to b t_r/m = 0.26 (Falcon, firm grip), and is not meant for much more.

    Source: Hulin 2017, eqs. 3.19, 3.25 and sec. 6.1.3; extrapolation and correction ours.
    """
    method = "slope near the origin (3.25)"
    limits = limits_of(points)
    near = ~limits.censored & (limits.stiffness > 0) & (limits.damping + device.viscous_damping > 0)
    if near.any():
        stiffest = limits.damping[near][np.argmax(limits.stiffness[near])]
        near &= limits.damping <= LOW_DAMPING * stiffest
    count = int(near.sum())
    if count < FEWEST_POINTS:
        reason = (
            f"{counted(count, 'limit')} of stability up to {percent(LOW_DAMPING)} of the damping of the stiffest one, "
            f"with b + B > 0; it needs {FEWEST_POINTS}"
        )
        return Estimate(value=None, unit="samples", method=method, reason=reason, trials=count)
    limits = Limits(*(getattr(limits, name)[near] for name in ("damping", "stiffness", "error", "censored")))
    value, error = _extrapolated(limits, device)
    line, line_error = _line(limits, device)

    def at(changed: DeviceParameters) -> float:
        return _extrapolated(limits, changed)[0]

    def through(changed: DeviceParameters) -> float:
        return _line(limits, changed)[0]

    order = 3 if count >= FEWEST_FOR_PARABOLA else 2
    plain = _interval(
        line,
        float(np.hypot(student_95(count - 1) * line_error, NORMAL_95 * propagated(device, line, through))),
        "line through the origin, K proportional to b + B (3.25)",
        count,
    )
    reach = float(np.hypot(student_95(count - order) * error, NORMAL_95 * propagated(device, value, at)))
    shape = "parabola" if order == 3 else "line"
    best = _interval(value, reach, f"{method}: (b + B)/K extrapolated to the origin by a {shape}", count)
    return best.model_copy(update={"by_method": {"line_through_origin": plain}})


def _interval(value: float, reach: float, method: str, count: int) -> Estimate:
    if value < 0:
        reason = "the slope near the origin is steeper than without any delay: mass or damping do not fit"
        return Estimate(value=None, unit="samples", method=method, reason=reason, trials=count)
    return Estimate(value=value, low=value - reach, high=value + reach, unit="samples", method=method, trials=count)


def bounded_below(points: Sequence[BoundaryPoint]) -> list[BoundaryPoint]:
    """Return the points that have a limit, or a lower bound above 0."""
    return [p for p in points if p.low is not None and (p.estimate is not None or p.low > 0)]


def limits_of(points: Sequence[BoundaryPoint]) -> Limits:
    """Return the limits of those points of a boundary that have one, or a lower bound."""
    used = bounded_below(points)
    low, high, value = (np.array([getattr(p, n) for p in used], dtype=np.float64) for n in ("low", "high", "estimate"))
    censored = np.isnan(high) | np.isnan(value)
    error = (high - low) / np.sqrt(12)  # exact for a bracket, a little more than that of a fitted limit
    known = error[np.isfinite(error) & (error > 0)]
    # a limit that claims to have no error would outweigh all others
    least = 0.1 * float(np.median(known)) if len(known) else 1.0
    error = np.where(np.isfinite(error), np.maximum(error, least), 10 * least)
    return Limits(np.array([p.damping for p in used]), np.where(censored, low, value), error, censored)


def propagated(device: DeviceParameters, value: float, estimate: Callable[[DeviceParameters], float]) -> float:
    """Standard error of an estimate by those of mass and damping: its change when either changes by one."""
    changes = []
    if device.mass_error > 0:
        changes.append(estimate(replace(device, mass=device.mass + device.mass_error)) - value)
    if device.damping_error > 0:
        shifted = replace(device, viscous_damping=device.viscous_damping + device.damping_error)
        changes.append(estimate(shifted) - value)
    return float(np.sqrt(np.square(changes).sum())) if changes else 0.0


def _extrapolated(limits: Limits, device: DeviceParameters) -> tuple[float, float]:
    """Delay factor and standard error by (b + B)/K at the origin, corrected for b."""
    x = limits.damping + device.viscous_damping
    ratio, sigma = x / limits.stiffness, np.abs(x) * limits.error / limits.stiffness**2
    order = 3 if len(x) >= FEWEST_FOR_PARABOLA else 2
    scale = np.abs(x).max()
    design = np.stack([(x / scale) ** power for power in range(order)], axis=1)
    coefficients, error = _weighted(design, ratio, sigma)
    m, b, T = device.mass, device.viscous_damping, device.sampling_period_s

    def effective(t_0: float) -> float:
        rest = m - t_0 * b
        return 2 * t_0 * m / (rest + float(np.sqrt(max(rest**2 + 2 * b * t_0 * m, 0.0))))

    t_r = effective(coefficients)
    slope = (effective(coefficients + error) - effective(coefficients - error)) / 2 if error > 0 else 0.0
    return t_r / T - 0.5, abs(slope) / T


def _line(limits: Limits, device: DeviceParameters) -> tuple[float, float]:
    """Delay factor and standard error by K = (b + B)/t_r."""
    x = limits.damping + device.viscous_damping
    slope, error = _weighted(x[:, None], limits.stiffness, limits.error)
    T = device.sampling_period_s
    return 1 / (slope * T) - 0.5, error / (slope**2 * T)


def _weighted(design: Floats, y: Floats, sigma: Floats) -> tuple[float, float]:
    """First coefficient of weighted least squares and its standard error, larger where the fit is worse than sigma."""
    scaled = design / sigma[:, None]
    inverse = np.linalg.inv(scaled.T @ scaled)
    coefficients = inverse @ (scaled.T @ (y / sigma))
    freedom = len(y) - design.shape[1]
    square = float(((y / sigma - scaled @ coefficients) ** 2).sum()) / max(freedom, 1)
    return float(coefficients[0]), float(np.sqrt(inverse[0, 0] * max(square, 1.0)))
