"""Results of an experiment, and theories for the experiments of a scene."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Mapping

import numpy as np

from pipeline.base.disk import if_writable, read_result, write_result
from pipeline.base.progress import part_of_work
from pipeline.base.provenance import code_digest, digest
from pipeline.comparison.ground_truth import true_limits, truth_held
from pipeline.comparison.loops.departures import SHORT as OTHER_WALL
from pipeline.comparison.loops.departures import experiment_departures, other_gains, untimed
from pipeline.comparison.loops.findings import examine_loop
from pipeline.comparison.loops.loop_basis import adequate_theory, identified_device
from pipeline.comparison.loops.recording_faults import cause_of, recording_faults, unsafe_recording, words_of
from pipeline.comparison.loops.wall_replay import large_motion_limits
from pipeline.comparison.scene.origin import header_lines
from pipeline.comparison.scene.scene import StoredData, needed_stages
from pipeline.comparison.scores.scores import scores_of
from pipeline.comparison.stated_masses import mass_deviations
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
from pipeline.planning.loop_limits import linear_limits
from pipeline.records.findings import NOT_ADEQUATE, BoundaryPoint, Estimate
from pipeline.records.results import (
    ExperimentNumbers,
    LoopFindings,
    MeasuredExperiment,
    SourcedLoop,
    UseRegion,
    delay_with,
)
from pipeline.rendering.labels import Units
from pipeline.store.storage import stage_folder
from pipeline.theory.predictions import Theory

FINDINGS = "loop"
"""Prefix of the file name for the findings on a loop, in the folder of the stages."""


LOOP_BEGINS = 0.65
"""Usual share of an experiment's run time after which its stages are complete and its loop is replayed."""

USUAL_SHARES, USUAL_SHARE = {"response": 6.0, "parts": 12.0}, 0.5
"""Usual run times of stages for the progress display, in any unit, and the run time of any other stage."""


