"""Estimate the parameters of an experiment, from the maximum-likelihood device and with the methods of the thesis."""

from __future__ import annotations

from math import floor

import numpy as np

from pipeline.base.wording import of_most
from pipeline.device.parameters import PARAMETERS
from pipeline.measured import thesis
from pipeline.measured.experiment.identified_loop import METHOD, NOT_NEEDED, identified_loop
from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.experiment.trend import drift_warning, find_trends
from pipeline.measured.signal.response import NO_ROW
from pipeline.measured.student import NORMAL_95, NORMAL_QUARTILE
from pipeline.records.findings import MATTERS, Estimate, ModelCheck

LARGEST_OFFSET = 0.05
"""Threshold for the distance [samples] from a whole number. Above it, a delay is not rounded, even if its interval is
wide. Such a distance changes the limit by 2 %."""

LEAST_OFFSET = 0.01
"""Distance [samples] from a whole number up to which a delay is always rounded, because the bias of a fit may be as
large."""

MOMENTUM_WINDOWS = {"": "", "_longer": " over twice the window", "_later": " over the second half of twice the window"}
"""Windows of the momentum balance with their descriptions. Keys are column suffixes. The results of later windows are
irregular (6.1.2)."""

BY_TRIAL = {"mass": "model_mass", "damping": "model_damping", "delay_samples": "model_delay"}
"""Parameters that are identified for each trial, and the names of their columns."""


def whole_delay(estimate: Estimate, at: float | None = None) -> float:
    """Return the value of a delay, rounded to a whole number of samples if its interval contains that number.

    If ``at`` is given, this number inside the interval is rounded instead of the value.

    >>> whole_delay(Estimate(value=3.97, low=3.93, high=4.01, unit="samples", method="model"))
    4.0
    >>> whole_delay(Estimate(value=2.37, low=2.36, high=2.38, unit="samples", method="model"))
    2.37
    """
    middle = estimate.value or 0.0
    value = middle if at is None else at
    reach = max(middle - (estimate.low or middle), (estimate.high or middle) - middle)
    near = abs(value - round(value)) <= min(max(reach, LEAST_OFFSET), LARGEST_OFFSET)
    return float(round(value)) if near else value


def by_model(of: Experiment, name: str) -> Estimate:
    """Return a parameter of the identified loop, with the scatter of single trials and the drift over the wall.

    ``name`` is a key of `PARAMETERS`.
    """
    unit, device = PARAMETERS[name].unit(of.motion), of.once(identified_loop)
    if device is None:
        return Estimate(value=None, unit=unit, method=METHOD, reason=of.texts("device", "reason")[0])
    estimate = device.estimate(name, unit)
    if estimate.value is None or name not in BY_TRIAL:
        return estimate
    values, errors = (of.column("model", f"{BY_TRIAL[name]}{end}") for end in ("", "_error"))
    known = np.isfinite(values) & np.isfinite(errors)
    v, e = values[known], errors[known]
    if len(v) < 2:
        return estimate
    K, B = (of.column("model", axis)[known] for axis in ("stiffness", "damping"))
    within = float(np.median(e))
    excess = (np.median(np.abs(v - estimate.value)) / NORMAL_QUARTILE) ** 2 - within**2
    spread = float(np.sqrt(max(excess, 0.0)))
    trend = find_trends(v, np.hypot(e, spread), {"stiffness": K, "damping": B}, unit, motion=of.motion, shared=e)
    reach = 0.5 * ((estimate.high or 0.0) - (estimate.low or 0.0))
    # A relative threshold fails near a value of 0. There, a drift within the error of one trial is small.
    least = max(MATTERS * abs(estimate.value), within if abs(estimate.value) <= reach else 0.0)
    axes = {"stiffness": K, "damping": B}
    drifts = [drift_warning(t, axes[t.over], estimate.value, least, unit, motion=of.motion) for t in trend]
    sign = None
    if name == "damping" and estimate.low is not None and estimate.high is not None:
        sign = thesis.sign_warning(estimate.low, estimate.high, unit)
    warning = "; ".join(filter(None, [*drifts, estimate.warning, sign])) or None
    return Estimate(
        value=estimate.value,
        low=estimate.low,
        high=estimate.high,
        unit=unit,
        method=estimate.method,
        trials=estimate.trials,
        spread=spread,
        within=within,
        trend=trend,
        warning=warning,
    )


def first_change(of: Experiment) -> Estimate:
    """Return the integer delay factor from the first position change (6.2, 6.3)."""
    rows = np.nan_to_num(of.column("delay", "first_change_samples"), nan=NO_ROW).astype(np.int64)
    return thesis.estimate_delay(rows, of_most(of.texts("delay", "reason")))


