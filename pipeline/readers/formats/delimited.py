"""Delimited text (CSV, TSV, semicolons, runs of blanks, terminal logs; gzip, zstd), as a profile lays it out."""

from __future__ import annotations

import codecs
import csv
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv

from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_model import Profile
from pipeline.profiles.profile_text import BLANKS, TextLayout
from pipeline.readers.dates import whole_dates
from pipeline.readers.frame import Array, Contents
from pipeline.readers.isolation import allowed_bytes
from pipeline.readers.limits import LONGEST_LINE
from pipeline.readers.refusals import refusal
from pipeline.records.batch import Integers

LONGEST_CHARACTER = 4
"""Bytes of the longest character in UTF-8 and UTF-16: a cut file lacks fewer than that."""

_BLOCK = 1 << 22
"""Bytes that are unpacked at once."""

PACKED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
"""First bytes of packed files."""

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
    names = _split(settings, contents, lines[top], top + 1)
    names = names if settings.header else [str(i + 1) for i in range(len(names))]
    first = top + settings.header + settings.unit_line
    units = _split(settings, contents, lines[first - 1], first) if settings.unit_line and first <= len(lines) else []
    row = _rows(settings, contents, lines, first)
    places = _places(settings, contents, names, top + 1)
    if not len(row):
        raise refusal("too-short", contents.name, "has 0 samples", "at least 2", row=top + 2)
    cells, kept = _cells(settings, contents, [lines[i - 1] for i in row], names, sorted({*places.values()}), row)
    last, columns = lines[row[-1] - 1], {place: _values(settings, values) for place, values in cells.items()}
    cut = kept[-1] != len(row) - 1 and len(kept) == len(row) - 1 - sum(np.diff(kept, prepend=-1) - 1)
    if not cut and not whole and len(kept) > 1 and _last_is_cut(settings, cells, columns):
        cut, kept, cells = True, kept[:-1], {place: values[:-1] for place, values in cells.items()}
        columns = {place: _values(settings, values) for place, values in cells.items()}
    if cut:
        contents.cut_row(last, int(row[-1]))
    elif not whole:
        contents.warnings.append(f"line {row[-1]} is the last one and has no line end: its last value may be cut")
    contents.row = row[kept]
    time = settings.columns.time if settings.columns else None
    for key, place in places.items():
        contents.add(key, columns[place], units[place].strip("[]() ") if place < len(units) else "")
        # stamps may be dates with decimals or blank cells
        stamps = time is not None and key == time.key and columns[place].dtype.kind == "f"
        if time is not None and stamps and (dates := whole_dates(time, _numbers(settings, cells[place])[1])):
            contents.dates[key] = dates


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
    parts: list[bytes] = []
    most = allowed_bytes(len(data))
    try:
        with pa.CompressedInputStream(pa.BufferReader(data), codec) as stream:
            while len(parts) * _BLOCK <= most and (part := stream.read(_BLOCK)):
                parts.append(part)
    except (OSError, pa.ArrowException) as error:
        raise refusal("damaged", name, f"cannot be unpacked ({codec}): {error}") from error
    if len(text := b"".join(parts)) > most:
        raise refusal("unpacks-too-large", name, f"unpacks to more than {most} bytes", "a log")
    return text


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
    if not end:
        return "", True
    if len(text) > LONGEST_LINE:
        for number, line in enumerate(text.split("\n"), start=1):
            if len(line) > LONGEST_LINE:
                found = f"has a line of more than {LONGEST_LINE} characters"
                raise refusal("too-long-line", name, found, "one line for each sample", row=number)
    # blank cells at the end of the last row stay, blank lines below it go
    last, line_end, _ = text[end:].partition("\n")
    return text[:end] + last + "\n", bool(line_end)


