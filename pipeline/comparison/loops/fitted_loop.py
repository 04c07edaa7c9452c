"""The loop that one device fitted to all trials makes, with the filter that the wall law shows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.comparison.loops.loop_range import LoopPoint, LoopRange
from pipeline.comparison.loops.loop_record import exact
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.ladder.ladder import holds
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate
from pipeline.records.loop_parts import LoopParts, Mode, VelocityFilter
from pipeline.records.loop_records import Parameter

LOAD = "mode at the load"

TOLD = 0.5
"""Share of the held-out trials that a device must explain for its parts to be named as causes."""


@dataclass(frozen=True, eq=False)
class FittedDevice:
    """The best device of a ladder.

    Parameters
    ----------
    parts : tuple of str
        What it has beside mass, damper and delay, as in the stage `ladder`.
    explained, held_out : int
        Trials that it was not fitted to: how many it explains, and all of them.
    values : dict of str to float
        Its numbers in SI by name.
    covariance : float64, shape (P, P)
        Of these.
    alike : tuple of str
        Parts of devices that cannot be told apart from it.
    next_best : tuple of str
        Parts of the likeliest other device, and in how many trials it holds; empty where there is none.
    """

    parts: tuple[str, ...]
    explained: int
    held_out: int
    values: dict[str, float]
    covariance: Floats
    alike: tuple[str, ...]
    next_best: str

    @property
    def holds(self) -> bool:
        """Whether it explains nearly all trials that it was not fitted to."""
        return holds(self.explained, self.held_out)

    @property
    def tells(self) -> bool:
        """Whether it explains enough of them for its parts to be real."""
        return self.explained >= TOLD * self.held_out

    def parameter(self, name: str) -> Parameter | None:
        """Return one of its numbers with its 95 % interval; None where it has none."""
        return self._known(name) if name in self.values else None

    def _known(self, name: str) -> Parameter:
        value = self.values[name]
        reach = NORMAL_95 * float(np.sqrt(self.covariance[(place := list(self.values).index(name)), place]))
        return Parameter(value=value, low=value - reach, high=value + reach)

    def point(self, values: dict[str, float], period_s: float, velocity: VelocityFilter | None) -> LoopPoint:
        """Return the loop of some numbers."""
        mode = None
        if "far_mass" in values:
            mass = values["mass"]
            mode = Mode(
                frequency_hz=values["frequency_hz"],
                damping_ratio=max(values["damping_ratio"], 0.0),
                mass=min(max(values["far_mass"], _LEAST * mass), (1 - _LEAST) * mass),
                sensor="load" if LOAD in self.parts else "motor",
            )
        lag = max(values.get("actuator_lag_s", 0.0), 0.0)
        parts = LoopParts(velocity=velocity, actuator_lag_s=lag if lag > _LEAST_LAG * period_s else 0.0, mode=mode)
        mass, damping, delay = (values[name] for name in ("mass", "damping", "delay_samples"))
        return LoopPoint(mass, damping, delay, values.get("stiffness", 0.0), period_s, parts)

    def loop(self, period_s: float, velocity: VelocityFilter | None) -> LoopRange:
        """Return its loop with what the trials leave open: 95 % along each principal axis of its numbers."""
        middle = self.point(self.values, period_s, velocity)
        scale = np.sqrt(np.diag(self.covariance))
        size = np.where(scale > 0, scale, 1.0)
        variance, axes = np.linalg.eigh(self.covariance / np.outer(size, size))
        apart = []
        for square, axis in zip(variance, axes.T, strict=True):
            step = NORMAL_95 * np.sqrt(max(float(square), 0.0)) * axis * size
            low, high = (dict(zip(self.values, self._at(end).tolist(), strict=True)) for end in (-step, step))
            apart.append((self.point(low, period_s, velocity), self.point(high, period_s, velocity)))
        mass, damping, delay = (self._known(name) for name in ("mass", "damping", "delay_samples"))
        return LoopRange(mass, damping, delay, middle.stiffness, period_s, middle.parts, tuple(apart))

    def _at(self, step: Floats) -> Floats:
        """Return the numbers after a step, those that must be positive at least a thousandth of what they are."""
        now = np.array(list(self.values.values()))
        after = now + step
        positive = np.isin(list(self.values), ("mass", "frequency_hz"))
        return np.where(positive, np.maximum(after, _LEAST * now), after)


_LEAST = 1e-3
"""Least share of the mass on a side of a mode, and of a positive number that an interval may reach down to."""

_LEAST_LAG = 1e-3
"""Lag [samples] that is none."""


def fitted_device(stages: ExperimentStages) -> FittedDevice | None:
    """Return the best device of the stage `ladder`, None where there is none."""
    rows = stages.table("ladder").to_pylist()
    if not rows:
        return None
    best, *others = rows
    numbers = json.loads(best["numbers"])
    after = next((row for row in others if row["role"] == "next best"), None)
    return FittedDevice(
        tuple(filter(None, best["parts"].split(","))),
        best["explained"],
        best["held_out"],
        dict(zip(numbers["names"], numbers["values"], strict=True)),
        np.array(numbers["covariance"]),
        tuple(row["parts"] for row in others if row["role"] == "alike"),
        f"{_words(after['parts'])}: {after['explained']} of {after['held_out']}" if after else "",
    )


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


_TERMS = {
    "mass": "mass",
    "damping": "damping",
    "friction": "coulomb",
    "device_stiffness": "stiffness",
    "constant_force": "constant_force",
    "jitter_samples": "jitter",
}
"""Estimates of an experiment, and the names of the numbers of a device that they are."""


def fitted_estimates(found: Mapping[str, Estimate], device: FittedDevice) -> dict[str, Estimate]:
    """Return the estimates of an experiment whose trials a device explains: its numbers, the others by method.

    Of a part that it does not have nothing is said: it would explain no more.
    """
    method = "one device fitted to all trials"
    result = {}
    for name, term in _TERMS.items():
        if name not in found:
            continue
        before, number = found[name], device.parameter(term)
        methods = {**before.by_method, "before": before.model_copy(update={"by_method": {}})}
        some = number.model_dump() if number else {"value": None, "reason": f"{method} explains the logs without it"}
        result[name] = Estimate(
            **some, unit=before.unit, method=method, trials=device.held_out, by_method=methods if number else {}
        )
    delay, number = found["delay_samples"], device.parameter("delay_samples")
    assert number is not None, "each device has one"
    by_ladder = Estimate(**number.model_dump(), unit="samples", method=method, trials=device.held_out)
    result["delay_samples"] = delay.model_copy(update={"by_method": {**delay.by_method, "ladder": by_ladder}})
    return result


def _words(parts: str) -> str:
    return parts.replace(",", ", ") or "mass, damping and delay alone"


def with_filter(loop: LoopRange | None, velocity: VelocityFilter | None) -> LoopRange | None:
    """Return a loop whose wall law filters the velocity."""
    if loop is None or velocity is None:
        return loop
    return replace(loop, parts=loop.parts.model_copy(update={"velocity": velocity}))
