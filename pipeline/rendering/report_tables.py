"""Tables of a report as finished text: what stands in which cell, and why a cell is empty.

Every cell has a name that is unique in its report, such as ``D.1/settle_2pct/experiment_1/cost``: `verify`
compares cells by name, and a test can ask for one of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from pipeline.base.wording import shared_notes
from pipeline.records.delay_rows import delay_points, is_delay_table
from pipeline.records.models import BoundaryPoint, ComparisonRow, Motion, Optimum
from pipeline.records.results import ComparisonResult, ExperimentResult
from pipeline.records.trial_records import TrialPage
from pipeline.rendering.labels import (
    CRITERION_NAMES,
    MISSING,
    UNITS,
    condition_label,
    cost_text,
    criterion_label,
    damping_text,
    percent_text,
    printed_scale,
    published_text,
    significant,
    stiffness_text,
    table_label,
)

CENSORED = "At the edge of the tested range (censored): the true value may lie outside."


@dataclass(frozen=True)
class Cell:
    """Text of a cell; ``aside`` is smaller text, ``why`` explains a missing value, ``marks`` name notes.

    ``name`` begins with that of its ``row``; the page holds both apart, since names would else be a tenth of it.
    ``trial`` refers to the trial that a number stands for (see `trial_records.reference`), empty where there is none.
    """

    text: str
    numeric: bool = True
    aside: str = ""
    why: str = ""
    marks: tuple[str, ...] = ()
    name: str = ""
    row: str = ""
    head: bool = False
    trial: str = ""


@dataclass(frozen=True)
class Head:
    """Column head; neighbours of the same ``group`` share a heading above."""

    text: str
    group: str = ""
    numeric: bool = True


@dataclass
class Table:
    """A table of a report; each block of rows may have a heading of its own."""

    identifier: str
    caption: str
    heads: tuple[Head, ...]
    blocks: list[tuple[str, list[tuple[Cell, ...]]]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def whys(self) -> list[str]:
        """The different reasons for missing values that are no notes: print and touch show no text on pointing."""
        return list(dict.fromkeys(self.reasons.values()))

    @property
    def reasons(self) -> dict[str, str]:
        """The reasons of cells that are no notes, each with the text below the table that it shares with others."""
        cells = (cell for _, rows in self.blocks for row in rows for cell in row)
        return shared_notes([cell.why for cell in cells if cell.why and cell.why not in self.notes])

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the column heads with the columns each spans; empty where there are none."""
        spans: list[tuple[str, int]] = []
        for head in self.heads:
            if spans and spans[-1][0] == head.group:
                spans[-1] = (head.group, spans[-1][1] + 1)
            else:
                spans.append((head.group, 1))
        return spans if any(group for group, _ in spans) else []

    def mark(self, notes: Iterable[str | None]) -> tuple[str, ...]:
        """Return the footnote marks (a, b, c ...) of some notes; the same note keeps its mark."""
        marks = []
        for note in notes:
            if note:
                if note not in self.notes:
                    self.notes.append(note)
                marks.append(footnote(self.notes.index(note)))
        return tuple(marks)

    def add(self, block: str, row: str, columns: Sequence[str], cells: Sequence[Cell]) -> None:
        """Append a row to the block of that name and name its cells; the first one is the row's head."""
        if not self.blocks or self.blocks[-1][0] != block:
            self.blocks.append((block, []))
        named = tuple(
            replace(c, name=f"{self.identifier}/{row}/{column}", row=f"{self.identifier}/{row}", head=index == 0)
            for index, (column, c) in enumerate(zip(columns, cells, strict=True))
        )
        self.blocks[-1][1].append(named)


