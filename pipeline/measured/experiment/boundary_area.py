"""Area under the measured stability boundary with its 95 % interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.base.wording import counted
from pipeline.measured.student import NORMAL_95
from pipeline.records.findings import BoundaryPoint, Estimate

LARGEST_UNLOCATED = 0.1
"""Part of the area at dampings without a stable trial, or with none that surely grows, up to which the area is told,
with what they leave open."""

FAR = 2.0
"""Stiffness, relative to that of the softest trial that seems to grow, beyond which no limit lies."""


def boundary_area(points: Sequence[BoundaryPoint], unit: str = "N^2 s/m^2") -> Estimate:
    """Return the area under the measured boundary, K over B, with its 95 % interval.

    Parameters
    ----------
    points : sequence of BoundaryPoint
        As `boundary_band` returns them.
    unit : str
        Of stiffness times damping.

    Returns
    -------
    Estimate
        Its standard error is (high - low)/(2 `NORMAL_95`). No value, but a lower bound in ``low``, where a point has
        no upper end, or an upper bound in ``high`` where those without an estimate bear more than
        `LARGEST_UNLOCATED` of it. ``trials`` is the number of dampings.

    Notes
    -----
    Trapezoids between the tested dampings, from the first to the last of them. An interval of width w stands for a
    standard error of w/sqrt(12), that of a uniform distribution, which is more than that of a normal one; errors of
    different dampings are taken as independent. What the boundary does between the dampings is no part of the error.
    """
    method = "trapezoids between the limits at the tested dampings"
    used = [p for p in points if p.low is not None]
    if len(used) < 2:
        reason = f"limits at {counted(len(used), 'damping')}; an area needs two"
        return Estimate(value=None, unit=unit, method=method, reason=reason, trials=len(used))
    B, low = np.array([p.damping for p in used]), np.array([p.low for p in used], dtype=np.float64)
    share = 0.5 * (np.diff(B, prepend=B[0]) + np.diff(B, append=B[-1]))
    open_ended = np.array([p.high is None for p in used])
    high = np.array([_far_end(p) for p in used])
    if open_ended.any() and not share[open_ended] @ high[open_ended] <= LARGEST_UNLOCATED * (share @ low):
        return Estimate(
            value=None,
            low=float(share @ low),
            unit=unit,
            method=method,
            reason=f"at {int(open_ended.sum())} of {len(used)} dampings the tested range ended before an unstable "
            "trial: a lower bound only",
            trials=len(used),
        )
    limit = np.array([p.estimate for p in used], dtype=np.float64)
    lost = np.isnan(limit)
    unlocated = int(lost.sum())
    # a limit that lies anywhere between two ends is told by their middle, as long as that is no part of the result
    limit = np.where(lost, 0.5 * (low + high), limit)
    if float(share[lost] @ high[lost]) > LARGEST_UNLOCATED * float(share @ limit):
        return Estimate(
            value=None,
            high=float(share @ high),
            unit=unit,
            method=method,
            reason=f"at {unlocated} of {len(used)} dampings no trial is surely stable: an upper bound only",
            trials=len(used),
        )
    area = float(share @ limit)
    error = float(np.sqrt((share**2) @ ((high - low) ** 2 / 12)))
    reach = NORMAL_95 * error
    return Estimate(value=area, low=area - reach, high=area + reach, unit=unit, method=method, trials=len(used))


def _far_end(point: BoundaryPoint) -> float:
    """Return the stiffness beyond which a limit does not lie: its end, or `FAR` times that of a trial that may grow."""
    if point.high is not None:
        return point.high
    return np.inf if point.censored or point.unstable is None else FAR * point.unstable