def _decoded(layout: TextLayout, name: str, data: bytes) -> str:
    marked = next((encoding for mark, encoding in _MARKS.items() if data.startswith(mark)), None)
    if marked is not None and marked != layout.encoding:
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
        if number < layout.skip_rows:
            _take_label(layout, contents, line, number + 1)
        elif at is not None and find_groups(at, line) is not None:
            return number
        elif below is not None and find_groups(below, line) is not None:
            _take_label(layout, contents, line, number + 1)
            below = None
        elif at is not None or below is not None or _is_comment(layout, line):
            _take_label(layout, contents, line, number + 1)
        elif layout.labels is None or (line.strip() and not _take_label(layout, contents, line, number + 1)):
            return number
    looked = f"below skip_rows = {layout.skip_rows}, header_at = {at!r} and header_after = {layout.header_after!r}"
    raise refusal("empty", contents.name, f"is empty {looked}", "a line of column names and samples", row=1)


def _is_comment(layout: TextLayout, line: str) -> bool:
    return layout.comment is not None and line.lstrip().startswith(layout.comment)


def _take_label(layout: Profile, contents: Contents, line: str, row: int) -> bool:
    """Keep a line "label: value" as an attribute; return whether it is one.

    Of a label that stands several times the last value is kept, but a condition must not change.
    """
    if layout.labels is None:
        return False
    line = line.lstrip()[len(layout.comment or "") :] if _is_comment(layout, line) else line
    label, sign, value = (part.strip() for part in line.partition(layout.labels))
    if not sign or not _LABEL_BEGINS.match(label):
        return False
    key = next((key for key, wanted in layout.attributes.items() if wanted == label), None)
    if key is not None and contents.attributes.get(label, value) != value:
        found = f"the label {label!r}, which gives the {key}, is {contents.attributes[label]!r} and here {value!r}"
        raise refusal("condition-wrong", contents.name, found, "one value for a log", row=row)
    contents.note(label, value)
    return True


def _split(layout: TextLayout, contents: Contents, line: str, row: int) -> list[str]:
    """Return the cells of a line of names or units."""
    if layout.delimiter == BLANKS:
        return line.split()
    try:
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=layout.delimiter), [])]
    except csv.Error as error:
        found = f"the line of names cannot be taken apart by {layout.delimiter!r} ({error})"
        raise refusal("too-long-line", contents.name, found, "names of columns", row=row) from error
    return cells[:-1] if layout.trailing_delimiter and cells and not cells[-1] else cells


def _rows(layout: TextLayout, contents: Contents, lines: list[str], first: int) -> Integers:
    """Return the numbers of the lines that are rows, and give these one delimiter between cells and none behind."""
    row = []
    for number in range(first, len(lines)):
        line = lines[number]
        if not line.strip(" \t"):
            if layout.blank_lines == "refuse":
                found, line = "a blank line between rows", 'blank_lines = "skip"'
                raise refusal("row-length", contents.name, found, "a row", row=number + 1, line=line)
        elif not _is_comment(layout, line):
            row.append(number + 1)
            if layout.delimiter == BLANKS:
                lines[number] = "\t".join(line.split())
            elif layout.trailing_delimiter:
                lines[number] = line.rstrip(" \t".replace(layout.delimiter, "")).removesuffix(layout.delimiter)
    return np.array(row, np.int64)


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
            found = f"{wants} once, found it {len(fits)} times among {len(names)} columns: {names}"
            raise refusal("column-missing", contents.name, found, cure=cure, row=row)
        places[column] = fits[0]
    return places


