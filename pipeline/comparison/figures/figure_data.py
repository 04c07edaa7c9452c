"""Arrays behind the figures: boundaries, cost maps and the delay sweep, measured beside theory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np

from pipeline.comparison.compare_experiment import motion_of
from pipeline.comparison.figures.cost_figures import measured_map, theory_maps
from pipeline.comparison.figures.figure_boundaries import answer_figure, boundary_figures
from pipeline.comparison.figures.figure_residuals import residual_figures
from pipeline.comparison.figures.figure_response import response_figures
from pipeline.comparison.figures.figure_trend import trend_figures
from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.scene.scene_parts import with_overlays
from pipeline.comparison.tables_d import layouts
from pipeline.loop.loop import LARGEST_DELAY, Loop
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.criteria import criterion_of
from pipeline.records.delay_rows import delay_points
from pipeline.records.figure_records import CostMap, DelayPanel, Figure, Limits
from pipeline.records.models import ComparisonRow, FigureKind, TableLayout
from pipeline.records.results import ExperimentResult, TheoryParameters
from pipeline.rendering.labels import criterion_label, table_label
from pipeline.theory.predictions import Predictions, Request, Theory

DAMPED = 0.02
"""Relative damping delta of the second theory curve of Fig. 6.12, the upper end of the range of 3.3."""

FIGURES = {"D.1": "6.5", "D.2": "6.6", "D.3": "6.7", "D.4": "6.10", "D.5": "6.11"}
"""Figure of the thesis whose optima a table holds; other tables are drawn as the first two."""


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
    told: ExperimentResult | None = None

    def asked(self, rows: Sequence[ComparisonRow], predictions: Predictions) -> tuple[Figure[Any], ...]:
        """Return all figures that the scene asks for, as far as there is data for them."""
        shown = self.data.scene.shown
        builders: dict[FigureKind, Callable[[], tuple[Figure[Any], ...]]] = {
            "maps": lambda: self.costs(predictions),
            "delay": lambda: self.delays(rows, predictions),
            "response": lambda: response_figures(self.data, motion_of(self.data)),
            "trend": lambda: trend_figures(self.results, motion_of(self.data)),
            "residuals": lambda: residual_figures(self.data, self.theories, predictions),
        }
        found = list[Figure[Any]](with_overlays((*self.answered(), *self.boundaries()), shown))
        for kind, build in builders.items():
            found += build() if shown.has_figure(kind) else ()
        return tuple(replace(figure, simulated=self.data.simulated) for figure in found)

    def answered(self) -> Iterator[Figure[Limits]]:
        """Yield the picture beside the answer, where there is one and a limit to draw."""
        if self.told and self.told.boundary:
            yield answer_figure(self.data, self.theories.get(self.told.experiment), self.told)

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
            maps = theory_maps(theory, shown, table.criteria, predictions) if theory else {}
            for criterion in table.criteria:
                panels = [maps[criterion]] if theory else []
                panels += [self._measured(r, stages, criterion, predictions) for r in shown if criterion in r.optimum]
                if not panels:
                    continue
                listed = self.data.scene.shown.has_table(table.name)
                figure = _cost_figure(table, criterion, tuple(panels), theory, listed=listed)
                # experiments "a b" and "a-b" would share an identifier, and so references into each other's drawing
                taken = (f"{figure.identifier}-{n}" if n > 1 else figure.identifier for n in count(1))
                name = next(name for name in taken if name not in figures)
                figures[name] = replace(figure, identifier=name)
        return tuple(figures.values())

    def _measured(
        self,
        result: ExperimentResult,
        stages: Mapping[str, ExperimentStages],
        criterion: str,
        predictions: Predictions,
    ) -> CostMap:
        """Map of an experiment, smoothed about its own theory where it has one."""
        own = self.theories.get(result.experiment)
        return measured_map(result, stages[result.experiment], criterion, own, predictions)

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
        found = predictions.get(Theory(parameters), f"{criterion}_discrete")
        return np.nan if found is None else found.cost


def _cost(row: ComparisonRow | None) -> float:
    return np.nan if row is None or row.cost is None else row.cost


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
