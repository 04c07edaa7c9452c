"""Run a planned comparison of measurements with theory, and write its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from pipeline.base.disk import write_text
from pipeline.base.progress import part_of_work
from pipeline.base.progress import report as report_share
from pipeline.base.provenance import digest
from pipeline.comparison.executors import Executor
from pipeline.comparison.experiment_result import experiment_numbers
from pipeline.comparison.figures.maps import departure_figures, map_figures
from pipeline.comparison.figures.responses import response_figures, trials_of, wall_figure
from pipeline.comparison.figures.trial_page import trial_page
from pipeline.comparison.plan import ComparisonPlan, report_code
from pipeline.comparison.scene.origin import excluded_trials, log_list, provenance, request
from pipeline.comparison.scene.scene import needed_stages
from pipeline.comparison.stage_pool import compute_stages
from pipeline.comparison.summary.first_screen import answer, most_informative
from pipeline.comparison.summary.summary_warnings import warnings_of
from pipeline.comparison.thesis_tables_d import TableBuilder
from pipeline.device_data.published import published_bound
from pipeline.records.models import ComparisonRow
from pipeline.records.results import ComparisonResult, ExperimentNumbers, ExperimentResult
from pipeline.rendering.figures.boundaries import answer_figure, boundary_figures
from pipeline.rendering.figures.drawing import Figure, write_figures
from pipeline.rendering.figures.overview import delay_figure, replay_figure, sensitivity_figure, trend_figure
from pipeline.rendering.report.report import ReportData, answer_lines
from pipeline.rendering.report.report import write as write_page
from pipeline.store.objects import origin
from pipeline.store.storage import missing_inputs
from pipeline.theory.predictions import Theory

REPORT_BEGINS = 0.9
"""Usual share of the run time of a comparison after which its report is written."""

STAGES_END, THEORY_BEGINS = 0.6, 0.95
"""Usual shares of the time before the report, which the progress display uses.

The first is reached when the stages of several experiments are complete, the second when only theory remains.
"""


@dataclass(frozen=True, eq=False)
class FinishedComparison:
    """Document of a comparison. If it is recomputed, it comes with the theory of each experiment."""

    plan: ComparisonPlan
    document: ComparisonResult
    theories: Mapping[str, Theory] = field(default_factory=dict)


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
