"""Reads JSON: a list of records, alone or under a key beside a header; one record a line; or lists beside each other.

Names of nested keys are joined by dots, elements of lists get brackets: ``state.q[3]``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.errors import LogError
from pipeline.profiles import Profile
from pipeline.readers.arrays import Array, StoredArray, frame_of_arrays, list_arrays, stored, unknown_column
from pipeline.readers.frame import ColumnInfo, Frame, Scalar
from pipeline.readers.safety import check_claim, reading

DEEPEST = 32
"""Lists and objects inside each other: what robots log has two to five."""

_EXACT = 1 << 53
"""Whole numbers up to this one are floats without loss."""


@dataclass(frozen=True)
class _Place:
    """What messages say about a file: its name, its size [byte], the line of each record where each has one."""

    name: str
    size: int
    lines: list[int] | None

    @property
    def row_name(self) -> str:
        return "line" if self.lines else "record"

    def row(self, number: int) -> int:
        """Return where a record stands, counted from 1."""
        return self.lines[number] if self.lines else number + 1


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
        value, place, warnings = _parse(name, data)
        records, attributes = _records(name, value, _path(profile))
        if records is None:
            return frame_of_arrays(name, _lists(place, value), wanted, attributes)
        columns = _columns(place, records, wanted)
        row = np.asarray(place.lines or range(1, len(records) + 1), dtype=np.int64)
        return Frame(columns, row, place.row_name, attributes, warnings)


def list_columns(name: str, data: bytes, profile: Profile | None = None) -> list[ColumnInfo]:
    """Return the columns of a JSON file; without a profile, those of its longest list of records.

    Raises
    ------
    LogError
        If the file is no JSON.
    """
    with reading(name, "JSON"):
        value, place, _ = _parse(name, data)
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


def _parse(name: str, data: bytes) -> tuple[Any, _Place, tuple[str, ...]]:
    """Return the value of the file, what messages need, and warnings."""
    text = data.decode(json.detect_encoding(data)).removeprefix("\ufeff")
    if not text.strip():
        raise LogError(f"{name} is empty; expected JSON. Record the log again.", 1)
    try:
        return json.loads(text), _Place(name, len(data), None), ()
    except json.JSONDecodeError as error:
        first = text.lstrip().split("\n", 1)[0]
        if error.msg != "Extra data" or not first.lstrip().startswith(("{", "[")):
            raise LogError(
                f"{name} is no JSON: {error.msg} at column {error.colno}. The file is cut or damaged; record it again.",
                error.lineno,
            ) from error
    records, lines, warnings = _parse_lines(name, text)
    return records, _Place(name, len(data), lines), warnings


def _parse_lines(name: str, text: str) -> tuple[list[Any], list[int], tuple[str, ...]]:
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    records, rows = [], []
    warnings: tuple[str, ...] = ()
    for number, line in lines:
        try:
            records.append(json.loads(line))
            rows.append(number)
        except json.JSONDecodeError as error:
            if number == lines[-1][0] and not text.endswith("\n"):
                warnings = (f"last row is cut: {line[:200]!r} (line {number}) was left out and is kept verbatim",)
                break
            raise LogError(
                f"{name} is no JSON with one record a line: {error.msg} at column {error.colno}. Repair the line.",
                number,
            ) from error
    return records, rows, warnings


def _records(name: str, value: Any, path: str) -> tuple[list[Any] | None, dict[str, Scalar]]:
    """Return the list of records and the single values beside it; None where each column is a list of its own."""
    attributes: dict[str, Scalar] = {}
    if isinstance(value, list):
        if path:
            raise LogError(f"{name} is itself a list of records; remove records = {path!r} from the profile.", 1)
        return value, attributes
    if not isinstance(value, dict):
        raise LogError(f"{name} holds a single value; expected a list of records.", 1)
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
        )
    found: Any = value
    for key in path.split("."):
        found = found.get(key) if isinstance(found, dict) else None
    if not isinstance(found, list):
        raise LogError(
            f"{name} has no list of records under {path!r}; found such lists under {_listing(candidates)}. "
            "Correct `records` in the profile.",
            1,
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


def _lists(place: _Place, value: Mapping[str, Any], prefix: str = "", depth: int = 0) -> dict[str, StoredArray]:
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


def _columns(place: _Place, records: list[Any], wanted: Sequence[str], mixed: bool = False) -> dict[str, Array]:
    cells: dict[str, _Cells] = {}
    keep = set(wanted)
    # a record is a Python object: there is nothing to hand to numpy before its values are collected
    for number, record in enumerate(records):
        if not isinstance(record, dict | list):
            raise LogError(
                f"{place.name}: {place.row_name} is {str(record)[:80]!r}; expected an object with a value for each "
                "column. Repair it, or correct `records` in the profile.",
                place.row(number),
            )
        _collect(place, cells, record, number, keep)
    for key in wanted:
        if key not in cells:
            known: dict[str, _Cells] = {}
            for number, record in enumerate(records[:100]):
                _collect(place, known, record, number, set())
            raise unknown_column(place.name, key, sorted(known))
    if not cells:
        raise LogError(f"{place.name} holds no records with values; expected samples. Record the log again.", 1)
    # records that share no names would fill a table of nothing
    check_claim(
        place.name,
        f"a table of {len(records)} records and {len(cells)} names",
        8 * len(records) * len(cells),
        place.size,
    )
    columns = {}
    for key in wanted or list(cells):
        values: list[Any] = [None] * len(records)
        for number, value in zip(cells[key].numbers, cells[key].values, strict=True):
            values[number] = value
        columns[key] = _column(place, key, values, mixed)
    return columns


def _collect(place: _Place, cells: dict[str, _Cells], record: Any, number: int, keep: set[str]) -> None:
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
                )
            column.numbers.append(number)
            column.values.append(value)
            continue
        if depth == DEEPEST:
            raise LogError(
                f"{place.name}: {path[:200]!r} is nested more than {DEEPEST} deep; expected records of one form.",
                place.row(number),
            )
        waiting.extend((key, item, depth + 1) for key, item in reversed(inner))


def _column(place: _Place, key: str, values: list[Any], mixed: bool) -> Array:
    """Return a column: integers, float64 with NaN for what is missing, or text."""
    kinds = {type(value) for value in values} - {type(None)}
    if str in kinds:
        if kinds != {str} and not mixed:
            at = next(i for i, value in enumerate(values) if not isinstance(value, str | None))
            raise LogError(
                f"{place.name}: column {key!r} mixes texts and numbers: {place.row_name} has {values[at]!r}. Expected "
                "one kind. Repair the file, or leave it out.",
                place.row(at),
            )
        return np.array(["" if value is None else str(value) for value in values], dtype=np.str_)
    if kinds <= {int, bool} and None not in values:
        whole = [int(value) for value in values]
        return np.array(whole, dtype=np.int64 if not whole or max(whole) < 1 << 63 else np.uint64)
    big = next((i for i, value in enumerate(values) if isinstance(value, int) and abs(value) > _EXACT), None)
    if big is not None:
        raise LogError(
            f"{place.name}: column {key!r} mixes whole numbers of more than 15 digits, such as {values[big]}, with "
            "missing values or fractions; expected whole numbers throughout, which are kept exactly.",
            place.row(big),
        )
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
