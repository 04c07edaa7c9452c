"""Files of log profiles. A profile describes in TOML how the files of a lab map to SI columns.

Shipped profiles are in ``schemas/profiles``. A user selects any other profile by its file name. A profile lists the
file names that it claims, the partner file if a log consists of two files, the columns with their units and signs, and
the conditions that are not stated in the files. `pipeline.profiles.profile_model` describes the keys. The message about
an error contains the line of the TOML text, the key, and the most similar valid key.
"""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from pipeline.base.errors import ProfileError
from pipeline.base.json_object import JsonObject
from pipeline.base.provenance import schema_folder
from pipeline.profiles.profile_model import PROBLEMS, Profile

Place = tuple[str | int, ...]

QUESTION = "# QUESTION:"
"""Prefix of the lines of a draft that ask for a value which must not be guessed."""

_WORDS = {
    "tuple_type": "Input should be a list in brackets",
    "model_type": "Input should be a table of keys",
    "dict_type": "Input should be a table of keys",
    "string_pattern_mismatch": "must be part of a file name in the same folder",
}
"""Messages of the validator, with the TOML names of value types instead of the Python names."""

_STATEMENT = re.compile(r"""\s*(\[{0,2})\s*([\w"'. -]+?)\s*[\]=]""")
"""Pattern of the header line of a table, or of a key."""


def read_profile(path: Path) -> Profile:
    """Read and check the file of a profile. The path of its sheet is relative to the folder of this file.

    Raises
    ------
    ProfileError
        If the file cannot be read, is not TOML, has wrong, missing or unknown keys, or has open questions of a draft.
        The message lists all problems, each with file, line and key.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        values = tomllib.loads(text)
    except OSError as error:
        raise ProfileError(f"{path}: the profile cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(f"{path}: the profile is not valid TOML (UTF-8): {error}.") from error
    questions = find_questions(text)
    asked = {question.place for question in questions}
    # A key with an open question is not reported as missing in addition.
    wrong = [mistake for mistake in find_mistakes(values, text) if mistake.place not in asked]
    found = sorted((*questions, *wrong), key=lambda mistake: mistake.line)
    if found:
        kinds = " and ".join(kind for kind, some in (("mistakes", wrong), ("open questions", questions)) if some)
        count = f"{len(found)} {kinds} in this profile:\n" if len(found) > 1 else ""
        raise ProfileError(count + "\n".join(f"{path}:{mistake.line}: {mistake.text}" for mistake in found))
    if "sheet" in values:
        values["sheet"]["file"] = str(path.parent / values["sheet"]["file"])
    return Profile.model_validate(values)


@cache
def shipped_profiles() -> tuple[Profile, ...]:
    """Return the shipped profiles, sorted by name."""
    return tuple(read_profile(path) for path in sorted((schema_folder() / "profiles").glob("*.toml")))


def load_profile(profile: str | Path | Profile) -> Profile:
    """Return a shipped profile by name, or the profile of a TOML file. A loaded profile is returned unchanged.

    Raises
    ------
    ProfileError
        If there is no such name or file, or the file is invalid.
    """
    if isinstance(profile, Profile):
        return profile
    shipped = {p.name: p for p in shipped_profiles()}
    if str(profile) in shipped:
        return shipped[str(profile)]
    path = Path(profile)
    if path.is_file():
        return read_profile(path)
    raise ProfileError(
        f"profile {str(profile)!r} is neither a file nor a shipped profile. Expected one of {sorted(shipped)}, or the "
        "path of a TOML file."
    )


def claim(name: str, profiles: tuple[Profile, ...]) -> Profile | None:
    """Return the profile that claims a log by its file name. All other profiles have priority over the native profile.

    Raises
    ------
    ProfileError
        If two non-native profiles claim the file.
    """
    specific = [p for p in profiles if p.format != "native" and p.claims(name)]
    if len(specific) > 1:
        raise ProfileError(
            f"{name}: claimed by the profiles {[p.name for p in specific]}, but only one profile may claim a file. "
            "Choose a profile with --profile, or narrow the `files` patterns."
        )
    if specific:
        return specific[0]
    return next((p for p in profiles if p.format == "native" and p.claims(name)), None)


@dataclass(frozen=True)
class Mistake:
    """An error in a profile, with its line (counted from 1), key, and message."""

    line: int
    place: Place
    text: str


def find_mistakes(values: JsonObject, text: str) -> list[Mistake]:
    """Return the errors of a profile, ordered by line. The list is empty if there are no errors.

    Contradictions between keys are checked only if each individual key is valid.

    Parameters
    ----------
    values : dict
        The parsed TOML.
    text : str
        Text of the profile, which gives the line numbers.
    """
    try:
        Profile.model_validate(values)
    except ValidationError as error:
        found = dict(problem for entry in error.errors() for problem in _explain(dict(entry)))
    else:
        return []
    lines = key_lines(text)
    mistakes = [Mistake(_line(lines, place), place, what) for place, what in found.items()]
    return sorted(mistakes, key=lambda mistake: (mistake.line, str(mistake.place)))


def find_questions(text: str) -> list[Mistake]:
    """Return the open questions of a draft, ``# QUESTION: key: words``. Each question is above its key, which is
    commented out.
    """
    found, lines = [], text.splitlines()
    for number, line in enumerate(lines, start=1):
        answered = number < len(lines) and not lines[number].lstrip().startswith("#")
        if not line.lstrip().startswith(QUESTION) or (answered and lines[number].strip()):
            continue
        key, _, words = line.lstrip().removeprefix(QUESTION).strip().partition(":")
        place: Place = tuple(int(part) if part.isdecimal() else part for part in key.split("."))
        found.append(Mistake(number, place, f"{_key(place)}: open question: {words.strip()} Set the key below it."))
    return found


def _explain(error: JsonObject) -> Iterator[tuple[Place, str]]:
    """Yield the location and message of each error."""
    if error["type"] == PROBLEMS:
        yield from ((tuple(place), f"{_key(place)}: {what}.") for place, what in error["ctx"]["problems"])
        return
    place = tuple(part for part in error["loc"] if part != "[key]")
    if error["type"] == "extra_forbidden":
        known = sorted(_keys_at(place[:-1]))
        near = get_close_matches(str(place[-1]), known, 1)
        what = f"unknown; {f'did you mean {near[0]!r}? Correct or remove it.' if near else f'expected one of {known}.'}"
    elif error["type"] == "missing":
        what = "missing. Add it."
    else:
        message = _WORDS.get(error["type"], str(error["msg"]).removeprefix("Value error, "))
        what = f"{message}, found {error['input']!r}."
    yield place, f"{_key(place)}: {what}"


def _key(place: Place) -> str:
    return f"key {'.'.join(str(part) for part in place)!r}" if place else "the profile"


def _keys_at(place: Place) -> set[str]:
    """Return the valid keys at a place in the profile."""
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


def key_lines(text: str) -> dict[Place, int]:
    """Return the line, counted from 1, at which each key and each table of a TOML text begins.

    Keys of an inline table have the line of this table.
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
        # A table that occurs only in dotted names begins at its first key.
        for length in range(1, len(place) + 1):
            lines.setdefault(place[:length], number)
    return lines


def _line(lines: Mapping[Place, int], place: Place) -> int:
    """Return the line of a key. If the key is missing, return the line of the table that should contain it."""
    while place not in lines:
        place = place[:-1]
    return lines[place]
