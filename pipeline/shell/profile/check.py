"""Preview of a profile on sample files: conditions and their sources, columns in SI, time, step, and warnings about
logs that can be read but contradict the profile; and the picture of a log as it was recorded.

Nothing is stored. A file that would be refused is shown with the reason that `pipeline ingest` would give.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import OTHER_COLUMNS, LogError, UsageError, refusal
from pipeline.base.provenance import __version__
from pipeline.base.wording import counted
from pipeline.device.parameters import drive_of, is_rotation
from pipeline.device_data.devices import known_devices
from pipeline.intake.sources import asked_profiles, find_sources, logs_of, motion_of
from pipeline.measured.signal.change_points import gaps, jumps, rests
from pipeline.measured.signal.edge import NO_ROW, find_edge
from pipeline.measured.signal.release import find_release
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, CONDITIONS, Kind, Profile, quantity, si_unit
from pipeline.readers import Log
from pipeline.readers.gain_check import followed_gains, gain_mismatch
from pipeline.readers.log import step_flags
from pipeline.readers.mapping import entry_of, statements
from pipeline.records.models import Motion
from pipeline.records.native import FREE
from pipeline.records.trials import Floats, Trial
from pipeline.rendering.figures.drawing import draw
from pipeline.rendering.figures.overview import RecordedColumn, recorded_figure
from pipeline.rendering.report.page_template import fill_template
from pipeline.shell.console import draft_hint, grouped
from pipeline.shell.profile.samples import open_sample

NOTHING = 1e-15
"""Largest magnitude [SI] of a rounding error of 0."""

STEP_ROWS, STEP_TOLERANCE = 3, 0.1
"""Number of rows from the step whose median is its size (a single row may be noisy, later ones include the velocity
filter), and allowed relative difference: a header often states a round number."""

PLAUSIBLE: dict[str, dict[Kind, tuple[float, float]]] = {
    "stiffness": {"translation": (1.0, 1e6), "rotation": (1e-2, 1e5)},
    "damping": {"translation": (1e-2, 1e4), "rotation": (1e-4, 1e3)},
    "step": {"translation": (1e-2, 1e3), "rotation": (1e-4, 1e3)},
    "sampling_period_s": dict.fromkeys(("translation", "rotation"), (2e-5, 0.1)),
    "displacement": {"translation": (1e-6, 1.0), "rotation": (1e-6, 1e5)},
    "duration_s": dict.fromkeys(("translation", "rotation"), (5e-3, 1e3)),
}
"""Plausible range of each quantity in SI: fingers and arms, drives of 1 W to 1 kW; 0 means absent."""


IS_UNUSUAL = "is its unit right?"
"""End of the sentence about an implausible number."""

Checked = dict[str, Any]
"""Result of checking a sample: ``path``; its ``trials``, or the ``reason`` why it would be refused, with the ``row``.

