"""Synthetic report data like chapter 6 of the thesis: shapes and sizes are realistic, numbers invented."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.records.findings import BoundaryPoint, Estimate, Optimum
from pipeline.records.models import ComparisonRow, Motion
from pipeline.records.results import ComparisonResult, ExperimentResult, SourcedLoop
from pipeline.rendering.figures.boundaries import limits_figure, limits_panel
from pipeline.rendering.figures.drawing import Figure, Panel, Series
from pipeline.rendering.report.report import ReportData

CRITERIA = ("settle_2pct", "overshoot", "energy_step_w0", "energy_step_w1", "energy_step_w2")
MINIMA = {"settle_2pct": 20.0, "energy_step_w0": 8.87, "energy_step_w1": 64.68, "energy_step_w2": 726.1}
HOSTILE = "<script>alert('x')</script> & $K_1$"


def limit(damping: Any, size: float = 1.0) -> Any:
    """Stiffness at the stability boundary: a parabola over 0..150 Ns/m that reaches 9000 N/m at B = 85."""
    b = np.asarray(damping, dtype=float) / (150 * size)
    return np.maximum(9000 * size * 4 * b * (1 - b) * (0.6 + 0.7 * b), 0.0)


def figures() -> tuple[Figure, ...]:
    """Limits of three experiments with theory, and costs over delay: ten panels in all."""
    b = np.arange(0.0, 150, 4.0)
    series = [Series(f"experiment {n}", "measured", limit(b, 1 - 0.03 * n), b, number=n) for n in range(3)]
    series += [Series(f"_theory {n}", "theory", limit(b, 1.05 - 0.03 * n), b, number=n) for n in range(3)]
    panels = [limits_panel(f"({name})", series, "translation") for name in "abc"]
    delays = np.arange(2.0, 9.0)
    over = [
        Panel(
            c, ("delay d [samples]", c), (Series("theory", "line", delays, 5 * (delays + 1)),), f"Costs {c} over delay."
        )
        for c in CRITERIA
    ]
    return (
        limits_figure("Stability limits", "Measured against theory.", panels, "boundaries-all"),
        limits_figure("Influence of delay", "Theory left.", panels[:2], "boundaries-delay"),
        Figure("delay", "delay", "Optimal cost over delay", "Theory.", tuple(over), size=(440.0, 300.0)),
    )


def estimate(value: float | None, unit: str, reason: str | None = None) -> Estimate:
    if value is None:
        return Estimate(value=None, unit=unit, method="none", reason=reason)
    other = Estimate(value=1.07 * value, low=value, high=1.2 * value, unit=unit, method="momentum balance", trials=212)
    return Estimate(
        value=value,
        low=0.97 * value,
        high=1.04 * value,
        unit=unit,
        method="corrected momentum",
        trials=212,
        by_method={"momentum balance": other},
    )


def experiment(name: str, grip: str = "none") -> ExperimentResult:
    b = np.arange(0.0, 148.0, 4.0)
    points = tuple(
        BoundaryPoint(
            damping=float(x),
            stable=float(round(k)) if k > 0 else None,
            unstable=float(round(k)) + 200,
            censored=bool(x > 140),
        )
        for x, k in zip(b, limit(b), strict=True)
    )
    return ExperimentResult(
        experiment=name,
        configuration="Falcon A" if name == "1" else "Falcon B",
        grip=grip,
        simulated=True,
        trials=2135,
        verdicts={"stable": 2063, "unstable": 70, "undecided": 2},
        estimates={
            "delay_samples": estimate(4.0, "samples"),
            "mass": estimate(0.58, "kg"),
            "damping": estimate(None, "Ns/m", "no logs with K = 0 and B <= 0 in this experiment"),
        },
        boundary=points,
        optimum={"settle_2pct": Optimum(stiffness=5200, damping=64, cost=20, ties=3, censored=True)},
        missing={"energy_step_w0": "the mass could not be estimated", "settle_1pct": "band below a quantum"},
        theory=SourcedLoop(
            mass=0.58, damping=4, stiffness=0, sampling_period_s=0.001, delay_samples=4, source="device file"
        ),
    )


def rows() -> tuple[ComparisonRow, ...]:
    result = []
    for table, names in (("D.1", ("settle_2pct", "overshoot")), ("D.2", CRITERIA[2:])):
        for criterion in names:
            c = MINIMA.get(criterion, 0.0)
            for n, condition in enumerate(("theory_discrete", "theory_continuous", "experiment_1", "experiment_2")):
                measured = condition.startswith("exp")
                result.append(
                    ComparisonRow(
                        table=table,
                        criterion=criterion,
                        condition=condition,
                        delay_samples=None,
                        stiffness=4469.3 + 300 * n,
                        damping=73.05 if not measured else 64.0,
                        cost=c * (1.2 - 0.1 * n),
                        published_stiffness=4469 + 200 * n,
                        published_damping=73.05,
                        published_cost=c,
                        deviation_percent=-16.7 + n if measured and c else None,
                        censored=condition == "experiment_2",
                        note="the printed value is a known erratum" if n == 0 else None,
                    )
                )
    return tuple(result)


def delay_rows() -> tuple[ComparisonRow, ...]:
    result = []
    for d in range(2, 9):
        for criterion, c, w in (
            ("settle_2pct", 5.0, 0),
            ("energy_step_w0", 2.8, 0),
            ("energy_step_w1", 4.5, 1),
            ("energy_step_w2", 12.0, 2),
        ):
            theory = c * (d + 1) ** (w + 1)
            for condition, value, deviation in (("theory_discrete", theory, None), ("experiment", theory * 1.1, 10.0)):
                gone = d == 5 and condition == "experiment" and w == 2
                result.append(
                    ComparisonRow(
                        table="D.6",
                        criterion=criterion,
                        condition=condition,
                        delay_samples=float(d),
                        experiment=f"delay-{d}" if condition == "experiment" else None,
                        stiffness=None,
                        damping=None,
                        cost=None if gone else value,
                        published_cost=theory * 0.99,
                        deviation_percent=None if gone else deviation,
                        note="no stable trial with this cost" if gone else None,
                    )
                )
    return tuple(result)


def report_data(*, full: bool = True, motion: Motion = "translation", hostile: bool = False) -> ReportData:
    name = HOSTILE if hostile else "falcon"
    result = ComparisonResult(
        device=name,
        title=f"{name}: course of experiments" if hostile else "Novint Falcon",
        motion=motion,
        known_device=True,
        simulated=True,
        criteria=CRITERIA,
        experiments=(experiment("1"), experiment(HOSTILE if hostile else "2"), experiment("6", "firm")),
        tables=(*rows(), *delay_rows()),
        summary=(
            "The measured optimal settling time is 20 samples; theory predicts 24 (deviation −16.7 %).",
            "Measured energy costs lie 20 to 43 % below theory; the optimum moves with w as predicted.",
            "The measured stability boundary follows d = 3 near the origin and d = 4 as a whole.",
        ),
        warnings=("Experiment 2: 3 optima lie at the edge of the tested range; they bound the true optimum only.",),
        provenance={
            "pipeline.version": "0.1.0",
            "input sha-256": "f" * 64,
            "command": "pipeline compare --device falcon",
        },
    )
    stages = (
        ("response", "run", "2 new logs"),
        ("mass", "reuse", "nothing changed"),
        ("delay table", "leave out", "no delay sweep"),
    )
    if not full:
        return ReportData(result, stages=stages)
    return ReportData(result, figures(), stages=stages)


def bare(data: ReportData) -> ReportData:
    """The same device with nothing measured: every optional section loses its data."""
    empty = data.result.model_copy(
        update={"experiments": (), "tables": (), "summary": (), "warnings": (), "simulated": False, "provenance": {}}
    )
    return replace(data, result=empty, figures=(), stages=())


def document_without_places(path: Path) -> dict:
    """Result of a comparison without what names folders: it is to be the same wherever it was made."""
    document = json.loads(path.read_text())
    del document["report"]
    for key in ("key", "command"):
        del document["provenance"][key]
    return document
