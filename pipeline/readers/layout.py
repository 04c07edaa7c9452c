"""How delimited text is laid out, as far as it can be seen without knowing the lab.

Only what the file shows beyond doubt is given as known; the rest is asked.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

from pipeline.base.errors import LogError, refusal
from pipeline.profiles.profile_columns import BLANKS, TextLayout
from pipeline.readers.formats.delimited import plain_text

PROBE_LINES = 400
"""Lines that are looked at: banners have some dozens, and a table shows its form in a hundred rows."""

FEWEST_ROWS = 2
"""Rows that make a table."""

NUMERIC_SHARE = 0.5
"""Share of numbers among the cells of a row, from which it is one: text columns may stand beside numbers."""

_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf)", re.IGNORECASE)
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:[.,]\d{3})+")
"""Numbers whose sign may part thousands as well: "1,234"."""

_LABEL = re.compile(r"\s*([^\W\d][^:=]*?)\s*([:=])\s*(\S.*)")
_DELIMITERS = (";", "\t", "|", ",", BLANKS)
"""In the order in which they are taken where several fit."""


@dataclass
class Layout:
    """Keys of a profile that lay out a text file, and questions about them by key."""

    keys: dict[str, Any] = field(default_factory=dict)
    questions: dict[str, str] = field(default_factory=dict)

    def to_read(self) -> dict[str, Any]:
        """Return keys by which the file can be read for a look at it, although something is asked."""
        return {"encoding": "latin-1", **self.keys} if "encoding" in self.questions else self.keys


def text_layout(name: str, data: bytes) -> Layout:
    """Return how a text file is laid out.

    Raises
    ------
    LogError
        If no table of numbers is found.
    """
    layout = Layout()
    lines = _text(name, data, layout).split("\n")[:-1]
    probe = lines[:PROBE_LINES]
    # the last line of a recording may be cut
    delimiter, rows = _table(probe[:-1] if len(probe) > FEWEST_ROWS else probe, name)
    keys = layout.keys
    keys["delimiter"] = delimiter
    cells = [_split(lines[row], delimiter) for row in rows]
    if delimiter != BLANKS and all(not row[-1] for row in cells):
        keys["trailing_delimiter"] = True
        cells = [row[:-1] for row in cells]
    _decimal([cell for row in cells for cell in row], layout)
    above = lines[: rows[0]]
    between = [lines[i] for i in range(rows[0], rows[-1]) if i not in set(rows)]
    lead = above[: max((i for i, line in enumerate(above, start=1) if line.strip()), default=0)]
    heads = list(takewhile(lambda line: _is_head(line, len(cells[0]), keys), lead[:-3:-1]))
    skipped = len(lead) - len(heads) if heads else len(above)
    keys |= {} if heads else {"header": False}
    keys |= {"unit_line": True} if len(heads) == 2 else {}
    keys |= {"skip_rows": skipped} if skipped else {}
    if any(not line.strip() for line in between):
        keys["blank_lines"] = "skip"
    beside = (*above[:skipped], *between)
    if found := [(line, match[2]) for line in beside if (match := _LABEL.fullmatch(line.lstrip("#%/ ")))]:
        keys["labels"] = sign = Counter(sign for _, sign in found).most_common(1)[0][0]
        # labels in remarks are read where the profile says what begins a remark
        marks = {mark[1] for line, of in found if of == sign and (mark := re.match(r"\s*([#%/]+)", line))}
        keys |= {"comment": marks.pop()} if len(marks) == 1 else {}
    return layout


def _text(name: str, data: bytes, layout: Layout) -> str:
    """Return the text, and put its encoding into the layout."""
    # without a mark, every second byte of most texts is zero
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or data[1:64:2].count(0) > len(data[1:64:2]) // 2:
        layout.keys["encoding"] = "utf-16"
    try:
        return plain_text(TextLayout(**layout.keys), name, data)[0]
    except LogError as error:
        if "UTF-8" not in error.reason:
            raise
    layout.questions["encoding"] = 'the text is no UTF-8. Which is it: "latin-1" (older tools) or "cp1252" (Windows)?'
    return plain_text(TextLayout(encoding="latin-1"), name, data)[0]


def _split(line: str, delimiter: str) -> list[str]:
    return line.split() if delimiter == BLANKS else [cell.strip() for cell in line.split(delimiter)]


def _is_number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell.strip('"')) is not None


def _table(lines: list[str], name: str) -> tuple[str, list[int]]:
    """Return the delimiter, and which lines are rows of numbers, all with the same number of cells."""
    best: tuple[str, list[int]] = ("", [])
    for delimiter in _DELIMITERS:
        widths: dict[int, list[int]] = {}
        for number, line in enumerate(lines):
            cells = _split(line, delimiter)
            if len(cells) > 1 and sum(map(_is_number, cells)) >= max(NUMERIC_SHARE * sum(map(bool, cells)), 2):
                widths.setdefault(len(cells), []).append(number)
        rows = max(widths.values(), key=len, default=[])
        # text that is parted by several signs: the one that makes more rows, the earlier one where equal
        if len(rows) > len(best[1]):
            best = delimiter, rows
    if len(best[1]) < FEWEST_ROWS:
        alone = sum(_is_number(line.strip().rstrip(";,").strip()) for line in lines)
        if alone >= FEWEST_ROWS:
            found = f"has one column of numbers ({alone} of the first {len(lines)} lines); a log needs the command and "
            found += "the position, or the velocity, in each row"
            raise refusal("column-missing", name, found, cure="Export them together, or describe them by [partner].")
        found, expected = f"no table of numbers was found among the first {len(lines)} lines", "rows of as many cells"
        raise refusal("header-missing", name, found, expected, "Export other formats as CSV.")
    return best


def _decimal(cells: list[str], layout: Layout) -> None:
    """Put the decimal sign into the layout, or ask where none is seen or it could part thousands as well."""
    numbers = [cell for cell in cells if _is_number(cell)]
    points, commas = [n for n in numbers if "." in n], [n for n in numbers if "," in n]
    seen = points[:1] + commas[:1]
    if layout.keys["delimiter"] == "," or (
        len(seen) == 1 and not all(_GROUPED.fullmatch(number) for number in points or commas)
    ):
        layout.keys["decimal"] = "," if commas else "."
        return
    shown = f"the table has {' and '.join(map(repr, seen))}" if seen else "the first rows have whole numbers only"
    layout.questions["decimal"] = f'{shown}. Which is the decimal sign of its logs, "." or ","?'


def _is_head(line: str, width: int, keys: dict[str, Any]) -> bool:
    """Return whether a line holds the names or units of so many columns."""
    cells = _split(line, keys["delimiter"])
    if keys.get("trailing_delimiter") and cells and not cells[-1]:
        cells.pop()
    # a remark in words may have as many blanks as the table has columns; a label has its sign behind the first word
    remark = keys["delimiter"] == BLANKS and _LABEL.fullmatch(line)
    return len(cells) == width and any(cells) and not remark and not any(map(_is_number, cells))