def _cells(
    layout: Profile, contents: Contents, lines: list[str], names: list[str], places: list[int], row: Integers
) -> tuple[dict[int, pa.ChunkedArray], Integers]:
    """Return the cells of columns as text, and the rows (counted from 0) that were kept."""
    bad: list[tuple[int, int, str]] = []

    def take(found: pacsv.InvalidRow) -> str:
        bad.append((found.number - 1, found.actual_columns, found.text))
        return "skip"

    labels = [str(i) for i in range(len(names))]
    try:
        data = pacsv.read_csv(
            pa.BufferReader("".join(f"{line}\n" for line in lines).encode()),
            # rows are numbered in the order of the file by one thread only
            read_options=pacsv.ReadOptions(column_names=labels, use_threads=False),
            parse_options=pacsv.ParseOptions(
                delimiter="\t" if layout.delimiter == BLANKS else layout.delimiter,
                ignore_empty_lines=False,
                invalid_row_handler=take,
            ),
            convert_options=pacsv.ConvertOptions(
                column_types=dict.fromkeys(labels, pa.string()),
                include_columns=[labels[i] for i in places],
                null_values=[],
                strings_can_be_null=False,
            ),
        )
    except pa.ArrowInvalid as error:
        found = f"cannot be read as delimited text: {error}"
        raise refusal("damaged", contents.name, found, row=int(row[0])) from error
    if data.num_rows + len(bad) != len(lines):
        # a quotation mark that is not closed takes the lines below into its cell
        at = next((i for i, line in enumerate(lines) if line.count('"') % 2), 0)
        found = f"{data.num_rows + len(bad)} rows in {len(lines)} lines; is a quotation mark not closed here?"
        raise refusal("row-length", contents.name, found, row=int(row[at]))
    for number, width, text in bad:
        last_is_cut = number == len(lines) - 1 and number > 0 and width < len(names)
        if not last_is_cut and not _take_label(layout, contents, text, int(row[number])):
            more = width == len(names) + 1 and text.rstrip().endswith(layout.delimiter)
            more |= width == len(names) - 1 and not names[-1]  # of the line of names
            line = "trailing_delimiter = true" if more else ""
            cure = ""
            if layout.delimiter == "," and width > len(names):
                cure = 'If these are decimal commas, write decimal = "," and another delimiter.'
            found = f"expected {len(names)} values, found {width} ({text[:200]!r})"
            raise refusal("row-length", contents.name, found, "", cure, int(row[number]), line)
    kept = np.delete(np.arange(len(lines)), [number for number, _, _ in bad])
    return {i: data.column(labels[i]) for i in places}, kept


def _last_is_cut(layout: TextLayout, cells: dict[int, pa.ChunkedArray], columns: dict[int, Array]) -> bool:
    """Return whether a column is of numbers, none of them missing, but for its last cell."""
    for place, values in columns.items():
        if values.dtype.kind == "U" and _values(layout, cells[place][:-1]).dtype.kind != "U":
            return True
        if values.dtype.kind == "f" and np.isnan(values[-1]) and not np.isnan(values[:-1]).any():
            return True
    return False


def _numbers(layout: TextLayout, column: pa.ChunkedArray) -> tuple[pa.Array, pa.Array]:
    """Return cells as they are, and with a decimal point and null where they have no value."""
    text = pc.utf8_trim_whitespace(column.combine_chunks())
    blank = pc.is_in(text, value_set=pa.array(["", *layout.missing], pa.string()))
    number = pc.if_else(blank, None, text)
    return text, pc.replace_substring(number, ",", ".") if layout.decimal == "," else number


def _values(layout: TextLayout, column: pa.ChunkedArray) -> Array:
    """Return cells as integers where all are whole numbers, as float64 where all are numbers or blank, else as text."""
    text, number = _numbers(layout, column)
    blank = pc.is_null(number)
    points = layout.decimal == "," and pc.any(pc.and_not(pc.match_substring(text, "."), blank)).as_py()
    whole = not pc.any(blank).as_py() and pc.all(pc.match_substring_regex(number, _INTEGER)).as_py()
    kinds: tuple[Any, ...] = () if points else (pa.int64(), pa.uint64(), pa.float64()) if whole else (pa.float64(),)
    for kind in kinds:
        try:
            plain = pc.utf8_ltrim(number, "+") if kind != pa.float64() else number
            return np.asarray(pc.cast(plain, kind).to_numpy(zero_copy_only=False))
        except pa.ArrowInvalid:  # does not fit
            continue
    return np.array(text.to_pylist() if points else pc.if_else(blank, "", text).to_pylist(), dtype=np.str_)
