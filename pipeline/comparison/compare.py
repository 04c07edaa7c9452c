"""Plan and run a comparison of measurements with theory, and write its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import ValidationError

from pipeline.base.disk import write_text
from pipeline.base.progress import part_of_work
from pipeline.base.progress import report as report_share
from pipeline.base.provenance import code_digest, digest, sha256
from pipeline.comparison.executors import Executor
from pipeline.comparison.experiment_result import experiment_numbers, nominal_theories
from pipeline.comparison.figures.maps import departure_figures, map_figures
from pipeline.comparison.figures.responses import response_figures, trials_of, wall_figure
from pipeline.comparison.figures.trial_page import trial_page
from pipeline.comparison.ground_truth import truths
from pipeline.comparison.scene.origin import excluded_trials, log_list, provenance, request
from pipeline.comparison.scene.scene import (
    LEAVE_OUT,
    REUSE,
    RUN,
    PlannedStage,
    StoredData,
    needed_stages,
    open_scene,
    plan_measured,
)
from pipeline.comparison.scene.scene_file import plan_parts
from pipeline.comparison.stage_pool import compute_stages
from pipeline.comparison.summary.first_screen import answer, most_informative
from pipeline.comparison.summary.summary_warnings import warnings_of
from pipeline.comparison.thesis_tables_d import TableBuilder
from pipeline.device_data.published import published_bound, published_files
from pipeline.records import accuracy as measured_accuracy
from pipeline.records.accuracy import AccuracyReport
from pipeline.records.findings import Note
from pipeline.records.models import ComparisonRow, Device, Shown
from pipeline.records.results import ComparisonResult, ExperimentNumbers, ExperimentResult, Truth
from pipeline.rendering.figures.boundaries import answer_figure, boundary_figures
from pipeline.rendering.figures.drawing import Figure, write_figures
from pipeline.rendering.figures.overview import delay_figure, replay_figure, sensitivity_figure, trend_figure
from pipeline.rendering.report.report import ReportData, answer_lines
from pipeline.rendering.report.report import write as write_page
from pipeline.store.objects import origin
from pipeline.store.storage import missing_inputs
from pipeline.theory.predictions import Predictions, Theory

REPORT_BEGINS = 0.9
"""Usual share of the run time of a comparison after which its report is written."""

STAGES_END, THEORY_BEGINS = 0.6, 0.95
"""Usual shares of the time before the report, which the progress display uses.

