"""What a profile would read of sample files: conditions and where each comes from, columns in SI, time, step, warnings
where a log reads without a fault and yet speaks against its profile.

Nothing is stored. A file that would be refused is shown with the reason that `pipeline ingest` would give.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.base.errors import LogError
from pipeline.base.units import UNITS, find_unit, unit_between, unit_in_heading
from pipeline.device_data.devices import known_devices
from pipeline.intake.reading import logs_of, motion_of
from pipeline.intake.sources import find_sources
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.signal.lag import lags_of
from pipeline.measured.signal.response import NO_ROW, external_force, find_response
from pipeline.measured.signal.wall_law import SCALE_TOLERANCE, Scale, power_of_ten, scale_of
from pipeline.profiles.profile_columns import QUANTITIES, ColumnSource, PositionSource, TimeSource
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, CONDITIONS, Profile
from pipeline.readers import Log, RawLog
from pipeline.readers.conditions import entry_of, places_of
from pipeline.readers.frame import ColumnInfo
from pipeline.readers.mapping import format_module
from pipeline.readers.time_axis import step_flags
from pipeline.records.batch import TrialBatch
from pipeline.records.findings import Record
from pipeline.records.models import Motion
from pipeline.shell.console import grouped

FIRST_MOTION = 0.05
"""Part of the largest excursion from which on the first motion after the step counts: above the quantum of coarse
sensors, below the first swing."""

STEP_ROWS = 3
"""Rows from the step on whose median is its size: one may flicker, and later ones may bear the filter of a velocity."""

STEP_TOLERANCE = 0.1
"""Part of the step by which its size may differ: a round number stands for what the controller commands."""

NOTHING = 1e-15
"""Size [SI] up to which a number is what rounding leaves of 0."""

SHORT = 3
"""Trials of one file that are told in its line."""

LEAST_LAG = 0.5
"""Lag of a velocity in sampling periods that any difference of two positions has."""


class CheckedCondition(Record):
    """A condition of a trial: value in SI, and the place of the profile (or the header) that gives it."""

    name: str
    value: float | str
    unit: str
    place: str


class CheckedColumn(Record):
    """A column of a trial: name and unit in the file, first and last value in SI, what the file says of its unit."""

    column: str
    source: str
    unit: str
    first: float
    last: float
    unit_si: str
    file_says: str = ""


class CheckedTrial(Record):
    """A trial that would be stored.

    ``time`` holds the flags of `pipeline.readers.time_axis.step_flags` and what was settled in the rows. ``step_row``
    is the row of the step, counted from 0, ``step`` how it is known, or why it is not. ``scale`` are the factors by
    which step and wall in the command are other than the conditions say; None where the log does not show them.
    """

    label: str | None
    conditions: tuple[CheckedCondition, ...]
    rows: int
    columns: tuple[CheckedColumn, ...]
    time: dict[str, float | int | None]
    step_row: int | None
    step: str
    scale: tuple[float, float] | None
    warnings: tuple[str, ...]


class CheckedSample(Record):
    """A sample file: its trials, or the reason why it would be refused, with the row."""

    path: str
    trials: tuple[CheckedTrial, ...] = ()
    reason: str | None = None
    row: int | None = None


def check_samples(profile: Profile, samples: Sequence[Path]) -> list[CheckedSample]:
    """Read samples as `pipeline ingest --profile` would, and show what is found.

    Parameters
    ----------
    profile : Profile
    samples : sequence of Path
        Files, and folders that are searched.

    Returns
    -------
    list of CheckedSample
        One a log, in order of path.

    Raises
    ------
    UsageError
        If a path does not exist.
    """
    motions = {name: device.motion for name, device in known_devices().items()}
    checked = []
    for source in find_sources(samples, (profile,)):
        try:
            name = source.files[0].name if source.files else source.path.name
            if not profile.claims(name) and profile.log_of_partner(source.path) is None:
                raise LogError(
                    f"the name fits none of files = {list(profile.files)} of profile {profile.name}, so that "
                    "`pipeline ingest` would not read it so. Correct `files`, or rename the log.",
                    code="no-profile",
                )
            _, raw, outcome = logs_of(source)
            hints = _hints(profile, raw)
            trials = tuple(_trial(profile, raw.names[0], log, motion_of(log, motions), hints) for log in outcome)
            checked.append(CheckedSample(path=str(source.path), trials=trials))
        except LogError as error:
            checked.append(CheckedSample(path=str(source.path), reason=error.reason, row=error.row))
    return checked


def _hints(profile: Profile, raw: RawLog) -> dict[str, str]:
    """Return what the file says of its columns, by name and by position."""
    if profile.format in ("native", "json"):  # they say nothing of columns
        return {}
    try:
        infos = [info for data, name in zip(raw.data, raw.names, strict=True) for info in _infos(profile, name, data)]
    except LogError:  # what is not asked for may be damaged
        return {}
    by_position = {str(i + 1): info.hint for i, info in enumerate(infos)} if profile.format == "delimited" else {}
    return by_position | {info.name: info.hint for info in infos}


def _infos(profile: Profile, name: str, data: bytes) -> list[ColumnInfo]:
    infos: list[ColumnInfo] = format_module(profile).list_columns(name, data, profile)
    return infos


def _trial(profile: Profile, name: str, log: Log, motion: Motion, hints: dict[str, str]) -> CheckedTrial:
    rows = np.array([len(log.time)])
    (flags,) = step_flags(log.time, rows, np.array([log.header.sampling_period_s]))
    batch = _batch(log)
    step_row, step = _step(log, batch)
    columns = tuple(_columns(profile, log, motion, hints))
    said = {column.column: column.file_says for column in columns}
    return CheckedTrial(
        label=log.label,
        conditions=_conditions(profile, name, log, motion),
        rows=len(log.time),
        columns=columns,
        time=flags | dict(log.counts),
        step_row=step_row,
        step=step,
        scale=None if (scale := scale_of(batch)) is None else (scale.step, scale.wall),
        warnings=(*log.warnings, *other_units(profile, said), *other_step(log, step_row, batch), *late_velocity(batch)),
    )


def _conditions(profile: Profile, name: str, log: Log, motion: Motion) -> tuple[CheckedCondition, ...]:
    places: dict[str, str] = {}
    if profile.format != "native":
        part = next((step for step in profile.steps if step.label == log.label), None)
        places = places_of(profile, name, entry_of(profile, name), part)
    found = []
    for key in CONDITIONS:
        quantities = CONDITION_QUANTITIES.get(key)
        unit = si_unit(quantities[motion]) if quantities else ""
        place = places.get(key, "header" if profile.format == "native" else "default")
        found.append(CheckedCondition(name=key, value=getattr(log.header, key), unit=unit, place=place))
    place = "constants" if "motion" in profile.constants.model_fields_set else "default"
    place = "header" if profile.format == "native" and log.header.motion else place
    return (*found, CheckedCondition(name="motion", value=motion, unit="", place=place))


def _columns(profile: Profile, log: Log, motion: Motion, hints: dict[str, str]) -> list[CheckedColumn]:
    sources = profile.column_sources()
    columns = []
    for key in ("time", "command", "position", "force", "velocity"):
        values = getattr(log, key)
        if values is None:
            continue
        source, unit = sources.get(key), si_unit(QUANTITIES[key][motion])
        name, written = (key, unit) if source is None else (source.key, source.unit or "")
        if isinstance(source, TimeSource) and not source.has_stamps:
            name, written = "(one row each sampling period)", ""
        if isinstance(source, ColumnSource):
            stands = f", stands for {source.stands_for}" if source.stands_for else ""
            if isinstance(source, PositionSource) and source.integrate:
                written += f", integrated ({source.integrate})"
            written += stands + (", sign -1" if source.sign == -1 else "")
        if source is not None and source.counts_per_unit is not None:
            written = f"counts, {source.counts_per_unit:g} a {written}"
        columns.append(
            CheckedColumn(
                column=key,
                source=name,
                unit=written,
                first=float(values[0]),
                last=float(values[-1]),
                unit_si=unit,
                file_says=hints.get(name, ""),
            )
        )
    return columns


def _batch(log: Log) -> TrialBatch:
    header = log.header
    return TrialBatch(
        ("sample",),
        stiffness=np.array([header.stiffness]),
        damping=np.array([header.damping]),
        step=np.array([header.step]),
        sampling_period_s=np.array([header.sampling_period_s]),
        rows=np.array([len(log.time)]),
        time=log.time[None],
        command=log.command[None],
        position=log.position[None],
        velocity=None if log.velocity is None else log.velocity[None],
        integrated=np.array([log.header.extra.get("integrated") == "trapezoid"]),
    )


def step_of(log: Log) -> tuple[int | None, str]:
    """Return the row of the step of a log, None where it is not known, and how it is known or why not."""
    return _step(log, _batch(log))


def _step(log: Log, batch: TrialBatch) -> tuple[int | None, str]:
    """Return the row of the step, and how it is known."""
    if "step_row" in log.header.extra:
        row = int(log.header.extra["step_row"])
        return row, f"declared, at {log.time[row]:.9g} s"
    found = find_response(batch)
    row = int(found.edge_row[0])
    if row == NO_ROW:
        return None, found.edge_reason[0]
    return row, f"found in the command, at {log.time[row]:.9g} s"


def si_unit(quantity: str) -> str:
    """Return the SI unit of a physical quantity (`pipeline.base.units`).

    >>> si_unit("rotational stiffness")
    'Nm/rad'
    """
    return next(symbol for symbol, unit in UNITS.items() if unit.quantity == quantity and unit.factor == 1.0)


def check_lines(profile: Profile, samples: Sequence[CheckedSample]) -> list[str]:
    """Return samples as lines for a reader: the first that is read in full, of the others a line each."""
    read = [sample for sample in samples if sample.reason is None]
    lines = _full_lines(read[0]) if read else []
    for sample in read[1:]:
        lines.append(f"{sample.path}: {_stored_words(sample)}; {'; '.join(map(_short, sample.trials[:SHORT]))}")
    told = [(sample.path, text) for sample in read[1:] for trial in sample.trials for text in trial.warnings]
    lines += [f"warning: {line}" for line in grouped(told)]
    rows = {sample.path: "" if sample.row is None else f", row {sample.row}" for sample in samples}
    refused = ((sample.path + rows[sample.path], sample.reason) for sample in samples if sample.reason is not None)
    lines += grouped((place, f"would be refused: {reason}") for place, reason in refused)
    return lines + [f"warning: {text}" for text in other_scale(profile, samples)]


def _stored_words(sample: CheckedSample) -> str:
    return f"{'1 trial' if len(sample.trials) == 1 else f'{len(sample.trials)} trials'} would be stored"


def _short(trial: CheckedTrial) -> str:
    value = {condition.name: condition.value for condition in trial.conditions}
    step = "no step is known" if trial.step_row is None else f"step in row {trial.step_row}"
    return f"K = {value['stiffness']:.9g}, B = {value['damping']:.9g}, {trial.rows} rows, {step}"


def _full_lines(sample: CheckedSample) -> list[str]:
    lines = [f"{sample.path}: {_stored_words(sample)}"]
    for trial in sample.trials:
        if trial.label is not None:
            lines.append(f"trial {trial.label!r}")
        for condition in trial.conditions:
            value = condition.value if isinstance(condition.value, str) else f"{condition.value:.9g}"
            lines.append(f"  {condition.name:<20} {f'{value} {condition.unit}'.strip():<20} from {condition.place}")
        for column in trial.columns:
            said = f" (the file says {column.file_says})" if column.file_says else ""
            origin = f"{column.source} [{column.unit}]{said}" if column.unit else f"{column.source}{said}"
            values = f"{_shown(column.first):.9g} to {_shown(column.last):.9g} {column.unit_si}"
            lines.append(f"  {column.column:<20} {values:<32} from {origin}")
        settled = {key: value for key, value in trial.time.items() if value and abs(value) > NOTHING}
        lines.append(f"  {'rows':<20} {trial.rows}")
        times = ", ".join(f"{key} {value:.6g}" for key, value in settled.items())
        lines.append(f"  {'quality of time':<20} {times}")
        lines.append(
            f"  {'step':<20} {'not known' if trial.step_row is None else f'row {trial.step_row}'}: {trial.step}"
        )
        lines += [f"  {'warning':<20} {text}" for text in trial.warnings]
    return lines


def _shown(value: float) -> float:
    """Return a number without what rounding leaves of 0, and without its sign."""
    return value if abs(value) > NOTHING else 0.0


def check_document(profile: Profile, samples: Sequence[CheckedSample]) -> dict[str, object]:
    """Return what was found as a JSON document."""
    refused = sum(sample.reason is not None for sample in samples)
    dumped = [json.loads(sample.model_dump_json()) for sample in samples]
    return {"profile": profile.name, "samples": dumped, "refused": refused, "warnings": other_scale(profile, samples)}


def other_units(profile: Profile, said: Mapping[str, str]) -> list[str]:
    """Return where a file states another unit than the profile.

    Parameters
    ----------
    profile : Profile
    said : mapping of str to str
        Unit that the file states of each SI column; where it is empty, what stands behind the column's name is read.
    """
    found = []
    for key, source in profile.column_sources().items():
        if source.unit is None:
            continue
        stated = said.get(key) or unit_in_heading(source.key, QUANTITIES[key].values())[1]
        if (unit := find_unit(stated)) is not None and unit != find_unit(source.unit):
            found.append(f"columns.{key}.unit is {source.unit!r}, but the file says {stated!r}: which is right?")
    return found


def other_scale(profile: Profile, samples: Sequence[CheckedSample]) -> list[str]:
    """Return which unit or sign all commands speak against, held against the wall law F - K (x - x_0) - B v.

    Parameters
    ----------
    profile : Profile
    samples : sequence of CheckedSample
        Those that do not show the wall do not count.
    """
    found = [trial.scale for sample in samples for trial in sample.trials if trial.scale is not None]
    if not found:
        return []
    step, wall = np.median(np.array(found), axis=0)
    for each in found:
        if np.abs(np.array(each) / (step, wall) - 1).max() > SCALE_TOLERANCE:
            return []
    return _scale_words(profile, Scale(float(step), float(wall)), f"all {len(found)} logs that show it")


def _scale_words(profile: Profile, scale: Scale, where: str) -> list[str]:
    found = []
    if scale.step < 0 and scale.wall < 0:
        found.append("has the sign reversed: columns.command.sign is probably wrong")
    elif scale.wall < 0:
        found.append("has K (x_0 - x) - B v with the sign reversed: columns.position.sign is probably wrong")
    elif scale.step < 0:
        found.append("has the step with the sign reversed: the sign of the step is probably wrong")
    of_command = power_of_ten(scale.step) and abs(scale.wall / scale.step - 1) <= SCALE_TOLERANCE
    key, factor = ("command", 1 / abs(scale.step)) if of_command else ("position", abs(scale.wall))
    source = profile.column_sources().get(key)
    stated = "" if source is None else source.unit or ""
    unit = unit_between(stated, factor, SCALE_TOLERANCE)
    if unit is not None or power_of_ten(scale.wall):
        advice = "check the units of K, B and of both columns"
        if unit is not None:
            advice = f"the {key} is probably in {unit}, not in {stated}"
        found.append(f"is {abs(scale.wall):.3g} times K (x_0 - x) - B v beside the step: {advice}")
    return [f"the command {words} (so in {where})" for words in found]


def other_step(log: Log, step_row: int | None, batch: TrialBatch) -> list[str]:
    """Return where the command jumps by another step than the profile says, or the position goes against it.

    Parameters
    ----------
    log : Log
    step_row : int or None
        Row of the step, counted from 0; None where it is not known.
    batch : TrialBatch
        The same log.
    """
    step = log.header.step
    if step_row is None or step == 0:
        return []
    found = []
    force = external_force(batch)[0]
    before = force[:step_row] if step_row else np.zeros(1)
    jump = float(np.median(force[step_row : step_row + STEP_ROWS]) - np.median(before))
    # chatter before the step, fed through a filter of the velocity, shows how well the jump is known
    if abs(jump - step) > STEP_TOLERANCE * abs(step) + float(np.ptp(before)):
        found.append(f"the command jumps by {jump:.4g} in row {step_row}, but the step is {step:.4g}: which is right?")
    moved = (log.position[step_row:] - log.position[step_row]) * np.sign(step)
    # noise is seen before the step; a first motion that stands out of it tells the direction
    noise = float(np.ptp(log.position[: step_row + 1]))
    clear = np.flatnonzero(np.abs(moved) > max(2 * noise, FIRST_MOTION * float(np.abs(moved).max(initial=0.0))))
    if len(clear) and moved[clear[0]] < 0:
        found.append(
            "the position moves against the step at first: check the signs of columns.command, columns.position and of "
            "the step"
        )
    return found


def late_velocity(batch: TrialBatch) -> list[str]:
    """Return by how much the logged velocity of a sample is later than its position, where that is seen."""
    (found,) = lags_of(batch)
    lag, error = found.lag_s or 0.0, found.standard_error_s or 0.0
    if abs(lag) <= NORMAL_95 * error or abs(lag) <= LEAST_LAG * batch.sampling_period_s[0]:
        return []
    return [
        f"the logged velocity is {1e3 * lag:.3g} ms later than the position (± "
        f"{1e3 * NORMAL_95 * error:.2g}): a filter, or a reading of another time; no cost or estimate uses it"
    ]
