"""What a profile would read of sample files: conditions and where each comes from, columns in SI, time, step, warnings
where a log reads without a fault and yet speaks against its profile.

Nothing is stored. A file that would be refused is shown with the reason that `pipeline ingest` would give.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.base.errors import LogError
from pipeline.device_data.devices import known_devices
from pipeline.intake.reading import logs_of, motion_of
from pipeline.intake.sources import find_sources
from pipeline.measured.signal.response import NO_ROW, find_response
from pipeline.profiles.profile_columns import QUANTITIES, CommandSource, si_unit
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, CONDITIONS, Profile
from pipeline.readers import Log, RawLog
from pipeline.readers.conditions import entry_of, statements
from pipeline.readers.isolation import read_file
from pipeline.readers.obeyed import cure, obeyed
from pipeline.readers.time_axis import step_flags
from pipeline.records.batch import TrialBatch
from pipeline.records.findings import Record
from pipeline.records.models import Motion
from pipeline.shell.console import grouped
from pipeline.shell.profile.profile_warnings import PLAUSIBLE, facts, implausible, other_step, other_units

NOTHING = 1e-15
"""Size [SI] up to which a number is what rounding leaves of 0."""

SHORT = 3
"""Trials of one file that are told in its line."""


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
    is the row of the step, counted from 0, ``step`` how it is known, or why it is not. ``other_gains``
    says which stiffness, damping or step the command obeys where the conditions state others, and the line that cures
    it. ``plausible`` are the numbers that are held against what devices have (`profile_warnings.PLAUSIBLE`).
    """

    label: str | None
    conditions: tuple[CheckedCondition, ...]
    rows: int
    columns: tuple[CheckedColumn, ...]
    time: dict[str, float | int | None]
    step_row: int | None
    step: str
    other_gains: str | None
    plausible: tuple[tuple[str, float], ...]
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
        files = zip(raw.data, raw.names, strict=True)
        infos = [info for data, name in files for info in read_file(profile, (name,), (data,)).listed()]
    except LogError:  # what is not asked for may be damaged
        return {}
    by_position = {str(i + 1): info.hint for i, info in enumerate(infos)} if profile.format == "delimited" else {}
    return by_position | {info.name: info.hint for info in infos}


def _trial(profile: Profile, name: str, log: Log, motion: Motion, hints: dict[str, str]) -> CheckedTrial:
    (flags,) = step_flags(log.time, np.array([len(log.time)]), np.array([log.header.sampling_period_s]))
    step_row, step = step_of(log)
    columns = tuple(_columns(profile, log, motion, hints))
    said = {column.column: column.file_says for column in columns}
    other = obeyed(log)
    return CheckedTrial(
        label=log.label,
        conditions=_conditions(profile, name, log, motion),
        rows=len(log.time),
        columns=columns,
        time=flags | dict(log.counts),
        step_row=step_row,
        step=step,
        other_gains=None if other is None else f"{other.sentence}. To cure it: {cure(profile, other)}",
        plausible=tuple(facts(log).items()),
        warnings=(
            *log.warnings,
            *implausible(log, motion),
            *other_units(profile, said),
            *other_step(log, step_row),
        ),
    )


def _conditions(profile: Profile, name: str, log: Log, motion: Motion) -> tuple[CheckedCondition, ...]:
    native = profile.format == "native"
    part = next((step for step in profile.steps if step.label == log.label), None)
    stated = {} if native else statements(profile, name, (entry_of(profile, name), part))
    places = {key: place for key, (place, _) in stated.items()}
    moving = log.header.motion if native else "motion" in profile.constants.model_fields_set
    places |= {"motion": "header" if native else "constants"} if moving else {}
    units = {key: si_unit(quantities[motion]) for key, quantities in CONDITION_QUANTITIES.items()}
    values = {key: getattr(log.header, key) for key in CONDITIONS} | {"motion": motion}
    default = {key: "header" if native and key != "motion" else "default" for key in values}
    return tuple(
        CheckedCondition(name=key, value=value, unit=units.get(key, ""), place=(default | places)[key])
        for key, value in values.items()
    )


def _columns(profile: Profile, log: Log, motion: Motion, hints: dict[str, str]) -> Iterator[CheckedColumn]:
    for key in ("time", "command", "position", "force", "velocity"):
        values, unit, source = getattr(log, key), si_unit(QUANTITIES[key][motion]), profile.column_sources().get(key)
        if values is None:
            continue
        name, written = (key, unit) if source is None else (source.key, source.unit or "")
        if isinstance(source, CommandSource) and source.value is not None:
            start = f"row {source.from_row}" if source.from_s is None else f"{source.from_s:g} s"
            name = f"(stated: {source.value:g} from {start} on)"
        elif source is not None and not source.in_file:
            name, written = "(one row each sampling period)", ""
        rule, stands = getattr(source, "integrate", None), getattr(source, "stands_for", None)
        written += f", integrated ({rule})" if rule else ""
        written += f", stands for {stands}" if stands else ""
        written += ", sign -1" if getattr(source, "sign", 1) == -1 else ""
        if source is not None and source.counts_per_unit is not None:
            written = f"counts, {source.counts_per_unit:g} a {written}"
        first, last = float(values[0]), float(values[-1])
        yield CheckedColumn(
            column=key, source=name, unit=written, first=first, last=last, unit_si=unit, file_says=hints.get(name, "")
        )


