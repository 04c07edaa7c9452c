"""JSON text, packed or not, to Python values. What the standard reader drops is kept: doubled keys, digits of dates."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from typing import Any

from pipeline.base.errors import LogError
from pipeline.readers.formats.plain_text import unpacked
from pipeline.readers.limits import LARGEST_JSON

_LONGEST = 16
"""Characters of a number, its decimal point among them, that a float always keeps."""

_WHOLE_DIGITS = 8
"""Digits before the decimal point of numbers whose text is kept: dates have 9 or more, other long fractions are only
what printing a float gives."""


@dataclass(frozen=True)
class Place:
    """What is said of a file: name, size [byte], line of each record where each has one, last line where it is cut."""

    name: str
    size: int
    lines: list[int] | None
    cut: str = ""

    @property
    def row_name(self) -> str:
        """What a row is called."""
        return "line" if self.lines else "record"

    def row(self, number: int) -> int:
        """Return where a record stands, counted from 1."""
        return self.lines[number] if self.lines else number + 1


class LongNumber(float):
    """A number such as 1700000000.123456789, of which a float loses digits; ``text`` has them."""

    text: str


class DoubledKeyError(ValueError):
    """A key that stands twice in one object.

    Parameters
    ----------
    path : tuple of str and int
        Keys and places in lists (from 0) that lead to the object.
    key : str
    """

    def __init__(self, path: tuple[str | int, ...], key: str) -> None:
        super().__init__(f"key {key!r} stands twice in one object")
        self.path = path
        self.key = key

    def place(self) -> str:
        """Return the path in words: ``entries[2].motor``."""
        parts = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self.path)
        return parts.removeprefix(".")


def load_json(text: str | bytes) -> Any:
    """Return the value of a JSON text.

    Raises
    ------
    json.JSONDecodeError
        If the text is no JSON.
    DoubledKeyError
        If a key stands twice in one object: only its last value would be left.
    """
    doubled: list[tuple[dict[str, Any], str]] = []

    def build(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            counts = Counter(key for key, _ in pairs)
            doubled.append((found, next(key for key, count in counts.items() if count > 1)))
        return found

    value = json.loads(text, parse_float=_number, object_pairs_hook=build)
    if doubled:
        raise _located(value, doubled)
    return value


def _number(text: str) -> float:
    if len(text) <= _LONGEST or text.find(".", _WHOLE_DIGITS) < 0:
        return float(text)
    number = LongNumber(text)
    number.text = text
    return number


def _located(value: Any, doubled: list[tuple[dict[str, Any], str]]) -> DoubledKeyError:
    """Return the error for the first doubled key that is found from the top; one inside another doubled key is lost."""
    keys = {id(found): key for found, key in doubled}
    waiting: list[tuple[tuple[str | int, ...], Any]] = [((), value)]
    while waiting:
        path, here = waiting.pop()
        if id(here) in keys:
            return DoubledKeyError(path, keys[id(here)])
        inner = here.items() if isinstance(here, dict) else enumerate(here) if isinstance(here, list) else ()
        waiting += [((*path, part), item) for part, item in inner][::-1]
    raise AssertionError("an object that no other doubled key hides is there")


def parse_json(name: str, data: bytes) -> tuple[Any, Place, tuple[str, ...]]:
    """Return the value of a file (a list where it has one record a line), what messages need, and warnings.

    Raises
    ------
    LogError
        If it cannot be unpacked, is too large, is no JSON, or a key stands twice in one object.
    """
    data = unpacked(name, data)
    if len(data) > LARGEST_JSON:
        raise LogError(
            f"{name} has {len(data)} bytes of JSON; expected at most {LARGEST_JSON}. Export it as CSV or Parquet.",
            code="too-large",
        )
    text = data.decode(json.detect_encoding(data)).removeprefix("\ufeff")
    if not text.strip():
        raise LogError(f"{name} is empty; expected JSON. Record the log again.", 1, code="empty")
    try:
        return load_json(text), Place(name, len(data), None), ()
    except DoubledKeyError as error:
        number = next((part + 1 for part in error.path if isinstance(part, int)), None)
        raise _doubled(name, error, "the file" if number is None else f"record {number}", number) from error
    except json.JSONDecodeError as error:
        first = text.lstrip().split("\n", 1)[0]
        if error.msg != "Extra data" or not first.lstrip().startswith(("{", "[")):
            raise LogError(
                f"{name} is no JSON: {error.msg} at column {error.colno}. The file is cut or damaged; record it again.",
                error.lineno,
                code="syntax",
            ) from error
    records, lines, cut = _parse_lines(name, text)
    warnings: tuple[str, ...] = ()
    if cut:
        row = text.count("\n", 0, text.rfind(cut)) + 1
        warnings = (f"last row is cut: {cut[:200]!r} (line {row}) was left out and is kept verbatim",)
    return records, Place(name, len(data), lines, cut), warnings


def _doubled(name: str, error: DoubledKeyError, where: str, row: int | None) -> LogError:
    inside = f" ({error.place()})" if error.path else ""
    return LogError(
        f"{name}: key {error.key!r} stands twice in one object of {where}{inside}; expected it once, since nobody can "
        "tell which value counts. Repair the file, or leave it out.",
        row,
        code="damaged",
    )


def _parse_lines(name: str, text: str) -> tuple[list[Any], list[int], str]:
    """Return the records, the line of each, and the last line where it is cut."""
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    records, rows = [], []
    for number, line in lines:
        try:
            records.append(load_json(line))
            rows.append(number)
        except DoubledKeyError as error:
            raise _doubled(name, error, f"line {number}", number) from error
        except json.JSONDecodeError as error:
            if number == lines[-1][0] and not text.endswith("\n"):
                return records, rows, line
            raise LogError(
                f"{name} is no JSON with one record a line: {error.msg} at column {error.colno}. Repair the line.",
                number,
                code="syntax",
            ) from error
    return records, rows, ""
