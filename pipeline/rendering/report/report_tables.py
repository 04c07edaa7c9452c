"""Tables of optimal points and stability limits: what stands in which cell, and why a cell is empty."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from pipeline.records.delay_rows import DelayPoint, delay_points, is_delay_table
from pipeline.records.findings import BoundaryPoint
from pipeline.records.models import ComparisonRow, Deviation, Motion
from pipeline.records.results import ComparisonResult, ExperimentResult
from pipeline.records.trial_codec import NO_TRIALS, TrialPage
from pipeline.rendering.labels import (
    MISSING,
    UNITS,
    condition_label,
    cost_text,
    criterion_label,
    criterion_name,
    damping_text,
    percent_text,
    printed_scale,
    published_text,
    significant,
    stiffness_text,
    table_label,
)
from pipeline.rendering.table import Cell, Column, Table, missing, number, words

CENSORED = "At the edge of the tested range (censored): the true value may lie outside."
PARTS = (
    "Parts, whose factors (1 + x/100) multiply to the whole: range, theory's least cost in the tested range against "
    "its least anywhere; grid, that at the tested points against that; model, the measured cost freed from the scatter "
    "of single trials against theory's (95 %); selection, the best single trial against that."
)
NOT_PUBLISHED = "not published"
UNDECIDED_BELOW = "A trial below it is undecided: no evidence against it, and worth a look or a repetition."
TESTED_RANGE_ENDED = "The tested range ended before an unstable trial."


def optimum_tables(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> list[Table]:
    """Return Tables D.1 to D.5 (or whatever the rows are named): optimal points beside the published ones."""
    tables = _rows_by_table(result).items()
    return [_optimum_table(name, rows, result.motion, trials) for name, rows in tables if not is_delay_table(rows)]


def delay_tables(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> list[Table]:
    """Return Table D.6 and others of its kind: one row a delay, three columns a criterion."""
    tables = _rows_by_table(result).items()
    return [_delay_table(name, rows, trials) for name, rows in tables if is_delay_table(rows)]


def measured_optimum_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the best trial of each experiment by each criterion, or None where there is none."""
    units = UNITS[result.motion]
    columns = (
        words("criterion"),
        Column("stiffness", unit=units.stiffness),
        Column("damping", unit=units.damping),
        Column("cost", "cost, 95 %"),
        Column("ties", "equal trials"),
    )
    table = Table("optima", "Trials with the least cost", columns)
    for e in result.experiments:
        for criterion, best in e.optimum.items():
            marks = table.mark(CENSORED if best.censored else None)
            trial, ends = trials.place(e.experiment, best.trial_id), (best.cost_low, best.cost_high)
            values: dict[str, Any] = {
                "criterion": criterion_label(criterion),
                "stiffness": Cell(best.stiffness, stiffness_text(best.stiffness), marks=marks, trial=trial),
                "damping": Cell(best.damping, damping_text(best.damping), trial=trial),
                "cost": number(best.cost, partial(cost_text, criterion), ends=ends, trial=trial),
                "ties": best.ties,
            }
            table.add(f"{e.experiment}/{criterion}", values, f"experiment {e.experiment}")
    return table.filled


def boundary_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the measured stability limit of all experiments over damping, or None where there is none."""
    tested = [e for e in result.experiments if e.boundary]
    units = UNITS[result.motion]
    columns = [Column("damping", unit=units.damping, show=damping_text)]
    for e in tested:
        column = partial(Column, group=f"experiment {e.experiment}", why="not tested at this damping")
        columns += [column(f"{e.experiment}/{name}", name) for name in ("stable", "unstable")]
        columns.append(column(f"{e.experiment}/limit", "limit, 95 %"))
        if any(p.stiffness_large_motion is not None for p in e.boundary):
            columns.append(column(f"{e.experiment}/large", "harder push", show=stiffness_text))
        if any(p.truth is not None for p in e.boundary):
            columns.append(column(f"{e.experiment}/truth", "truth", show=stiffness_text))
    caption = (
        f"Largest stable and smallest unstable stiffness [{units.stiffness}] at each damping, and the limit by the "
        "growth rates of the trials around it"
    )
    if any(p.stiffness_large_motion is not None for e in tested for p in e.boundary):
        caption += "; with friction both hold for this step, and a harder push is unstable from the linear limit on"
    table = Table("boundary", caption, columns)
    for damping in sorted({p.damping for e in tested for p in e.boundary}):
        values: dict[str, Any] = {"damping": damping}
        for e in tested:
            values |= _limit_cells(table, e, damping, trials.limits)
        table.add(damping_text(damping), values)
    return table.filled


def missing_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return what could not be had and why, or None where nothing is missing."""
    columns = (words("experiment"), words("result"), words("reason"))
    table = Table("missing", "Results that the logs do not allow", columns)
    for e in result.experiments:
        for what, why in e.missing.items():
            name = criterion_name(what)
            table.add(f"{e.experiment}/{what}", {"experiment": e.experiment, "result": name, "reason": why})
    return table.filled


