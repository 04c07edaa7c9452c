"""Preview a profile on sample files, with conditions and their sources, columns in SI units, time, step, and warnings.

A warning is given for a log that can be read but contradicts the profile. Nothing is stored. If `pipeline ingest` would
refuse a file, the preview states the reason.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.base.errors import LogError, refusal
from pipeline.base.json_object import JsonObject
from pipeline.base.wording import counted
from pipeline.device.parameters import drive_of, is_rotation
from pipeline.device_data.devices import known_devices
from pipeline.intake.sources import find_sources, logs_of, motion_of, requested_profiles
from pipeline.measured.signal.release import find_release
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, CONDITIONS, Kind, Profile, quantity, si_unit
from pipeline.readers import Log
from pipeline.readers.gain_check import followed_gains, gain_mismatch
from pipeline.readers.log import step_flags
from pipeline.readers.mapping import entry_of, statements
from pipeline.records.models import Motion
from pipeline.records.native import OF_WALL
from pipeline.shell.console import grouped
from pipeline.surface.log_picture import step_of, trial_of

NOTHING = 1e-15
"""Largest magnitude [SI] of a number that is treated as a rounding error of 0."""

STEP_ROWS, STEP_TOLERANCE = 3, 0.1
"""Number of rows after the step over which the median of the command is computed, and allowed relative difference
between this jump and the header.

A single row may be noisy, and later rows include the effect of the velocity filter. A header often states a rounded
number.
"""

PLAUSIBLE: dict[str, dict[Kind, tuple[float, float]]] = {
    "stiffness": {"translation": (1.0, 1e6), "rotation": (1e-2, 1e5)},
    "damping": {"translation": (1e-2, 1e4), "rotation": (1e-4, 1e3)},
    "step": {"translation": (1e-2, 1e3), "rotation": (1e-4, 1e3)},
    "sampling_period_s": dict.fromkeys(("translation", "rotation"), (2e-5, 0.1)),
    "displacement": {"translation": (1e-6, 1.0), "rotation": (1e-6, 1e5)},
    "duration_s": dict.fromkeys(("translation", "rotation"), (5e-3, 1e3)),
}
"""Plausible range of each quantity in SI, for devices between finger and arm size with drives of 1 W to 1 kW. A value
of 0 means absent."""


IS_UNUSUAL = "check its unit"
"""End of the sentence about an implausible number."""

Checked = JsonObject
"""Result for a sample: its ``path`` and its ``trials``, or the ``reason`` and ``row`` with which it would be refused.

``conditions`` of a trial have ``name``, ``value``, ``unit``, the ``place`` (in the profile or the header) that gives
the condition, and the ``usual`` range of devices. Displacement and duration are computed from the samples. ``columns``
have the SI name ``column``, its ``source`` and ``unit`` in the file, and the ``first`` and ``last`` value in
``unit_si``. ``time`` has the flags of `pipeline.readers.log.step_flags` and the repairs of rows. ``step_row`` is the
row of the step, counted from 0. ``step`` is its source, or the reason why it is unknown. ``other_gains`` states the
stiffness, damping or step that the command follows if the conditions state other values, and the line that corrects the
conditions. ``obeyed`` has these gains in SI.
"""


def check_samples(profile: Profile, samples: Sequence[Path]) -> list[Checked]:
    """Read samples (files or folders) as `pipeline ingest --profile` would, and return one result for each log.

    Raises
    ------
    UsageError
        If a path does not exist.
    """
    motions = {name: device.motion for name, device in known_devices().items()}
    checked = list[Checked]()
    chosen = requested_profiles(profile, samples)
    (profile,) = chosen.profiles
    for source in find_sources(samples, chosen.profiles, ignore=chosen.ignore):
        try:
            name = source.files[0].name if source.files else source.path.name
            if not profile.claims(name) and profile.log_of_partner(source.path) is None:
                found = f"the name matches none of files = {list(profile.files)} of profile {profile.name}"
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


def _conditions(profile: Profile, name: str, log: Log, motion: Motion) -> Iterator[JsonObject]:
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
        if key == "motion" and profile.format != "native":
            place = "constants" if profile.constants.motion else "columns.position.unit"
        usual, fault = "", ""
        # No plausible ranges are known in units of a drive.
        if key in PLAUSIBLE and not (drive_of(motion) and key in OF_WALL):
            low, high = PLAUSIBLE[key]["rotation" if is_rotation(motion) else "translation"]
            usual = f"{low:g} to {high:g}"
            if value and not low <= abs(value) <= high:
                fault = f"{key} is {value:.4g} [SI]; devices have {usual}: {IS_UNUSUAL}"
        yield {"name": key, "value": value, "unit": units.get(key, ""), "place": place, "usual": usual, "fault": fault}


def _columns(profile: Profile, log: Log, motion: Motion) -> Iterator[JsonObject]:
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


def _other_kind(profile: Profile, log: Log) -> Iterator[str]:
    """Yield a problem if a log declared as a release shows a hit, or vice versa, or if it shows neither."""
    if profile.kind not in ("release", "hit"):
        return
    found = find_release(trial_of(log))
    if found.kind and found.kind != profile.kind:
        yield f"kind is {profile.kind!r}, but the log shows a {found.kind}. Check which of the two is right"
    elif not found.kind:
        yield f"kind is {profile.kind!r}, but no free motion was found ({found.reason}), so there will be no verdict"


def _other_step(log: Log, step_row: int | None) -> Iterator[str]:
    """Yield a problem if the jump of the command differs from the stated step. Rows are counted from 0."""
    step = log.header.step
    if step_row is None or step == 0:
        return
    before = log.command[:step_row] if step_row else np.zeros(1)
    jump = float(np.median(log.command[step_row : step_row + STEP_ROWS]) - np.median(before))
    # The accuracy of the jump is limited by noise, visible in the command before the step.
    if abs(jump - step) > STEP_TOLERANCE * abs(step) + float(np.ptp(before)):
        yield (
            f"the command jumps by {jump:.4g} in row {step_row}, but the stated step is {step:.4g}. Check which of the "
            "two is right"
        )


def check_lines(samples: Sequence[Checked]) -> list[str]:
    """Return samples as lines of text.

    The first readable sample is shown in full. Each of the other samples is shown on one line.
    """
    lines, found, others, refused = list[str](), [], [], []
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
            step = "the step is unknown" if row is None else f"{'step' if value['step'] else 'it moves'} in row {row}"
            line += f"; K = {value['stiffness']:.9g}, B = {value['damping']:.9g}, {trials[0]['rows']} rows, {step}"
        lines += [line] if lines else [line, *map(_full, trials)]
        found += [(path, text) for trial in trials for text in trial["warnings"]]
        others += [(path, trial["other_gains"]) for trial in trials if trial["other_gains"]]
    warnings = [f"warning: {line}" for line in grouped(found)]
    return [*lines, *warnings, *grouped(refused), *(f"error: {line}" for line in grouped(others))]


def _full(trial: Checked) -> str:
    lines = [] if trial["label"] is None else [f"trial {trial['label']!r}"]
    for c in trial["conditions"]:
        text = c["value"] if isinstance(c["value"], str) else f"{c['value']:.9g} {c['unit']}"
        usual = f"usual {c['usual']}" if c["usual"] else ""
        lines.append(f"  {c['name']:<20} {text:<20} from {c['place']:<19} {usual}".rstrip())
    for c in trial["columns"]:
        # Print a rounding error of 0, or -0, as 0.
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
