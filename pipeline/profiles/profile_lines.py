"""Mistakes of a profile in words: each with the line of the TOML text, the key, and the key that was meant."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from pipeline.profiles.profile_model import PROBLEMS, Profile

Place = tuple[str | int, ...]

QUESTION = "# QUESTION:"
"""Beginning of the lines of a draft in which something is asked that must not be guessed."""

_INSTEAD = {"step_row": "step_at", "step_time_s": "step_at", "column": "name"}
"""Keys that are missing only because another one, which stands for them, is wrong."""

_WORDS = {
    "tuple_type": "Input should be a list in brackets",
    "model_type": "Input should be a table of keys",
    "dict_type": "Input should be a table of keys",
    "string_pattern_mismatch": "must be part of a file name in the same folder",
}
"""Kinds of values in the words of TOML, not of Python."""

_STATEMENT = re.compile(r"""\s*(\[{0,2})\s*([\w"'. -]+?)\s*[\]=]""")
"""Head of a table, or a key."""


@dataclass(frozen=True)
class Mistake:
    """What is wrong in a profile: line counted from 1, key, and words."""

    line: int
    place: Place
    text: str


def find_mistakes(values: dict[str, Any], text: str) -> list[Mistake]:
    """Return all mistakes of a profile, in order of line; empty where there is none.

    What does not fit together is looked for once wrong keys are mended or taken out, so that they do not hide it.

    Parameters
    ----------
    values : dict
        The parsed TOML.
    text : str
        Its text, for the line numbers.
    """
    rest, found = deepcopy(values), dict[Place, str]()
    for _ in range(2):
        try:
            Profile.model_validate(rest)
            break
        except ValidationError as error:
            told = [problem for entry in error.errors() for problem in _explain(dict(entry))]
        for place, what, meant in told:
            if not any(place[: len(other)] == other for other in found):
                found[place] = what
            _mend(rest, place, meant)
        found |= {
            (*place[:-1], other): "" for place in tuple(found) if place and (other := _INSTEAD.get(str(place[-1])))
        }
    lines = key_lines(text)
    mistakes = [Mistake(_line(lines, place), place, what) for place, what in found.items() if what]
    return sorted(mistakes, key=lambda mistake: (mistake.line, str(mistake.place)))


def find_questions(text: str) -> list[Mistake]:
    """Return the questions of a draft that nobody has answered: ``# QUESTION: key: words`` above a key in remarks."""
    found, lines = [], text.splitlines()
    for number, line in enumerate(lines, start=1):
        answered = number < len(lines) and not lines[number].lstrip().startswith("#")
        if not line.lstrip().startswith(QUESTION) or (answered and lines[number].strip()):
            continue
        key, _, words = line.lstrip().removeprefix(QUESTION).strip().partition(":")
        place: Place = tuple(int(part) if part.isdecimal() else part for part in key.split("."))
        found.append(Mistake(number, place, f"{_key(place)}: open question: {words.strip()} Set the key below it."))
    return found


def _explain(error: dict[str, Any]) -> Iterator[tuple[Place, str, str | None]]:
    """Yield place and words of mistakes, and the key that an unknown one was taken for."""
    if error["type"] == PROBLEMS:
        yield from ((tuple(place), f"{_key(place)}: {what}.", None) for place, what in error["ctx"]["problems"])
        return
    place, meant = tuple(part for part in error["loc"] if part != "[key]"), None
    if error["type"] == "extra_forbidden":
        known = sorted(_keys_at(place[:-1]))
        meant = next(iter(get_close_matches(str(place[-1]), known, 1)), None)
        expected = f"did you mean {meant!r}? Correct or remove it." if meant else f"expected one of {known}."
        what = f"not known; {expected}"
    elif error["type"] == "missing":
        what = "missing. Add it."
    else:
        message = _WORDS.get(error["type"], str(error["msg"]).removeprefix("Value error, "))
        what = f"{message}, found {error['input']!r}."
    yield place, f"{_key(place)}: {what}", meant


def _key(place: Place) -> str:
    return f"key {'.'.join(str(part) for part in place)!r}" if place else "the profile"


def _keys_at(place: Place) -> set[str]:
    """Return the keys that are known at a place in a profile."""
    model: type[BaseModel] | None = Profile
    for part in place:
        if isinstance(part, int) or model is None:
            continue
        field = model.model_fields.get(part)
        model = _model_in(field.annotation) if field else None
    return set(model.model_fields) if model else set()


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for part in get_args(annotation) if (model := _model_in(part))), None)


def _mend(values: dict[str, Any], place: Place, meant: str | None) -> None:
    """Rename a wrong key to the one that was meant, or take it out."""
    holder: Any = values
    for part in place[:-1]:
        try:
            holder = holder[part]
        except (KeyError, IndexError, TypeError):
            return
    if isinstance(holder, dict) and place[-1:] and place[-1] in holder:
        value = holder.pop(place[-1])
        holder |= {meant: value} if meant and meant not in holder else {}


def key_lines(text: str) -> dict[Place, int]:
    """Return the line, counted from 1, on which each key and each table of a TOML text begins.

    Keys of a table in braces stand on the line of that table.
    """
    lines: dict[Place, int] = {(): 1}
    table: Place = ()
    entries: Counter[Place] = Counter()

    def placed(name: str) -> Place:
        place: Place = ()
        for part in filter(None, name.split(".")):
            place = (*place, part.strip(" \"'"))
            place = (*place, entries[place] - 1) if place in entries else place
        return place

    for number, line in enumerate(text.splitlines(), start=1):
        if (statement := _STATEMENT.match(line)) is None:
            continue
        brackets, name = statement.groups()
        if brackets == "[[":
            above, _, last = name.rpartition(".")
            entries[(*placed(above), last.strip(" \"'"))] += 1
        table = placed(name) if brackets else table
        place = table if brackets else (*table, *(part.strip(" \"'") for part in name.split(".")))
        # a table that is named in parts only begins with its first part
        for length in range(1, len(place) + 1):
            lines.setdefault(place[:length], number)
    return lines


def _line(lines: Mapping[Place, int], place: Place) -> int:
    """Return the line of a key, or of the table in which it is missing."""
    while place not in lines:
        place = place[:-1]
    return lines[place]
