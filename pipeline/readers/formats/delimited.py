"""Reads delimited text (CSV, TSV, semicolons, runs of blanks, terminal logs; gzip, zstd), as a profile lays it out."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from pipeline.base.errors import LogError
from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_model import Profile
from pipeline.profiles.profile_text import BLANKS, TextLayout
from pipeline.readers.dates import whole_dates
from pipeline.readers.formats.plain_text import plain_text
from pipeline.readers.frame import ColumnInfo, Frame, Scalar
from pipeline.readers.limits import LONGEST_BANNER
from pipeline.readers.safety import check_columns
from pipeline.records.batch import Integers

SHOWN_VALUES = 3
"""First values of a column that `list_columns` gives."""

_INTEGER = r"^[+-]?[0-9]{1,20}$"
_LABEL_BEGINS = re.compile(r"\s*[^\W\d]")
"""A label begins with a letter: "12:30" is a time of day."""


@dataclass(frozen=True, eq=False)
class _Table:
    """The rows of the table as text, one a line.

    ``top`` is the number of the line of names (of the first row without one), ``line`` that of the first row where all
    follow each other, else of each row. ``whole`` says whether the last line has a line end.
    """

    top: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    body: str
    line: int | Integers
    whole: bool
    attributes: dict[str, Scalar]

    def row(self, count: int) -> Integers:
        """Return the line numbers of the first rows."""
        return np.arange(self.line, self.line + count) if isinstance(self.line, int) else self.line[:count]


def read_frame(profile: Profile, name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Read the wanted columns (all where none is named) of a delimited file.

    A last row that is cut (fewer cells than the others, or without line end and with a cell that is no number) is left
    out with a warning and kept verbatim as the attribute ``cut_last_row``.

    Raises
    ------
    LogError
        If the table is not found, a column is missing or named twice, or a row has another number of cells.
    """
    table = _find_table(profile, name, data)
    places = _places(profile, name, table, wanted)
    rows = table.row(table.body.count("\n"))
    if not len(rows):
        text = f"{name} has 0 samples; expected at least 2. Was the recording cut off? Record it again."
        raise LogError(text, table.top + 1, code="empty")
    cells, dropped = _cells(profile, name, table, sorted(set(places.values())))
    warnings = []
    last = table.body[table.body.rfind("\n", 0, -1) + 1 : -1]
    cut = len(rows) - 1 in dropped
    columns = {place: _values(profile, values) for place, values in cells.items()}
    if not cut and not table.whole and len(rows) > 1 and _last_is_cut(profile, cells, columns):
        cells = {place: values[:-1] for place, values in cells.items()}
        columns = {place: _values(profile, values) for place, values in cells.items()}
        cut, dropped = True, {*dropped, len(rows) - 1}
    attributes = dict(table.attributes)
    if cut:
        attributes["cut_last_row"] = last
        warnings.append(f"last row is cut: {last[:200]!r} (line {rows[-1]}) was left out and is kept verbatim")
    elif not table.whole:
        warnings.append(f"line {rows[-1]} is the last one and has no line end: its last value may be cut")
    return Frame(
        columns={key: columns[place] for key, place in places.items()},
        row=np.delete(rows, sorted(dropped)),
        row_name="line",
        attributes=attributes,
        warnings=tuple(warnings),
        dates=_dates(profile, places, cells, columns),
    )


def _dates(
    profile: Profile, places: dict[str, int], cells: dict[int, pa.ChunkedArray], columns: dict[int, NDArray[Any]]
) -> dict[str, tuple[Integers, int]]:
    """Return the stamps of the time column exactly where they are dates with decimals or blank cells."""
    source = profile.columns.time if profile.columns else None
    place = None if source is None else places.get(source.key)
    if source is None or place is None or columns[place].dtype.kind != "f":
        return {}
    found = whole_dates(source, _numbers(profile, cells[place])[1])
    return {} if found is None else {source.key: found}


