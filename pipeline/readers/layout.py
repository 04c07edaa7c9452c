"""What can be seen of a file without knowing the lab: its format, and how delimited text is laid out.

Only what the file shows beyond doubt is given as known; the rest is asked.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import Format
from pipeline.profiles.profile_text import BLANKS, TextLayout
from pipeline.readers.formats import FORMATS, HDF5
from pipeline.readers.formats.delimited import plain_text
from pipeline.readers.refusals import refusal

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


def format_of(name: str, data: bytes) -> Format:
    """Return the format of a file by its first bytes; delimited text where they are none of the known.

    Parameters
    ----------
    name : str
        File name: it decides where bags are packed as a whole.
    data : bytes
    """
    for kind, form in FORMATS.items():
        if form.magic and data.startswith(form.magic):
            return kind
    # a MATLAB 7.3 file may lack its text, a packed database says nothing of what is inside
    if HDF5 in (data[512:520], data[1024:1032]):
        return "matlab" if name.lower().endswith(".mat") else "hdf5"
    if ".db3" in name.lower():
        return "rosbag"
    head = data[:64].replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n")
    if head.startswith(b"{") or (head.startswith(b"[") and head[1:].lstrip()[:1] in (b"{", b"[")):
        return "json"
    if re.search(rb"^#\s*device\s*:", data[:4096], re.MULTILINE) and b"time_s,command,position" in data:
        return "native"
    return "delimited"


def text_layout(name: str, data: bytes) -> Layout:
    """Return how a text file is laid out.

    Raises
    ------
    LogError
        If no table of numbers is found.
    """
    layout = Layout()
    text = _text(name, data, layout)
    lines = text.split("\n")[:-1]
    probe = lines[:PROBE_LINES]
    # the last line of a recording may be cut
    delimiter, rows = _table(probe[:-1] if len(probe) > FEWEST_ROWS else probe, name)
    first, last = rows[0], rows[-1]
    layout.keys["delimiter"] = delimiter
    cells = [_split(lines[row], delimiter) for row in rows]
    if delimiter != BLANKS and all(not row[-1] for row in cells):
        layout.keys["trailing_delimiter"] = True
        cells = [row[:-1] for row in cells]
    _decimal([cell for row in cells for cell in row], delimiter, layout)
    width = len(cells[0])
    _head(lines[:first], width, delimiter, layout)
    between = [lines[i] for i in range(first, last) if i not in set(rows)]
    if any(not line.strip() for line in between):
        layout.keys["blank_lines"] = "skip"
    above = lines[: layout.keys.get("skip_rows", 0)]
    labels = [(line, match[2]) for line in (*above, *between) if (match := _LABEL.fullmatch(line.lstrip("#%/ ")))]
    if labels:
        layout.keys["labels"] = sign = Counter(sign for _, sign in labels).most_common(1)[0][0]
        # labels in remarks are read where the profile says what begins a remark
        marks = {mark[1] for line, found in labels if found == sign and (mark := re.match(r"\s*([#%/]+)", line))}
        if len(marks) == 1:
            layout.keys["comment"] = marks.pop()
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
        split = [_split(line, delimiter) for line in lines]
        numeric = [
            len(cells) > 1 and sum(map(_is_number, cells)) >= max(NUMERIC_SHARE * sum(map(bool, cells)), 2)
            for cells in split
        ]
        widths = Counter(len(cells) for cells, good in zip(split, numeric, strict=True) if good)
        if not widths:
            continue
        width = widths.most_common(1)[0][0]
        rows = [i for i, cells in enumerate(split) if numeric[i] and len(cells) == width]
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


def _decimal(cells: list[str], delimiter: str, layout: Layout) -> None:
    """Put the decimal sign into the layout, or ask where none is seen or it could part thousands as well."""
    if delimiter == ",":
        layout.keys["decimal"] = "."
        return
    numbers = [cell for cell in cells if _is_number(cell)]
    points, commas = [n for n in numbers if "." in n], [n for n in numbers if "," in n]
    seen = points[:1] + commas[:1]
    if len(seen) == 1 and not all(_GROUPED.fullmatch(number) for number in points or commas):
        layout.keys["decimal"] = "." if points else ","
        return
    shown = f"the table has {' and '.join(map(repr, seen))}" if seen else "the first rows have whole numbers only"
    layout.questions["decimal"] = f'{shown}. Which is the decimal sign of its logs, "." or ","?'


def _head(above: list[str], width: int, delimiter: str, layout: Layout) -> None:
    """Put line of names, line of units and what stands above them into the layout."""
    lines = list(above)
    while lines and not lines[-1].strip():
        lines.pop()
    heads: list[str] = []
    while lines and len(heads) < 2 and _is_head(lines[-1], width, delimiter, layout):
        heads.append(lines.pop())
    if not heads:
        layout.keys["header"] = False
    if len(heads) == 2:
        layout.keys["unit_line"] = True
    if lines or (not heads and above):
        layout.keys["skip_rows"] = len(above) if not heads else len(lines)


def _is_head(line: str, width: int, delimiter: str, layout: Layout) -> bool:
    cells = _split(line, delimiter)
    if layout.keys.get("trailing_delimiter") and cells and not cells[-1]:
        cells.pop()
    if len(cells) != width or not any(cells):
        return False
    # a remark in words may have as many blanks as the table has columns; a label has its sign behind the first word
    return not any(_is_number(cell) for cell in cells) and not (delimiter == BLANKS and _LABEL.fullmatch(line))
