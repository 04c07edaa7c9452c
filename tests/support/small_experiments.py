"""Small experiments for tests of degenerate ones: simulated, written as native logs, ingested and compared."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from labs import compare

from pipeline.device.loop import Loop
from pipeline.intake.ingest import ingest
from pipeline.records.native import NativeHeader, format_header
from pipeline.records.results import ComparisonResult
from pipeline.records.trials import Trials
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import simulate


def trials(
    K,
    B,
    *,
    mass=0.5,
    damping=3.0,
    coulomb=0.0,
    delay_samples=2.0,
    jitter_samples=(),
    steps=4.0,
    rows=200,
    edge_row=20,
    period=1e-3,
) -> Trials:
    """One trial for each wall; ``steps`` is the step of all, or of each."""
    K, B, steps = np.broadcast_arrays(np.asarray(K, float), np.asarray(B, float), np.asarray(steps, float))
    friction = {"coulomb": coulomb} if coulomb else None
    loop = Loop(
        mass,
        damping,
        period,
        delay_samples,
        friction=friction,
        sensor={"quantum": 1e-6},
        jitter_samples=jitter_samples,
    )
    simulated = []
    for i, (k, b, step) in enumerate(zip(K, B, steps, strict=True)):
        setup = Setup(loop, step=float(step), rows=rows, edge_row=edge_row, travel=0.3)
        simulated += simulate(setup, np.array([k]), np.array([b]), seed=i)
    return Trials.of(simulated)


def write_logs(
    folder: Path, trials: Trials, *, device="dev", experiment="1", step: float | None = None, prefix="", **header
) -> Path:
    """Write native logs; ``step`` replaces the one that the header states."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, trial in enumerate(trials):
        stated = trial.step if step is None else step
        walls = trial.stiffness, trial.damping
        head = format_header(NativeHeader(device, experiment, *walls, stated, trial.sampling_period_s, **header))
        cells = np.stack([trial.time, trial.command, trial.position], axis=1)
        text = head + "".join("{:.17g},{:.17g},{:.17g}\n".format(*row) for row in cells.tolist())
        (folder / f"{prefix}{i:03d}.csv").write_text(text, encoding="utf-8")
    return folder


def compared(raw: Path, processed: Path, *, device="dev", report: Path | None = None, **options) -> ComparisonResult:
    """Ingest logs and compare them."""
    found = ingest([raw], processed)
    assert found.ingested == found.found
    result = compare(device, processed, report=report, **options).result
    assert result is not None
    return result


def compared_trials(folder: Path, trials: Trials | Sequence[Trials], **options) -> ComparisonResult:
    """Write, ingest and compare trials by one cost; the report is written too, so that its figures are drawn."""
    options.setdefault("criteria", ["settle_2pct"])
    for number, each in enumerate([trials] if isinstance(trials, Trials) else trials):
        header = {name: options.pop(name) for name in ("step", "grip", "experiment") if name in options}
        write_logs(folder / "raw", each, prefix=f"{number}-", **header)
    return compared(folder / "raw", folder / "processed", report=folder / "report.html", **options)
