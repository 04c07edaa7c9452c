"""What a profile would read of sample files: conditions and where each comes from, columns in SI, time, step, warnings
where a log reads without a fault and yet speaks against its profile.

Nothing is stored. A file that would be refused is shown with the reason that `pipeline ingest` would give.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import LogError
from pipeline.base.units import find_unit, unit_in_heading
from pipeline.device_data.devices import known_devices
from pipeline.intake.reading import logs_of, motion_of
from pipeline.intake.sources import find_sources
from pipeline.measured.signal.response import NO_ROW, find_response
from pipeline.profiles.profile_columns import QUANTITIES, si_unit
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

NOTHING = 1e-15
"""Size [SI] up to which a number is what rounding leaves of 0."""

SHORT = 3
"""Trials of one file that are told in its line."""

FIRST_MOTION = 0.05
"""Part of the largest excursion from which on the first motion after the step counts: above the quantum of coarse
sensors, below the first swing."""

STEP_ROWS = 3
"""Rows from the step on whose median is its size: one may flicker, and later ones may bear the filter of a velocity."""

STEP_TOLERANCE = 0.1
"""Part of the step by which its size may differ: a round number stands for what the controller commands."""

PLAUSIBLE: dict[str, dict[Motion, tuple[float, float]]] = {
    "stiffness": {"translation": (1.0, 1e6), "rotation": (1e-2, 1e5)},
    "damping": {"translation": (1e-2, 1e4), "rotation": (1e-4, 1e3)},
    "step": {"translation": (1e-2, 1e3), "rotation": (1e-4, 1e3)},
    "sampling_period_s": {"translation": (2e-5, 0.1), "rotation": (2e-5, 0.1)},
    "displacement": {"translation": (1e-6, 1.0), "rotation": (1e-6, 100.0)},
    "duration_s": {"translation": (5e-3, 1e3), "rotation": (5e-3, 1e3)},
}
"""Range of each number in SI that devices have: fingers and arms, drives of a watt to a kilowatt; 0 is none."""


class CheckedTrial(Record):
    """A trial that would be stored.

    ``conditions`` have ``name``, ``value``, ``unit`` and the ``place`` of the profile (or the header) that gives it;
    ``columns`` the SI name ``column``, its ``source`` and ``unit`` in the file, ``first`` and ``last`` value in
    ``unit_si``, and what the file says of its unit. ``time`` holds the flags of `pipeline.readers.time_axis.step_flags`
    and what was settled in the rows. ``step_row`` is the row of the step, counted from 0, ``step`` how it is known, or
    why it is not. ``other_gains`` says which stiffness, damping or step the command obeys where the conditions state
    others, and the line that cures it. ``plausible`` are the numbers that are held against `PLAUSIBLE`.
    """

    label: str | None
    conditions: tuple[dict[str, Any], ...]
    rows: int
    columns: tuple[dict[str, Any], ...]
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
    """Read samples (files, and folders that are searched) as `pipeline ingest --profile` would; return one a log.

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
    facts = {key: float(getattr(log.header, key)) for key in list(PLAUSIBLE)[:4]}
    facts |= {"displacement": float(np.ptp(log.position)), "duration_s": float(np.ptp(log.time))}
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
        plausible=tuple(facts.items()),
        warnings=(
            *log.warnings,
            *_implausible(facts, motion),
            *_other_units(profile, {column["column"]: column["file_says"] for column in columns}),
            *_other_step(log, step_row),
        ),
    )


def _conditions(profile: Profile, name: str, log: Log, motion: Motion) -> tuple[dict[str, Any], ...]:
    native = profile.format == "native"
    places = dict.fromkeys(CONDITIONS, "header" if native else "default")
    places["motion"] = "default"
    if not native:
        part = next((step for step in profile.steps if step.label == log.label), None)
        places |= {key: place for key, (place, _) in statements(profile, name, (entry_of(profile, name), part)).items()}
    if log.header.motion if native else "motion" in profile.constants.model_fields_set:
        places["motion"] = "header" if native else "constants"
    units = {key: si_unit(quantities[motion]) for key, quantities in CONDITION_QUANTITIES.items()}
    values = {key: getattr(log.header, key) for key in CONDITIONS} | {"motion": motion}
    return tuple({"name": k, "value": v, "unit": units.get(k, ""), "place": places[k]} for k, v in values.items())


