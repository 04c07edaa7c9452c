"""The whole way from simulated logs to reports, in a minute: what `pipeline demo` runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.comparison.compare import compare
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.records.results import ComparisonResult
from pipeline.shell.report_index import INDEX_FILE, write_index
from pipeline.simulation.course import run_course, write_course

SEED = 1
"""Seed of the demo's logs; any would do."""


@dataclass(frozen=True)
class Part:
    """A device of the demo: its experiments (empty for all), and which share of the trials is simulated."""

    device: str
    experiments: tuple[str, ...] = ()
    coarsen: int = 1


REDUCED = (Part("falcon-real", ("1",), coarsen=4), Part("falcon", ("1", "2", "6"), coarsen=2), Part("lwr", coarsen=2))
"""Half the dampings and half the stiffness steps: a fourth of the trials, and maps that look like the full ones. First
comes a device that deviates as the real one may (docs/falcon.md)."""

FULL = (Part("falcon-real"), Part("falcon"), Part("lwr"))


@dataclass(frozen=True)
class DemoOutcome:
    """Reports that were written, and the key result with their places as lines."""

    reports: tuple[Path, ...]
    results: tuple[ComparisonResult, ...]
    lines: tuple[str, ...]


def run_demo(
    folder: Path = Path("."),
    full: bool = False,
    report_progress: Callable[[str], None] | None = None,
    parts: Sequence[Part] | None = None,
) -> DemoOutcome:
    """Simulate logs, ingest them, compare them with theory, and write one report for each device.

    Parameters
    ----------
    folder : Path
        Gets ``raw/demo``, ``processed/demo`` and ``reports`` with an index page (with ``full``: ``raw/demo-full``,
        ``processed/demo-full``). Logs of an earlier demo, and reports of its devices as
        `compare` writes them, are replaced; other files are never touched.
    full : bool
        Thesis size: all experiments and all trials.
    report_progress : callable, optional
        Gets a line before each step.
    parts : sequence of Part, optional
        Other devices and experiments than those of the two demos.

    Raises
    ------
    PipelineError
        If a file cannot be written, or a simulated log was refused.
    """
    say = report_progress or (lambda _: None)
    began = time.monotonic()
    chosen = parts if parts is not None else FULL if full else REDUCED
    name = "demo-full" if full else "demo"
    raw, processed = folder / "raw" / name, folder / "processed" / name
    logs = sum(_simulate(part, raw, say) for part in chosen)
    say(f"ingest: {logs} logs")
    report = ingest([raw], processed)
    if report.quarantined:
        first = report.quarantined[0]
        raise PipelineError(
            f"{first.path}: {first.reason} ({len(report.quarantined)} log(s) of {raw} were refused; expected "
            "only simulated ones there). Remove the file, or the folder, and run the demo again."
        )
    reports, results = [], []
    for part in chosen:
        outcome = compare(
            part.device,
            processed,
            experiments=part.experiments or None,
            report=folder / "reports" / f"{part.device}.html",
            progress=partial(_say_of, part.device, say),
        )
        assert outcome.result is not None, "only a dry run has no result"
        assert outcome.report is not None, "a report was asked for"
        reports.append(outcome.report)
        results.append(outcome.result)
    write_index(folder / "reports")
    seconds = time.monotonic() - began
    lines = [
        f"{logs} simulated logs in {raw}, compared in {seconds:.0f} s; open in a browser:",
        *(f"  {path}" for path in reports),
        f"  {folder / 'reports' / INDEX_FILE}",
        *(f"{result.title}: {line}" for result in results for line in result.summary),
    ]
    return DemoOutcome(tuple(reports), tuple(results), tuple(lines))


def _say_of(device: str, say: Callable[[str], None], text: str) -> None:
    say(f"{device}: {text}")


def _simulate(part: Part, raw: Path, say: Callable[[str], None]) -> int:
    device = load_device(part.device)
    written = 0
    for name in part.experiments or tuple(e.name for e in device.experiments):
        say(f"simulate: {device.name}, experiment {name}")
        course = run_course(device, name, seed=SEED, coarsen=part.coarsen)
        written += write_course(course, raw, overwrite=True)
    return written
