"""Delay, mass and damping of an experiment: each by every method, and the one that is recommended.

The model fitted to the whole response is recommended where it explains most trials: it uses all samples, and it says
when it is wrong. Else the methods of the thesis stand, with a warning that says why.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from pipeline.base.wording import commonest
from pipeline.measured import aggregate, damping
from pipeline.measured.combine import combine, with_sign_warning
from pipeline.measured.response import NO_ROW
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate, ModelCheck

MODEL_SHARE = 0.5
"""Share of the trials that the model has to explain to be recommended: what is wrong for most is no model."""

NOT_EXPLAINED = "the model explains no trial; the reasons stand with the trials"


class Stored(Protocol):
    """What the estimates of an experiment are made from: stored columns of its stages."""

    @property
    def rotation(self) -> bool:
        """Whether units are rotational."""

    @property
    def sampling_period_s(self) -> float:
        """Sampling period T [s]."""

    def column(self, stage: str, name: str) -> Floats:
        """Numeric column of a stage, null as NaN."""

    def texts(self, stage: str, name: str) -> list[str]:
        """Text column of a stage, null as an empty string."""


def delay_estimate(of: Stored) -> Estimate:
    """Return the integer delay factor of an experiment; ``by_method`` holds what is not rounded.

    Cost indices are counted from the command edge plus this factor (6.1.4), so that it is an integer; its interval is
    the range that holds 95 % of the trials. It needs no fitted model, and a scene without one has this estimate; see
    `with_model_delay`.
    """
    found = np.nan_to_num(of.column("delay", "delay_samples"), nan=NO_ROW).astype(np.int64)
    plain = np.nan_to_num(of.column("delay", "first_change_samples"), nan=NO_ROW).astype(np.int64)
    best = aggregate.estimate_delay(found, sampling_period_s=of.sampling_period_s)
    if best.value is None:
        best = best.model_copy(
            update={"reason": f"{best.reason}; most trials: {commonest(of.texts('delay', 'reason'))}"}
        )
    thesis = aggregate.estimate_delay(plain).model_copy(update={"method": "first position change (6.2, 6.3)"})
    onset = _combined(
        of, ("delay", "onset_samples", "onset_error"), "samples", "onset of motion, by the motion that the quantum hid"
    )
    return best.model_copy(
        update={
            "method": "onset of motion where it is sure enough, else first position change; rounded",
            "by_method": best.by_method | {"first_change": thesis, "onset": onset},
        }
    )


def with_model_delay(of: Stored, delay: Estimate) -> Estimate:
    """Return the delay factor with the delay by the model among its methods."""
    return delay.model_copy(update={"by_method": {**delay.by_method, "model": model_delay(of)}})


def model_delay(of: Stored) -> Estimate:
    """Return the mean delay of the command in force by the model, not rounded [samples]."""
    return _by_model(of, "delay", "samples")


def jitter_estimate(of: Stored) -> Estimate:
    """Return the standard deviation of the delay within a trial by the model [samples]."""
    return _by_model(of, "jitter", "samples")


def damping_estimate(of: Stored, mass: Estimate, delay: Estimate) -> Estimate:
    """Return the viscous damping of an experiment.

    Parameters
    ----------
    of : Stored
    mass, delay : Estimate
        By the model and of the experiment; the decay of free trials needs them.
    """
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
    friction = _combined(
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
        methods["measured_force"] = _combined(
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


def _by_model(of: Stored, name: str, unit: str) -> Estimate:
    estimate = _combined(
        *(of, ("model", f"model_{name}", f"model_{name}_error"), unit), "model fitted to the whole response"
    )
    if estimate.value is not None:
        return estimate
    return estimate.model_copy(
        update={"reason": f"{NOT_EXPLAINED}; most trials: {commonest(of.texts('model', 'reason'))}"}
    )


def _combined(of: Stored, columns: tuple[str, str, str], unit: str, method: str) -> Estimate:
    stage, value, error = columns
    return combine(
        *(of.column(stage, value), of.column(stage, error), of.texts(stage, "trial_id"), unit, method),
        f"no trial has a value with an interval; most trials: {commonest(of.texts(stage, 'reason'))}",
        stiffness=of.column(stage, "stiffness"),
        damping=of.column(stage, "damping"),
        rotation=of.rotation,
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
