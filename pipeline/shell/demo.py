"""Function for `pipeline demo`, which runs all steps from simulated logs to reports in a minute."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from pipeline.base.errors import PipelineError
from pipeline.base.progress import Names, heard_by
from pipeline.comparison.compare import run, write_report
from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.shell.report_index import INDEX_FILE, write_index
from pipeline.simulation.sweep import run_sweep, write_sweep

SEED = 1
"""Seed of the simulated logs. The value is arbitrary."""


class Part(NamedTuple):
    """A device of the demo, its experiments (all if empty), and the factor by which their grids are coarsened."""

    device: str
    experiments: tuple[str, ...] = ()
    coarsen: int = 1


PARTS = (Part("falcon-real", ("1",), coarsen=4), Part("falcon", ("1", "2", "6"), coarsen=2), Part("lwr", coarsen=2))
"""Devices of the demo, with half the dampings and half the stiffness steps.

They have a quarter of the trials, and their maps look like the full ones. The first device deviates from theory as the
real device might (docs/falcon.md).
"""


def run_demo(
    folder: Path = Path("."),
    report_progress: Callable[[str], None] = lambda _: None,
    parts: Sequence[Part] | None = None,
) -> tuple[list[Path], list[str]]:
    """Simulate logs, ingest them, compare them with theory, and write one report for each device.

    Return the reports, and lines with the main results and their files.

    Parameters
    ----------
    folder : Path
        Folder for ``raw/demo``, ``processed/demo`` and ``reports`` with an index page. Logs of an earlier demo and
        reports of its devices are replaced. Other files are never changed.
    report_progress : callable
        Function that is called with a text before each step.
    parts : sequence of Part, optional
        Devices and experiments. The default is `PARTS`.

    Raises
    ------
    PipelineError
        If a file cannot be written, or a simulated log was refused.
    """
    say, began = report_progress, time.monotonic()
    parts = parts or PARTS
    raw, processed, pages = folder / "raw" / "demo", folder / "processed" / "demo", folder / "reports"
    logs = 0
    for part in parts:
        device = load_device(part.device)
        for experiment in part.experiments or [e.name for e in device.experiments]:
            say(f"simulate: {device.name}, experiment {experiment}")
            logs += write_sweep(run_sweep(device, experiment, seed=SEED, coarsen=part.coarsen), raw, overwrite=True)
    say(f"ingest: {logs} logs")
    if refused := ingest([raw], processed).quarantined:
        raise PipelineError(
            f"{refused[0].path}: {refused[0].reason} ({len(refused)} log(s) in {raw} were refused, because this folder "
            "may contain only simulated logs). Remove the file or the folder, and run the demo again."
        )
    reports, summaries = [], []
    for part in parts:
        report = pages / f"{part.device}.html"
        with heard_by(Names(lambda text, device=part.device: say(f"{device}: {text}"))):  # type: ignore[misc]
            selection = ComparisonSelection(part.device, processed, experiments=part.experiments or None)
            finished = run(plan_comparison(selection, ReportOptions(report)))
            write_report(finished)
        reports.append(report)
        summaries += [f"{finished.document.title}: {line}" for line in finished.document.summary]
    write_index(pages)
    head = f"{logs} simulated logs in {raw}, compared in {time.monotonic() - began:.0f} s; open in a browser:"
    return reports, [head, *(f"  {page}" for page in (*reports, pages / INDEX_FILE)), *summaries]
