"""Delay, mass and damping of an experiment: each by every method, and the one that is recommended.

The model fitted to the whole response is recommended where it explains most trials: it uses all samples, and it says
when it is wrong. It has no friction, spring or constant force: where the logs ask for one, or cannot exclude friction,
the joint balance of all trials speaks. Else the methods of the thesis stand, with a warning that says why.
"""

from __future__ import annotations

from math import floor
from typing import Any, Literal

import numpy as np

from pipeline.base.wording import of_most, percent
from pipeline.measured.device import arm_stiffness, damping
from pipeline.measured.device.forces import OPTIONAL, Forces, identify
from pipeline.measured.experiment import aggregate
from pipeline.measured.experiment.combine import with_sign_warning
from pipeline.measured.experiment.fitted_device import explaining_device
from pipeline.measured.experiment.known_delay import LARGEST_OFFSET, delay_estimate, whole_delay
from pipeline.measured.experiment.stored import Stored, combined
from pipeline.measured.explained import EXPLAINED
from pipeline.measured.intervals import NORMAL_95
from pipeline.records.findings import Estimate, ModelCheck

MODEL_SHARE = 0.5
"""Share of the trials that the model has to explain to be recommended: what is wrong for most is no model."""

CONSTANT_SHARE = 0.5
"""Constant force, relative to the friction, that the interval of a friction allows for which is not told from it."""

REVERSAL = "record a reversal, or a step in the other direction, to tell them apart"

Term = Literal["mass", "damping", "friction", "stiffness", "constant_force"]
"""Terms of the joint balance that are estimates of an experiment."""

_UNITS: dict[Term, tuple[str, str]] = {
    "mass": ("kg", "kg m^2"),
    "damping": ("Ns/m", "Nms/rad"),
    "friction": ("N", "Nm"),
    "stiffness": ("N/m", "Nm/rad"),
    "constant_force": ("N", "Nm"),
}
"""Unit of each, of a translation and a rotation."""

FRICTION_GAIN = 8.0
"""Median fall of the deviance by friction beside a jitter from which on the jitter is not believed: of the trials of a
loop with jitter alone one in four passes it, of those with friction enough to feign a jitter nearly all."""

NOT_EXPLAINED = "the model explains no trial; the reasons stand with the trials"


def with_model_delay(of: Stored, delay: Estimate) -> Estimate:
    """Return the delay factor with the delay by the model among its methods, and by the model where costs take that."""
    found: dict[str, Any] = {"by_method": {**delay.by_method, "model": model_delay(of)}}
    explaining, factor = of.once(explaining_delay), of.once(explaining_factor)
    if explaining is not None and factor is not None and delay.value is not None:
        first, value, last = (float(whole) for whole in factor)
        # (6.3) leaves the position inside the period open
        found |= {"value": value, "low": first, "high": last + 1, "method": f"{explaining.method}, in whole samples"}
    return delay.model_copy(update=found)


def model_delay(of: Stored) -> Estimate:
    """Return the mean delay of the command in force by the model, not rounded [samples]."""
    return _by_model(of, "delay", "samples")


def explaining_delay(of: Stored) -> Estimate | None:
    """Return the delay by what explains nearly all logs without jitter, else None.

    That is the device fitted to all trials, or the model of each. By it costs are counted, too: the first motion that a
    coarse sensor shows comes too late, and scatters, and behind a drive that lags it comes later still.
    """
    device = of.once(explaining_device)
    if device is not None:
        return device.estimate("delay_samples", "samples")
    check, jitter = model_check(of), jitter_estimate(of)
    if not check.trials or check.explained < EXPLAINED * check.trials or (jitter.low or 0.0) > 0:
        return None
    return model_delay(of)


def explaining_factor(of: Stored) -> tuple[int, int, int] | None:
    """Return the least, the likely and the largest integer factor that `explaining_delay` leaves, None without it.

    A delay that ends just before a whole sample is that one, as far as a fit can be off: nothing moves in between.
    """
    model = of.once(explaining_delay)
    if model is None or model.value is None:
        return None
    value = max(floor(model.value + LARGEST_OFFSET), 0)
    low, high = (max(floor(whole_delay(model, end)), 0) for end in (model.low, model.high))
    return min(low, value), value, max(high, value)


def jitter_estimate(of: Stored) -> Estimate:
    """Return the standard deviation of the delay within a trial by the model [samples].

    It needs a model that explains nearly all trials, and errors that friction does not explain as well: any force that
    the model lacks looks like a jitter.
    """
    found = _by_model(of, "jitter", "samples")
    fall = friction_gain(of)
    explained = found.trials + len(found.outliers)
    if found.value is None or (_explains(found, EXPLAINED) and fall <= FRICTION_GAIN):
        return found
    reason = f"the model explains {explained} of {explained + found.refused} trials only"
    if fall > FRICTION_GAIN:
        reason = (
            "the errors of the force follow the direction of the motion, as friction does, and not only the changes of "
            f"the command (deviance of the median trial lower by {fall:.3g}, allowed {FRICTION_GAIN:g})"
        )
    return Estimate(value=None, unit=found.unit, method=found.method, reason=reason, refused=found.refused)


