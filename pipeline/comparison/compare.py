"""Measured against theoretical: the one place where both branches meet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.base.disk import write_text
from pipeline.base.progress import part_of_work
from pipeline.base.progress import report as report_share
from pipeline.base.provenance import code_digest, digest, sha256
from pipeline.comparison.executors import Executor
from pipeline.comparison.experiment_result import estimated_theories, experiment_result, nominal_theories
from pipeline.comparison.figures.maps import departure_figures, map_figures
from pipeline.comparison.figures.responses import response_figures, trials_of, wall_figure
from pipeline.comparison.figures.trial_page import trial_page
from pipeline.comparison.ground_truth import add_ground_truth, truths
from pipeline.comparison.scene.origin import excluded_trials, log_list, provenance, request
from pipeline.comparison.scene.scene import (
    LEAVE_OUT,
    REUSE,
    RUN,
    PlannedStage,
    SceneData,
    needed_stages,
    open_scene,
    plan_measured,
)
from pipeline.comparison.scene.scene_file import plan_parts
from pipeline.comparison.scores.scores import add_scores
from pipeline.comparison.stage_pool import compute_stages
from pipeline.comparison.summary.first_screen import answer, told_most
from pipeline.comparison.summary.summary_warnings import warnings_of
from pipeline.comparison.thesis_tables_d import TableBuilder
from pipeline.device_data.published import published_bound, published_files
from pipeline.records import accuracy as measured_accuracy
from pipeline.records.findings import Note
from pipeline.records.models import ComparisonRow, Device, Shown
from pipeline.records.results import ComparisonResult, ExperimentResult, Truth
from pipeline.rendering.figures.boundaries import answer_figure, boundary_figures
from pipeline.rendering.figures.drawing import Figure, write_figures
from pipeline.rendering.figures.overview import DampedCosts, delay_figure, replay_figure, trend_figure
from pipeline.rendering.report.report import ReportData, answer_lines
from pipeline.rendering.report.report import write as write_report
from pipeline.store.objects import origin
from pipeline.store.storage import missing_inputs
from pipeline.theory.predictions import Predictions, Theory

REPORT_BEGINS = 0.9
"""Usual share of the run time of a comparison after which its report is written."""

STAGES_END, THEORY_BEGINS = 0.6, 0.95
"""Usual shares of the time before that: when the stages of several experiments are complete, and when only theory is
awaited."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a comparison: its result (None for a dry run), its stages, and the report file."""

    result: ComparisonResult | None
    stages: tuple[PlannedStage, ...]
    report: Path | None


def compare(
    device: str | Device,
    processed: Path,
    *,
    experiments: Sequence[str] | None = None,
    criteria: Sequence[str] | None = None,
    report: Path | None = None,
    dry_run: bool = False,
    full: bool = False,
    shown: Shown | None = None,
    scene_file: Path | None = None,
    truth: Mapping[str, Truth] | None = None,
    notes: Sequence[Note] = (),
    executor: Executor = compute_stages,
    figures: Path | None = None,
) -> Outcome:
    """Compare the stored experiments of a device with theory, and write the report.

    Parameters
    ----------
    device : str or Device
        Name as in the logs, possibly of an unknown device; or a device as its device file describes it.
    processed : Path
        Folder that `ingest` filled.
    experiments, criteria : sequence of str, optional
        Experiments and criteria to compare; by default all stored ones, and all of `models.CRITERIA`.
    report : Path, optional
        HTML file to write, with the result as JSON next to it (same name, ``.json``); without it only the stages below
        ``processed`` are written.
    dry_run : bool
        True to return only the plan.
    full : bool
        True to include the response of every trial in the report, even if the report becomes large.
    shown : Shown, optional
        Figures, tables and overlays of the report; by default all for which data are available.
    scene_file : Path, optional
        File from which ``shown`` was read; the report names it in the command that repeats the comparison.
    truth : mapping of experiment to Truth, optional
        Ground truth of simulated experiments whose ``truth.json`` is missing.
    notes : sequence of Note
        Notes of users on experiments and trials, which document and report repeat.
    executor : Executor
        Computes the stages; by default, processes on this machine do.
    figures : Path, optional
        Folder for the report's figures as SVG, PDF and CSV; written again even if the report is unchanged.

    Returns
    -------
    Outcome

    Raises
    ------
    DeviceError, UsageError, StoreError
        If the request does not match the stored data; see `scene.open_scene`.
    """
    data = open_scene(device, processed, experiments, criteria, shown)
    data = replace(data, truth=truths(data.experiments, truth or {}))
    plan = plan_measured(data)
    predictions = Predictions(processed / "theory")
    accuracy = measured_accuracy.stored(processed)
    key = _report_key(data, report, accuracy.measured if accuracy else "", full, notes)
    stored = _stored_result(report, key)
    if stored is not None and figures is None and all(p.action != RUN for p in plan):
        unchanged = "the report and all its inputs are unchanged"
        plan += [PlannedStage(name, REUSE, unchanged) for name in ("theory", "report")]
        return Outcome(None if dry_run else stored, tuple(plan), report)
    early = nominal_theories(data)
    plan += _plan_theory(data, early, predictions)
    if report is None:
        plan.append(PlannedStage("report", LEAVE_OUT, "no report file is asked for"))
    else:
        plan += plan_parts(data)
        plan.append(PlannedStage("report", RUN, "there is none, or something that it shows changed"))
    if dry_run:
        return Outcome(None, tuple(plan), None)

    lost = missing_inputs(processed, data.scene.device)
    with part_of_work("", 0.0, REPORT_BEGINS):
        found = _compute(data, early, predictions, executor)
    output = [*(["--scene", str(scene_file)] if scene_file else []), *(["--full"] if full else [])]
    logs = tuple(log_list(stages) for stages in data.experiments)
    entries = provenance(data, logs, origin(processed), key=key, code=report_code(), output=output)
    more = {"report": str(report) if report else None, "provenance": entries, "logs": logs, "notes": tuple(notes)}
    result = _result(data, found, lost, more)
    if report is not None:
        with part_of_work("report: figures and page", REPORT_BEGINS, 1.0):
            asked = data.scene.shown
            drawn = tuple(replace(f, simulated=data.simulated) for f in _figures(data, result, found, predictions))
            report_share(0.5)
            trials = trial_page(data, found.results, found.theories, full=full) if asked.has_figure("trials") else None
            report_share(0.8)
            page = ReportData(
                result,
                figures=drawn,
                stages=tuple(plan),
                accuracy=accuracy,
                trials=trials,
                tables=asked.tables,
                request=request(data, result.logs, origin(processed), report_code())
                | {"full": full, "document": digest(result.numbers()), "notes": [one.model_dump() for one in notes]},
            )
            write_report(page, report)
            write_text(report.with_suffix(".json"), result.model_dump_json(indent=1) + "\n")
            if figures is not None:
                write_figures(drawn, figures)
    return Outcome(result, tuple(plan), report)


