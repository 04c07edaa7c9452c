"""Tables in the manner of D.1 to D.6: theoretical optima, measured optima, published values, deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.scores.deviation import Deviations
from pipeline.device_data.published import find
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.criteria import CRITERIA, REPORTED, criterion_of
from pipeline.records.findings import Optimum
from pipeline.records.models import ComparisonRow, Deviation, Shown, TableLayout
from pipeline.records.results import ExperimentResult
from pipeline.theory.predictions import Prediction, Predictions, Request, Theory

TABLED = tuple(c.name for c in CRITERIA.values() if c.tabled)
"""Criteria of a table for an experiment that no published table holds."""


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
    covered = {e for table in result if table.kind == "optima" for e in table.experiments}
    covered |= {e for table in result if table.kind == "delay" for e in table.experiments}
    usual = tuple(c for c in TABLED if c in asked) or tuple(c for c in REPORTED if c in asked)
    extra = tuple(c for c in asked if c not in REPORTED)  # in no published table
    least = min((added_delay(e) for e in data.experiments), default=0)
    for stages in data.experiments:
        experiment = stages.experiment
        # in a sweep of a device without layouts, one table over delay says more than one table for each delay
        swept = data.device is None and data.scene.delay_sweep and added_delay(stages) > least
        criteria = (() if experiment in covered else usual) + extra
        if criteria and not swept:
            layout = TableLayout(
                name=f"experiment {experiment}", criteria=criteria, experiments=(experiment,), theory_from=experiment
            )
            result.append(layout)
    # an overshoot of zero at every delay says nothing (Table D.6)
    sweep = tuple(c for c in (*TABLED, *extra) if c in asked and not criterion_of(c).family.levels)
    if data.device is None and data.scene.delay_sweep and sweep:
        result.append(
            TableLayout(name="delay", criteria=sweep, experiments=stored, theory_from=stored[0], kind="delay")
        )
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
                if table.kind == "delay":
                    theories = [self.theories[e] for e in table.experiments if e in self.theories]
                    result += [(t.loop, f"{criterion}_discrete") for t in theories]
                elif table.theory_from in self.theories:
                    loop = self.theories[table.theory_from].loop
                    result.append((loop, f"{criterion}_discrete"))
                    if self.data.scene.shown.has_table(table.name):
                        result.append((loop, criterion))
        return list(dict.fromkeys(result))

    def rows(self, predictions: Predictions, results: Sequence[ExperimentResult]) -> tuple[ComparisonRow, ...]:
        """Return all rows, table after table."""
        measured = {r.experiment: r for r in results}
        parts = Deviations(self.data.experiments, {r.experiment: r.optimum for r in results}, predictions)
        rows: list[ComparisonRow] = []
        for table in layouts(self.data):
            # the figure over delay is drawn from the rows, also where the table is not shown
            if table.kind == "optima" and not self.data.scene.shown.has_table(table.name):
                continue
            fill = self._delay_rows if table.kind == "delay" else self._optima_rows
            rows += fill(table, predictions, measured, parts)
        return tuple(rows)

    def _optima_rows(
        self,
        table: TableLayout,
        predictions: Predictions,
        measured: Mapping[str, ExperimentResult],
        parts: Deviations,
    ) -> list[ComparisonRow]:
        rows = []
        theory = self.theories.get(table.theory_from)
        for criterion in table.criteria:
            discrete = None if theory is None else predictions.get(theory, f"{criterion}_discrete")
            continuous = None if theory is None else predictions.get(theory, criterion)
            if theory is not None:
                delay = theory.parameters.delay_samples
                for name, found in (("discrete", discrete), ("continuous", continuous)):
                    why = predictions.why(theory, f"{criterion}_discrete" if name == "discrete" else criterion)
                    rows.append(
                        self._row(table, criterion, f"theory_{name}", delay, prediction=found, missing=why or None)
                    )
            for experiment in table.experiments:
                result = measured[experiment]
                optimum = result.optimum.get(criterion)
                if optimum is None and discrete is None:
                    continue  # nothing to show; the reason stands with the experiment
                condition = condition_of(table, experiment, self._published_size(table))
                estimated = result.estimates["delay_samples"].value
                cost = discrete.cost if discrete else None
                rows.append(
                    self._row(
                        *(table, criterion, condition, estimated),
                        experiment=experiment,
                        optimum=optimum,
                        reference=cost,
                        parts=parts.of(experiment, theory, criterion) if theory else None,
                        missing=result.missing.get(criterion),
                    )
                )
        return rows

    def _delay_rows(
        self,
        table: TableLayout,
        predictions: Predictions,
        measured: Mapping[str, ExperimentResult],
        parts: Deviations,
    ) -> list[ComparisonRow]:
        rows = []
        for experiment in table.experiments:
            theory = self.theories.get(experiment)
            result = measured[experiment]
            estimated = result.estimates["delay_samples"].value
            delay = theory.parameters.delay_samples if theory else estimated
            for criterion in table.criteria:
                discrete = None if theory is None else predictions.get(theory, f"{criterion}_discrete")
                if theory is not None:
                    why = predictions.why(theory, f"{criterion}_discrete") or None
                    rows.append(self._row(table, criterion, "theory_discrete", delay, prediction=discrete, missing=why))
                rows.append(
                    self._row(
                        *(table, criterion, "experiment", delay),
                        experiment=experiment,
                        optimum=result.optimum.get(criterion),
                        reference=discrete.cost if discrete else None,
                        parts=parts.of(experiment, theory, criterion) if theory else None,
                        missing=result.missing.get(criterion),
                    )
                )
        return rows

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
        *,
        experiment: str | None = None,
        prediction: Prediction | None = None,
        optimum: Optimum | None = None,
        reference: float | None = None,
        parts: Deviation | None = None,
        missing: str | None = None,
    ) -> ComparisonRow:
        point = prediction or optimum
        published = find(table.name, criterion, condition, delay if table.kind == "delay" else None)
        if published is not None and published.device != self.data.scene.device:
            published = None  # a table of another device may bear the same name
        notes = [missing if point is None else None, None if table.kind == "delay" else _region_note(prediction)]
        notes += [_optimum_note(criterion, optimum), published.erratum if published else None]
        cost = point.cost if point else None
        return ComparisonRow(
            table=table.name,
            criterion=criterion,
            condition=condition,
            delay_samples=delay,
            stiffness=point.stiffness if point else None,
            damping=point.damping if point else None,
            cost=cost,
            published_stiffness=published.stiffness if published else None,
            published_damping=published.damping if published else None,
            published_cost=published.cost if published else None,
            deviation_percent=_deviation(cost, reference),
            deviation=parts,
            censored=bool(optimum and optimum.censored),
            note=" ".join(n for n in notes if n) or None,
            experiment=experiment,
            trial_id=optimum.trial_id if optimum else None,
        )


def _region_note(prediction: Prediction | None) -> str | None:
    if prediction is None or prediction.region is None:
        return None
    low_k, high_k, low_b, high_b = prediction.region
    return (
        f"The optimum is a region; given is the centre of its bounding box, K from {low_k:.4g} to {high_k:.4g}, "
        f"B from {low_b:.4g} to {high_b:.4g}."
    )


def _deviation(cost: float | None, reference: float | None) -> float | None:
    """Deviation of a measured cost from the discrete theory in percent, as in Table D.6; none where theory is zero."""
    if cost is None or not reference:
        return None
    return 100 * (cost - reference) / reference


def _optimum_note(criterion: str, optimum: Optimum | None) -> str | None:
    if optimum is None:
        return None
    if optimum.ties > 1 and criterion_of(criterion).family.whole:
        return f"{optimum.ties} trials share this cost; the one nearest to the middle of them is given."
    return None
