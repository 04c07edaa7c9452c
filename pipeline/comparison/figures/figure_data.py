"""Arrays behind the figures: boundaries, cost maps and the delay sweep, measured beside theory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np

from pipeline.comparison.compare_experiment import motion_of
from pipeline.comparison.figures.boundary_curves import measured_curve, theory_curve
from pipeline.comparison.figures.figure_boundaries import answer_figure, boundary_figures
from pipeline.comparison.figures.figure_optima import optimal_curve
from pipeline.comparison.figures.figure_residuals import residual_figures
from pipeline.comparison.figures.figure_response import response_figures
from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.scene.scene_parts import with_overlays
from pipeline.comparison.tables_d import layouts
from pipeline.loop.loop import LARGEST_DELAY, Loop
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.criteria import criterion_of
from pipeline.records.delay_rows import delay_points
from pipeline.records.figure_records import CostMap, Curve, DelayPanel, Figure, Limits
from pipeline.records.findings import Optimum
from pipeline.records.models import ComparisonRow, FigureKind, TableLayout
from pipeline.records.results import Answer, ExperimentResult, TheoryParameters
from pipeline.rendering.labels import criterion_label, table_label
from pipeline.theory.cost.maps import cost_maps
from pipeline.theory.predictions import Predictions, Request, Theory

MAP_POINTS = 101
"""Grid points along each axis of a drawn map; finer ones change no contour visibly."""

DAMPED = 0.02
"""Relative damping delta of the second theory curve of Fig. 6.12, the upper end of the range of 3.3."""

FIGURES = {"D.1": "6.5", "D.2": "6.6", "D.3": "6.7", "D.4": "6.10", "D.5": "6.11"}
"""Figure of the thesis whose optima a table holds; other tables are drawn as the first two."""

NO_TRIALS = (np.empty(0), np.empty(0), np.empty(0))


def shows_damped(data: SceneData) -> bool:
    """Tell whether a scene shows the damped curve of Fig. 6.12: in the delay figure, or in the scores."""
    return data.scene.shown.has_figure("delay") or data.scene.shown.has_table("scores")


def requests_of_delay_figure(data: SceneData, theories: Mapping[str, Theory]) -> list[Request]:
    """Return the theoretical optima of the damped curve of the delay figure, where that is shown."""
    if not shows_damped(data):
        return []
    return [
        (Loop(0.0, DAMPED, theories[e].parameters.delay_samples), f"{criterion}_discrete")
        for table in layouts(data)
        if table.kind == "delay"
        for e in table.experiments
        if e in theories
        for criterion in table.criteria
    ]


@dataclass(frozen=True)
class FigureBuilder:
    """Builds the figures of a scene from finished results."""

    data: SceneData
    theories: Mapping[str, Theory]
    results: Sequence[ExperimentResult]
    told: Answer | None = None

    def asked(self, rows: Sequence[ComparisonRow], predictions: Predictions) -> tuple[Figure[Any], ...]:
        """Return all figures that the scene asks for, as far as there is data for them."""
        shown = self.data.scene.shown
        builders: dict[FigureKind, Callable[[], tuple[Figure[Any], ...]]] = {
            "maps": lambda: self.costs(predictions),
            "delay": lambda: self.delays(rows, predictions),
            "response": lambda: response_figures(self.data, motion_of(self.data)),
            "residuals": lambda: residual_figures(self.data, self.theories),
        }
        found = list[Figure[Any]](with_overlays((*self.answered(), *self.boundaries()), shown))
        for kind, build in builders.items():
            found += build() if shown.has_figure(kind) else ()
        return tuple(replace(figure, simulated=self.data.simulated) for figure in found)

    def answered(self) -> Iterator[Figure[Limits]]:
        """Yield the picture beside the answer, where there is one and a limit to draw."""
        name = self.told.experiment if self.told else ""
        for result in self.results:
            if self.told and result.experiment == name and result.boundary:
                yield answer_figure(self.data, self.told, self.theories.get(name), result)

    def boundaries(self) -> tuple[Figure[Limits], ...]:
        """Return boundary figures: without and with operator, over delay, from the estimates, and normalised."""
        return boundary_figures(self.data, self.theories, self.results)

    def costs(self, predictions: Predictions) -> tuple[Figure[CostMap], ...]:
        """Return one cost figure for each criterion of each table of optima."""
        stages = {e.experiment: e for e in self.data.experiments}
        figures: dict[str, Figure[CostMap]] = {}
        for table in layouts(self.data):
            if table.kind == "delay":
                continue
            theory = self.theories.get(table.theory_from)
            shown = [r for r in self.results if r.experiment in table.experiments]
            maps = _theory_maps(theory, shown, table.criteria, predictions) if theory else {}
            for criterion in table.criteria:
                panels = [maps[criterion]] if theory else []
                panels += [_measured_map(r, stages[r.experiment], criterion) for r in shown if criterion in r.optimum]
                if not panels:
                    continue
                listed = self.data.scene.shown.has_table(table.name)
                figure = _cost_figure(table, criterion, tuple(panels), theory, listed=listed)
                # experiments "a b" and "a-b" would share an identifier, and so references into each other's drawing
                taken = (f"{figure.identifier}-{n}" if n > 1 else figure.identifier for n in count(1))
                name = next(name for name in taken if name not in figures)
                figures[name] = replace(figure, identifier=name)
        return tuple(figures.values())

    def delays(self, rows: Sequence[ComparisonRow], predictions: Predictions) -> tuple[Figure[DelayPanel], ...]:
        """Return the figure of optimal costs over delay, if there is a sweep."""
        caption = "Costs of the sampled response at the optimum, theory and experiment. In the manner of Fig. 6.12."
        figures = []
        for table in layouts(self.data):
            shown = [r for r in rows if r.table == table.name] if table.kind == "delay" else []
            panels = [self._delay_panel(shown, criterion, predictions) for criterion in table.criteria]
            known = tuple(panel for panel in panels if len(panel.delay_samples))
            if known:
                figures.append(Figure("delay", "delay", "Optimal costs over delay", caption, known))
        return tuple(figures)

    def _delay_panel(self, rows: Sequence[ComparisonRow], criterion: str, predictions: Predictions) -> DelayPanel:
        points = [p for p in delay_points([r for r in rows if r.criterion == criterion]) if p.delay is not None]
        delays = np.array([p.delay for p in points], dtype=np.float64)
        theory = np.array([_cost(p.theory.get(criterion)) for p in points])
        measured = np.array([_cost(p.measured.get(criterion)) for p in points])
        damped = np.array([self._damped_cost(float(d), criterion, predictions) for d in delays])
        return DelayPanel(criterion, delays, theory, damped, f"theory, δ = {DAMPED:g}", measured)

    def _damped_cost(self, delay: float, criterion: str, predictions: Predictions) -> float:
        if delay > LARGEST_DELAY:
            return np.nan
        parameters = TheoryParameters(
            mass=1.0, damping=DAMPED, stiffness=0.0, sampling_period_s=1.0, delay_samples=delay, source="normalised"
        )
        return predictions.get(Theory(parameters), f"{criterion}_discrete").cost


def _cost(row: ComparisonRow | None) -> float:
    return np.nan if row is None or row.cost is None else row.cost


def _theory_maps(
    theory: Theory, shown: Sequence[ExperimentResult], criteria: Sequence[str], predictions: Predictions
) -> dict[str, CostMap]:
    """Maps of theory by criterion over its stable region and all that was tested."""
    points = [point for result in shown for point in result.boundary]
    p, border, units = theory.parameters, theory.boundary, theory.units
    stiffest = max([border.alpha_max * units.stiffness, *(p.unstable or p.stable or 0.0 for p in points)])
    dampings = [border.beta_max * units.damping, *(p.damping for p in points)]
    stiffness = np.linspace(0, stiffest, MAP_POINTS)
    damping = np.linspace(min(0.0, *dampings), max(dampings), MAP_POINTS)
    costs = cost_maps(theory.loop, stiffness / units.stiffness, damping / units.damping, criteria)
    label = f"theory, d = {p.delay_samples:g}, m = {p.mass:.3g}, b = {p.damping:.3g}"
    maps = {}
    for criterion, cost in costs.items():
        found = predictions.get(theory, f"{criterion}_discrete")
        optimum = Optimum(stiffness=found.stiffness, damping=found.damping, cost=found.cost)
        curves = _optimal_curves(stiffness, damping, cost, criterion, exact=True)
        edge = theory_curve(theory, "boundary")
        maps[criterion] = CostMap(label, "theory", stiffness, damping, cost, edge, optimum, *NO_TRIALS, *curves)
    return maps


def _optimal_curves(
    stiffness: Floats, damping: Floats, cost: Floats, criterion: str, *, exact: bool
) -> tuple[Curve, Curve]:
    """Best damping for each stiffness and best stiffness for each damping, where the map has costs on both sides."""
    smooth = exact and criterion_of(criterion).family.smooth
    b, b_inside = optimal_curve(damping, cost, smooth=smooth)
    k, k_inside = optimal_curve(stiffness, cost.T, smooth=smooth)
    return (
        Curve("best damping", "optimal", stiffness, np.where(b_inside, b, np.nan)),
        Curve("best stiffness", "optimal", np.where(k_inside, k, np.nan), damping),
    )


def _measured_map(result: ExperimentResult, stages: ExperimentStages, criterion: str) -> CostMap:
    cost = stages.sure_cost(criterion)
    k, b = stages.column("response", "stiffness"), stages.column("response", "damping")
    shown = (k > 0) & (stages.verdicts.verdict != "unstable")
    k, b, cost = k[shown], b[shown], cost[shown]
    levels = np.unique(b) if len(b) else np.zeros(1)
    optimum = result.optimum.get(criterion)
    axis = _stiffness_axis(k, len(levels), optimum)
    grid = np.full((len(levels), len(axis)), np.nan)
    for row, level in enumerate(levels):
        at = np.flatnonzero((b == level) & np.isfinite(cost))
        if len(at) > 1:
            order = at[np.argsort(k[at], kind="stable")]
            # along K a course is dense enough to interpolate; beyond its first and last trial nothing is claimed
            grid[row] = np.interp(axis, k[order], cost[order], left=np.nan, right=np.nan)
    name = f"experiment {result.experiment}" + (f", {result.configuration}" if result.configuration else "")
    curves = _optimal_curves(axis, levels, grid, criterion, exact=False)
    return CostMap(name, "measured", axis, levels, grid, measured_curve(result), optimum, k, b, cost, *curves)


def _stiffness_axis(stiffness: Floats, levels: int, optimum: Optimum | None) -> Floats:
    """Stiffness values that were tried at a tenth of the dampings or more, and that of the optimum.

    The second pass of a course refines each column around its own limit only; as grid lines those values would be gaps.
    """
    values, count = np.unique(stiffness, return_counts=True)
    common = values[count >= min(max(2, 0.1 * levels), count.max(initial=1))]
    axis = np.union1d(common, [optimum.stiffness] if optimum else [])
    return axis if len(axis) > 1 else np.array([0.0, 1.0])


def _cost_figure(
    table: TableLayout, criterion: str, panels: tuple[CostMap, ...], theory: Theory | None, *, listed: bool
) -> Figure[CostMap]:
    name = criterion_label(criterion)
    label = table_label(table.name)
    optima = f" Optima as in {label if label != table.name else f'the table of {label}'}." if listed else ""
    thesis = FIGURES.get(table.name, criterion_of(criterion).family.figure)
    return Figure(
        "maps",
        re.sub(r"[^A-Za-z0-9_-]", "-", f"{table.name}-{criterion}"),
        f"Cost maps, {name}",
        f"Costs of the sampled response in the stable region{', theory left' if theory else ''}; below, the least cost "
        f"for each stiffness and all trials.{optima} In the manner of Fig. {thesis}.",
        panels,
        criterion,
        f"costs, {label}",
    )