def _figures(data: SceneData, result: ComparisonResult, found: _Found, predictions: Predictions) -> Iterator[Figure]:
    """Yield the requested figures of the scene for which data are available."""
    shown, motion, told = data.scene.shown, result.motion, result.told
    if told is not None and told.boundary and shown.has_figure("boundaries"):
        number = data.scene.experiments.index(told.experiment)
        theory = found.theories.get(told.experiment) if shown.has_overlay("theory") else None
        yield answer_figure(told, theory, motion, number, trials_of(data.experiments[number]))
    if told is not None and shown.has_figure("response") and (wall := _recommended(data, told, found)) is not None:
        yield wall
    known = data.device.published_as if data.device is not None else ""
    printed = published_bound(known or data.scene.device) if shown.has_overlay("linear") else None
    yield from boundary_figures(
        result.experiments, found.theories, motion, shown, sweep=data.scene.delay_sweep, printed=printed
    )
    if shown.has_figure("maps"):
        yield from map_figures(data, result.experiments, found.theories, predictions)
    if shown.has_figure("delay"):
        yield from delay_figure(found.rows, found.damped)
    if shown.has_figure("response"):
        yield from response_figures(data)
        yield from replay_figure(result)
    if shown.has_figure("trend"):
        yield from trend_figure(result)
    if shown.has_figure("residuals"):
        yield from departure_figures(data, found.theories, predictions)


def _recommended(data: SceneData, told: ExperimentResult, found: _Found) -> Figure | None:
    """Return the figure of the recommended wall; None without such a wall or without a theoretical optimum."""
    theory = found.theories.get(told.experiment)
    if told.use is None or theory is None:
        return None
    rows = (row for row in found.rows if row.criterion == "settle_2pct" and row.condition == "theory_discrete")
    best = next((row for row in rows if row.cost is not None and row.delay_samples == theory.loop.delay_samples), None)
    stages = data.experiments[data.scene.experiments.index(told.experiment)]
    return None if best is None else wall_figure(stages, told, theory, best)


@dataclass(frozen=True)
class _Found:
    """Results of the experiments with their scores and theories, rows of the tables, costs over delay."""

    results: Sequence[ExperimentResult]
    theories: dict[str, Theory]
    rows: tuple[ComparisonRow, ...]
    damped: DampedCosts


