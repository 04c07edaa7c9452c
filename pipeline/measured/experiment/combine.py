"""One value of an experiment from the values and standard errors of its trials.

Trials scatter by their own errors and by what differs between them (friction, pose, operator). Both are told apart,
trials that lie far outside both are named and left out, and a drift over the tested stiffness or damping is looked
for: a parameter of the device must not depend on what the wall is set to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.wording import true_minus
from pipeline.measured.experiment.trend import DRIFT, Axis, drift_warning, find_trends
from pipeline.measured.intervals import NORMAL_QUARTILE, ROUNDING, SMALLEST, student_95
from pipeline.records.batch import Booleans, Floats
from pipeline.records.findings import Estimate

OUTLIER = 3.5
"""Deviation in standard deviations from which on one of many trials is an outlier: 1 of 2,000 good ones is."""

TRUNCATED_VARIANCE = 0.9945
"""Variance of a standard normal variable between -`OUTLIER` and `OUTLIER`: what is left after outliers are."""

CROWDED = 0.1
"""Share of outliers from which on they are no accidents, and the value itself is in doubt."""

FEW_TRIALS = 1.0
"""How much wider the limit of outliers is with few trials: by this divided by their number, for the spread that is
known badly then; by simulation 1.3 % of the good trials are named with 5 trials, 0.2 % with 10."""

_ROUNDS = 20
"""Most repetitions of naming outliers and estimating the spread; two to four settle it."""

_HALVINGS = 60
"""Bisections of the spread: a double's mantissa and some."""


def combine(
    values: Floats,
    errors: Floats,
    trial_ids: Sequence[str],
    unit: str,
    method: str,
    reason: str,
    *,
    stiffness: Floats | None = None,
    damping: Floats | None = None,
    rotation: bool = False,
    outlier: float = OUTLIER,
    drift: float = DRIFT,
    shared: float = 0.0,
) -> Estimate:
    """Return the value of an experiment: the median of its trials, weighted by what each one knows.

    Parameters
    ----------
    values, errors : float64, shape (n,)
        Value and standard error of each trial in ``unit``; NaN where a trial has none.
    trial_ids : sequence of str, length n
    unit, method : str
    reason : str
        What to say where no trial has a value with an error.
    stiffness, damping : float64, shape (n,), optional
        K [N/m, Nm/rad] and B [Ns/m, Nms/rad] of the trials; with them ``trend`` is filled.
    rotation : bool
        Whether units of the trend are those of a rotation.
    outlier : float
        Deviation, in standard deviations of a trial, from which on it is named and left out (more with few trials).
    drift : float
        Change over the tested range, relative to the value, below which a significant trend gives no warning.
    shared : float
        Part of the error of one trial that all trials share, as `stored.SHARED` of fits.

    Returns
    -------
    Estimate
        With ``spread``, ``within``, ``outliers``, ``refused``, ``trend`` and ``warning``.

    Raises
    ------
    ParameterError
        If the arrays differ in length, or an error is negative.

    Notes
    -----
    Weights are 1/(error^2 + spread^2). The spread is the one for which the deviations of the trials from the median,
    divided by their standard deviations, have a mean square of one (Paule and Mandel), taken over the trials that are
    no outliers; it is 0 where the errors explain all scatter. Outliers are first sought with the spread for which the
    median of those deviations is that of a normal distribution, which stands up to nearly half of wrong trials. The
    interval is that of the weighted median of normal values, with Student's factor for few trials, and half of a
    significant drift and the shared part of the error of one trial beside it.

    A median is less precise than a mean by a quarter where nothing is wrong; that is the price for not being moved
    by the trials that are wrong without being far off.

    Source: Paule and Mandel 1982, J. Res. NBS 87(5).
    """
    v, e = np.asarray(values, dtype=np.float64), np.asarray(errors, dtype=np.float64)
    lengths = [len(v), len(e), len(trial_ids), *(len(c) for c in (stiffness, damping) if c is not None)]
    if len(set(lengths)) > 1:
        raise ParameterError(f"values, errors, ids and conditions of {lengths} trials: expected one of each per trial.")
    if (e < 0).any():
        raise ParameterError(f"standard error {np.nanmin(e)}: expected none that is negative.")
    known = np.isfinite(v) & np.isfinite(e)
    refused = int(len(v) - known.sum())
    if not known.any():
        return Estimate(value=None, unit=unit, method=method, reason=reason, refused=refused)
    index = np.flatnonzero(known)
    found = _location(v[index], e[index], outlier)
    used = index[found.inside]
    outliers = tuple(trial_ids[i] for i in index[~found.inside])
    reach = float(student_95(found.freedom)) * found.error
    warnings = []
    if len(used) == 1:
        warnings.append("one trial only: the scatter between trials is not known")
    if len(outliers) > CROWDED * len(index):
        warnings.append(f"{len(outliers)} of {len(index)} trials are outliers: the value is in doubt")
    named: dict[Axis, Floats | None] = {"stiffness": stiffness, "damping": damping}
    conditions = {name: x[index] for name, x in named.items() if x is not None}
    trend = find_trends(v[index], np.hypot(e[index], found.spread), conditions, unit, rotation=rotation)
    # trials that drift with the wall are those of no one device: the value is known to half of what they drift
    drifts = [0.5 * t.slope * (t.span or 0.0) for t in trend if t.significant]
    within = float(np.median(e[used]))
    reach = float(np.sqrt(reach**2 + np.max(np.square(drifts), initial=0.0) + (shared * within) ** 2))
    # 2 % of nothing is nothing: beside a value that may be 0, a drift within the error of one trial is small
    least = max(drift * abs(found.value), within if abs(found.value) <= reach else 0.0)
    warnings += [drift_warning(t, conditions[t.over], found.value, least, unit, rotation=rotation) for t in trend]
    return Estimate(
        value=found.value,
        low=found.value - reach,
        high=found.value + reach,
        unit=unit,
        method=method,
        trials=len(used),
        spread=found.spread if len(used) > 1 else None,
        within=within,
        outliers=outliers,
        refused=refused,
        trend=trend,
        warning="; ".join(filter(None, warnings)) or None,
    )