def delay_factor(of: Experiment) -> tuple[int, int, int] | None:
    """Return the smallest, most likely and largest integer delay factor for the start of costs, or None without a
    delay.

    The delay of the model is rounded down. A delay just below a whole number, within the accuracy of a fit, is rounded
    to that number. If the delay jitters, its mean is rounded, and the first position changes give the range. Without a
    model, the first position changes are used.
    """
    plain, model = of.once(first_change), by_model(of, "delay_samples")
    device = of.once(identified_loop)
    if model.value is None or device is None:
        if plain.value is None:
            return None
        return int(plain.low or 0), int(plain.value), max(int(plain.high or 0) - 1, int(plain.value))
    if device.jitter[0] > NORMAL_95 * device.jitter[1]:
        value = round(model.value)
        return min(int(plain.low or value), value), value, max(int(plain.high or value) - 1, value)
    value = max(floor(model.value + LARGEST_OFFSET), 0)
    low, high = (max(floor(whole_delay(model, end)), 0) for end in (model.low, model.high))
    return min(low, value), value, max(high, value)


def delay_estimate(of: Experiment) -> Estimate:
    """Return the integer delay factor of an experiment. ``by_method`` contains the delay of the model, not rounded.

    Cost indices are counted from the command edge plus this factor (6.1.4), so it must be an integer.
    """
    plain, model, factor = of.once(first_change), by_model(of, "delay_samples"), of.once(delay_factor)
    methods = {"model": model, "first_change": plain}
    if factor is None or model.value is None:
        # with a coarse sensor or friction, the first change is late, so it is only an upper bound
        low = None if plain.value is None else 0.0
        return Estimate(
            value=plain.value,
            low=low,
            high=plain.high,
            unit=plain.unit,
            method=plain.method,
            reason=plain.reason,
            trials=plain.trials,
            by_method=methods,
        )
    first, value, last = (float(whole) for whole in factor)
    # eq. 6.3 does not determine the delay within the sampling period
    return Estimate(
        value=value,
        low=first,
        high=last + 1,
        unit=model.unit,
        method=f"{METHOD}, in whole samples",
        trials=model.trials,
        spread=model.spread,
        within=model.within,
        trend=model.trend,
        warning=model.warning,
        by_method=methods,
    )


def mass_estimate(of: Experiment) -> Estimate:
    """Return the mass of an experiment. ``by_method`` contains the mass from the momentum balance of the thesis
    (6.4)."""
    model, unit = by_model(of, "mass"), PARAMETERS["mass"].unit(of.motion)
    reason = f"no trial allows a momentum balance{of_most(of.texts('mass', 'reason'))}"
    methods = {"model": model}
    for name, over in MOMENTUM_WINDOWS.items():
        method = f"momentum balance (6.4){over}, median of trials"
        values = of.column("mass", f"mass_momentum{name}")
        methods[f"thesis_momentum_balance{name}"] = thesis.estimate_median(values, unit, method, reason)
    return model.recommended_of(methods)


def damping_estimate(of: Experiment) -> Estimate:
    """Return the damping of an experiment. ``by_method`` contains the damping from the limit at K = 0 (3.25, 6.1.2)."""
    K, B, growth = (of.column("response", name) for name in ("stiffness", "damping", "growth_per_s"))
    limit = thesis.by_limit(B, K, growth, PARAMETERS["damping"].unit(of.motion))
    model = by_model(of, "damping")
    return model.recommended_of({"model": model, "stability_limit": limit})


def jitter_estimate(of: Experiment) -> Estimate:
    """Return the standard deviation of the delay within a trial [samples]."""
    device = of.once(identified_loop)
    if device is None:
        return Estimate(value=None, unit="samples", method=METHOD, reason=of.texts("device", "reason")[0])
    value, error = device.jitter
    if value == 0:
        trials = len(device.trials)
        return Estimate(value=None, low=0.0, unit="samples", method=METHOD, reason=NOT_NEEDED, trials=trials)
    reach = NORMAL_95 * error
    return Estimate(
        value=value,
        low=max(value - reach, 0.0),
        high=value + reach,
        unit="samples",
        method=METHOD,
        trials=len(device.trials),
    )


def model_check(of: Experiment) -> ModelCheck:
    """Return the goodness of fit of the maximum-likelihood device to the logs of an experiment."""
    device = of.once(identified_loop)
    trials = len(of.texts("model", "trial_id"))
    return ModelCheck(
        trials=trials, explained=device.explained if device else 0, fit_percent=device.fit_percent if device else None
    )


def standard_error(estimate: Estimate) -> float:
    """Return the standard error that corresponds to a 95 % interval, or 0 if there is none."""
    if estimate.low is None or estimate.high is None:
        return 0.0
    return (estimate.high - estimate.low) / (2 * NORMAL_95)
