"""Inspect the format, the layout, and the numeric columns of an unknown log."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.base.errors import ProfileError, UsageError, refusal
from pipeline.base.units import DRIVES, find_unit, unit_in_heading
from pipeline.profiles.profile_model import GROUPED, QUANTITIES, Format, Profile
from pipeline.readers.file_columns import FileColumns, trial_groups
from pipeline.readers.formats import format_of
from pipeline.readers.formats.delimited import Layout, text_layout, unpacked
from pipeline.readers.isolation import read_file
from pipeline.records.trials import Floats

SPEEDS = frozenset(QUANTITIES["velocity"].values())
"""Quantities of columns whose integral is a position."""

_BESIDE = {"position": SPEEDS, "command": frozenset(DRIVES)}
"""Further quantities that the column of a role may have."""


_OF_ANOTHER = re.compile(r"[./](data|values?)(\[\d+\])*$", re.IGNORECASE)


class Sample(NamedTuple):
    """Unknown log, with its format, the keys of its layout, questions about these keys, and its contents.

    If the file has several trials, ``trials`` has the contents of each.
    """

    name: str
    kind: Format
    layout: Layout
    contents: FileColumns
    trials: tuple[FileColumns, ...] = ()

    @property
    def numbers(self) -> dict[str, Floats]:
        """Numeric columns with several rows, by name."""
        columns = self.contents.columns.items()
        return {key: np.asarray(v, np.float64) for key, v in columns if key and v.dtype.kind != "U" and len(v) > 1}

    def title(self, name: str) -> str:
        """Return the heading of a column, which may come from a comment line."""
        return self.layout.titles.get(name, name)

    def unit(self, name: str, role: str) -> tuple[str, str]:
        """Return the last part of a column name without its unit, and the unit that the file states for the column."""
        allowed = (*QUANTITIES[role].values(), *_BESIDE.get(role, ()))
        plain, unit = unit_in_heading(self.title(name), allowed)
        # Text in brackets that is not a known unit is replaced by the unit line, or by the answer to a question.
        known = unit if find_unit(unit) else ""
        unit_in_file = known or self.contents.units.get(name) or self.contents.hints.get(name) or unit
        # A column named "data" or "value" gets the name of its parent.
        plain = _OF_ANOTHER.sub("", plain) or plain
        return re.split(r"[./]", plain)[-1].strip().lower(), unit_in_file


SHORTEST_TRIAL = 10
"""Smallest number of rows of a trial in a long table."""


def _trial_column(contents: FileColumns) -> tuple[str, list[slice]] | None:
    """Return the column that numbers the trials of a long table, and the rows of each trial. Time restarts in each
    trial."""
    columns = contents.columns
    rows = len(next(iter(columns.values()), ()))
    if any(len(column) != rows for column in columns.values()) or rows < 2 * SHORTEST_TRIAL:
        return None
    for clock in columns.values():
        if clock.dtype.kind == "U" or not np.isfinite(clock.astype(np.float64)).all():
            continue
        steps = np.diff(clock.astype(np.float64))
        starts = np.flatnonzero(steps < 0) + 1
        ends = np.array([0, *starts.tolist(), rows])
        # Within a trial, a clock increases in every row.
        if not len(starts) or min(np.diff(ends)) < SHORTEST_TRIAL or (np.delete(steps, starts - 1) <= 0).any():
            continue
        blocks = [slice(first, behind) for first, behind in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]
        for name, column in columns.items():
            changes = np.flatnonzero(column[1:] != column[:-1]) + 1
            if np.array_equal(changes, starts) and len(np.unique(column)) == len(blocks):
                return name, blocks
    return None


def _rows_of(contents: FileColumns, rows: slice) -> FileColumns:
    """Return the contents of a file, restricted to a range of rows."""
    return replace(
        contents, columns={name: column[rows] for name, column in contents.columns.items()}, row=contents.row[rows]
    )


def open_sample(path: Path) -> Sample:
    """Open an unknown log.

    Raises
    ------
    UsageError
        If the file cannot be read.
    LogError
        If the file has no columns of numbers.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}). Name a log file.") from error
    kind = format_of(path.name, unpacked(path.name, data))
    if kind == "native":
        raise ProfileError(f"{path} is a native log, which needs no profile: `pipeline ingest {path}` reads it.")
    layout = text_layout(path.name, data) if kind == "delimited" else Layout()
    settings = Profile.model_construct(name="draft", format=kind, files=("*",), **layout.keys)
    contents, trials = read_file(settings, (path.name,), (data,)), tuple[FileColumns, ...]()
    if kind in GROUPED:
        by_group = layout.keys | {"trials": "each group"}
        each = Profile.model_construct(name="draft", format=kind, files=("*",), **by_group)
        whole = read_file(each, (path.name,), (data,)) if kind in ("json", "tdms") else contents
        if groups := trial_groups(whole):
            layout.keys["trials"] = "each group"
            layout.evidence["trials"] = f"{len(groups)} groups have the same columns: {groups[0].strip('/')}, ..."
            trials = tuple(whole.of_group(group) for group in groups)
            contents = trials[0]
    if not trials and (found := _trial_column(contents)) is not None:
        name, blocks = found
        layout.keys["trial_column"] = name
        layout.evidence["trial_column"] = f"time restarts where this column changes: {len(blocks)} trials"
        trials = tuple(_rows_of(contents, block) for block in blocks)
        contents = trials[0]
    sample = Sample(path.name, kind, layout, contents, trials)
    layout.keys |= {} if "trials" in layout.keys else sample.contents.keys
    if not sample.numbers:
        reasons = (f"{key} {reason}" for key, reason in sample.contents.refused.items())
        cure = "; ".join(reasons) or "Export the recorded signals as plain columns."
        raise refusal("empty", "", "it has no columns of numbers with several rows", cure=cure)
    return sample
