"""Represent a table for the page, Markdown and LaTeX. Its cells contain text made from the rows of a data frame.

Every cell has a name that is unique in its report, such as ``D.1/settle_2pct/experiment_1/cost``: `verify` compares
cells by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

from pipeline.base.wording import shared_notes
from pipeline.rendering.labels import MISSING, span

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
"""Row of a table or data frame: its values by column. A missing value is None."""


@dataclass(frozen=True)
class Cell:
    """Printed content of a cell. ``aside`` is smaller text, ``why`` explains a missing value, and ``marks`` refer to
    notes.

    ``name`` is the column's name; ``trial`` refers to the trial of a number (`trial_page.reference`).
    """

    text: str
    name: str
    numeric: bool = True
    aside: str = ""
    why: str = ""
    marks: tuple[str, ...] = ()
    trial: str = ""


@dataclass(frozen=True)
class Column:
    """Column of a table, with its name in the frame, its head, and the conversion of its values to cells.

    Parameters
    ----------
    name : str
    label : str
        Head without the unit. If it is empty, the name is used.
    unit, group : str
        Unit, and heading that the column shares with neighbouring columns.
    show : callable, optional
        Function that formats a number of a row. Words are printed unchanged.
    ends : (str, str), optional
        Columns with the ends of the interval. The interval is left out if both ends are printed like the value.
    aside : callable, optional
        Function that formats the text next to the value.
    why : str
        Reason for a missing value if the row has no ``reason``.
    notes : callable, optional
        Function that yields the texts of the footnotes of a value.
    optional : bool
        Whether the column is left out if no row has a value.
    linked : bool
        Whether the column refers to the trial of its row. If ``link`` is given, it names another trial.
    """

    name: str
    label: str = ""
    unit: str = ""
    group: str = ""
    show: Callable[[Any, Row], str] | None = None
    ends: tuple[str, str] | None = None
    aside: Callable[[Row], str] | None = None
    why: str = ""
    notes: Callable[[Row], Iterable[str | None]] | None = None
    optional: bool = False
    linked: bool = False
    link: Callable[[Row], str] | None = None

    @property
    def head(self) -> str:
        """Label with the unit in brackets."""
        label = self.label or self.name
        return f"{label} [{self.unit}]" if self.unit else label

    def cell(self, row: Row, table: Table, trial: str) -> Cell:
        """Return the cell of a row."""
        value = row.get(self.name)
        marks = table.mark(*self.notes(row)) if self.notes else ()
        beside = self.aside(row) if self.aside else ""
        numeric = self.show is not None
        if value is None or value == "":
            why = self.why or row.get("reason") or "not available"
            marks = marks or (table.mark(why) if why in table.notes else ())
            return Cell(MISSING, self.name, numeric=numeric, aside=beside, why=why, marks=marks)
        if self.show is None:
            return Cell(str(value), self.name, numeric=False, aside=beside, marks=marks)
        text = self.show(value, row)
        if self.ends and not beside:
            shown = self.show
            beside = span(lambda end: shown(end, row), *(row.get(end) for end in self.ends))
            beside = "" if beside == f"{text} to {text}" else beside
        place = self.link(row) if self.link else trial if self.linked else ""
        return Cell(text, self.name, aside=beside, marks=marks, trial=place)


@dataclass
class Table:
    """Table in which each block of rows may have a separate heading, and each row has a name."""

    name: str
    caption: str
    columns: Sequence[Column]
    blocks: list[tuple[str, list[tuple[str, tuple[Cell, ...]]]]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def rows(self) -> list[tuple[Cell, ...]]:
        """The rows of all blocks."""
        return [cells for _, rows in self.blocks for _, cells in rows]

    @property
    def reasons(self) -> dict[str, str]:
        """Return the reasons of cells (except notes), each with the text below the table that cells with this reason
        share."""
        whys = (cell.why for row in self.rows for cell in row)
        return shared_notes([why for why in whys if why and why not in self.notes])

    @property
    def whys(self) -> list[str]:
        """Return the distinct texts of `reasons`. They are needed because print and touch screens have no hovering."""
        return list(dict.fromkeys(self.reasons.values()))

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Return the headings above the column heads, each with the number of columns that it spans."""
        spans = [(group, len(list(same))) for group, same in groupby(column.group for column in self.columns)]
        return spans if any(group for group, _ in spans) else []

    @property
    def footnotes(self) -> list[tuple[str, str]]:
        """Return each note with its mark, which is empty for a note on the whole table, to which no cell refers."""
        used = {mark for row in self.rows for cell in row for mark in cell.marks}
        marks = [footnote(index) for index in range(len(self.notes))]
        return [(mark if mark in used else "", note) for mark, note in zip(marks, self.notes, strict=True)]

    def mark(self, *notes: str | None) -> tuple[str, ...]:
        """Return the footnote marks (a, b, c ...) of notes. Equal notes share a mark."""
        given = [note for note in notes if note]
        self.notes += [note for note in dict.fromkeys(given) if note not in self.notes]
        return tuple(footnote(self.notes.index(note)) for note in given)


def table_of(
    name: str,
    caption: str,
    columns: Sequence[Column],
    frame: pd.DataFrame | Sequence[Row],
    row: Callable[[Row], str],
    block: Callable[[Row], str] = lambda _: "",
    trial: Callable[[Row], str] = lambda _: "",
) -> Table | None:
    """Return a table of the rows of a frame, or None if there are no rows.

    Parameters
    ----------
    name, caption : str
    columns : sequence of Column
    frame : DataFrame, or sequence of mapping
    row, block : callable
        Functions that return the name of a row, which is unique in the table, and the heading of its block.
    trial : callable
        Function that returns the reference to the trial of a row's linked columns.
    """
    rows = records(frame)
    shown = [c for c in columns if not c.optional or any(each.get(c.name) is not None for each in rows)]
    table = Table(name, caption, shown)
    for each in rows:
        heading = block(each)
        if not table.blocks or table.blocks[-1][0] != heading:
            table.blocks.append((heading, []))
        cells = tuple(column.cell(each, table, trial(each)) for column in shown)
        table.blocks[-1][1].append((f"{name}/{row(each)}", cells))
    return table if rows else None


def records(frame: pd.DataFrame | Sequence[Row]) -> list[Row]:
    """Return the rows of a frame with None in place of NaN."""
    if isinstance(frame, Sequence):
        return [dict(row) for row in frame]
    return [{k: None if v is None or v != v else v for k, v in row.items()} for row in frame.to_dict("records")]


def word_table(name: str, caption: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Table | None:
    """Return a table of words, or None if there are no rows. The first cell of a row is also the name of the row."""
    columns = [Column(head) for head in heads]
    return table_of(name, caption, columns, [dict(zip(heads, row, strict=True)) for row in rows], lambda r: r[heads[0]])


def marked(table: Table, *, simulated: bool, more: str = "") -> Table:
    """Return a table with ``more`` in its caption, and a remark if its numbers come from simulated logs."""
    words = "; ".join(filter(None, ["simulated" if simulated else "", more]))
    return replace(table, caption=f"{table.caption} ({words})") if words else table


def footnote(index: int) -> str:
    """Return the mark of a footnote: a to z, then a1, b1 and so on."""
    return chr(ord("a") + index % 26) + (str(index // 26) if index >= 26 else "")


def is_sweep(rows: Sequence[Row]) -> bool:
    """Return whether the rows of one table are over delay.

    In this case, measured rows differ only in their experiment.
    """
    measured = [(row["criterion"], row["condition"]) for row in rows if not row["condition"].startswith("theory")]
    return len(set(measured)) < len(measured)