def _columns(profile: Profile, log: Log, motion: Motion, hints: dict[str, str]) -> Iterator[dict[str, Any]]:
    for key in ("time", "command", "position", "force", "velocity"):
        values, unit, source = getattr(log, key), si_unit(QUANTITIES[key][motion]), profile.column_sources().get(key)
        if values is None:
            continue
        name, written = (key, unit) if source is None else (source.key, source.unit or "")
        if source is not None and (value := getattr(source, "value", None)) is not None:
            row, seconds = getattr(source, "from_row", None), getattr(source, "from_s", None)
            name = f"(stated: {value:g} from {f'row {row}' if seconds is None else f'{seconds:g} s'} on)"
        elif source is not None and not source.in_file:
            name, written = "(one row each sampling period)", ""
        for part, words in (("integrate", ", integrated ({})"), ("stands_for", ", stands for {}")):
            written += words.format(said) if (said := getattr(source, part, None)) else ""
        written += ", sign -1" if getattr(source, "sign", 1) == -1 else ""
        if source is not None and source.counts_per_unit is not None:
            written = f"counts, {source.counts_per_unit:g} a {written}"
        ends = {"first": float(values[0]), "last": float(values[-1]), "unit_si": unit}
        yield {"column": key, "source": name, "unit": written, **ends, "file_says": hints.get(name, "")}


def step_of(log: Log) -> tuple[int | None, str]:
    """Return the row of the step of a log, None where it is not known, and how it is known or why not."""
    header = log.header
    if "step_row" in header.extra:
        row = int(header.extra["step_row"])
        return row, f"declared, at {log.time[row]:.9g} s"
    gains = {key: np.array([getattr(header, key)]) for key in ("stiffness", "damping", "step", "sampling_period_s")}
    samples = {key: getattr(log, key)[None] for key in ("time", "command", "position")}
    found = find_response(TrialBatch(("sample",), rows=np.array([len(log.time)]), **gains, **samples))
    row = int(found.edge_row[0])
    if row == NO_ROW:
        return None, found.edge_reason[0]
    several = f"; it has {int(found.steps[0])} steps. Declare each by [[steps]] (label, from_s, to_s), or the first "
    several += "alone by window = { to_s = ... }"
    return row, f"found in the command, at {log.time[row]:.9g} s{several if found.steps[0] > 1 else ''}"


def _implausible(facts: Mapping[str, float], motion: Motion) -> Iterator[str]:
    """Yield which numbers of a log no device has, so that a unit may be wrong."""
    for key, value in facts.items():
        low, high = PLAUSIBLE[key][motion]
        if value and not low <= abs(value) <= high:
            yield f"{key} is {value:.4g} [SI]; devices have {low:g} to {high:g}: is its unit right?"


def _other_units(profile: Profile, said: Mapping[str, str]) -> Iterator[str]:
    """Yield where a file states another unit than the profile: in its hints, else behind the name of the column."""
    for key, source in profile.column_sources().items():
        stated = said.get(key) or unit_in_heading(source.key, QUANTITIES[key].values())[1]
        if source.unit and (unit := find_unit(stated)) is not None and unit != find_unit(source.unit):
            yield f"columns.{key}.unit is {source.unit!r}, but the file says {stated!r}: which is right?"


def _other_step(log: Log, step_row: int | None) -> Iterator[str]:
    """Yield where the command jumps by another step, or the position goes against it; rows are counted from 0."""
    step = log.header.step
    if step_row is None or step == 0:
        return
    before = log.command[:step_row] if step_row else np.zeros(1)
    jump = float(np.median(log.command[step_row : step_row + STEP_ROWS]) - np.median(before))
    # chatter before the step, fed through a filter of the velocity, shows how well the jump is known
    if abs(jump - step) > STEP_TOLERANCE * abs(step) + float(np.ptp(before)):
        yield f"the command jumps by {jump:.4g} in row {step_row}, but the step is {step:.4g}: which is right?"
    moved = (log.position[step_row:] - log.position[step_row]) * np.sign(step)
    # noise is seen before the step; a first motion that stands out of it tells the direction
    noise = float(np.ptp(log.position[: step_row + 1]))
    clear = np.flatnonzero(np.abs(moved) > max(2 * noise, FIRST_MOTION * float(np.abs(moved).max(initial=0.0))))
    if len(clear) and moved[clear[0]] < 0:
        yield "the position moves against the step at first: check the signs of command, position and step"


