"""Estimates and limits over the experiments of a device, beside the header lines by which these differ.

A lab writes into its logs what it changed: firmware, grease, the day of the recording. Nothing rests on these lines; a
reader sees whether a number moved with one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from pipeline.records.findings import BoundaryPoint
from pipeline.records.results import ComparisonResult, ExperimentResult
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import UNITS, damping_text, span, stiffness_text
from pipeline.rendering.report.report_estimates import MAIN, estimate_cell, quantity_name, unit_text
from pipeline.rendering.table import Cell, Column, Table, missing, words

_NO_LIMIT = "no stable trial at any damping"


def differing_lines(experiments: Sequence[ExperimentResult]) -> tuple[str, ...]:
    """Return the header lines that two experiments or more have, not all with the same values."""
    values: dict[str, list[str]] = {}
    for experiment in experiments:
        for line in experiment.header:
            values.setdefault(line.key, []).append(line_text(experiment, line.key))
    return tuple(key for key, told in sorted(values.items()) if len(told) > 1 and len(set(told)) > 1)


def line_text(experiment: ExperimentResult, key: str) -> str:
    """Return what the logs of an experiment say in a header line: its value, or the first of several; else nothing."""
    line = next((line for line in experiment.header if line.key == key), None)
    if line is None:
        return ""
    return f"{next(iter(line.values))}{' …' if line.different > 1 else ''}"


def leading_line(experiments: Sequence[ExperimentResult]) -> str:
    """Return the header line by which experiments are ordered: the first that is a date in all, else the first."""
    keys = differing_lines(experiments)
    return next((key for key in keys if all(_dates(experiments, key))), keys[0])


def in_order(experiments: Sequence[ExperimentResult]) -> list[ExperimentResult]:
    """Return experiments in the order of the dates of their leading line; as they are where it has none."""
    dates = _dates(experiments, leading_line(experiments))
    if not all(dates):
        return list(experiments)
    return [experiments[n] for n in sorted(range(len(dates)), key=lambda n: (dates[n] or "", n))]


def _dates(experiments: Sequence[ExperimentResult], key: str) -> list[str | None]:
    return [_date(line_text(each, key).removesuffix(" …")) for each in experiments]


def stiffest(experiment: ExperimentResult) -> BoundaryPoint | None:
    """Return the measured limit at the damping with the largest stable stiffness."""
    known = [point for point in experiment.boundary if point.stable is not None]
    return max(known, key=lambda point: point.stable or 0.0, default=None)


def limit_of(point: BoundaryPoint | None) -> float | None:
    """Return the limit at a damping: by the growth rates where they tell it, else the largest stable stiffness."""
    if point is None or point.censored or point.estimate is None:
        return point.stable if point else None
    return point.estimate


def trend_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return estimates and the stiffest limit by experiment and header lines, or None where no line differs."""
    keys = differing_lines(result.experiments)
    if not keys:
        return None
    units = UNITS[result.motion]
    quantities = [q for q in MAIN if any(q in e.estimates for e in result.experiments)]
    unit_of = {q: e.estimates[q].unit for e in reversed(result.experiments) for q in e.estimates}
    columns = [words("experiment"), *(words(f"line/{key}", key) for key in keys)]
    columns += [Column("limit", "stiffest limit", units.stiffness)]
    columns += [Column(q, quantity_name(q), unit_text(unit_of[q]), why="not asked for") for q in quantities]
    caption = "Limits and estimates with 95 % intervals over the experiments, beside header lines that differ"
    table = Table("trend", caption, columns)
    for e in in_order(result.experiments):
        values: dict[str, Any] = {f"line/{key}": line_text(e, key) or missing("no such line") for key in keys}
        values |= {q: estimate_cell(table, e.estimates[q]) for q in quantities if q in e.estimates}
        table.add(e.experiment, values | {"experiment": e.experiment, "limit": _limit_cell(stiffest(e))})
    return table.filled


def _limit_cell(point: BoundaryPoint | None) -> Cell:
    limit = limit_of(point)
    if point is None or limit is None:
        return missing(_NO_LIMIT)
    bound = "\N{GREATER-THAN OR EQUAL TO} " if point.censored else ""
    interval = span(stiffness_text, point.low, point.high)
    aside = f"at B = {damping_text(point.damping)}" + (f"; {interval}" if interval else "")
    return Cell(limit, f"{bound}{stiffness_text(limit)}", aside=aside)


def _date(text: str) -> str | None:
    """Return a date in ISO 8601, which sorts as text does; None for another text."""
    try:
        return datetime.fromisoformat(text).isoformat()
    except ValueError:
        return None
