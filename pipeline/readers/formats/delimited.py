"""Delimited text (CSV, TSV, semicolons, runs of blanks, terminal logs; gzip, zstd), as a profile lays it out."""

from __future__ import annotations

import codecs
import csv
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_columns import BLANKS, TextLayout
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_kind import PACKED
from pipeline.readers.frame import Array, Contents
from pipeline.readers.limits import LONGEST_ATTRIBUTE, LONGEST_LINE, allowed_bytes
from pipeline.readers.refusals import refusal

LONGEST_CHARACTER = 4
"""Bytes of the longest character in UTF-8 and UTF-16: a cut file lacks fewer than that."""

_BLOCK = 1 << 22
"""Bytes that are unpacked at once."""

_MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_INTEGER = r"^[+-]?[0-9]{1,20}$"
_LABEL_BEGINS = re.compile(r"\s*[^\W\d]")
"""A label begins with a letter: "12:30" is a time of day."""


def read(path: Path, settings: Profile, contents: Contents) -> None:
    """Add the columns of the table.

    A last row that is cut (fewer cells than the others, or without line end and with a cell that is no number) is left
    out with a warning and kept verbatim as the attribute ``cut_last_row``.
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
    row, found = _rows(settings, contents, lines, first, names, set(places.values()))
    cells = {key: pa.array(found[place], pa.string()) for key, place in places.items()}
    columns = {key: _values(settings, values) for key, values in cells.items()}
    cut = contents.warnings != ()
    if not cut and not whole and len(row) > 1:
        shorter = {key: _values(settings, values[:-1]) for key, values in cells.items()}
        if any(_is_spoilt(values, shorter[key]) for key, values in columns.items()):
            contents.cut_row(lines[row.pop() - 1], row[-1] + 1)
            columns, cut = shorter, True
    if not cut and not whole:
        contents.warnings += (f"line {row[-1]} is the last one and has no line end: its last value may be cut",)
    contents.row = np.array(row, np.int64)
    for key, place in places.items():
        contents.add(key, columns[key], units[place].strip(" []()") if place < len(units) else "")
        if settings.columns and settings.columns.time and key == settings.columns.time.key:
            contents.keep_stamps(key, _numbers(settings, cells[key][: len(row)])[1])


def unpacked(name: str, data: bytes) -> bytes:
    """Return the bytes of a text file, unpacked where it is packed by gzip or zstd.

    Raises
    ------
    LogError
        If it cannot be unpacked, or holds more than a file of its size may.
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
        raise refusal("damaged", name, f"cannot be unpacked ({codec}): {error}") from error
    if len(text) > most:
        raise refusal("unpacks-too-large", name, f"unpacks to more than {most} bytes", "a log")
    return bytes(text)


def plain_text(layout: TextLayout, name: str, data: bytes) -> tuple[str, bool]:
    """Return the text of a file without blanks at its end, and whether the last line had a line end.

    Lines are parted by one line feed each, and the last one ends with one.

    Raises
    ------
    LogError
        If the file cannot be unpacked, has a line longer than `LONGEST_LINE`, or is not encoded as the profile says.
    """
    text = _decoded(layout, name, unpacked(name, data)).replace("\r\n", "\n").replace("\r", "\n")
    end = len(text.rstrip(" \t\n"))
    for number, line in enumerate(text.split("\n"), start=1) if len(text) > LONGEST_LINE else ():
        if len(line) > LONGEST_LINE:
            found = f"has a line of more than {LONGEST_LINE} characters"
            raise refusal("too-long-line", name, found, "one line for each sample", row=number)
    # blank cells at the end of the last row stay, blank lines below it go
    last, line_end, _ = text[end:].partition("\n")
    return (text[:end] + last + "\n", bool(line_end)) if end else ("", True)


def _decoded(layout: TextLayout, name: str, data: bytes) -> str:
    marked = next((encoding for mark, encoding in _MARKS.items() if data.startswith(mark)), layout.encoding)
    if marked != layout.encoding:
        found = f"begins with the byte order mark of {marked}, the profile reads {layout.encoding}"
        raise refusal("encoding", name, found, row=1, line=f'encoding = "{marked}"')
    codec = "utf-8-sig" if layout.encoding == "utf-8" else layout.encoding
    try:
        return data.decode(codec)
    except UnicodeDecodeError as error:
        if error.end >= len(data) and error.start > max(len(data) - LONGEST_CHARACTER, 0):
            # the recording was cut inside a character; its row is found to be cut, too
            return data[: error.start].decode(codec)
        found = f"is no {layout.encoding.upper()} text ({error.reason}, byte {data[error.start]:#04x} at {error.start})"
        row = data.count(b"\n", 0, error.start) + 1
        raise refusal("encoding", name, found, row=row, line='encoding = "latin-1"') from error


def _top(layout: Profile, contents: Contents, lines: list[str]) -> int:
    """Return where the line of names is, or the first row without one; lines above it are skipped or labels."""
    below, at = layout.header_after, layout.header_at
    for number, line in enumerate(lines):
        skipped = number < layout.skip_rows
        if not skipped and at is not None and find_groups(at, line) is not None:
            return number
        searched = at is not None or below is not None
        if not skipped and below is not None and find_groups(below, line) is not None:
            below = None
        is_label = _take_label(layout, contents, line, number + 1)
        blank = layout.labels is not None and not line.strip()
        if not (skipped or searched or is_label or blank or _is_comment(layout, line)):
            return number
    looked = f"below skip_rows = {layout.skip_rows}, header_at = {at!r} and header_after = {layout.header_after!r}"
    raise refusal("empty", contents.name, f"is empty {looked}", "a line of column names and samples", row=1)