def explains_itself(of: Stored) -> bool:
    """Return whether the model of each trial explains nearly all, without friction that it takes for a jitter."""
    check = model_check(of)
    explained = check.trials > 0 and check.explained >= EXPLAINED * check.trials
    return explained and friction_gain(of) <= FRICTION_GAIN


def friction_gain(of: Stored) -> float:
    """Return the median fall of the deviance by friction beside the jitter of the model."""
    gain = of.column("model", "friction_gain")
    return float(np.nanmedian(gain)) if np.isfinite(gain).any() else 0.0


def damping_estimate(of: Stored) -> Estimate:
    """Return the viscous damping of an experiment; the decay of free trials takes the delay and the model's mass."""
    mass, delay = model_mass(of), of.once(delay_estimate)
    unit = "Nms/rad" if of.rotation else "Ns/m"
    K, B, growth = (of.column("response", name) for name in ("stiffness", "damping", "growth_per_s"))
    limit = damping.by_limit(B, K, growth, unit)
    thesis = aggregate.estimate_damping(limit, of.column("damping", "viscous_damping"), unit)
    model = with_sign_warning(_by_model(of, "damping", unit))
    joint = by_joint_balance(of, "damping")
    methods = {**thesis.by_method, "model": model, "joint_balance": joint}
    if mass.value is not None and delay.value is not None:
        methods["decay"] = _decay(of, mass.value, delay.value, unit)
    return _recommended(of, model, thesis, methods)


def mass_estimate(of: Stored) -> Estimate:
    """Return the mass of an experiment."""
    unit = "kg m^2" if of.rotation else "kg"
    corrected, plain = of.column("mass", "mass"), of.column("mass", "mass_momentum")
    thesis = aggregate.estimate_mass(corrected, plain, unit)
    if thesis.value is None:
        why = f"{thesis.reason}{of_most(of.texts('mass', 'reason'))}"
        thesis = thesis.model_copy(update={"reason": why})
    friction = combined(
        *(of, ("mass", "balance_mass", "balance_mass_error"), unit), "momentum balance with friction (and gravity)"
    )
    model = model_mass(of)
    methods = {
        **thesis.by_method,
        "corrected_momentum_balance": thesis.model_copy(update={"by_method": {}}),
        "friction_momentum_balance": friction,
        "model": model,
        "joint_balance": by_joint_balance(of, "mass"),
    }
    if np.isfinite(of.column("mass", "force_mass")).any():
        methods["measured_force"] = combined(
            *(of, ("mass", "force_mass", "force_mass_error"), unit),
            "momentum balance by the measured force, with viscous damping and Coulomb friction",
        )
    # where the model does not hold, friction is the commonest cause
    return _recommended(of, model, thesis if friction.value is None else friction, methods)


def joint_forces(of: Stored) -> Forces | None:
    """Return what the joint balance of all trials tells, None where no trial says anything."""
    return identify(of.lists("damping", "balance_sums"), of.sampling_period_s)


def by_joint_balance(of: Stored, term: Term) -> Estimate:
    """Return a term of the joint balance: its value, an upper bound of it, or why there is neither."""
    found, unit = of.once(joint_forces), _UNITS[term][of.rotation]
    method = "joint balance of all trials"
    if found is None:
        reason = f"no trial allows a balance over its motion{of_most(of.texts('damping', 'reason'))}"
        return Estimate(value=None, unit=unit, method=method, reason=reason)
    value, trials = found.value.get(term), found.trials
    if value is None:
        bound = found.bound.get(term)
        return Estimate(
            value=None,
            low=None if bound is None else 0.0,
            high=bound,
            unit=unit,
            method=method if bound is None else f"upper bound, as if there were no friction, by the {method}",
            reason=_not_told(of, found, term),
            trials=trials,
        )
    half, warning = found.half_width[term], None
    low, high = value - half, value + half
    if term in OPTIONAL and term not in found.asked_for:
        low, high = min(low, 0.0), max(high, 0.0)  # the logs follow as well without it
    if found.one_way and term == "friction":
        # a constant force of o adds to the friction of c or takes from it
        low, high = low / (1 + CONSTANT_SHARE), high / (1 - CONSTANT_SHARE)
        warning = (
            f"all motion is one way, where a constant force counts as friction: the interval allows for one of "
            f"{percent(CONSTANT_SHARE)} of the friction; {REVERSAL}"
        )
    return Estimate(value=value, low=low, high=high, unit=unit, method=method, trials=trials, warning=warning)


