"""The parts of the device that explains the logs as causes: what each does to the limit, and what shows it."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.loops.fitted_loop import LOAD, loop_point, loop_range
from pipeline.comparison.loops.log_evidence import friction_words
from pipeline.comparison.loops.loop_range import MATTERS, LoopPoint, LoopRange
from pipeline.measured.experiment.fitted_device import FittedDevice
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import VelocityFilter
from pipeline.records.loop_records import Cause, Parameter
from pipeline.rendering.labels import Units, significant, span


def part_causes(
    stages: ExperimentStages, fitted: FittedDevice, velocity: VelocityFilter | None, units: Units
) -> list[Cause]:
    """Return the parts of a fitted device as causes, those that move a result most first.

    Parameters
    ----------
    stages : ExperimentStages
    fitted : FittedDevice
        That explains enough of the logs.
    velocity : VelocityFilter or None
        Of the wall law.
    units : Units

    Notes
    -----
    A part that moves neither the limit nor the rest positions by more than `MATTERS` is not told.
    """
    loop = loop_range(fitted, stages.sampling_period_s, velocity)
    found = []
    for part in fitted.parts:
        effect, shown = _effect(part, stages, fitted, loop, units)
        if effect > MATTERS:
            found.append((effect, _cause(part, stages, fitted, units, shown)))
    return [cause for _, cause in sorted(found, key=lambda pair: -pair[0])]


def _effect(
    part: str, stages: ExperimentStages, fitted: FittedDevice, loop: LoopRange, units: Units
) -> tuple[float, str]:
    """Return how far a part moves a result, relative to it, and what it does in words."""
    if part == "saturation":
        return fitted.saturated, f"{significant(100 * fitted.saturated, 2)} % of the stable trials command more"
    other = _without(part, stages, fitted, loop)
    damping, limit, without = loop.beside(other)
    effect = abs(limit - without) / max(limit, without, 1e-300)
    shown = (
        f"limit at B = {significant(damping, 3)} {units.damping}: K = {significant(limit, 3)} {units.stiffness} with "
        f"it, {significant(without, 3)} without"
    )
    if part == "friction":
        # the other way round: what the loop would have beside it
        shown = (
            "by the viscous damping that takes as much from an oscillation as large as the step moves the wall, limit "
            f"at B = {significant(damping, 3)} {units.damping}: K = {significant(without, 3)} {units.stiffness} with "
            f"it, {significant(limit, 3)} without"
        )
    if part in ("spring", "force"):
        rest = _rest_effect(part, stages, fitted)
        if rest > effect:
            return rest, f"moves the rest positions by up to {significant(100 * rest, 2)} %"
    return effect, shown


def _without(part: str, stages: ExperimentStages, fitted: FittedDevice, loop: LoopRange) -> LoopPoint:
    """Return the loop without a part; for friction with the viscous damping that it is worth."""
    left = dict(fitted.values)
    if part == "spring":
        left["stiffness"] = 0.0
    elif part == "lag":
        left["actuator_lag_s"] = 0.0
    elif part.startswith("mode"):
        left.pop("far_mass")
    elif part == "friction":
        left["damping"] += _viscous(stages, fitted, loop)
    return loop_point(fitted, left, stages.sampling_period_s, loop.parts.velocity)


def _viscous(stages: ExperimentStages, fitted: FittedDevice, loop: LoopRange) -> float:
    """Return the viscous damping that Coulomb friction c is worth at the amplitude F_0/K of the stiffest wall.

    4 c/(pi w A) takes as much energy from an oscillation of the frequency w, here sqrt(K/m), and the amplitude A.
    """
    stiffness = float(loop.at_values(np.array([loop.point.stiffest]))[0])
    step = float(np.median(np.abs(stages.trials.column("step").to_numpy())))
    if stiffness <= 0 or step <= 0:
        return 0.0
    return 4 * fitted.values["coulomb"] * sqrt(stiffness * fitted.values["mass"]) / (pi * step)


def _rest_effect(part: str, stages: ExperimentStages, fitted: FittedDevice) -> float:
    """Return by what share of the final displacement a spring or a constant force moves rest positions at most."""
    K = stages.column("response", "stiffness")
    stable: Floats = K[(stages.verdicts.verdict == "stable") & (K > 0)]
    if not len(stable):
        return 0.0
    if part == "spring":
        return abs(fitted.values["stiffness"]) / float(stable.min())
    step = float(np.median(np.abs(stages.trials.column("step").to_numpy())))
    return abs(fitted.values["constant_force"]) / step if step else 0.0


def _cause(part: str, stages: ExperimentStages, fitted: FittedDevice, units: Units, shown: str) -> Cause:
    code, number, sentence = _named(part, stages, fitted, units)
    interval = f"95 %: {span(lambda value: significant(value, 4), number.low, number.high)}; "
    trials = counted(len(fitted.trials), "log")
    evidence = f"{interval}the device with it explains {fitted.explained} of {trials}; {shown}"
    return Cause.model_validate({"code": code, "sentence": sentence, "evidence": evidence})


def _named(part: str, stages: ExperimentStages, fitted: FittedDevice, units: Units) -> tuple[str, Parameter, str]:
    """Return code, the number that tells most, and a sentence of a part."""

    def number(name: str) -> tuple[Parameter, str]:
        found = fitted.parameter(name)
        assert found is not None, "a part has its numbers"
        return found, significant(found.value, 3)

    force = "Nm" if "rad" in units.stiffness else "N"
    if part == "spring":
        value, text = number("stiffness")
        sentence = f"A spring of {text} {units.stiffness} holds the device: an operator, or one of its own."
        return "operator", value, sentence
    if part == "force":
        value, text = number("constant_force")
        return "constant_force", value, f"A constant force of {text} {force} acts on the device."
    if part == "lag":
        value, _ = number("actuator_lag_s")
        ms = significant(1e3 * value.value, 3)
        low, high = 1e3 * value.low, 1e3 * value.high
        shown = Parameter(value=1e3 * value.value, low=low, high=high)
        return "actuator_lag", shown, f"The force lags behind the command by a time constant of {ms} ms."
    if part == "friction":
        value, _ = number("coulomb")
        return "coulomb_friction", value, friction_words(value.value, force, stages)
    if part == "saturation":
        value, text = number("force_limit")
        return "saturation", value, f"The drive gives no more than {text} {force}, whatever is commanded."
    value, text = number("frequency_hz")
    side = "load" if part == LOAD else "motor"
    sentence = f"The device vibrates at {text} Hz, a mass on a spring; the position is sensed at the {side}'s side."
    return "vibration_mode", value, sentence
