"""Reads JSON: a list of records, alone or under a key beside a header; one record a line; or lists beside each other.

Names of nested keys are joined by dots, elements of lists get brackets: ``state.q[3]``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.base.errors import LogError
from pipeline.profiles.profile_columns import TimeSource
from pipeline.profiles.profile_model import Profile
from pipeline.readers.dates import whole_dates
from pipeline.readers.formats.arrays import Array, StoredArray, frame_of_arrays, list_arrays, stored, unknown_column
from pipeline.readers.formats.json_text import LongNumber, Place, parse_json
from pipeline.readers.frame import ColumnInfo, Frame, Scalar
from pipeline.readers.limits import DEEPEST, EXACT
from pipeline.readers.safety import check_claim, check_columns, reading
from pipeline.records.batch import Integers


@dataclass
class _Cells:
    """Values of a column and the records they stand in; records without the name take no memory."""

    numbers: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)


def read_frame(profile: Profile, name: str, data: bytes, wanted: Sequence[str]) -> Frame:
    """Read records of a JSON file.

    Parameters
    ----------
    profile : Profile
        ``records`` is the path of the list of records, such as ``"entries"``; empty where the file is the list, has
        one record a line, or holds one list for each column.
    name : str
        File name, for messages.
    data : bytes
        UTF-8, UTF-16 or UTF-32, with or without byte order mark.
    wanted : sequence of str
        Names; empty means all.

    Returns
    -------
    Frame
        A value that is null or not there is NaN, or an empty text in a text column; true and false are 1 and 0.
        Attributes are the single values beside the list of records.

    Raises
    ------
    LogError
        If the file is no JSON, there is no list of records, a name is not there, or a column mixes texts and numbers.

    Notes
    -----
    Takes about 40 times the size of the file in memory at most (small numbers become objects of 32 bytes).
    """
    with reading(name, "JSON"):
        value, place, warnings = parse_json(name, data)
        records, attributes = _records(name, value, _path(profile))
        source = profile.columns.time if profile.columns else None
        if records is None:
            frame = frame_of_arrays(name, _lists(place, value), wanted, attributes)
            return replace(frame, dates=_dates(source, _at(value, source.key)) if source else {})
        cells = _cells(place, records, wanted)
        columns = {key: _column(place, key, values, False) for key, values in cells.items()}
        row = np.asarray(place.lines or range(1, len(records) + 1), dtype=np.int64)
        dates = _dates(source, cells.get(source.key)) if source else {}
        if place.cut:
            attributes["cut_last_row"] = place.cut
        return Frame(columns, row, place.row_name, attributes, warnings, dates)


def list_columns(name: str, data: bytes, profile: Profile | None = None) -> list[ColumnInfo]:
    """Return the columns of a JSON file; without a profile, those of its longest list of records.

    Raises
    ------
    LogError
        If the file is no JSON.
    """
    with reading(name, "JSON"):
        value, place, _ = parse_json(name, data)
        path = _path(profile)
        candidates = {} if path or isinstance(value, list) else _candidates(value)
        if candidates:
            path = max(candidates, key=lambda key: candidates[key])
        records, _ = _records(name, value, path)
        if records is None:
            return list_arrays(_lists(place, value))
        columns = _columns(place, records, (), mixed=True)
        hint = f'records = "{path}"' if path else ""
        return [
            ColumnInfo(key, stored(column).kind, len(column), tuple(map(str, column[:3])), hint)
            for key, column in columns.items()
        ]


def _path(profile: Profile | None) -> str:
    return profile.records or "" if profile else ""


def _records(name: str, value: Any, path: str) -> tuple[list[Any] | None, dict[str, Scalar]]:
    """Return the list of records and the single values beside it; None where each column is a list of its own."""
    attributes: dict[str, Scalar] = {}
    if isinstance(value, list):
        if path:
            raise LogError(
                f"{name} is itself a list of records; remove records = {path!r} from the profile.",
                1,
                code="profile-wrong",
            )
        return value, attributes
    if not isinstance(value, dict):
        raise LogError(f"{name} holds a single value; expected a list of records.", 1, code="header-missing")
    for key, single in _single_values(value):
        attributes[key] = single
    candidates = _candidates(value)
    if not path:
        if not candidates:
            return None, attributes
        best = max(candidates, key=lambda key: candidates[key])
        raise LogError(
            f'{name} holds lists of records under {_listing(candidates)}; add records = "{best}" (or another of them) '
            "to the profile.",
            1,
            code="profile-wrong",
            profile_line=f'records = "{best}"',
        )
    found = _at(value, path)
    if not isinstance(found, list):
        raise LogError(
            f"{name} has no list of records under {path!r}; found such lists under {_listing(candidates)}. "
            "Correct `records` in the profile.",
            1,
            code="profile-wrong",
        )
    return found, attributes


def _listing(candidates: Mapping[str, int]) -> str:
    return ", ".join(f"{key!r} ({count} records)" for key, count in candidates.items()) or "no key"


def _candidates(value: Mapping[str, Any], prefix: str = "", depth: int = 0) -> dict[str, int]:
    """Return the paths of all lists of objects, with their lengths."""
    found: dict[str, int] = {}
    for key, inner in value.items():
        if isinstance(inner, list) and inner and isinstance(inner[0], dict):
            found[prefix + key] = len(inner)
        elif isinstance(inner, dict) and depth < DEEPEST:
            found |= _candidates(inner, f"{prefix}{key}.", depth + 1)
    return found


def _single_values(value: Mapping[str, Any], prefix: str = "", depth: int = 0) -> list[tuple[str, Scalar]]:
    found: list[tuple[str, Scalar]] = []
    for key, inner in value.items():
        if isinstance(inner, str | int | float):
            found.append((prefix + key, int(inner) if isinstance(inner, bool) else inner))
        elif isinstance(inner, dict) and depth < DEEPEST:
            found += _single_values(inner, f"{prefix}{key}.", depth + 1)
    return found


def _lists(place: Place, value: Mapping[str, Any], prefix: str = "", depth: int = 0) -> dict[str, StoredArray]:
    """Return all lists of numbers or texts as arrays by path."""
    found: dict[str, StoredArray] = {}
    for key, inner in value.items():
        if isinstance(inner, dict) and depth < DEEPEST:
            found |= _lists(place, inner, f"{prefix}{key}.", depth + 1)
        elif isinstance(inner, list):
            if inner and isinstance(inner[0], list):
                columns = _columns(place, inner, ())
                found |= {f"{prefix}{key}[{int(number) - 1}]": stored(column) for number, column in columns.items()}
            else:
                found[prefix + key] = stored(_column(place, prefix + key, inner, False))
    return found


def _at(value: Mapping[str, Any], path: str) -> Any:
    """Return what stands under a path of keys joined by dots, or None."""
    found: Any = value
    for key in path.split("."):
        found = found.get(key) if isinstance(found, dict) else None
    return found


def _dates(source: TimeSource, values: Any) -> dict[str, tuple[Integers, int]]:
    """Return the stamps of the time column exactly where they are dates with decimals."""
    if not isinstance(values, list) or not any(type(value) in (float, LongNumber) for value in values):
        return {}
    texts = [None if v is None else v.text if isinstance(v, LongNumber) else repr(v) for v in values]
    found = whole_dates(source, pa.array(texts, pa.string()))
    return {} if found is None else {source.key: found}


def _columns(place: Place, records: list[Any], wanted: Sequence[str], mixed: bool = False) -> dict[str, Array]:
    cells = _cells(place, records, wanted)
    return {key: _column(place, key, values, mixed) for key, values in cells.items()}


def _cells(place: Place, records: list[Any], wanted: Sequence[str]) -> dict[str, list[Any]]:
    """Return the value of each record for each name, None where it has none."""
    cells: dict[str, _Cells] = {}
    keep = set(wanted)
    # a record is a Python object: there is nothing to hand to numpy before its values are collected
    for number, record in enumerate(records):
        if not isinstance(record, dict | list):
            raise LogError(
                f"{place.name}: {place.row_name} is {str(record)[:80]!r}; expected an object with a value for each "
                "column. Repair it, or correct `records` in the profile.",
                place.row(number),
                code="row-length",
            )
        _collect(place, cells, record, number, keep)
    for key in wanted:
        if key not in cells:
            known: dict[str, _Cells] = {}
            for number, record in enumerate(records[:100]):
                _collect(place, known, record, number, set())
            raise unknown_column(place.name, key, sorted(known))
    check_columns(place.name, len(cells))
    if not cells:
        raise LogError(
            f"{place.name} holds no records with values; expected samples. Record the log again.", 1, code="empty"
        )
    # records that share no names would fill a table of nothing
    check_claim(
        place.name,
        f"a table of {len(records)} records and {len(cells)} names",
        8 * len(records) * len(cells),
        place.size,
    )
    columns: dict[str, list[Any]] = {key: [None] * len(records) for key in wanted or list(cells)}
    for key, values in columns.items():
        for number, value in zip(cells[key].numbers, cells[key].values, strict=True):
            values[number] = value
    return columns


def _collect(place: Place, cells: dict[str, _Cells], record: Any, number: int, keep: set[str]) -> None:
    """Put the values of a record into their columns."""
    top = isinstance(record, list)
    waiting: list[tuple[str, Any, int]] = [("", record, 0)]
    while waiting:
        path, value, depth = waiting.pop()
        if isinstance(value, dict):
            inner = [(f"{path}.{key}" if path else key, item) for key, item in value.items()]
        elif isinstance(value, list):
            # a record that is a list has columns without names: "1", "2", ...
            inner = [(str(i + 1) if top and not path else f"{path}[{i}]", item) for i, item in enumerate(value)]
        else:
            if keep and path not in keep:
                continue
            column = cells.setdefault(path, _Cells())
            if column.numbers and column.numbers[-1] == number:
                raise LogError(
                    f"{place.name}: {path!r} stands twice in one {place.row_name}; expected one value.",
                    place.row(number),
                    code="damaged",
                )
            column.numbers.append(number)
            column.values.append(value)
            continue
        if depth == DEEPEST:
            raise LogError(
                f"{place.name}: {path[:200]!r} is nested more than {DEEPEST} deep; expected records of one form.",
                place.row(number),
                code="too-deep",
            )
        waiting.extend((key, item, depth + 1) for key, item in reversed(inner))


def _column(place: Place, key: str, values: list[Any], mixed: bool) -> Array:
    """Return a column: integers, float64 with NaN for what is missing, or text."""
    kinds = {type(value) for value in values} - {type(None)}
    if str in kinds:
        if kinds != {str} and not mixed:
            at = next(i for i, value in enumerate(values) if not isinstance(value, str | None))
            raise LogError(
                f"{place.name}: column {key!r} mixes texts and numbers: {place.row_name} has {values[at]!r}. Expected "
                "one kind. Repair the file, or leave it out.",
                place.row(at),
                code="not-a-number",
            )
        return np.array(["" if value is None else str(value) for value in values], dtype=np.str_)
    if kinds <= {int, bool} and None not in values:
        whole = [int(value) for value in values]
        return np.array(whole, dtype=np.int64 if not whole or max(whole) < 1 << 63 else np.uint64)
    big = next((i for i, value in enumerate(values) if isinstance(value, int) and abs(value) > EXACT), None)
    if big is not None:
        raise LogError(
            f"{place.name}: column {key!r} mixes whole numbers of more than 15 digits, such as {values[big]}, with "
            "missing values or fractions; expected whole numbers throughout, which are kept exactly.",
            place.row(big),
            code="no-value",
        )
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
