"""Build tables in the format of D.1 to D.6 with theoretical optima, measured optima, published values, and
deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

from pipeline.comparison.measured_damping import with_measured_damping
from pipeline.comparison.scene.scene import StoredData, layouts
from pipeline.comparison.scores.deviation import deviation_of
from pipeline.device_data.published import find, published_deviation
from pipeline.records.criteria import DISCRETE, criterion_of
from pipeline.records.findings import Optimum
from pipeline.records.models import ComparisonRow, Deviation, TableLayout
from pipeline.records.results import ExperimentNumbers
from pipeline.rendering.labels import overshoot_note
from pipeline.theory.predictions import Prediction, Predictions, Request, Theory

DAMPED = "theory_damped"
"""Condition of the rows of theory with the measured damping."""

OWN = "theory_of_"
"""Beginning of the condition of theory with the stated device of an experiment, if the theory of its table has a
different device. The name of the experiment follows."""

_NUMBERS = ("stiffness", "damping", "cost")


def condition_of(table: TableLayout, experiment: str, published_experiments: int) -> str:
    """Return the name of a measured row: ``experiment`` if the table has one experiment, else ``experiment_<name>``."""
    return "experiment" if published_experiments == 1 or table.kind == "delay" else f"experiment_{experiment}"


@dataclass(frozen=True)
class TableBuilder:
    """Builder of tables from theory and measured optima.

    Parameters
    ----------
    data : StoredData
    theories : mapping of experiment to Theory
        Theory for each experiment, and for experiments whose parameters a table names. Unavailable theories are
        missing.
    """

    data: StoredData
    theories: Mapping[str, Theory]

    def requests(self) -> list[Request]:
        """Return all theoretical optima that the tables need."""
        result: list[Request] = []
        for table in layouts(self.data):
            for criterion in table.criteria:
                for loop in (self.theories[e].normalised for e in _leading(table) if e in self.theories):
                    result.append((loop, f"{criterion}{DISCRETE}"))
                    if table.kind != "delay" and self.data.scene.shown.has_table(table.name):
                        result.append((loop, criterion))
                own = (self._own(table, experiment) for experiment in table.experiments)
                result += [(theory.normalised, f"{criterion}{DISCRETE}") for theory in own if theory is not None]
        return list(dict.fromkeys(result))

    def rows(self, predictions: Predictions, results: Sequence[ExperimentNumbers]) -> tuple[ComparisonRow, ...]:
        """Return all rows, table after table.

        For each criterion, the rows of theory come before those of the experiments. One of them has the measured
        damping of the experiment whose parameters theory uses, if it differs from the stated damping. If the stated
        device of another experiment is different, the theory of this device comes before that experiment.
        """
        measured, damped = {r.experiment: r for r in results}, self.damped(results)
        stages = {e.experiment: e for e in self.data.experiments}

        @cache  # an experiment may occur in several tables
        def made_of(experiment: str, leader: str, criterion: str) -> Deviation | None:
            theory, best = self.theories.get(leader), measured[experiment].optimum.get(criterion)
            return deviation_of(stages[experiment], best, theory, criterion, predictions) if theory else None

        rows: list[ComparisonRow] = []
        for table in self._tables():
            over_delay = table.kind == "delay"
            for leader, criterion in product(_leading(table), table.criteria):
                theory, discrete = self.theories.get(leader), None
                if theory is not None:
                    discrete = predictions.get(theory, f"{criterion}{DISCRETE}")
                    kinds = (DISCRETE,) if over_delay else (DISCRETE, "")
                    rows += [self._theory_row(table, criterion, theory, kind, predictions) for kind in kinds]
                if leader in damped:
                    rows.append(self._theory_row(table, criterion, damped[leader], DISCRETE, predictions, DAMPED))
                for experiment in (leader,) if over_delay else table.experiments:
                    result = measured[experiment]
                    # Without both, there is nothing to show. The experiment contains the reason.
                    if over_delay or discrete is not None or criterion in result.optimum:
                        parts = made_of(experiment, leader, criterion)
                        row = self._measured_row(table, criterion, result, theory, discrete, parts)
                        if (own := self._own(table, experiment)) is not None:
                            condition = f"{OWN}{experiment}"
                            rows.append(self._theory_row(table, criterion, own, DISCRETE, predictions, condition))
                            row = _with_own(row, rows[-1].cost, made_of(experiment, experiment, criterion))
                        rows.append(row)
        return tuple(rows)

    def _own(self, table: TableLayout, experiment: str) -> Theory | None:
        """Return the theory of an experiment if the theory of its table is based on a different device, otherwise
        None."""
        own, leader = self.theories.get(experiment), self.theories.get(table.theory_from)
        is_other = own is not None and leader is not None and own.loop != leader.loop
        return own if table.kind != "delay" and is_other else None

    def damped(self, results: Sequence[ExperimentNumbers]) -> dict[str, Theory]:
        """Return theory with the measured damping for each experiment whose damping differs from the stated one."""
        measured = {result.experiment: result.estimates["damping"] for result in results}
        found = {
            name: with_measured_damping(theory, measured[name])
            for name, theory in self.theories.items()
            if name in measured
        }
        return {name: theory for name, theory in found.items() if theory is not None}

    def damped_requests(self, results: Sequence[ExperimentNumbers]) -> list[Request]:
        """Return the optima that the rows with the measured damping need."""
        damped = self.damped(results)
        wanted = (
            (damped[leader].normalised, f"{criterion}{DISCRETE}")
            for table in self._tables()
            for leader in _leading(table)
            for criterion in table.criteria
            if leader in damped
        )
        return list(dict.fromkeys(wanted))

    def _tables(self) -> list[TableLayout]:
        """Return the tables with rows. The figure over delay uses its rows even if the table is not shown."""
        shown = self.data.scene.shown
        return [table for table in layouts(self.data) if table.kind == "delay" or shown.has_table(table.name)]

    def _theory_row(
        self,
        table: TableLayout,
        criterion: str,
        theory: Theory,
        kind: str,
        predictions: Predictions,
        condition: str = "",
    ) -> ComparisonRow:
        found, why = predictions.get(theory, criterion + kind), predictions.why(theory, criterion + kind)
        condition = condition or ("theory_discrete" if kind else "theory_continuous")
        note = why if found is None else None if table.kind == "delay" else _region_note(found)
        about = {"theory_mass": theory.loop.apparent().mass, "theory_damping": theory.loop.apparent().damping}
        return self._row(
            table,
            criterion,
            condition,
            theory.loop.delay_samples,
            found,
            note,
            theory_source=theory.source,
            margin=theory.margin(found) if found is not None else None,
            **about,
        )

    def _measured_row(
        self,
        table: TableLayout,
        criterion: str,
        result: ExperimentNumbers,
        theory: Theory | None,
        discrete: Prediction | None,
        parts: Deviation | None,
    ) -> ComparisonRow:
        of_theory = table.kind == "delay" and theory is not None
        delay = theory.loop.delay_samples if theory and of_theory else result.estimates["delay_samples"].value
        condition = condition_of(table, result.experiment, self._published_size(table))
        best = result.optimum.get(criterion)
        about: dict[str, object] = {"experiment": result.experiment, "deviation": parts}
        if best is None:
            return self._row(table, criterion, condition, delay, None, result.missing.get(criterion), **about)
        # The ratio is None if theory is zero.
        for name in _NUMBERS if discrete else ():
            measured, theoretical = getattr(best, name), getattr(discrete, name)
            key = "deviation_percent" if name == "cost" else f"{name}_deviation_percent"
            about[key] = 100 * (measured - theoretical) / theoretical if theoretical else None
        about |= {"censored": best.censored, "trial_id": best.trial_id, "margin": best.margin}
        return self._row(table, criterion, condition, delay, best, _optimum_note(criterion, best), **about)

    def _published_size(self, table: TableLayout) -> int:
        """Return the number of experiments in the published table, whether they are stored or not."""
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
        device = self.data.device
        own = device.published_as if device is not None and device.published_as else self.data.scene.device
        if published is not None and published.device != own:
            published = None  # another device may have a table with this name
        values = {name: getattr(point, name) if point else None for name in _NUMBERS}
        stated = {f"published_{name}": getattr(published, name) if published else None for name in _NUMBERS}
        stated["published_deviation_percent"] = published_deviation(published) if published else None
        erratum = published.erratum if published else None
        if erratum is not None and own != self.data.scene.device:
            erratum = f"Published value, for the device {own}: {erratum}"
        notes = (note, erratum)
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


def _leading(table: TableLayout) -> tuple[str, ...]:
    """Return the experiments whose parameters theory uses. Over delay, theory follows each experiment."""
    return table.experiments if table.kind == "delay" else (table.theory_from,)


def _with_own(row: ComparisonRow, theory: float | None, parts: Deviation | None) -> ComparisonRow:
    """Return a measured row with its deviations from the theoretical cost of the stated device of its experiment."""
    percent = 100 * (row.cost / theory - 1) if row.cost is not None and theory else None
    model = parts.model if parts is not None and parts.steady else None
    return row.model_copy(update={"own_deviation_percent": percent, "own_model_percent": model})


def _region_note(prediction: Prediction) -> str | None:
    if prediction.region is None:
        return None
    low_k, high_k, low_b, high_b = prediction.region
    return (
        f"The optimum is a region. The values are the centre of its bounding box, K from {low_k:.4g} to {high_k:.4g}, "
        f"B from {low_b:.4g} to {high_b:.4g}."
    )


def _optimum_note(criterion: str, optimum: Optimum) -> str | None:
    if (note := overshoot_note(optimum)) is not None:
        return note
    if optimum.ties > 1 and criterion_of(criterion).family.whole:
        return f"{optimum.ties} trials have this cost. The values are those of the trial nearest to their middle."
    return None
