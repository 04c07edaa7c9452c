"""One page of a log as it was recorded: its columns with the step, rests, jumps and gaps that are found in them.

By a profile the columns are those of a trial in SI over time; without one all columns of numbers, as they stand in the
file, over the number of the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.base.errors import OTHER_COLUMNS, LogError, UsageError
from pipeline.device_data.devices import known_devices
from pipeline.intake.sources import find_sources, logs_of, motion_of
from pipeline.measured.signal.marks import gaps, jumps, rests
from pipeline.profiles.profile_columns import QUANTITIES, si_unit
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log
from pipeline.records.batch import Floats
from pipeline.records.models import Motion
from pipeline.rendering.figures.drawing import draw
from pipeline.rendering.figures.overview import RecordedColumn, recorded_figure
from pipeline.rendering.report.page_template import fill_template
from pipeline.shell.console import draft_hint
from pipeline.shell.profile.check import step_of
from pipeline.shell.profile.draft import open_sample

MOST_COLUMNS = 24
"""Columns of a file without a profile that are drawn; a bag has hundreds."""

MOST_TRIALS = 12
"""Trials of one file that are drawn."""

ROWS, TIME = "row", "time [s]"


@dataclass(frozen=True, eq=False)
class Picture:
    """A log: its name, the columns of each of its trials by title, what is to be said, and what they stand over."""

    log: str
    trials: tuple[tuple[str, tuple[RecordedColumn, ...]], ...]
    notes: tuple[str, ...]
    abscissa: str


def look(log: Path, profile: Profile | None = None) -> Picture:
    """Return the picture of a log.

    Parameters
    ----------
    log : Path
        A file, or the folder of a bag.
    profile : Profile, optional
        That reads it; the shipped profiles are known, and a file that none of them reads is shown as it stands.

    Raises
    ------
    UsageError
        If the path does not exist or holds several logs.
    LogError
        If the profile refuses the log, or no columns of numbers are found in it.
    """
    sources = find_sources([log], shipped_profiles() if profile is None else (profile,))
    if len(sources) != 1:
        raise UsageError(f"{log}: expected one log, found {len(sources)}. Give a single file.")
    (source,) = sources
    try:
        claimant, _, outcome = logs_of(source)
    except LogError as error:
        row = "" if error.row is None else f", row {error.row}"
        if profile is not None:
            raise LogError(f"{log}{row}: {error.reason}", error.row, code=error.code) from error
        note = f"Shown as it stands; `pipeline ingest` would refuse it{row}: {error.reason.split('. ')[0]}."
        hints = (draft_hint(str(log)),) if error.code in OTHER_COLUMNS else ()
        return Picture(str(log), (_as_it_stands(log),), (note, *hints), ROWS)
    notes = [f"Read by profile {claimant.name}, in SI."]
    if len(outcome) > MOST_TRIALS:
        notes.append(f"The file holds {len(outcome)} trials; the first {MOST_TRIALS} are shown.")
    motions = {name: device.motion for name, device in known_devices().items()}
    trials = []
    for one in outcome[:MOST_TRIALS]:
        title, columns, said = _trial(one, motion_of(one, motions))
        trials.append((title, columns))
        notes += [f"{title}: {text}" for text in said]
    return Picture(str(log), tuple(trials), tuple(notes), TIME)


def _trial(log: Log, motion: Motion) -> tuple[str, tuple[RecordedColumn, ...], list[str]]:
    """Return the title of a trial, its columns, how its step is known and what else is to be said."""
    row, how = step_of(log)
    columns = tuple(
        _column(key, si_unit(QUANTITIES[key][motion]), log.time, values, log.time, row)
        for key in ("command", "position", "force", "velocity")
        if (values := getattr(log, key)) is not None
    )
    said = f"step in row {row}" if row is not None else "no step is known"
    title = f"trial {log.label}" if log.label else f"K = {log.header.stiffness:g}, B = {log.header.damping:g}"
    return title, columns, [f"{said} ({how})", *log.warnings]


def _as_it_stands(log: Path) -> tuple[str, tuple[RecordedColumn, ...]]:
    """Return the columns of numbers of a file of which nothing is known."""
    sample = open_sample(log)
    columns = dict(islice(sample.numbers.items(), MOST_COLUMNS))
    # a column that rises in every row is a clock or a counter: its gaps are those of the log
    clock = next((values for values in columns.values() if (np.diff(values) > 0).all()), None)
    return sample.name, tuple(
        _column(name, sample.contents.hints.get(name, ""), rows, values, rows if clock is None else clock, None)
        for name, values in columns.items()
        for rows in [np.arange(len(values), dtype=np.float64)]
    )


def _column(name: str, unit: str, place: Floats, values: Floats, time: Floats, step_row: int | None) -> RecordedColumn:
    found = tuple(jumps(values).tolist()), tuple(rests(values)), tuple(gaps(time).tolist())
    return RecordedColumn(name, unit, place, values, *found, step_row)


def page(pictures: Sequence[Picture]) -> str:
    """Return the page of some logs."""
    drawn = []
    for i, picture in enumerate(pictures):
        trials = []
        for j, (title, columns) in enumerate(picture.trials):
            drawn_columns = draw(recorded_figure(f"log-{i}-{j}", title, columns, picture.abscissa)).panels
            trials.append((title, list(zip(drawn_columns, (column.words for column in columns), strict=True))))
        drawn.append((picture, trials))
    return fill_template("log.html.j2", drawn=drawn, version=__version__)


def document(picture: Picture) -> dict[str, Any]:
    """Return what was found in a log as a JSON document."""
    trials = []
    for title, columns in picture.trials:
        found = [
            {"name": c.name, "unit": c.unit, "jumps": list(c.jumps), "rests": [list(rest) for rest in c.rests]}
            for c in columns
        ]
        first = columns[0]
        known = {"rows": len(first.values), "step_row": first.step_row, "gaps": list(first.gaps)}
        trials.append({"title": title, **known, "columns": found})
    return {"log": picture.log, "trials": trials, "notes": list(picture.notes)}
