"""Tables of a comparison with all their digits, for other programs: names of columns, units, values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pipeline.records.criteria import criterion_of
from pipeline.records.findings import Record
from pipeline.records.models import Deviation
from pipeline.records.results import ComparisonResult
from pipeline.rendering.labels import UNITS, Units
from pipeline.rendering.table import Column, Table, Value

Row = dict[str, Value]

_LEFT_OUT = {"table", "by_method", "trend", "outliers", "deviation"}
"""Fields that hold other records or lists; the JSON document has them."""


def value_tables(result: ComparisonResult) -> tuple[Table, ...]:
    """Return Tables D.1 to D.6 (or whatever the rows are named), then what was found for each experiment.

    Values are SI, costs as in the JSON document (overshoot as a fraction). Tables without rows are left out.
    """
    units = _units(UNITS[result.motion])
    limits = dict.fromkeys(("stable", "unstable", "estimate", "low", "high", "truth"), UNITS[result.motion].stiffness)
    names = dict.fromkeys(row.table for row in result.tables)
    found = [_table(name, units, _optimal_points(result, name)) for name in names]
    found += [
        _table("estimates", units, _estimates(result)),
        _table("boundary", units | limits, _listed(result, "boundary")),
        _table("optima", units, _optima(result)),
        _table("scores", {}, _scores(result)),
        _table("loop_boundary", units, _listed(result, "loop_boundary")),
        _table("replay", {}, _listed(result, "replay")),
        _table("causes", {}, _listed(result, "causes")),
        _table("header", {}, _header(result)),
        _table("trials", {}, _counts(result)),
        _table("missing", {}, _missing(result)),
    ]
    return tuple(table for table in found if table.blocks)


def as_document(tables: Iterable[Table]) -> dict[str, Any]:
    """Return tables as a document that JSON can hold: for each its columns with units, and its rows as objects."""
    return {
        table.name: {
            "columns": [{"name": column.name, "unit": column.unit} for column in table.columns],
            "rows": table.records,
        }
        for table in tables
    }


def _units(units: Units) -> dict[str, str]:
    """Unit of each column that has one; words, counts and values without unit have none."""
    return {
        **dict.fromkeys(("stiffness", "published_stiffness"), units.stiffness),
        **dict.fromkeys(("damping", "published_damping"), units.damping),
        **dict.fromkeys(("mass", "scatter"), units.mass),
        **dict.fromkeys(("delay_samples", "settle_2pct"), "samples"),
        **dict.fromkeys(("deviation_percent", *(f"deviation_{part}" for part in Deviation.model_fields)), "%"),
        "window_s": "s",
    }


def _table(name: str, units: Mapping[str, str], rows: Iterable[Row]) -> Table:
    listed = list(rows)
    table = Table(name, "", [Column(column, unit=units.get(column, "")) for row in listed[:1] for column in row])
    for number, row in enumerate(listed):
        table.add(str(number), row)
    return table


def _fields(record: Record) -> Row:
    return {name: value for name, value in record if name not in _LEFT_OUT}


def _cost_unit(criterion: str) -> Row:
    """The unit of a cost, which differs from row to row; an overshoot is a fraction, whatever it is printed in."""
    return {"cost_unit": criterion_of(criterion).family.unit}


def _optimal_points(result: ComparisonResult, name: str) -> Iterator[Row]:
    for row in result.tables:
        if row.table == name:
            parts = {f"deviation_{part}": getattr(row.deviation, part, None) for part in Deviation.model_fields}
            yield _fields(row) | parts | _cost_unit(row.criterion)


def _estimates(result: ComparisonResult) -> Iterator[Row]:
    for e in result.experiments:
        for quantity, best in e.estimates.items():
            for use, value in (("recommended", best), *best.by_method.items()):
                yield {"experiment": e.experiment, "quantity": quantity, "use": use, **_fields(value)}


def _header(result: ComparisonResult) -> Iterator[Row]:
    for e in result.experiments:
        for line in e.header:
            for value, trials in line.values.items():
                yield {"experiment": e.experiment, "key": line.key, "value": value, "trials": trials}


def _listed(result: ComparisonResult, field: str) -> Iterator[Row]:
    for e in result.experiments:
        found = getattr(e, field) or ()
        items = found if isinstance(found, tuple) else (found,)
        yield from ({"experiment": e.experiment, **_fields(item)} for item in items)


def _optima(result: ComparisonResult) -> Iterator[Row]:
    for e in result.experiments:
        for criterion, best in e.optimum.items():
            yield {"experiment": e.experiment, "criterion": criterion, **_fields(best), **_cost_unit(criterion)}


def _scores(result: ComparisonResult) -> Iterator[Row]:
    """Scores of measured against theory, one a row; those that are lists (bands over damping) are left to JSON."""
    for e in result.experiments:
        for scores in e.scores:
            for name, value in _leaves(scores.model_dump(mode="json")):
                yield {"experiment": e.experiment, "theory": scores.basis, "score": name, "value": value}


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


def _counts(result: ComparisonResult) -> Iterator[Row]:
    for e in result.experiments:
        for kind, counts in (("verdict", e.verdicts), ("outcome", e.outcomes)):
            for what, number in counts.items():
                yield {"experiment": e.experiment, "kind": kind, "what": what, "trials": number}


def _missing(result: ComparisonResult) -> Iterator[Row]:
    for e in result.experiments:
        for what, why in e.missing.items():
            yield {"experiment": e.experiment, "result": what, "reason": why}
