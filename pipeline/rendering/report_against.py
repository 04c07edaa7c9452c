"""The page about two experiments, devices or code versions: tables of differences and boundaries in one figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.base.disk import write_text
from pipeline.base.wording import unbroken
from pipeline.records.against_records import (
    AgainstResult,
    BoundaryDifference,
    CostDifference,
    PairDifference,
    ValueDifference,
)
from pipeline.records.figure_records import BoundaryFigure
from pipeline.records.models import Motion
from pipeline.rendering import report_tables
from pipeline.rendering.labels import CRITERION_NAMES, UNITS, percent_text, significant
from pipeline.rendering.page_template import fill_template
from pipeline.rendering.report_figures import Drawing
from pipeline.rendering.report_tables import Cell, Head, Table, missing_cell, text_cell

DIGITS = 4
"""Digits of a printed value; differences of few per cent are told apart."""


@dataclass(frozen=True)
class AgainstPage:
    """A finished comparison with its figures (one a pair)."""

    result: AgainstResult
    figures: tuple[BoundaryFigure, ...]
    motion: Motion


def render(page: AgainstPage) -> str:
    """Return the page as one HTML document."""

    from pipeline.rendering import figures

    parts = []
    for number, (pair, figure) in enumerate(zip(page.result.pairs, page.figures, strict=True)):
        drawing = Drawing(figure.identifier, figure.title, figure.caption, figures.boundaries(figure, page.motion), "")
        parts.append({"pair": pair, "figure": drawing, "tables": pair_tables(pair, page.motion, number)})
    page_text = fill_template(
        "report_against.html.j2", result=page.result, parts=parts, footnote=report_tables.footnote
    )
    return unbroken(page_text)


def write(page: AgainstPage, path: Path) -> AgainstResult:
    """Write the page, and its document as JSON beside it; return the document with the name of the page."""
    result = page.result.model_copy(update={"report": str(path)})
    write_text(path, render(AgainstPage(result, page.figures, page.motion)))
    write_text(path.with_suffix(".json"), result.model_dump_json(indent=1) + "\n")
    return result


def pair_tables(pair: PairDifference, motion: Motion, number: int = 0) -> list[Table]:
    """Return the tables of a pair that have rows: estimates, optima, costs at common points, boundary.

    Parameters
    ----------
    pair : PairDifference
    motion : {"translation", "rotation"}
    number : int
        Of the pair on its page: cells of several pairs need names of their own.
    """
    physical = pair.plane == "physical"
    stiffness, damping = (UNITS[motion].stiffness, UNITS[motion].damping) if physical else ("α", "β")
    found = [
        _value_table(f"estimates-{number}", "Estimates", pair, pair.estimates),
        _value_table(f"optima-{number}", "Optimal points and their costs", pair, pair.optima),
        _cost_table(f"costs-{number}", pair.costs),
        _boundary_table(f"boundary-{number}", pair, pair.boundary, stiffness, damping),
    ]
    return [table for table in found if table is not None and table.blocks]


def _value_table(name: str, caption: str, pair: PairDifference, values: tuple[ValueDifference, ...]) -> Table:
    heads = (
        Head("", numeric=False),
        *(Head(text) for text in (*pair.labels, "difference", "95 %")),
        Head("significant", numeric=False),
    )
    table = Table(name, f"{caption}: second minus first", heads)
    columns = ("name", "first", "second", "difference", "interval", "significant")
    for v in values:
        unit = f" [{v.unit.replace('^2', '²')}]" if v.unit else ""
        reason = v.reason or "not available"
        numbers = [Cell(significant(x, DIGITS)) if x is not None else missing_cell(reason) for x in (v.first, v.second)]
        difference = missing_cell(reason) if v.difference is None else Cell(significant(v.difference, DIGITS))
        table.add("", v.name, columns, [text_cell(_words(v.name) + unit), *numbers, difference, *_judgement(v)])
    return table


def _judgement(v: ValueDifference | CostDifference) -> list[Cell]:
    if v.low is None or v.high is None:
        return [missing_cell(v.reason or "no interval")] * 2
    return [
        Cell(f"{significant(v.low, DIGITS)} to {significant(v.high, DIGITS)}"),
        text_cell("yes" if v.significant else "no"),
    ]


def _words(name: str) -> str:
    criterion, _, what = name.partition("/")
    words = CRITERION_NAMES.get(criterion, criterion.removesuffix("_samples").replace("_", " "))
    return f"{words}: {what}" if what else words


def _cost_table(name: str, costs: tuple[CostDifference, ...]) -> Table:
    heads = (
        Head("criterion", numeric=False),
        *(Head(t) for t in ("points", "second over first", "95 %")),
        Head("significant", numeric=False),
    )
    table = Table(name, "Costs at common stiffness and damping: median of second over first", heads)
    for c in costs:
        middle = missing_cell(c.reason or "no common point")
        if c.median is not None:
            plain = c.kind == "ratio"
            middle = Cell(significant(c.median, DIGITS), aside="" if plain else "difference, as a fraction")
        columns = ("criterion", "points", "median", "interval", "significant")
        table.add(
            "", c.criterion, columns, [text_cell(_words(c.criterion)), Cell(str(c.points)), middle, *_judgement(c)]
        )
    return table


def _boundary_table(
    name: str, pair: PairDifference, edge: BoundaryDifference | None, stiffness: str, damping: str
) -> Table | None:
    if edge is None:
        return None
    heads = [Head(f"damping [{damping}]"), *(Head(t, f"limit [{stiffness}]") for t in pair.labels)]
    table = Table(
        name, "Stability limits over damping", (*heads, Head("difference [%]"), Head("significant", numeric=False))
    )
    for p in edge.points:
        sure = (
            missing_cell("no interval on both sides")
            if p.significant is None
            else text_cell("yes" if p.significant else "no")
        )
        cells = [
            *(Cell(significant(x, DIGITS)) for x in (p.damping, p.first, p.second)),
            Cell(percent_text(p.percent)),
            sure,
        ]
        columns = ("damping", "first", "second", "difference", "significant")
        table.add("", significant(p.damping, 6), columns, cells)
    return table
