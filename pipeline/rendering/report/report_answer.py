"""The walls to use in words: on the first screen, in sentences, and as a table of all experiments."""

from __future__ import annotations

from functools import partial
from typing import Any

from pipeline.records.results import ComparisonResult, ExperimentResult
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import (
    UNITS,
    cost_range_text,
    criterion_label,
    damping_text,
    range_text,
    significant,
    stiffness_text,
)
from pipeline.rendering.report.page_template import fill_template
from pipeline.rendering.table import Cell, Column, Table, missing, number

AROUND = "walls around it: costs in the median, from the least to the largest"


def answer_lines(result: ComparisonResult) -> tuple[str, ...]:
    """Return the five answers as lines of text; none where there is no answer."""
    if result.answer is None:
        return ()
    text = fill_template("answer.txt.j2", result=result, **answer_content(result))
    return tuple(" ".join(line.split()) for line in text.splitlines() if line.strip())


def answer_content(result: ComparisonResult) -> dict[str, Any]:
    """Return what the templates of the answer take beside the result: units, and the sampling period [s]."""
    return {"units": UNITS[result.motion], "period": result.told.sampling_period_s if result.told else None}


def use_note(result: ExperimentResult) -> str:
    """Return why no cost chose the walls to use, or why there are none; empty where a cost did."""
    if not result.use_reason:
        return ""
    return f"{'None' if result.use is None else 'Chosen by stiffness'}: {result.use_reason}."


def use_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the walls to use of each experiment with the costs of the trials there, or None where there are none."""
    units = UNITS[result.motion]
    names = [name for name in result.criteria if any(e.use and name in e.use.costs for e in result.experiments)]
    columns = (
        Column("experiment"),
        Column("set_stiffness", "K", units.stiffness, "wall to set", show=stiffness_text),
        Column("set_damping", "B", units.damping, "wall to set", show=damping_text),
        Column("set_margin", "limit over K, at least", group="wall to set"),
        Column("stiffness", "K", units.stiffness, AROUND),
        Column("damping", "B", units.damping, AROUND),
        Column("trials", group=AROUND),
        *(Column(name, criterion_label(name), group=AROUND) for name in names),
        Column("margin", "limit over K, at least", group=AROUND),
    )
    caption = "Walls to use: all stable, and far from the limit; of each, the wall to set, and walls around it"
    table = Table("use", caption, columns)
    for each in result.experiments:
        use, why = each.use, each.use_reason or ""
        if use is None:
            table.add(each.experiment, {c.name: missing(why) for c in columns} | {"experiment": each.experiment})
            continue
        point, trial = use.point, trials.place(each.experiment, use.point.trial_id)
        cells: dict[str, Any] = {
            "experiment": Cell(each.experiment, each.experiment, numeric=False, marks=table.mark(use_note(each))),
            "set_stiffness": number(point.stiffness, stiffness_text, trial=trial),
            "set_damping": number(point.damping, damping_text, trial=trial),
            "set_margin": Cell(point.margin, significant(point.margin, 2)),
            "stiffness": Cell(use.stiffness_low, range_text(stiffness_text, use.stiffness_low, use.stiffness_high)),
            "damping": Cell(use.damping_low, range_text(damping_text, use.damping_low, use.damping_high)),
            "trials": use.trials,
            "margin": Cell(use.margin, significant(use.margin, 2)),
        }
        for name, cost in use.costs.items():
            cells[name] = number(cost.median, partial(_printed, name), ends=(cost.low, cost.high))
        table.add(each.experiment, cells)
    return table.filled if names else None


def _printed(criterion: str, cost: float) -> str:
    return cost_range_text(criterion, cost, cost).partition(" ")[0]