def nominal_theories(data: StoredData) -> dict[str, Theory]:
    """Return the theory based on the device file for each of its experiments.

    All experiments of the file are considered, because a table may use parameters of another experiment. An experiment
    is omitted if its delay exceeds the largest delay that the theory covers, or if no wall stabilises its loop.
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


def experiment_numbers(data: StoredData, stages: ExperimentStages, theory: Theory | None) -> ExperimentNumbers:
    """Compute and collect the required results of an experiment, except its first screen.

    Parameters
    ----------
    data : StoredData
    stages : ExperimentStages
    theory : Theory or None
        Theory based on the device file. For an unknown device, the theory is based on the estimates if the loop is
        adequate.
    """
    measured = _measured(data, stages)
    with part_of_work("", LOOP_BEGINS, 1.0):
        loop = _examined(data, stages, measured)
    if data.device is None:
        theory = adequate_theory(loop, stages)
    linear = large_motion_limits(measured, loop, stages)
    use, why = _use(measured, stages, linear)
    truth = data.truth.get(stages.experiment)
    values = truth.values if truth is not None else {}
    unsure = loop.loop is not None and not loop.loop.adequate
    if unsure and (device := stages.once(identified_loop)) is not None:
        unsure = not device.is_reliable
    estimates = {
        name: _completed(each, values.get(name), doubted=unsure and name in _OF_A_LOOP)
        for name, each in measured.estimates.items()
    }
    limits = true_limits(truth, [point.damping for point in measured.boundary])
    boundary = tuple(
        BoundaryPoint(
            damping=point.damping,
            stable=point.stable,
            unstable=point.unstable,
            censored=point.censored,
            estimate=point.estimate,
            low=point.low,
            high=point.high,
            trials=point.trials,
            undecided=point.undecided,
            stiffness_large_motion=linear.get(point.damping),
            truth=limit,
        )
        for point, limit in zip(measured.boundary, limits, strict=True)
    )
    return ExperimentNumbers(
        **(dict(measured) | dict(loop) | {"estimates": estimates, "boundary": boundary}),
        theory=theory.described if theory else None,
        scores=scores_of(measured, stages, theory, by_file=data.device is not None),
        use=use,
        use_reason=why or None,
        masses=mass_deviations(measured, data.device, theory.loop if data.device is not None and theory else None),
        truth=truth,
        truth_held=truth_held(_judged(estimates, loop).values(), boundary) if truth is not None else None,
    )


def _judged(estimates: Mapping[str, Estimate], loop: LoopFindings) -> dict[str, Estimate]:
    """Return estimates with the delay of the first screen, which is compared with its true value."""
    factor = estimates["delay_samples"]
    return {**estimates, "delay_samples": delay_with(factor, loop).model_copy(update={"truth": factor.truth})}


def _measured(data: StoredData, stages: ExperimentStages) -> MeasuredExperiment:
    """Compute the required stages of an experiment, and collect their results."""
    needed = needed_stages(data)
    ordered = sorted(needed, key=list(NEEDS).index)
    shares = np.cumsum([0.0, *(USUAL_SHARES.get(stage, USUAL_SHARE) for stage in ordered)])
    shares *= LOOP_BEGINS / shares[-1]
    for stage, begin, end in zip(ordered, shares.tolist(), shares[1:].tolist(), strict=False):
        with part_of_work("", begin, end):
            stages.table(stage)
    entry = next((e for e in (data.device.experiments if data.device else ()) if e.name == stages.experiment), None)
    limits, gains, fault = _known_points(stages), stages.once(other_gains), stages.once(unsafe_recording)
    if fault is not None or (gains is not None and gains.most):
        optimum, reason = {}, words_of(fault) if fault is not None else OTHER_WALL
        missing = dict.fromkeys(data.scene.criteria, reason)
    else:
        best = {criterion: stages.optimum(criterion, limits) for criterion in data.scene.criteria}
        optimum = {criterion: found for criterion, found in best.items() if found is not None}
        missing = {c: stages.cost(c)[1] or "no stable trial has this cost" for c in best if c not in optimum}
    periods = set(stages.trials.column("sampling_period_s").to_pylist())
    grips = sorted(set(stages.trials.column("grip").to_pylist()))
    return MeasuredExperiment(
        experiment=stages.experiment,
        configuration=entry.configuration if entry else "",
        grip=grips[0] if len(grips) == 1 else "none",
        simulated=any(stages.trials.column("simulated").to_pylist()),
        sampling_period_s=periods.pop() if len(periods) == 1 else None,
        trials=stages.trials.num_rows,
        verdicts=dict(sorted(Counter(stages.verdicts.verdict.tolist()).items())),
        outcomes=dict(Counter(stages.texts("outcome", "outcome"))) if "outcome" in needed else {},
        model_check=model_check(stages) if "model" in needed else None,
        estimates=_estimates(stages, needed, data.units),
        boundary=limits,
        optimum=optimum,
        missing=missing,
        header=header_lines(stages),
        recording=stages.once(recording_faults),
    )


def _use(
    measured: MeasuredExperiment, stages: ExperimentStages, linear: Mapping[float, float | None]
) -> tuple[UseRegion | None, str]:
    """Return the walls to use, or the reason why there are none.

    ``linear`` contains the limits for large motions if friction was found.
    """
    fault, gains = stages.once(unsafe_recording), stages.once(other_gains)
    if fault is not None:
        return None, words_of(fault)
    if gains is not None and gains.most:
        return None, OTHER_WALL
    limits = {damping: K for damping, K in linear.items() if K is not None}
    if linear and (device := stages.once(identified_device)) is not None:
        others = np.setdiff1d(stages.column("response", "damping"), [*limits])
        limits |= zip(others.tolist(), linear_limits(device.loop, others).tolist(), strict=True)
    return region_to_use(measured, stages, limits)


def _known_points(stages: ExperimentStages) -> tuple[BoundaryPoint, ...]:
    """Return the measured boundary. It has no limits if the recordings do not determine any."""
    if stages.once(unsafe_recording) is None:
        return stages.boundary_points
    return tuple(
        BoundaryPoint(
            damping=each.damping,
            stable=None,
            unstable=None,
            censored=True,
            trials=each.trials,
            undecided=each.undecided,
        )
        for each in stages.boundary_points
    )


_OF_A_LOOP = ("delay_samples", "mass", "damping", "device_stiffness")
"""Estimates that are valid only if the loop is adequate."""


def _examined(data: StoredData, stages: ExperimentStages, measured: MeasuredExperiment) -> LoopFindings:
    """Return the loop and its consequences. The stored ones are used if all inputs are unchanged.

    Simulating the identified device at the tested walls takes longer than reading all stages.
    """
    if "device" not in needed_stages(data):
        gains = stages.once(other_gains)
        causes = [cause_of(each) for each in measured.recording if each.is_unsafe]
        return LoopFindings(
            optimum=measured.optimum, causes=(*causes, *([] if gains is None or gains.few else [gains.cause]))
        )
    device = data.device.model_dump_json() if data.device else ""
    keys = [stages.key(stage) for stage in sorted(NEEDS)]
    key = digest([measured.model_dump_json(), device, code_digest("report"), *keys])
    folder = stage_folder(stages.processed, stages.device, stages.experiment)
    stored = json.loads(read_result(folder, FINDINGS, ".json") or b"{}")
    if stored.get("key") == key:
        return LoopFindings.model_validate(stored["findings"])
    found = examine_loop(measured, stages, data.device, data.units)
    with if_writable():
        document = {"key": key, "findings": found.model_dump(mode="json")}
        write_result(folder, FINDINGS, ".json", json.dumps(document, allow_nan=False).encode())
    return found


def _completed(estimate: Estimate, truth: float | None, *, doubted: bool) -> Estimate:
    """Return an estimate with its true value, and with a warning if it depends on a loop that is not adequate."""
    doubt = f"{NOT_ADEQUATE}, so its interval may be too narrow" if doubted and estimate.value is not None else ""
    warning = "; ".join(filter(None, [estimate.warning, doubt])) or None
    return estimate.model_copy(update={"truth": truth, "warning": warning})


def _estimates(stages: ExperimentStages, needed: Collection[str], units: Units) -> dict[str, Estimate]:
    """Return the estimates of delay, mass and damping of an experiment, and the estimates derived from its boundary.

    If the recordings do not show the delay, only the area of the boundary remains, or no estimate.
    """
    area = boundary_area(stages.boundary_points, f"{units.stiffness} {units.damping}")
    if "device" not in needed:
        why = "left out: neither a requested criterion nor a theory curve needs it"
        of = {"delay_samples": "samples", "mass": units.mass, "damping": units.damping}
        return {name: _without(unit, why) for name, unit in of.items()} | {"boundary_area": area}
    estimates = {
        "delay_samples": stages.once(delay_estimate),
        "mass": stages.once(mass_estimate) if "mass" in needed else by_model(stages, "mass"),
        "damping": stages.once(damping_estimate),
        "boundary_area": area,
        **{name: by_model(stages, parameter) for name, parameter in ESTIMATE_PARAMETERS.items()},
        "constant_force": by_model(stages, "constant_force"),
        "jitter_samples": jitter_estimate(stages),
    }
    fault = stages.once(unsafe_recording)
    reason = words_of(fault) if fault is not None else untimed(stages.once(experiment_departures))
    if not reason:
        return estimates
    return {
        name: each if name == "boundary_area" and fault is None else _without(each.unit, reason)
        for name, each in estimates.items()
    }


def _without(unit: str, reason: str) -> Estimate:
    return Estimate(value=None, unit=unit, method="none", reason=reason)
