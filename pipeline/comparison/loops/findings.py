"""The identified loop of an experiment, and the conclusions from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import listed
from pipeline.comparison.loops.boundary_shape import implied_delay, straight_bound
from pipeline.comparison.loops.causes import LoopEvidence, causes_of
from pipeline.comparison.loops.departures import (
    CourseFilter,
    experiment_departures,
    experiment_filter,
    other_gains,
    untimed,
)
from pipeline.comparison.loops.loop_basis import (
    LoopBasis,
    filter_quantities,
    identified_device,
    loop_basis,
    loop_quantities,
    mode_quantities,
    operator_quantities,
)
from pipeline.comparison.loops.passive_wall import is_passive, passive_wall
from pipeline.comparison.loops.recording_faults import unsafe_recording, words_of
from pipeline.comparison.loops.sensitivity import region_causes, sensitivities
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
from pipeline.measured.experiment.identified_loop import identified_loop
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.loop_limits import StepTrial, limits_of
from pipeline.records.findings import Estimate, Limit, Quantity
from pipeline.records.models import Device, Experiment
from pipeline.records.results import (
    LIMITS_WITHIN,
    LoopFindings,
    LoopResult,
    MeasuredExperiment,
    WallReplay,
    delay_of_logs,
)
from pipeline.records.trials import Floats
from pipeline.rendering.labels import Units, significant

OTHER_WALL = (
    "the unit of the position, or of K, B and the step, corrected in the profile (see `pipeline profile check`)"
)
NOTHING = "no device was identified from the logs, because mass, damping or delay are unknown"
HELD = (
    "a spring (perhaps a hand) acts on the device, so its own damping is unknown and passivity cannot be shown. "
    "Provide a device file, or trials without the hand"
)
GRIPPED = (
    "a hand was on the device (grip {}). Its damping vanishes when it lets go, and the damping of the device alone is "
    "unknown. Provide a device file with the hand as its operator, or record trials without it (grip none)"
)

JITTERS = (
    "the delay jitters. Passivity is proven only for a constant delay (4.6), so stability with any operator is not "
    "guaranteed"
)


@dataclass(frozen=True)
class LogsUnusable:
    """The recordings, or the walls that their commands follow, do not allow identification of a loop."""

    reason: str


@dataclass(frozen=True)
class NotIdentified:
    """Mass, damping or delay cannot be identified, and no device file states them."""

    reason: str = NOTHING


@dataclass(frozen=True, eq=False)
class Inadequate:
    """A loop that is not confirmed by a replay of tested walls.

    Parameters
    ----------
    basis : LoopBasis
    limits : tuple of Limit
        Limits of the loop at the tested dampings.
    replay : WallReplay or None
        Replay, or None if no tested wall could be replayed.
    reason : str
        Result of the replay and source of the loop, as a clause.
    """

    basis: LoopBasis
    limits: tuple[Limit, ...]
    replay: WallReplay | None
    reason: str


@dataclass(frozen=True, eq=False)
class Adequate(Inadequate):
    """A loop that predicts the tested walls."""


Findings = LogsUnusable | NotIdentified | Inadequate | Adequate


def examine_loop(
    measured: MeasuredExperiment, stages: ExperimentStages, device: Device | None, units: Units
) -> LoopFindings:
    """Return the loop of an experiment, its adequacy, its limits, a passive wall, and causes of deviations.

    Parameters
    ----------
    measured : MeasuredExperiment
    stages : ExperimentStages
    device : Device or None
        Device as described by its file, or None.
    units : Units
    """
    gains, fault = stages.once(other_gains), stages.once(unsafe_recording)
    misled = gains is not None and gains.most
    departures = [] if misled else stages.once(experiment_departures)
    velocity = None if misled else stages.once(experiment_filter)
    unusable = f"{gains.cause.sentence.rstrip('.')}; to resolve this, provide {OTHER_WALL}" if misled and gains else ""
    unusable = words_of(fault) if fault is not None else unusable or untimed(departures)
    entry = next((entry for entry in device.experiments if entry.name == stages.experiment), None) if device else None
    of_file = device.loop_for(entry) if device is not None and entry is not None else None
    trial = usual_trial(measured, stages)
    found = LogsUnusable(unusable) if unusable else judge_loop(measured, stages, of_file, trial)
    basis = found.basis if isinstance(found, Inadequate) else None
    delay = _delay(measured, found, stages)
    causes = causes_of(LoopEvidence(measured, stages, trial, units, departures, velocity, gains, basis, of_file, delay))
    # The damping of a hand vanishes when it lets go.
    grips = _grips(stages, entry) if of_file is None or of_file.operator is None else []
    refused = _passivity_unknown(found, grips, trial)
    wall, none = (None, refused) if basis is None or refused else passive_wall(basis, measured)
    optimum = measured.optimum
    if basis is not None and not refused:
        optimum = {
            name: best.model_copy(update={"passive": is_passive(basis, best.stiffness, best.damping)})
            for name, best in optimum.items()
        }
    return LoopFindings(
        loop=_record(measured, found, velocity, of_file),
        loop_boundary=(found.limits or None) if isinstance(found, Inadequate) else None,
        passive=wall,
        passive_reason=none,
        optimum=optimum,
        implied_delay=implied_delay(measured, basis),
        straight_bound=straight_bound(measured, basis),
        replay=found.replay if isinstance(found, Inadequate) else None,
        sensitivities=sensitivities(found.basis.loop, found.limits) if isinstance(found, Adequate) else (),
        region_causes=region_causes(measured, of_file, found.basis, found.limits)
        if isinstance(found, Adequate)
        else None,
        causes=causes,
    )


def _delay(measured: MeasuredExperiment, found: Findings, stages: ExperimentStages) -> Estimate:
    """Return the delay of the logs: the fitted one, unless the loop is not confirmed."""
    device = stages.once(identified_loop)
    judged = isinstance(found, Inadequate) and found.replay is not None and found.replay.verdicts_same is not None
    return delay_of_logs(
        measured.estimates["delay_samples"],
        adequate=isinstance(found, Adequate),
        judged=judged,
        doubted=device is None or not device.is_reliable,
    )


def judge_loop(
    measured: MeasuredExperiment, stages: ExperimentStages, of_file: Loop | None, trial: StepTrial
) -> Findings:
    """Return whether usable logs show a loop, and whether it predicts the tested walls.

    Parameters
    ----------
    measured : MeasuredExperiment
    stages : ExperimentStages
    of_file : Loop or None
        Loop of the device file, or None.
    trial : StepTrial
        Step and duration of a typical trial.

    Notes
    -----
    Only the replay of the identified device decides. The loop is that of the device file if it reproduces the measured
    limits, or without measured limits those of the identified device. Otherwise, it is the identified loop.
    """
    basis = loop_basis(stages.once(identified_device), of_file)
    if basis is None:
        return NotIdentified()
    B, least = np.array([point.damping for point in measured.boundary]), softest(measured, stages)
    by_file = limits_of(basis.nominal, B, trial, least) if basis.nominal is not None else None
    by_logs, replay, refused = None, None, ""
    if basis.identified is not None:
        by_logs = limits_of(basis.identified, B, trial, least)
        replay = wall_replay(measured, stages, basis.identified, by_logs[0], trial)
    if by_file is not None and by_logs is not None and (refused := _file_refused(measured, by_file[0], by_logs[0])):
        by_file, basis = None, replace(basis, nominal=None)
    basis = replace(basis, error=replay_error(replay))
    limits = limits_with_intervals(measured, basis, [each for each in (by_file, by_logs) if each is not None])
    reason = _reason(basis, replay, refused, of_file, walls=bool(measured.boundary))
    return (Adequate if replay is not None and replay.is_right else Inadequate)(basis, limits, replay, reason)


def _passivity_unknown(found: Findings, grips: Sequence[str], trial: StepTrial) -> str:
    """Return the reason why no passive wall can be given, or "" if it can."""
    if isinstance(found, LogsUnusable | NotIdentified):
        return found.reason
    if not isinstance(found, Adequate):
        return f"an adequate loop is required, but {found.reason}"
    if grips:
        return GRIPPED.format(listed(grips))
    basis = found.basis
    if basis.nominal is None and basis.identified is not None and "spring" in basis.identified.parts:
        return HELD
    return JITTERS if trial.jitter else ""


def _grips(stages: ExperimentStages, of: Experiment | None) -> list[str]:
    """Return the grips of hands on the device, from logs and device file. The list is empty without a hand."""
    grips = {*stages.trials.column("grip").to_pylist(), *([of.grip] if of is not None else [])}
    return sorted(grip for grip in grips if grip and grip != "none")


def _file_refused(measured: MeasuredExperiment, by_file: Floats, by_logs: Floats) -> str:
    """Return the reason why the limits of the device file's loop are not used, or "" if they agree with measured
    limits."""
    off = limits_off(measured, by_file)
    if off is None:
        off = median(100 * np.abs(by_file / np.where(by_logs > 0, by_logs, np.nan) - 1))
    if off is None or off <= LIMITS_WITHIN:
        return ""
    return f"the limits of the device file deviate by {significant(off, 2)} %, so the identified device is used"


def _record(
    measured: MeasuredExperiment, found: Findings, velocity: CourseFilter | None, of_file: Loop | None
) -> LoopResult:
    check, friction = measured.model_check, measured.estimates.get("friction")
    known = friction is not None and None not in (friction.value, friction.low, friction.high)
    operator = of_file.operator if of_file is not None else None
    basis = found.basis if isinstance(found, Inadequate) else None
    numbers = {} if basis is None else loop_quantities(basis)
    of_logs = velocity.of_logs if velocity else ()
    return LoopResult(
        source="estimated" if basis is None or basis.nominal is None else "device file",
        adequate=isinstance(found, Adequate),
        reason=found.reason,
        explained=check.explained / check.trials if check and check.trials else None,
        mass=numbers.get("mass"),
        damping=numbers.get("damping"),
        stiffness=numbers.get("stiffness"),
        delay_samples=numbers.get("delay_samples"),
        actuator_lag_s=numbers.get("actuator_lag_s"),
        velocity=filter_quantities(basis.loop.velocity, of_logs) if basis and basis.loop.velocity else None,
        mode=None if basis is None else mode_quantities(basis),
        operator=operator_quantities(operator, basis.loop.motion) if basis and basis.nominal and operator else None,
        friction=Quantity(value=friction.value, low=friction.low, high=friction.high, unit=friction.unit)
        if friction and known
        else None,
    )


def _reason(basis: LoopBasis, replay: WallReplay | None, refused: str, of_file: Loop | None, *, walls: bool) -> str:
    """Return the result of the replay, and the source of the loop. ``walls``: whether any wall was tested."""
    if not walls:
        return "no wall was tried (K > 0), so the loop could not be compared with verdicts"
    if replay is None or replay.verdicts_same is None:
        return (
            "no wall outside the interval of a measured limit has a verdict, so the identified device cannot be checked"
        )
    clauses = [replay_words(replay)]
    if refused:
        clauses.append(refused)
    elif basis.nominal is not None and of_file is not None and of_file.parts_in_words():
        clauses.append(f"the loop of the device file ({of_file.parts_in_words()}) has the same limits")
    else:
        side = f"mode at the {basis.devices[0].mode_sensor}"
        parts = [side if part == "mode" else part for part in basis.devices[0].parts]
        what = listed(["mass", "damping", "delay", *parts])
        clauses.append(f"the loop has {what}; an error of the force per command appears in the mass")
    return "; ".join(clauses)
