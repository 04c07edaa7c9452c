"""Delay, mass and damping of an experiment: each by every method, and the one that is recommended.

The model fitted to the whole response is recommended where it explains most trials: it uses all samples, and it says
when it is wrong. Else the methods of the thesis stand, with a warning that says why.
"""

from __future__ import annotations

import numpy as np

from pipeline.base.wording import commonest
from pipeline.measured.device import damping
from pipeline.measured.experiment import aggregate
from pipeline.measured.experiment.combine import with_sign_warning
from pipeline.measured.experiment.known_delay import delay_estimate
from pipeline.measured.experiment.stored import Stored, combined
from pipeline.measured.intervals import NORMAL_95
from pipeline.records.findings import Estimate, ModelCheck

MODEL_SHARE = 0.5
"""Share of the trials that the model has to explain to be recommended: what is wrong for most is no model."""

EXPLAINED = 0.9
"""Share of the logs that a model explains which is right: chance leaves 5 % of them unexplained."""

NOT_EXPLAINED = "the model explains no trial; the reasons stand with the trials"


def with_model_delay(of: Stored, delay: Estimate) -> Estimate:
    """Return the delay factor with the delay by the model among its methods."""
    return delay.model_copy(update={"by_method": {**delay.by_method, "model": model_delay(of)}})


def model_delay(of: Stored) -> Estimate:
    """Return the mean delay of the command in force by the model, not rounded [samples]."""
    return _by_model(of, "delay", "samples")


def explaining_delay(of: Stored) -> Estimate | None:
    """Return the delay by the model where that explains nearly all logs and the delay does not jitter, else None.

    By it costs are counted, too: the first motion that a coarse sensor shows comes too late, and scatters.
    """
    check, jitter = model_check(of), jitter_estimate(of)
    if not check.trials or check.explained < EXPLAINED * check.trials or (jitter.low or 0.0) > 0:
        return None
    return model_delay(of)


def jitter_estimate(of: Stored) -> Estimate:
    """Return the standard deviation of the delay within a trial by the model [samples]."""
    return _by_model(of, "jitter", "samples")


def damping_estimate(of: Stored) -> Estimate:
    """Return the viscous damping of an experiment; the decay of free trials takes the delay and the model's mass."""
    mass, delay = model_mass(of), of.once(delay_estimate)
    unit = "Nms/rad" if of.rotation else "Ns/m"
    K, B, growth = (of.column("response", name) for name in ("stiffness", "damping", "growth_per_s"))
    thesis = aggregate.estimate_damping(damping.by_limit(B, K, growth), of.column("damping", "viscous_damping"), unit)
    model = with_sign_warning(_by_model(of, "damping", unit))
    methods = {**thesis.by_method, "model": model}
    if mass.value is not None and delay.value is not None:
        methods["decay"] = _decay(of, mass.value, delay.value, unit)
    return _recommended(model, thesis, methods)


def mass_estimate(of: Stored) -> Estimate:
    """Return the mass of an experiment."""
    unit = "kg m^2" if of.rotation else "kg"
    corrected, plain = of.column("mass", "mass"), of.column("mass", "mass_momentum")
    thesis = aggregate.estimate_mass(corrected, plain, unit)
    if thesis.value is None:
        why = f"{thesis.reason}; most trials: {commonest(of.texts('mass', 'reason'))}"
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
    }
    if np.isfinite(of.column("mass", "force_mass")).any():
        methods["measured_force"] = combined(
            *(of, ("mass", "force_mass", "force_mass_error"), unit),
            "momentum balance by the measured force, with viscous damping and Coulomb friction",
        )
    # where the model does not hold, friction is the commonest cause
    return _recommended(model, thesis if friction.value is None else friction, methods)


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
    return estimate.model_copy(
        update={"reason": f"{NOT_EXPLAINED}; most trials: {commonest(of.texts('model', 'reason'))}"}
    )


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


def _recommended(model: Estimate, thesis: Estimate, methods: dict[str, Estimate]) -> Estimate:
    explained = model.trials + len(model.outliers)
    if model.value is not None and explained >= MODEL_SHARE * (explained + model.refused):
        return model.model_copy(update={"by_method": methods})
    why = None
    if thesis.value is not None:
        why = f"the model explains {explained} of {explained + model.refused} trials only; its value is not taken"
    warning = "; ".join(filter(None, [thesis.warning, why])) or None
    return thesis.model_copy(update={"by_method": methods, "warning": warning})
