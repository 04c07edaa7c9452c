"""The recomputed theory tables as lines for a terminal and as a JSON document."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from pipeline.device_data.published_theory import QUANTITIES, PrintedNumber
from pipeline.studies.thesis_tables import FLAT, LIMIT, MARKS, ROUNDING, Entry, Mark, TheoryRow, count_marks

SIGNS: dict[Mark, str] = {"equal": "", "within": " ~", "erratum": " !", "unexplained": " ?"}
"""What stands behind a computed number."""

LEGEND = "~ within one unit of the last printed digit, or as told below; ! erratum; ? unexplained"

_MORE = 2
"""Digits of a computed number beyond the printed ones: enough to see how it rounds."""


Align = Callable[[Sequence[Mapping[str, Any]], Sequence[str]], list[str]]
"""Makes aligned lines of cells by column and the names of the columns."""


def table_lines(name: str, rows: Sequence[TheoryRow], align: Align) -> list[str]:
    """Return a table as aligned lines, then the reason of each number that needs one, then an empty line."""
    names = [quantity for quantity in QUANTITIES if any(e.name == quantity for row in rows for e in row.entries)]
    columns = ["criterion", "d", "gamma", "delta", *(c for n in names for c in (n, f"{n} printed"))]
    lines = [f"Table {name}: {_counts(rows)}", *align([_cells(row, names) for row in rows], columns)]
    for row in rows:
        reasons: dict[str, list[str]] = {}
        for entry in row.entries:
            if text := _reason(entry):
                reasons.setdefault(text, []).append(entry.name)
        place = f"{row.criterion}, d = {row.delay:g}, gamma = {row.gamma:g}, delta = {row.delta:g}"
        lines += [f"  {place}: {' and '.join(of)}: {text}" for text, of in reasons.items()]
    return [*lines, ""]


def _cells(row: TheoryRow, names: Sequence[str]) -> dict[str, Any]:
    cells: dict[str, Any] = {"criterion": row.criterion, "d": row.delay, "gamma": row.gamma, "delta": row.delta}
    for name in names:
        entry = next((e for e in row.entries if e.name == name), None)
        cells[name] = entry and _computed(entry)
        cells[f"{name} printed"] = entry and entry.printed
    return cells


def _computed(entry: Entry) -> str:
    digits = PrintedNumber(entry.printed).digits + _MORE
    # adding 0.0 turns the -0.0 that rounding can leave into 0.0
    return f"{round(entry.computed, digits) + 0.0:.{digits}f}{SIGNS[entry.mark]}"


def _reason(entry: Entry) -> str | None:
    if entry.tolerance in (FLAT, LIMIT):
        return f"{entry.tolerance}, {entry.reason}"
    if entry.mark == "unexplained":
        return f"printed {entry.printed}, computed {entry.computed:.10g}"
    return entry.reason


def _counts(rows: Sequence[TheoryRow]) -> str:
    return ", ".join(f"{count} {mark}" for mark, count in count_marks(rows).items())


def summary_line(rows: Sequence[TheoryRow]) -> str:
    """Return what it comes to: how many of the printed numbers have each mark."""
    return f"{sum(len(row.entries) for row in rows)} printed numbers: {_counts(rows)}. ({LEGEND}.)"


def document(rows: Sequence[TheoryRow]) -> dict[str, Any]:
    """Return rows and counts as a document that JSON can hold."""
    return {
        "marks": list(MARKS),
        "tolerances": {
            ROUNDING: "within one unit of the last printed digit",
            FLAT: "a point that rounds to the printed one has the optimal cost to its printed digits",
            LIMIT: "the printed cost is that of a point whose alpha rounds to the limit alpha = -gamma",
        },
        "count": dict(count_marks(rows)),
        "rows": [asdict(row) for row in rows],
    }