def list_columns(name: str, data: bytes, profile: Profile | None = None) -> list[ColumnInfo]:
    """Return the columns of a delimited file, laid out as the profile says (commas and decimal points without one).

    Raises
    ------
    LogError
        As `read_frame`.
    """
    if profile is None:
        profile = Profile.model_construct(name="none", format="delimited", files=("*",))
    units = _find_table(profile, name, data).units
    frame = read_frame(profile, name, data, ())
    kinds = {"i": "integer", "f": "number"}
    return [
        ColumnInfo(
            column,
            kinds.get(values.dtype.kind, "text"),
            len(values),
            tuple(str(value) for value in values[:SHOWN_VALUES]),
            units[index].strip("[]() ") if index < len(units) else "",
        )
        for index, (column, values) in enumerate(frame.columns.items())
    ]


def _find_table(layout: Profile, name: str, data: bytes) -> _Table:
    """Return the table: what stands above it is skipped, or read as labels."""
    text, whole = plain_text(layout, name, data)
    attributes: dict[str, Scalar] = {}
    below, at = layout.header_after, layout.header_at
    start, number, top = 0, 0, 1
    names: tuple[str, ...] = ()
    while start < len(text) and number < layout.skip_rows + LONGEST_BANNER:
        number += 1
        end = text.find("\n", start) + 1
        line = text[start:end].rstrip("\n")
        before, start = start, end
        if at is not None and number > layout.skip_rows and find_groups(at, line) is not None:
            at = None
        elif number <= layout.skip_rows or at is not None or below is not None or _is_comment(layout, line):
            _take_label(layout, name, line, number, attributes)
            if below is not None and number > layout.skip_rows and find_groups(below, line) is not None:
                below = None
            continue
        elif layout.labels is not None and (not line.strip() or _take_label(layout, name, line, number, attributes)):
            continue
        top = number
        if layout.header:
            names = _split(layout, name, line, number)
            break
        start, number = before, number - 1
        names = tuple(str(i + 1) for i in range(len(_split(layout, name, line, number + 1))))
        break
    check_columns(name, len(names))
    if not names:
        raise LogError(
            f"{name} is empty{_looked_for(layout)}; expected a line of column names and samples.", 1, code="empty"
        )
    units: tuple[str, ...] = ()
    if layout.unit_line:
        number += 1
        end = text.find("\n", start) + 1
        units, start = _split(layout, name, text[start:end], number), end
    body, line_numbers = _rows(layout, name, text[start:], number + 1)
    return _Table(top, names, units, body, line_numbers, whole, attributes)


def _looked_for(layout: TextLayout) -> str:
    """Say in a message what marks the table."""
    for key in ("header_at", "header_after"):
        pattern = getattr(layout, key)
        if pattern is not None:
            return f" or has no line that fits {key} = {pattern!r}"
    return f" below skip_rows = {layout.skip_rows}" if layout.skip_rows else ""


def _is_comment(layout: TextLayout, line: str) -> bool:
    return layout.comment is not None and line.lstrip().startswith(layout.comment)


def _take_label(layout: Profile, name: str, line: str, row: int, attributes: dict[str, Scalar]) -> bool:
    """Keep a line "label: value" as an attribute; return whether it is one.

    Of a label that stands several times the last value is kept, but a condition must not change.
    """
    if layout.labels is None:
        return False
    if _is_comment(layout, line):
        line = line.lstrip()[len(layout.comment or "") :]
    label, sign, value = line.partition(layout.labels)
    if not sign or not _LABEL_BEGINS.match(label):
        return False
    label, value = label.strip(), value.strip()
    key = next((key for key, wanted in layout.attributes.items() if wanted == label), None)
    if key is not None and attributes.get(label, value) != value:
        raise LogError(
            f"{name}: the label {label!r}, which gives the {key}, is {attributes[label]!r} and here {value!r}; "
            "expected one value for a log. Give the condition by [[file]] or [[steps]] and remove it from "
            "[attributes], or part the file.",
            row,
            code="condition-wrong",
        )
    attributes[label] = value
    return True


