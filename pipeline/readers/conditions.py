"""Conditions of a foreign log (stiffness, damping, step, ...) from all places that a profile names, in SI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from pipeline.base.errors import LogError, ParameterError, refusal
from pipeline.base.units import factor_to_si
from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, REQUIRED_CONDITIONS, FileEntry, Profile, StepEntry
from pipeline.readers.frame import Contents, Scalar
from pipeline.records.batch import Integers
from pipeline.records.native import FREE, NativeHeader, parse_header

Part = tuple[FileEntry | None, StepEntry | None]
"""What a profile says of a file, and of a step in it."""


def entry_of(profile: Profile, name: str) -> FileEntry | None:
    """Return what the profile says of a single file, or None where it says nothing.

    Raises
    ------
    LogError
        If two entries fit the file.
    """
    entries = [entry for entry in profile.file if fnmatchcase(name.lower(), entry.match.lower())]
    if len(entries) > 1:
        found = f"fits {len(entries)} entries [[file]] of profile {profile.name}, match = {[e.match for e in entries]}"
        raise refusal("profile-wrong", name, found, "one")
    return entries[0] if entries else None


def statements(profile: Profile, name: str, part: Part) -> dict[str, tuple[str, Any]]:
    """Return the place of the profile that gives each condition of a trial, and its value; None where the file has it.

    The most special place counts: that of the step, of the file, then columns, attributes, the file name, constants.

    Raises
    ------
    LogError
        If the file name does not fit the profile.
    """
    entry, step = part
    found = {key: ("constants", value) for key, value in profile.constants.given().items()}
    told = {} if profile.name_pattern is None else find_groups(profile.name_pattern, name)
    if told is None:
        text = f"file name {name!r} does not fit name_pattern {profile.name_pattern!r} of {profile.name}"
        raise refusal("profile-wrong", "", text)
    found |= {key: ("name_pattern", value) for key, value in told.items()}
    found |= {key: (f"attributes: {attribute!r}", None) for key, attribute in profile.attributes.items()}
    found |= {key: (f"condition_columns: {column!r}", None) for key, column in profile.condition_columns.items()}
    if entry is not None:
        found |= {key: (f"file, match = {entry.match!r}", value) for key, value in entry.given().items()}
    if step is not None:
        found |= {key: (f"steps, label = {step.label!r}", value) for key, value in step.given().items()}
    return found


def conditions_of(
    profile: Profile,
    names: tuple[str, str],
    frame: Contents,
    rows: Integers,
    part: Part,
    required: Sequence[str] = REQUIRED_CONDITIONS,
) -> dict[str, Any]:
    """Return the conditions of a trial in SI.

    Parameters
    ----------
    profile : Profile
    names : tuple of str
        File name; and file with trial, for messages.
    frame : Contents
    rows : int64
        Rows of the trial, for conditions that stand in a column.
    part : FileEntry or None, StepEntry or None
        What the profile says of the file and of the step.
    required : sequence of str
        Conditions without which the trial is refused.

    Raises
    ------
    LogError
        If the file name, an attribute or a column does not give what the profile takes from it, or a condition is
        missing.
    """
    name, where = names
    given: dict[str, Any] = {}
    columns, attributes = dict[str, str](**profile.condition_columns), dict[str, str](**profile.attributes)
    for key, (_, value) in statements(profile, name, part).items():
        inside = value is None
        if inside and key in columns:
            value = _of_column(where, frame, rows, key, columns[key])
        elif inside and (value := frame.attributes.get(attributes[key])) is None:
            found = f"has no attribute {attributes[key]!r} (the {key}); found {sorted(frame.attributes)[:40]}"
            raise refusal("condition-missing", where, found)
        given[key] = _in_si(profile, where, key, value, inside)
    if given.keys().isdisjoint(FREE):
        given |= dict.fromkeys(FREE, 0.0)
    if missing := next((key for key in required if key not in given), None):
        line = f'[[file]]\nmatch = "{name}"\n{missing} = <value>'
        found = f"profile {profile.name} does not give the {missing} of this file"
        raise refusal("condition-missing", where, found, line=line)
    return given


def header_of(profile: Profile, where: str, given: Mapping[str, Any], extra: dict[str, str]) -> NativeHeader:
    """Return the conditions as a header: as lines of a native log, so that those of every format pass the same checks.

    Raises
    ------
    LogError
        If a condition is not legal.
    """
    lines = (f"# {key}: {value}" for key, value in {**given, "motion": profile.constants.motion}.items())
    try:
        header = parse_header(lines)
    except LogError as error:
        reason = f"{where}: by the conditions that profile {profile.name} gives, {error.reason}"
        # the row is that of the lines made here, which the file does not have
        raise LogError(reason, code=error.code) from error
    if (header.device, header.experiment) != (str(given["device"]), str(given["experiment"])):
        found = f"device {given['device']!r} or experiment {given['experiment']!r} has a part in brackets"
        raise refusal("condition-wrong", where, found, "names without brackets")
    return replace(header, extra=extra)


def _of_column(where: str, frame: Contents, rows: Integers, key: str, column: str) -> Scalar:
    values = frame.columns[column][rows]
    if not len(values):
        raise refusal("condition-missing", where, f"column {column!r}, which gives the {key}, has no rows")
    other = values != values[0]
    if other.any():
        at = int(np.argmax(other))
        found = f"column {column!r} gives the {key} and changes from {values[0]} to {values[at]}"
        raise refusal("condition-wrong", where, found, "one value for a trial", row=int(frame.row[rows[at]]))
    value: Scalar = values[0].item()
    return value


def _in_si(profile: Profile, where: str, key: str, value: Scalar, inside: bool = False) -> Scalar:
    """Return a condition in SI; a unit that stands behind the value in the file counts.

    ``inside`` says that the value stands in the file: where numbers have a decimal comma, a point may part thousands.
    """
    if key not in CONDITION_QUANTITIES:
        # 1.0 of a column of floats is the experiment "1"
        return int(value) if isinstance(value, float) and value.is_integer() else value
    factor = profile.condition_factor(key)
    if not isinstance(value, str):
        return value * factor
    text, said = value.strip(), f"the {key} is {value.strip()[:200]!r}"
    number, _, unit = text.replace("[", " ").replace("(", " ").rstrip(")]").partition(" ")
    if inside and profile.decimal_sign == "," and "." in number:
        found = f"{said}, but the decimal sign is ',': the point may part thousands"
        raise refusal("condition-wrong", where, found)
    try:
        magnitude = float(number.replace(profile.decimal_sign, ".").replace("_", "?"))
        unit = unit.strip()
        stated = factor_to_si(unit, (CONDITION_QUANTITIES[key][profile.constants.motion],)) if unit else factor
    except ParameterError as error:
        raise refusal("condition-wrong", where, f"{said}: {error}") from error
    except ValueError:
        expected = f"a number (decimal sign {profile.decimal_sign!r}), with or without its unit"
        raise refusal("condition-wrong", where, said, expected) from None
    if stated != factor and getattr(profile.units, key) is not None:
        found = f"{said}, but units.{key} is {getattr(profile.units, key)!r}"
        raise refusal("condition-wrong", where, found)
    return magnitude * stated
