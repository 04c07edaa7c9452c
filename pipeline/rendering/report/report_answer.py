"""The walls to use in words: on the first screen, in sentences, and as a table of all experiments."""

from __future__ import annotations

from functools import partial
from typing import Any

from pipeline.records.results import ComparisonResult, UseRegion
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import (
    UNITS,
    Units,
    cost_range_text,
    criterion_label,
    criterion_name,
    damping_text,
    printed_scale,
    range_text,
    significant,
    stiffness_text,
)
from pipeline.rendering.table import Cell, Column, Table, missing, number

TOLD = ("settle_2pct", "overshoot", "energy_step_w1")
"""Costs that are told of the walls to use, after that by which they were chosen."""


def use_facts(use: UseRegion, units: Units) -> dict[str, str]:
    """Return what a reader needs of the walls to use by what it is: which first, costs to expect, the limit last."""
    ends = range_text(stiffness_text, use.stiffness_low, use.stiffness_high)
    dampings = range_text(damping_text, use.damping_low, use.damping_high)
    return {
        "use": f"K = {ends} {units.stiffness}, B = {dampings} {units.damping}",
        **{
            criterion_name(name).partition(" (")[0]: cost_range_text(name, cost.median, cost.low, cost.high)
            for name in dict.fromkeys((use.criterion, *TOLD))
            if (cost := use.costs.get(name)) is not None
        },
        "limit": f"at least {significant(use.margin, 2)} times as stiff",
    }


def use_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the walls to use of each experiment with the costs of the trials there, or None where there are none."""
    units = UNITS[result.motion]
    names = [name for name in result.criteria if any(e.use and name in e.use.costs for e in result.experiments)]
    columns = (
        Column("experiment"),
        Column("stiffness", unit=units.stiffness),
        Column("damping", unit=units.damping),
        Column("trials"),
        *(Column(name, criterion_label(name)) for name in names),
        Column("margin", "limit over stiffness, at least"),
    )
    caption = (
        "Walls to use: stable, good and far from the limit; costs are the median of the trials there, with the least "
        "and the largest"
    )
    table = Table("use", caption, columns)
    for each in result.experiments:
        use, why = each.use, each.use_reason or ""
        if use is None:
            table.add(each.experiment, {c.name: missing(why) for c in columns} | {"experiment": each.experiment})
            continue
        cells: dict[str, Any] = {
            "experiment": each.experiment,
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
    return significant(cost * printed_scale(criterion), 3)