``conditions`` of a trial have ``name``, ``value``, ``unit``, the ``place`` of the profile (or the header) that gives
it, and the ``usual`` range of devices; displacement and duration are of the samples. ``columns`` have the SI name
``column``, its ``source`` and ``unit`` in the file, and ``first`` and ``last`` value in ``unit_si``. ``time`` has the
flags of `pipeline.readers.log.step_flags` and the repairs of rows. ``step_row`` is the row of the step, counted from 0,
``step`` its source, or why it is unknown. ``gain_mismatch`` states the stiffness, damping or step that the command
obeys if the conditions state others, and the line that corrects them; ``followed_gains`` has their numbers in SI.
"""


def check_samples(profile: Profile, samples: Sequence[Path]) -> list[Checked]:
    """Read samples (files or folders) as `pipeline ingest --profile` would; return one result per log.

    Raises
    ------
    UsageError
        If a path does not exist.
    """
    motions = {name: device.motion for name, device in known_devices().items()}
    checked = list[Checked]()
    asked = asked_profiles(profile, samples)
    (profile,) = asked.profiles
    for source in find_sources(samples, asked.profiles, ignore=asked.ignore):
        try:
            name = source.files[0].name if source.files else source.path.name
            if not profile.claims(name) and profile.log_of_partner(source.path) is None:
                found = f"the name fits none of files = {list(profile.files)} of profile {profile.name}"
                raise refusal("no-profile", "", found, cure="Correct `files`, or rename the log.")
            _, raw, outcome = logs_of(source)
            trials = [_trial(profile, raw.names[0], log, motion_of(log, motions)) for log in outcome]
            checked.append({"path": str(source.path), "trials": trials, "reason": None, "row": None})
        except LogError as error:
            checked.append({"path": str(source.path), "trials": [], "reason": error.reason, "row": error.row})
    return checked


def _trial(profile: Profile, name: str, log: Log, motion: Motion) -> Checked:
    (flags,) = step_flags(log.time, np.array([len(log.time)]), np.array([log.header.sampling_period_s]))
    step_row, step = step_of(log)
    conditions = list(_conditions(profile, name, log, motion))
    return {
        "label": log.label,
        "conditions": conditions,
        "rows": len(log.time),
        "columns": list(_columns(profile, log, motion)),
        "time": flags | dict(log.counts),
        "step_row": step_row,
        "step": step,
        "other_gains": gain_mismatch(profile, log),
        "obeyed": found.found if (found := followed_gains(log)) is not None else {},
        "findings": [finding.document for finding in log.findings],
        "warnings": [
            *log.warnings,
            *(each.sentence for each in log.findings),
            *filter(None, (c.pop("fault") for c in conditions)),
            *_other_step(log, step_row),
            *_other_kind(profile, log),
        ],
    }


def _conditions(profile: Profile, name: str, log: Log, motion: Motion) -> Iterator[dict[str, Any]]:
    if profile.format == "native":
        places = dict.fromkeys(CONDITIONS, "header")
    else:
        part = next((step for step in profile.steps if step.label == log.label), None)
        places = {key: place for key, (place, _) in statements(profile, name, (entry_of(profile, name), part)).items()}
    units = {key: si_unit(quantity(key, motion)) for key in CONDITION_QUANTITIES}
    units |= {"displacement": si_unit(quantity("position", motion)), "duration_s": "s"}
    samples = {"displacement": float(np.ptp(log.position)), "duration_s": float(np.ptp(log.time))}
    for key, value in ({k: getattr(log.header, k) for k in CONDITIONS} | {"motion": motion} | samples).items():
        place = "samples" if key in samples else places.get(key, "default")
        usual, fault = "", ""
        if key in PLAUSIBLE and not (drive_of(motion) and key in FREE):  # nothing is known about a drive
            low, high = PLAUSIBLE[key]["rotation" if is_rotation(motion) else "translation"]
            usual = f"{low:g} to {high:g}"
            if value and not low <= abs(value) <= high:
                fault = f"{key} is {value:.4g} [SI]; devices have {usual}: {IS_UNUSUAL}"
        yield {"name": key, "value": value, "unit": units.get(key, ""), "place": place, "usual": usual, "fault": fault}


def _columns(profile: Profile, log: Log, motion: Motion) -> Iterator[dict[str, Any]]:
    for key in ("time", "command", "position", "force", "velocity"):
        if (values := getattr(log, key)) is None:
            continue
        unit, source = si_unit(quantity(key, motion)), profile.column_sources().get(key)
        given = {"name": key, "unit": unit} if source is None else source.model_dump(exclude_defaults=True)
        name = given.pop("name", given.pop("column", "no column"))
        how = [given.pop("unit", ""), *(f"{k} {v}" for k, v in given.items() if (k, v) != ("sign", 1))]
        ends = {"first": float(values[0]), "last": float(values[-1]), "unit_si": unit}
        ends |= {"low": float(values.min()), "high": float(values.max())}
        yield {"column": key, "source": str(name), "unit": ", ".join(filter(None, how)), **ends}


def step_of(log: Log) -> tuple[int | None, str]:
    """Return the row of the step of a log (None if unknown), and its source or the reason why it is unknown."""
    header = log.header
    if "step_row" in header.extra:
        row = int(header.extra["step_row"])
        return row, f"declared, at {log.time[row]:.9g} s"
    trial = _trial_of(log)
    if header.step == 0 and (release := find_release(trial)).kind:
        what = {"release": "released", "hit": "hit"}[release.kind]
        return release.begin, f"none: the device is {what} at {log.time[release.begin]:.9g} s"
    edge = find_edge(trial)
    if edge.row == NO_ROW:
        return None, edge.reason
    return edge.row, f"found in the command, at {log.time[edge.row]:.9g} s"


def _trial_of(log: Log) -> Trial:
    header = log.header
    wall = header.stiffness, header.damping, header.step, header.sampling_period_s
    return Trial("sample", *wall, log.time, log.command, log.position)


def _other_kind(profile: Profile, log: Log) -> Iterator[str]:
    """Yield a problem if a log declared as a release or a hit shows the other kind, or neither."""
    if profile.kind not in ("release", "hit"):
        return
    found = find_release(_trial_of(log))
    if found.kind and found.kind != profile.kind:
        yield f"kind is {profile.kind!r}, but the log shows a {found.kind}: which is right?"
    elif not found.kind:
        yield f"kind is {profile.kind!r}, but no free motion is seen ({found.reason}), so that there will be no verdict"


def _other_step(log: Log, step_row: int | None) -> Iterator[str]:
    """Yield a problem if the command jumps by another step than stated; rows are counted from 0."""
    step = log.header.step
    if step_row is None or step == 0:
        return
    before = log.command[:step_row] if step_row else np.zeros(1)
    jump = float(np.median(log.command[step_row : step_row + STEP_ROWS]) - np.median(before))
    # noise before the step, passed through the velocity filter, determines the accuracy of the jump
    if abs(jump - step) > STEP_TOLERANCE * abs(step) + float(np.ptp(before)):
        yield f"the command jumps by {jump:.4g} in row {step_row}, but the step is {step:.4g}: which is right?"


def check_lines(samples: Sequence[Checked]) -> list[str]:
    """Return samples as lines of text: the first readable one in full, one line for each other."""
    lines, told, others, refused = list[str](), [], [], []
    for sample in samples:
        path, trials = sample["path"], sample["trials"]
        if sample["reason"] is not None:
            place = path if sample["row"] is None else f"{path}, row {sample['row']}"
            refused.append((place, f"would be refused: {sample['reason']}"))
            continue
        line = f"{path}: {counted(len(trials), 'trial')} would be stored"
        if lines:
            value = {condition["name"]: condition["value"] for condition in trials[0]["conditions"]}
            row = trials[0]["step_row"]
            step = "no step is known" if row is None else f"{'step' if value['step'] else 'it moves'} in row {row}"
            line += f"; K = {value['stiffness']:.9g}, B = {value['damping']:.9g}, {trials[0]['rows']} rows, {step}"
        lines += [line] if lines else [line, *map(_full, trials)]
        told += [(path, text) for trial in trials for text in trial["warnings"]]
        others += [(path, trial["other_gains"]) for trial in trials if trial["other_gains"]]
    warnings = [f"warning: {line}" for line in grouped(told)]
    return [*lines, *warnings, *grouped(refused), *(f"error: {line}" for line in grouped(others))]


def _full(trial: Checked) -> str:
    lines = [] if trial["label"] is None else [f"trial {trial['label']!r}"]
    for c in trial["conditions"]:
        text = c["value"] if isinstance(c["value"], str) else f"{c['value']:.9g} {c['unit']}"
        usual = f"usual {c['usual']}" if c["usual"] else ""
        lines.append(f"  {c['name']:<20} {text:<20} from {c['place']:<19} {usual}".rstrip())
    for c in trial["columns"]:
        # print a rounding error of 0, or -0, as 0
        first, last, low, high = (c[end] if abs(c[end]) > NOTHING else 0.0 for end in ("first", "last", "low", "high"))
        span = f"{first:.9g} to {last:.9g} {c['unit_si']}"
        if (low, high) != (min(first, last), max(first, last)):
            span += f" ({low:.4g} to {high:.4g})"
        lines.append(f"  {c['column']:<20} {span:<32} from {c['source']} [{c['unit']}]")
    settled = ", ".join(f"{key} {value:.6g}" for key, value in trial["time"].items() if value and abs(value) > NOTHING)
    row = "not known" if trial["step_row"] is None else f"row {trial['step_row']}"
    for key, text in (("rows", str(trial["rows"])), ("quality of time", settled), ("step", f"{row}: {trial['step']}")):
        lines.append(f"  {key:<20} {text}")
    return "\n".join(lines)


MOST_COLUMNS = 24
"""Largest number of drawn columns of a file without a profile; a bag has hundreds."""

MOST_TRIALS = 12
"""Largest number of drawn trials of one file."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Picture of a log: its name, the columns of each of its trials by title, remarks, and the horizontal axis."""

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
        Profile that reads it; by default the shipped ones are tried. A file that none of them reads is shown as
        recorded.

    Raises
    ------
    UsageError
        If the path does not exist or contains several logs.
    LogError
        If the profile refuses the log, or no columns of numbers are found in it.
    """
    sources = find_sources([log], asked_profiles(profile, [log]).profiles)
    if len(sources) != 1:
        raise UsageError(f"{log}: expected one log, found {len(sources)}. Give a single file.")
    (source,) = sources
    try:
        claimant, _, outcome = logs_of(source)
    except LogError as error:
        row = "" if error.row is None else f", row {error.row}"
        if profile is not None:
            raise error.reworded(f"{log}{row}: {error.reason}") from error
        notes = [f"Shown as it stands; `pipeline ingest` would refuse it{row}: {error.reason.split('. ')[0]}."]
        notes += [draft_hint(str(log))] if error.code in OTHER_COLUMNS else []
        return Picture(str(log), (_as_it_stands(log),), tuple(notes), "row")
    notes = [f"Read by profile {claimant.name}, in SI."]
    if len(outcome) > MOST_TRIALS:
        notes.append(f"The file contains {len(outcome)} trials; the first {MOST_TRIALS} are shown.")
    motions = {name: device.motion for name, device in known_devices().items()}
    trials = []
    for one in outcome[:MOST_TRIALS]:
        title, columns, said = _drawn(one, motion_of(one, motions))
        trials.append((title, columns))
        notes += [f"{title}: {text}" for text in said]
    return Picture(str(log), tuple(trials), tuple(notes), "time [s]")


def _drawn(log: Log, motion: Motion) -> tuple[str, tuple[RecordedColumn, ...], list[str]]:
    """Return the title of a trial, its columns, the source of its step, and other remarks."""
    row, how = step_of(log)
    columns = tuple(
        _column(key, si_unit(quantity(key, motion)), log.time, values, log.time, row)
        for key in ("command", "position", "force", "velocity")
        if (values := getattr(log, key)) is not None
    )
    moved = "step" if log.header.step else "it moves"
    said = f"{moved} in row {row}" if row is not None else "no step is known"
    title = f"trial {log.label}" if log.label else f"K = {log.header.stiffness:g}, B = {log.header.damping:g}"
    return title, columns, [f"{said} ({how})", *log.warnings, *(each.sentence for each in log.findings)]


def _as_it_stands(log: Path) -> tuple[str, tuple[RecordedColumn, ...]]:
    """Return the numeric columns of an unknown file."""
    sample = open_sample(log)
    columns = dict(islice(sample.numbers.items(), MOST_COLUMNS))
    # a column that increases in every row is a clock or a counter: its gaps are those of the log
    clock = next((values for values in columns.values() if (np.diff(values) > 0).all()), None)
    return sample.name, tuple(
        _column(name, sample.contents.hints.get(name, ""), rows, values, rows if clock is None else clock, None)
        for name, values in columns.items()
        for rows in [np.arange(len(values), dtype=np.float64)]
    )


def _column(name: str, unit: str, place: Floats, values: Floats, time: Floats, step_row: int | None) -> RecordedColumn:
    found = tuple(jumps(values).tolist()), tuple(rests(values)), tuple(gaps(time).tolist())
    return RecordedColumn(name, unit, place, values, *found, step_row)


def page(picture: Picture) -> str:
    """Return the page of a log."""
    drawn = []
    for number, (title, columns) in enumerate(picture.trials):
        panels = draw(recorded_figure(f"log-{number}", title, columns, picture.abscissa)).panels
        drawn.append((title, list(zip(panels, (column.words for column in columns), strict=True))))
    return fill_template("log.html.j2", picture=picture, drawn=drawn, version=__version__)


def document(picture: Picture) -> dict[str, Any]:
    """Return the findings on a log as a JSON document."""
    trials = []
    for title, columns in picture.trials:
        found = [{"name": c.name, "unit": c.unit, "jumps": c.jumps, "rests": c.rests} for c in columns]
        known = {"rows": len(columns[0].values), "step_row": columns[0].step_row, "gaps": columns[0].gaps}
        trials.append({"title": title, **known, "columns": found})
    return {"log": picture.log, "trials": trials, "notes": picture.notes}
