"""The loop of an experiment as far as its logs allow to speak of it, and what follows from it."""

from __future__ import annotations

import numpy as np

from pipeline.base.wording import listed
from pipeline.comparison.loops.adequacy import Doubt, doubts
from pipeline.comparison.loops.causes import direct_causes
from pipeline.comparison.loops.log_evidence import found_filter, law_departures
from pipeline.comparison.loops.loop_range import LoopRange, estimated_range, stated_range
from pipeline.comparison.loops.passive_wall import passive_wall
from pipeline.measured.experiment.rest_forces import rest_forces
from pipeline.measured.signal.velocity_filter import VelocityFilterFound
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.loop_parts import LoopParts, named
from pipeline.records.loop_records import LoopFindings, LoopLimit, LoopResult, Parameter
from pipeline.records.models import Device, Experiment
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import Units

MOST_REASONS = 3
"""Reasons against a loop that are told: the gravest ones; others often follow from them."""


def loop_findings(
    result: ExperimentResult, stages: ExperimentStages, device: Device | None, units: Units
) -> LoopFindings:
    """Return the loop of an experiment, whether it is adequate, its limits, a passive wall and causes.

    Parameters
    ----------
    result : ExperimentResult
        With its estimates and boundary.
    stages : ExperimentStages
    device : Device or None
        As its file describes it.
    units : Units

    Notes
    -----
    The loop is that of the device file where there is one, with intervals that reach to the estimates; else that of
    the estimates.
    """
    entry = next((e for e in device.experiments if e.name == stages.experiment), None) if device else None
    estimated = estimated_range(result, stages.sampling_period_s)
    period = device.sampling_period_s if device else stages.sampling_period_s
    loop = estimated if entry is None else stated_range(entry, estimated, period)
    departures, rest = law_departures(stages), stages.once(rest_forces)
    parts = _declared_parts(device, entry)
    against = doubts(result, loop, departures, rest, parts, units)
    velocity = found_filter(stages) if any(each.code == "velocity_filter" for each in departures) else None
    shown = _loop_result(result, loop, against, stated=entry is not None, velocity=velocity)
    stated = entry.mass if entry else None
    causes = direct_causes(result, stages, estimated, departures, rest, stated, units, adequate=not against)
    if loop is None or against:
        why = f"needs an adequate loop, and this one is not: {shown.reason}"
        return LoopFindings(loop=shown, passive_reason=why, causes=causes)
    wall, why_none = passive_wall(loop, result)
    return LoopFindings(
        loop=shown,
        loop_boundary=_limits(loop, result),
        passive=wall,
        passive_reason=why_none,
        causes=causes,
    )


_PART_WORDS = {"velocity": "velocity filter", "actuator_lag_s": "actuator lag", "mode": "vibration mode"}


def _declared_parts(device: Device | None, entry: Experiment | None) -> str:
    """Return which parts of a loop that is not ideal a device file declares; theory by them replaces this doubt."""
    if device is None or entry is None:
        return ""
    ideal, parts = LoopParts(), device.loop_of(entry)
    names = [name for name, part in named(parts).items() if part != getattr(ideal, name)]
    return listed([_PART_WORDS.get(name, name.replace("_", " ")) for name in names])


def _loop_result(
    result: ExperimentResult,
    loop: LoopRange | None,
    against: list[Doubt],
    *,
    stated: bool,
    velocity: VelocityFilterFound | None,
) -> LoopResult:
    check = result.model_check
    explained = check.explained / check.trials if check and check.trials else None
    friction = result.estimates.get("friction")
    told = friction is not None and None not in (friction.value, friction.low, friction.high)
    return LoopResult(
        source="device file" if stated else "estimated",
        adequate=not against,
        reason=_reason(result, against),
        explained=explained,
        mass=loop.mass if loop else None,
        damping=loop.damping if loop else None,
        stiffness=_exact(loop.stiffness) if loop and stated else None,
        delay_samples=loop.delay_samples if loop else None,
        velocity=_filter_parameters(velocity) if velocity else None,
        friction=Parameter(value=friction.value, low=friction.low, high=friction.high) if friction and told else None,
    )


def _reason(result: ExperimentResult, against: list[Doubt]) -> str:
    if not against:
        check = result.model_check
        logs = f"{check.explained} of {check.trials} logs" if check else "the logs"
        return f"the logs obey the wall law, and mass, damping and delay explain {logs} and the measured limits"
    told = "; ".join(doubt.text for doubt in against[:MOST_REASONS])
    helps = list(dict.fromkeys(doubt.help for doubt in against[:MOST_REASONS] if doubt.help))
    return told + (f"; what would help: {'; '.join(helps)}" if helps else "")


def _exact(value: float) -> Parameter:
    return Parameter(value=value, low=value, high=value)


def _filter_parameters(found: VelocityFilterFound) -> dict[str, Parameter]:
    """Return a filter that logs show exactly, by the names of a device file."""
    if found.difference:
        return {"samples": _exact(float(found.difference))}
    if found.cutoff_hz:
        return {"order": _exact(float(len(found.a) - 1)), "cutoff_hz": _exact(found.cutoff_hz)}
    numbers = {f"b{i}": value for i, value in enumerate(found.b)} | {f"a{i}": value for i, value in enumerate(found.a)}
    return {name: _exact(value) for name, value in numbers.items()}


def _limits(loop: LoopRange, result: ExperimentResult) -> tuple[LoopLimit, ...]:
    """Return the limit of the loop at every tested damping."""
    damping = np.array([point.damping for point in result.boundary])
    if not len(damping):
        return ()
    low, high = loop.band(damping)
    value = loop.at_values(damping)
    rows = zip(damping, value, np.minimum(low, value), np.maximum(high, value), strict=True)
    return tuple(LoopLimit(damping=float(b), stiffness=float(v), low=float(a), high=float(h)) for b, v, a, h in rows)
