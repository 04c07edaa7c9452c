"""Write the page on two experiments, devices or code versions.

It has tables of differences, and one figure with both boundaries.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.base.disk import write_text
from pipeline.base.wording import unbroken
from pipeline.records.models import Motion
from pipeline.records.results import (
    AgainstResult,
    BoundaryDifference,
    CostDifference,
    PairDifference,
    Plane,
    ValueDifference,
)
from pipeline.rendering.figures.drawing import Figure, draw
from pipeline.rendering.labels import UNITS, criterion_name, interval_texts, percent_text, significant, unit_text
from pipeline.rendering.report.page_template import fill_template
from pipeline.rendering.table import Column, Row, Table, marked, table_of
from pipeline.rendering.tables.formats import digits

_four = digits(4)


def _shown(_: Any, row: Row) -> str:
    return str(row["shown"])


@dataclass(frozen=True)
class AgainstPage:
    """Finished comparison with its figures, one for each pair."""

    result: AgainstResult
    figures: tuple[Figure, ...]
    motion: Motion


def render(page: AgainstPage) -> str:
    """Return the page as one HTML document."""
    parts = []
    for index, (pair, figure) in enumerate(zip(page.result.pairs, page.figures, strict=True)):
        drawn = draw(replace(figure, simulated=pair.simulated))
        parts.append({"pair": pair, "figure": drawn, "tables": pair_tables(pair, page.motion, index)})
    sides = [side for pair in page.result.pairs for side in (pair.first, pair.second) if side.simulated]
    simulated = list(dict.fromkeys(side.label for side in sides))
    content = {"result": page.result, "parts": parts, "simulated": simulated}
    return unbroken(fill_template("report_against.html.j2", **content))


def write(page: AgainstPage, path: Path) -> AgainstResult:
    """Write the page, and its document as JSON next to it. Return the document with the name of the page."""
    found = page.result
    result = AgainstResult(
        title=found.title,
        pairs=found.pairs,
        only_first=found.only_first,
        only_second=found.only_second,
        report=str(path),
    )
    write_text(path, render(replace(page, result=result)))
    write_text(path.with_suffix(".json"), result.model_dump_json(indent=1) + "\n")
    return result


def sentences_of(
    labels: tuple[str, str],
    plane: Plane,
    boundary: BoundaryDifference | None,
    boundary_reason: str | None,
    estimates: Sequence[ValueDifference],
    costs: Sequence[CostDifference],
) -> tuple[str, ...]:
    """Return the conclusions on a pair of experiments, in sentences."""
    about = {"labels": labels, "plane": plane, "edge": boundary, "reason": boundary_reason}
    lines = fill_template("against.txt.j2", **about, estimates=estimates, costs=costs).splitlines()
    return tuple(" ".join(line.split()) for line in lines if line.strip())


def value_name(name: str) -> str:
    """Return the label of a quantity of a `ValueDifference`. It is the name, or part and name joined by a slash."""
    criterion, _, what = name.partition("/")
    named = criterion_name(criterion.removesuffix("_samples"))
    return f"{named}: {what.replace('_', ' ')}" if what else named


def pair_tables(pair: PairDifference, motion: Motion, index: int = 0) -> list[Table]:
    """Return the non-empty tables of a pair. ``index`` makes the cell names unique if a page has several pairs."""
    K, B = (UNITS[motion].stiffness, UNITS[motion].damping) if pair.plane == "physical" else ("α", "β")
    first, second = pair.labels
    judged = (
        Column("difference", show=_shown),
        Column("interval", "95 %", show=lambda text, _: str(text), why="no interval"),
        Column("sure", "significant", why="no interval"),
    )
    both = Column("first", first, show=_four), Column("second", second, show=_four)
    values = (Column("head", "quantity"), *both, *judged)
    costs = (
        Column("head", "criterion"),
        Column("points", show=_four),
        Column("median", "second over first", show=_shown, aside=_kind),
        *judged[1:],
    )
    limits = (
        Column("damping", unit=B, show=_four),
        Column("first", first, "", f"limit [{K}]", _four),
        Column("second", second, "", f"limit [{K}]", _four),
        Column("percent", "difference", "%", show=lambda value, _: percent_text(value)),
        judged[2],
    )
    sides = list(zip(pair.labels, (pair.first, pair.second), strict=True))
    excluded = [{"side": label, **dict(one)} for label, side in sides for one in side.excluded]
    notes = [
        {"side": label, **dict(one), "trial": one.trial_id or "all", "tag": ", ".join(one.tags)}
        for label, side in sides
        for one in side.notes
    ]
    whats, words = _words("side", "trial_id", "log", "reason", "since"), _words("side", "trial", "tag", "text")
    found = [
        _table("estimates", "Estimates: second minus first", values, pair.estimates, index),
        _table("optima", "Optimal points and their costs: second minus first", values, pair.optima, index),
        _table("scores", "Scores against theory: second minus first", values, pair.scores, index),
        _table("costs", "Costs at common stiffness and damping: median of second over first", costs, pair.costs, index),
        _table(
            "boundary", "Stability limits over damping", limits, pair.boundary.points if pair.boundary else (), index
        ),
        table_of(f"excluded-{index}", "Trials excluded by hand", whats, excluded, _of_side("trial_id")),
        table_of(f"notes-{index}", "Notes and tags of the lab", words, notes, _of_side("trial")),
    ]
    return [marked(table, simulated=pair.simulated) for table in found if table is not None]


def _table(name: str, caption: str, columns: Sequence[Column], values: Sequence[Any], index: int) -> Table | None:
    rows = []
    for value in values:
        row = dict[str, object](value)
        called = row.get("name") or row.get("criterion") or significant(row.get("damping", 0.0), 6)
        unit = f" [{unit_text(row['unit'])}]" if row.get("unit") else ""
        row |= {
            "name": called,
            "head": value_name(called) + unit,
            "sure": {True: "yes", False: "no", None: None}[row["significant"]],
        }
        row["shown"], *ends = interval_texts(row.get("difference", row.get("median")), row.get("low"), row.get("high"))
        row["interval"] = " to ".join(dict.fromkeys(filter(None, ends))) or None
        rows.append(row)
    return table_of(f"{name}-{index}", caption, columns, rows, lambda row: str(row["name"]))


def _words(*names: str) -> list[Column]:
    return [Column(name, name.removesuffix("_id"), why="nothing was written") for name in names]


def _of_side(name: str) -> Callable[[Row], str]:
    return lambda row: f"{row['side']}/{row[name]}"


def _kind(row: Row) -> str:
    return "" if row["kind"] == "ratio" else "difference, as a fraction"
