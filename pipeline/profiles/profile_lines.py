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

_PLACEHOLDERS: dict[str, Any] = {"name": "unnamed", "format": "delimited", "files": ["*"]}
"""Values for keys that every profile needs, so that a profile without them is searched for further mistakes."""

QUESTION = "# QUESTION:"
"""Beginning of the lines of a draft in which something is asked that must not be guessed."""

_NOT_ASKED: dict[str, tuple[str, ...]] = {
    "step_row": ("step_at",),
    "step_time_s": ("step_at",),
    "column": ("name",),
    "format": ("decimal",),
}
"""Keys beside a wrong one that are missing only because the wrong one was taken out."""

_WORDS = {
    "tuple_type": "Input should be a list in brackets",
    "model_type": "Input should be a table of keys",
    "dict_type": "Input should be a table of keys",
    "string_pattern_mismatch": "must be part of a file name in the same folder",
}
"""Kinds of values in the words of TOML, not of Python."""

_STATEMENT = re.compile(r"""\s*(\[{0,2})\s*([\w"'. -]+?)\s*[\]=]""")
"""Head of a table, or a key."""

_ROUNDS = 5
"""Times a profile is checked again without its mistakes; each round removes what the one before found, and nothing in a
profile is nested deeper."""


@dataclass(frozen=True)
class Mistake:
    """What is wrong in a profile: line counted from 1, key, and words."""

    line: int
    place: Place
    text: str


def find_mistakes(values: dict[str, Any], text: str) -> list[Mistake]:
    """Return all mistakes of a profile, in order of line; empty where there is none.

    Wrong keys are taken out and the rest is checked again, so that one mistake does not hide another; what is missing
    only because it was taken out is not reported.

    Parameters
    ----------
    values : dict
        The parsed TOML.
    text : str
        Its text, for the line numbers.
    """
    lines = key_lines(text)
    rest = deepcopy(values)
    found: dict[Place, str] = {}
    for _ in range(_ROUNDS):
        try:
            Profile.model_validate(rest)
            break
        except ValidationError as error:
            new = {
                place: what
                for place, what in (p for e in error.errors() for p in _explain(dict(e)))
                if not any(place[: len(other)] == other for other in found)
            }
            if not new:
                break
            # a key that was meant is not missing, too
            found |= new
            meant = [(*place[:-1], key) for place in new if (key := _meant(place, new[place]))]
            found |= dict.fromkeys(meant, "")
            beside = [(*p[:-1], key) for p in (*new, *meant) if p for key in _NOT_ASKED.get(str(p[-1]), ())]
            found |= {place: "" for place in beside if place not in found}
            for place in new:
                _remove(rest, place)
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
        hint = "Set the key below it."
        found.append(Mistake(number, place, f"{_key(place)}: open question: {words.strip()} {hint}"))
    return found


def _explain(error: dict[str, Any]) -> Iterator[tuple[Place, str]]:
    if error["type"] == PROBLEMS:
        yield from ((tuple(place), f"{_key(place)}: {what}.") for place, what in error["ctx"]["problems"])
        return
    place = tuple(part for part in error["loc"] if part != "[key]")
    if error["type"] == "extra_forbidden":
        known = sorted(_keys_at(place[:-1]))
        near = get_close_matches(str(place[-1]), known, 1)
        expected = f"did you mean {near[0]!r}? Correct or remove it." if near else f"expected one of {known}."
        yield place, f"{_key(place)}: not known; {expected}"
    elif error["type"] == "missing":
        yield place, f"{_key(place)}: missing. Add it."
    else:
        message = _WORDS.get(error["type"], str(error["msg"]).removeprefix("Value error, "))
        yield place, f"{_key(place)}: {message}, found {error['input']!r}."


def _key(place: Place) -> str:
    return f"key {'.'.join(str(part) for part in place)!r}" if place else "the profile"


def _meant(place: Place, what: str) -> str | None:
    """Return the key that an unknown one was taken for."""
    if "not known; did you mean" not in what:
        return None
    return get_close_matches(str(place[-1]), sorted(_keys_at(place[:-1])), 1)[0]


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


def _remove(values: dict[str, Any], place: Place) -> None:
    """Take a key out; where every profile needs it, put something legal there."""
    holder: Any = values
    for part in place[:-1]:
        try:
            holder = holder[part]
        except (KeyError, IndexError, TypeError):
            return
    last = place[-1] if place else None
    if isinstance(holder, dict):
        holder.pop(last, None)
        if len(place) == 1 and last in _PLACEHOLDERS:
            holder[last] = _PLACEHOLDERS[str(last)]
        elif last in ("match", "label", "replace", "by"):
            holder[last] = f"unnamed {place}"
    elif isinstance(holder, list) and isinstance(last, int) and last < len(holder):
        # the other entries keep their numbers
        holder[last] = {"match": f"unnamed {last}"} if place[0] == "file" else {"label": f"unnamed {last}"}


def key_lines(text: str) -> dict[Place, int]:
    """Return the line, counted from 1, on which each key and each table of a TOML text begins.

    Keys of a table in braces stand on the line of that table.
    """
    lines: dict[Place, int] = {(): 1}
    table: Place = ()
    entries: Counter[Place] = Counter()

    def placed(name: str) -> Place:
        place: Place = ()
        for part in name.split("."):
            place = (*place, part.strip(" \"'"))
            place = (*place, entries[place] - 1) if place in entries else place
        return place

    for number, line in enumerate(text.splitlines(), start=1):
        if (statement := _STATEMENT.match(line)) is None:
            continue
        brackets, name = statement.groups()
        if brackets == "[[":
            above, _, last = name.rpartition(".")
            entries[(*(placed(above) if above else ()), last.strip(" \"'"))] += 1
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