def _split(layout: TextLayout, name: str, line: str, row: int) -> tuple[str, ...]:
    """Return the cells of a line of names or units."""
    if layout.delimiter == BLANKS:
        return tuple(line.split())
    try:
        cells = [cell.strip() for cell in next(csv.reader([line.rstrip("\n")], delimiter=layout.delimiter), [])]
    except csv.Error as error:
        raise LogError(
            f"{name}: the line of names cannot be taken apart ({error}); expected names of columns. Correct the "
            f"delimiter ({layout.delimiter!r}), or export the file again.",
            row,
            code="too-long-line",
        ) from error
    if layout.trailing_delimiter and cells and not cells[-1]:
        cells.pop()
    return tuple(cells)


def _rows(layout: TextLayout, name: str, body: str, first: int) -> tuple[str, int | Integers]:
    """Return the text of the table with one delimiter between cells and none behind, and the line numbers."""
    numbers: int | Integers = first
    blank = re.search(r"^[ \t]*\n", body, re.MULTILINE)
    if blank and layout.blank_lines == "refuse":
        raise LogError(
            f'{name}: found a blank line between rows; expected a row. Remove it, or add blank_lines = "skip".',
            first + body.count("\n", 0, blank.start()),
            code="row-length",
            profile_line='blank_lines = "skip"',
        )
    if blank or layout.comment is not None:
        lines = body.split("\n")[:-1]
        kept = [i for i, line in enumerate(lines) if line.strip() and not _is_comment(layout, line)]
        numbers = first + np.array(kept, dtype=np.int64)
        body = "".join(f"{lines[i]}\n" for i in kept)
    if layout.delimiter == BLANKS:
        # runs become single tabs first: to look for the end of a line in a long run takes its length squared
        body = re.sub(r"^\t|\t$", "", re.sub(r"[ \t]+", "\t", body), flags=re.MULTILINE)
    elif layout.trailing_delimiter:
        body = _without_last_delimiter(layout.delimiter, body)
    return body, numbers


def _without_last_delimiter(delimiter: str, body: str) -> str:
    """Return the rows without the delimiter at their ends and the blanks behind it."""
    if delimiter not in " \t":
        return re.sub(f"{re.escape(delimiter)}[ \t]*$", "", body, flags=re.MULTILINE)
    # of a run of blanks, what stands before the first delimiter stays; a run is taken from its beginning only
    return re.sub(r"(?<![ \t])[ \t]+$", lambda run: run[0].partition(delimiter)[0], body, flags=re.MULTILINE)


def _places(profile: Profile, name: str, table: _Table, wanted: Sequence[str]) -> dict[str, int]:
    """Return the position of each wanted column, counted from 0; where none is wanted, of all that have a name."""
    names = table.names
    if not wanted:
        return {label if names.index(label) == i else f"{label} ({i + 1})": i for i, label in enumerate(names)}
    by_position = {str(source.column) for source in profile.column_sources().values() if source.column is not None}
    keys = {column: key for file in ("source", "partner") for key, column in profile.wanted(file).items()}
    places = {}
    if len(names) == 1 < len(set(wanted)):
        raise LogError(
            f"{name}: has one column, {names[0]!r}, but profile {profile.name} wants {', '.join(wanted)}. Correct the "
            f"delimiter ({profile.delimiter!r}); a log needs command and position, or velocity, in each row.",
            table.top,
            code="column-missing",
        )
    for column in wanted:
        if column in by_position or not profile.header:
            if not column.isdecimal() or not 1 <= int(column) <= len(names):
                raise LogError(
                    f"{name}: profile {profile.name} wants column {column} for {keys.get(column, column)}, found "
                    f"{len(names)} columns. Correct it, or the delimiter ({profile.delimiter!r}).",
                    table.top,
                    code="column-missing",
                )
            places[column] = int(column) - 1
        elif names.count(column) != 1:
            raise LogError(
                f"{name}: profile {profile.name} wants column {column!r} for {keys.get(column, column)} once, found it "
                f"{names.count(column)} times among {list(names)}. Correct the name, give column = <position>, or "
                f"correct the delimiter ({profile.delimiter!r}).",
                table.top,
                code="column-missing",
            )
        else:
            places[column] = names.index(column)
    return places


