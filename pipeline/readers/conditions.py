"""Conditions of a foreign log (stiffness, damping, step, ...) from all places that a profile names, in SI."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from pipeline.base.errors import LogError, ParameterError
from pipeline.base.units import factor_to_si
from pipeline.profiles.patterns import find_groups
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, REQUIRED_CONDITIONS, FileEntry, Profile, StepEntry
from pipeline.readers.frame import Frame, Scalar
from pipeline.readers.limits import LONGEST_QUANTITY
from pipeline.readers.refusals import refusal
from pipeline.records.batch import Integers
from pipeline.records.native import FREE, NativeHeader, parse_header

_QUANTITY = re.compile(r"([^\s\[\]()]+)\s*[\[(]?\s*([^\d\s\[\]()][^\[\]()]*?)?\s*[\])]?")
"""A number and, behind it, a unit, which may stand in brackets."""


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


def conditions_of(
    profile: Profile,
    name: str,
    where: str,
    frame: Frame,
    rows: Integers,
    special: Mapping[str, Any],
    required: Sequence[str] = REQUIRED_CONDITIONS,
) -> dict[str, Any]:
    """Return the conditions of a trial in SI, from the most special place that gives each.

    Parameters
    ----------
    profile : Profile
    name, where : str
        File name; and file with trial, for messages.
    frame : Frame
    rows : int64
        Rows of the trial, for conditions that stand in a column.
    special : mapping
        What holds for this file or step and goes before all else.
    required : sequence of str
        Conditions without which the trial is refused.

    Raises
    ------
    LogError
        If the file name, an attribute or a column does not give what the profile takes from it, or a condition is
        missing.
    """
    given: dict[str, Any] = dict(profile.constants.given()) | _of_name(profile, name)
    for key, attribute in profile.attributes.items():
        if key in special or key in profile.condition_columns:
            continue
        if attribute not in frame.attributes:
            found = f"has no attribute {attribute!r} (attributes.{key}); found {sorted(frame.attributes)[:40]}"
            raise refusal("condition-missing", where, found)
        given[key] = frame.attributes[attribute]
    for key, column in profile.condition_columns.items():
        if key not in special:
            given[key] = _of_column(where, frame, rows, key, column)
    given |= special
    if not any(key in given for key in FREE):
        given |= dict.fromkeys(FREE, 0.0)
    for condition in required:
        if condition not in given:
            line = f'[[file]]\nmatch = "{name}"\n{condition} = <value>'
            found = f"profile {profile.name} does not give the {condition} of this file"
            raise refusal("condition-missing", where, found, line=line)
    # names of files have points also where the numbers in them have commas
    inside = (set(profile.attributes) | set(profile.condition_columns)) - set(special)
    return {key: _in_si(profile, where, key, value, key in inside) for key, value in given.items()}


def places_of(profile: Profile, name: str, entry: FileEntry | None, step: StepEntry | None) -> dict[str, str]:
    """Return the key of the profile that gives each condition of a trial, in the order of `conditions_of`.

    Parameters
    ----------
    profile : Profile
    name : str
        File name.
    entry, step : FileEntry, StepEntry, optional
        What the profile says of the file and of the step.

    Raises
    ------
    LogError
        If the file name does not fit the profile.
    """
    places = dict.fromkeys(profile.constants.given(), "constants")
    places |= dict.fromkeys(_of_name(profile, name), "name_pattern")
    places |= {key: f"attributes: {attribute!r}" for key, attribute in profile.attributes.items()}
    places |= {key: f"condition_columns: {column!r}" for key, column in profile.condition_columns.items()}
    if entry is not None:
        places |= dict.fromkeys(entry.given(), f"file, match = {entry.match!r}")
    if step is not None:
        places |= dict.fromkeys(step.given(), f"steps, label = {step.label!r}")
    return places


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
        found = f"device {given['device']!r} or experiment {given['experiment']!r} would be stored as "
        found += f"{header.device!r}, {header.experiment!r}"
        raise refusal("condition-wrong", where, found, cure="Choose names without brackets.")
    return replace(header, extra=extra)


def _of_name(profile: Profile, name: str) -> dict[str, str]:
    if profile.name_pattern is None:
        return {}
    found = find_groups(profile.name_pattern, name)
    if found is None:
        text = f"file name {name!r} does not fit name_pattern {profile.name_pattern!r} of {profile.name}"
        raise refusal("profile-wrong", "", text, cure="Rename the file or correct the profile.")
    return found


def _of_column(where: str, frame: Frame, rows: Integers, key: str, column: str) -> Scalar:
    values = frame.columns[column][rows]
    if not len(values):
        raise refusal("condition-missing", where, f"column {column!r}, which gives the {key}, has no rows")
    other = values != values[0]
    if other.any():
        at = int(np.argmax(other))
        found = f"column {column!r} gives the {key} and changes from {values[0]} to {values[at]}"
        cure = "Give trial_column to tell trials apart, or correct condition_columns."
        raise refusal("condition-wrong", where, found, "one value for a trial", cure, int(frame.row[rows[at]]))
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
    text = value.strip()
    # what is longer is no number with a unit, and takes the pattern its length squared
    match = _QUANTITY.fullmatch(text) if len(text) <= LONGEST_QUANTITY else None
    number, unit = match.groups() if match else (text, None)
    if inside and profile.decimal_sign == "," and "." in number:
        found = f"the {key} is {text[:200]!r}, but the decimal sign is ',': the point may part thousands"
        cure = "Write the number with a comma, or give the condition elsewhere (name_pattern, [[file]], [constants])."
        raise refusal("condition-wrong", where, found, cure=cure)
    try:
        magnitude = float(number.replace(profile.decimal_sign, ".").replace("_", "?"))
    except ValueError:
        expected = f"a number (decimal sign {profile.decimal_sign!r}), with or without its unit"
        raise refusal("condition-wrong", where, f"the {key} is {text[:200]!r}", expected) from None
    if unit:
        try:
            stated = factor_to_si(unit, (CONDITION_QUANTITIES[key][profile.constants.motion],))
        except ParameterError as error:
            raise refusal("condition-wrong", where, f"the {key} is {text[:200]!r}: {error}") from error
        if getattr(profile.units, key) is not None and stated != factor:
            found = f"the {key} is {text[:200]!r}, but units.{key} of profile {profile.name} is "
            found += repr(getattr(profile.units, key))
            raise refusal("condition-wrong", where, found, cure="Correct one of both.")
        factor = stated
    return magnitude * factor
