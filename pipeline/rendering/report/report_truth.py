"""What was true of simulated experiments, beside what was found, as a table."""

from __future__ import annotations

from typing import Any

from pipeline.records.findings import Estimate
from pipeline.records.results import ComparisonResult
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import estimate_texts, significant
from pipeline.rendering.report.report_estimates import NAMES
from pipeline.rendering.table import Cell, Column, Table, missing, words

MISSED = "Outside the interval."


def truth_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the truth of every experiment, with the intervals of its estimates; None where none is known."""
    known = [each for each in result.experiments if each.truth and each.truth_held]
    units = {name: one.unit for each in known for name, one in each.estimates.items() if one.truth is not None}
    columns = [words("experiment"), Column("limits", "limits that hold it")]
    columns += [Column(name, NAMES.get(name, name), unit.replace("^2", "²")) for name, unit in units.items()]
    caption = f"What was true in the simulation, with the interval of each estimate: {_held(result)}"
    table = Table("truth", caption, columns)
    for each in known:
        held = each.truth_held
        assert held is not None, "they are chosen by it"
        cells: dict[str, Any] = {"experiment": each.experiment}
        cells["limits"] = missing((each.truth and each.truth.limit_reason) or "no limit has an interval")
        if held.limits:
            cells["limits"] = Cell(held.limits_held / held.limits, f"{held.limits_held} of {held.limits}")
        cells |= {name: _cell(table, one) for name, one in each.estimates.items() if name in units}
        table.add(each.experiment, cells)
    return table.filled


def _cell(table: Table, one: Estimate) -> Cell:
    if one.truth is None:
        return missing("not told apart from the lag of the actuator")
    _, low, high = estimate_texts(one)
    outside = None not in (one.value, one.low, one.high) and not (one.low or 0.0) <= one.truth <= (one.high or 0.0)
    marks = table.mark(MISSED if outside else None)
    interval = f"{low} to {high}" if one.value is not None and low and high else "no interval"
    return Cell(one.truth, significant(one.truth, 4), aside=interval, marks=marks)


def _held(result: ComparisonResult) -> str:
    """Return how many intervals hold the truth over all experiments."""
    known = [each.truth_held for each in result.experiments if each.truth_held is not None]
    total = sum(held.estimates + held.limits for held in known)
    held = sum(held.estimates_held + held.limits_held for held in known)
    return f"{held} of {total} intervals of 95 % hold it"
