"""Table of the answers about several experiments."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from pipeline.records.results import ComparisonResult
from pipeline.rendering.labels import MISSING, UNITS, answer_texts, damping_text
from pipeline.rendering.table import Column, Row, Table, table_of
from pipeline.rendering.tables.formats import experiment_row, show_damping, show_stiffness

GRADES = {"yes": "yes", "partly": "partly", "no": "no", "with_friction": "with friction", None: "not known"}
"""Words that state how well theory predicts a boundary or costs."""


def overview_table(result: ComparisonResult) -> Table | None:
    """Return the differences between the answers on several experiments, with one row for each experiment.

    The result is None for one experiment.
    """
    units, rows = UNITS[result.motion], []
    for answer in [e.answer for e in result.experiments if e.answer is not None]:
        predicts, wall, step = answer.predicts, answer.wall, answer.next
        boundary = predicts.code if predicts.code == "with_friction" else predicts.boundary
        row: Row = {"experiment": answer.experiment, "boundary": GRADES[boundary]}
        row |= {"costs": GRADES[predicts.optimal_costs], "tested": predicts.tested_up_to}
        row |= {"wall_stiffness": wall and wall.stiffness, "wall_damping": wall and wall.damping}
        row |= {"next_stiffness": step and step.stiffness, "next_damping": step and step.damping}
        for found in answer.estimates:
            row |= {found.name: found.value, f"{found.name}_answer": found}
        rows.append(row)
    mass = "inertia J" if result.motion.startswith("rotation") else "mass m"
    columns = (
        Column("experiment"),
        Column("wall_stiffness", "K", units.stiffness, "wall to use", show_stiffness, why="none is recommended"),
        Column("wall_damping", "B", units.damping, "wall to use", show_damping, why="none is recommended"),
        Column("boundary", "boundary", group="theory predicts", aside=_tested),
        Column("costs", "costs", group="theory predicts"),
        *(
            Column(name, label, unit, show=_answered(name), aside=_within(name), notes=_notes_on(name), why=why)
            for name, label, unit, why in (
                ("stiffness_max", "largest stable K", units.stiffness, "no stable trial"),
                ("delay_samples", "delay d", "samples", "the logs do not determine it"),
                ("mass", mass, units.mass, "the logs do not determine it"),
            )
        ),
        Column(
            "next_stiffness", "K", units.stiffness, "measure next", show_stiffness, why="nothing is left to measure"
        ),
        Column("next_damping", "B", units.damping, "measure next", show_damping, why="nothing is left to measure"),
    )
    table = table_of(
        "overview", "The answers about each experiment, with 95 % intervals", columns, rows, experiment_row
    )
    return table if len(rows) > 1 else None


def _tested(row: Row) -> str:
    """Return the damping up to which the boundary is judged, if theory is stable far beyond it. Otherwise empty."""
    judged = row["tested"] is not None and row["boundary"] != GRADES[None]
    return f"B ≤ {damping_text(row['tested'])}" if judged else ""


def _answered(name: str) -> Callable[[float, Row], str]:
    """Return a function that formats the value of an answer without its unit."""
    return lambda value, row: answer_texts(row[f"{name}_answer"])[0].partition(" ")[0]


def _notes_on(name: str) -> Callable[[Row], Iterator[str]]:
    """Return a function that yields the note on an answer: a largest limit may be exceeded beyond the tested range."""

    def notes(row: Row) -> Iterator[str]:
        found = row.get(f"{name}_answer")
        if found is not None and found.at_last_damping:
            yield "At the largest tested damping: beyond it, limits may be larger."

    return notes


def _within(name: str) -> Callable[[Row], str]:
    """Return a function that formats the interval of an answer as text. The text is empty if an end is missing."""

    def text(row: Row) -> str:
        found = row.get(f"{name}_answer")
        return "" if found is None or found.value is None else answer_texts(found)[1].replace(MISSING, "")

    return text