def step_of(log: Log) -> tuple[int | None, str]:
    """Return the row of the step of a log, None where it is not known, and how it is known or why not."""
    if "step_row" in log.header.extra:
        row = int(log.header.extra["step_row"])
        return row, f"declared, at {log.time[row]:.9g} s"
    header = log.header
    batch = TrialBatch(
        ("sample",),
        stiffness=np.array([header.stiffness]),
        damping=np.array([header.damping]),
        step=np.array([header.step]),
        sampling_period_s=np.array([header.sampling_period_s]),
        rows=np.array([len(log.time)]),
        time=log.time[None],
        command=log.command[None],
        position=log.position[None],
    )
    found = find_response(batch)
    row = int(found.edge_row[0])
    if row == NO_ROW:
        return None, found.edge_reason[0]
    several = f"; it has {int(found.steps[0])} steps. Declare each by [[steps]] (label, from_s, to_s), or the first "
    several += "alone by window = { to_s = ... }"
    return row, f"found in the command, at {log.time[row]:.9g} s{several if found.steps[0] > 1 else ''}"


def check_lines(profile: Profile, samples: Sequence[CheckedSample]) -> list[str]:
    """Return samples as lines for a reader: the first that is read in full, of the others a line each."""
    read = [sample for sample in samples if sample.reason is None]
    lines = [line for trial in read[0].trials for line in _full_lines(trial)] if read else []
    for number, sample in enumerate(read):
        stored = "1 trial" if len(sample.trials) == 1 else f"{len(sample.trials)} trials"
        shown = "".join(f"; {_short(trial)}" for trial in sample.trials[:SHORT]) if number else ""
        lines.insert(len(lines) if number else 0, f"{sample.path}: {stored} would be stored{shown}")
    told = [(sample.path, text) for sample in read[1:] for trial in sample.trials for text in trial.warnings]
    lines += [f"warning: {line}" for line in grouped(told)]
    rows = {sample.path: "" if sample.row is None else f", row {sample.row}" for sample in samples}
    refused = ((sample.path + rows[sample.path], sample.reason) for sample in samples if sample.reason is not None)
    lines += grouped((place, f"would be refused: {reason}") for place, reason in refused)
    others = [(sample.path, trial.other_gains) for sample in read for trial in sample.trials if trial.other_gains]
    return lines + [f"error: {line}" for line in grouped(others)]


def _short(trial: CheckedTrial) -> str:
    value = {condition.name: condition.value for condition in trial.conditions}
    step = "no step is known" if trial.step_row is None else f"step in row {trial.step_row}"
    return f"K = {value['stiffness']:.9g}, B = {value['damping']:.9g}, {trial.rows} rows, {step}"


def _full_lines(trial: CheckedTrial) -> Iterator[str]:
    if trial.label is not None:
        yield f"trial {trial.label!r}"
    motion: Motion = "rotation" if any(c.value == "rotation" for c in trial.conditions) else "translation"
    length = next((column.unit_si for column in trial.columns if column.column == "position"), "")
    facts_ = dict(trial.plausible)
    rows = [(c.name, c.value, c.unit, f"from {c.place}") for c in trial.conditions]
    rows += [("displacement", facts_["displacement"], length, ""), ("duration_s", facts_["duration_s"], "s", "")]
    for key, value, unit, origin in rows:
        text = value if isinstance(value, str) else f"{value:.9g}" if origin else f"{value:.4g}"
        usual = "usual {:g} to {:g}".format(*PLAUSIBLE[key][motion]) if key in PLAUSIBLE else ""
        yield f"  {key:<20} {f'{text} {unit}'.strip():<20} {origin:<24} {usual}".rstrip()
    for column in trial.columns:
        said = f" (the file says {column.file_says})" if column.file_says else ""
        name = f"{column.source} [{column.unit}]{said}" if column.unit else f"{column.source}{said}"
        # neither what rounding leaves of 0, nor its sign
        first, last = (value if abs(value) > NOTHING else 0.0 for value in (column.first, column.last))
        yield f"  {column.column:<20} {f'{first:.9g} to {last:.9g} {column.unit_si}':<32} from {name}"
    settled = ", ".join(f"{key} {value:.6g}" for key, value in trial.time.items() if value and abs(value) > NOTHING)
    row = "not known" if trial.step_row is None else f"row {trial.step_row}"
    last_lines = [("rows", str(trial.rows)), ("quality of time", settled), ("step", f"{row}: {trial.step}")]
    yield from (f"  {key:<20} {text}" for key, text in [*last_lines, *(("warning", text) for text in trial.warnings)])


def check_document(profile: Profile, samples: Sequence[CheckedSample]) -> dict[str, object]:
    """Return what was found as a JSON document."""
    refused = sum(sample.reason is not None for sample in samples)
    return {"profile": profile.name, "samples": [s.model_dump(mode="json") for s in samples], "refused": refused}
