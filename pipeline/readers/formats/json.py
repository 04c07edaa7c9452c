"""JSON: a list of records, alone or under a key beside a header; one record a line; or lists beside each other.

Names of nested keys are joined by dots, elements of lists get brackets: ``state.q[3]``. A value that is null or not
there is NaN, or an empty text; true and false are 1 and 0.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.profiles.profile_model import Profile
from pipeline.readers.dates import whole_dates
from pipeline.readers.formats.delimited import unpacked
from pipeline.readers.frame import Array, Contents, with_gaps
from pipeline.readers.limits import DEEPEST, EXACT
from pipeline.readers.refusals import refusal

_LONGEST = 16
"""Characters of a number, its decimal point among them, that a float always keeps."""


class LongNumber(float):
    """A number such as 1700000000.123456789, of which a float loses digits; ``text`` has them."""

    text: str


class DoubledKeyError(ValueError):
    """A key that stands twice in one object: only its last value would be left."""


def read(path: Path, settings: Profile, contents: Contents) -> None:
    """Add the keys of records, and single values beside them as attributes."""
    data = unpacked(contents.name, path.read_bytes())
    text = data.decode(json.detect_encoding(data)).removeprefix("\ufeff")
    if not text.strip():
        raise refusal("empty", contents.name, "is empty", "JSON", row=1)
    value = _parsed(contents, text)
    records = _records(contents, value, settings.records or "")
    cells: dict[str, tuple[list[int], list[Any]]] = {}
    if records is None:
        for key, inner in _walk(value, lists=False):
            if isinstance(inner, list) and inner and isinstance(inner[0], list):
                contents.add(key, partial(np.array, inner))
            elif isinstance(inner, list):
                known = [number for number, one in enumerate(inner) if one is not None]
                _add(contents, settings, key, known, [inner[number] for number in known], len(inner))
        return
    rows, contents.row_name = len(records), "record" if contents.row is None else "line"
    contents.row = np.arange(1, rows + 1) if contents.row is None else contents.row
    for number, record in enumerate(records):
        row = int(contents.row[number])
        if not isinstance(record, dict | list):
            found = f"{contents.row_name} is {str(record)[:80]!r}"
            raise refusal("row-length", contents.name, found, "an object", row=row)
        for key, one in _walk(record):
            if one is not None:
                numbers, values = cells.setdefault(key, ([], []))
                if numbers and numbers[-1] == number:
                    found = f"{key!r} stands twice in one {contents.row_name}"
                    raise refusal("damaged", contents.name, found, "one value", row=row)
                numbers.append(number)
                values.append(one)
    if not cells:
        raise refusal("empty", contents.name, "holds no records with values", "samples", row=1)
    for key, (numbers, values) in cells.items():
        if contents.asks(key):
            _add(contents, settings, key, numbers, values, rows)


def _add(contents: Contents, settings: Profile, key: str, numbers: list[int], values: list[Any], rows: int) -> None:
    """Add the values of a column at their records, with the digits of stamps that are dates."""
    where, place = f"{contents.name}: column {key!r}", np.array(numbers, np.int64)

    def load() -> Array:
        return with_gaps(where, _array(where, values, place, contents), place, rows, contents.row)

    contents.add(key, load)
    source = settings.columns.time if settings.columns else None
    if source is not None and source.key == key and any(isinstance(value, float) for value in values):
        texts: list[str | None] = [None] * rows
        for number, one in zip(numbers, values, strict=True):
            texts[number] = one.text if isinstance(one, LongNumber) else repr(one)
        if dates := whole_dates(source, pa.array(texts, pa.string())):
            contents.dates[key] = dates


def load_json(text: str | bytes) -> Any:
    """Return the value of a JSON text, with the digits of dates; raises `DoubledKeyError`."""

    def build(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in pairs:
            if key in found:
                raise DoubledKeyError(f"key {key!r} stands twice in one object")
            found[key] = value
        return found

    return json.loads(text, parse_float=_number, object_pairs_hook=build)


def _number(text: str) -> float:
    # dates have 9 digits and more before the point; other long fractions are only what printing a float gives
    if len(text) <= _LONGEST or text.find(".", 8) < 0:
        return float(text)
    number = LongNumber(text)
    number.text = text
    return number


def _parsed(contents: Contents, text: str) -> Any:
    """Return the value of a file, a list where it has one record a line."""
    cure = "Repair the file, or leave it out."
    try:
        return load_json(text)
    except DoubledKeyError as error:
        expected = "it once, since nobody can tell which value counts"
        raise refusal("damaged", contents.name, str(error), expected, cure) from error
    except json.JSONDecodeError as error:
        if error.msg != "Extra data" or not text.lstrip().startswith(("{", "[")):
            found = f"is no JSON: {error.msg} at column {error.colno}"
            raise refusal("syntax", contents.name, found, row=error.lineno) from error
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    records: list[Any] = []
    for number, line in lines:
        try:
            records.append(load_json(line))
        except DoubledKeyError as error:
            raise refusal("damaged", contents.name, f"{error} of line {number}", "it once", cure, number) from error
        except json.JSONDecodeError as error:
            if number == lines[-1][0] and not text.endswith("\n"):
                said = f"last row is cut: {line[:200]!r} (line {number}) was left out and is kept verbatim"
                contents.warnings.append(said)
                contents.note("cut_last_row", line)
                break
            found = f"is no JSON with one record a line: {error.msg} at column {error.colno}"
            raise refusal("syntax", contents.name, found, cure="Repair the line.", row=number) from error
    contents.row_name, contents.row = "line", np.array([number for number, _ in lines[: len(records)]], np.int64)
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
    for key, inner in _walk(value, lists=False):
        if isinstance(inner, list) and inner and isinstance(inner[0], dict):
            lists[key] = inner
        else:
            contents.note(key, int(inner) if isinstance(inner, bool) else inner)
    best = max(lists, key=lambda key: len(lists[key]), default="")
    if (path and path not in lists) or (best and not path and contents.wanted):
        listing = ", ".join(f"{key!r} ({len(found)} records)" for key, found in lists.items()) or "no key"
        found = f"has no list of records under {path!r}; such lists are" if path else "holds lists of records"
        cure, line = "Correct `records` in the profile.", f'records = "{best}"' if best else ""
        cure = cure if path else f"Add {line} (or another of them) to the profile."
        raise refusal("profile-wrong", contents.name, f"{found} under {listing}", "", cure, 1, line)
    if best and not path:
        contents.keys["records"] = best
    return lists[path or best] if lists else None


def _walk(value: Any, path: str = "", depth: int = 0, lists: bool = True) -> Iterator[tuple[str, Any]]:
    """Yield path and value of all that is inside objects, and inside lists where ``lists``."""
    if depth > DEEPEST:
        raise refusal("too-deep", "", f"{path[:200]!r} is nested more than {DEEPEST} deep", "records of one form")
    inner: Mapping[Any, Any] = {}
    if isinstance(value, dict):
        inner = {f"{path}.{key}" if path else key: part for key, part in value.items()} if path else value
    elif isinstance(value, list) and lists:
        # a record that is a list has columns without names: "1", "2", ...
        inner = {f"{path}[{i}]" if path else str(i + 1): part for i, part in enumerate(value)}
    else:
        yield path, value
        return
    for key, part in inner.items():
        if isinstance(part, dict | list):
            yield from _walk(part, key, depth + 1, lists)
        else:
            yield key, part


def _array(where: str, values: list[Any], place: Array, contents: Contents) -> Array:
    """Return values as integers, float64 or text."""
    kinds = {type(value) for value in values}

    def row(number: int) -> int:
        return int(place[number]) + 1 if contents.row is None else int(contents.row[place[number]])

    if str in kinds:
        if kinds != {str} and contents.wanted:
            at = next(i for i, value in enumerate(values) if not isinstance(value, str))
            found = f"{where} mixes texts and numbers: {contents.row_name} has {values[at]!r}"
            raise refusal("not-a-number", "", found, "one kind", row=row(at))
        return np.array([str(value) for value in values], np.str_)
    if kinds <= {int, bool}:
        return np.array([int(value) for value in values], np.int64 if max(values, default=0) < 1 << 63 else np.uint64)
    big = next((i for i, value in enumerate(values) if isinstance(value, int) and abs(value) > EXACT), None)
    if big is not None:
        found = f"{where} mixes whole numbers of more than 15 digits, such as {values[big]}, with fractions"
        raise refusal("no-value", "", found, "whole numbers throughout, which are kept exactly", row=row(big))
    return np.array(values, np.float64)
