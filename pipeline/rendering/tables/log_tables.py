"""Tables of outcomes, causes, missing results, notes and header lines of logs."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.records.results import ComparisonResult
from pipeline.rendering.labels import criterion_name
from pipeline.rendering.table import Column, Row, Table, table_of
from pipeline.rendering.tables.formats import (
    digits,
    experiment_block,
    experiment_row,
    row_within_experiment,
    show_number,
)

OUTCOMES = {
    "settled": "settled",
    "moving": "still moving",
    "limit_cycle": "limit cycle",
    "diverged": "diverged",
    "saturated": "saturated",
    "travel_limit": "hit a limit",
    "too_short": "too short",
    "disturbed": "disturbed",
    "no_step": "no step",
}


def outcomes_table(result: ComparisonResult) -> Table | None:
    """Return the number of trials by outcome."""
    shown = [name for name in OUTCOMES if any(e.outcomes.get(name) for e in result.experiments)]
    rows = [
        {"experiment": e.experiment, **{name: e.outcomes.get(name, 0) for name in shown}} for e in result.experiments
    ]
    columns = [Column("experiment"), *(Column(name, OUTCOMES[name], show=show_number) for name in shown)]
    table = table_of("outcomes", "Number of trials by outcome", columns, rows if shown else [], experiment_row)
    if table is not None and "settled" in shown:
        table.mark(
            "Settled: the position stays within 2 % of x_0 + F_0/K. Logs with other outcomes may also come to rest, "
            "some of them at another position."
        )
    if table is not None and "disturbed" in shown:
        table.mark("Disturbed: a force of 5 % of the step or more acts in addition to command, mass and damping.")
    return table


def device_tables(f: Mapping[str, list[Row]]) -> dict[str, Table | None]:
    """Return the tables of the devices identified from logs."""
    return {
        "causes": table_of(
            "causes",
            "What the logs show in addition to mass, damping and delay",
            (Column("code", "cause"), Column("sentence", "what it is"), Column("evidence")),
            [row | {"code": row["code"].replace("_", " ")} for row in f["causes"]],
            row_within_experiment("code"),
            experiment_block,
        ),
        "model": table_of(
            "model",
            "Logs that one device explains, and fit of its free runs to unseen logs",
            (
                Column("experiment"),
                Column("trials", show=show_number),
                Column("explained", show=show_number),
                Column("fit_percent", "fit of free runs", "%", "median", digits(3), why="no log could be replayed"),
            ),
            f["model"],
            experiment_row,
        ),
    }


def manual_tables(f: Mapping[str, list[Row]]) -> dict[str, Table | None]:
    """Return the tables of missing results, excluded trials and notes."""
    return {
        "missing": table_of(
            "missing",
            "Missing results",
            (Column("experiment"), Column("result"), Column("reason")),
            [row | {"result": criterion_name(row["what"])} for row in f["missing"]],
            row_within_experiment("what"),
        ),
        "excluded": table_of(
            "excluded",
            "Trials excluded by hand; no number uses them",
            (Column("experiment"), Column("trial_id", "trial"), Column("log"), Column("reason"), Column("since")),
            f["excluded"],
            lambda row: str(row["trial_id"]),
        ),
        "notes": table_of(
            "notes",
            "Notes and tags of the lab; no number uses them",
            (Column("trial_id", "trial"), Column("tags", why="no tag"), Column("text", "note", why="no text")),
            [row | {"trial_id": row["trial_id"] or "all"} for row in f["notes"]],
            row_within_experiment("trial_id"),
            experiment_block,
        ),
    }


def header_table(result: ComparisonResult) -> Table | None:
    """Return the header lines of the logs that do not affect any number."""
    rows = []
    for e in result.experiments:
        for line in e.header:
            texts = [f"{value or 'empty'} ({count})" for value, count in line.values.items()]
            texts += [f"{line.different - len(texts)} more"] if line.different > len(texts) else []
            about = {"experiment": e.experiment, "line": line.key, "trials": line.trials}
            rows.append(about | {"values": "; ".join(texts)})
    columns = (Column("line"), Column("trials", show=show_number), Column("values", "values (trials)"))
    caption = "Other header lines of the logs; no number uses them"
    return table_of("header", caption, columns, rows, row_within_experiment("line"), experiment_block)