def _cells(layout: Profile, name: str, table: _Table, places: list[int]) -> tuple[dict[int, pa.ChunkedArray], set[int]]:
    """Return the cells of columns as text, and the rows (counted from 0) that were left out."""
    width, count = len(table.names), table.body.count("\n")
    bad: list[tuple[int, int, str]] = []

    def take(row: pacsv.InvalidRow) -> str:
        bad.append((row.number - 1, row.actual_columns, row.text))
        return "skip"

    labels = [str(i) for i in range(width)]
    try:
        data = pacsv.read_csv(
            pa.BufferReader(table.body.encode()),
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
        raise LogError(
            f"{name} cannot be read as delimited text: {error}.", int(table.row(1)[0]), code="damaged"
        ) from error
    if data.num_rows + len(bad) != count:
        # a quotation mark that is not closed takes the lines below into its cell
        at = next((i for i, line in enumerate(table.body.split("\n")) if line.count('"') % 2), 0)
        raise LogError(
            f"{name}: found {data.num_rows + len(bad)} rows in {count} lines; expected each row on one line. Is a "
            "quotation mark not closed here? Remove it, or leave this log out.",
            int(table.row(count)[at]),
            code="row-length",
        )
    for row, found, text in bad:
        last_is_cut = row == count - 1 and found < width and row > 0
        line = int(table.row(count)[row])
        if not last_is_cut and not _take_label(layout, name, text, line, table.attributes):
            one_more = found == width + 1 and text.rstrip().endswith(layout.delimiter)
            one_more |= found == width - 1 and not table.names[-1]  # of the line of names
            hint = ", or add trailing_delimiter = true" if one_more else ""
            commas = layout.delimiter == "," and found > width
            decimal = ', or write decimal = "," and another delimiter.' if commas else "."
            raise LogError(
                f"{name}: expected {width} values, found {found} ({text[:200]!r}). Repair the row{hint}{decimal}",
                line,
                code="row-length",
                profile_line="trailing_delimiter = true" if one_more else None,
            )
    return {i: data.column(labels[i]) for i in places}, {row for row, _, _ in bad}


def _last_is_cut(layout: TextLayout, cells: dict[int, pa.ChunkedArray], columns: dict[int, NDArray[Any]]) -> bool:
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


def _values(layout: TextLayout, column: pa.ChunkedArray) -> NDArray[Any]:
    """Return cells as integers where all are whole numbers, as float64 where all are numbers or blank, else as text."""
    text, number = _numbers(layout, column)
    blank = pc.is_null(number)
    if layout.decimal == "," and pc.any(pc.and_not(pc.match_substring(text, "."), blank)).as_py():
        return np.array(text.to_pylist(), dtype=np.str_)
    if not pc.any(blank).as_py() and pc.all(pc.match_substring_regex(number, _INTEGER)).as_py():
        for kind in (pa.int64(), pa.uint64()):
            try:
                integers: NDArray[Any] = pc.cast(pc.utf8_ltrim(number, "+"), kind).to_numpy(zero_copy_only=False)
                return integers
            except pa.ArrowInvalid:  # does not fit
                continue
    try:
        floats: NDArray[Any] = pc.cast(number, pa.float64()).to_numpy(zero_copy_only=False)
        return floats
    except pa.ArrowInvalid:
        return np.array(pc.if_else(blank, "", text).to_pylist(), dtype=np.str_)
