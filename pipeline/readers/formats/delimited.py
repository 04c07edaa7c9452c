"""Reader of delimited text (CSV, TSV, semicolons, blanks, terminal logs; gzip, zstd) in the layout of a profile."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.base.errors import LogError, refusal
from pipeline.base.json_object import JsonObject
from pipeline.profiles.profile_model import BLANKS, Profile, TextLayout, find_groups
from pipeline.readers.file_columns import LONGEST_ATTRIBUTE, Array, FileColumns, allowed_bytes
from pipeline.readers.formats import PACKED

LONGEST_CHARACTER = 4
"""Number of bytes of the longest character in UTF-8 and UTF-16. A character at the end of a truncated file lacks fewer
bytes."""

_BLOCK = 1 << 22
"""Number of bytes that are unpacked at a time."""

MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_INTEGER = r"^[+-]?[0-9]{1,20}$"
_LABEL_BEGINS = re.compile(r"\s*[^\W\d]")
"""Pattern of the beginning of a label. It is a letter, because "12:30" is a time of day."""


PROBE_LINES = 400
"""Number of inspected lines. A header block has a few dozen lines, and a hundred rows are enough to show the form of a
table."""

FEWEST_ROWS = 2
"""Smallest number of rows of a table."""

FEW_KEYS, LEAST_TABLE = 3, 10
"""Largest number of numeric lines above a table that do not belong to it, and smallest number of rows of the table
below such lines."""

NUMERIC_SHARE = 0.5
"""Smallest share of numbers among the cells of a row of samples. Some columns may contain texts."""

_GROUP_SIGNS = " \u00a0\u2009\u202f'\u2019"
"""Thousands separators: blanks and apostrophes, as in French and Swiss numbers."""

_GROUPED_NUMBER = rf"[+-]?[0-9]{{1,3}}(?:[{_GROUP_SIGNS}][0-9]{{3}})+(?:[.,][0-9]*)?"
_NUMBER = re.compile(
    rf"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|{_GROUPED_NUMBER}|[+-]?(?:nan|inf)", re.IGNORECASE
)
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:[.,]\d{3})+")
"""Pattern of numbers whose point or comma may be a thousands separator, such as "1,234"."""

_LABELLED = re.compile(r"\s*([^\W\d][^:=]*?)\s*([:=])\s*(\S.*)")
_DELIMITERS = (";", "\t", "|", ",", BLANKS)
"""Delimiters in order of preference, for lines that several delimiters fit."""


def read(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the columns of the table.

    An incomplete last row is omitted with a warning, and its text is kept as the attribute ``cut_last_row``. Such a row
    has fewer cells than the others, or it has no line end and a cell that is not a number.
    """
    contents.row_name = "line"
    text, whole = plain_text(settings, contents.name, path.read_bytes())
    lines = text.split("\n")[:-1]
    top = _top(settings, contents, lines)
    names = [name.strip() for name in _split(settings, contents, lines[top], top + 1)]
    names = names if settings.header else [str(i + 1) for i in range(len(names))]
    first = top + settings.header + settings.unit_line
    units = _split(settings, contents, lines[first - 1], first) if settings.unit_line and first <= len(lines) else []
    places = _places(settings, contents, names, top + 1)
    row, cells = _rows(settings, contents, lines, first, names, list(places.values()))
    columns = [_values(settings, values) for values in cells]
    if not contents.warnings and not whole:
        shorter = [_values(settings, values[:-1]) for values in cells]
        if len(row) > 1 and any(map(_is_spoilt, columns, shorter)):
            contents.cut_row(lines[row.pop() - 1], row[-1] + 1)
            columns = shorter
        else:
            contents.warnings = (f"the last line ({row[-1]}) has no line end: its last value may be incomplete",)
    contents.row = np.array(row, np.int64)
    for (key, place), values in zip(places.items(), columns, strict=True):
        stamps = date_stamps(values)
        unit = units[place].strip(" []()") if place < len(units) else ""
        contents.add(key, values if stamps is None else stamps, unit, "" if stamps is None else "ns")


