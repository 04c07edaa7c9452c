"""Delay that a measured stability boundary implies, by its slope near the origin and by its whole course.

A boundary knows nothing of the first position change, from which the delay is else read: where both disagree, the
model (constant delay, rigid device) does not hold. With jitter the boundary lies between those of the shortest and the
longest delay, and near the origin it follows a shorter one than elsewhere (6.1.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted, percent
from pipeline.comparison.scores.implied_slope import (
    FEWEST_POINTS,
    DeviceParameters,
    Limits,
    implied_by_slope,
    limits_of,
    propagated,
)
from pipeline.loop.loop import Normalised
from pipeline.measured.intervals import NORMAL_95, student_95
from pipeline.records.batch import Floats
from pipeline.records.findings import BoundaryPoint, Estimate
from pipeline.theory.limits import stiffness_limit

LONGEST = 64.0
"""Largest delay factor that a boundary is compared with, eight times that of any experiment of the thesis."""

STEP = 0.05
"""Step of the delays at which theory is tabulated: interpolation between them is off by 0.002 samples at most."""

COARSE_STEP = 0.5
"""Step of the delays that only say where a table in steps of `STEP` is needed; a multiple of it."""

AROUND = COARSE_STEP
"""Delays tabulated on either side of those that limits imply: their interpolation in coarse steps is off by less."""

LEAST_REACH = 0.01
"""Least half width of the interval [samples]: the sensor shifts growth rates of all dampings alike, which no scatter of
the limits shows, and theory is interpolated."""

MISFIT = 0.02
"""Deviation of the limits from theory, relative to them and beyond their errors, that is worth a warning: 2 % of
stiffness are 0.04 samples at d = 4."""

_ZOOMS = 6
"""Ten-fold zooms into the best delay: from `STEP` to less than any interval."""

_HALVINGS = 50
"""Bisections of the misfit: more than its digits are worth."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """Delay factor, half width of its 95 % interval, and relative misfit of theory."""

    value: float
    reach: float
    misfit: float


def implied_delay(points: Sequence[BoundaryPoint], device: DeviceParameters) -> Estimate:
    """Return the delay factor whose theoretical boundary is nearest to the measured one.

    Parameters
    ----------
    points : sequence of BoundaryPoint
        As `boundary_band.boundary_band` returns them.
    device : DeviceParameters
        Negative damping counts as none here: theory asks for b >= 0.

    Returns
    -------
    Estimate
        In samples, may be fractional; ``by_method`` holds `implied_by_slope`. ``trials`` is the number of dampings.

    Raises
    ------
    ParameterError
        If mass or sampling period is not positive.

    Notes
    -----
    Least squares of the stiffness at given damping, weighted by 1/(error^2 + (misfit K)^2). The misfit is the relative
    deviation beyond the errors that makes the mean square deviation one; it is 0 where one delay explains all
    limits, and above `MISFIT` it gives a warning, which names the range of delays that single limits imply.
    Neighbouring limits then deviate alike, so the interval is widened for the correlation of neighbours. A limit that
    is a lower bound counts only where theory lies below it.

    The whole boundary scales with m, so that an error of the mass of 2 % is one of 0.04 samples at d = 4.

    Source: Hulin 2017, secs. 3.4 and 6.1.3.
    """
    method = "fit of the whole theoretical boundary"
    limits = limits_of(points)
    count = int((~limits.censored).sum())
    slope = {"slope_near_origin": implied_by_slope(points, device)}
    if count < FEWEST_POINTS:
        reason = (
            f"{counted(count, 'damping')} with a limit of stability that is no mere bound; it needs {FEWEST_POINTS}"
        )
        return Estimate(value=None, unit="samples", method=method, reason=reason, trials=count, by_method=slope)
    delays = _delays(limits, device)
    theory = _table(limits, device, delays)
    fit = _fit(limits, delays, theory)

    def value(changed: DeviceParameters) -> float:
        near = _delays(limits, changed)
        return _fit(limits, near, _table(limits, changed, near)).value

    reach = float(np.hypot(max(fit.reach, LEAST_REACH), NORMAL_95 * propagated(device, fit.value, value)))
    warnings = []
    if fit.value >= LONGEST:
        warnings.append(f"the longest delay compared, {LONGEST:g} samples, fits best")
    beyond = int((limits.stiffness - NORMAL_95 * limits.error > theory[0]).sum())
    if beyond:
        warnings.append(
            f"{beyond} of {len(limits.damping)} limits lie above theory even without delay: mass, damping or sampling "
            "period do not fit"
        )
    single = _single(limits.stiffness, delays, theory)[~limits.censored]
    single = single[np.isfinite(single)]
    if fit.misfit > MISFIT and len(single):
        warnings.append(
            f"no single delay explains the boundary: its limits deviate by {percent(fit.misfit, 1)} (rms) "
            f"beyond their errors, those at single dampings imply {single.min():.2f} to {single.max():.2f} samples"
        )
    return Estimate(
        value=fit.value,
        low=max(fit.value - reach, 0.0),
        high=fit.value + reach,
        unit="samples",
        method=method,
        trials=len(limits.damping),
        by_method=slope,
        warning="; ".join(warnings) or None,
    )


def _delays(limits: Limits, device: DeviceParameters) -> Floats:
    """Delays at which theory is tabulated: coarse steps up to one whose limits are too low, fine ones where it matters.

    Theory falls with the delay. What fits best lies between the least and the largest delay that single limits and the
    ends of their intervals imply, so that only these and the neighbourhood need fine steps.
    """
    scale = Normalised(device.mass, device.sampling_period_s)
    coarse, rows = [0.0], [_row(limits, device, scale, 0.0)]
    while coarse[-1] < LONGEST and not (rows[-1] < 0.5 * limits.stiffness).all():
        coarse.append(coarse[-1] + COARSE_STEP)
        rows.append(_row(limits, device, scale, coarse[-1]))
    delays, theory = np.array(coarse), np.stack(rows)
    reach = NORMAL_95 * limits.error
    single = np.concatenate([_single(k, delays, theory) for k in (limits.stiffness - reach, limits.stiffness + reach)])
    single = np.nan_to_num(single, nan=0.0)  # theory is too low even without delay
    first, last = single.min() - AROUND, single.max() + AROUND
    fine = STEP * np.arange(int(LONGEST / STEP) + 1)
    fine = fine[(fine >= first) & (fine <= last)]
    # both grids hold the same numbers where they meet, up to rounding
    return np.unique(np.round(np.concatenate([delays, fine]), 9))


def _table(limits: Limits, device: DeviceParameters, delays: Floats) -> Floats:
    """Theoretical limit [N/m, Nm/rad] for each delay at each damping, shape (delays, dampings)."""
    scale = Normalised(device.mass, device.sampling_period_s)
    return np.stack([_row(limits, device, scale, float(delay)) for delay in delays])


def _row(limits: Limits, device: DeviceParameters, scale: Normalised, delay: float) -> Floats:
    loop = scale.loop(0.0, max(device.viscous_damping, 0.0), delay)
    # a wall that no stiffness makes stable has its limit at zero
    return np.maximum(stiffness_limit(loop, limits.damping / scale.damping), 0.0) * scale.stiffness


def _single(stiffness: Floats, delays: Floats, theory: Floats) -> Floats:
    """Delay at which theory falls to a stiffness, one per damping, by interpolation; NaN where it is always below."""
    above = theory >= stiffness[None, :]
    last = np.where(above.any(axis=0), len(delays) - 1 - np.argmax(above[::-1], axis=0), 0)
    after = np.minimum(last + 1, len(delays) - 1)
    at = np.arange(len(stiffness))
    fall = theory[last, at] - theory[after, at]
    share = np.where(fall > 0, (theory[last, at] - stiffness) / np.where(fall > 0, fall, 1.0), 0.0)
    return np.where(above.any(axis=0), delays[last] + STEP * share, np.nan)


def _fit(limits: Limits, delays: Floats, theory: Floats) -> _Fit:
    """Delay of least weighted squares with its interval, and the relative misfit of theory."""
    freedom = max(int((~limits.censored).sum()) - 1, 1)

    def deviation(delay: Floats) -> Floats:
        row = np.clip(np.searchsorted(delays, delay, side="right") - 1, 0, len(delays) - 2)
        part = ((delay - delays[row]) / (delays[row + 1] - delays[row]))[:, None]
        difference = (1 - part) * theory[row] + part * theory[row + 1] - limits.stiffness
        result: Floats = np.where(limits.censored, np.minimum(difference, 0.0), difference)
        return result

    def nearest(misfit: float) -> tuple[float, float]:
        variance = limits.error**2 + (misfit * limits.stiffness) ** 2
        grid = delays
        for _ in range(_ZOOMS):
            squares = (deviation(grid) ** 2 / variance).sum(axis=1)
            best = int(np.argmin(squares))
            least, delay = float(squares[best]), float(grid[best])
            grid = np.linspace(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)], 21)
        return delay, least

    misfit = 0.0
    value, least = nearest(misfit)
    if least > freedom:
        low, high = 0.0, 1.0  # a misfit of the size of the limits themselves explains anything
        for _ in range(_HALVINGS):
            misfit = 0.5 * (low + high)
            value, least = nearest(misfit)
            low, high = (misfit, high) if least > freedom else (low, misfit)
    sigma = np.hypot(limits.error, misfit * limits.stiffness)
    ends = deviation(np.clip(value + STEP * np.array([-1.0, 1.0]), 0.0, delays[-1]))
    slope = (ends[1] - ends[0]) / (min(value + STEP, delays[-1]) - max(value - STEP, 0.0))
    variance = 1 / float(((slope / sigma) ** 2).sum())
    if misfit > 0:
        near = (deviation(np.array([value]))[0] / sigma)[~limits.censored]
        alike = float((near[1:] * near[:-1]).sum() / (near * near).sum())
        alike = float(np.clip(alike, 0.0, 1 - 2 / len(near)))  # two independent limits at least
        variance *= (1 + alike) / (1 - alike)
    return _Fit(value, float(student_95(freedom)) * float(np.sqrt(variance)), misfit)
