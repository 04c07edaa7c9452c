"""Linear upper bound of a measured boundary that theory does not have: K <= K_0 - c B (6.1.3).

The theoretical boundary may be stretched in both directions, so that a wrong mass or delay is no bound. Only where a
straight line beyond the stiffest limit fits much better than any such curve, and cuts a part of it off, is it reported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.base.wording import counted, percent, true_minus
from pipeline.comparison.scores.implied_slope import Limits
from pipeline.measured.intervals import student_95
from pipeline.records.batch import Floats
from pipeline.records.score_records import BoundScore

STRETCHES = np.geomspace(0.25, 2.5, 231)
"""Stretches of theory along B that are tried, in steps of 1 %: from a region a quarter as high (a third was measured
with the LWR, 6.2.3) to more than twice."""

_CLOSER = np.linspace(0.985, 1.015, 61)
"""Stretches around the best of these: on the steep end of a boundary 1 % of B is many times the error of a limit."""

FEWEST_ON_LINE = 4
"""Limits that a line needs: two for the line, two that can contradict it."""

FEWEST_BELOW = 4
"""Limits that are left to the stretched theory below the line."""

CHANCE = 1e-3
"""Chance of a better fit by a line without any bound, from which on it is no finding. Small, since neighbouring limits
of a boundary that is shaped a little otherwise than theory (jitter) deviate alike."""

SMALLEST_CUT = 0.02
"""Part of the whole stretched theoretical region that has to be missing above the line: courses with jitter and no
bound feign up to 0.4 %, at the steep end of the boundary."""

SHAPE_ERROR = 0.005
"""Error of theory relative to the stiffest limit that is added to those of the limits, in squares: without it the few
limits that are known to 0.01 % would decide alone."""


Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class TheoryCurve:
    """Theoretical limit [N/m, Nm/rad] over damping, shape (n,), dense and from below to above all that is stable."""

    damping: Floats
    limit: Floats


@dataclass(frozen=True)
class _Fits:
    """Weighted squares left by stretched theory alone and beside a line, with stretch, factor and number of that."""

    plain: float
    plain_stretch: float
    least: float
    stretch: float
    factor: float
    at: int


def upper_bound(limits: Limits, theory: TheoryCurve) -> tuple[BoundScore | None, str]:
    """Return the linear bound of the upper part of a measured boundary, or None and why there is none.

    Parameters
    ----------
    limits : Limits
        As `implied_slope.limits_of` returns them; censored limits and those at K = 0 are left out.
    theory : TheoryCurve

    Raises
    ------
    ParameterError
        If the theoretical curve has no stable stiffness.

    Notes
    -----
    Without a bound: K = s_K f(B/s_B) with the theoretical limit f and two free factors. With it: a falling line on
    neighbouring dampings from the stiffest limit on, and that curve below and, where it bends in front of the line,
    above them; two numbers more, by weighted least squares over all factors and all first and last dampings of the
    line. The chance p of such a gain by noise is that of F(2, n - 6), times the number of pairs of dampings tried;
    F is taken with the larger of scatter and error. The bound is reported where p < `CHANCE` and the line cuts
    `SMALLEST_CUT` off the region below that curve. Its interval is that of the line alone.

    Source: Hulin 2017, eq. 6.5 and sec. 6.1.3; test ours.
    """
    if not (theory.limit > 0).any():
        raise ParameterError("theoretical boundary without a stable stiffness: nothing to compare a bound with.")
    use = ~limits.censored & (limits.stiffness > 0)
    B, K = limits.damping[use], limits.stiffness[use]
    fewest = FEWEST_ON_LINE + FEWEST_BELOW
    if len(K) < fewest:
        return None, f"{counted(len(K), 'damping')} with a limit that is no mere bound; it needs {fewest}"
    top = int(np.argmax(K))
    first, end = np.triu_indices(len(K) + 1, FEWEST_ON_LINE)
    tried = first >= max(top, FEWEST_BELOW)
    first, end = first[tried], end[tried]
    if not len(first):
        return None, f"{counted(len(K) - top - 1, 'damping')} beyond the stiffest limit; it needs {FEWEST_ON_LINE - 1}"
    weight = 1 / (limits.error[use] ** 2 + (SHAPE_ERROR * K.max()) ** 2)
    line, slope = _lines(B, K, weight, first, end)
    line = np.where(slope < 0, line, np.inf)
    if not np.isfinite(line).any():
        return None, "beyond the stiffest limit the boundary does not fall"
    rough = _fits(theory, B, K, weight, first, end, line, STRETCHES)
    near = np.concatenate([rough.plain_stretch * _CLOSER, rough.stretch * _CLOSER])
    fits = _fits(theory, B, K, weight, first, end, line, near)
    freedom = len(K) - 6
    gain = max(fits.plain - fits.least, 0.0) / 2 / max(fits.least / freedom, 1.0)
    chance = min(1.0, len(first) * float((1 + 2 * gain / freedom) ** (-freedom / 2)))  # F with 2 degrees above
    on = slice(int(first[fits.at]), int(end[fits.at]))
    expected = fits.factor * np.interp(B / fits.stretch, theory.damping, theory.limit, left=0.0, right=0.0)
    missing = float(np.trapezoid(np.maximum(expected - K, 0.0)[on], B[on]))
    cut = missing / max(float(np.trapezoid(expected, B)), float(np.finfo(float).tiny))
    if chance >= CHANCE or cut < SMALLEST_CUT:
        return None, (
            f"the best line beyond the stiffest limit cuts off {percent(cut, 1)} of the theoretical region (chance "
            f"{true_minus(f'{chance:.2g}')}): a bound is found from {percent(SMALLEST_CUT)} on with a chance below "
            f"{CHANCE:g}"
        )
    return _score(B[on], K[on], weight[on], cut, chance), ""


def _fits(
    theory: TheoryCurve,
    B: Floats,
    K: Floats,
    weight: Floats,
    first: Indices,
    end: Indices,
    line: Floats,
    stretches: Floats,
) -> _Fits:
    """Best stretched theory alone, and the best one beside a line over some of the dampings ``first`` to ``end``."""
    shape = np.interp(B[None, :] / stretches[:, None], theory.damping, theory.limit, left=0.0, right=0.0)
    xx, xy, yy = (_running(weight * v) for v in (shape * shape, shape * K, K * K))
    alone = _left_over(xx[:, -1], xy[:, -1], yy[-1])
    beside = [v[..., -1:] - v[..., end] + v[..., first] for v in (xx, xy, yy)]
    both = _left_over(*beside) + line
    stretch, at = np.unravel_index(int(np.argmin(both)), both.shape)
    known = float(beside[0][stretch, at])
    return _Fits(
        plain=float(alone.min()),
        plain_stretch=float(stretches[np.argmin(alone)]),
        least=float(both[stretch, at]),
        stretch=float(stretches[stretch]),
        factor=float(beside[1][stretch, at]) / known if known > 0 else 0.0,
        at=int(at),
    )


def _score(B: Floats, K: Floats, weight: Floats, cut: float, chance: float) -> BoundScore:
    """Line with intervals by Student's factor, its errors at least those of the limits."""
    design = np.stack([np.ones_like(B), B], axis=1)
    inverse = np.linalg.inv(design.T @ (weight[:, None] * design))
    level, slope = (float(c) for c in inverse @ (design.T @ (weight * K)))
    squares = float(weight @ (K - level - slope * B) ** 2)
    freedom = len(B) - 2
    reach = student_95(freedom) * np.sqrt(np.diag(inverse) * max(squares / freedom, 1.0))
    return BoundScore(
        stiffness=level,
        stiffness_low=level - float(reach[0]),
        stiffness_high=level + float(reach[0]),
        slope=-slope,
        slope_low=-slope - float(reach[1]),
        slope_high=-slope + float(reach[1]),
        damping_low=float(B[0]),
        damping_high=float(B[-1]),
        dampings=len(B),
        cut=cut,
        p_value=chance,
    )


def _running(values: Floats) -> Floats:
    """Sums of the first 0, 1, 2 ... values along the last axis."""
    return np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)


def _left_over(xx: Floats, xy: Floats, yy: Floats) -> Floats:
    """Weighted squares that y = factor x leaves over; all of them where x is zero."""
    known = xx > 0
    left: Floats = np.maximum(yy - np.where(known, xy**2 / np.where(known, xx, 1.0), 0.0), 0.0)
    return left


def _lines(B: Floats, K: Floats, weight: Floats, first: Indices, end: Indices) -> tuple[Floats, Floats]:
    """Weighted squares left of a straight line over the limits ``first`` to ``end`` (not included), and its slope."""
    x, y = B - B.mean(), K - K.mean()  # about the middle: fewer digits cancel
    w, wx, wy, wxx, wxy, wyy = (
        s[end] - s[first] for s in (_running(weight * v) for v in (np.ones_like(x), x, y, x * x, x * y, y * y))
    )
    slope = (wxy - wx * wy / w) / (wxx - wx * wx / w)
    left = wyy - wy * wy / w - slope * (wxy - wx * wy / w)
    return np.maximum(left, 0.0), slope