def footnote(index: int) -> str:
    """Return the mark of a footnote: a to z, then a1, b1 and so on."""
    return chr(ord("a") + index % 26) + (str(index // 26) if index >= 26 else "")


def text_cell(text: str) -> Cell:
    """Return a cell of words."""
    return Cell(text, numeric=False)


def missing_cell(why: str) -> Cell:
    """Return the cell of a value that does not exist, with the reason for it."""
    return Cell(MISSING, why=why)


def optimum_tables(result: ComparisonResult, trials: TrialPage | None = None) -> list[Table]:
    """Return Tables D.1 to D.5 (or whatever the rows are named): optimal points beside the published ones."""
    names = dict.fromkeys(row.table for row in result.tables)
    tables = []
    for name in names:
        rows = [row for row in result.tables if row.table == name]
        if not is_delay_table(rows):
            tables.append(_optimum_table(name, rows, result.motion, trials))
    return tables


def delay_tables(result: ComparisonResult, trials: TrialPage | None = None) -> list[Table]:
    """Return Table D.6 and others of its kind: one row a delay, three columns a criterion."""
    names = dict.fromkeys(row.table for row in result.tables)
    groups = [(name, [row for row in result.tables if row.table == name]) for name in names]
    return [_delay_table(name, rows, trials) for name, rows in groups if is_delay_table(rows)]


def measured_optimum_table(result: ComparisonResult, trials: TrialPage | None = None) -> Table | None:
    """Return the best trial of each experiment by each criterion, or None where there is none."""
    units = UNITS[result.motion]
    numbers = (f"stiffness [{units.stiffness}]", f"damping [{units.damping}]", "cost, 95 %", "equal trials")
    heads = (Head("criterion", numeric=False), *(Head(text) for text in numbers))
    table = Table("optima", "Trials with the least cost", heads)
    columns = ("criterion", "stiffness", "damping", "cost", "ties")
    for e in result.experiments:
        for criterion, best in e.optimum.items():
            marks = table.mark([CENSORED if best.censored else None])
            trial = _place(trials, e.experiment, best.trial_id)
            cells = [
                text_cell(criterion_label(criterion)),
                Cell(stiffness_text(best.stiffness), marks=marks, trial=trial),
                Cell(damping_text(best.damping), trial=trial),
                Cell(cost_text(criterion, best.cost), aside=_interval_text(criterion, best), trial=trial),
                Cell(str(best.ties)),
            ]
            table.add(f"experiment {e.experiment}", f"{e.experiment}/{criterion}", columns, cells)
    return table if table.blocks else None


def _place(trials: TrialPage | None, experiment: str | None, trial_id: str | None) -> str:
    """Return how the page refers to a trial; empty where it does not show it."""
    return trials.places.get((experiment or "", trial_id or ""), "") if trials else ""


def _interval_text(criterion: str, best: Optimum) -> str:
    if best.cost_low is None or best.cost_high is None:
        return ""
    return f"{cost_text(criterion, best.cost_low)} to {cost_text(criterion, best.cost_high)}"


def boundary_table(result: ComparisonResult, trials: TrialPage | None = None) -> Table | None:
    """Return the measured stability limit of all experiments over damping, or None where there is none."""
    tested = [e for e in result.experiments if e.boundary]
    if not tested:
        return None
    units = UNITS[result.motion]
    heads = [Head(f"damping [{units.damping}]")]
    columns = ["damping"]
    for e in tested:
        heads += [Head(name, f"experiment {e.experiment}") for name in ("stable", "unstable", "limit, 95 %")]
        columns += [f"{e.experiment}/{name}" for name in ("stable", "unstable", "limit")]
    caption = (
        f"Largest stable and smallest unstable stiffness [{units.stiffness}] at each damping, and the limit by the "
        "growth rates of the trials around it"
    )
    table = Table("boundary", caption, tuple(heads))
    for damping in sorted({p.damping for e in tested for p in e.boundary}):
        cells = [Cell(damping_text(damping))]
        for e in tested:
            cells += _boundary_cells(table, e, damping, trials.limits if trials else {})
        table.add("", damping_text(damping), columns, cells)
    return table


def missing_table(result: ComparisonResult) -> Table | None:
    """Return what could not be had and why, or None where nothing is missing."""
    heads = tuple(Head(text, numeric=False) for text in ("experiment", "result", "reason"))
    table = Table("missing", "Results that the logs do not allow", heads)
    for e in result.experiments:
        for what, why in e.missing.items():
            cells = (
                text_cell(e.experiment),
                text_cell(CRITERION_NAMES.get(what, what.replace("_", " "))),
                text_cell(why),
            )
            table.add("", f"{e.experiment}/{what}", ("experiment", "result", "reason"), cells)
    return table if table.blocks else None


def word_table(identifier: str, caption: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Table | None:
    """Return a table of words, or None where it has no rows; the first cell of a row names it."""
    table = Table(identifier, caption, tuple(Head(text, numeric=False) for text in heads))
    for row in rows:
        table.add("", row[0], heads, [text_cell(text) for text in row])
    return table if table.blocks else None


def _optimum_table(name: str, rows: Sequence[ComparisonRow], motion: Motion, trials: TrialPage | None) -> Table:
    units = UNITS[motion]
    published = any(row.published_cost is not None or row.published_stiffness is not None for row in rows)
    deviates = any(row.deviation_percent is not None for row in rows)
    names = list(dict.fromkeys(CRITERION_NAMES.get(row.criterion, row.criterion) for row in rows))
    values = [f"stiffness K [{units.stiffness}]", f"damping B [{units.damping}]", "cost"]
    heads = [Head("condition", numeric=False), *(Head(v, "this report" if published else "") for v in values)]
    columns = ["condition", "stiffness", "damping", "cost"]
    if deviates:
        heads.append(Head("deviation [%]", "this report" if published else ""))
        columns.append("deviation")
    if published:
        heads += [Head(v, "published") for v in ("K", "B", "cost")]
        columns += ["published_stiffness", "published_damping", "published_cost"]
    title = f"{table_label(name)[:1].upper()}{table_label(name)[1:]}. " if name else ""
    table = Table(name or "optima-theory", f"{title}Optimal points: {'; '.join(names)}", tuple(heads))
    for row in rows:
        why = row.note or "not available"
        marks = table.mark([row.note, CENSORED if row.censored else None])
        head = condition_label(row.condition)
        if row.delay_samples is not None and not row.condition.startswith("theory"):
            head += f" (d = {significant(row.delay_samples, 3)})"
        trial = _place(trials, row.experiment, row.trial_id)
        cells = [
            Cell(head, numeric=False, marks=marks),
            missing_cell(why) if row.stiffness is None else Cell(stiffness_text(row.stiffness), trial=trial),
            missing_cell(why) if row.damping is None else Cell(damping_text(row.damping), trial=trial),
            missing_cell(why) if row.cost is None else Cell(cost_text(row.criterion, row.cost), trial=trial),
        ]
        if deviates:
            cells.append(_deviation_cell(row))
        if published:
            cells += _published_cells(row)
        table.add(criterion_label(row.criterion), f"{row.criterion}/{row.condition}", columns, cells)
    return table


def _deviation_cell(row: ComparisonRow) -> Cell:
    if row.deviation_percent is not None:
        return Cell(percent_text(row.deviation_percent))
    if row.condition.startswith("theory"):
        return missing_cell("theory is what the deviation refers to")
    return missing_cell("no deviation: a cost is missing, or the cost of theory is zero")


def _published_cells(row: ComparisonRow) -> list[Cell]:
    cost = None if row.published_cost is None else row.published_cost * printed_scale(row.criterion)
    values = (row.published_stiffness, row.published_damping, cost)
    return [missing_cell("not published") if v is None else Cell(published_text(v)) for v in values]


def _delay_table(name: str, rows: Sequence[ComparisonRow], trials: TrialPage | None) -> Table:
    criteria = list(dict.fromkeys(row.criterion for row in rows))
    points = delay_points(rows)
    shared = Counter(point.delay for point in points)
    heads = [Head("delay d")]
    columns = ["delay"]
    for criterion in criteria:
        heads += [Head(text, criterion_label(criterion)) for text in ("theory", "experiment", "dev. %")]
        columns += [f"{criterion}/{text}" for text in ("theory", "experiment", "deviation")]
    title = table_label(name) if table_label(name) != name else name.capitalize()
    caption = f"{title}. Optimal costs over total delay"
    if any(row.published_cost is not None for row in rows):
        caption += "; published values in brackets"
    table = Table(name, caption, tuple(heads))
    for point in points:
        delay = MISSING if point.delay is None else significant(point.delay, 3)
        alone = shared[point.delay] == 1 and point.delay is not None
        cells = [Cell(delay, aside="" if alone else f"experiment {point.experiment}")]
        for criterion in criteria:
            measured = point.measured.get(criterion)
            cells.append(_cost_cell(table, point.theory.get(criterion), trials, "theory is not known at this delay"))
            cells.append(_cost_cell(table, measured, trials, "no trials at this delay"))
            cells.append(_deviation_cell(measured) if measured else missing_cell("not measured"))
        table.add("", f"d={delay}" if alone else f"d={delay}/{point.experiment}", columns, cells)
    return table


def _cost_cell(table: Table, row: ComparisonRow | None, trials: TrialPage | None, without: str) -> Cell:
    if row is None:
        return missing_cell(without)
    published = None if row.published_cost is None else row.published_cost * printed_scale(row.criterion)
    printed = "" if published is None else f"({published_text(published)})"
    marks = table.mark([row.note, CENSORED if row.censored else None])
    if row.cost is None:
        return Cell(MISSING, aside=printed, why=row.note or "not available", marks=marks)
    trial = _place(trials, row.experiment, row.trial_id)
    return Cell(cost_text(row.criterion, row.cost), aside=printed, marks=marks, trial=trial)


def _boundary_cells(
    table: Table, experiment: ExperimentResult, damping: float, trials: Mapping[tuple[str, float, float], str]
) -> list[Cell]:
    def trial(stiffness: float) -> str:
        return trials.get((experiment.experiment, damping, stiffness), "")

    point = next((p for p in experiment.boundary if p.damping == damping), None)
    if point is None:
        return [missing_cell("not tested at this damping")] * 3
    note = "The tested range ended before an unstable trial." if point.censored else None
    stable = missing_cell("no stable trial")
    if point.stable is not None:
        stable = Cell(stiffness_text(point.stable), trial=trial(point.stable))
    unstable = Cell(MISSING, why=note or "no unstable trial", marks=table.mark([note]))
    if point.unstable is not None:
        unstable = Cell(stiffness_text(point.unstable), marks=table.mark([note]), trial=trial(point.unstable))
    return [stable, unstable, _limit_cell(point)]


def _limit_cell(point: BoundaryPoint) -> Cell:
    if point.estimate is None or point.low is None or point.high is None:
        if not point.low:
            return missing_cell("no trial is surely stable or surely unstable")
        return Cell(f"≥ {stiffness_text(point.low)}")
    interval = f"{stiffness_text(point.low)} to {stiffness_text(point.high)}"
    return Cell(stiffness_text(point.estimate), aside=interval)
