"""The loop that statements rest on: the device that logs show, or that of its file where that has the same limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.comparison.loops.departures import course_filter
from pipeline.device.parts import Coefficients, LoopParts, VelocityFilter
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.experiment.fitted_device import fitted_device
from pipeline.measured.law.log_rows import SET_DIGITS
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.plan.found_device import AT_LOAD, FoundDevice, LoopPoint, stated_device
from pipeline.records.batch import Floats
from pipeline.records.findings import Parameter
from pipeline.records.models import Device, Experiment
from pipeline.records.results import ExperimentResult, TheoryParameters
from pipeline.theory.predictions import Theory


@dataclass(frozen=True, eq=False)
class ToldLoop:
    """The loop by the logs, by the device file, or by both; ``error`` is that of its limits by replay, 95 %, relative.

    ``held`` is the part of the damping that an operator has, by the file.
    """

    found: FoundDevice | None
    stated: FoundDevice | None = None
    error: float = 0.0
    held: float = 0.0

    @property
    def devices(self) -> list[FoundDevice]:
        """The device that statements rest on, and the other one."""
        return [each for each in (self.stated, self.found) if each is not None]

    @property
    def point(self) -> LoopPoint:
        """The device that statements rest on."""
        return self.devices[0].point

    @property
    def points(self) -> list[LoopPoint]:
        """All devices that the 95 % ranges hold, at their ends."""
        return [p for each in self.devices for p in (each.point, *(end for both in each.ends for end in both))]

    def band(self, limits: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
        """Return the least and the largest limit that numbers and replay leave open, of the limits of its devices."""
        middle = limits[0][0]
        low = np.fmin.reduce([limit - reach for limit, reach in limits])
        high = np.fmax.reduce([limit + reach for limit, reach in limits])
        off = self.error * middle
        return np.maximum(middle - np.hypot(middle - low, off), 0.0), middle + np.hypot(high - middle, off)

    def parameter(self, name: str) -> Parameter:
        """Return a number with its 95 % interval; that of a file reaches to what the logs show."""
        found = self.found.fitted.with_interval(name) if self.found else None
        if self.stated is None:
            assert found is not None, "a loop is found or stated"
            return found
        value, off = self.stated.fitted.values[name], 0.0
        if name == "delay_samples" and self.found is not None:  # to a device that has no lag it is a delay
            off = (
                self.point.parts.actuator_lag_s - self.found.point.parts.actuator_lag_s
            ) / self.point.sampling_period_s
        ends = [value, *((found.low - off, found.high - off) if found else ())]
        return Parameter(value=value, low=min(ends), high=max(ends))


def found_device(result: ExperimentResult, stages: ExperimentStages) -> FoundDevice | None:
    """Return the device fitted to all logs, with their filter; else that of the estimates; None without one."""
    fitted = stages.once(fitted_device)
    if fitted is None or "delay_samples" in fitted.open:
        return None
    velocity = stages.once(course_filter)
    return FoundDevice(fitted, stages.sampling_period_s, velocity.velocity if velocity else None)


def told_loop(found: FoundDevice | None, device: Device | None, of: Experiment | None) -> ToldLoop | None:
    """Return the loop by the file where there is one, and by the logs; None where there is neither."""
    stated, held = None, 0.0
    if device is not None and of is not None:
        parts = device.loop_of(of)
        stated = stated_device(device, of) if of.delay_samples <= LARGEST_DELAY else None
        held = parts.operator.damping / parts.force_gain if parts.operator else 0.0
    return ToldLoop(found, stated, held=held) if found or stated else None


def adequate_theory(result: ExperimentResult, stages: ExperimentStages) -> Theory | None:
    """Return the theory by the found device of an experiment whose loop is adequate and has stable walls, else None.

    A damping below zero counts as zero: the theory asks for b >= 0. Friction is in no theory.
    """
    found = found_device(result, stages) if result.loop is not None and result.loop.adequate else None
    if found is None or found.point.coulomb:
        return None
    point = found.point
    theory = Theory(
        TheoryParameters(
            mass=point.mass,
            damping=max(point.damping, 0.0),
            stiffness=max(point.stiffness, 0.0),
            sampling_period_s=point.sampling_period_s,
            delay_samples=max(point.delay_samples, 0.0),
            loop=point.parts,
            source="estimated from the logs",
        )
    )
    return theory if theory.stabilised else None


def loop_numbers(told: ToldLoop, of_logs: Sequence[VelocityFilter], parts: LoopParts | None) -> dict[str, Any]:
    """Return the numbers of a loop as fields of a result: of the logs with intervals, those of a file as stated."""
    point = told.point
    numbers: dict[str, Any] = {name: told.parameter(name) for name in ("mass", "damping", "delay_samples")}
    numbers["velocity"] = filter_parameters(point.parts.velocity, of_logs) if point.parts.velocity else None
    if told.stated is not None and parts is not None:
        mode, held = parts.mode, parts.operator.model_dump() if parts.operator else {}
        vibrates = mode.model_dump(exclude={"sensor"}) | {"sensor_at_load": mode.sensor == "load"} if mode else {}
        return numbers | {
            "stiffness": exact(point.stiffness),
            "actuator_lag_s": exact(parts.actuator_lag_s) if parts.actuator_lag_s else None,
            "mode": {name: exact(float(value)) for name, value in vibrates.items()} or None,
            "operator": {name: exact(float(value)) for name, value in held.items()} or None,
        }
    fitted = told.devices[0].fitted
    names = {name: name for name in ("frequency_hz", "damping_ratio", "load_damping")} | {"mass": "far_mass"}
    found = {name: fitted.with_interval(of) for name, of in names.items() if of in fitted.values}
    most = {"mass": fitted.values["mass"]}
    mode_found = {
        name: Parameter(value=each.value, low=max(each.low, 0.0), high=min(each.high, most.get(name, np.inf)))
        for name, each in found.items()
    }
    at_load = AT_LOAD in fitted.parts
    if at_load:
        # with damping on both sides any share moves the far mass alike
        mode_found["mass"] = mode_found["mass"].model_copy(update={"low": 0.0, "high": most["mass"]})
    return numbers | {
        "stiffness": fitted.parameter("stiffness"),
        "actuator_lag_s": fitted.parameter("actuator_lag_s"),
        "mode": mode_found | {"sensor_at_load": exact(float(at_load))} if mode_found else None,
    }


def filter_parameters(velocity: VelocityFilter, of_logs: Sequence[VelocityFilter] = ()) -> dict[str, Parameter]:
    """Return a filter by the names of a device file, its numbers as far apart as those of single logs are.

    A single log shows its filter to within the rounding of its commands, and may show a rounder number.
    """
    numbers = _filter_numbers(velocity)
    kind = (numbers.keys(), numbers.get("order"))
    others = [found for found in map(_filter_numbers, of_logs) if (found.keys(), found.get("order")) == kind]
    result = {}
    for name, value in numbers.items():
        low, high = np.quantile([found[name] for found in (numbers, *others)], (0.025, 0.975))
        # half of the last digit, as far as logs tell; a device file is exact
        digit = 10.0 ** (np.floor(np.log10(value)) + 1 - SET_DIGITS) if of_logs and name == "cutoff_hz" else 0.0
        result[name] = Parameter(value=value, low=min(low, value) - 0.5 * digit, high=max(high, value) + 0.5 * digit)
    return result


def _filter_numbers(velocity: VelocityFilter) -> dict[str, float]:
    if not isinstance(velocity, Coefficients):
        return {name: float(value) for name, value in velocity.model_dump(exclude={"kind"}).items()}
    sides = (("b", velocity.b), ("a", velocity.a))
    return {f"{name}{i}": value for name, values in sides for i, value in enumerate(values)}


def exact(value: float) -> Parameter:
    """Return a parameter that is its own interval."""
    return Parameter(value=value, low=value, high=value)
