"""The loop that one device fitted to all trials makes, with the filter that the wall law shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipeline.comparison.loops.log_evidence import LawDeparture, found_filter
from pipeline.comparison.loops.loop_range import LoopPoint, LoopRange, estimated_range
from pipeline.comparison.loops.loop_record import exact
from pipeline.measured.experiment.fitted_device import FittedDevice, fitted_device
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import LoopParts, Mode, VelocityFilter
from pipeline.records.loop_records import Parameter
from pipeline.records.results import ExperimentResult

LOAD = "mode at the load"

_LEAST = 1e-3
"""Least share of the mass on a side of a mode, and of a positive number that an interval may reach down to."""

_LEAST_LAG = 1e-3
"""Lag [samples] that is none."""


def loop_point(
    device: FittedDevice, values: Mapping[str, float], period_s: float, velocity: VelocityFilter | None
) -> LoopPoint:
    """Return the loop of a device that has some numbers."""
    mode = None
    if "far_mass" in values:
        mass = values["mass"]
        mode = Mode(
            frequency_hz=values["frequency_hz"],
            damping_ratio=max(values["damping_ratio"], 0.0),
            mass=min(max(values["far_mass"], _LEAST * mass), (1 - _LEAST) * mass),
            sensor="load" if LOAD in device.parts else "motor",
        )
    lag = max(values.get("actuator_lag_s", 0.0), 0.0)
    parts = LoopParts(velocity=velocity, actuator_lag_s=lag if lag > _LEAST_LAG * period_s else 0.0, mode=mode)
    mass, damping, delay = (values[name] for name in ("mass", "damping", "delay_samples"))
    return LoopPoint(mass, damping, delay, values.get("stiffness", 0.0), period_s, parts)


def loop_range(device: FittedDevice, period_s: float, velocity: VelocityFilter | None) -> LoopRange:
    """Return the loop of a device with what the trials leave open: 95 % along each principal axis of its numbers."""
    middle = loop_point(device, device.values, period_s, velocity)
    scale = np.sqrt(np.diag(device.covariance))
    size = np.where(scale > 0, scale, 1.0)
    variance, axes = np.linalg.eigh(device.covariance / np.outer(size, size))
    apart = []
    for square, axis in zip(variance, axes.T, strict=True):
        step = NORMAL_95 * np.sqrt(max(float(square), 0.0)) * axis * size
        low, high = (dict(zip(device.values, _after(device, end).tolist(), strict=True)) for end in (-step, step))
        apart.append((loop_point(device, low, period_s, velocity), loop_point(device, high, period_s, velocity)))
    mass, damping, delay = (device.known(name) for name in ("mass", "damping", "delay_samples"))
    return LoopRange(mass, damping, delay, middle.stiffness, period_s, middle.parts, tuple(apart))


def _after(device: FittedDevice, step: Floats) -> Floats:
    """Return a device's numbers after a step, those that must be positive at least a thousandth of what they are."""
    now = np.array(list(device.values.values()))
    positive = np.isin(list(device.values), ("mass", "frequency_hz"))
    return np.where(positive, np.maximum(now + step, _LEAST * now), now + step)


def mode_parameters(device: FittedDevice) -> dict[str, Parameter] | None:
    """Return the mode of a device by the names of a device file; its side of the sensor is 1 for the load."""
    names = {"frequency_hz": "frequency_hz", "damping_ratio": "damping_ratio", "mass": "far_mass"}
    found = {name: number for name, of in names.items() if (number := device.parameter(of)) is not None}
    if not found:
        return None
    most = {"mass": device.values["mass"]}
    within = {name: _within(number, most.get(name, np.inf)) for name, number in found.items()}
    return within | {"sensor_at_load": exact(float(LOAD in device.parts))}


def _within(number: Parameter, most: float) -> Parameter:
    """Return a number that is not negative, and at most so large, with the interval that is left."""
    return Parameter(value=number.value, low=max(number.low, 0.0), high=min(number.high, most))


def with_filter(loop: LoopRange | None, velocity: VelocityFilter | None) -> LoopRange | None:
    """Return a loop whose wall law filters the velocity."""
    if loop is None or velocity is None:
        return loop
    return replace(loop, parts=loop.parts.model_copy(update={"velocity": velocity}))


def velocity_of(stages: ExperimentStages, departures: list[LawDeparture]) -> VelocityFilter | None:
    """Return the velocity filter of the wall law; one that few logs show is none."""
    # a controller filters the velocity in all trials or in none; single logs can imitate it
    if not any(each.code == "velocity_filter" and each.logs > 0.5 * each.of for each in departures):
        return None
    found = found_filter(stages)
    return found.declared if found is not None else None


def found_loop(result: ExperimentResult, stages: ExperimentStages, velocity: VelocityFilter | None) -> LoopRange | None:
    """Return the linear loop of the device that explains the logs, with their filter; else that of the estimates."""
    fitted = stages.once(fitted_device)
    if fitted is not None and "delay_samples" in fitted.open:
        return None
    if fitted is not None:
        return loop_range(fitted, stages.sampling_period_s, velocity)
    return with_filter(estimated_range(result, stages.sampling_period_s), velocity)
