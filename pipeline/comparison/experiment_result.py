"""Results of one experiment, and the theories of the experiments of a scene."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np

from pipeline.base.disk import if_writable, read_result, write_result
from pipeline.base.progress import part_of_work
from pipeline.base.provenance import code_digest, digest
from pipeline.comparison.loops.departures import SHORT as OTHER_WALL
from pipeline.comparison.loops.departures import LawRows, law_departures, other_gains, untimed
from pipeline.comparison.loops.findings import loop_findings
from pipeline.comparison.loops.loop_basis import adequate_theory
from pipeline.comparison.loops.recording_faults import cause_of, recording_faults, unsafe_recording, words_of
from pipeline.comparison.loops.wall_replay import with_large_motion
from pipeline.comparison.scene.origin import header_lines
from pipeline.comparison.scene.scene import SceneData, needed_stages
from pipeline.comparison.summary.recommended_walls import region_to_use
from pipeline.device.loop import Loop
from pipeline.device.parameters import ESTIMATE_PARAMETERS
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.experiment.boundary import boundary_area
from pipeline.measured.experiment.estimates import (
    by_model,
    damping_estimate,
    delay_estimate,
    jitter_estimate,
    mass_estimate,
    model_check,
)
from pipeline.measured.experiment.identified_loop import identified_loop
from pipeline.measured.stages.stage_needs import NEEDS
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.findings import BoundaryPoint, Estimate
from pipeline.records.models import Experiment
from pipeline.records.results import NOT_ADEQUATE, ExperimentResult, LoopFindings, SourcedLoop
from pipeline.rendering.labels import Units
from pipeline.store.storage import stage_folder
from pipeline.theory.predictions import Theory

FINDINGS = "loop"
"""Prefix of the file name for the findings on a loop, in the folder of the stages."""


LOOP_BEGINS = 0.65
"""Usual share of an experiment's run time after which its stages are complete and its loop is replayed."""

USUAL_SHARES, USUAL_SHARE = {"response": 6.0, "parts": 12.0}, 0.5
"""Usual run times of stages, in any unit, for the progress display; and the run time of any other stage."""


def nominal_theories(data: SceneData) -> dict[str, Theory]:
    """Return the theory by the device file for all of its experiments (a table may use parameters of another one).

    An experiment has no theory if its delay exceeds the range of theory, or if no wall stabilises its loop.
    """
    if data.device is None:
        return {}
    loops = {entry.name: data.device.loop_for(entry) for entry in data.device.experiments}
    theories = {
        name: Theory(SourcedLoop(loop=loop, source=f"device file {data.device.name}{_with(loop)}"))
        for name, loop in loops.items()
        if loop.delay_samples <= LARGEST_DELAY
    }
    return {name: theory for name, theory in theories.items() if theory.stabilised}


def _with(loop: Loop) -> str:
    text = f", with {loop.parts_in_words()}" if loop.parts_in_words() else ""
    return f"{text}; without {', '.join(loop.left_out)}" if loop.left_out else text


def estimated_theories(results: Sequence[ExperimentResult], data: SceneData) -> dict[str, Theory]:
    """Return the theory by the estimates of each experiment whose loop is adequate."""
    both = zip(results, data.experiments, strict=True)
    found = {result.experiment: adequate_theory(result, stages) for result, stages in both}
    return {name: theory for name, theory in found.items() if theory is not None}


def experiment_result(data: SceneData, stages: ExperimentStages, theory: Theory | None) -> ExperimentResult:
    """Compute and collect the required results of one experiment."""
    needed = needed_stages(data)
    ordered = sorted(needed, key=list(NEEDS).index)
    shares = np.cumsum([0.0, *(USUAL_SHARES.get(stage, USUAL_SHARE) for stage in ordered)])
    shares *= LOOP_BEGINS / shares[-1]
    for stage, begin, end in zip(ordered, shares.tolist(), shares[1:].tolist(), strict=False):
        with part_of_work("", begin, end):
            stages.table(stage)
    units = data.units
    named: dict[str, Experiment] = {e.name: e for e in data.device.experiments} if data.device else {}
    entry = named.get(stages.experiment)
    limits = _known_points(stages)
    best = {criterion: stages.optimum(criterion, limits) for criterion in data.scene.criteria}
    optimum = {criterion: found for criterion, found in best.items() if found is not None}
    missing = {c: stages.cost(c)[1] or "no stable trial has this cost" for c in best if c not in optimum}
    periods = set(stages.trials.column("sampling_period_s").to_pylist())
    grips = sorted(set(stages.trials.column("grip").to_pylist()))
    result = ExperimentResult(
        experiment=stages.experiment,
        configuration=entry.configuration if entry else "",
        grip=grips[0] if len(grips) == 1 else "none",
        simulated=any(stages.trials.column("simulated").to_pylist()),
        sampling_period_s=periods.pop() if len(periods) == 1 else None,
        trials=stages.trials.num_rows,
        verdicts=dict(sorted(Counter(stages.verdicts.verdict.tolist()).items())),
        outcomes=dict(Counter(stages.texts("outcome", "outcome"))) if "outcome" in needed else {},
        model_check=model_check(stages) if "model" in needed else None,
        estimates=_estimates(stages, needed, units),
        boundary=limits,
        optimum=optimum,
        missing=missing,
        theory=theory.described if theory else None,
        header=header_lines(stages),
        recording=stages.once(recording_faults),
    )
    gains, fault = stages.once(other_gains), stages.once(unsafe_recording)
    if fault is not None or (gains is not None and gains.most):
        why = words_of(fault) if fault is not None else OTHER_WALL
        result = result.model_copy(update={"optimum": {}, "missing": dict.fromkeys(data.scene.criteria, why)})
        use = None
    else:
        use, why = region_to_use(result, stages)
    causes = [cause_of(each) for each in result.recording if each.is_unsafe]
    causes += [] if gains is None or gains.few else [gains.cause]
    result = result.model_copy(update={"use": use, "use_reason": why or None, "causes": tuple(causes)})
    with part_of_work("", LOOP_BEGINS, 1.0):
        return _with_loop(data, stages, result, units) if "device" in needed else result


