"""JSON: a list of records, alone or under a key beside a header; one record a line; or lists beside each other."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.base.errors import Code
from pipeline.profiles.profile_model import Profile
from pipeline.readers.dates import whole_dates
from pipeline.readers.formats.delimited import unpacked
from pipeline.readers.formats.records import Cells, columns_of, flat
from pipeline.readers.frame import Contents
from pipeline.readers.refusals import refusal


def read(path: Path, settings: Profile, contents: Contents) -> None:
    """Add the keys of records, and single values beside them as attributes."""
    data = unpacked(contents.name, path.read_bytes())
    text = data.decode(json.detect_encoding(data)).removeprefix("\ufeff")
    if not text.strip():
        raise refusal("empty", contents.name, "is empty", "JSON", row=1)
    columns, rows = _columns(contents, settings, _parsed(contents, text, float))
    for key, cells in columns.items():
        if not contents.asks(key):
            continue
        count = rows or len(cells.values)
        where = f"{contents.name}: column {key!r}"
        contents.add(key, partial(cells.array, where, count, contents.row))
        source = settings.columns.time if settings.columns else None
        if source is not None and source.key == key and float in set(map(type, cells.values)):
            # a float of a date loses digits that its text has
            again = Contents(contents.name, contents.wanted)
            texts, _ = _columns(again, settings, _parsed(again, text, str))
            stamps: list[str | None] = [None] * count
            for place, stamp in zip(*texts[key], strict=True):
                stamps[place] = str(stamp)
            if dates := whole_dates(source, pa.array(stamps, pa.string())):
                contents.dates[key] = dates


def _columns(contents: Contents, settings: Profile, value: Any) -> tuple[dict[str, Cells], int]:
    """Return columns and number of records; 0 where each column is a list of its own."""
    records = _records(contents, value, settings.records or "")
    if records is None:
        return _lists(contents, value), 0
    contents.row_name = "record" if contents.row is None else "line"
    for number, record in enumerate(records):
        if not isinstance(record, dict | list):
            row = number + 1 if contents.row is None else int(contents.row[number])
            raise refusal("row-length", contents.name, f"has {str(record)[:80]!r}", "an object", row=row)
    columns = columns_of(records)
    if not columns:
        raise refusal("empty", contents.name, "holds no records with values", "samples", row=1)
    return columns, len(records)


def _lists(contents: Contents, value: Any) -> dict[str, Cells]:
    """Return the columns that are lists of their own; lists of lists are matrices."""
    columns = {}
    for key, inner in flat(value, lists=False):
        if isinstance(inner, list) and inner and isinstance(inner[0], list):
            contents.add(key, partial(np.array, inner))
        elif isinstance(inner, list):
            known = [number for number, one in enumerate(inner) if one is not None]
            columns[key] = Cells([*known], [inner[number] for number in known])
    return columns


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object whose keys stand once: of a doubled one only the last value would be left."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"key {max(keys, key=keys.count)!r} stands twice in one object")
    return found


def _parsed(contents: Contents, text: str, number: type) -> Any:
    """Return the value of a file, a list where it has one record a line."""
    load = partial(json.loads, parse_float=number, object_pairs_hook=_object)
    try:
        return load(text)
    except json.JSONDecodeError as error:
        if error.msg != "Extra data" or text.lstrip()[0] not in "{[":
            found = f"is no JSON: {error.msg} at column {error.colno}"
            raise refusal("syntax", contents.name, found, row=error.lineno) from error
    lines = {number: line for number, line in enumerate(text.split("\n"), start=1) if line.strip()}
    records, last = [], max(lines)
    for row, line in lines.items():
        try:
            records.append(load(line))
        except ValueError as error:
            if row == last and not text.endswith("\n"):
                contents.cut_row(line, row)
                break
            code: Code = "syntax" if isinstance(error, json.JSONDecodeError) else "damaged"
            found = f"is no JSON with one record a line: {error}"
            raise refusal(code, contents.name, found, cure="Repair the line.", row=row) from error
    contents.row = np.array(list(lines)[: len(records)], np.int64)
    return records


def _records(contents: Contents, value: Any, path: str) -> list[Any] | None:
    """Return the list of records; None where each column is a list of its own. Single values become attributes."""
    if isinstance(value, list):
        if path:
            found = f"is itself a list of records; remove records = {path!r} from the profile"
            raise refusal("profile-wrong", contents.name, found, row=1)
        return value
    if not isinstance(value, dict):
        raise refusal("header-missing", contents.name, "holds a single value", "a list of records", row=1)
    lists: dict[str, list[Any]] = {}
    for key, inner in flat(value, lists=False):
        if isinstance(inner, list) and inner and isinstance(inner[0], dict):
            lists[key] = inner
        else:
            contents.note(key, int(inner) if isinstance(inner, bool) else inner)
    best = max(lists, key=lambda key: len(lists[key]), default="")
    if (path and path not in lists) or (best and not path and contents.wanted):
        listing = ", ".join(f"{key!r} ({len(found)} records)" for key, found in lists.items()) or "no key"
        found = f"has lists of records under {listing}, and not under {path!r}"
        line = f'records = "{best}"' if best else ""
        raise refusal("profile-wrong", contents.name, found, cure="Correct `records` in the profile.", row=1, line=line)
    if best and not path:
        contents.keys["records"] = best
    return lists[path or best] if lists else None
