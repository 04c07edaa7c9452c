"""Sheets of conditions, with one row per log. The rows become `[[file]]` entries of the profile that names the sheet.

CSV is read here, XLSX and ODS with python-calamine. The column that names the logs is found by its content. The other
columns are mapped by name (``stiffness``, ``K``, ...) or by a text such as ``K:stiffness:N/mm``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any, get_args

from pydantic import ValidationError

from pipeline.base.errors import LogError, ParameterError, ProfileError
from pipeline.base.json_object import JsonObject
from pipeline.base.units import find_unit, unit_in_heading
from pipeline.base.wording import counted
from pipeline.profiles.profile_files import find_mistakes
from pipeline.profiles.profile_model import (
    CONDITION_QUANTITIES,
    CONDITIONS,
    NUMBERS_IN_NAMES,
    FileEntry,
    Profile,
    number_in_name,
    quantity,
)
from pipeline.readers.file_columns import library
from pipeline.readers.isolation import isolated
from pipeline.records.findings import Grip
from pipeline.records.native import OF_WALL

Cell = str | float | None

LARGEST_SHEET = 16 << 20
"""Largest size of a sheet [byte]. It corresponds to 10^5 rows, which is more logs than a lab ever records."""

LISTED_FILES = 5
"""Largest number of files listed in a sentence."""

_DELIMITERS = (";", "\t", "|", ",")
_PACKED = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
"""First bytes of XLSX and ODS, and of XLS."""

NAMES = {
    "stiffness": ("stiffness", "k", "steifigkeit"),
    "damping": ("damping", "b", "daempfung", "dämpfung"),
    "step": ("step", "f0", "f_0", "force step", "sprung", "kraftsprung"),
    "sampling_period_s": ("sampling_period_s", "sampling period"),
    "added_delay_samples": ("added_delay_samples", "added delay"),
    "device": ("device", "gerät"),
    "experiment": ("experiment", "versuch"),
    "grip": ("grip", "griff"),
}
"""Names that identify a column as a condition, in lower case and without a unit."""


@dataclass(frozen=True)
class SheetTable:
    """Names of the columns, the cells below them, and the sheet row of the first cells, counted from 1."""

    names: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    first_row: int

    def column(self, name: str) -> list[Cell]:
        """Return the cells of a column."""
        at = self.names.index(name)
        return [row[at] for row in self.rows]


def with_sheet(profile: Profile, logs: Collection[str]) -> tuple[Profile, list[str]]:
    """Return a profile with the rows of its sheet as `[[file]]` entries, and mismatches between sheet and logs.

    Parameters
    ----------
    profile : Profile
        Profile with a sheet.
    logs : collection of str
        Names of the files to read. They identify the column of file names.

    Raises
    ------
    ProfileError
        If the sheet cannot be read, no column names the logs, two rows name the same log, or a cell is invalid.
    """
    assert profile.sheet is not None, "the caller passes only profiles with a sheet"
    path = Path(profile.sheet.file)
    table = read_sheet(path)
    named = name_column(table, profile, logs)
    units, columns = mapped_columns(table, profile, named)
    entries, rows = _entries(table, profile, named, columns)
    values = profile.model_dump(exclude_defaults=True) | {"sheet": None}
    values["units"] = {**profile.units.model_dump(exclude_defaults=True), **units}
    values["file"] = _joined(values.get("file", ()), [entry.model_dump(exclude_defaults=True) for entry in entries])
    try:
        ready = Profile.model_validate(values)
    except ValidationError:
        mistakes = "; ".join(dict.fromkeys(mistake.text for mistake in find_mistakes(values, "")))
        raise ProfileError(f"{path}: the rows of this sheet make the profile invalid: {mistakes}") from None
    present = [name for name in logs if profile.claims(name) and name != path.name]
    return ready, _missing(path, rows, present) if logs else []


def _joined(own: Sequence[JsonObject], rows: Sequence[JsonObject]) -> list[JsonObject]:
    """Return entries of single files, as tables of a profile, joined with the rows of a sheet.

    An entry overrides the row of the sheet for the same file.
    """
    corrections = {entry["match"].lower(): entry for entry in own}
    joined = [row | corrections.pop(row["match"].lower(), {}) for row in rows]
    return [*corrections.values(), *joined]


def _missing(path: Path, rows: dict[str, tuple[int, str]], present: Sequence[str]) -> list[str]:
    """Return sentences about rows without a file and files without a row."""
    here = {name.lower() for name in present}
    lost = [f"{text} (row {number})" for name, (number, text) in rows.items() if name.lower() not in here]
    alone = [name for name in present if name.lower() not in {row.lower() for row in rows}]
    lines = []
    for listed, kind, what in ((lost, "row", "without a log"), (alone, "log", "without a row")):
        if listed:
            more = f" and {len(listed) - LISTED_FILES} more" if len(listed) > LISTED_FILES else ""
            lines.append(f"{counted(len(listed), kind)} {what}: {', '.join(listed[:LISTED_FILES])}{more}.")
    return lines


def read_sheet(path: Path) -> SheetTable:
    """Return the first sheet with at least two columns in a CSV, XLSX or ODS file.

    Raises
    ------
    ProfileError
        If the file cannot be read, or has no rows below the column names.
    """
    try:
        if path.stat().st_size > LARGEST_SHEET:
            raise ProfileError(
                f"{path}: the sheet has more than {LARGEST_SHEET} bytes, but one row per log is expected."
            )
        data = path.read_bytes()
    except OSError as error:
        raise ProfileError(f"{path}: the sheet cannot be read ({error.strerror}).") from error
    try:
        lines = _packed_rows(path.name, data) if data.startswith(_PACKED) else _text_rows(data)
    except (LogError, ValueError) as error:
        raise ProfileError(f"{path}: the sheet cannot be read: {error}") from error
    top = next((i for i, row in enumerate(lines) if sum(_is_name(cell) for cell in row) >= 2), None)
    if top is None:
        raise ProfileError(
            f"{path}: the sheet has no line of column names. At least two columns with names are expected."
        )
    names = tuple("" if cell is None else str(cell).strip() for cell in lines[top])
    rows = [row + (None,) * (len(names) - len(row)) for row in lines[top + 1 :]]
    while rows and not any(cell is not None for cell in rows[-1]):
        rows.pop()
    doubled = next((name for name in names if name and names.count(name) > 1), None)
    if doubled or not rows:
        found = f"names {doubled!r} twice" if doubled else "has no rows below its names"
        raise ProfileError(f"{path}: the sheet {found}. Expected one column for each name, and one row per log.")
    return SheetTable(names, tuple(row[: len(names)] for row in rows), top + 2)


def _is_name(cell: Cell) -> bool:
    return isinstance(cell, str) and bool(re.search(r"[^\W\d]", cell))


def _text_rows(data: bytes) -> list[tuple[Cell, ...]]:
    """Return the cells of a CSV file. The delimiter is the one that splits most lines into the same number of cells."""
    text = None
    for encoding in ("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", "cp1252", "latin-1"):
        with suppress(UnicodeDecodeError):
            text = data.decode(encoding)
            break
    lines = (text or "").replace("\0", "").splitlines()
    best: list[list[str]] = []
    score = 0
    for delimiter in _DELIMITERS:
        try:
            rows = list(csv.reader(lines, delimiter=delimiter))
        except csv.Error:
            continue
        widths = [len(row) for row in rows if len(row) > 1]
        count = max((widths.count(width) for width in set(widths)), default=0)
        if count > score:
            best, score = rows, count
    return [tuple(cell.strip() or None for cell in row) for row in best]


def _packed_rows(name: str, data: bytes) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = isolated(
        f"{__name__}:{packed_rows_here.__name__}",
        "a sheet (XLSX, ODS)",
        len(data),
        name,
        data,
        imports="python_calamine",
    )
    return rows


def packed_rows_here(name: str, data: bytes) -> list[tuple[Cell, ...]]:
    """Return the cells of the first sheet with at least two columns. The function runs in a worker process."""
    from io import BytesIO

    calamine: Any = library("python_calamine", "sheets")
    book = calamine.CalamineWorkbook.from_filelike(BytesIO(data))
    for title in book.sheet_names:
        rows = book.get_sheet_by_name(title).to_python(skip_empty_area=False)
        if any(len(row) > 1 for row in rows):
            return [tuple(_cell(value) for value in row) for row in rows]
    return []


def _cell(value: object) -> Cell:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return float(value)
    return str(value).strip() or None


def _file_of(cell: Cell) -> str:
    """Return the file name in a cell, without folders of any operating system. A number is returned as typed."""
    if isinstance(cell, float) and cell.is_integer():
        cell = int(cell)
    return PureWindowsPath(str(cell).strip()).name if cell is not None else ""


def _matches(text: str, names: dict[str, str]) -> str | None:
    """Return the log that a cell names, with or without its extension, or None if there is no such log."""
    return names.get(text.lower()) if text else None


def _spellings(logs: Collection[str]) -> dict[str, str]:
    """Return logs by their names in lower case, both with and without the extension."""
    whole = {name.lower(): name for name in logs}
    return {Path(name).stem.lower(): name for name in logs} | whole


def name_column(table: SheetTable, profile: Profile, logs: Collection[str]) -> str:
    """Return the column that names the logs. If it is not stated, it is the column whose cells are names of logs.

    Raises
    ------
    ProfileError
        If there is no such column.
    """
    sheet = profile.sheet
    assert sheet is not None, "the profile must have a sheet"
    if sheet.name is not None:
        if sheet.name not in table.names:
            raise ProfileError(f"{sheet.file}: no column {sheet.name!r}. Columns: {', '.join(table.names)}.")
        return sheet.name
    names = _spellings(logs)

    def count(name: str) -> int:
        cells = map(_file_of, table.column(name))
        return sum(_matches(text, names) is not None if logs else profile.claims(text) for text in cells)

    counts = {name: count(name) for name in table.names if name}
    best = max(counts, key=lambda name: counts[name])
    if not counts[best]:
        example = f" (such as {min(logs)})" if logs else f" (patterns {list(profile.files)})"
        listing = ", ".join(filter(None, table.names))
        raise ProfileError(
            f"{sheet.file}: no column of the sheet names the logs{example}. Columns: {listing}. "
            'State the column of file names: [sheet] name = "...".'
        )
    return best


def mapped_columns(table: SheetTable, profile: Profile, named: str) -> tuple[dict[str, str], dict[str, str]]:
    """Return the unit and the column of each condition, as two mappings.

    Raises
    ------
    ProfileError
        If a mapping names no column or condition, or two columns are mapped to the same condition.
    """
    sheet = profile.sheet
    assert sheet is not None, "the profile must have a sheet"
    columns, units = dict[str, str](), dict[str, str]()
    for text in sheet.columns:
        name, key, unit = split_mapping(text, table.names, sheet.file)
        if key in columns:
            raise ProfileError(
                f"{sheet.file}: columns {columns[key]!r} and {name!r} both state the {key}. Expected only one."
            )
        columns[key] = name
        units |= {key: unit} if unit else {}
    for name in table.names:
        plain, unit = unit_in_heading(name, _quantities(profile))
        found = next((key for key, known in NAMES.items() if plain.strip().lower() in known), None)
        if found is None or name in (named, *columns.values()) or found in columns:
            continue
        columns[found] = name
        if unit and found in NUMBERS_IN_NAMES:
            units[found] = unit
    for key, name in columns.items():
        heading = unit_in_heading(name, _quantities(profile))[1]
        if key in units or key not in (*NUMBERS_IN_NAMES,) or key == "added_delay_samples":
            continue
        if heading and find_unit(heading) is not None:
            units[key] = heading
    stated = profile.units.model_dump(exclude_defaults=True)
    for key, unit in units.items():
        if key in stated and find_unit(stated[key]) != find_unit(unit):
            raise ProfileError(
                f"{sheet.file}: the {key} is in {unit}, but [units] has {stated[key]}. Correct one of them."
            )
    bare = [key for key in OF_WALL if key in columns and key not in units | stated]
    for key in bare:
        if any(cell not in (None, 0.0, "0") for cell in table.column(columns[key])):
            raise ProfileError(
                f"{sheet.file}: column {columns[key]!r} has no unit. Write the unit after the name, "
                f'"{columns[key]} [N/mm]", or state it in the profile: '
                f'[sheet] columns = ["{columns[key]}:{key}:N/mm"].'
            )
    return units, columns


def conditions_by_name(names: Sequence[str]) -> dict[str, str]:
    """Return the columns whose names identify them as conditions, keyed by condition.

    >>> conditions_by_name(["Datei", "K [N/mm]", "B", "note"])
    {'stiffness': 'K [N/mm]', 'damping': 'B'}
    """
    found: dict[str, str] = {}
    for name in names:
        plain = unit_in_heading(name, ())[0].strip().lower()
        key = next((key for key, known in NAMES.items() if plain in known), None)
        if key is not None:
            found.setdefault(key, name)
    return found


def _quantities(profile: Profile) -> list[str]:
    return [quantity(key, profile.motion) for key in CONDITION_QUANTITIES]


def split_mapping(text: str, names: Collection[str], file: str) -> tuple[str, str, str]:
    """Return the column, the condition and the unit of a mapping such as ``K:stiffness:N/mm``.

    Raises
    ------
    ProfileError
        If the text names no column, condition or unit.

    Examples
    --------
    >>> split_mapping("K:stiffness:N/mm", ["K"], "runs.csv"), split_mapping("who:device", ["who"], "runs.csv")
    (('K', 'stiffness', 'N/mm'), ('who', 'device', ''))
    """
    for name in sorted(names, key=len, reverse=True):
        rest = text.removeprefix(f"{name}:") if name and text.startswith(f"{name}:") else None
        if rest is None:
            continue
        key, _, unit = rest.partition(":")
        if key not in CONDITIONS:
            raise ProfileError(
                f"{file}: {text!r}: {key!r} is not a condition; expected one of {', '.join(CONDITIONS)}."
            )
        if unit and (find_unit(unit) is None or key not in NUMBERS_IN_NAMES):
            raise ProfileError(f"{file}: {text!r}: {unit!r} is not a unit of the {key}.")
        return name, key, unit
    raise ProfileError(f"{file}: {text!r} names no column of the sheet. Columns: {', '.join(filter(None, names))}.")


def _entries(
    table: SheetTable, profile: Profile, named: str, columns: dict[str, str]
) -> tuple[list[FileEntry], dict[str, tuple[int, str]]]:
    """Return an entry for each row that names a log, and the row number and the text of the cell for each file."""
    sheet = profile.sheet
    assert sheet is not None, "the profile must have a sheet"
    decimal = _decimal_sign(table, columns)
    entries, rows = list[FileEntry](), dict[str, tuple[int, str]]()
    for number, row in enumerate(table.rows, start=table.first_row):
        cells = dict(zip(table.names, row, strict=True))
        text = _file_of(cells[named])
        if not text:
            continue
        ending = "" if profile.claims(text) else _ending(profile)
        file = text + ending
        where = f"{sheet.file}, row {number} ({text})"
        values = {key: _value(where, key, cells[name], decimal) for key, name in columns.items()}
        values = {key: value for key, value in values.items() if value is not None}
        if file.lower() in {other.lower() for other in rows}:
            first = next(number for name, (number, _) in rows.items() if name.lower() == file.lower())
            raise ProfileError(f"{where}: row {first} also names this log. Expected one row per log. Remove one row.")
        rows[file] = number, text
        try:
            entries.append(FileEntry(match=_escaped(text) + ending, **values))
        except ValidationError as error:
            what = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
            raise ProfileError(f"{where}: {what}.") from None
    return entries, rows


def _escaped(name: str) -> str:
    return re.sub(r"([*?[])", r"[\1]", name)


def _ending(profile: Profile) -> str:
    """Return the file extension of the logs of a profile, which is appended to names without an extension."""
    endings = (re.search(r"\.[^.*?\[\]]+(?:\.gz|\.zst)?$", pattern) for pattern in profile.files)
    return next((ending[0] for ending in endings if ending), ".*")


def _decimal_sign(table: SheetTable, columns: dict[str, str]) -> str:
    """Return the decimal sign of a sheet. The sign is a comma if a cell has a comma and no cell has a point."""
    cells = [cell for key, name in columns.items() if key in NUMBERS_IN_NAMES for cell in table.column(name)]
    texts = [cell for cell in cells if isinstance(cell, str)]
    return "," if any("," in text for text in texts) and not any("." in text for text in texts) else "."


def _value(where: str, key: str, cell: Cell, decimal: str) -> Any:
    """Convert a cell to the value of its condition, or to None if it is blank."""
    if cell is None:
        return None
    if key not in NUMBERS_IN_NAMES:
        text = str(int(cell)) if isinstance(cell, float) and cell.is_integer() else str(cell)
        if key == "grip" and text not in get_args(Grip):
            raise ProfileError(f"{where}: the grip is {text!r}; expected one of {', '.join(get_args(Grip))}.")
        return text
    try:
        number = float(cell) if isinstance(cell, float) else number_in_name(str(cell), decimal)
    except (ParameterError, ValueError) as error:
        why = f": {error}" if isinstance(error, ParameterError) else "; expected a number"
        raise ProfileError(f"{where}: the {key} is {cell!r}{why}.") from None
    return int(number) if key == "added_delay_samples" and number.is_integer() else number
