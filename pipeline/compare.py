"""Measured against theoretical: the one place where both branches meet."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from pipeline import __version__
from pipeline import accuracy as measured_accuracy
from pipeline.boundary_band import boundary_area
from pipeline.figure_data import FigureBuilder, requests_of_delay_figure
from pipeline.implied_delay import implied_delay
from pipeline.implied_slope import DeviceParameters
from pipeline.labels import UNITS, Units
from pipeline.models import CRITERIA, Estimate, Experiment, Motion, Optimum
from pipeline.predictions import THEORY_CODE, Predictions, Theory
from pipeline.provenance import code_digest, digest
from pipeline.report import write as write_report
from pipeline.results import (
    ComparisonResult,
    ExperimentResult,
    MassWindow,
    OtherDefinitions,
    ReportData,
    TheoryParameters,
)
from pipeline.scene import LEAVE_OUT, REUSE, RUN, PlannedStage, SceneData, needed_stages, open_scene, plan_measured
from pipeline.stage_columns import standard_error
from pipeline.stages import ExperimentStages
from pipeline.summary import summarise, warnings_of
from pipeline.tables import write_text
from pipeline.tables_d import TableBuilder

_REPORT_CODE = (
    *(
        "compare",
        "implied_delay",
        "implied_slope",
        "scene",
        "tables_d",
        "figure_data",
        "summary",
        "maps",
        "predictions",
        "published",
        "results",
    ),
    *("report", "report_tables", "report_estimates", "figures", "panels", "labels", "style", "models", "accuracy"),
    *THEORY_CODE,
    *("templates/report.html.j2", "templates/macros.html.j2", "templates/report.css"),
)


@dataclass(frozen=True)
class Outcome:
    """What a comparison did: its result (None for a dry run), its stages, and the report file."""

    result: ComparisonResult | None
    stages: tuple[tuple[str, str, str], ...]
    report: Path | None


def compare(
    device: str,
    processed: Path,
    *,
    experiments: Sequence[str] | None = None,
    criteria: Sequence[str] | None = None,
    report: Path | None = None,
    dry_run: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Outcome:
    """Compare the stored experiments of a device with theory, and write the report.

    Parameters
    ----------
    device : str
        Name as in the logs; it need not be known.
    processed : Path
        Folder that `ingest` filled.
    experiments, criteria : sequence of str, optional
        What to compare; by default everything that is stored, and all criteria of `models.CRITERIA`.
    report : Path, optional
        HTML file to write, with the result as JSON beside it (same name, ``.json``); without it nothing is written
        but the stages below ``processed``.
    dry_run : bool
        Whether only the plan is made.
    progress : callable, optional
        Gets the name of each step when it begins.

    Returns
    -------
    Outcome

    Raises
    ------
    DeviceError, UsageError, StoreError
        Where the request does not fit what is stored; see `scene.open_scene`.
    """
    say = progress or (lambda _: None)
    data = open_scene(device, processed, experiments, criteria)
    plan = plan_measured(data)
    predictions = Predictions(processed / "theory")
    known = data.device is not None
    early = _nominal_theories(data)
    accuracy = measured_accuracy.stored(processed)
    key = _report_key(data, report, accuracy.measured if accuracy else "")
    stored = _stored_result(report, key)
    if stored is not None and all(p.action != RUN for p in plan):
        plan += [
            PlannedStage("theory", REUSE, "the report and all that it rests on are unchanged"),
            PlannedStage("report", REUSE, "the report and all that it rests on are unchanged"),
        ]
        return Outcome(None if dry_run else stored, _rows(plan), report)
    plan += _plan_theory(data, early, predictions)
    plan.append(_plan_report(report))
    if dry_run:
        return Outcome(None, _rows(plan), None)

    builder = TableBuilder(data, early)
    if known:
        say("theory: optima (in the background)")
        predictions.start(builder.requests() + requests_of_delay_figure(data, early))
    try:
        results = []
        for stages in data.experiments:
            say(f"experiment {stages.experiment}: estimates and costs")
            results.append(_experiment(data, stages, early.get(stages.experiment)))
        if not known:
            early = _estimated_theories(results, data)
            builder = TableBuilder(data, early)
            say("theory: optima for the estimated parameters")
            predictions.start(builder.requests() + requests_of_delay_figure(data, early))
            results = [
                r.model_copy(update={"theory": early[r.experiment].parameters if r.experiment in early else None})
                for r in results
            ]
    finally:
        predictions.finish()
    rows = builder.rows(predictions, results)
    result = ComparisonResult(
        device=device,
        title=data.device.title if data.device else device,
        motion=_motion(data),
        known_device=known,
        simulated=data.simulated,
        criteria=data.scene.criteria,
        experiments=tuple(results),
        tables=rows,
        summary=summarise(data, results, rows, early),
        warnings=warnings_of(data, results, rows),
        report=str(report) if report else None,
        provenance={"key": key, "version": __version__, **_inputs(data), "command": _command(data, processed)},
    )
    if report is not None:
        say("report: figures and page")
        figures = FigureBuilder(data, early, results)
        page = ReportData(
            result,
            boundaries=figures.boundaries(),
            costs=figures.costs(predictions),
            delays=figures.delays(rows, predictions),
            stages=_rows(plan),
            accuracy=accuracy,
        )
        write_report(page, report)
        write_text(report.with_suffix(".json"), result.model_dump_json(indent=1) + "\n")
    return Outcome(result, _rows(plan), report)


def _rows(plan: Sequence[PlannedStage]) -> tuple[tuple[str, str, str], ...]:
    return tuple(p.as_row() for p in plan)


def _plan_theory(data: SceneData, theories: dict[str, Theory], predictions: Predictions) -> list[PlannedStage]:
    if data.device is None:
        return [PlannedStage("theory", RUN, "the device is not known: its parameters are estimated first")]
    wanted = TableBuilder(data, theories).requests() + requests_of_delay_figure(data, theories)
    missing = predictions.missing(wanted)
    plan = [PlannedStage("theory: boundaries and maps", RUN, "closed form, drawn anew with every report")]
    if not wanted:
        plan.append(PlannedStage("theory: optima", LEAVE_OUT, "no table asks for one"))
    elif missing:
        plan.append(PlannedStage("theory: optima", RUN, f"{len(missing)} of {len(set(wanted))} are not stored"))
    else:
        plan.append(PlannedStage("theory: optima", REUSE, f"all {len(set(wanted))} are stored"))
    if not data.scene.delay_sweep:
        plan.append(PlannedStage("delay table", LEAVE_OUT, "no experiment has added delay"))
    return plan


def _plan_report(path: Path | None) -> PlannedStage:
    if path is None:
        return PlannedStage("report", LEAVE_OUT, "no report file is asked for")
    return PlannedStage("report", RUN, "there is none, or something that it shows changed")


def _report_key(data: SceneData, path: Path | None, accuracy: str) -> str:
    """Hash of all that a report shows: stages, device file, criteria, code, and where it lies."""
    needed = sorted(needed_stages(data))
    stages = [[e.experiment, *(e.key(s) for s in needed)] for e in data.experiments]
    device = data.device.model_dump_json() if data.device else ""
    return digest([data.scene.model_dump_json(), stages, device, code_digest(*_REPORT_CODE), str(path), accuracy])


def _stored_result(path: Path | None, key: str) -> ComparisonResult | None:
    """Return the result of an earlier run if report and result are there and rest on the same key."""
    if path is None or not path.is_file():
        return None
    try:
        result = ComparisonResult.model_validate_json(path.with_suffix(".json").read_bytes())
    except (FileNotFoundError, ValidationError):
        return None  # not there, or not in this form: it is written anew
    return result if result.provenance.get("key") == key else None


def _motion(data: SceneData) -> Motion:
    return "rotation" if data.experiments[0].rotation else "translation"


def _inputs(data: SceneData) -> dict[str, str]:
    profiles = {p for e in data.experiments for p in e.trials.column("profile").unique().to_pylist()}
    logs = digest(sorted(e.inputs_digest for e in data.experiments))
    return {"logs": logs, "profiles": ", ".join(sorted(profiles))}


def _command(data: SceneData, processed: Path) -> str:
    scene = data.scene
    words = ["pipeline", "compare", "--device", scene.device]
    words += [word for experiment in scene.experiments for word in ("--experiment", experiment)]
    words += [] if scene.criteria == CRITERIA else ["--criteria", ",".join(scene.criteria)]
    return shlex.join([*words, "--processed", str(processed)])  # names come from logs and may hold anything


def _nominal_theories(data: SceneData) -> dict[str, Theory]:
    """Theory by the device file, for all of its experiments (a table may take the parameters of another one)."""
    if data.device is None:
        return {}
    device = data.device
    return {
        e.name: Theory(
            TheoryParameters(
                mass=e.mass,
                damping=e.damping,
                stiffness=e.stiffness,
                sampling_period_s=device.sampling_period_s,
                delay_samples=e.delay_samples,
                source=f"device file {device.name}",
            )
        )
        for e in device.experiments
    }


def _estimated_theories(results: Sequence[ExperimentResult], data: SceneData) -> dict[str, Theory]:
    """Theory by the estimates of each experiment, where mass, damping and delay are known."""
    theories = {}
    for result, stages in zip(results, data.experiments, strict=True):
        mass, damping, delay = (result.estimates[n].value for n in ("mass", "damping", "delay_samples"))
        if mass is None or damping is None or delay is None:
            continue
        theories[result.experiment] = Theory(
            TheoryParameters(
                mass=mass,
                damping=max(damping, 0.0),  # the theory asks for b >= 0; a negative estimate is noise about zero
                stiffness=0.0,
                sampling_period_s=stages.sampling_period_s,
                delay_samples=delay,
                source="estimated from the logs",
            )
        )
    return theories


def _experiment(data: SceneData, stages: ExperimentStages, theory: Theory | None) -> ExperimentResult:
    """Compute what is needed of one experiment and gather it."""
    needed = needed_stages(data)
    for stage in needed:
        stages.table(stage)
    units = UNITS[_motion(data)]
    named: dict[str, Experiment] = {e.name: e for e in data.device.experiments} if data.device else {}
    entry = named.get(stages.experiment)
    optimum: dict[str, Optimum] = {}
    missing: dict[str, str] = {}
    for criterion in data.scene.criteria:
        best = stages.optimum(criterion)
        if best is not None:
            optimum[criterion] = best
        else:
            missing[criterion] = stages.cost(criterion)[1] or "no stable trial has this cost"
    grips = sorted(set(stages.trials.column("grip").to_pylist()))
    return ExperimentResult(
        experiment=stages.experiment,
        configuration=entry.configuration if entry else "",
        grip=grips[0] if len(grips) == 1 else "none",
        simulated=any(stages.trials.column("simulated").to_pylist()),
        trials=stages.trials.num_rows,
        verdicts=dict(sorted(Counter(stages.verdicts.verdict.tolist()).items())),
        outcomes=dict(Counter(stages.texts("outcome", "outcome"))),
        mass_windows=_mass_windows(stages) if "windows" in needed else (),
        other_definitions=_other_definitions(stages, optimum) if {"settling", "overshoot"} <= needed else (),
        model_check=stages.model_check if "model" in needed else None,
        estimates=_estimates(stages, needed, units),
        boundary=stages.boundary_points,
        optimum=optimum,
        missing=missing,
        theory=theory.parameters if theory else None,
    )


def _estimates(stages: ExperimentStages, needed: Collection[str], units: Units) -> dict[str, Estimate]:
    """Estimates of an experiment: delay, mass and damping, and what follows from its boundary."""
    left_out = "left out: neither a criterion that was asked for nor a theory curve needs it"
    found = {
        "delay_samples": stages.delay_estimate if "delay" in needed else _without("samples", left_out),
        "mass": stages.mass_estimate if "mass" in needed else _without(units.mass, left_out),
        "damping": stages.damping_estimate if "damping" in needed else _without(units.damping, left_out),
        "boundary_area": boundary_area(stages.boundary_points, f"{units.stiffness} {units.damping}"),
    }
    mass, damping = found["mass"], found["damping"]
    if "model" in needed:
        found["jitter_samples"] = stages.jitter_estimate
    if mass.value is not None and damping.value is not None:
        device = DeviceParameters(
            mass.value, damping.value, stages.sampling_period_s, standard_error(mass), standard_error(damping)
        )
        found["implied_delay"] = implied_delay(stages.boundary_points, device)
    return found


def _mass_windows(stages: ExperimentStages) -> tuple[MassWindow, ...]:
    rows = stages.table("windows").to_pylist()
    return tuple(
        MassWindow(window_s=r["window_s"], mass=r["mass_median"], scatter=r["mass_scatter"], trials=r["trials"])
        for r in rows
    )


def _other_definitions(stages: ExperimentStages, optimum: Mapping[str, Optimum]) -> tuple[OtherDefinitions, ...]:
    """Settling time and overshoot of the best trials by the definitions of other tools."""
    settling = {row["trial_id"]: row for row in stages.table("settling").to_pylist()}
    overshoot = {row["trial_id"]: row for row in stages.table("overshoot").to_pylist()}
    found = []
    for criterion, best in optimum.items():
        both = settling[str(best.trial_id)] | overshoot[str(best.trial_id)]
        values = {name: both[name] for name in OtherDefinitions.model_fields if name in both}
        found.append(OtherDefinitions(criterion=criterion, **values))
    return tuple(found)


def _without(unit: str, reason: str) -> Estimate:
    return Estimate(value=None, unit=unit, method="none", reason=reason)
