"""The record of a log profile: which files, which format, which columns, which conditions, which part of the rows.

All that does not fit together is found at once: `Profile` raises one error that holds every problem with its place.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from fnmatch import translate
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from pipeline.base.errors import ParameterError
from pipeline.base.provenance import sha256
from pipeline.base.units import factor_to_si
from pipeline.profiles.profile_columns import (
    Columns,
    Count,
    Number,
    Problem,
    Source,
    TextLayout,
    factor,
    group_names,
    pattern_problem,
    problems_of,
)
from pipeline.records.findings import Grip, Motion, Name, Record
from pipeline.records.native import FREE

Format = Literal[
    "native", "delimited", "json", "parquet", "feather", "matlab", "hdf5", "rosbag", "mcap", "tdms", "mdf"
]  # fmt: skip
Condition = Literal[
    "device", "experiment", "stiffness", "damping", "step", "sampling_period_s", "added_delay_samples", "grip"
]
CONDITIONS: tuple[str, ...] = get_args(Condition)
REQUIRED_CONDITIONS = CONDITIONS[:6]
PROBLEMS = "profile_problems"
"""Type of the validation error that holds all problems of a profile."""

_EXAMPLES = {"device": '"bench"', "experiment": '"1"', "sampling_period_s": "0.001"}
CONDITION_QUANTITIES: dict[str, dict[Motion, str]] = {
    "stiffness": {"translation": "stiffness", "rotation": "rotational stiffness"},
    "damping": {"translation": "damping", "rotation": "rotational damping"},
    "step": {"translation": "force", "rotation": "torque"},
    "sampling_period_s": {"translation": "time", "rotation": "time"},
}


class Partner(Record):
    """Second file of a log, beside the first: its name is the first one's with a text replaced."""

    replace: Name
    by: Annotated[Name, Field(pattern=r"^[^/\\\x00]+$")]


class Conditions(Record):
    """Conditions of a log, in SI or in the units that [units] names; None where something else gives them."""

    device: Name | None = None
    experiment: Name | None = None
    stiffness: Number | None = None
    damping: Number | None = None
    step: Number | None = None
    sampling_period_s: Annotated[Number, Field(gt=0)] | None = None
    added_delay_samples: Count | None = None
    grip: Grip | None = None

    def given(self) -> dict[str, Any]:
        """Return the conditions that are given."""
        return {key: value for key in CONDITIONS if (value := getattr(self, key)) is not None}


class Constants(Conditions):
    """Conditions that hold for all files of a profile, and the motion of the device."""

    motion: Motion = "translation"


class ConditionUnits(Record):
    """Units of conditions, wherever the profile takes them from; SI where none is given."""

    stiffness: Name | None = None
    damping: Name | None = None
    step: Name | None = None
    sampling_period_s: Name | None = None


class Window(Record):
    """Part of the rows, both ends included: by time [s] or by row, counted from 0 as read from the file."""

    from_s: Number | None = None
    to_s: Number | None = None
    from_row: Count | None = None
    to_row: Count | None = None


class StepTime(Record):
    """When the step happens: found in the command, or declared by row (from 0), by time [s], or the first row."""

    step_row: Count | None = None
    step_time_s: Number | None = None
    step_at: Literal["command edge", "first row"] | None = None

    @property
    def declared(self) -> list[str]:
        """Keys by which something is said about the step; one is expected."""
        return [key for key in StepTime.model_fields if getattr(self, key) is not None]


STEP_MISSING = (
    'missing; add the line step_at = "command edge" (the step is found in the command, and rows before it are '
    'recorded), step_at = "first row", step_row = <row, counted from 0> or step_time_s = <seconds>'
)


class FileEntry(Conditions, StepTime):
    """Conditions, step and window of the files whose name fits a pattern."""

    match: Name
    window: Window | None = None


class StepEntry(Conditions, StepTime, Window):
    """One of several steps in a file: its rows, and what differs from the conditions of the file."""

    label: Name