The first is reached when the stages of several experiments are complete, the second when only theory remains.
"""


@dataclass(frozen=True)
class ComparisonSelection:
    """Selection of the data that are compared.

    Parameters
    ----------
    device : str or Device
        Device name as in the logs, which need not be a known one, or a device as described by its device file.
    processed : Path
        Folder that `ingest` filled.
    experiments, criteria : sequence of str, optional
        Experiments and criteria to compare. By default, all stored experiments and all of `models.CRITERIA`.
    shown : Shown
        Figures, tables and overlays. By default, all with available data. Only what they need is computed.
    truth : mapping of experiment to Truth
        Ground truth of simulated experiments that lack a ``truth.json``.
    notes : sequence of Note
        Notes of users on experiments and trials. Document and report repeat them.
    """

    device: str | Device
    processed: Path
    experiments: Sequence[str] | None = None
    criteria: Sequence[str] | None = None
    shown: Shown = field(default_factory=Shown)
    truth: Mapping[str, Truth] = field(default_factory=dict)
    notes: Sequence[Note] = ()


@dataclass(frozen=True)
class ReportOptions:
    """Location and appearance of a report.

    Parameters
    ----------
    path : Path
        HTML file. The document is written next to it with the extension ``.json``.
    full : bool
        Whether the report includes the response of every trial, even if it becomes large.
    scene_file : Path, optional
        File from which the content was read. The report names it in the command that repeats the comparison.
    figures : Path, optional
        Folder for the report's figures as SVG, PDF and CSV. They are written even if the report is unchanged.
    """

    path: Path
    full: bool = False
    scene_file: Path | None = None
    figures: Path | None = None

    @property
    def words(self) -> list[str]:
        """Options of the command that writes the report again."""
        return [*(["--scene", str(self.scene_file)] if self.scene_file else []), *(["--full"] if self.full else [])]


@dataclass(frozen=True, eq=False)
class ComparisonPlan:
    """Planned computations of a comparison, with reasons.

    Parameters
    ----------
    selection : ComparisonSelection
    report : ReportOptions or None
    data : StoredData
        Stored data.
    stages : tuple of PlannedStage
    key : str
        Hash of all inputs of the report.
    unchanged : ComparisonResult or None
        Document of the existing report, if neither the report nor its figures must be written again. Otherwise None.
    theories : mapping of experiment to Theory
        Theory based on the device file.
    predictions : Predictions
    accuracy : AccuracyReport or None
    """

    selection: ComparisonSelection
    report: ReportOptions | None
    data: StoredData
    stages: tuple[PlannedStage, ...]
    key: str
    unchanged: ComparisonResult | None
    theories: Mapping[str, Theory]
    predictions: Predictions
    accuracy: AccuracyReport | None


@dataclass(frozen=True, eq=False)
class FinishedComparison:
    """Document of a comparison. If it is recomputed, it comes with the theory of each experiment."""

    plan: ComparisonPlan
    document: ComparisonResult
    theories: Mapping[str, Theory] = field(default_factory=dict)


def plan_comparison(selection: ComparisonSelection, report: ReportOptions | None = None) -> ComparisonPlan:
    """Return what a comparison will compute. Nothing is computed or written.

    Parameters
    ----------
    selection : ComparisonSelection
    report : ReportOptions, optional
        Options of the report. Without them, only the stages below ``processed`` are written.

    Raises
    ------
    DeviceError, UsageError, StoreError
        If the request does not match the stored data. See `scene.open_scene`.
    """
    processed, shown = selection.processed, selection.shown
    data = open_scene(selection.device, processed, selection.experiments, selection.criteria, shown)
    data = replace(data, truth=truths(data.experiments, selection.truth))
    plan, predictions = plan_measured(data), Predictions(processed / "theory")
    accuracy = measured_accuracy.stored(processed)
    key = _report_key(data, report, accuracy.measured if accuracy else "", selection.notes)
    stored = _stored_result(report, key)
    if stored is not None and any(each.action == RUN for each in plan):
        stored = None
    if stored is not None:
        unchanged = "the report and all its inputs are unchanged"
        stages = (*plan, *(PlannedStage(name, REUSE, unchanged) for name in ("theory", "report")))
        return ComparisonPlan(selection, report, data, stages, key, stored, {}, predictions, accuracy)
    theories = nominal_theories(data)
    plan += _plan_theory(data, theories, predictions)
    if report is None:
        plan.append(PlannedStage("report", LEAVE_OUT, "no report is requested"))
    else:
        plan += plan_parts(data)
        plan.append(PlannedStage("report", RUN, "there is no report, or its content has changed"))
    return ComparisonPlan(selection, report, data, tuple(plan), key, None, theories, predictions, accuracy)


def run(plan: ComparisonPlan, executor: Executor = compute_stages) -> FinishedComparison:
    """Compute a planned comparison of stored experiments with theory. Its stages are stored.

    Parameters
    ----------
    plan : ComparisonPlan
    executor : Executor
        Function that computes the stages. By default, processes on this machine compute them.
    """
    if plan.unchanged is not None:
        return FinishedComparison(plan, plan.unchanged)
    data, theories, processed = plan.data, plan.theories, plan.selection.processed
    lost = missing_inputs(processed, data.scene.device)
    builder = TableBuilder(data, theories)
    with part_of_work("", 0.0, REPORT_BEGINS), plan.predictions as predictions:
        if data.device is not None:
            predictions.start(builder.requests())
        numbers, count = [], len(data.experiments)
        before = STAGES_END if count > 1 else 0.0
        with part_of_work("trials of all experiments", 0.0, before):
            executor(data.experiments, needed_stages(data))
        for number, stages in enumerate(data.experiments):
            begin, end = (before + (THEORY_BEGINS - before) * place / count for place in (number, number + 1))
            with part_of_work(f"experiment {stages.experiment}: estimates and costs", begin, end):
                numbers.append(experiment_numbers(data, stages, theories.get(stages.experiment)))
        if data.device is None:
            theories = {each.experiment: Theory(each.theory) for each in numbers if each.theory is not None}
            builder = TableBuilder(data, theories)
            predictions.start(builder.requests())
        with part_of_work("theory: optima", THEORY_BEGINS, 1.0):
            predictions.finish()
            predictions.start(builder.damped_requests(numbers))
            predictions.finish()
    return FinishedComparison(plan, _document(plan, numbers, builder.rows(predictions, numbers), lost), theories)


def write_report(finished: FinishedComparison) -> None:
    """Write the planned report and its document, if they changed."""
    plan, result, report = finished.plan, finished.document, finished.plan.report
    if report is None or plan.unchanged is not None:
        return
    data, asked = plan.data, plan.data.scene.shown
    with part_of_work("report: figures and page", REPORT_BEGINS, 1.0):
        drawn = tuple(replace(each, simulated=data.simulated) for each in _figures(finished))
        report_share(0.5)
        has_trials = asked.has_figure("trials")
        trials = trial_page(data, result.experiments, finished.theories, full=report.full) if has_trials else None
        report_share(0.8)
        page = ReportData(
            result,
            figures=drawn,
            stages=plan.stages,
            accuracy=plan.accuracy,
            trials=trials,
            tables=asked.tables,
            request=request(data, result.logs, origin(plan.selection.processed), report_code())
            | {
                "full": report.full,
                "document": digest(result.numbers()),
                "notes": [each.model_dump() for each in result.notes],
            },
        )
        write_page(page, report.path)
        write_text(report.path.with_suffix(".json"), result.model_dump_json(indent=1) + "\n")
        if report.figures is not None:
            write_figures(drawn, report.figures)


def _figures(finished: FinishedComparison) -> Iterator[Figure]:
    """Yield the requested figures of the scene, if their data are available."""
    data, result, theories = finished.plan.data, finished.document, finished.theories
    shown, motion, headline = data.scene.shown, result.motion, result.featured
    if headline is not None and headline.boundary and shown.has_figure("boundaries"):
        number = data.scene.experiments.index(headline.experiment)
        theory = theories.get(headline.experiment) if shown.has_overlay("theory") else None
        others = [each for each in result.experiments if each is not headline]
        step = result.answer.next if result.answer is not None else None
        yield answer_figure(headline, theory, motion, number, trials_of(data.experiments[number]), others, step)
    if headline is not None and shown.has_figure("response") and (wall := _recommended(finished, headline)) is not None:
        yield wall
    known = data.device.published_as if data.device is not None else ""
    printed = published_bound(known or data.scene.device) if shown.has_overlay("linear") else None
    yield from boundary_figures(
        result.experiments, theories, motion, shown, sweep=data.scene.delay_sweep, printed=printed
    )
    if shown.has_figure("boundaries"):
        yield from sensitivity_figure(result.experiments)
    if shown.has_figure("maps"):
        yield from map_figures(data, result.experiments, theories, finished.plan.predictions)
    if shown.has_figure("delay"):
        yield from delay_figure(result.tables)
    if shown.has_figure("response"):
        yield from response_figures(data)
        yield from replay_figure(result)
    if shown.has_figure("trend"):
        yield from trend_figure(result)
    if shown.has_figure("residuals"):
        yield from departure_figures(data, theories, finished.plan.predictions)


def _recommended(finished: FinishedComparison, headline: ExperimentNumbers) -> Figure | None:
    """Return the figure of the recommended wall, or None if this wall or the theoretical optimum is missing."""
    data, theory = finished.plan.data, finished.theories.get(headline.experiment)
    if headline.use is None or theory is None:
        return None
    rows = (
        row
        for row in finished.document.tables
        if row.criterion == "settle_2pct" and row.condition == "theory_discrete" and row.cost is not None
    )
    best = next((row for row in rows if row.delay_samples == theory.loop.delay_samples), None)
    stages = data.experiments[data.scene.experiments.index(headline.experiment)]
    return None if best is None else wall_figure(stages, headline, theory, best)


def _document(
    plan: ComparisonPlan, numbers: Sequence[ExperimentNumbers], rows: tuple[ComparisonRow, ...], lost: Sequence[str]
) -> ComparisonResult:
    """Return the document. ``lost`` are damaged parts of the store."""
    data, report, store = plan.data, plan.report, origin(plan.selection.processed)
    both = zip(data.experiments, numbers, strict=True)
    answers = [answer(data, stages, each, rows) for stages, each in both]
    most = most_informative(numbers)
    logs = tuple(log_list(stages) for stages in data.experiments)
    words = report.words if report is not None else ()
    return ComparisonResult(
        device=data.scene.device,
        title=data.device.title if data.device else data.scene.device,
        motion=data.motion,
        known_device=data.device is not None,
        simulated=data.simulated,
        criteria=data.scene.criteria,
        measuring=data.scene.shown.measuring,
        experiments=tuple(
            ExperimentResult(**dict(each), answer=answer) for each, answer in zip(numbers, answers, strict=True)
        ),
        tables=rows,
        answer=answers[most],
        summary=answer_lines(answers[most], data.motion, numbers[most].sampling_period_s),
        warnings=(*lost, *warnings_of(data, numbers)),
        excluded=excluded_trials(data),
        notes=tuple(plan.selection.notes),
        report=str(report.path) if report is not None else None,
        provenance=provenance(data, logs, store, key=plan.key, code=report_code(), output=words),
        logs=logs,
    )


def _plan_theory(data: StoredData, theories: dict[str, Theory], predictions: Predictions) -> list[PlannedStage]:
    if data.device is None and not data.overlay:
        return [PlannedStage("theory", LEAVE_OUT, "the device is unknown, and no estimate of it is requested")]
    if data.device is None:
        return [PlannedStage("theory", RUN, "the device is unknown; its parameters are estimated first")]
    wanted = TableBuilder(data, theories).requests()
    missing = predictions.missing(wanted)
    plan = [PlannedStage("theory: boundaries and maps", RUN, "closed-form results are computed for every report")]
    if not wanted:
        plan.append(PlannedStage("theory: optima", LEAVE_OUT, "no table needs them"))
    elif missing:
        plan.append(PlannedStage("theory: optima", RUN, f"{len(missing)} of {len(set(wanted))} are not stored"))
    else:
        plan.append(PlannedStage("theory: optima", REUSE, f"all {len(set(wanted))} are stored"))
    if not data.scene.delay_sweep:
        plan.append(PlannedStage("delay table", LEAVE_OUT, "no experiment has added delay"))
    return plan


def report_code() -> str:
    """Return a hash of the code that writes a report and of the files that this code loads."""
    return digest([code_digest("report"), *(sha256(file.read_bytes()) for file in published_files())])


def _report_key(data: StoredData, report: ReportOptions | None, accuracy: str, notes: Sequence[Note]) -> str:
    """Return a hash of all inputs of a report.

    These are stages, exclusions, notes, device file, criteria, code and location.
    """
    needed = sorted(needed_stages(data))
    stages = [[e.experiment, *(e.key(s) for s in needed)] for e in data.experiments]
    device = data.device.model_dump_json() if data.device else ""
    excluded = [one.model_dump() for one in data.excluded]
    truth = {name: one.model_dump(mode="json") for name, one in data.truth.items()}
    where = [str(report.path), report.full] if report is not None else []
    shown = [data.scene.model_dump_json(), stages, device, report_code(), where, accuracy, excluded, truth]
    return digest([*shown, [one.model_dump() for one in notes]])


def _stored_result(report: ReportOptions | None, key: str) -> ComparisonResult | None:
    """Return the result of an earlier run if it and its report exist with the same key, and no figures are
    requested."""
    if report is None or report.figures is not None or not report.path.is_file():
        return None
    try:
        result = ComparisonResult.model_validate_json(report.path.with_suffix(".json").read_bytes())
    except (FileNotFoundError, ValidationError):
        return None  # the file is missing or has another format; therefore, it is written again
    return result if result.provenance.get("key") == key else None
