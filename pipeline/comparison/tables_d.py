"""Tables in the manner of D.1 to D.6: theoretical optima, measured optima, published values, deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.scores.deviation import deviation_of
from pipeline.device_data.published import find
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.criteria import CRITERIA, DISCRETE, REPORTED, criterion_of
from pipeline.records.findings import Optimum
from pipeline.records.models import ComparisonRow, Deviation, Shown, TableLayout
from pipeline.records.results import ExperimentResult
from pipeline.theory.predictions import Prediction, Predictions, Request, Theory

TABLED = tuple(c.name for c in CRITERIA.values() if c.tabled)
"""Criteria of a table for an experiment that no published table holds."""

_NUMBERS = ("stiffness", "damping", "cost")


def layouts(data: SceneData) -> tuple[TableLayout, ...]:
    """Return the tables that the stored experiments can fill: published layouts, then one for each other experiment."""
    asked = data.scene.criteria
    stored = data.scene.experiments
    known = data.device.tables if data.device else ()
    result = []
    for table in known:
        experiments = tuple(e for e in table.experiments if e in stored)
        criteria = tuple(c for c in table.criteria if c in asked)
        if experiments and criteria and (table.kind == "optima" or len(experiments) > 1):
            result.append(table.model_copy(update={"experiments": experiments, "criteria": criteria}))
    covered = {e for table in result for e in table.experiments}
    usual = tuple(c for c in TABLED if c in asked) or tuple(c for c in REPORTED if c in asked)
    extra = tuple(c for c in asked if c not in REPORTED)  # in no published table
    least = min((added_delay(e) for e in data.experiments), default=0)
    for stages in data.experiments:
        experiment = stages.experiment
        # in a sweep of a device without layouts, one table over delay says more than one table for each delay
        swept = data.device is None and data.scene.delay_sweep and added_delay(stages) > least
        criteria = (() if experiment in covered else usual) + extra
        if criteria and not swept:
            name = f"experiment {experiment}"
            result.append(TableLayout(name=name, criteria=criteria, experiments=(experiment,), theory_from=experiment))
    # an overshoot of zero at every delay says nothing (Table D.6)
    sweep = tuple(c for c in (*TABLED, *extra) if c in asked and not criterion_of(c).family.levels)
    if data.device is None and data.scene.delay_sweep and sweep:
        fields: dict[str, Any] = {"experiments": stored, "theory_from": stored[0], "kind": "delay"}
        result.append(TableLayout(name="delay", criteria=sweep, **fields))
    return tuple(table for table in result if _in_use(table, data.scene.shown))


def _in_use(table: TableLayout, shown: Shown) -> bool:
    """Tell whether a layout is shown as a table, or gives the figures that follow it."""
    return shown.has_table(table.name) or shown.has_figure("delay" if table.kind == "delay" else "maps")


def added_delay(stages: ExperimentStages) -> int:
    """Return the least delay that was added on purpose in the trials of an experiment, in samples."""
    return int(min(stages.trials.column("added_delay_samples").to_pylist()))


def condition_of(table: TableLayout, experiment: str, published_experiments: int) -> str:
    """Return the name of a measured row: ``experiment`` if the table has only one, else ``experiment_<name>``."""
    return "experiment" if published_experiments == 1 or table.kind == "delay" else f"experiment_{experiment}"


@dataclass(frozen=True)
class TableBuilder:
    """Fills tables from theory and measured optima.

    Parameters
    ----------
    data : SceneData
    theories : mapping of experiment to Theory
        Theory for each experiment (and for those whose parameters a table names); missing where none can be had.
    """

    data: SceneData
    theories: Mapping[str, Theory]

    def requests(self) -> list[Request]:
        """Return all theoretical optima that the tables need."""
        result: list[Request] = []
        for table in layouts(self.data):
            for criterion in table.criteria:
                leading = table.experiments if table.kind == "delay" else (table.theory_from,)
                for loop in (self.theories[e].loop for e in leading if e in self.theories):
                    result.append((loop, f"{criterion}{DISCRETE}"))
                    if table.kind != "delay" and self.data.scene.shown.has_table(table.name):
                        result.append((loop, criterion))
        return list(dict.fromkeys(result))

    def rows(self, predictions: Predictions, results: Sequence[ExperimentResult]) -> tuple[ComparisonRow, ...]:
        """Return all rows, table after table: of each criterion those of theory, then the experiments."""
        measured = {r.experiment: r for r in results}
        stages = {e.experiment: e for e in self.data.experiments}

        @cache  # an experiment may stand in several tables
        def made_of(experiment: str, leader: str, criterion: str) -> Deviation | None:
            theory, best = self.theories.get(leader), measured[experiment].optimum.get(criterion)
            return deviation_of(stages[experiment], best, theory, criterion, predictions) if theory else None

        rows: list[ComparisonRow] = []
        for table in layouts(self.data):
            over_delay = table.kind == "delay"
            # the figure over delay is drawn from the rows, also where the table is not shown
            if not (over_delay or self.data.scene.shown.has_table(table.name)):
                continue
            leading = table.experiments if over_delay else (table.theory_from,)
            for leader, criterion in product(leading, table.criteria):
                theory, discrete = self.theories.get(leader), None
                if theory is not None:
                    discrete = predictions.get(theory, f"{criterion}{DISCRETE}")
                    kinds = (DISCRETE,) if over_delay else (DISCRETE, "")
                    rows += [self._theory_row(table, criterion, theory, kind, predictions) for kind in kinds]
                for experiment in (leader,) if over_delay else table.experiments:
                    result = measured[experiment]
                    # without both there is nothing to show; the reason stands with the experiment
                    if over_delay or discrete is not None or criterion in result.optimum:
                        parts = made_of(experiment, leader, criterion)
                        rows.append(self._measured_row(table, criterion, result, theory, discrete, parts))
        return tuple(rows)

    def _theory_row(
        self, table: TableLayout, criterion: str, theory: Theory, kind: str, predictions: Predictions
    ) -> ComparisonRow:
        found, why = predictions.get(theory, criterion + kind), predictions.why(theory, criterion + kind)
        condition = "theory_discrete" if kind else "theory_continuous"
        note = why if found is None else None if table.kind == "delay" else _region_note(found)
        return self._row(table, criterion, condition, theory.parameters.delay_samples, found, note)

    def _measured_row(
        self,
        table: TableLayout,
        criterion: str,
        result: ExperimentResult,
        theory: Theory | None,
        discrete: Prediction | None,
        parts: Deviation | None,
    ) -> ComparisonRow:
        of_theory = table.kind == "delay" and theory is not None
        delay = theory.parameters.delay_samples if theory and of_theory else result.estimates["delay_samples"].value
        condition = condition_of(table, result.experiment, self._published_size(table))
        best = result.optimum.get(criterion)
        about: dict[str, Any] = {"experiment": result.experiment, "deviation": parts}
        if best is None:
            return self._row(table, criterion, condition, delay, None, result.missing.get(criterion), **about)
        # none where theory is zero
        off = 100 * (best.cost - discrete.cost) / discrete.cost if discrete and discrete.cost else None
        about |= {"deviation_percent": off, "censored": best.censored, "trial_id": best.trial_id}
        return self._row(table, criterion, condition, delay, best, _optimum_note(criterion, best), **about)

    def _published_size(self, table: TableLayout) -> int:
        """Number of experiments in the published table, however many of them are stored."""
        original = [t for t in (self.data.device.tables if self.data.device else ()) if t.name == table.name]
        return len(original[0].experiments) if original else 1

    def _row(
        self,
        table: TableLayout,
        criterion: str,
        condition: str,
        delay: float | None,
        point: Prediction | Optimum | None,
        note: str | None,
        **others: Any,
    ) -> ComparisonRow:
        published = find(table.name, criterion, condition, delay if table.kind == "delay" else None)
        if published is not None and published.device != self.data.scene.device:
            published = None  # a table of another device may bear the same name
        values = {name: getattr(point, name) if point else None for name in _NUMBERS}
        stated = {f"published_{name}": getattr(published, name) if published else None for name in _NUMBERS}
        notes = (note, published.erratum if published else None)
        return ComparisonRow(
            table=table.name,
            criterion=criterion,
            condition=condition,
            delay_samples=delay,
            note=" ".join(filter(None, notes)) or None,
            **values,
            **stated,
            **others,
        )


def _region_note(prediction: Prediction) -> str | None:
    if prediction.region is None:
        return None
    low_k, high_k, low_b, high_b = prediction.region
    return (
        f"The optimum is a region; given is the centre of its bounding box, K from {low_k:.4g} to {high_k:.4g}, "
        f"B from {low_b:.4g} to {high_b:.4g}."
    )


def _optimum_note(criterion: str, optimum: Optimum) -> str | None:
    if optimum.ties > 1 and criterion_of(criterion).family.whole:
        return f"{optimum.ties} trials share this cost; the one nearest to the middle of them is given."
    return None