class Profile(TextLayout, StepTime):
    """How the files of one lab are read; keys of text files stand beside these (`TextLayout`).

    Parameters
    ----------
    name, title : str
    format : str
        Reader; a native log brings columns and conditions itself.
    files : tuple of str
        Patterns of the file names that are claimed (``*``, ``?``, ``[...]``; case does not matter).
    records : str, optional
        Key of the list of records inside a JSON file, with dots where it is nested.
    partner : Partner, optional
    columns : Columns
    constants : Constants
    units : ConditionUnits
    name_pattern : str, optional
        Regular expression with named groups that reads conditions out of the file name, such as
        ``B(?P<damping>[-0-9.]+)_K(?P<stiffness>[0-9.]+)``.
    attributes, condition_columns : dict
        Condition -> attribute of the file (a label of text lines, an HDF5 attribute) or column that gives it.
    file : tuple of FileEntry
        What holds for single files; one entry at most may fit a file.
    trial_column : str, optional
        Long form: rows with the same value in this column are one trial.
    steps : tuple of StepEntry
        Several steps in one file, each its own trial.
    window : Window, optional
        Rows outside are not stored.
    step_row, step_time_s, step_at
        See `StepTime`. One of them is needed, here or in every entry of file or steps, but where the step is the
        constant 0.

    Notes
    -----
    A condition is taken from the most special place that gives it: steps, file, condition_columns, attributes,
    name_pattern, constants.
    """

    name: Name
    title: str = ""
    format: Format
    files: Annotated[tuple[Name, ...], Field(min_length=1)]
    records: Name | None = None
    partner: Partner | None = None
    columns: Columns | None = None
    constants: Constants = Constants()
    units: ConditionUnits = ConditionUnits()
    name_pattern: str | None = None
    attributes: dict[Condition, Name] = Field(default_factory=dict)
    condition_columns: dict[Condition, Name] = Field(default_factory=dict)
    file: tuple[FileEntry, ...] = ()
    trial_column: Name | None = None
    steps: tuple[StepEntry, ...] = ()
    window: Window | None = None

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        problems = list(self._problems())
        if problems:
            text = "; ".join(f"key {'.'.join(map(str, place))!r}: {what}" for place, what in problems)
            raise PydanticCustomError(PROBLEMS, "{text}", {"text": text, "problems": problems})
        return self

    def __hash__(self) -> int:
        # tables by condition are not hashable; equal profiles have equal names and files
        return hash((self.name, self.files))

    def _problems(self) -> Iterator[Problem]:
        if self.format == "native":
            if foreign := self.model_fields_set - {"name", "title", "format", "files"}:
                yield ("format",), f"a native log brings all of {sorted(foreign)}. Remove them, or correct the format"
            return
        given = {key for key in self.model_fields_set if getattr(self, key) is not None}
        for form, keys in (("delimited", set(TextLayout.model_fields)), ("json", {"records"})):
            for key in sorted(keys & given) if form != self.format else ():
                yield (key,), f"for format {form}, found {self.format}. Remove it"
        if self.format == "delimited":
            yield from self.layout_problems()
        if self.columns is None:
            yield ("columns",), "missing. Add [columns.time], [columns.command], [columns.position]"
        else:
            yield from problems_of(self.columns, self.constants.motion)
        partners = [key for key, source in self.column_sources().items() if source.file == "partner"]
        if self.partner is None and partners:
            yield ("partner",), f"missing, but columns.{partners[0]} is of the partner. Add [partner] with replace, by"
        if self.partner and (self.partner.replace in self.partner.by or self.partner.by in self.partner.replace):
            yield ("partner", "by"), "'replace' and 'by' must not contain each other"
        yield from self._step_problems()
        yield from self._condition_problems()

    def _step_problems(self) -> Iterator[Problem]:
        """Yield what is wrong in [[steps]], and where it is not said when the step happens."""
        entries = {(key, i): e for key in ("steps", "file") for i, e in enumerate(getattr(self, key))}
        places: list[tuple[tuple[str | int, ...], StepTime]] = [((), self), *entries.items()]
        for place, entry in places:
            if len(given := entry.declared) > 1:
                yield (*place, given[1]), f"given beside {given[0]}; expected one of them"
        labels = [step.label for step in self.steps]
        for index, step in enumerate(self.steps):
            if step.sampling_period_s is not None:
                words = "one for the whole file is expected. Move it to [constants]"
                yield ("steps", index, "sampling_period_s"), words
            if labels.index(step.label) != index:
                yield ("steps", index, "label"), f"{step.label!r} is given twice; expected a name of its own"
        if self.steps and (self.trial_column or self.window or any(entry.window for entry in self.file)):
            yield ("steps",), "given beside trial_column or a window; expected one of them"
        varies = "step" in {*self.name_groups(), *self.attributes, *self.condition_columns}
        constant = 0.0 if self.conditions().isdisjoint(FREE) else None if varies else self.constants.step
        steps = [constant, *(entry.step for entry in entries.values() if entry.step is not None)]
        # an entry that says nothing beside one that does is refused with the files that it reads
        if not any(entry.declared for entry in (self, *entries.values())) and any(step != 0 for step in steps):
            yield ("step_at",), STEP_MISSING

    def conditions(self) -> set[str]:
        """Return the conditions that anything gives."""
        tables = {key for table in (self.constants, *self.file, *self.steps) for key in table.given()}
        return tables | {*self.name_groups(), *self.attributes, *self.condition_columns}

    def _condition_problems(self) -> Iterator[Problem]:
        for key in CONDITION_QUANTITIES:
            try:
                self.condition_factor(key)
            except ParameterError as error:
                yield ("units", key), f"{error} (motion is {self.constants.motion})"
        problem = pattern_problem(self.name_pattern)
        if problem is None and self.name_pattern is not None and not self.name_groups():
            problem = "has no named group, so that it gives no condition. Write (?P<stiffness>[0-9.]+) for (...)"
        if unknown := sorted(self.name_groups() - set(CONDITIONS)):
            problem = f"unknown groups {unknown}; known are {list(CONDITIONS)}"
        if problem:
            yield ("name_pattern",), problem
        given = self.conditions()
        for key in REQUIRED_CONDITIONS:
            # a log of motion without wall and step leaves out all that speaks of them
            if key not in given and not (key in FREE and given.isdisjoint(FREE)):
                line = f"{key} = {_EXAMPLES.get(key, '<number>')}"
                others = "or give it by name_pattern, attributes, condition_columns, [[file]] or [[steps]]"
                yield ("constants", key), f"missing. Add {line} to [constants], {others}"

    @property
    def reads_names(self) -> bool:
        """Whether the name of a file decides what is read of it: a renamed file may be another log."""
        return self.name_pattern is not None or bool(self.file)

    def name_groups(self) -> frozenset[str]:
        """Return the conditions that the file name gives."""
        return frozenset() if pattern_problem(self.name_pattern) else group_names(self.name_pattern or "")

    def column_sources(self) -> dict[str, Source]:
        """Return the columns by SI name: time, command, position, and what else there is."""
        return {} if self.columns is None else self.columns.sources()

    def wanted(self, file: Literal["source", "partner"] = "source") -> dict[str, str]:
        """Return what a profile asks for of a file: key of the profile -> name of the column in `Contents`."""
        found = {
            f"columns.{key}": source.key
            for key, source in self.column_sources().items()
            if source.file == file and source.in_file
        }
        time = self.columns.time if self.columns else None
        if time is not None and time.fraction is not None and time.file == file:
            found["columns.time.fraction"] = time.fraction.name
        if file == "source":
            found |= {f"condition_columns.{key}": name for key, name in self.condition_columns.items()}
            if self.trial_column is not None:
                found["trial_column"] = self.trial_column
        return found

    def factors(self) -> dict[str, float]:
        """Return the signed factor to SI of each column that has a unit."""
        motion = self.constants.motion
        sources = self.column_sources().items()
        return {key: factor(key, source, motion) for key, source in sources if source.unit is not None}

    def condition_factor(self, key: str) -> float:
        """Return the factor to SI of a condition."""
        unit = getattr(self.units, key, None)
        return 1.0 if unit is None else factor_to_si(unit, (CONDITION_QUANTITIES[key][self.constants.motion],))

    def claims(self, name: str) -> bool:
        """Return whether a file name is that of a log (not of a partner) of this profile."""
        return _name_pattern(self.files).match(name.lower()) is not None

    def partner_of(self, path: Path) -> Path | None:
        """Return the partner file of a log, or None where a log is one file."""
        if self.partner is None:
            return None
        return path.with_name(path.name.replace(self.partner.replace, self.partner.by))

    def log_of_partner(self, path: Path) -> Path | None:
        """Return the log that a file would be the partner of, or None where it is none."""
        if self.partner is None or self.partner.by not in path.name:
            return None
        name = path.name.replace(self.partner.by, self.partner.replace)
        return path.with_name(name) if self.claims(name) else None

    def digest(self) -> str:
        """Return the SHA-256 of all that decides how a file is read; layout and title of the TOML do not.

        Keys at their default do not count, so that a new key leaves the hashes of profiles without it as they are.
        """
        values = self.model_dump(mode="json", exclude={"title"}, exclude_defaults=True)
        return sha256(json.dumps(values, sort_keys=True).encode())


@cache
def _name_pattern(files: tuple[str, ...]) -> re.Pattern[str]:
    """Return one pattern for all of `Profile.files`: thousands of names are held against each profile."""
    return re.compile("|".join(translate(pattern.lower()) for pattern in files))
