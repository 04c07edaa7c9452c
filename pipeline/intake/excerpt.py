"""Where a fault stands in a text file: the byte at which its row begins, and the lines around it, safe to print."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import LogError
from pipeline.readers.formats.plain_text import is_packed, unpacked
from pipeline.readers.layout import format_of
from pipeline.records.batch import Integers

EXCERPT_ROWS = 3
"""Lines shown before and behind the row at fault."""

LONGEST_SHOWN = 160
"""Characters of a line that are shown: two lines of a terminal; seven such lines make a record of 2 kB at most."""

_WIDEST = 4
"""Bytes of the widest character."""


@dataclass(frozen=True)
class Excerpt:
    """Lines of a text file around a row.

    Parameters
    ----------
    byte : int or None
        Offset of the row in the file, counted from 0; None where the file is packed, or has no such row.
    lines : tuple of (int, str)
        Line number, counted from 1, and text; control characters are escaped, long lines cut.
    """

    byte: int | None
    lines: tuple[tuple[int, str], ...]


NOTHING = Excerpt(None, ())
"""Of a file whose rows are no lines."""


def excerpt_of(
    name: str, data: bytes, row: int | None, kind: str, encoding: str = "utf-8", around: int = EXCERPT_ROWS
) -> Excerpt:
    """Return the lines around a row of a text file, its first lines where there is no row.

    Parameters
    ----------
    name : str
        The file.
    data : bytes
        Its content, packed (gzip, zstd) or not.
    row : int or None
        Line, counted from 1.
    kind : str
        Format by which lines were counted: a carriage return alone ends one in ``"delimited"`` text.
    encoding : str
        Encoding by the profile; what does not fit it is shown as Latin-1.
    around : int
        Lines before and behind.
    """
    packed = is_packed(data)
    try:
        text = unpacked(name, data)
    except LogError:
        return NOTHING
    if format_of(name, text[: 1 << 16]) not in ("delimited", "native", "json"):
        return NOTHING
    mark = text[:2]
    codec = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be"}.get(mark) or (
        "utf-16-le" if encoding == "utf-16" else encoding
    )
    width = 2 if codec.startswith("utf-16") else 1
    if width == 1 and b"\0" in text:
        return NOTHING
    start = _line_starts(text, codec, width, kind == "delimited")
    count = len(start) - 1
    at = row or 1
    numbers = range(max(at - around, 1), min(at + around, count) + 1)
    lines = tuple((number, _shown(text[start[number - 1] : start[number]], codec)) for number in numbers)
    known = row is not None and not packed and row <= count
    return Excerpt(int(start[at - 1]) if known else None, lines)


def _line_starts(text: bytes, codec: str, width: int, returns: bool) -> Integers:
    """Return where each line begins, and where the last one ends."""
    units = np.frombuffer(text, {"utf-16-le": "<u2", "utf-16-be": ">u2"}.get(codec, "u1"), len(text) // width)
    end = units == ord("\n")
    if returns:
        # one that a line feed follows is part of that line end
        alone = units == ord("\r")
        alone[:-1] &= ~end[1:]
        end |= alone
    starts = (np.flatnonzero(end) + 1) * width
    whole = len(units) * width
    if not len(starts) or starts[-1] < whole:
        starts = np.append(starts, whole)
    return np.concatenate(([0], starts)) if whole else np.zeros(1, dtype=np.int64)


def _shown(line: bytes, codec: str) -> str:
    head = line[: _WIDEST * LONGEST_SHOWN]
    try:
        # the last character of the head may be cut
        text = head.decode(codec, "strict" if len(head) == len(line) else "ignore")
    except UnicodeDecodeError:
        text = head.decode("latin-1")
    text = text.removeprefix("\ufeff").rstrip("\r\n")[:LONGEST_SHOWN]
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\t" else c.encode("unicode_escape").decode() for c in text)
