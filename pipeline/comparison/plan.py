"""Plan a comparison of measurements with theory: what is computed, what is reused, and what is left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import ValidationError

from pipeline.base.provenance import code_digest, digest, sha256
from pipeline.comparison.ground_truth import truths
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
from pipeline.device_data.published import published_files
from pipeline.records import accuracy as measured_accuracy
from pipeline.records.accuracy import AccuracyReport
from pipeline.records.findings import Note
from pipeline.records.models import Device, Shown
from pipeline.records.results import ComparisonResult, Truth
from pipeline.theory.predictions import Predictions, Theory


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


def plan_comparison(selection: ComparisonSelection, report: ReportOptions | None = None) -> ComparisonPlan:
    """Return the plan of a comparison. Nothing is computed or written.

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
    from pipeline.comparison.experiment_result import nominal_theories  # takes half a second to import

    theories = nominal_theories(data)
    plan += _plan_theory(data, theories, predictions)
    if report is None:
        plan.append(PlannedStage("report", LEAVE_OUT, "no report is requested"))
    else:
        plan += plan_parts(data)
        plan.append(PlannedStage("report", RUN, "there is no report, or its content has changed"))
    return ComparisonPlan(selection, report, data, tuple(plan), key, None, theories, predictions, accuracy)


def _plan_theory(data: StoredData, theories: dict[str, Theory], predictions: Predictions) -> list[PlannedStage]:
    if data.device is None and not data.overlay:
        return [PlannedStage("theory", LEAVE_OUT, "the device is unknown, and no estimate of it is requested")]
    if data.device is None:
        return [PlannedStage("theory", RUN, "the device is unknown; its parameters are estimated first")]
    from pipeline.comparison.thesis_tables_d import TableBuilder  # takes half a second to import

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