def with_sign_warning(estimate: Estimate) -> Estimate:
    """Return the estimate of a quantity that cannot be negative with a warning where it is, or where it may be 0."""
    value, low, high = estimate.value, estimate.low, estimate.high
    if value is None or low is None or high is None or low > 0:
        return estimate
    interval = true_minus(f"95 % interval {low:.3g} to {high:.3g} {estimate.unit}")
    text = f"significantly negative ({interval})" if high < 0 else f"not significantly different from 0 ({interval})"
    return estimate.model_copy(update={"warning": "; ".join(filter(None, [estimate.warning, text]))})


@dataclass(frozen=True, eq=False)
class _Location:
    """Weighted median, its standard error, the spread between trials, and which trials are no outliers."""

    value: float
    error: float
    spread: float
    freedom: float
    inside: Booleans


def _location(v: Floats, e: Floats, outlier: float) -> _Location:
    n = len(v)
    order = np.argsort(v, kind="stable")
    v = v[order]
    # trials without an error of their own still carry rounding; and no weight is infinite
    e = np.maximum(e[order], ROUNDING * np.abs(v).max() + SMALLEST)
    limit = outlier * (1 + FEW_TRIALS / n)
    # first no trial counts more than a typical one: a wrong one that claims to be precise must not be the median
    plain = _weights(np.maximum(e, np.median(e)), 0.0)
    spread = _spread(v, e, lambda _: plain, _median_excess)
    middle, error = _median(v, plain), _median_error(plain, np.hypot(e, spread))
    inside = np.ones(n, dtype=np.bool_)
    for _ in range(_ROUNDS):
        # a trial far more precise than the median is no outlier for lying apart from it
        before, inside = inside, np.abs(v - middle) <= limit * np.hypot(np.hypot(e, spread), error)
        if not inside.any():
            inside = before
            break
        kept = e[inside]
        spread = _spread(v[inside], kept, partial(_weights, kept), _square_excess)
        weights = _weights(kept, spread)
        middle, error = _median(v[inside], weights), _median_error(weights, np.hypot(kept, spread))
        if (inside == before).all():
            break
    # the errors of the trials are known, only the spread comes from few of them (Satterthwaite); a variance from n
    # trials is known to a relative error of sqrt(2/(n - 1)), so that much of it may be spread even where none is seen
    others = int(inside.sum()) - 1
    share = spread**2 / (spread**2 + float(np.median(e[inside])) ** 2) + np.sqrt(2 / max(others, 1))
    freedom = others / min(share, 1.0) ** 2 if others else np.inf
    unsorted = np.empty(n, dtype=np.bool_)
    unsorted[order] = inside
    return _Location(middle, error, spread, freedom, unsorted)


def _weights(e: Floats, spread: float) -> Floats:
    """Information of each trial, relative to the most precise one."""
    variance = e * e + spread * spread
    weights: Floats = variance.min() / variance
    return weights


def _median(v: Floats, w: Floats) -> float:
    """Weighted median of sorted values, interpolated, so that it is the plain one where weights are equal."""
    middle = np.cumsum(w) - 0.5 * w
    return float(np.interp(0.5 * w.sum(), middle, v))


def _median_error(w: Floats, sigma: Floats) -> float:
    """Standard error of a weighted median of normal values: root of sum w^2 over twice sum w times density at 0."""
    return float(0.5 * np.sqrt((w * w).sum()) / (w / (np.sqrt(2 * np.pi) * sigma)).sum())


def _median_excess(z: Floats) -> float:
    return float(np.median(np.abs(z))) / NORMAL_QUARTILE - 1


def _square_excess(z: Floats) -> float:
    return float((z * z).sum()) / (TRUNCATED_VARIANCE * max(len(z) - 1, 1)) - 1


def _spread(v: Floats, e: Floats, weights: Callable[[float], Floats], excess: Callable[[Floats], float]) -> float:
    """Spread between trials at which their deviations from the median are as large as expected; 0 if they are less."""

    def at(spread: float) -> float:
        return excess((v - _median(v, weights(spread))) / np.hypot(e, spread))

    low, high = 0.0, 2 * float(np.ptp(v))
    if high == 0 or at(low) <= 0:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if at(middle) > 0 else (low, middle)
    return high