_DATE = re.compile(
    r"(?:(?P<y>\d{4})-(?P<m>\d\d)-(?P<d>\d\d)|(?P<D>\d\d)\.(?P<M>\d\d)\.(?P<Y>\d{4}))[T ]+"
    r"(?P<time>\d\d:\d\d:\d\d)(?:[.,](?P<rest>\d{1,9}))?(?P<zone>Z|[+-]\d\d:?\d\d)?"
)
"""Pattern of dates with a time of day, in ISO 8601 or German order. A date such as 03/04/2026 is ambiguous and not
accepted."""


def date_stamps(values: Array) -> Array | None:
    """Return dates as integer nanoseconds since 1970, or None if a cell is not a date.

    >>> date_stamps(np.array(["2026-03-29T10:00:00.001Z", "29.03.2026 10:00:00,5"])).tolist()
    [1774778400001000000, 1774778400500000000]
    """
    if values.dtype.kind != "U" or not len(values):
        return None
    matches = [_DATE.fullmatch(cell.strip()) for cell in values.tolist()]
    if not all(matches):
        return None
    texts, rests = list[str](), list[int]()
    for match in matches:
        assert match is not None, "every cell is a date"
        year, month, day = (match[a] or match[b] for a, b in (("y", "Y"), ("m", "M"), ("d", "D")))
        texts.append(f"{year}-{month}-{day}T{match['time']}")
        zone = match["zone"] or "Z"
        minutes = 0 if zone == "Z" else int(zone[0] + "1") * (60 * int(zone[1:3]) + int(zone[-2:]))
        rests.append(int((match["rest"] or "0").ljust(9, "0")) - 60_000_000_000 * minutes)
    try:
        seconds = np.array(texts, "datetime64[s]").astype(np.int64)
    except ValueError:  # this day does not exist in the calendar
        return None
    stamps: Array = seconds * 1_000_000_000 + np.array(rests, np.int64)
    return stamps


def unpacked(name: str, data: bytes) -> bytes:
    """Return the bytes of a text file after decompression with gzip or zstd, if it is compressed.

    Raises
    ------
    LogError
        If the file cannot be decompressed, or contains more than its size allows.
    """
    codec = next((codec for magic, codec in PACKED.items() if data.startswith(magic)), None)
    if codec is None:
        return data
    most, text = allowed_bytes(len(data)), bytearray()
    try:
        with pa.CompressedInputStream(pa.BufferReader(data), codec) as stream:
            while len(text) <= most and (part := stream.read(_BLOCK)):
                text += part
    except (OSError, pa.ArrowException) as error:
        raise refusal("damaged", name, f"cannot be decompressed ({codec}): {error}") from error
    if len(text) > most:
        raise refusal("unpacks-too-large", name, f"unpacks to more than {most} bytes", "a log")
    return bytes(text)


def plain_text(layout: TextLayout, name: str, data: bytes) -> tuple[str, bool]:
    """Return the text of a file without trailing blank lines, and whether its last line had a line end.

    Every line of the text, including the last, ends with one line feed. A byte order mark determines the encoding.

    Raises
    ------
    LogError
        If the file cannot be decompressed, or its encoding differs from that of the profile.
    """
    data = unpacked(name, data)
    codec = next((codec for mark, codec in MARKS.items() if data.startswith(mark)), layout.encoding)
    try:
        text = data.decode(codec)
    except UnicodeDecodeError as error:
        if error.end < len(data) or error.start <= max(len(data) - LONGEST_CHARACTER, 0):
            found = f"is not {codec.upper()} text ({error.reason}, byte {data[error.start]:#04x} at {error.start})"
            row = data.count(b"\n", 0, error.start) + 1
            raise refusal("encoding", name, found, row=row, line='encoding = "latin-1"') from error
        # The recording ends inside a character. The row of this character is detected as incomplete later.
        text = data[: error.start].decode(codec)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    end = len(text.rstrip(" \t\n"))
    # Blank cells at the end of the last row are kept. Blank lines below this row are removed.
    last, line_end, _ = text[end:].partition("\n")
    return (text[:end] + last + "\n", bool(line_end)) if end else ("", True)


