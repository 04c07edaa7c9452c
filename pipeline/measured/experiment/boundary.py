"""Estimate the limit of stability at each damping with its 95 % interval, and the area below the limits.

The growth rate of a trial passes smoothly through zero at the limit. A fit of the growth rates locates the limit
between the last stable and the first unstable trial. The verdicts bound the limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.base.errors import ParameterError
from pipeline.base.wording import counted
from pipeline.measured.student import NORMAL_95, NORMAL_QUARTILE, SIGMAS, SMALLEST, student_95
from pipeline.recording.samples import NOISE_GAIN
from pipeline.records.findings import BoundaryPoint, Estimate
from pipeline.records.trials import Booleans, Floats, Integers

NEAREST = 10
"""Largest number of trials near the limit that are fitted: two coarse steps and the fine steps of the sweep (6.1.1),
and a few more."""

FEWEST_FOR_CURVATURE = 6
"""Smallest number of trials for a parabola: three for its coefficients and three for the error."""

SEEN = 8.0
"""Growth rate at which a mode is certainly detected, relative to the slowest detected growth. A mode that begins a
thousand times smaller must grow by a further factor of exp(7)."""

TYPICAL_BEND = 1 / float(NORMAL_QUARTILE * np.sqrt(NOISE_GAIN))
"""Standard deviation of growth rates, relative to the median absolute second difference."""

FARTHEST = 0.25
"""Largest distance of a fitted trial from the limit, relative to the limit. Beyond it, another mode may dominate."""

NEIGHBOURS = 2
"""Number of dampings on either side whose scatter of the growth rates is used."""

SHARED = 0.7
"""Share of the error of a single growth rate that is common to all rates at one damping. With it, the intervals cover
97.7 % of 1,344 simulated limits (93 to 100 %, depending on device, sensor and steps). Without it, they cover 80 %."""

ROUNDS = 3
"""Number of fits of the growth rate. The first fit is centred in the bracket of the verdicts, which can miss the limit
by more than its width. Each further fit is centred at the zero of the previous fit."""

LINE_REACH = 3.0
"""Largest distance of the zero of a line from the middle of the bracket, relative to the distance of the farthest
trial."""

BEND = 1.0
"""Half of the largest second derivative of the growth rate over K, relative to its slope over K (up to 0.6 in
simulations). The error of a line through few rates is this factor times the smallest and the largest distance of the
trials from the zero, divided by the zero."""

WITNESSES = 2
"""Number of trials with the same verdict, at a stiffness or beyond, that makes the verdict reliable. With jitter, one
decided verdict in 100 differs in a repeated run. The same number of stable trials overrules an undecided trial at a
lower stiffness."""


@dataclass(frozen=True, eq=False)
class _Columns:
    """Trials arranged by damping, shape (dampings, trials), padded with NaN and False."""

    stiffness: Floats
    growth: Floats
    stable: Booleans
    unstable: Booleans


@dataclass(frozen=True, eq=False)
class _Crossing:
    """Zero of the growth rate over K at each damping, shape (dampings,), or NaN if unknown.

    ``scatter`` is the standard deviation of a single rate at the zero [1/s], and ``slope`` is the slope of the rate
    over K. ``bend`` is the error of a line due to the curvature of the rate [N/m, Nm/rad].
    """

    zero: Floats
    error: Floats
    scatter: Floats
    slope: Floats
    freedom: Floats
    bend: Floats


def boundary_band(
    stiffness: Floats, damping: Floats, verdict: Sequence[str] | ArrayLike, growth_per_s: Floats
) -> tuple[BoundaryPoint, ...]:
    """Return the measured boundary: the limit at each damping with its 95 % interval.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad] of the trials.
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``.
    growth_per_s : float64, shape (n,)
        Growth rate of each trial from `verdict.judge` [1/s], or NaN if unknown.

    Returns
    -------
    tuple of BoundaryPoint
        Points of `measured_boundary` with ``estimate``, ``low``, ``high`` and ``trials`` (number of trials with K > 0).
        A point that is censored or has no conclusive unstable trial has only ``low``, which is the stiffest certainly
        stable trial or 0. A point without a certainly stable trial has ``low`` = 0, ``high``, and no ``estimate``.

    Raises
    ------
    ParameterError
        If the arrays differ in length.

    Notes
    -----
    The growth rate of up to `NEAREST` trials is fitted over K by a parabola, or by a line for fewer than
    `FEWEST_FOR_CURVATURE` trials. The zero of the fit is the estimate. Three errors are added in quadrature: the error
    of the fit, with Student's factor; the share `SHARED` of the error of a single rate; and the error of a line due to
    curvature. The second error accounts for sensor errors that shift all rates at one damping together.

    The interval is restricted to the range allowed by the verdicts. This range extends from the stiffest stable trial
    below all unstable trials to the softest unstable trial above all stable trials. Repeated trials that disagree widen
    this range. Undecided trials also widen it, unless `WITNESSES` stiffer trials overrule them. A verdict is not
    counted if the sign of the growth contradicts it, or if the growth is within `SIGMAS` standard errors of zero and
    fewer than `WITNESSES` trials share the verdict. If the scatter of the rates is unknown, as for two rates, the
    interval is the allowed range. The estimate is then the interpolation of two rates or the middle of the bracket, and
    a zero outside the range widens it. The limit can therefore lie outside ``stable`` and ``unstable``, which depend
    only on the verdicts.

    The limit is valid for walls with K >= 0. If the delay jitters, it is the limit of the loop with jitter, which
    differs from the limit for the mean delay.

    Source: Hulin 2017, secs. 6.1.1 and 6.1.3; the interval is an addition of this package.
    """
    if len(growth_per_s) != len(stiffness):
        raise ParameterError(
            f"boundary of {len(stiffness)} trials with {len(growth_per_s)} growth rates: expected one rate per trial."
        )
    verdicts = np.asarray(verdict, dtype=np.str_)
    points = measured_boundary(stiffness, damping, verdicts)
    if not points:
        return points
    columns = _side_by_side(stiffness, damping, verdicts, growth_per_s)
    nothing = np.full(len(points), np.nan)
    low, high = _allowed(columns, nothing)
    centre = np.where(np.isfinite(high), 0.5 * (low + high), np.nan)
    for _ in range(ROUNDS):
        found = _zero_crossing(columns, centre)
        centre = np.where(np.isnan(found.zero), centre, found.zero)
    scatter = _pooled(found.scatter)
    low, high = _allowed(columns, np.where(np.isnan(found.zero), nothing, scatter))
    single = NORMAL_95 * scatter / found.slope
    # Two rates leave no degree of freedom for an error (NaN). Then, only the verdicts are used.
    reach = np.hypot(np.hypot(student_95(found.freedom) * found.error, SHARED * single), found.bend)
    decided = np.isfinite(reach) & (found.zero + reach >= low) & (found.zero - reach <= high)
    # a mode that grows below the zero is not the mode that crosses zero
    decided &= ~(_may_grow(columns, scatter) & (columns.stiffness < (found.zero - reach)[:, None])).any(axis=1)
    between = np.isfinite(columns.growth) & (columns.stiffness >= low[:, None]) & (columns.stiffness <= high[:, None])
    interpolated = np.isnan(reach) & (found.zero >= low) & (found.zero <= high)
    # An interpolation of more than two rates is ambiguous. A range that begins at 0 has no meaningful middle.
    interpolated &= (between.sum(axis=1) <= 2) | (low == 0)
    # rates contradict the verdicts if a mode that grows is below the sensor floor and another mode decays
    apart = ~decided & ~interpolated
    low, high = (np.where(apart, end(limit, centre), limit) for end, limit in ((np.fmin, low), (np.fmax, high)))
    value = np.where(decided | interpolated, np.clip(found.zero, low, high), _middle(columns, low, high))
    low, high = (
        np.where(decided, np.fmax(found.zero - reach, low), low),
        np.where(decided, np.fmin(found.zero + reach, high), high),
    )
    limited = np.isfinite(high)
    # without a certainly stable trial, the middle between 0 and the first unstable trial is not an estimate
    located = limited & (decided | interpolated | (low > 0))
    counts = np.isfinite(columns.stiffness).sum(axis=1)
    return tuple(
        p.model_copy(
            update={
                "estimate": float(v) if found else None,
                "low": float(a),
                "high": float(h) if known else None,
                "trials": int(n),
            }
        )
        for p, v, a, h, n, known, found in zip(points, value, low, high, counts, limited, located, strict=True)
    )


def _middle(c: _Columns, low: Floats, high: Floats) -> Floats:
    """Return the middle of the bracket of all verdicts, or the middle of the allowed range if verdicts contradict each
    other."""
    stiffest = np.where(c.stable, c.stiffness, 0.0).max(axis=1)
    softest = np.where(c.unstable, c.stiffness, np.inf).min(axis=1)
    agree = (stiffest > 0) & (stiffest < softest) & np.isfinite(softest)
    result: Floats = np.clip(0.5 * np.where(agree, stiffest + softest, low + high), low, high)
    return result


def _side_by_side(stiffness: Floats, damping: Floats, verdict: NDArray[np.str_], growth: Floats) -> _Columns:
    """Arrange the trials with K > 0 by damping, padded with NaN."""
    tried = stiffness > 0
    levels, row = np.unique(damping[tried], return_inverse=True)
    order = np.argsort(row, kind="stable")
    row = row[order]
    place = np.arange(len(row)) - np.searchsorted(row, row)
    shape = (len(levels), int(place.max()) + 1)

    def spread(values: np.ndarray, missing: object) -> np.ndarray:
        wide = np.full(shape, missing)
        wide[row, place] = values[tried][order]
        return wide

    return _Columns(
        spread(stiffness, np.nan),
        spread(growth, np.nan),
        spread(verdict == "stable", False),
        spread(verdict == "unstable", False),
    )


def _allowed(c: _Columns, scatter: Floats) -> tuple[Floats, Floats]:
    """Return the range of the limit that conclusive verdicts allow. Open ends are 0 and infinity.

    If the scatter of the growth rates is unknown (NaN), a verdict counts unless the sign of the growth contradicts it.
    If the scatter is known, or if an undecided trial tends to grow, a verdict without a growth rate does not count. Its
    motion may have been too small to detect growth.
    """
    doubt = np.nan_to_num(SIGMAS * scatter)[:, None]
    grows = _may_grow(c, scatter)
    plain = np.isnan(c.growth) & (np.isnan(scatter) & ~grows.any(axis=1))[:, None]
    stable = c.stable & (plain | (c.growth < -doubt) | _witnessed(c.stiffness, c.stable & (c.growth < 0)))
    unstable = c.unstable & (plain | (c.growth > doubt) | _witnessed(-c.stiffness, c.unstable & (c.growth > 0)))
    softest = np.where(unstable | grows, c.stiffness, np.inf).min(axis=1)
    stiffest = np.where(stable, c.stiffness, 0.0).max(axis=1)
    low = np.where(stable & (c.stiffness < softest[:, None]), c.stiffness, 0.0).max(axis=1)
    high = np.where(unstable & (c.stiffness > stiffest[:, None]), c.stiffness, np.inf).min(axis=1)
    return low, high


def _may_grow(c: _Columns, scatter: Floats) -> Booleans:
    """Return whether the motion of each trial may grow.

    The motion may grow in undecided trials that are not overruled, and in stable trials beyond a peak of the rate.

    With increasing K, the slowest mode of a rigid loop first decays faster and then more slowly. If the growth rate
    falls again, the mode with the rising rate may continue to rise below the noise of another mode.
    """
    order = np.argsort(np.where(np.isfinite(c.growth), c.stiffness, np.inf), axis=1, kind="stable")
    K, g = (np.take_along_axis(values, order, axis=1) for values in (c.stiffness, c.growth))
    change, here, clear = np.diff(g, axis=1), g[:, 2:-1], SIGMAS * scatter[:, None]
    # With jitter, rates scatter more for fast loops than at the limit. The curvature of the rates shows this.
    bends = np.abs(np.diff(g, n=2, axis=1))
    sure = np.maximum(clear, SIGMAS * TYPICAL_BEND * np.nan_to_num(_medians(bends))[:, None])
    peak = np.zeros(g.shape, dtype=np.bool_)
    # At a peak, the negative rate has risen twice. Its magnitude then at least doubles, and it falls below the rate
    # before the peak. A single outlier is not a peak, because the rate after it is above the rate before it.
    # Comparisons with NaN are false.
    peak[:, 2:-1] = (here < 0) & (change[:, :-2] > 0) & (change[:, 1:-1] > sure)
    peak[:, 2:-1] &= (-change[:, 2:] > np.maximum(sure, np.abs(here))) & (g[:, 3:] < g[:, 1:-2])
    peak[:, 2:-1] &= _went_unseen(c, K, g)
    first = np.where(peak, K, np.inf).min(axis=1, initial=np.inf)
    behind = c.stable & (c.stiffness > first[:, None])
    undecided = ~c.stable & ~c.unstable & (np.nan_to_num(c.growth) > np.nan_to_num(clear))
    undecided &= c.stiffness > _outvoted(c, c.stable & ~behind & (c.growth < -np.nan_to_num(clear)))[:, None]
    result: Booleans = undecided | behind
    return result


def _went_unseen(c: _Columns, K: Floats, growth: Floats) -> Booleans:
    """Return whether the rising mode may continue undetected after each rate, from the third to the second to last.

    Extrapolated from its last two rises to the stiffest stable trial, the mode must grow at most `SEEN` times as fast
    as the slowest growth that was detected. A faster mode would have been detected; the peak is then an outlier.
    """
    slope = (growth[:, 2:-1] - growth[:, :-3]) / np.maximum(K[:, 2:-1] - K[:, :-3], SMALLEST)
    stiffest = np.where(c.stable, c.stiffness, 0.0).max(axis=1)[:, None]
    seen = np.where(c.unstable & (c.growth > 0), c.growth, np.inf).min(axis=1)[:, None]
    result: Booleans = growth[:, 2:-1] + slope * (stiffest - K[:, 2:-1]) <= SEEN * seen
    return result


def _outvoted(c: _Columns, sure: Booleans) -> Floats:
    """Return the stiffness at each damping above which fewer than `WITNESSES` trials are certainly stable."""
    found: Floats = np.sort(np.where(sure, c.stiffness, 0.0), axis=1)[:, -WITNESSES:]
    return found[:, 0] if found.shape[1] == WITNESSES else np.zeros(len(found))


def _witnessed(stiffness: Floats, agrees: Booleans) -> Booleans:
    """Return whether at least `WITNESSES` trials with the same verdict are at least as stiff as each trial, including
    itself."""
    far = np.sort(np.where(agrees, stiffness, -np.inf), axis=1)[:, -WITNESSES:]
    found: Booleans = agrees & (stiffness <= far[:, :1]) & (far.shape[1] == WITNESSES)
    return found


def _pooled(scatter: Floats) -> Floats:
    """Return the scatter of single rates, with the median of neighbouring dampings as a lower bound.

    The scatter of a few trials is uncertain. The median of all dampings is not suitable: with jitter, rates of fast
    loops scatter a hundred times more.
    """
    if not np.isfinite(scatter).any():
        return scatter
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(scatter, NEIGHBOURS, constant_values=np.nan), 2 * NEIGHBOURS + 1
    )
    pooled: Floats = np.fmax(scatter, _medians(around))
    return pooled


def _medians(rows: Floats) -> Floats:
    """Return the median of the finite values in each row, or NaN if there are none."""
    if rows.shape[1] == 0:
        return np.full(len(rows), np.nan)
    known = np.isfinite(rows).sum(axis=1)
    ordered = np.sort(rows, axis=1)  # NaN last
    at = np.stack([np.maximum(known - 1, 0) // 2, np.minimum(known // 2, rows.shape[1] - 1)], axis=1)
    return np.asarray(np.take_along_axis(ordered, at, axis=1).mean(axis=1))


def _zero_crossing(c: _Columns, centre: Floats) -> _Crossing:
    """Fit the growth rate over K of the trials closest to ``centre`` [N/m, Nm/rad], and find its zero."""
    middle = centre[:, None]
    distance = np.abs(c.stiffness - middle)
    known = np.isfinite(c.growth) & (distance <= FARTHEST * middle)
    distance = np.where(known, distance, np.inf)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :NEAREST]
    distance = np.take_along_axis(distance, nearest, axis=1)
    use = np.isfinite(distance)
    count = use.sum(axis=1)
    width = np.where(use, distance, 0.0).max(axis=1)
    width = np.where(width > 0, width, 1.0)
    u = np.where(use, (np.take_along_axis(c.stiffness, nearest, axis=1) - middle) / width[:, None], 0.0)
    g = np.where(use, np.take_along_axis(c.growth, nearest, axis=1), 0.0)
    weight = _steadiness(g, use)
    curved = np.where(count >= FEWEST_FOR_CURVATURE, 1.0, 0.0)
    design = np.stack([np.ones_like(u), u, u * u * curved[:, None]], axis=2)
    normal = np.einsum("lmi,lm,lmj->lij", design, weight, design)
    normal[:, 2, 2] += 1 - curved
    normal[count < 2] = np.eye(3)
    usable = (count >= 2) & (np.linalg.matrix_rank(normal, hermitian=True) == 3)
    normal[~usable] = np.eye(3)
    inverse = np.linalg.inv(normal)
    a = np.einsum("lij,lmj,lm,lm->li", inverse, design, weight, g)
    freedom = count - 2.0 - curved
    squares = (weight * (g - np.einsum("lmi,li->lm", design, a)) ** 2).sum(axis=1)
    scatter = np.sqrt(squares / np.where(freedom > 0, freedom, np.nan))
    root, step = np.zeros(len(g)), np.zeros(len(g))
    farthest = np.where(curved, 1.0, LINE_REACH)
    for _ in range(20):  # Newton's method: three or four steps suffice for an almost straight parabola
        slope = a[:, 1] + 2 * a[:, 2] * root
        step = (a[:, 0] + a[:, 1] * root + a[:, 2] * root**2) / np.where(slope > 0, slope, np.inf)
        root = np.clip(root - step, -farthest, farthest)
    slope = a[:, 1] + 2 * a[:, 2] * root
    crosses = usable & (slope > 0) & (np.abs(step) < 1e-9)  # relative to the width, far below any interval
    at = np.stack([np.ones_like(root), root, root**2 * curved], axis=1)
    slope = np.where(crosses, slope, np.nan) / width
    error = scatter * np.sqrt(np.einsum("li,lij,lj->l", at, inverse, at)) / slope
    zero = np.where(crosses, centre + root * width, np.nan)
    apart = np.abs(u - root[:, None])  # relative to the width
    bend = np.where(use, apart, 1 + LINE_REACH).min(axis=1) * np.where(use, apart, 0.0).max(axis=1)
    bend = np.where(curved == 0, BEND * bend * width**2, 0.0) / np.where(crosses, zero, np.inf)
    return _Crossing(zero, error, np.where(crosses, scatter, np.nan), slope, freedom, bend)


def _steadiness(growth: Floats, use: Booleans) -> Floats:
    """Return the weight of each growth rate. It is 1 near zero, and smaller for fast motion, which is visible in fewer
    samples."""
    size = np.sort(np.where(use, np.abs(growth), np.inf), axis=1)
    typical = np.take_along_axis(size, np.maximum(use.sum(axis=1, keepdims=True) - 1, 0) // 2, axis=1)
    typical = np.where(np.isfinite(typical) & (typical > 0), typical, 1.0)
    weight: Floats = np.where(use, 1 / (1 + (growth / typical) ** 2), 0.0)
    return weight


def measured_boundary(
    stiffness: Floats, damping: Floats, verdict: Sequence[str] | ArrayLike
) -> tuple[BoundaryPoint, ...]:
    """Return the boundary points of an experiment, ordered by damping.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad] of the trials.
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``. An undecided trial is not evidence. It is counted if it is below a
        stable trial.

    Returns
    -------
    tuple of BoundaryPoint
        One point for each damping with trials at K > 0. A point is censored if none of its trials is unstable.

    Raises
    ------
    ParameterError
        If the arrays differ in length.

    Notes
    -----
    A pair (K, B) that was tested several times is unstable if it was unstable once. Trials at K <= 0 are not boundary
    points, since a trial at K = 0 shows the damping of the device. The computation needs neither the delay nor the
    mass.

    Source: Hulin 2017, secs. 6.1.1 (procedure) and 6.1.3.
    """
    verdicts = np.asarray(verdict, dtype=np.str_)
    if not len(stiffness) == len(damping) == len(verdicts):
        raise ParameterError(
            f"boundary of {len(stiffness)} stiffness values, {len(damping)} damping values and "
            f"{len(verdicts)} verdicts: expected one of each for every trial."
        )
    tried = stiffness > 0
    levels, column = np.unique(damping[tried], return_inverse=True)
    k, tested = stiffness[tried], verdicts[tried]
    unstable = np.full(len(levels), np.inf)
    np.minimum.at(unstable, column[tested == "unstable"], k[tested == "unstable"])
    below = (tested == "stable") & (k < unstable[column])
    stable = np.full(len(levels), -np.inf)
    np.maximum.at(stable, column[below], k[below])
    undecided = np.bincount(column[(tested == "undecided") & (k < stable[column])], minlength=len(levels))
    return tuple(
        BoundaryPoint(
            damping=float(b),
            stable=float(low) if np.isfinite(low) else None,
            unstable=float(high) if np.isfinite(high) else None,
            censored=not np.isfinite(high),
            undecided=int(count),
        )
        for b, low, high, count in zip(levels, stable, unstable, undecided, strict=True)
    )


def spread_over_plane(stiffness: Floats, damping: Floats, usable: Booleans, most: int) -> Integers:
    """Return the indices of at most ``most`` usable trials, spread evenly in the order of damping and stiffness."""
    index = np.flatnonzero(usable)
    order = index[np.lexsort((stiffness[index], damping[index]))]
    if len(order) <= most:
        return order
    return np.asarray(order[np.round(np.linspace(0, len(order) - 1, most)).astype(np.int64)])


LARGEST_UNLOCATED = 0.1
"""Largest share of the area at dampings without an estimate of the limit. If the share is larger, no area is reported.
It is computed with the upper ends of these limits."""

FAR = 2.0
"""Upper bound of a limit, relative to the stiffness of the softest trial that seems to grow."""


def boundary_area(points: Sequence[BoundaryPoint], unit: str = "N^2 s/m^2") -> Estimate:
    """Return the area under the measured boundary K(B) with its 95 % interval.

    Parameters
    ----------
    points : sequence of BoundaryPoint
        As returned by `boundary_band`.
    unit : str
        Unit of stiffness times damping.

    Returns
    -------
    Estimate
        The standard error is (high - low)/(2 `NORMAL_95`). If points without an upper end matter, there is only a lower
        bound in ``low``. If points without an estimate make up more than `LARGEST_UNLOCATED` of the area, there is only
        an upper bound in ``high``. ``trials`` is the number of dampings.

    Notes
    -----
    Trapezoids are used between the tested dampings, from the first to the last. An interval of width w is treated as a
    uniform distribution with the standard error w/sqrt(12), which is larger than the standard error of a normal
    distribution. Errors at different dampings are assumed to be independent. The error does not include the shape of
    the boundary between the dampings.
    """
    method = "trapezoids between the limits at the tested dampings"
    used = [p for p in points if p.low is not None]
    if len(used) < 2:
        reason = f"limits are known at {counted(len(used), 'damping')}; an area requires two"
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
            "trial, so the value is only a lower bound",
            trials=len(used),
        )
    limit = np.array([p.estimate for p in used], dtype=np.float64)
    lost = np.isnan(limit)
    unlocated = int(lost.sum())
    # a limit anywhere between two ends is set to their middle, as long as that hardly affects the result
    limit = np.where(lost, 0.5 * (low + high), limit)
    if float(share[lost] @ high[lost]) > LARGEST_UNLOCATED * float(share @ limit):
        return Estimate(
            value=None,
            high=float(share @ high),
            unit=unit,
            method=method,
            reason=f"at {unlocated} of {len(used)} dampings no trial is certainly stable, so the value is only an "
            "upper bound",
            trials=len(used),
        )
    area = float(share @ limit)
    error = float(np.sqrt((share**2) @ ((high - low) ** 2 / 12)))
    reach = NORMAL_95 * error
    return Estimate(value=area, low=area - reach, high=area + reach, unit=unit, method=method, trials=len(used))


def _far_end(point: BoundaryPoint) -> float:
    """Return the upper bound of a limit: its upper end, or `FAR` times the stiffness of a trial that may grow."""
    if point.high is not None:
        return point.high
    return np.inf if point.censored or point.unstable is None else FAR * point.unstable
