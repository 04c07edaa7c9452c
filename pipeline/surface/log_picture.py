"""Show the columns, the step, jumps, rests and missing rows of a raw log, in SI units or as recorded."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from pipeline.base.disk import write_text
from pipeline.base.errors import OTHER_COLUMNS, LogError, UsageError, draft_hint
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import check_output
from pipeline.base.provenance import __version__
from pipeline.device_data.devices import known_devices
from pipeline.intake.sources import find_sources, logs_of, motion_of, requested_profiles
from pipeline.measured.signal.change_points import gaps, jumps, rests
from pipeline.measured.signal.edge import NO_ROW, find_edge
from pipeline.measured.signal.release import find_release
from pipeline.profiles.profile_files import load_profile
from pipeline.profiles.profile_model import Profile, quantity, si_unit
from pipeline.readers import Log
from pipeline.readers.sample import open_sample
from pipeline.records.models import Motion
from pipeline.records.trials import Floats, Trial
from pipeline.rendering.figures.drawing import draw
from pipeline.rendering.figures.overview import RecordedColumn, recorded_figure
from pipeline.rendering.report.page_template import fill_template
from pipeline.surface.logs import PathLike

MOST_COLUMNS = 24
"""Largest number of drawn columns of a file without a profile. A bag may have hundreds of columns."""

MOST_TRIALS = 12
"""Largest number of drawn trials of one file."""


@dataclass(frozen=True, eq=False)
class LogPicture:
    """Picture of a log: path, trials with titles and columns, remarks, and label of the abscissa."""

    log: str
    trials: tuple[tuple[str, tuple[RecordedColumn, ...]], ...]
    notes: tuple[str, ...]
    abscissa: str

    def __str__(self) -> str:
        """Return the remarks as lines of text."""
        return "\n".join(self.notes)

    @property
    def document(self) -> JsonObject:
        """The JSON document of `pipeline look --json`: columns, steps, jumps, rests and gaps of each trial."""
        trials = []
        for title, columns in self.trials:
            found = [{"name": c.name, "unit": c.unit, "jumps": c.jumps, "rests": c.rests} for c in columns]
            known = {"rows": len(columns[0].values), "step_row": columns[0].step_row, "gaps": columns[0].gaps}
            trials.append({"title": title, **known, "columns": found})
        return {"log": self.log, "trials": trials, "notes": self.notes}

    def write(self, path: PathLike) -> Path:
        """Write the picture as an HTML page, and return its path.

        Raises
        ------
        UsageError
            If the path is a folder.
        PipelineError
            If the file cannot be written.
        """
        target, drawn = Path(path), []
        check_output(target, "")
        for number, (title, columns) in enumerate(self.trials):
            panels = draw(recorded_figure(f"log-{number}", title, columns, self.abscissa)).panels
            drawn.append((title, list(zip(panels, (column.words for column in columns), strict=True))))
        target.parent.mkdir(parents=True, exist_ok=True)
        write_text(target, fill_template("log.html.j2", picture=self, drawn=drawn, version=__version__))
        return target


def look(path: PathLike, profile: PathLike | Profile | None = None) -> LogPicture:
    """Return the picture of a raw log: columns, step, jumps, rests and missing rows, as in `pipeline look`.

    Parameters
    ----------
    path : path
        A file, or the folder of a bag.
    profile : str or path, optional
        Profile for reading the file, by name or as a TOML file. By default, the shipped profiles are tried. A file that
        matches no profile is drawn as recorded, over the row number.

    Returns
    -------
    LogPicture
        ``trials`` (title and columns, with the rows of jumps, rests, gaps and step), ``notes`` (remarks),
        ``document``, and ``write("look.html")``.

    Raises
    ------
    UsageError
        If the path does not exist or contains several logs.
    LogError
        If the profile rejects the log, or the file has no numeric columns.
    """
    log, given = Path(path), None if profile is None else load_profile(_named(profile))
    sources = find_sources([log], requested_profiles(given, [log]).profiles)
    if len(sources) != 1:
        raise UsageError(f"{log}: expected one log, found {len(sources)}. Name a single file.")
    (source,) = sources
    try:
        claimant, _, outcome = logs_of(source)
    except LogError as error:
        row = "" if error.row is None else f", row {error.row}"
        if given is not None:
            raise error.reworded(f"{log}{row}: {error.reason}") from error
        notes = [f"Shown as recorded; `pipeline ingest` would refuse it{row}: {error.reason.split('. ')[0]}."]
        notes += [draft_hint(str(log))] if error.code in OTHER_COLUMNS else []
        return LogPicture(str(log), (_as_it_stands(log),), tuple(notes), "row")
    notes = [f"Read by profile {claimant.name}, in SI."]
    if len(outcome) > MOST_TRIALS:
        notes.append(f"The file contains {len(outcome)} trials. Only the first {MOST_TRIALS} are shown.")
    motions = {name: device.motion for name, device in known_devices().items()}
    trials = []
    for one in outcome[:MOST_TRIALS]:
        title, columns, said = _drawn(one, motion_of(one, motions))
        trials.append((title, columns))
        notes += [f"{title}: {text}" for text in said]
    return LogPicture(str(log), tuple(trials), tuple(notes), "time [s]")


def _named(profile: PathLike | Profile) -> str | Path | Profile:
    return profile if isinstance(profile, str | Profile) else Path(profile)


def _drawn(log: Log, motion: Motion) -> tuple[str, tuple[RecordedColumn, ...], list[str]]:
    """Return the title of a trial, its columns, and remarks. The first remark states the origin of the step."""
    row, how = step_of(log)
    columns = tuple(
        _column(key, si_unit(quantity(key, motion)), log.time, values, log.time, row)
        for key in ("command", "position", "force", "velocity")
        if (values := getattr(log, key)) is not None
    )
    moved = "step" if log.header.step else "it moves"
    source = f"{moved} in row {row}" if row is not None else "no step is known"
    title = f"trial {log.label}" if log.label else f"K = {log.header.stiffness:g}, B = {log.header.damping:g}"
    return title, columns, [f"{source} ({how})", *log.warnings, *(each.sentence for each in log.findings)]


def _as_it_stands(log: Path) -> tuple[str, tuple[RecordedColumn, ...]]:
    """Return the file name and the numeric columns of a file that matches no profile."""
    sample = open_sample(log)
    columns = dict(islice(sample.numbers.items(), MOST_COLUMNS))
    # A column that increases in every row is a clock or a counter. Gaps in this column are missing rows of the log.
    clock = next((values for values in columns.values() if (np.diff(values) > 0).all()), None)
    return sample.name, tuple(
        _column(name, sample.contents.hints.get(name, ""), rows, values, rows if clock is None else clock, None)
        for name, values in columns.items()
        for rows in [np.arange(len(values), dtype=np.float64)]
    )


def _column(name: str, unit: str, place: Floats, values: Floats, time: Floats, step_row: int | None) -> RecordedColumn:
    found = tuple(jumps(values).tolist()), tuple(rests(values)), tuple(gaps(time).tolist())
    return RecordedColumn(name, unit, place, values, *found, step_row)


def step_of(log: Log) -> tuple[int | None, str]:
    """Return the row of the step of a log, and its origin. Without a step, return None and the reason."""
    header = log.header
    if "step_row" in header.extra:
        row = int(header.extra["step_row"])
        return row, f"declared, at {log.time[row]:.9g} s"
    trial = trial_of(log)
    if header.step == 0 and (release := find_release(trial)).kind:
        what = {"release": "released", "hit": "hit"}[release.kind]
        return release.begin, f"none: the device is {what} at {log.time[release.begin]:.9g} s"
    edge = find_edge(trial)
    if edge.row == NO_ROW:
        return None, edge.reason
    return edge.row, f"found in the command, at {log.time[edge.row]:.9g} s"


def trial_of(log: Log) -> Trial:
    """Return a log as a trial, for functions that measure its command and motion."""
    header = log.header
    wall = header.stiffness, header.damping, header.step, header.sampling_period_s
    return Trial("sample", *wall, log.time, log.command, log.position)