def _top(layout: Profile, contents: FileColumns, lines: list[str]) -> int:
    """Return the index of the header line, or of the first data row if there is no header.

    Lines above it are skipped or read as labels.
    """
    at = layout.header_at
    for number, line in enumerate(lines):
        skipped = number < layout.skip_rows
        if not skipped and at is not None and find_groups(at, line) is not None:
            return number
        is_label = _take_label(layout, contents, line, number + 1)
        blank = (layout.labels is not None or layout.blank_lines == "skip") and not line.strip()
        if not (skipped or at is not None or is_label or blank or _is_comment(layout, line)):
            return number
    found = f"is empty below skip_rows = {layout.skip_rows} and header_at = {at!r}"
    raise refusal("empty", contents.name, found, "a line of column names and samples", row=1)


def _is_comment(layout: TextLayout, line: str) -> bool:
    return layout.comment is not None and line.lstrip().startswith(layout.comment)


def _take_label(layout: Profile, contents: FileColumns, line: str, row: int) -> bool:
    """Store a line "label: value" as an attribute. Return False if the line does not have this form.

    If a label is repeated, its last value is kept. The value of a condition must not change.
    """
    line = line.lstrip()[len(layout.comment or "") :] if _is_comment(layout, line) else line
    label, sign, value = (part.strip() for part in line.partition(layout.labels or "\n"))
    if not sign or not _LABEL_BEGINS.match(label):
        return False
    key = next((key for key, wanted in layout.attributes.items() if wanted == label), None)
    if key is not None and contents.attributes.get(label, value) != value:
        found = (
            f"the label {label!r} states the {key} twice, with the different values {contents.attributes[label]!r} and "
            f"{value!r}"
        )
        raise refusal("condition-wrong", contents.name, found, "one value for a log", row=row)
    contents.note(label, value)
    return True


def _split(layout: TextLayout, contents: FileColumns, line: str, row: int) -> list[str]:
    """Return the cells of a line."""
    if layout.row_end is not None:
        line = line.rstrip().removesuffix(layout.row_end)
    if layout.delimiter == BLANKS:
        return line.split()
    if layout.trailing_delimiter:
        line = line.rstrip(" \t".replace(layout.delimiter, "")).removesuffix(layout.delimiter)
    if '"' not in line:
        return line.split(layout.delimiter)
    try:
        return next(csv.reader([line], delimiter=layout.delimiter, strict=True))
    except csv.Error as error:
        text = f"a quotation mark seems to be unclosed ({error})"
        raise refusal("row-length", contents.name, text, row=row) from error


def _rows(
    layout: Profile, contents: FileColumns, lines: list[str], first: int, names: list[str], places: list[int]
) -> tuple[list[int], list[list[str]]]:
    """Return the row numbers, and the cells of each column. An incomplete last row is omitted, and its text is kept."""
    row, cells, width = list[int](), list[list[str]](), len(names)
    for number, line in enumerate(lines[first:], start=first + 1):
        if not line.strip(" \t") and layout.blank_lines == "refuse":
            help_line = 'blank_lines = "skip"'
            raise refusal("row-length", contents.name, "a blank line between rows", "a row", row=number, line=help_line)
        if not line.strip(" \t") or _is_comment(layout, line):
            continue
        found = _split(layout, contents, line, number)
        if len(found) == width:
            row.append(number)
            cells.append(found)
        elif row and number == len(lines) and len(found) < width:
            contents.cut_row(line, number)
        elif not _take_label(layout, contents, line, number):
            commas = 'If these are decimal commas, write decimal = "," and a different delimiter.'
            cure = commas if layout.delimiter == "," and len(found) > width else ""
            text = f"expected {width} values, found {len(found)} ({line[:200]!r})"
            more = (len(found) == width + 1 and not found[-1].strip()) or (len(found) == width - 1 and not names[-1])
            help_line = "trailing_delimiter = true" if more else ""
            raise refusal("row-length", contents.name, text, "", cure, number, help_line)
    if not row:
        raise refusal("too-short", contents.name, "has 0 samples", "at least 2", row=first + 1)
    return row, [[found[place] for found in cells] for place in places]


