"""The one model of a table: what page, CSV, JSON, Markdown and LaTeX render.

Every cell has a name that is unique in its report, such as ``D.1/settle_2pct/experiment_1/cost``: `verify`
compares cells by name, and a test can ask for one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from typing import Any, Self

from pipeline.base.wording import shared_notes
from pipeline.rendering.labels import MISSING, span

Value = str | float | int | bool | None

WIDEST = 10
"""Columns of a table that fit beside each other into a window of 1280 px."""

FEWEST_GROUPS = 3
"""Headings over columns from which on a table repeats itself, once for each experiment or criterion."""


@dataclass(frozen=True)
class Cell:
    """A value and how it is printed; ``aside`` is smaller text, ``why`` explains a missing value, ``marks`` name notes.

    ``name`` begins with that of its ``row``; the page holds both apart, since names would else be a tenth of it.
    ``trial`` refers to the trial that a number stands for (see `trial_records.reference`), empty where there is none.
    """

    value: Value
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
class Column:
    """A column: its name, what is printed above it, and how its plain values become cells.

    Parameters
    ----------
    name : str
        Unique in the table.
    label : str, optional
        Head without unit; the name where it is not given.
    unit : str
    group : str
        Heading that neighbours share.
    numeric : bool
        Whether it holds numbers, not words.
    show : callable
        Prints a number.
    why : str
        Why a value is missing, where nothing else is known.
    """

    name: str
    label: str | None = None
    unit: str = ""
    group: str = ""
    numeric: bool = True
    show: Callable[[Any], str] = str
    why: str = ""

    @property
    def head(self) -> str:
        """Label with the unit in brackets."""
        label = self.name if self.label is None else self.label
        return f"{label} [{self.unit}]" if self.unit else label

    def cell(self, value: Cell | Value) -> Cell:
        """Return a plain value as a cell; what is one already stays."""
        if isinstance(value, Cell):
            return value
        if isinstance(value, str):
            return Cell(value, value, numeric=self.numeric)
        return number(value, self.show, self.why)


def words(name: str, label: str | None = None) -> Column:
    """Return a column of words."""
    return Column(name, label, numeric=False)


def number(
    value: float | None,
    show: Callable[[Any], str],
    why: str = "",
    *,
    ends: tuple[float | None, float | None] = (None, None),
    **more: Any,
) -> Cell:
    """Return the cell of a number with the ends of its interval, or of one that is missing with the reason for it."""
    if value is None:
        return missing(why)
    return Cell(value, show(value), **({"aside": span(show, *ends)} | more))


def missing(why: str, **more: Any) -> Cell:
    """Return the cell of a value that does not exist, with the reason for it."""
    return Cell(None, MISSING, why=why, **more)


@dataclass
class Table:
    """A table; each block of rows may have a heading of its own."""

    name: str
    caption: str
    columns: Sequence[Column]
    blocks: list[tuple[str, list[tuple[Cell, ...]]]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def filled(self) -> Self | None:
        """The table, or None where it has no rows."""
        return self if self.blocks else None

    @property
    def rows(self) -> list[tuple[Cell, ...]]:
        """The rows of all blocks."""
        return [row for _, rows in self.blocks for row in rows]

    @property
    def records(self) -> list[dict[str, Value]]:
        """The values of all rows by column, as other programs take them."""
        return [{c.name: cell.value for c, cell in zip(self.columns, row, strict=True)} for row in self.rows]

    @property
    def reasons(self) -> dict[str, str]:
        """The reasons of cells that are no notes, each with the text below the table that it shares with others."""
        whys = (cell.why for row in self.rows for cell in row)
        return shared_notes([why for why in whys if why and why not in self.notes])

    @property
    def whys(self) -> list[str]:
        """The texts of `reasons`, each once: print and touch show no text on pointing."""
        return list(dict.fromkeys(self.reasons.values()))

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the column heads with the columns each spans; empty where there are none."""
        spans = [(group, len(list(same))) for group, same in groupby(column.group for column in self.columns)]
        return spans if any(group for group, _ in spans) else []

    @property
    def parts(self) -> list[Table]:
        """The table as a page shows it: one of many groups in parts side by side no longer, but below each other.

        Each part has the first column and whole groups, up to `WIDEST` columns, and no row that is empty in it; notes
        stand below the last.
        """
        spans, places = self.groups, range(1, len(self.columns))
        if len(self.columns) <= WIDEST or sum(bool(name) for name, _ in spans) < FEWEST_GROUPS:
            return [self]
        ends = [sum(span for _, span in spans[:n]) for n in range(2, len(spans) + 1)]
        cuts = [1]
        for end, after in zip(ends, [*ends[1:], ends[-1]], strict=True):
            if after - cuts[-1] + 1 > WIDEST or end == len(self.columns):
                cuts.append(end)
        named: set[str] = set()
        parts = []
        for number, (start, end) in enumerate(pairwise(cuts), 1):
            columns = (0, *places[start - 1 : end - 1])
            caption = f"Part {number} of {len(cuts) - 1}. {self.caption}" if number > 1 else self.caption
            part = Table(self.name, caption, [self.columns[c] for c in columns])
            blocks = ((block, self._rows_of_part(rows, columns, named)) for block, rows in self.blocks)
            part.blocks = [(block, rows) for block, rows in blocks if rows]
            parts.append(part)
        parts[-1].notes = self.notes
        return parts

    @staticmethod
    def _rows_of_part(
        rows: Sequence[tuple[Cell, ...]], columns: Sequence[int], named: set[str]
    ) -> list[tuple[Cell, ...]]:
        """Rows with a value in these columns; a head that stands in a part before has no name again."""
        shown = []
        for row in rows:
            head, *cells = (row[c] for c in columns)
            if any(cell.text != MISSING for cell in cells):
                shown.append((replace(head, name="") if head.name in named else head, *cells))
                named.add(head.name)
        return shown

    def mark(self, *notes: str | None) -> tuple[str, ...]:
        """Return the footnote marks (a, b, c ...) of some notes; the same note keeps its mark."""
        told = [note for note in notes if note]
        self.notes += [note for note in dict.fromkeys(told) if note not in self.notes]
        return tuple(footnote(self.notes.index(note)) for note in told)

    def add(self, row: str, values: Mapping[str, Any], block: str = "") -> None:
        """Append a row to the block of that name; the first cell is the row's head.

        Parameters
        ----------
        row : str
            Name of the row; that of a cell is table, row and column.
        values : mapping
            By column; a column without one gets a missing value, and what no column asks for is left out.
        """
        if not self.blocks or self.blocks[-1][0] != block:
            self.blocks.append((block, []))
        place = f"{self.name}/{row}"
        cells = [
            replace(column.cell(values.get(column.name)), name=f"{place}/{column.name}", row=place, head=index == 0)
            for index, column in enumerate(self.columns)
        ]
        self.blocks[-1][1].append(tuple(cells))


def word_table(name: str, caption: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Table | None:
    """Return a table of words, or None where it has no rows; the first cell of a row names it."""
    table = Table(name, caption, [words(head) for head in heads])
    for row in rows:
        table.add(row[0], dict(zip(heads, row, strict=True)))
    return table.filled


def marked(table: Table, *, simulated: bool) -> Table:
    """Return a table whose caption says that its numbers are those of simulated logs, where they are."""
    return replace(table, caption=f"{table.caption} (simulated)") if simulated else table


def footnote(index: int) -> str:
    """Return the mark of a footnote: a to z, then a1, b1 and so on."""
    return chr(ord("a") + index % 26) + (str(index // 26) if index >= 26 else "")
