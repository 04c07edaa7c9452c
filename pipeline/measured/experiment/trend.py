"""Test whether an estimate drifts over the tested stiffness or damping.

A parameter of the device must not depend on the wall. If its estimates depend on the wall, the model is wrong.
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
"""Largest change, relative to the value, that is reported in percent."""

FEWEST_FOR_TREND = 8
"""Smallest number of trials for a trend: three for the coefficients and five for their errors."""

HUBER = 1.345
"""Threshold for the residual, in standard deviations. Above it, the weight of a trial is reduced (95 % efficiency,
Huber)."""

_ROUNDS = 50
"""Largest number of reweighted fits. Five to fifteen are usual."""

_SETTLED = 1e-6
"""Threshold for the change of the weights. Below it, the fit has converged. The effect of such a change is far below a
standard error."""

_LEAST_FREE = 1e-6
"""Smallest value of 1 - leverage of a trial. It avoids a division by zero if a single trial determines the line."""

Axis = Literal["stiffness", "damping"]


def find_trends(
    v: Floats,
    sigma: Floats,
    conditions: dict[Axis, Floats],
    unit: str,
    *,
    motion: Motion = "translation",
    shared: Floats | None = None,
) -> tuple[Trend, ...]:
    """Return the slopes of the values of trials over stiffness and damping, from a joint fit.

    Parameters
    ----------
    v, sigma : float64, shape (n,)
        Value of each trial and the standard deviation of its scatter, in ``unit``.
    conditions : dict of float64, shape (n,)
        K [N/m, Nm/rad] with the key ``stiffness``, B [Ns/m, Nms/rad] with the key ``damping``, or one of them.
    unit : str
    motion : Motion
        Kind of motion, which determines the units.
    shared : float64, shape (n,), optional
        Errors of the trials that may have the same sign in all of them, such as the rounding of a common rest position.

    Returns
    -------
    tuple of Trend
        One trend for each condition that was varied. Empty for fewer than `FEWEST_FOR_TREND` trials, or if stiffness
        and damping were varied together, so that their effects cannot be separated.

    Notes
    -----
    The fit is weighted least squares in which the influence of a residual is limited to `HUBER` standard deviations.
    The interval is based on the residuals instead of ``sigma``, so that it is valid even if the errors of the trials
    are wrong. It includes the slope of one standard error of all trials at once: if errors grow with the stiffness, a
    shared error imitates a drift. The false-positive rate is 5 % for each of the two slopes.

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
    # HC3: residuals are enlarged by their leverage. Trials with limited influence have none, because their contribution
    # to the score does not depend on the slope.
    answers = np.where(pull == 1, w, 0.0)
    normal = (x * answers) @ x.T
    if np.linalg.matrix_rank(normal, hermitian=True) < len(x):
        return ()
    inverse = np.linalg.inv(normal)
    draw = np.einsum("in,ij,jn->n", x, inverse, x) * answers
    score = x * (w * (v - slopes @ x) / np.maximum(1 - draw, _LEAST_FREE))
    covariance = inverse @ (score @ score.T) @ inverse
    variance = np.diag(covariance)
    if shared is not None:
        variance = variance + (inverse @ (x * answers) @ shared) ** 2
    reach = np.hypot(float(student_95(len(v) - len(x))) * np.sqrt(variance), ROUNDING * np.abs(v).max())
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
    """Return a sentence about a drift that is significant and larger than ``least``, otherwise an empty string.

    Parameters
    ----------
    trend : Trend
    x : float64, shape (n,)
        Stiffness or damping of the trials of the trend.
    value, least : float
        Value of the experiment, and smallest change over the tested range that deserves a warning, in ``unit``.
    unit : str
    motion : Motion
    """
    span = float(np.ptp(x))
    change = trend.slope * span
    if not trend.significant or abs(change) <= least:
        return ""
    # a percentage of a value near 0 is meaningless
    relative = f" ({100 * change / value:+.1f} %)" if abs(change) <= MOST_RELATIVE * abs(value) else ""
    name = unit_of(trend.over, motion)
    return true_minus(
        f"{DRIFTS} {change:+.3g} {unit}{relative} over the tested {trend.over} {x.min():g} to {x.max():g} {name}, "
        f"95 % interval {trend.low * span:+.3g} to {trend.high * span:+.3g} {unit}: the model does not explain all "
        "trials"
    )
