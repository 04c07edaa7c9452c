"""Drift of an estimate over the tested stiffness or damping.

A parameter of the device must not depend on what the wall is set to: where its estimates do, the model is wrong.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from pipeline.base.wording import true_minus
from pipeline.device.parameters import Motion, unit_of
from pipeline.measured.student import NORMAL_QUARTILE, ROUNDING, SMALLEST, student_95
from pipeline.records.findings import DRIFTS, Trend
from pipeline.records.trials import Floats

MOST_RELATIVE = 10.0
"""Change, relative to the value, up to which it is reported in percent."""

FEWEST_FOR_TREND = 8
"""Trials from which on a trend is looked for: three coefficients and five more to estimate their error."""

HUBER = 1.345
"""Residual, in standard deviations, from which on a trial pulls a trend no more strongly: 95 % efficient (Huber)."""

_ROUNDS = 50
"""Most repetitions of fitting and limiting the pull of residuals; five to fifteen settle it."""

_SETTLED = 1e-6
"""Change of the pull of a trial below which the fit is settled: far below any standard error."""

_LEAST_FREE = 1e-6
"""Smallest part of a residual that its trial leaves free: a trial that alone makes the line divides by no zero."""

Axis = Literal["stiffness", "damping"]


def find_trends(
    v: Floats, sigma: Floats, conditions: dict[Axis, Floats], unit: str, *, motion: Motion = "translation"
) -> tuple[Trend, ...]:
    """Return the slopes of the values of trials over stiffness and damping, fitted together.

    Parameters
    ----------
    v, sigma : float64, shape (n,)
        Value of each trial and the standard deviation of its scatter, in ``unit``.
    conditions : dict of float64, shape (n,)
        K [N/m, Nm/rad] as ``stiffness``, B [Ns/m, Nms/rad] as ``damping``, or one of them.
    unit : str
    motion : Motion
        Decides the units.

    Returns
    -------
    tuple of Trend
        One for each condition that was varied; none with fewer than `FEWEST_FOR_TREND` trials, or where stiffness
        and damping were varied together, so that their effects cannot be separated.

    Notes
    -----
    Weighted least squares in which a residual beyond `HUBER` standard deviations pulls no more strongly. The interval
    is that of the residuals and not of ``sigma``, so that it is valid where the errors of the trials are wrong; a trend
    that is not there is found significant in 5 % of cases, for each of both slopes.

    Source: Huber 1981, Robust Statistics; MacKinnon and White 1985 (HC3).
    """
    varied: list[Axis] = [name for name, x in conditions.items() if len(x) >= FEWEST_FOR_TREND and np.ptp(x) > 0]
    if not varied:
        return ()
    x = np.stack([np.ones_like(v), *((conditions[n] - conditions[n].mean()) / np.ptp(conditions[n]) for n in varied)])
    sigma = np.maximum(sigma, ROUNDING * np.abs(v).max() + SMALLEST)
    pull = np.ones_like(v)
    for _ in range(_ROUNDS):
        w = pull / sigma**2
        w = w / w.max()
        normal = (x * w) @ x.T
        if np.linalg.matrix_rank(normal, hermitian=True) < len(x):
            return ()
        slopes = np.linalg.solve(normal, (x * w) @ v)
        residual = (v - slopes @ x) / sigma
        scale = float(np.median(np.abs(residual))) / NORMAL_QUARTILE or 1.0
        size = np.abs(residual) / scale
        now = np.where(size <= HUBER, 1.0, HUBER / np.maximum(size, HUBER))
        if np.abs(now - pull).max() < _SETTLED:
            break
        pull = now
    # HC3: residuals, each enlarged for how far it drew the line to itself; a trial whose pull is limited does not
    # answer to a change of the slope
    answers = np.where(pull == 1, w, 0.0)
    normal = (x * answers) @ x.T
    if np.linalg.matrix_rank(normal, hermitian=True) < len(x):
        return ()
    inverse = np.linalg.inv(normal)
    draw = np.einsum("in,ij,jn->n", x, inverse, x) * answers
    score = x * (w * (v - slopes @ x) / np.maximum(1 - draw, _LEAST_FREE))
    covariance = inverse @ (score @ score.T) @ inverse
    reach = np.hypot(float(student_95(len(v) - len(x))) * np.sqrt(np.diag(covariance)), ROUNDING * np.abs(v).max())
    found = []
    for name, slope, r in zip(varied, slopes[1:], reach[1:], strict=True):
        scale = float(np.ptp(conditions[name]))
        low, high = (slope - r) / scale, (slope + r) / scale
        found.append(
            Trend(
                over=name,
                slope=float(slope) / scale,
                low=float(low),
                high=float(high),
                unit=f"{unit}/({unit_of(name, motion)})",
                significant=bool(low > 0 or high < 0),
                span=scale,
            )
        )
    return tuple(found)


def drift_warning(
    trend: Trend, x: Floats, value: float, least: float, unit: str, *, motion: Motion = "translation"
) -> str:
    """Return a sentence about a drift that is significant and larger than ``least``; empty otherwise.

    Parameters
    ----------
    trend : Trend
    x : float64, shape (n,)
        Stiffness or damping of the trials that the trend is over.
    value, least : float
        Value of the experiment, and smallest change over the tested range worth a warning, in ``unit``.
    unit : str
    motion : Motion
    """
    span = float(np.ptp(x))
    change = trend.slope * span
    if not trend.significant or abs(change) <= least:
        return ""
    # for a value near 0 a share is meaningless
    relative = f" ({100 * change / value:+.1f} %)" if abs(change) <= MOST_RELATIVE * abs(value) else ""
    name = unit_of(trend.over, motion)
    return true_minus(
        f"{DRIFTS} {change:+.3g} {unit}{relative} over the tested {trend.over} {x.min():g} to {x.max():g} {name}, "
        f"95 % interval {trend.low * span:+.3g} to {trend.high * span:+.3g} {unit}: the model does not explain all "
        "trials"
    )