def stiffness_estimate(of: Stored) -> Estimate:
    """Return the stiffness of the device, an arm that holds it included; by the limit, too, where K < 0 was tested."""
    joint = by_joint_balance(of, "stiffness")
    K, B, growth = (of.column("response", name) for name in ("stiffness", "damping", "growth_per_s"))
    if not (K < 0).any():
        return joint
    limit = arm_stiffness.by_limit(K, B, growth, joint.unit)
    best = joint if joint.value is not None or limit.value is None else limit
    return best.model_copy(update={"by_method": {"stability_limit": limit, "joint_balance": joint}})


def _not_told(of: Stored, found: Forces, term: Term) -> str:
    if found.value:
        if term == "constant_force" and found.one_way:
            return f"all motion is one way, where a constant force and friction are one number; {REVERSAL}"
        return f"the motion does not tell the {term.replace('_', ' ')} from the other forces"
    text = (
        "the motion does not tell Coulomb friction from inertia and damping: under one constant force, less force "
        "and less mass move alike"
    )
    bound = found.bound.get(term)
    if bound is not None:
        text += f"; it is at most {bound:.3g} {_UNITS[term][of.rotation]} unless a constant force helps the motion"
    # steps of several sizes that are there did not tell it either
    sizes = "" if len(set(np.abs(of.step_sizes).round(12).tolist())) > 1 else "steps of two sizes, or "
    return f"{text}; record {sizes}trials that oscillate against a wall"


def model_mass(of: Stored) -> Estimate:
    """Return the mass of an experiment by the model."""
    return _by_model(of, "mass", "kg m^2" if of.rotation else "kg")


def model_check(of: Stored) -> ModelCheck:
    """Return how well the model explains the logs of an experiment."""

    def median(name: str) -> float | None:
        values = of.column("model", name)
        return float(np.nanmedian(values)) if np.isfinite(values).any() else None

    return ModelCheck(
        trials=len(of.column("model", "model_mass")),
        explained=int(np.isfinite(of.column("model", "model_mass_error")).sum()),
        left=int(np.isfinite(of.column("model", "leaves_row")).sum()),
        misfit=median("misfit"),
        whiteness=median("whiteness"),
        ghost=median("ghost_relative"),
    )


def standard_error(estimate: Estimate) -> float:
    """Return the standard error that an interval of 95 % stands for; 0 where there is none."""
    if estimate.low is None or estimate.high is None:
        return 0.0
    return (estimate.high - estimate.low) / (2 * NORMAL_95)


def _by_model(of: Stored, name: str, unit: str) -> Estimate:
    estimate = combined(
        *(of, ("model", f"model_{name}", f"model_{name}_error"), unit), "model fitted to the whole response"
    )
    if estimate.value is not None:
        return estimate
    return estimate.model_copy(update={"reason": f"{NOT_EXPLAINED}{of_most(of.texts('model', 'reason'))}"})


def _decay(of: Stored, mass: float, delay: float, unit: str) -> Estimate:
    K, B, growth = (of.column("response", name) for name in ("stiffness", "damping", "growth_per_s"))
    found = damping.by_decay(B, K, growth, mass, delay_samples=delay, sampling_period_s=of.sampling_period_s)
    return Estimate(
        value=found.value,
        low=found.low,
        high=found.high,
        unit=unit,
        method="decay of the velocity in the trials with K = 0",
        reason=found.reason,
        trials=found.trials,
    )


def _recommended(of: Stored, model: Estimate, thesis: Estimate, methods: dict[str, Estimate]) -> Estimate:
    found, joint = of.once(joint_forces), methods["joint_balance"]
    # a balance of single trials with friction in it stands where all together tell neither value nor bound
    alone = methods.get("friction_momentum_balance")
    if found is not None and not found.value and not found.bound and alone is not None and alone.value is not None:
        return alone.model_copy(update={"by_method": methods})
    if found is not None and (found.asked_for or not found.value):
        return joint.model_copy(update={"by_method": methods})
    if model.value is not None and _explains(model):
        return model.model_copy(update={"by_method": methods})
    explained = model.trials + len(model.outliers)
    other, why = (thesis if joint.value is None else joint), None
    if other.value is not None:
        why = f"the model explains {explained} of {explained + model.refused} trials only; its value is not taken"
    warning = "; ".join(filter(None, [other.warning, why])) or None
    return other.model_copy(update={"by_method": methods, "warning": warning})


def _explains(model: Estimate, share: float = MODEL_SHARE) -> bool:
    """Whether the model explains so many trials that it can be right."""
    explained = model.trials + len(model.outliers)
    return explained >= share * (explained + model.refused)
