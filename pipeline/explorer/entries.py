"""Build the initial content of the explorer: loops, and measurements on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields

from pipeline.base.json_object import JsonObject
from pipeline.device.loop import Loop
from pipeline.device.parameters import drive_of
from pipeline.device.parts import Part, named
from pipeline.records.models import Device
from pipeline.records.results import ComparisonResult, ExperimentResult, LoopResult

Entry = JsonObject
"""Entry for the script of the page: ``label``, ``loop``, and measurements (`Entry` in page.mjs)."""

_LEFT_OUT = ("sensor", "constant_force", "force_limit")
"""Parts of a loop that the page neither uses nor writes to a device file."""


def loop_entries(loop: Loop) -> JsonObject:
    """Return a loop as the entries of a device file in SI units. Parts that the loop does not have are omitted.

    Examples
    --------
    >>> loop_entries(Loop(0.5, 4.0, 0.001, 2.0, operator={"mass": 0.1}))["operator"]
    {'mass': 0.1}
    """
    result: JsonObject = {}
    for field in fields(Loop):
        value = getattr(loop, field.name)
        if field.name in _LEFT_OUT or value is None or value == ():
            continue
        result[field.name] = named(value) if isinstance(value, Part) else value
    return result


def device_entries(devices: Iterable[Device], by: str = "", only: str | None = None) -> list[Entry]:
    """Return an entry for each experiment of each device. With ``only``, only experiments with this name are included.

    The label of each entry ends with the source of the loop (``by``).
    """
    return [
        {"label": f"{device.title}, {experiment.name}{by}", "loop": loop_entries(device.loop_for(experiment))}
        for device in devices
        for experiment in device.experiments
        if only in (None, experiment.name)
    ]


def measured_entries(result: ComparisonResult, only: str | None = None) -> list[Entry]:
    """Return an entry for each experiment of a comparison whose loop is known from its logs or from the device file.

    With ``only``, only the experiment with this name is included.

    A device whose commands are in volts or counts has no entry, because the page uses N or Nm.
    """
    if drive_of(result.motion):
        return []
    recommended = result.answer.wall if result.answer else None
    found = []
    for experiment in result.experiments:
        loop = _identified_loop(experiment, result.motion)
        if loop is None or only not in (None, experiment.experiment):
            continue
        own = recommended if result.answer is not None and result.answer.experiment == experiment.experiment else None
        wall = None if own is None else {"stiffness": own.stiffness, "damping": own.damping}
        label = f"{result.title}, {experiment.experiment}"
        found.append(
            {"label": label, "experiment": experiment.experiment, "loop": loop, "wall": wall, **_measured(experiment)}
        )
    return found


def with_trials(entry: Entry, walls: Sequence[tuple[float, float, bool]]) -> Entry:
    """Return an entry with trials added. A trial is a tuple (stiffness, damping, stable)."""
    return {**entry, "trials": [[stiffness, damping, int(stable)] for stiffness, damping, stable in walls]}


def _measured(experiment: ExperimentResult) -> JsonObject:
    """Return limits with the trials on either side of them, and the limits that the loop with friction predicts.

    The page shows no passive wall if the logs prove none (``passive_reason``).
    """
    limits, trials = [], []
    for point in experiment.boundary:
        sides = [(point.stable, 1), (None if point.censored else point.unstable, 0)]
        trials += [[stiffness, point.damping, stable] for stiffness, stable in sides if stiffness is not None]
        if (limit := point.limit) is not None and not limit.censored:
            limits.append([point.damping, limit.stiffness])
    rubs = experiment.loop is not None and experiment.loop.friction is not None and experiment.loop.friction.value
    friction = [[b.damping, b.stiffness, b.stiffness_large_motion] for b in experiment.loop_boundary or () if rubs]
    unproven = "" if experiment.passive is not None else experiment.passive_reason or ""
    return {"limits": limits, "trials": trials, "friction": friction, "passive_reason": unproven}


def _identified_loop(experiment: ExperimentResult, motion: str) -> JsonObject | None:
    found = experiment.loop
    if found is None or found.source == "device file":
        return None if experiment.theory is None else loop_entries(experiment.theory.loop)
    numbers = {name: getattr(found, name) for name in ("mass", "damping", "stiffness", "delay_samples")}
    values = {name: None if each is None else each.value for name, each in numbers.items()}
    if not values["mass"] or values["delay_samples"] is None or experiment.sampling_period_s is None:
        return None if experiment.theory is None else loop_entries(experiment.theory.loop)
    loop: JsonObject = {"motion": motion, "sampling_period_s": experiment.sampling_period_s}
    # An estimate may be negative, but the numbers in a device file may not.
    loop |= {name: value if name == "mass" else max(value or 0.0, 0.0) for name, value in values.items()}
    if found.actuator_lag_s is not None and found.actuator_lag_s.value:
        loop["actuator_lag_s"] = found.actuator_lag_s.value
    return loop | _parts_of(found, experiment)


def _parts_of(found: LoopResult, experiment: ExperimentResult) -> JsonObject:
    """Return the velocity filter, the vibration mode and the friction of an identified loop. The side of the position
    sensor is that of the loop used for theory, or the motor side.
    """
    parts: JsonObject = {}
    known = experiment.theory.loop if experiment.theory is not None else None
    velocity = {name: each.value for name, each in (found.velocity or {}).items() if each.value is not None}
    if "cutoff_hz" in velocity:
        order = round(velocity.get("order", 1.0))
        parts["velocity"] = {"kind": "butterworth", "order": order, "cutoff_hz": velocity["cutoff_hz"]}
    elif "samples" in velocity:
        parts["velocity"] = {"kind": "difference", "samples": round(velocity["samples"])}
    mode = {name: each.value for name, each in (found.mode or {}).items() if each.value is not None}
    if {"frequency_hz", "damping_ratio", "mass"} <= set(mode):
        sensor = known.mode.sensor if known is not None and known.mode is not None else "motor"
        parts["mode"] = {**mode, "sensor": sensor}
    if found.friction is not None and found.friction.value:
        parts["friction"] = {"coulomb": found.friction.value}
    return parts
