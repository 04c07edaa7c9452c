"""Tables of a comparison with all their digits, for other programs: names of columns, units, values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from pipeline.records.models import BoundaryPoint, ComparisonRow, Estimate, Optimum, Record
from pipeline.records.results import ComparisonResult, MassWindow, OtherDefinitions
from pipeline.rendering.labels import UNITS, Units, criterion_unit

Value = str | float | int | bool | None


@dataclass(frozen=True)
class ValueTable:
    """A table as values: SI, costs as in the JSON document (overshoot as a fraction).

    Parameters
    ----------
    name : str
    columns : tuple of str
    units : tuple of str
        Unit of each column; empty for words, counts and values without unit.
    rows : tuple of tuple
        None where a value is missing.
    """

    name: str
    columns: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]

    @property
    def heads(self) -> tuple[str, ...]:
        """Names of the columns with their units in brackets."""
        return tuple(f"{c} [{u}]" if u else c for c, u in zip(self.columns, self.units, strict=True))


def value_tables(result: ComparisonResult) -> tuple[ValueTable, ...]:
    """Return Tables D.1 to D.6 (or whatever the rows are named), then what was found for each experiment.

    Tables without rows are left out.
    """
    units = UNITS[result.motion]
    found = [_table(name, ComparisonRow, units, _rows_of(result, name)) for name in _names(result)]
    found += [
        _table("estimates", Estimate, units, _estimates(result), first=("experiment", "quantity", "use")),
        _table("boundary", BoundaryPoint, units, _listed(result, "boundary"), first=("experiment",)),
        _table("optima", Optimum, units, _optima(result), first=("experiment", "criterion")),
        _table("windows", MassWindow, units, _listed(result, "mass_windows"), first=("experiment",)),
        _table("definitions", OtherDefinitions, units, _listed(result, "other_definitions"), first=("experiment",)),
        _scores(result),
        _verdicts(result),
        _missing(result),
    ]
    return tuple(table for table in found if table.rows)


_LEFT_OUT = frozenset({"table", "by_method", "trend", "outliers"})
"""Fields that hold other records or lists; the JSON document has them."""


def _table(
    name: str,
    record: type[Record],
    units: Units,
    rows: Iterable[tuple[tuple[Value, ...], Record]],
    first: tuple[str, ...] = (),
) -> ValueTable:
    """Return records as rows; ``first`` are columns before theirs."""
    fields = [f for f in record.model_fields if f not in _LEFT_OUT]
    columns = (*first, *fields)
    known = {
        "stiffness": units.stiffness,
        "published_stiffness": units.stiffness,
        "damping": units.damping,
        "published_damping": units.damping,
        "delay_samples": "samples",
        "deviation_percent": "%",
        "window_s": "s",
        "mass": units.mass,
        "scatter": units.mass,
        **dict.fromkeys(("settle_2pct", "settle_matlab_final_value"), "samples"),
        **dict.fromkeys(("settle_matlab_peak_error", "settle_python_control"), "samples"),
    }
    if record is BoundaryPoint:
        known |= dict.fromkeys(("stable", "unstable", "estimate", "low", "high"), units.stiffness)
    if record in (ComparisonRow, Optimum):
        columns = (*columns, "cost_unit")  # differs from row to row
    values = tuple(_row(before, item, fields, record in (ComparisonRow, Optimum)) for before, item in rows)
    return ValueTable(name, columns, tuple(known.get(column, "") for column in columns), values)


def _row(before: tuple[Value, ...], item: Record, fields: list[str], cost: bool) -> tuple[Value, ...]:
    values = (*before, *(getattr(item, f) for f in fields))
    if not cost:
        return values
    criterion = str(getattr(item, "criterion", before[-1] if before else ""))
    # the stored overshoot is a fraction, whatever it is printed in
    return (*values, "samples" if criterion_unit(criterion) == "samples" else "1")


def _names(result: ComparisonResult) -> list[str]:
    return list(dict.fromkeys(row.table for row in result.tables))


def _rows_of(result: ComparisonResult, name: str) -> Iterator[tuple[tuple[Value, ...], Record]]:
    yield from (((), row) for row in result.tables if row.table == name)


def _estimates(result: ComparisonResult) -> Iterator[tuple[tuple[Value, ...], Record]]:
    for e in result.experiments:
        for quantity, best in e.estimates.items():
            yield (e.experiment, quantity, "recommended"), best
            yield from (((e.experiment, quantity, name), value) for name, value in best.by_method.items())


def _listed(result: ComparisonResult, field: str) -> Iterator[tuple[tuple[Value, ...], Record]]:
    for e in result.experiments:
        yield from (((e.experiment,), item) for item in getattr(e, field))


def _optima(result: ComparisonResult) -> Iterator[tuple[tuple[Value, ...], Record]]:
    for e in result.experiments:
        yield from (((e.experiment, criterion), best) for criterion, best in e.optimum.items())


def _scores(result: ComparisonResult) -> ValueTable:
    """Scores of measured against theory, one a row; those that are lists (bands over damping) are left to JSON."""
    rows = [
        (e.experiment, scores.basis, name, value)
        for e in result.experiments
        for scores in e.scores
        for name, value in _leaves(scores.model_dump(mode="json"))
    ]
    return ValueTable("scores", ("experiment", "theory", "score", "value"), ("", "", "", ""), tuple(rows))


def _leaves(values: Any, place: str = "") -> Iterator[tuple[str, Value]]:
    """Yield name and value of all numbers and words in nested records; lists of records by their criterion."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _leaves(value, f"{place}.{key}" if place else key)
    elif isinstance(values, list):
        for value in values:
            if isinstance(value, dict) and "criterion" in value:
                rest = {key: part for key, part in value.items() if key != "criterion"}
                yield from _leaves(rest, f"{place}.{value['criterion']}")
    else:
        yield place, values


def _verdicts(result: ComparisonResult) -> ValueTable:
    rows = [
        (e.experiment, kind, what, number)
        for e in result.experiments
        for kind, count in (("verdict", e.verdicts), ("outcome", e.outcomes))
        for what, number in count.items()
    ]
    return ValueTable("trials", ("experiment", "kind", "what", "trials"), ("", "", "", ""), tuple(rows))


def _missing(result: ComparisonResult) -> ValueTable:
    rows = tuple((e.experiment, what, why) for e in result.experiments for what, why in e.missing.items())
    return ValueTable("missing", ("experiment", "result", "reason"), ("", "", ""), rows)


def as_document(tables: Iterable[ValueTable]) -> dict[str, Any]:
    """Return tables as a document that JSON can hold: for each its columns with units, and its rows as objects."""
    return {
        table.name: {
            "columns": [{"name": c, "unit": u} for c, u in zip(table.columns, table.units, strict=True)],
            "rows": [dict(zip(table.columns, row, strict=True)) for row in table.rows],
        }
        for table in tables
    }
