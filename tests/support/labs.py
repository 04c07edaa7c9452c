"""A lab: courses of one device, simulated, written and ingested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.comparison.compare import run, write_report
from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.models import Device
from pipeline.records.results import ComparisonResult
from pipeline.simulation.sweep import SimulatedSweep, run_sweep, write_sweep
from pipeline.store.storage import read_trials


@dataclass(frozen=True)
class Outcome:
    """Document of a comparison (None where it was only planned), its stages, and the report."""

    result: ComparisonResult | None
    stages: tuple[tuple[str, str, str], ...]
    report: Path | None


def compare(device: str | Device, processed: Path, *, report: Path | None = None, dry_run: bool = False, **options):
    """Plan, run and write: options are those of a selection, of a report, or the executor."""
    looks = {name: options.pop(name) for name in ("full", "scene_file", "figures") if name in options}
    how = {name: options.pop(name) for name in ("executor",) if name in options}
    plan = plan_comparison(
        ComparisonSelection(device, processed, **options), ReportOptions(report, **looks) if report else None
    )
    if dry_run:
        return Outcome(None, plan.stages, None)
    finished = run(plan, **how)
    write_report(finished)
    return Outcome(finished.document, plan.stages, report)


@dataclass(frozen=True)
class Lab:
    """Courses of one device, with the folders of their logs and of what was ingested from them."""

    device: Device
    courses: dict[str, SimulatedSweep]
    raw: Path
    processed: Path

    def stages(self, experiment: str, processed: Path | None = None) -> ExperimentStages:
        """Stages of an experiment, with nothing kept in memory."""
        folder = processed or self.processed
        trials = read_trials(folder, self.device.name, experiment)
        return ExperimentStages(folder, self.device.name, experiment, trials)

    def compare(self, **options) -> Outcome:
        return compare(self.device.name, options.pop("processed", self.processed), **options)


def make_lab(folder: Path, device: Device, experiments: tuple[str, ...], **options) -> Lab:
    courses = {name: run_sweep(device, name, **options) for name in experiments}
    written = sum(write_sweep(course, folder / "raw") for course in courses.values())
    report = ingest([folder / "raw"], folder / "processed")
    assert report.ingested == written == report.found
    return Lab(device, courses, folder / "raw", folder / "processed")


def copied_experiments(folder: Path, device: Device, course: str, names: Sequence[str], **options) -> Path:
    """Logs of one simulated course under the names of several experiments."""
    write_sweep(run_sweep(device, course, **options), folder / "once")
    for log in sorted((folder / "once").rglob("*.csv")):
        text = log.read_text(encoding="utf-8")
        for name in names:
            copy = folder / "raw" / name / log.name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(text.replace(f"# experiment: {course}\n", f"# experiment: {name}\n"), encoding="utf-8")
    return folder / "raw"
