"""Read JSON files.

A file contains a list of records (alone, or under a key next to a header), one record per line, or one list per column.

Each value inside the records is a column named by its path, such as ``state.q[3]``, or ``1``, ``2`` for plain lists.
A null or missing value is NaN, or an empty text. True and false are 1 and 0.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import Array, FileColumns, with_gaps
from pipeline.readers.formats.delimited import unpacked
from pipeline.records.trials import Integers

Cells = dict[int, Any]
"""Values of a column, keyed by the number of the record, counted from 0."""


def read(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the values in records as columns, and single values as attributes."""
    data = unpacked(contents.name, path.read_bytes())
    text = data.decode(json.detect_encoding(data)).removeprefix("\ufeff")
    if not text.strip():
        raise refusal("empty", contents.name, "is empty", "JSON", row=1)
    value = _parsed(contents, text)
    if settings.trials is not None:
        for key, inner in _grouped(value):
            if isinstance(inner, list):
                cells = {number: one for number, one in enumerate(inner) if one is not None}
                contents.add(key, partial(column, f"{contents.name}: column {key!r}", cells, len(inner)))
            elif inner is not None:
                contents.note(key, int(inner) if isinstance(inner, bool) else inner)
        return
    records = _records(contents, value, settings.records or "")
    if records is None:
        columns = {
            key: {number: one for number, one in enumerate(inner) if one is not None}
            for key, inner in _flat(value, lists=False)
            if isinstance(inner, list)
        }
    else:
        contents.row_name = "line" if len(contents.row) else "record"
        columns = columns_of(records)
        if not columns:
            raise refusal("empty", contents.name, "contains no records with values", "samples", row=1)
    for key, cells in columns.items():
        if isinstance(next(iter(cells.values()), None), list):  # the column is a matrix
            contents.add(key, partial(np.array, list(cells.values())))
        elif contents.wants(key):
            where = f"{contents.name}: column {key!r}"
            contents.add(key, partial(column, where, cells, len(records or cells), contents.row))


def columns_of(records: Sequence[Any]) -> dict[str, Cells]:
    """Return the values in records by path, in the order in which the paths occur."""
    columns: dict[str, Cells] = {}
    for number, record in enumerate(records):
        if not isinstance(record, dict | list):
            raise refusal("row-length", "", f"has {str(record)[:80]!r}", "an object", row=number + 1)
        for path, value in _flat(record):
            if value is not None:
                columns.setdefault(path, {})[number] = value
    return columns


def column(where: str, cells: Cells, rows: int, row: Sequence[int] | Integers = ()) -> Array:
    """Return one value for each row. ``row`` is the position of each row in the file.

    Raises
    ------
    LogError
        If a column has both texts and numbers.
    """
    found, number = list(cells.values()), [*cells]
    texts = [isinstance(value, str) for value in found]
    if any(texts) != all(texts):
        at = texts.index(False)
        at_row = int(row[number[at]]) if len(row) else number[at] + 1
        raise refusal("not-a-number", where, f"mixes texts and numbers, such as {found[at]!r}", row=at_row)
    beyond = all(isinstance(value, int) for value in found) and max(found) >= 1 << 63
    values = np.array(found, np.uint64 if beyond else None)
    return with_gaps(values.astype(np.int64) if values.dtype == np.bool_ else values, number, rows)


def _flat(value: Any, path: str = "", lists: bool = True) -> Iterator[tuple[str, Any]]:
    """Yield the path and the value of all values inside objects, and also inside lists if ``lists`` is true."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _flat(part, f"{path}.{key}" if path else key, lists)
    elif isinstance(value, list) and lists:
        for number, part in enumerate(value):
            yield from _flat(part, f"{path}[{number}]" if path else str(number + 1), lists)
    else:
        yield path, value


def _grouped(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the path and the value of single values and of lists of plain values, inside objects and lists of
    objects."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _grouped(part, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and any(isinstance(part, dict) for part in value):
        for number, part in enumerate(value):
            yield from _grouped(part, f"{path}[{number}]")
    elif isinstance(value, list) and any(isinstance(part, list) for part in value):
        widths = {len(part) for part in value if isinstance(part, list)}
        for at in range(min(widths, default=0)) if len(widths) == 1 else ():
            yield f"{path}[{at}]", [part[at] for part in value]
    else:
        yield path, value


def _parsed(contents: FileColumns, text: str) -> Any:
    """Return the parsed file. A file with one record per line gives a list."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        if error.msg != "Extra data" or text.lstrip()[0] not in "{[":
            found = f"is not JSON: {error.msg} at column {error.colno}"
            raise refusal("syntax", contents.name, found, row=error.lineno) from error
    lines = [(row, line) for row, line in enumerate(text.split("\n"), start=1) if line.strip()]
    records = []
    for row, line in lines:
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError as error:
            if row == lines[-1][0] and not text.endswith("\n"):
                contents.cut_row(line, row)
                break
            found = f"is not JSON with one record per line: {error}"
            raise refusal("syntax", contents.name, found, cure="Repair the line.", row=row) from error
    contents.row = np.array([row for row, _ in lines[: len(records)]], np.int64)
    return records


def _records(contents: FileColumns, value: Any, path: str) -> list[Any] | None:
    """Return the list of records, or None if each column is a separate list. Single values become attributes."""
    if isinstance(value, list):
        value = {"": value}
    if not isinstance(value, dict):
        raise refusal("header-missing", contents.name, "is a single value", "a list of records", row=1)
    lists: dict[str, list[Any]] = {}
    for key, inner in _flat(value, lists=False):
        if isinstance(inner, list) and (not key or (inner and isinstance(inner[0], dict))):
            lists[key] = inner
        else:
            contents.note(key, int(inner) if isinstance(inner, bool) else inner)
    best = max(lists, key=lambda key: len(lists[key]), default="")
    if path not in lists and (path or (best and contents.wanted)):
        listing = ", ".join(f"{key!r} ({len(found)} records)" for key, found in lists.items()) or "no key"
        found, line = (
            f"has lists of records under {listing}, but not under {path!r}",
            f'records = "{best}"' if best else "",
        )
        raise refusal("profile-wrong", contents.name, found, cure="Correct `records` in the profile.", row=1, line=line)
    if best and not path:
        contents.keys["records"] = best
    return lists[path or best] if lists else None
