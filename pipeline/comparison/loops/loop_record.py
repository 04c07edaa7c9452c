"""The parts of a loop beside mass, damping, stiffness and delay: as theory takes them, and as a result holds them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.measured.law.velocity_filter import CUTOFF_DIGITS, VelocityFilterFound
from pipeline.records.loop_parts import Butterworth, Coefficients, Difference, LoopParts, Mode, VelocityFilter
from pipeline.records.loop_records import LoopResult, Parameter


def parts_of(loop: LoopResult) -> LoopParts:
    """Return the parts of a loop beside mass, damping, stiffness and delay."""
    velocity = mode = None
    if loop.velocity is not None:
        v = {name: each.value for name, each in loop.velocity.items()}
        if "samples" in v:
            velocity = VelocityFilterFound((), difference=int(v["samples"])).declared
        elif "cutoff_hz" in v:
            velocity = VelocityFilterFound((), (0.0,) * (int(v["order"]) + 1), cutoff_hz=v["cutoff_hz"]).declared
        else:
            b, a = (tuple(value for name, value in v.items() if name[0] == side) for side in "ba")
            velocity = VelocityFilterFound(b, a).declared
    if loop.mode is not None:
        m = {name: each.value for name, each in loop.mode.items()}
        far = m.pop("sensor_at_load")
        mode = Mode(**m, sensor="load" if far else "motor")
    lag = loop.actuator_lag_s.value if loop.actuator_lag_s else 0.0
    return LoopParts(velocity=velocity, actuator_lag_s=max(lag, 0.0), mode=mode)


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
        off = 0.5 * _last_digit(value) if of_logs and name == "cutoff_hz" else 0.0
        result[name] = Parameter(value=value, low=min(low, value) - off, high=max(high, value) + off)
    return result


def _filter_numbers(velocity: VelocityFilter) -> dict[str, float]:
    if isinstance(velocity, Difference):
        return {"samples": float(velocity.samples)}
    if isinstance(velocity, Butterworth):
        return {"order": float(velocity.order), "cutoff_hz": velocity.cutoff_hz}
    if not isinstance(velocity, Coefficients):
        return {name: float(value) for name, value in velocity.model_dump(exclude={"kind"}).items()}
    sides = (("b", velocity.b), ("a", velocity.a))
    return {f"{name}{i}": value for name, values in sides for i, value in enumerate(values)}


def _last_digit(value: float) -> float:
    """Return a unit of the last digit of a cut-off as it was rounded."""
    return float(10.0 ** (np.floor(np.log10(value)) + 1 - CUTOFF_DIGITS))


def stated_parameters(parts: LoopParts) -> dict[str, Parameter | dict[str, Parameter] | None]:
    """Return the parts that a device file declares as fields of a result, with the numbers of the file."""
    mode, operator = parts.mode, parts.operator
    numbers = mode.model_dump(exclude={"sensor"}) | {"sensor_at_load": mode.sensor == "load"} if mode else {}
    held = operator.model_dump() if operator else {}
    return {
        "actuator_lag_s": exact(parts.actuator_lag_s) if parts.actuator_lag_s else None,
        "velocity": filter_parameters(parts.velocity) if parts.velocity else None,
        "mode": {name: exact(float(value)) for name, value in numbers.items()} or None,
        "operator": {name: exact(float(value)) for name, value in held.items()} or None,
    }


def exact(value: float) -> Parameter:
    """Return a parameter that is its own interval."""
    return Parameter(value=value, low=value, high=value)