def _places(profile: Profile, contents: FileColumns, names: list[str], row: int) -> dict[str, int]:
    """Return the position of each wanted column, counted from 0. By default, return the positions of all columns."""
    if not contents.wanted:
        return {label if names.index(label) == i else f"{label} ({i + 1})": i for i, label in enumerate(names)}
    by_position = {str(source.column) for source in profile.column_sources().values() if source.column is not None}
    keys = {column: key for file in ("source", "partner") for key, column in profile.wanted(file).items()}
    places, cure = {}, f"Correct the delimiter ({profile.delimiter!r}) or the name, or give column = <position>."
    for column in contents.wanted:
        numbered = column in by_position or not profile.header
        fits = [i for i, name in enumerate(names) if (str(i + 1) if numbered else name) == column]
        if len(fits) != 1:
            wants = f"profile {profile.name} wants column {column!r} for {keys.get(column, column)}"
            found = f"{wants} once, but it occurs {len(fits)} times in {len(names)} columns: {str(names)[:1000]}"
            raise refusal("column-missing", contents.name, found, cure=cure, row=row)
        places[column] = fits[0]
    return places


def _is_spoilt(values: Array, shorter: Array) -> bool:
    """Return True if all cells of a column except the last cell are numbers, and none of them is missing."""
    if values.dtype.kind == "f":
        return bool(np.isnan(values[-1]) and not np.isnan(values[:-1]).any())
    return values.dtype.kind == "U" != shorter.dtype.kind


def _values(layout: TextLayout, cells: list[str]) -> Array:
    """Return cells as integers if all are integers, as float64 if all are numbers or blank, otherwise as texts."""
    text = pc.utf8_trim_whitespace(pa.array(cells, pa.string()))
    blank = pc.is_in(text, value_set=pa.array(["", *layout.missing], pa.string()))
    number, kinds = pc.if_else(blank, None, text), [pa.float64()]
    if layout.delimiter != BLANKS:
        whole = pc.replace_substring_regex(number, f"[{_GROUP_SIGNS}]", "")
        number = pc.if_else(pc.match_substring_regex(number, f"^{_GROUPED_NUMBER}$"), whole, number)
    if layout.decimal == ",":
        # The point may be a thousands separator.
        number = pc.if_else(pc.match_substring(number, "."), "point", pc.replace_substring(number, ",", "."))
    if pc.all(pc.fill_null(pc.match_substring_regex(number, _INTEGER), False)).as_py():
        number, kinds = pc.utf8_ltrim(number, "+"), [pa.int64(), pa.uint64(), pa.float64()]
    for kind in kinds:
        with suppress(pa.ArrowInvalid):  # the cells have a different type
            return np.asarray(pc.cast(number, kind).to_numpy(zero_copy_only=False))
    shown = pc.utf8_slice_codeunits(pc.if_else(blank, "", text), 0, LONGEST_ATTRIBUTE)
    return np.array(shown.to_pylist(), dtype=np.str_)


@dataclass
class Layout:
    """Layout of a text file that was inspected.

    ``keys``: layout keys of a profile. ``questions`` and ``evidence``: open questions and evidence, by key. ``titles``:
    column names found in comment lines, with units in brackets, keyed by the name in `FileColumns`.
    """

    keys: JsonObject = field(default_factory=dict)
    questions: dict[str, str] = field(default_factory=dict)
    evidence: dict[str, str] = field(default_factory=dict)
    titles: dict[str, str] = field(default_factory=dict)