def _known_points(stages: ExperimentStages) -> tuple[BoundaryPoint, ...]:
    """Return the measured boundary; without limits if the recordings do not determine any."""
    if stages.once(unsafe_recording) is None:
        return stages.boundary_points
    nothing = {"estimate": None, "low": None, "high": None, "stable": None, "unstable": None, "censored": True}
    return tuple(point.model_copy(update=nothing) for point in stages.boundary_points)


_OF_A_LOOP = ("delay_samples", "mass", "damping", "device_stiffness")
"""Estimates that are valid only if their loop is adequate."""


def _with_loop(data: SceneData, stages: ExperimentStages, result: ExperimentResult, units: Units) -> ExperimentResult:
    """Add the loop and its consequences; drop or flag results that need a better loop."""
    fault = stages.once(unsafe_recording)
    if fault is not None:
        nothing = {name: _without(each.unit, words_of(fault)) for name, each in result.estimates.items()}
        result = result.model_copy(update={"estimates": nothing})
    elif reason := untimed(law_departures(stages.once(LawRows.of))):
        kept = {"boundary_area": result.estimates["boundary_area"]}
        others = {name: _without(each.unit, reason) for name, each in result.estimates.items()}
        result = result.model_copy(update={"estimates": others | kept})
    findings = _findings(data, stages, result, units)
    found = dict(result.estimates)
    if not findings.loop.adequate:
        device = stages.once(identified_loop)
        if device is None or not device.tells:
            found |= {name: _doubted(found[name]) for name in _OF_A_LOOP if name in found}
    named = {name: getattr(findings, name) for name in LoopFindings.model_fields}
    return with_large_motion(result.model_copy(update={**named, "estimates": found}), stages)


def _findings(data: SceneData, stages: ExperimentStages, result: ExperimentResult, units: Units) -> LoopFindings:
    """Return the loop and its consequences: the stored ones if all inputs are unchanged.

    Simulating the identified device at the tested walls takes longer than reading all stages.
    """
    device = data.device.model_dump_json() if data.device else ""
    keys = [stages.key(stage) for stage in sorted(NEEDS)]
    key = digest([result.model_dump_json(), device, code_digest("report"), *keys])
    folder = stage_folder(stages.processed, stages.device, stages.experiment)
    stored = json.loads(read_result(folder, FINDINGS, ".json") or b"{}")
    if stored.get("key") == key:
        return LoopFindings.model_validate(stored["findings"])
    found = loop_findings(result, stages, data.device, units)
    with if_writable():
        document = {"key": key, "findings": found.model_dump(mode="json")}
        write_result(folder, FINDINGS, ".json", json.dumps(document, allow_nan=False).encode())
    return found


def _doubted(estimate: Estimate) -> Estimate:
    if estimate.value is None:
        return estimate
    doubt = f"{NOT_ADEQUATE}, so that its interval may be too narrow"
    return estimate.model_copy(update={"warning": "; ".join(filter(None, [estimate.warning, doubt]))})


def _estimates(stages: ExperimentStages, needed: Collection[str], units: Units) -> dict[str, Estimate]:
    """Return the estimates of an experiment: delay, mass and damping, and those derived from its boundary."""
    area = boundary_area(stages.boundary_points, f"{units.stiffness} {units.damping}")
    if "device" not in needed:
        why = "left out: neither a criterion that was asked for nor a theory curve needs it"
        of = {"delay_samples": "samples", "mass": units.mass, "damping": units.damping}
        return {name: _without(unit, why) for name, unit in of.items()} | {"boundary_area": area}
    return {
        "delay_samples": stages.once(delay_estimate),
        "mass": stages.once(mass_estimate) if "mass" in needed else by_model(stages, "mass"),
        "damping": stages.once(damping_estimate),
        "boundary_area": area,
        **{name: by_model(stages, parameter) for name, parameter in ESTIMATE_PARAMETERS.items()},
        "constant_force": by_model(stages, "constant_force"),
        "jitter_samples": jitter_estimate(stages),
    }


def _without(unit: str, reason: str) -> Estimate:
    return Estimate(value=None, unit=unit, method="none", reason=reason)