def _compute(
    data: SceneData,
    theories: dict[str, Theory],
    predictions: Predictions,
    executor: Executor,
) -> _Found:
    """Compute estimates and scores; theory is computed in parallel, or afterwards if the device is unknown."""
    builder = TableBuilder(data, theories)
    with predictions:
        if data.device is not None:
            predictions.start(builder.requests())
        results, count = [], len(data.experiments)
        before = STAGES_END if count > 1 else 0.0
        with part_of_work("trials of all experiments", 0.0, before):
            executor(data.experiments, needed_stages(data))
        for number, stages in enumerate(data.experiments):
            begin, end = (before + (THEORY_BEGINS - before) * place / count for place in (number, number + 1))
            with part_of_work(f"experiment {stages.experiment}: estimates and costs", begin, end):
                results.append(experiment_result(data, stages, theories.get(stages.experiment)))
        if data.device is None:
            theories = estimated_theories(results, data)
            builder = TableBuilder(data, theories)
            predictions.start(builder.requests())
            own = {name: theory.described for name, theory in theories.items()}
            results = [r.model_copy(update={"theory": own.get(r.experiment)}) for r in results]
        with part_of_work("theory: optima", THEORY_BEGINS, 1.0):
            predictions.finish()
            damped = builder.damped(predictions, results) if data.scene.shown.has_figure("delay") else {}
    rows = builder.rows(predictions, results)
    scored = add_scores(data, results, theories)
    known = [add_ground_truth(result, data.truth.get(result.experiment)) for result in scored]
    return _Found(known, theories, rows, damped)


def _result(data: SceneData, found: _Found, lost: Sequence[str], more: dict[str, Any]) -> ComparisonResult:
    """Return the document; ``more`` are its non-numeric entries, ``lost`` damaged parts of the store."""
    both = zip(data.experiments, found.results, strict=True)
    answers = [answer(data, stages, result, found.rows) for stages, result in both]
    results = [r.model_copy(update={"answer": told}) for r, told in zip(found.results, answers, strict=True)]
    result = ComparisonResult(
        device=data.scene.device,
        title=data.device.title if data.device else data.scene.device,
        motion=data.motion,
        known_device=data.device is not None,
        simulated=data.simulated,
        criteria=data.scene.criteria,
        measuring=data.scene.shown.measuring,
        experiments=tuple(results),
        tables=found.rows,
        answer=answers[told_most(results)],
        summary=(),
        warnings=(*lost, *warnings_of(data, found.results)),
        excluded=excluded_trials(data),
        **more,
    )
    return result.model_copy(update={"summary": answer_lines(result)})


def _plan_theory(data: SceneData, theories: dict[str, Theory], predictions: Predictions) -> list[PlannedStage]:
    if data.device is None and not data.overlay:
        return [PlannedStage("theory", LEAVE_OUT, "the device is not known, and no estimate of it is asked for")]
    if data.device is None:
        return [PlannedStage("theory", RUN, "the device is not known: its parameters are estimated first")]
    wanted = TableBuilder(data, theories).requests()
    missing = predictions.missing(wanted)
    plan = [PlannedStage("theory: boundaries and maps", RUN, "closed form, drawn again with every report")]
    if not wanted:
        plan.append(PlannedStage("theory: optima", LEAVE_OUT, "no table asks for one"))
    elif missing:
        plan.append(PlannedStage("theory: optima", RUN, f"{len(missing)} of {len(set(wanted))} are not stored"))
    else:
        plan.append(PlannedStage("theory: optima", REUSE, f"all {len(set(wanted))} are stored"))
    if not data.scene.delay_sweep:
        plan.append(PlannedStage("delay table", LEAVE_OUT, "no experiment has added delay"))
    return plan


def report_code() -> str:
    """Return a hash of the code that makes a report and of the files that it loads."""
    return digest([code_digest("report"), *(sha256(file.read_bytes()) for file in published_files())])


def _report_key(data: SceneData, path: Path | None, accuracy: str, full: bool, notes: Sequence[Note]) -> str:
    """Return a hash of all inputs of a report: stages, exclusions, notes, device file, criteria, code and location."""
    needed = sorted(needed_stages(data))
    stages = [[e.experiment, *(e.key(s) for s in needed)] for e in data.experiments]
    device = data.device.model_dump_json() if data.device else ""
    excluded = [one.model_dump() for one in data.excluded]
    truth = {name: one.model_dump(mode="json") for name, one in data.truth.items()}
    shown = [data.scene.model_dump_json(), stages, device, report_code(), str(path), accuracy, full, excluded, truth]
    shown += [[one.model_dump() for one in notes]]
    return digest(shown)


def _stored_result(path: Path | None, key: str) -> ComparisonResult | None:
    """Return the result of an earlier run if report and result exist and have the same key."""
    if path is None or not path.is_file():
        return None
    try:
        result = ComparisonResult.model_validate_json(path.with_suffix(".json").read_bytes())
    except (FileNotFoundError, ValidationError):
        return None  # missing, or in another format: it is written again
    return result if result.provenance.get("key") == key else None
