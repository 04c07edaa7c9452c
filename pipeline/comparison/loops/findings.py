"""The identified loop of an experiment, and the conclusions from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.base.wording import listed
from pipeline.comparison.loops.boundary_shape import implied_delay, straight_bound
from pipeline.comparison.loops.causes import Shown, causes_of
from pipeline.comparison.loops.departures import (
    CourseFilter,
    LawRows,
    experiment_filter,
    law_departures,
    other_gains,
    untimed,
)
from pipeline.comparison.loops.loop_basis import LoopBasis, identified_device, loop_basis, loop_numbers
from pipeline.comparison.loops.passive_wall import is_passive, passive_wall
from pipeline.comparison.loops.recording_faults import unsafe_recording, words_of
from pipeline.comparison.loops.wall_replay import (
    limits_off,
    limits_with_intervals,
    median,
    replay_error,
    replay_words,
    softest,
    usual_trial,
    wall_replay,
)
from pipeline.device.loop import Loop
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.loop_limits import limits_of
from pipeline.records.findings import Quantity
from pipeline.records.models import Device, Experiment
from pipeline.records.results import LIMITS_WITHIN, ExperimentResult, LoopFindings, LoopResult, WallReplay
from pipeline.records.trials import Floats
from pipeline.rendering.labels import Units, significant

OTHER_WALL = (
    "the unit of the position, or of K, B and the step, corrected in the profile (see `pipeline profile check`)"
)
NOTHING = "no device was found in the logs, since mass, damping or delay are not known"
HELD = (
    "a spring (perhaps a hand) acts on the device, so that its own damping is unknown and passivity cannot be shown. "
    "Provide a device file, or trials without the hand"
)
GRIPPED = (
    "a hand was on the device (grip {}), whose damping is gone when it lets go, and how much of the damping is the "
    "device's own is not known: provide a device file with the hand as its operator, or record trials without it "
    "(grip none)"
)

JITTERS = (
    "the delay jitters, and passivity is known of constant delays alone (4.6): stability with every hand cannot be "
    "promised"
)


def loop_findings(
    result: ExperimentResult, stages: ExperimentStages, device: Device | None, units: Units
) -> LoopFindings:
    """Return the loop of an experiment, its adequacy, its limits, a passive wall and causes.

    Parameters
    ----------
    result : ExperimentResult
        With its estimates and boundary.
    stages : ExperimentStages
    device : Device or None
        Device as its file describes it.
    units : Units

    Notes
    -----
    Only the replay of the identified device decides. The loop is that of the device file if it reproduces the measured
    limits (without any, those of the identified device); else it is the identified one.
    """
    gains = stages.once(other_gains)
    misled = gains is not None and gains.most
    departures = [] if misled else law_departures(stages.once(LawRows.of))
    velocity = None if misled else stages.once(experiment_filter)
    unknown = f"{gains.cause.sentence.rstrip('.')}; what would help: {OTHER_WALL}" if misled and gains else ""
    fault = stages.once(unsafe_recording)
    unknown = words_of(fault) if fault is not None else unknown or untimed(departures)
    identified = None if unknown else identified_device(stages)
    entry = next((entry for entry in device.experiments if entry.name == stages.experiment), None) if device else None
    of_file = device.loop_for(entry) if device is not None and entry is not None else None
    basis = None if unknown else loop_basis(identified, of_file)
    trial = usual_trial(result, stages)
    limits, replay, refused = [], None, ""
    if basis is not None:
        B = np.array([point.damping for point in result.boundary])
        limits = [limits_of(known, B, trial, softest(result, stages)) for known in basis.devices]
        if identified is not None:
            replay = wall_replay(result, stages, identified, limits[-1][0], trial)
        basis = replace(basis, error=replay_error(replay))
        if basis.nominal is not None and identified is not None:
            basis, limits, refused = _judged(basis, result, limits)
    nominal_mass = basis.loop.mass if basis is not None and basis.nominal is not None else None
    error = basis.error if basis is not None else 0.0
    shown = Shown(result, stages, trial, units, departures, velocity, gains, identified, nominal_mass, error)
    causes = causes_of(shown)
    adequate = basis is not None and replay is not None and replay.is_right
    reason = unknown or NOTHING
    if basis is not None:
        reason = _reason(basis, replay, refused, of_file, walls=bool(result.boundary))
    record = _record(result, basis, velocity, of_file, adequate=adequate, reason=reason)
    shape = {"implied_delay": implied_delay(result, basis), "straight_bound": straight_bound(result, basis)}
    findings = LoopFindings(loop=record, replay=replay, causes=causes, optimum=result.optimum, **shape)
    if basis is None:
        return findings.model_copy(update={"passive_reason": reason})
    findings = findings.model_copy(update={"loop_boundary": limits_with_intervals(result, basis, limits) or None})
    if not adequate:
        return findings.model_copy(update={"passive_reason": f"needs an adequate loop, and this one is not: {reason}"})
    has_spring = basis.nominal is None and identified is not None and "spring" in identified.parts
    # the damping of a hand vanishes when it lets go
    grips = _grips(stages, entry) if of_file is None or of_file.operator is None else []
    refused = GRIPPED.format(listed(grips)) if grips else HELD if has_spring else JITTERS if trial.jitter else ""
    if refused:
        return findings.model_copy(update={"passive_reason": refused})
    wall, none = passive_wall(basis, result)
    optimum = {
        criterion: best.model_copy(update={"passive": is_passive(basis, best.stiffness, best.damping)})
        for criterion, best in result.optimum.items()
    }
    return findings.model_copy(update={"passive": wall, "passive_reason": none, "optimum": optimum})


def _grips(stages: ExperimentStages, of: Experiment | None) -> list[str]:
    """Return the grips of the hand on the device, by logs and device file; empty without a hand."""
    grips = {*stages.trials.column("grip").to_pylist(), *([of.grip] if of is not None else [])}
    return sorted(grip for grip in grips if grip and grip != "none")


def _judged(
    basis: LoopBasis, result: ExperimentResult, limits: list[tuple[Floats, Floats]]
) -> tuple[LoopBasis, list[tuple[Floats, Floats]], str]:
    """Return the loop by its file with its limits, or by the logs alone if the limits of the file differ; and why."""
    (by_file, _), (by_logs, _) = limits
    off = limits_off(result, by_file)
    if off is None:
        off = median(100 * np.abs(by_file / np.where(by_logs > 0, by_logs, np.nan) - 1))
    if off is None or off <= LIMITS_WITHIN:
        return basis, limits, ""
    why = f"the limits of the device file's loop are {significant(off, 2)} % off, so that the found device is used"
    return replace(basis, nominal=None), limits[1:], why


def _record(
    result: ExperimentResult,
    basis: LoopBasis | None,
    velocity: CourseFilter | None,
    of_file: Loop | None,
    *,
    adequate: bool,
    reason: str,
) -> LoopResult:
    check, friction = result.model_check, result.estimates.get("friction")
    known = friction is not None and None not in (friction.value, friction.low, friction.high)
    operator = of_file.operator if of_file is not None else None
    numbers = loop_numbers(basis, velocity.of_logs if velocity else (), operator) if basis is not None else {}
    return LoopResult(
        source="estimated" if basis is None or basis.nominal is None else "device file",
        adequate=adequate,
        reason=reason,
        explained=check.explained / check.trials if check and check.trials else None,
        **numbers,
        friction=Quantity(**friction.model_dump(include={"value", "low", "high", "unit"}))
        if friction and known
        else None,
    )


def _reason(basis: LoopBasis, replay: WallReplay | None, refused: str, of_file: Loop | None, *, walls: bool) -> str:
    """Return the replay's verdict on a loop, and the source of the loop; ``walls``: whether any was tested."""
    if not walls:
        return "no wall was tried (K > 0), so that the loop was compared with no verdict"
    if replay is None or replay.verdicts_same is None:
        return (
            "no wall outside the interval of a measured limit has a verdict, so the identified device cannot be checked"
        )
    said = [replay_words(replay)]
    if refused:
        said.append(refused)
    elif basis.nominal is not None and of_file is not None and of_file.parts_in_words():
        said.append(f"the loop of the device file ({of_file.parts_in_words()}) has the same limits")
    else:
        side = f"mode at the {basis.devices[0].mode_sensor}"
        parts = [side if part == "mode" else part for part in basis.devices[0].parts]
        what = listed(["mass", "damping", "delay", *parts])
        said.append(f"it has {what}; what changes force per command alone shows in the mass")
    return "; ".join(said)