def text_layout(name: str, data: bytes) -> Layout:
    """Determine the layout of a text file.

    Raises
    ------
    LogError
        If no table of numbers is found.
    """
    layout = Layout()
    lines = _guessed(name, data, layout).split("\n")[:-1]
    probe = lines[:PROBE_LINES]
    # The last line of a recording may be incomplete.
    delimiter, rows = _table(probe[:-1] if len(probe) > FEWEST_ROWS else probe, name)
    keys = layout.keys
    keys["delimiter"] = delimiter
    if delimiter not in (";", BLANKS) and all(lines[row].rstrip().endswith(";") for row in rows):
        keys["row_end"] = ";"
        lines = [line.rstrip().removesuffix(";") for line in lines]
    cells = [_parted(lines[row], delimiter) for row in rows]
    above = lines[: rows[0]]
    named = _parted(above[-1], delimiter) if above else []
    # A blank last column with a name, such as a column of remarks, is kept.
    if delimiter != BLANKS and all(not row[-1] for row in cells) and not (len(named) == len(cells[0]) and named[-1]):
        keys["trailing_delimiter"] = True
        cells = [row[:-1] for row in cells]
    _decimal([cell for row in cells for cell in row], layout)
    between = [lines[i] for i in range(rows[0], rows[-1]) if i not in set(rows)]
    lead = above[: max((i for i, line in enumerate(above, start=1) if line.strip()), default=0)]
    heads = list(takewhile(lambda line: _is_head(line, len(cells[0]), keys), lead[:-3:-1]))
    skipped = len(lead) - len(heads) if heads else len(above)
    keys |= {} if heads else {"header": False}
    keys |= {"unit_line": True} if len(heads) == 2 else {}
    keys |= {"skip_rows": skipped} if skipped else {}
    if any(not line.strip() for line in between):
        keys["blank_lines"] = "skip"
    outside = (*above[:skipped], *between)
    if found := [(line, match[2]) for line in outside if (match := _LABELLED.fullmatch(line.lstrip("#%/ ")))]:
        keys["labels"] = sign = Counter(sign for _, sign in found).most_common(1)[0][0]
        # Labels in comment lines are read only if the profile states the comment sign.
        marks = {mark[1] for line, of in found if of == sign and (mark := re.match(r"\s*([#%/]+)", line))}
        keys |= {"comment": marks.pop()} if len(marks) == 1 else {}
    if heads and (mark := keys.get("comment")) and any(line.lstrip().startswith(mark) for line in heads):
        # Names in comment lines are not part of the table. The columns are therefore selected by position.
        keys.pop("unit_line", None)
        *units, names = ([cell.strip(mark + " ") for cell in _parted(line, delimiter)] for line in heads)
        behind = [f" [{unit.strip('[]() ')}]" if unit else "" for unit in units[0]] if units else [""] * len(names)
        layout.titles = {str(i + 1): f"{name}{behind[i]}" for i, name in enumerate(names)}
        keys |= {"header": False, "skip_rows": len(above)}
    return layout


def _guessed(name: str, data: bytes, layout: Layout) -> str:
    """Decode the text, and store its encoding in the layout."""
    # In UTF-16 without a byte order mark, every second byte of most texts is zero.
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or data[1:64:2].count(0) > len(data[1:64:2]) // 2:
        layout.keys["encoding"] = "utf-16"
    try:
        return plain_text(TextLayout(**layout.keys), name, data)[0]
    except LogError as error:
        if "UTF-8" not in error.reason:
            raise
    # The two encodings have the same letters. Only cp1252 has characters such as the dash where latin-1 has control
    # characters.
    with suppress(LogError):
        text = plain_text(TextLayout(encoding="cp1252"), name, data)[0]
        layout.keys["encoding"] = "cp1252"
        return text
    layout.keys["encoding"] = "latin-1"
    return plain_text(TextLayout(encoding="latin-1"), name, data)[0]


