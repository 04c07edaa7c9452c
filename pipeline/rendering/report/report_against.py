"""The page about two experiments, devices or code versions: tables of differences and boundaries in one figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.base.disk import write_text
from pipeline.base.wording import unbroken
from pipeline.records.against_records import (
    AgainstResult,
    CostDifference,
    PairDifference,
    ValueDifference,
)
from pipeline.records.figure_records import Figure, Limits
from pipeline.records.models import Motion
from pipeline.rendering.labels import UNITS, criterion_name, percent_text, significant, span
from pipeline.rendering.report.page_template import fill_template
from pipeline.rendering.report.report_figures import Drawing
from pipeline.rendering.table import Cell, Column, Table, footnote, marked, missing, number, words

FOUR = partial(significant, digits=4)
"""Prints a value: differences of few per cent are told apart."""

INTERVAL, SIGNIFICANT = Column("interval", "95 %"), words("significant")


@dataclass(frozen=True)
class AgainstPage:
    """A finished comparison with its figures (one a pair)."""

    result: AgainstResult
    figures: tuple[Figure[Limits], ...]
    motion: Motion


def render(page: AgainstPage) -> str:
    """Return the page as one HTML document."""

    from pipeline.rendering.figures import figures

    parts = []
    for index, (pair, drawn) in enumerate(zip(page.result.pairs, page.figures, strict=True)):
        figure = replace(drawn, simulated=pair.simulated)
        drawing = Drawing(figure.identifier, figure.title, figure.caption, figures.boundaries(figure, page.motion), "")
        parts.append({"pair": pair, "figure": drawing, "tables": pair_tables(pair, page.motion, index)})
    sides = [side for pair in page.result.pairs for side in (pair.first, pair.second) if side.simulated]
    simulated = list(dict.fromkeys(side.label for side in sides))
    page_text = fill_template(
        "report_against.html.j2", result=page.result, parts=parts, footnote=footnote, simulated=simulated
    )
    return unbroken(page_text)


def write(page: AgainstPage, path: Path) -> AgainstResult:
    """Write the page, and its document as JSON beside it; return the document with the name of the page."""
    result = page.result.model_copy(update={"report": str(path)})
    write_text(path, render(AgainstPage(result, page.figures, page.motion)))
    write_text(path.with_suffix(".json"), result.model_dump_json(indent=1) + "\n")
    return result


def pair_tables(pair: PairDifference, motion: Motion, index: int = 0) -> list[Table]:
    """Return the tables of a pair that have rows: estimates, optima, scores, costs at common points, boundary, excluded
    trials, notes.

    Parameters
    ----------
    pair : PairDifference
    motion : {"translation", "rotation"}
    index : int
        Of the pair on its page: cells of several pairs need names of their own.
    """
    physical = pair.plane == "physical"
    stiffness, damping = (UNITS[motion].stiffness, UNITS[motion].damping) if physical else ("α", "β")
    found = [
        _value_table(f"estimates-{index}", "Estimates", pair, pair.estimates),
        _value_table(f"optima-{index}", "Optimal points and their costs", pair, pair.optima),
        _value_table(f"scores-{index}", "Scores against theory", pair, pair.scores),
        _cost_table(f"costs-{index}", pair.costs),
        _boundary_table(f"boundary-{index}", pair, stiffness, damping),
        _excluded_table(f"excluded-{index}", pair),
        _notes_table(f"notes-{index}", pair),
    ]
    return [marked(table, simulated=pair.simulated) for table in found if table.blocks]


def _value_table(name: str, caption: str, pair: PairDifference, values: Sequence[ValueDifference]) -> Table:
    first, second = map(Column, ("first", "second"), pair.labels)
    columns = (words("name", ""), first, second, Column("difference"), INTERVAL, SIGNIFICANT)
    table = Table(name, f"{caption}: second minus first", columns)
    for v in values:
        unit = f" [{v.unit.replace('^2', '²')}]" if v.unit else ""
        why = v.reason or "not available"
        numbers = {what: number(getattr(v, what), FOUR, why) for what in ("first", "second", "difference")}
        table.add(v.name, {"name": value_name(v.name) + unit, **numbers, **_judgement(v)})
    return table


def _judgement(v: ValueDifference | CostDifference) -> dict[str, Any]:
    if v.low is None or v.high is None:
        nothing = missing(v.reason or "no interval")
        return {"interval": nothing, "significant": nothing}
    interval = span(FOUR, v.low, v.high)
    return {"interval": Cell(interval, interval), "significant": "yes" if v.significant else "no"}


def value_name(name: str) -> str:
    """Return what a quantity of a `ValueDifference` is called: its name, or part and name with a slash between."""
    criterion, _, what = name.partition("/")
    named = criterion_name(criterion.removesuffix("_samples"))
    return f"{named}: {what.replace('_', ' ')}" if what else named


def _cost_table(name: str, costs: Sequence[CostDifference]) -> Table:
    columns = (words("criterion"), Column("points"), Column("median", "second over first"), INTERVAL, SIGNIFICANT)
    table = Table(name, "Costs at common stiffness and damping: median of second over first", columns)
    for c in costs:
        aside = "" if c.kind == "ratio" else "difference, as a fraction"
        median = number(c.median, FOUR, c.reason or "no common point", aside=aside)
        values = {"criterion": value_name(c.criterion), "points": c.points, "median": median}
        table.add(c.criterion, {**values, **_judgement(c)})
    return table


def _boundary_table(name: str, pair: PairDifference, stiffness: str, damping: str) -> Table:
    limit = partial(Column, group=f"limit [{stiffness}]", show=FOUR)
    first, second = map(limit, ("first", "second"), pair.labels)
    difference = Column("difference", unit="%", show=percent_text)
    columns = (Column("damping", unit=damping, show=FOUR), first, second, difference, SIGNIFICANT)
    table = Table(name, "Stability limits over damping", columns)
    for p in pair.boundary.points if pair.boundary else ():
        sure: Cell | str = missing("no interval on both sides")
        if p.significant is not None:
            sure = "yes" if p.significant else "no"
        table.add(significant(p.damping, 6), {**dict(p), "difference": p.percent, "significant": sure})
    return table


def _excluded_table(name: str, pair: PairDifference) -> Table:
    columns = [words(head) for head in ("side", "trial", "log", "reason", "since")]
    table = Table(name, "Trials excluded by hand", columns)
    for label, side in zip(pair.labels, (pair.first, pair.second), strict=True):
        for one in side.excluded:
            cells = {"side": label, "trial": one.trial_id, "log": one.log, "reason": one.reason, "since": one.since}
            table.add(f"{label}/{one.trial_id}", cells)
    return table


def _notes_table(name: str, pair: PairDifference) -> Table:
    table = Table(name, "Notes and tags of the lab", [words(head) for head in ("side", "trial", "tags", "note")])
    for label, side in zip(pair.labels, (pair.first, pair.second), strict=True):
        for one in side.notes:
            cells = {"side": label, "trial": one.trial_id or "all", "tags": ", ".join(one.tags), "note": one.text}
            table.add(f"{label}/{one.trial_id or ''}", cells)
    return table