def excluded_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return the trials that were excluded by hand, or None where none was."""
    columns = [words(name) for name in ("experiment", "trial", "log", "reason", "since")]
    table = Table("excluded", "Trials excluded by hand: kept, and used for no number of this report", columns)
    for one in result.excluded:
        cells = {"experiment": one.experiment, "trial": one.trial_id, "log": one.log}
        table.add(one.trial_id, cells | {"reason": one.reason, "since": one.since})
    return table.filled


def notes_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return what people wrote on experiments and trials, or None where they wrote nothing."""
    columns = [words(name) for name in ("trial", "tags", "note")]
    table = Table("notes", "Notes and tags of the lab; no number rests on them", columns)
    for one in result.notes:
        cells = {"trial": one.trial_id or "all", "tags": ", ".join(one.tags), "note": one.text}
        table.add(f"{one.experiment}/{one.trial_id or ''}", cells, f"experiment {one.experiment}")
    return table.filled


def header_table(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> Table | None:
    """Return what logs say of themselves in header lines of the lab, or None where they say nothing more."""
    columns = (words("line"), Column("trials"), words("values", "values (trials)"))
    table = Table("header", "Header lines of the logs that only the lab knows; no number rests on them", columns)
    for e in result.experiments:
        for line in e.header:
            told = [f"{value or 'empty'} ({count})" for value, count in line.values.items()]
            more = line.different - len(told)
            values = "; ".join([*told, *([f"{more} more"] if more else [])])
            cells = {"line": line.key, "trials": line.trials, "values": values}
            table.add(f"{e.experiment}/{line.key}", cells, f"experiment {e.experiment}")
    return table.filled


def _rows_by_table(result: ComparisonResult) -> dict[str, list[ComparisonRow]]:
    tables: dict[str, list[ComparisonRow]] = {}
    for row in result.tables:
        tables.setdefault(row.table, []).append(row)
    return tables


def _optimum_table(name: str, rows: Sequence[ComparisonRow], motion: Motion, trials: TrialPage) -> Table:
    units = UNITS[motion]
    published = any(row.published_cost is not None or row.published_stiffness is not None for row in rows)
    here = "this report" if published else ""
    columns = [
        words("condition"),
        Column("stiffness", "stiffness K", units.stiffness, here),
        Column("damping", "damping B", units.damping, here),
        Column("cost", group=here),
    ]
    if any(row.deviation_percent is not None for row in rows):
        columns.append(Column("deviation", unit="%", group=here))
    if published:
        columns += [
            Column(f"published_{what}", label, group="published", show=published_text, why=NOT_PUBLISHED)
            for what, label in (("stiffness", "K"), ("damping", "B"), ("cost", "cost"))
        ]
    label = table_label(name)
    title = f"{label[:1].upper()}{label[1:]}. " if name else ""
    criteria = dict.fromkeys(criterion_name(row.criterion) for row in rows)
    table = Table(name or "optima-theory", f"{title}Optimal points: {'; '.join(criteria)}", columns)
    for row in rows:
        place = f"{row.criterion}/{row.condition}"
        table.add(place, _optimum_cells(table, row, trials), criterion_label(row.criterion))
    return table


def _optimum_cells(table: Table, row: ComparisonRow, trials: TrialPage) -> dict[str, Any]:
    condition = condition_label(row.condition)
    if row.delay_samples is not None and not row.condition.startswith("theory"):
        condition += f" (d = {significant(row.delay_samples, 3)})"
    why = row.note or "not available"
    trial = trials.place(row.experiment, row.trial_id)
    return {
        "condition": Cell(condition, condition, numeric=False, marks=_marks(table, row)),
        "stiffness": number(row.stiffness, stiffness_text, why, trial=trial),
        "damping": number(row.damping, damping_text, why, trial=trial),
        "cost": number(row.cost, partial(cost_text, row.criterion), why, trial=trial),
        "deviation": _deviation_cell(table, row),
        "published_stiffness": row.published_stiffness,
        "published_damping": row.published_damping,
        "published_cost": number(row.published_cost, partial(_published_cost, row.criterion), NOT_PUBLISHED),
    }


def _marks(table: Table, row: ComparisonRow) -> tuple[str, ...]:
    return table.mark(row.note, CENSORED if row.censored else None)


def _published_cost(criterion: str, cost: float) -> str:
    return published_text(cost * printed_scale(criterion))


def _deviation_cell(table: Table, row: ComparisonRow) -> Cell:
    theory = row.condition.startswith("theory")
    why = "no deviation: a cost is missing, or the cost of theory is zero"
    cell = number(row.deviation_percent, percent_text, "theory is what the deviation refers to" if theory else why)
    return replace(cell, aside=_parts(row.deviation), marks=table.mark(PARTS)) if row.deviation else cell


def _parts(parts: Deviation) -> str:
    """What a deviation is made of, in a line; parts that are printed as zero are left out, but for the model's."""
    nothing, low, high = (percent_text(value) for value in (0.0, parts.model_low, parts.model_high))
    interval = "" if low == high == nothing else f" ({low} to {high})"
    others = {name: percent_text(getattr(parts, name)) for name in ("range", "grid", "selection")}
    told = [f"{name} {text}" for name, text in others.items() if text != nothing]
    return ", ".join([f"model {percent_text(parts.model)}{interval}", *told])


def _delay_table(name: str, rows: Sequence[ComparisonRow], trials: TrialPage) -> Table:
    criteria = list(dict.fromkeys(row.criterion for row in rows))
    columns = [Column("delay", "delay d")]
    for criterion in criteria:
        columns += [
            Column(f"{criterion}/{what}", label, group=criterion_label(criterion), why=why)
            for what, label, why in (
                ("theory", "theory", "theory is not known at this delay"),
                ("experiment", "experiment", "no trials at this delay"),
                ("deviation", "dev. %", "not measured"),
            )
        ]
    title = table_label(name) if table_label(name) != name else name.capitalize()
    caption = f"{title}. Optimal costs over total delay"
    if any(row.published_cost is not None for row in rows):
        caption += "; published values in brackets"
    table = Table(name, caption, columns)
    points = delay_points(rows)
    shared = Counter(point.delay for point in points)
    for point in points:
        delay = MISSING if point.delay is None else significant(point.delay, 3)
        alone = shared[point.delay] == 1 and point.delay is not None
        first = Cell(point.delay, delay, aside="" if alone else f"experiment {point.experiment}")
        cells = {"delay": first, **_delay_cells(table, point, criteria, trials)}
        table.add(f"d={delay}" if alone else f"d={delay}/{point.experiment}", cells)
    return table


def _delay_cells(table: Table, point: DelayPoint, criteria: Sequence[str], trials: TrialPage) -> dict[str, Any]:
    cells: dict[str, Any] = {}
    for criterion in criteria:
        for what, rows in (("theory", point.theory), ("experiment", point.measured)):
            if criterion in rows:
                cells[f"{criterion}/{what}"] = _cost_cell(table, rows[criterion], trials)
        if criterion in point.measured:
            cells[f"{criterion}/deviation"] = _deviation_cell(table, point.measured[criterion])
    return cells


def _cost_cell(table: Table, row: ComparisonRow, trials: TrialPage) -> Cell:
    published = row.published_cost
    aside = "" if published is None else f"({_published_cost(row.criterion, published)})"
    marks = _marks(table, row)
    if row.cost is None:
        return missing(row.note or "not available", aside=aside, marks=marks)
    trial = trials.place(row.experiment, row.trial_id)
    return Cell(row.cost, cost_text(row.criterion, row.cost), aside=aside, marks=marks, trial=trial)


def _limit_cells(
    table: Table, experiment: ExperimentResult, damping: float, places: Mapping[tuple[str, float, float], str]
) -> dict[str, Any]:
    point = next((p for p in experiment.boundary if p.damping == damping), None)
    if point is None:
        return {}
    note = TESTED_RANGE_ENDED if point.censored else None
    name = experiment.experiment
    stable, unstable = (places.get((name, damping, k or 0.0), "") for k in (point.stable, point.unstable))
    marks = table.mark(note)
    below = table.mark(UNDECIDED_BELOW if point.undecided else None)
    return {
        f"{name}/stable": number(point.stable, stiffness_text, "no stable trial", trial=stable, marks=below),
        f"{name}/unstable": missing(note or "no unstable trial", marks=marks)
        if point.unstable is None
        else Cell(point.unstable, stiffness_text(point.unstable), marks=marks, trial=unstable),
        f"{name}/limit": _limit_cell(point),
        f"{name}/large": point.stiffness_large_motion,
        f"{name}/truth": point.truth,
    }


def _limit_cell(point: BoundaryPoint) -> Cell:
    if None not in (point.estimate, point.low, point.high):
        return number(point.estimate, stiffness_text, ends=(point.low, point.high))
    if point.low:
        return Cell(point.low, f"≥ {stiffness_text(point.low)}")
    if point.high:
        return Cell(point.high, f"≤ {stiffness_text(point.high)}")
    return missing("no trial is surely stable or surely unstable")