def _parted(line: str, delimiter: str) -> list[str]:
    if delimiter == BLANKS:
        return line.split()
    if '"' in line:
        # A name in quotation marks may contain the delimiter.
        with suppress(csv.Error):
            return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, strict=True))]
    return [cell.strip() for cell in line.split(delimiter)]


def _is_number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell.strip('"')) is not None


def _table(lines: list[str], name: str) -> tuple[str, list[int]]:
    """Return the delimiter and the indices of the rows of numbers. All rows have the same number of cells."""
    best: tuple[str, list[int]] = ("", [])
    for delimiter in _DELIMITERS:
        widths: dict[int, list[int]] = {}
        for number, line in enumerate(lines):
            cells = _parted(line, delimiter)
            if len(cells) > 1 and sum(map(_is_number, cells)) >= max(NUMERIC_SHARE * sum(map(bool, cells)), 2):
                widths.setdefault(len(cells), []).append(number)
        rows = _block(max(widths.values(), key=len, default=[]))
        # If several delimiters fit, the delimiter with the most rows is taken. Among those with equally many rows, the
        # first is taken.
        if len(rows) > len(best[1]):
            best = delimiter, rows
    if len(best[1]) < FEWEST_ROWS:
        alone = sum(_is_number(line.strip().rstrip(";,").strip()) for line in lines)
        if alone >= FEWEST_ROWS:
            found = f"has one column of numbers ({alone} of the first {len(lines)} lines); a log needs the "
            found += "command, and the position or velocity, in each row"
            raise refusal(
                "column-missing",
                name,
                found,
                cure="Export all columns together, or describe a second file by [partner].",
            )
        found, expected = f"no table of numbers was found among the first {len(lines)} lines", "rows of equal length"
        raise refusal("header-missing", name, found, expected, "Export other formats as CSV.")
    return best


def _block(rows: list[int]) -> list[int]:
    """Return the rows of the table, without a few numeric lines above it, such as settings of a recorder."""
    runs: list[list[int]] = []
    for row in rows:
        if runs and row == runs[-1][-1] + 1:
            runs[-1].append(row)
        else:
            runs.append([row])
    longest = max(map(len, runs), default=0)
    while runs and len(runs[0]) <= FEW_KEYS and longest >= LEAST_TABLE:
        runs.pop(0)
    return [row for run in runs for row in run]


def _decimal(cells: list[str], layout: Layout) -> None:
    """Store the decimal sign in the layout. Add a question if no sign occurs, or if the sign may be a thousands
    separator."""
    numbers = [cell for cell in cells if _is_number(cell)]
    points, commas = [n for n in numbers if "." in n], [n for n in numbers if "," in n]
    seen = points[:1] + commas[:1]
    if layout.keys["delimiter"] == "," or (
        len(seen) == 1 and not all(_GROUPED.fullmatch(number) for number in points or commas)
    ):
        layout.keys["decimal"] = "," if commas else "."
        return
    shown = f"the table contains {' and '.join(map(repr, seen))}" if seen else "the first rows have whole numbers only"
    layout.questions["decimal"] = f'{shown}. Is the decimal sign of the logs "." or ","?'


def _is_head(line: str, width: int, keys: JsonObject) -> bool:
    """Return True if a line consists of names or units for the given number of columns."""
    cells = _parted(line, keys["delimiter"])
    if keys.get("trailing_delimiter") and cells and not cells[-1]:
        cells.pop()
    # With blanks as delimiter, a comment may have as many words as the table has columns. A label is recognised by the
    # sign after its first word.
    remark = keys["delimiter"] == BLANKS and _LABELLED.fullmatch(line)
    return len(cells) == width and any(cells) and not remark and not any(map(_is_number, cells))
