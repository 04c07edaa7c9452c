"""Synthetic report data like chapter 6 of the thesis: shapes and sizes are realistic, numbers invented."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.records.figure_records import CostMap, Curve, DelayPanel, Figure, Limits
from pipeline.records.findings import BoundaryPoint, Estimate, Optimum
from pipeline.records.models import ComparisonRow, Motion
from pipeline.records.results import ComparisonResult, ExperimentResult, ReportData, TheoryParameters
from pipeline.records.score_records import BoundScore
from pipeline.rendering.labels import criterion_label

CRITERIA = ("settle_2pct", "overshoot", "energy_step_w0", "energy_step_w1", "energy_step_w2")
MINIMA = {"settle_2pct": 20.0, "energy_step_w0": 8.87, "energy_step_w1": 64.68, "energy_step_w2": 726.1}
BOUND = BoundScore(
    stiffness=38000,
    stiffness_low=37000,
    stiffness_high=39000,
    slope=230,
    slope_low=220,
    slope_high=240,
    damping_low=100,
    damping_high=160,
    dampings=16,
    cut=0.2,
    p_value=1e-9,
)
"""Linear upper bound in the manner of (6.5)."""
HOSTILE = "<script>alert('x')</script> & $K_1$"


def limit(damping: Any, size: float = 1.0) -> Any:
    """Stiffness at the stability boundary: a parabola over 0..150 Ns/m that reaches 9000 N/m at B = 85."""
    b = np.asarray(damping, dtype=float) / (150 * size)
    return np.maximum(9000 * size * 4 * b * (1 - b) * (0.6 + 0.7 * b), 0.0)


def cost(criterion: str, k: Any, b: Any, size: float = 1.0) -> Any:
    """A cost with one minimum near (5000, 82), infinite at the boundary; overshoot zero at low stiffness."""
    inside = limit(b, size) - k
    x, y = k / (9000 * size), b / (150 * size)
    distance = (x - 0.55) ** 2 * 4 + (y - 0.55) ** 2 * 9
    if criterion == "overshoot":
        value = np.maximum(1.4 * (x - 0.45) + 2.5 * (y - 0.6) ** 2, 0) + 0.02 * np.maximum(x - 0.5, 0)
    else:
        value = MINIMA[criterion] * (1 + distance * 3 + 0.02 * 9000 / np.maximum(inside, 30))
        value = np.ceil(value) if criterion.startswith("settle") else value
    return np.where(inside > 0, value, np.nan)


def boundary(label: str, kind: str, size: float = 1.0, noise: float = 0.0, seed: int = 0) -> Curve:
    b = np.linspace(0, 150 * size, 400) if kind == "theory" else np.arange(0, 150 * size, 4.0)
    k = limit(b, size) + noise * np.random.default_rng(seed).normal(size=b.size)
    if kind != "measured":
        return Curve(label, kind, k, b)
    return Curve(label, kind, np.maximum(np.round(k / 200) * 200, 0), b, (b > 140 * size).astype(float))


def best(k: Any, b: Any, values: Any) -> Optimum:
    least = values == np.nanmin(values)  # of equal ones the largest stiffness, as for the overshoot
    index = int(np.argmax(np.where(least, k, -np.inf)))
    return Optimum(
        stiffness=float(k.ravel()[index]), damping=float(b.ravel()[index]), cost=float(values.ravel()[index])
    )


def cost_map(label: str, kind: str, criterion: str, size: float = 1.0, seed: int = 1) -> CostMap:
    rng = np.random.default_rng(seed)
    top = 9500 * size
    k = np.linspace(0, top, 251) if kind == "theory" else np.arange(200.0, top, 160.0)
    b = np.linspace(0, 150 * size, 251) if kind == "theory" else np.arange(0.0, 150 * size, 3.0)
    grid_k, grid_b = np.meshgrid(k, b)
    values = cost(criterion, grid_k, grid_b, size)
    empty = np.zeros(0)
    trials = (empty, empty, empty)
    if kind == "measured":
        noisy = values * (1 + 0.04 * rng.normal(size=values.shape)) if criterion != "overshoot" else values
        values = np.where(rng.random(values.shape) < 0.03, np.nan, noisy)
        known = np.isfinite(values)
        trials = (grid_k[known], grid_b[known], values[known])
    edge = boundary("stability boundary", kind, size)
    return CostMap(label, kind, k, b, values, edge, best(grid_k, grid_b, values), *trials)


def cost_figure(criterion: str, size: float = 1.0) -> Figure[CostMap]:
    maps = (
        cost_map("theory, d = 4", "theory", criterion, size),
        cost_map("experiment 1 (Falcon A)", "measured", criterion, size * 0.95, 1),
        cost_map("experiment 2 (Falcon B)", "measured", criterion, size * 0.9, 2),
    )
    return Figure(
        "maps",
        f"cost-{criterion}-{round(100 * size)}",
        criterion_label(criterion).split(" [")[0],
        "Contour lines of the cost and, below, the least cost for each stiffness. Theory for m = 0.58 kg, "
        "b = 4 Ns/m, k = 0 and d = 4.",
        maps,
        criterion,
    )


def boundary_figures() -> tuple[Figure[Limits], ...]:
    measured = tuple(
        boundary(f"experiment {i} (Falcon {'ABB'[i - 1]})", "measured", 1 - 0.03 * i, 60, i) for i in (1, 2, 3)
    )
    theory = tuple(boundary(f"d = {d}", "theory", 4.5 / (d + 0.5)) for d in (3, 4, 5, 6))
    line = Curve("linear condition (6.5)", "linear", np.array([0.0, 9000.0]), np.array([150.0, 90.0]))
    grips = tuple(boundary(f"experiment {i}", "measured", 1 + 0.1 * i, 60, i) for i in (1, 4, 6))
    grips_theory = tuple(boundary(f"theory, experiment {i}", "theory", 1.05 + 0.14 * i) for i in (1, 4, 6))
    lwr = tuple(boundary(f"d = {d}", "theory", 2.5 / (d + 0.5)) for d in range(2, 9))
    lwr_measured = tuple(boundary(f"d = {d}", "measured", 2.0 / (d + 0.6), 40, d) for d in range(2, 9))
    return (
        Figure(
            "boundaries",
            "bound-devices",
            "Stability boundaries without operator",
            "Measured against theory for m = 0.58 kg, d = 3 to 6.",
            (("", (*measured, *theory, line)),),
        ),
        Figure(
            "boundaries",
            "bound-grip",
            "Influence of the operator",
            "Measured (solid) and theoretical (dashed).",
            (("(a) Falcon A", (*grips, *grips_theory, line)), ("(b) Falcon B", (*grips, line))),
        ),
        Figure(
            "boundaries",
            "bound-delay",
            "Influence of delay",
            "Theory left, experiment right.",
            (("theory", lwr), ("experiment", lwr_measured)),
        ),
    )


def delay_figure() -> Figure[DelayPanel]:
    d = np.arange(2.0, 9.0)
    panels = []
    for criterion, c, w in (("settle_2pct", 5.0, 0), ("energy_step_w0", 2.8, 0), ("energy_step_w1", 4.5, 1)):
        theory = c * (d + 1) ** (w + 1)
        measured = theory * (1 + 0.05 * np.sin(3 * d))
        measured[3] = np.nan
        panels.append(DelayPanel(criterion, d, theory, theory * 0.95, "theory, δ = 0.02", measured))
    return Figure(
        "delay", "delay", "Optimal cost over delay", "Measured optima (plus signs) follow theory.", tuple(panels)
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
        theory=TheoryParameters(
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
            for condition, value, deviation in (
                ("theory_discrete", theory, None),
                ("experiment", theory * 1.1, 10.0),
            ):
                gone = d == 5 and condition == "experiment" and w == 2
                result.append(
                    ComparisonRow(
                        table="D.6",
                        criterion=criterion,
                        condition=condition,
                        delay_samples=float(d),
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
    costs = tuple(cost_figure(c) for c in CRITERIA) + tuple(cost_figure(c, 1.4) for c in ("settle_2pct", "overshoot"))
    return ReportData(result, (*boundary_figures(), *costs, delay_figure()), stages=stages)


def bare(data: ReportData) -> ReportData:
    """The same device with nothing measured: every optional section loses its data."""
    empty = data.result.model_copy(
        update={
            "experiments": (),
            "tables": (),
            "summary": (),
            "warnings": (),
            "simulated": False,
            "provenance": {},
        }
    )
    return replace(data, result=empty, figures=(), stages=())


def document_without_places(path: Path) -> dict:
    """Result of a comparison without what names folders: it is to be the same wherever it was made."""
    document = json.loads(path.read_text())
    del document["report"]
    for key in ("key", "command"):
        del document["provenance"][key]
    return document