def check_lines(samples: Sequence[CheckedSample]) -> list[str]:
    """Return samples as lines for a reader: the first that is read in full, of the others a line each."""
    read = [sample for sample in samples if sample.reason is None]
    lines = []
    for number, sample in enumerate(read):
        stored = "1 trial" if len(sample.trials) == 1 else f"{len(sample.trials)} trials"
        shown = "".join(f"; {_short(trial)}" for trial in sample.trials[:SHORT]) if number else ""
        lines.append(f"{sample.path}: {stored} would be stored{shown}")
        lines += [] if number else [line for trial in sample.trials for line in _full_lines(trial)]
    told = [(sample.path, text) for sample in read[1:] for trial in sample.trials for text in trial.warnings]
    lines += [f"warning: {line}" for line in grouped(told)]
    rows = {sample.path: "" if sample.row is None else f", row {sample.row}" for sample in samples}
    refused = ((sample.path + rows[sample.path], sample.reason) for sample in samples if sample.reason is not None)
    lines += grouped((place, f"would be refused: {reason}") for place, reason in refused)
    others = [(sample.path, trial.other_gains) for sample in read for trial in sample.trials if trial.other_gains]
    return lines + [f"error: {line}" for line in grouped(others)]


def _short(trial: CheckedTrial) -> str:
    value = {condition["name"]: condition["value"] for condition in trial.conditions}
    step = "no step is known" if trial.step_row is None else f"step in row {trial.step_row}"
    return f"K = {value['stiffness']:.9g}, B = {value['damping']:.9g}, {trial.rows} rows, {step}"


def _full_lines(trial: CheckedTrial) -> Iterator[str]:
    if trial.label is not None:
        yield f"trial {trial.label!r}"
    motion: Motion = "rotation" if any(c["value"] == "rotation" for c in trial.conditions) else "translation"
    found = dict(trial.plausible)
    rows = [(c["name"], c["value"], c["unit"], f"from {c['place']}") for c in trial.conditions]
    rows += [("displacement", found["displacement"], si_unit(QUANTITIES["position"][motion]), "")]
    rows += [("duration_s", found["duration_s"], "s", "")]
    for key, value, unit, origin in rows:
        text = value if isinstance(value, str) else f"{value:.9g}" if origin else f"{value:.4g}"
        usual = "usual {:g} to {:g}".format(*PLAUSIBLE[key][motion]) if key in PLAUSIBLE else ""
        yield f"  {key:<20} {f'{text} {unit}'.strip():<20} {origin:<24} {usual}".rstrip()
    for c in trial.columns:
        said = f" (the file says {c['file_says']})" if c["file_says"] else ""
        # neither what rounding leaves of 0, nor its sign
        first, last = (c[end] if abs(c[end]) > NOTHING else 0.0 for end in ("first", "last"))
        span, unit = f"{first:.9g} to {last:.9g} {c['unit_si']}", f" [{c['unit']}]" if c["unit"] else ""
        yield f"  {c['column']:<20} {span:<32} from {c['source']}{unit}{said}"
    settled = ", ".join(f"{key} {value:.6g}" for key, value in trial.time.items() if value and abs(value) > NOTHING)
    row = "not known" if trial.step_row is None else f"row {trial.step_row}"
    last_lines = [("rows", str(trial.rows)), ("quality of time", settled), ("step", f"{row}: {trial.step}")]
    yield from (f"  {key:<20} {text}" for key, text in [*last_lines, *(("warning", text) for text in trial.warnings)])


def check_document(profile: Profile, samples: Sequence[CheckedSample]) -> dict[str, object]:
    """Return what was found as a JSON document."""
    refused = sum(sample.reason is not None for sample in samples)
    return {"profile": profile.name, "samples": [s.model_dump(mode="json") for s in samples], "refused": refused}
