"""The loop of an experiment as far as its logs allow to speak of it, and what follows from it."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.base.wording import listed
from pipeline.comparison.loops.adequacy import Doubt, Shown, doubts
from pipeline.comparison.loops.causes import direct_causes
from pipeline.comparison.loops.fitted_loop import found_loop, mode_parameters, velocity_of
from pipeline.comparison.loops.large_motion import TYPICAL, limits_for_step
from pipeline.comparison.loops.log_evidence import filters_of_logs, law_departures
from pipeline.comparison.loops.loop_range import LoopRange, stated_range
from pipeline.comparison.loops.loop_record import exact, filter_parameters, stated_parameters
from pipeline.comparison.loops.other_gains import other_gains
from pipeline.comparison.loops.passive_wall import passive_wall
from pipeline.comparison.loops.wall_replay import replay_words, wall_replay
from pipeline.measured.experiment.fitted_device import fitted_device
from pipeline.measured.experiment.rest_forces import rest_forces
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.loop_parts import LoopParts
from pipeline.records.loop_records import Cause, LoopFindings, LoopLimit, LoopResult, Parameter, WallReplay
from pipeline.records.models import Device
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
    gains, rest = stages.once(other_gains), stages.once(rest_forces)
    fitted = stages.once(fitted_device)
    departures = [] if gains is not None and gains.most else law_departures(stages)
    velocity = velocity_of(stages, departures)
    shown = Shown(departures, rest, fitted, velocity, filters_of_logs(stages) if velocity else (), gains)
    estimated = found_loop(result, stages, velocity)
    period = device.sampling_period_s if device else stages.sampling_period_s
    parts = device.loop_of(entry) if device and entry else None
    loop = estimated if entry is None or parts is None else stated_range(entry, parts, estimated, period)
    against = doubts(result, loop, shown, parts, units)
    hard = [doubt for doubt in against if not doubt.soft]
    stated = loop.mass.value if parts and loop else None
    causes = direct_causes(result, stages, estimated, shown, stated, units, adequate=not hard)
    # a file that the logs contradict foretells no limit
    loops = (estimated if hard and estimated is not None else loop, estimated)
    limits, replay = _predicted(result, stages, loops, shown, causes)
    if replay is not None and replay.verdicts_same is not None:
        against = hard if replay.is_right else against or [Doubt(replay_words(replay))]
    record = _loop_result(result, loop, against, shown, parts)
    if replay is not None and "friction" in record.parts_beside and not against:
        record = record.model_copy(update={"reason": replay_words(replay)})
    limits = _widened(limits, replay) if against else limits
    findings = LoopFindings(loop=record, loop_boundary=limits or None, replay=replay, causes=causes)
    if loop is None or against:
        why = f"needs an adequate loop, and this one is not: {record.reason}"
        return findings.model_copy(update={"passive_reason": why})
    held = entry is None and fitted is not None and "spring" in fitted.parts
    # a hand that is let go of takes its damping with it
    wall, why_none = (None, _HELD) if held else passive_wall(loop, result)
    return findings.model_copy(update={"passive": wall, "passive_reason": why_none})


def _predicted(
    result: ExperimentResult,
    stages: ExperimentStages,
    loops: tuple[LoopRange | None, LoopRange | None],
    shown: Shown,
    causes: tuple[Cause, ...],
) -> tuple[tuple[LoopLimit, ...], WallReplay | None]:
    """Return the limits of the loop, for the step that was used where there is friction, and the found one's replay.

    ``loops`` are that of the statements and the one found.
    """
    loop, estimated = loops
    if loop is None or not result.boundary or (shown.gains is not None and shown.gains.most):
        return (), None
    friction = result.estimates.get("friction")
    rubs = any(cause.code == "coulomb_friction" for cause in causes) and friction is not None and bool(friction.value)
    if rubs and estimated is not None and friction is not None:
        limits = limits_for_step(result, stages, estimated, friction)
    else:
        limits = _limits(loop, result)
    if estimated is None:
        return limits, None
    own = limits if rubs or loop is estimated else _limits(estimated, result)
    fitted = shown.fitted if shown.explained else None
    return limits, wall_replay(result, stages, estimated, fitted, own)


def _widened(limits: tuple[LoopLimit, ...], replay: WallReplay | None) -> tuple[LoopLimit, ...]:
    """Return limits whose intervals hold the error of the replay: 95 % of a normal one with its median."""
    off = (replay.limits_off_percent or 0.0) / 100 if replay is not None else 0.0
    share = NORMAL_95 * TYPICAL * off

    def wider(each: LoopLimit) -> LoopLimit:
        reach = share * each.stiffness
        low = each.stiffness - float(np.hypot(each.stiffness - each.low, reach))
        high = each.stiffness + float(np.hypot(each.high - each.stiffness, reach))
        return each.model_copy(update={"low": max(low, 0.0), "high": high})

    return tuple(wider(each) for each in limits)


_HELD = (
    "a spring holds the device, perhaps a hand: how much of the damping is the device's own is not known, and a wall "
    "is passive by that alone; a device file, or trials without it, would tell"
)


def _loop_result(
    result: ExperimentResult, loop: LoopRange | None, against: list[Doubt], shown: Shown, parts: LoopParts | None
) -> LoopResult:
    check, fitted = result.model_check, shown.fitted
    explained = check.explained / check.trials if check and check.trials else None
    friction = result.estimates.get("friction")
    numbers: dict[str, Any] = {"velocity": filter_parameters(shown.velocity, shown.of_logs) if shown.velocity else None}
    told = friction is not None and None not in (friction.value, friction.low, friction.high)
    if fitted is not None and fitted.tells:
        numbers |= {name: fitted.parameter(name) for name in ("stiffness", "actuator_lag_s")}
        numbers["mode"] = mode_parameters(fitted)
    if parts is not None:
        numbers = stated_parameters(parts) | {"stiffness": exact(loop.stiffness) if loop else None}
    return LoopResult(
        source="estimated" if parts is None else "device file",
        adequate=not against,
        reason=_reason(result, against, shown, parts),
        explained=explained,
        mass=loop.mass if loop else None,
        damping=loop.damping if loop else None,
        delay_samples=loop.delay_samples if loop else None,
        **numbers,
        friction=Parameter(value=friction.value, low=friction.low, high=friction.high) if friction and told else None,
    )


def _reason(result: ExperimentResult, against: list[Doubt], shown: Shown, parts: LoopParts | None) -> str:
    fitted, stated = shown.fitted, parts.words() if parts else ""
    if not against and stated:
        return (
            f"the loop of the device file ({stated}) has the measured limits and those of the loop that the logs show, "
            f"which explains {_explained(result)}"
        )
    if not against:
        law = "with a filtered velocity, " if shown.velocity else ""
        what = listed(["mass", "damping", "delay", *(fitted.parts if fitted else ())])
        logs = _explained(result)
        return f"the logs obey the wall law, {law}and {what} explain {logs} and the measured limits"
    told = "; ".join(doubt.text for doubt in against[:MOST_REASONS])
    helps = list(dict.fromkeys(doubt.help for doubt in against[:MOST_REASONS] if doubt.help))
    return told + (f"; what would help: {'; '.join(helps)}" if helps else "")


def _explained(result: ExperimentResult) -> str:
    check = result.model_check
    return f"{check.explained} of {check.trials} logs" if check else "the logs"


def _limits(loop: LoopRange, result: ExperimentResult) -> tuple[LoopLimit, ...]:
    """Return the limit of the loop at every tested damping."""
    damping = np.array([point.damping for point in result.boundary])
    if not len(damping):
        return ()
    low, high = loop.band(damping)
    value = loop.at_values(damping)
    rows = zip(damping, value, np.minimum(low, value), np.maximum(high, value), strict=True)
    return tuple(LoopLimit(damping=float(b), stiffness=float(v), low=float(a), high=float(h)) for b, v, a, h in rows)
