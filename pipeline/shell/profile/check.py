"""What a profile would read of sample files: conditions and where each comes from, columns in SI, time, step, warnings
where a log reads without a fault and yet speaks against its profile.

Nothing is stored. A file that would be refused is shown with the reason that `pipeline ingest` would give.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import LogError, refusal
from pipeline.base.wording import counted
from pipeline.device_data.devices import known_devices
from pipeline.intake.sources import find_sources, logs_of, motion_of
from pipeline.measured.signal.response import NO_ROW, find_response
from pipeline.profiles.profile_columns import QUANTITIES, si_unit
from pipeline.profiles.profile_model import CONDITION_QUANTITIES, CONDITIONS, Profile
from pipeline.readers import Log
from pipeline.readers.log import step_flags
from pipeline.readers.mapping import entry_of, statements
from pipeline.readers.obeyed import other_gains
from pipeline.records.batch import TrialBatch
from pipeline.records.models import Motion
from pipeline.shell.console import grouped

NOTHING = 1e-15
"""Size [SI] up to which a number is what rounding leaves of 0."""

FIRST_MOTION = 0.05
"""Part of the largest excursion from which on the first motion after the step counts: above the quantum of coarse
sensors, below the first swing."""

STEP_ROWS, STEP_TOLERANCE = 3, 0.1
"""Rows from the step on whose median is its size: one may flicker, and later ones may bear the filter of a velocity;
and part of the step by which it may differ: a round number stands for what the controller commands."""

PLAUSIBLE: dict[str, dict[Motion, tuple[float, float]]] = {
    "stiffness": {"translation": (1.0, 1e6), "rotation": (1e-2, 1e5)},
    "damping": {"translation": (1e-2, 1e4), "rotation": (1e-4, 1e3)},
    "step": {"translation": (1e-2, 1e3), "rotation": (1e-4, 1e3)},
    "sampling_period_s": dict.fromkeys(("translation", "rotation"), (2e-5, 0.1)),
    "displacement": {"translation": (1e-6, 1.0), "rotation": (1e-6, 100.0)},
    "duration_s": dict.fromkeys(("translation", "rotation"), (5e-3, 1e3)),
}
"""Range of each number in SI that devices have: fingers and arms, drives of a watt to a kilowatt; 0 is none."""


Checked = dict[str, Any]
"""What was found in a sample: ``path``; its ``trials``, or the ``reason`` why it would be refused, with the ``row``.

``conditions`` of a trial have ``name``, ``value``, ``unit``, the ``place`` of the profile (or the header) that gives
it, and what is ``usual`` of devices; displacement and duration are of the samples. ``columns`` have the SI name
``column``, its ``source`` and ``unit`` in the file, and ``first`` and ``last`` value in ``unit_si``. ``time`` holds
the flags of `pipeline.readers.log.step_flags` and what was settled in the rows. ``step_row`` is the row of the step,
counted from 0, ``step`` how it is known, or why it is not. ``other_gains`` says which stiffness, damping or step the
command obeys where the conditions state others, and the line that cures it.
"""


def check_samples(profile: Profile, samples: Sequence[Path]) -> list[Checked]:
    """Read samples (files, and folders that are searched) as `pipeline ingest --profile` would; return one a log.

    Raises
    ------
    UsageError
        If a path does not exist.
    """
    motions = {name: device.motion for name, device in known_devices().items()}
    checked = list[Checked]()
    for source in find_sources(samples, (profile,)):
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
        "other_gains": other_gains(profile, log),
        "warnings": [*log.warnings, *_implausible(conditions, motion), *_other_step(log, step_row)],
    }


def _conditions(profile: Profile, name: str, log: Log, motion: Motion) -> Iterator[dict[str, Any]]:
    if profile.format == "native":
        places = dict.fromkeys(CONDITIONS, "header")
    else:
        part = next((step for step in profile.steps if step.label == log.label), None)
        places = {key: place for key, (place, _) in statements(profile, name, (entry_of(profile, name), part)).items()}
    units = {key: si_unit(quantities[motion]) for key, quantities in CONDITION_QUANTITIES.items()}
    units |= {"displacement": si_unit(QUANTITIES["position"][motion]), "duration_s": "s"}
    samples = {"displacement": float(np.ptp(log.position)), "duration_s": float(np.ptp(log.time))}
    for key, value in ({k: getattr(log.header, k) for k in CONDITIONS} | {"motion": motion} | samples).items():
        place = "samples" if key in samples else places.get(key, "default")
        usual = "{:g} to {:g}".format(*PLAUSIBLE[key][motion]) if key in PLAUSIBLE else ""
        yield {"name": key, "value": value, "unit": units.get(key, ""), "place": place, "usual": usual}


def _implausible(conditions: Sequence[Checked], motion: Motion) -> Iterator[str]:
    """Yield which numbers of a log no device has, so that a unit may be wrong."""
    for c in conditions:
        low, high = PLAUSIBLE[c["name"]][motion] if c["usual"] else (0.0, np.inf)
        if c["usual"] and c["value"] and not low <= abs(c["value"]) <= high:
            yield f"{c['name']} is {c['value']:.4g} [SI]; devices have {c['usual']}: is its unit right?"


def _columns(profile: Profile, log: Log, motion: Motion) -> Iterator[dict[str, Any]]:
    for key in ("time", "command", "position", "force", "velocity"):
        if (values := getattr(log, key)) is None:
            continue
        unit, source = si_unit(QUANTITIES[key][motion]), profile.column_sources().get(key)
        given = {"name": key, "unit": unit} if source is None else source.model_dump(exclude_defaults=True)
        name = given.pop("name", given.pop("column", "no column"))
        how = [given.pop("unit", ""), *(f"{k} {v}" for k, v in given.items() if (k, v) != ("sign", 1))]
        ends = {"first": float(values[0]), "last": float(values[-1]), "unit_si": unit}
        yield {"column": key, "source": str(name), "unit": ", ".join(filter(None, how)), **ends}


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


def check_lines(samples: Sequence[Checked]) -> list[str]:
    """Return samples as lines for a reader: the first that is read in full, of the others a line each."""
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
            step = "no step is known" if (row := trials[0]["step_row"]) is None else f"step in row {row}"
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
        # neither what rounding leaves of 0, nor its sign
        first, last = (c[end] if abs(c[end]) > NOTHING else 0.0 for end in ("first", "last"))
        span = f"{first:.9g} to {last:.9g} {c['unit_si']}"
        lines.append(f"  {c['column']:<20} {span:<32} from {c['source']} [{c['unit']}]")
    settled = ", ".join(f"{key} {value:.6g}" for key, value in trial["time"].items() if value and abs(value) > NOTHING)
    row = "not known" if trial["step_row"] is None else f"row {trial['step_row']}"
    for key, text in (("rows", str(trial["rows"])), ("quality of time", settled), ("step", f"{row}: {trial['step']}")):
        lines.append(f"  {key:<20} {text}")
    return "\n".join(lines)