def _is_comment(layout: TextLayout, line: str) -> bool:
    return layout.comment is not None and line.lstrip().startswith(layout.comment)


def _take_label(layout: Profile, contents: Contents, line: str, row: int) -> bool:
    """Keep a line "label: value" as an attribute; return whether it is one.

    Of a label that stands several times the last value is kept, but a condition must not change.
    """
    line = line.lstrip()[len(layout.comment or "") :] if _is_comment(layout, line) else line
    label, sign, value = (part.strip() for part in line.partition(layout.labels or "\n"))
    if not sign or not _LABEL_BEGINS.match(label):
        return False
    key = next((key for key, wanted in layout.attributes.items() if wanted == label), None)
    if key is not None and contents.attributes.get(label, value) != value:
        found = f"the label {label!r}, which gives the {key}, is {contents.attributes[label]!r} and here {value!r}"
        raise refusal("condition-wrong", contents.name, found, "one value for a log", row=row)
    contents.note(label, value)
    return True


def _split(layout: TextLayout, contents: Contents, line: str, row: int) -> list[str]:
    """Return the cells of a line."""
    if layout.delimiter == BLANKS:
        return line.split()
    if layout.trailing_delimiter:
        line = line.rstrip(" \t".replace(layout.delimiter, "")).removesuffix(layout.delimiter)
    if '"' not in line:
        return line.split(layout.delimiter)
    try:
        return next(csv.reader([line], delimiter=layout.delimiter, strict=True))
    except csv.Error as error:
        text = f"is a quotation mark not closed here ({error})?"
        raise refusal("row-length", contents.name, text, row=row) from error


def _rows(
    layout: Profile, contents: Contents, lines: list[str], first: int, names: list[str], places: set[int]
) -> tuple[list[int], dict[int, list[str]]]:
    """Return the number of each row, and cells by column; a last row that is cut is left out, and kept verbatim."""
    row, columns, width = list[int](), {place: list[str]() for place in places}, len(names)
    for number, line in enumerate(lines[first:], start=first + 1):
        if not line.strip(" \t") and layout.blank_lines == "refuse":
            help_line = 'blank_lines = "skip"'
            raise refusal("row-length", contents.name, "a blank line between rows", "a row", row=number, line=help_line)
        if not line.strip(" \t") or _is_comment(layout, line):
            continue
        cells = _split(layout, contents, line, number)
        if len(cells) == width:
            row.append(number)
            for place, column in columns.items():
                column.append(cells[place])
        elif row and number == len(lines) and len(cells) < width:
            contents.cut_row(line, number)
        elif not _take_label(layout, contents, line, number):
            more = (len(cells) == width + 1 and not cells[-1].strip()) or (len(cells) == width - 1 and not names[-1])
            commas = 'If these are decimal commas, write decimal = "," and another delimiter.'
            cure = commas if layout.delimiter == "," and len(cells) > width else ""
            found = f"expected {width} values, found {len(cells)} ({line[:200]!r})"
            help_line = "trailing_delimiter = true" if more else ""
            raise refusal("row-length", contents.name, found, "", cure, number, help_line)
    if not row:
        raise refusal("too-short", contents.name, "has 0 samples", "at least 2", row=first + 1)
    return row, columns


def _places(profile: Profile, contents: Contents, names: list[str], row: int) -> dict[str, int]:
    """Return the position of each wanted column, counted from 0; where none is wanted, of all."""
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
            found = f"{wants} once, found it {len(fits)} times among {len(names)} columns: {str(names)[:1000]}"
            raise refusal("column-missing", contents.name, found, cure=cure, row=row)
        places[column] = fits[0]
    return places


def _is_spoilt(values: Array, shorter: Array) -> bool:
    """Return whether a column is of numbers, none of them missing, but for its last cell."""
    if values.dtype.kind == "f":
        return bool(np.isnan(values[-1]) and not np.isnan(values[:-1]).any())
    return values.dtype.kind == "U" != shorter.dtype.kind


def _numbers(layout: TextLayout, column: pa.Array) -> tuple[pa.Array, pa.Array]:
    """Return cells as they are, and with a decimal point and null where they have no value."""
    text = pc.utf8_trim_whitespace(column)
    blank = pc.is_in(text, value_set=pa.array(["", *layout.missing], pa.string()))
    number = pc.if_else(blank, None, text)
    return text, pc.replace_substring(number, ",", ".") if layout.decimal == "," else number


def _values(layout: TextLayout, column: pa.Array) -> Array:
    """Return cells as integers where all are whole numbers, as float64 where all are numbers or blank, else as text."""
    text, number = _numbers(layout, column)
    blank = pc.is_null(number)
    points = layout.decimal == "," and pc.any(pc.and_not(pc.match_substring(text, "."), blank)).as_py()
    whole = not pc.any(blank).as_py() and pc.all(pc.match_substring_regex(number, _INTEGER)).as_py()
    for kind in () if points else (pa.int64(), pa.uint64(), pa.float64()) if whole else (pa.float64(),):
        try:
            plain = pc.utf8_ltrim(number, "+") if kind != pa.float64() else number
            return np.asarray(pc.cast(plain, kind).to_numpy(zero_copy_only=False))
        except pa.ArrowInvalid:  # does not fit
            continue
    cells = pc.utf8_slice_codeunits(text if points else pc.if_else(blank, "", text), 0, LONGEST_ATTRIBUTE)
    return np.array(cells.to_pylist(), dtype=np.str_)
