"""Rows of a table of optima over delay: which tables are such, and which rows belong to one experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.records.models import ComparisonRow


def is_theory(row: ComparisonRow) -> bool:
    """Tell whether a row holds what theory says, not what was measured."""
    return row.condition.startswith("theory")


def is_delay_table(rows: Sequence[ComparisonRow]) -> bool:
    """Tell whether rows form a table over delay: its measured rows differ in their experiment only.

    In a table of optima each criterion has one row a condition, and delays may differ from theory to experiment.
    """
    measured = [row for row in rows if not is_theory(row)]
    kinds = {(row.criterion, row.condition) for row in measured}
    places = {(row.criterion, row.condition, row.experiment, row.delay_samples) for row in measured}
    return len(kinds) < len(measured) == len(places)


@dataclass(frozen=True)
class DelayPoint:
    """One experiment in a table over delay: its theoretical and measured rows by criterion.

    ``delay`` is the total delay in samples, None where it is not known.
    """

    delay: float | None
    experiment: str | None
    theory: dict[str, ComparisonRow]
    measured: dict[str, ComparisonRow]


def delay_points(rows: Sequence[ComparisonRow]) -> list[DelayPoint]:
    """Return the experiments of a table over delay, in order of delay; several may have the same.

    Parameters
    ----------
    rows : sequence of ComparisonRow
        Theory of each experiment and criterion directly before the measured row that it belongs to. Deviations refer
        to the discrete theory, which therefore stands in the table where there are both.
    """
    points: dict[tuple[float | None, str | None], DelayPoint] = {}
    theory: dict[str, ComparisonRow] = {}
    for row in rows:
        if is_theory(row):
            if row.condition == "theory_discrete" or row.criterion not in theory:
                theory[row.criterion] = row
            continue
        point = points.setdefault(
            (row.delay_samples, row.experiment), DelayPoint(row.delay_samples, row.experiment, {}, {})
        )
        point.measured[row.criterion] = row
        if row.criterion in theory:
            point.theory[row.criterion] = theory.pop(row.criterion)
    return sorted(points.values(), key=lambda point: float("inf") if point.delay is None else point.delay)
