"""The walls to use in words: on the first screen, in sentences, and as a table of all experiments."""

from __future__ import annotations

from functools import partial
from typing import Any

from pipeline.records.criteria import criterion_of
from pipeline.records.models import Motion
from pipeline.records.results import ComparisonResult, ExperimentResult, UsePoint
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import (
    UNITS,
    Units,
    cost_range_text,
    criterion_label,
    criterion_name,
    damping_text,
    range_text,
    significant,
    stiffness_text,
)
from pipeline.rendering.table import Cell, Column, Table, missing, number

TOLD = ("settle_2pct", "overshoot", "energy_step_w1")
"""Costs that are told of the walls to use, after that by which they were chosen."""

AROUND = "walls around it: costs in the median, from the least to the largest"


def use_facts(result: ExperimentResult, units: Units) -> dict[str, str]:
    """Return what a reader needs of the walls to use: the one to set, its costs, the limit, the walls around it."""
    use = result.use
    if use is None:
        return {}
    point, names = use.point, [name for name in dict.fromkeys((use.criterion, *TOLD)) if name in use.point.costs]
    chosen = use.costs.get(use.criterion)
    costs = f": {cost_range_text(use.criterion, chosen.low, chosen.high)}" if chosen else ""
    return {
        f"set, experiment {result.experiment}": (
            f"K = {stiffness_text(point.stiffness)} {units.stiffness}, "
            f"B = {damping_text(point.damping)} {units.damping}"
        ),
        **{criterion_name(name).partition(" (")[0]: _with_time(result, name, point.costs[name]) for name in names},
        "limit": f"at least {significant(point.margin, 2)} times as stiff{_harder(point)}",
        f"{use.trials} walls around": (
            f"K = {range_text(stiffness_text, use.stiffness_low, use.stiffness_high)} {units.stiffness}, "
            f"B = {range_text(damping_text, use.damping_low, use.damping_high)} {units.damping}{costs}"
        ),
    }


def _harder(point: UsePoint) -> str:
    if point.margin_large_motion is None:
        return ""
    return f" for this step, {significant(point.margin_large_motion, 2)} times for a harder push"


def _with_time(result: ExperimentResult, name: str, cost: float) -> str:
    """Return a cost, one in samples in ms too."""
    text, period = cost_range_text(name, cost, cost), result.sampling_period_s
    if criterion_of(name).family.printed_unit == "samples" and period:
        return f"{text} = {significant(1e3 * cost * period, 3)} ms"
    return text


def loop_line(result: ExperimentResult, motion: Motion) -> str:
    """Return sampling period, delay, mass and damping of an experiment in a line: theory's, else the estimates."""
    units, period, theory = UNITS[motion], result.sampling_period_s, result.theory
    names = {"delay_samples": ("d", "samples"), "mass": ("m", units.mass), "damping": ("b", units.damping)}
    known = {n: getattr(theory, n) if theory else each.value for n, each in result.estimates.items() if n in names}
    parts = [f"T = {significant(1e3 * period, 3)} ms"] if period else []
    for name, (symbol, unit) in names.items():
        if (value := known.get(name)) is not None:
            ms = f" = {significant(1e3 * value * period, 3)} ms" if name == "delay_samples" and period else ""
            parts.append(f"{symbol} = {significant(value, 3)} {unit}{ms}")
    source = theory.source.partition(";")[0] if theory else "estimated"
    return f"Experiment {result.experiment}: {', '.join(parts)} ({source})." if parts else ""


def use_note(result: ExperimentResult) -> str:
    """Return why no cost chose the walls to use, or why there are none; empty where a cost did."""
    if not result.use_reason:
        return ""
    if result.use is None:
        return f"No walls to use are named: {result.use_reason}."
    return (
        f"Stiff walls, of at most half the stiffness of the limit; which one is best cannot be told, since "
        f"{result.use_reason}."
    )


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
