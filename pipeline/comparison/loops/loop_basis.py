"""The loop on which all conclusions depend: the identified loop, or that of the device file if its limits agree."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.comparison.loops.departures import experiment_filter
from pipeline.device.loop import Loop
from pipeline.device.parameters import PARAMETERS, Motion
from pipeline.device.parts import Butterworth, Coefficients, Difference, Operator, VelocityFilter
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.experiment.identified_loop import IdentifiedLoop, identified_loop, nominal_loop
from pipeline.measured.identification.intervals import Interval
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.measured.wall_command.log_rows import SET_DIGITS
from pipeline.records.findings import Quantity
from pipeline.records.results import LoopFindings, SourcedLoop
from pipeline.records.trials import Floats
from pipeline.theory.predictions import Theory


@dataclass(frozen=True, eq=False)
class LoopBasis:
    """The loop from the logs, from the device file, or from both.

    Parameters
    ----------
    identified : IdentifiedLoop or None
        Loop from the logs.
    nominal : IdentifiedLoop or None
        Loop from the device file. Its parameters have no intervals.
    error : float
        95 % quantile of the relative error of the limits according to the replay.
    operator_damping : float
        Damping of the operator in the file, per unit of command [Ns/m, Nms/rad].
    """

    identified: IdentifiedLoop | None
    nominal: IdentifiedLoop | None = None
    error: float = 0.0
    operator_damping: float = 0.0

    @property
    def devices(self) -> list[IdentifiedLoop]:
        """The device on which the conclusions are based, followed by the other device if there is one."""
        return [device for device in (self.nominal, self.identified) if device is not None]

    @property
    def loop(self) -> Loop:
        """The loop on which the conclusions are based."""
        return self.devices[0].loop

    @property
    def loops(self) -> list[Loop]:
        """The loop of each device, followed by its loops at the ends of the 95 % intervals."""
        return [
            loop for device in self.devices for loop in (device.loop, *(end for both in device.ends for end in both))
        ]

    def band(self, limits: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
        """Return the lower and upper bound of the limits of its devices.

        The bounds account for the intervals of the parameters and for the error that the replay found.
        """
        middle = limits[0][0]
        low = np.fmin.reduce([limit - reach for limit, reach in limits])
        high = np.fmax.reduce([limit + reach for limit, reach in limits])
        off = self.error * middle
        return np.maximum(middle - np.hypot(middle - low, off), 0.0), middle + np.hypot(high - middle, off)

    def interval(self, name: str) -> Interval:
        """Return a parameter with its 95 % interval.

        The interval of a file's value extends to the estimate from the logs.
        """
        by_logs = self.identified.interval(name) if self.identified else None
        if self.nominal is None:
            assert by_logs is not None, "a loop is identified or nominal"
            return by_logs
        value, off = self.nominal.values[name], 0.0
        if (
            name == "delay_samples" and self.identified is not None
        ):  # in a device without lag, the delay includes the lag
            off = (self.loop.actuator_lag_s - self.identified.loop.actuator_lag_s) / self.loop.sampling_period_s
        ends = [value, *((by_logs.low - off, by_logs.high - off) if by_logs else ())]
        return Interval(value, min(ends), max(ends))


def identified_device(stages: ExperimentStages) -> IdentifiedLoop | None:
    """Return the loop from all logs, with their velocity filter, or None if mass or delay cannot be identified."""
    identified = stages.once(identified_loop)
    if identified is None or "delay_samples" in identified.unidentifiable:
        return None
    shown = stages.once(experiment_filter)
    return dataclasses.replace(identified, velocity=shown.velocity if shown else None)


def loop_basis(identified: IdentifiedLoop | None, of_file: Loop | None) -> LoopBasis | None:
    """Return the loop from the device file and from the logs, or None without both."""
    nominal, damping = None, 0.0
    if of_file is not None:
        nominal = nominal_loop(of_file) if of_file.delay_samples <= LARGEST_DELAY else None
        damping = of_file.operator.damping / of_file.force_gain if of_file.operator else 0.0
    return LoopBasis(identified, nominal, operator_damping=damping) if identified or nominal else None


def adequate_theory(findings: LoopFindings, stages: ExperimentStages) -> Theory | None:
    """Return the theory of the identified loop of an experiment, or None if it is not adequate or has no stable walls.

    A negative damping is replaced by zero, because theory needs b >= 0. Theory does not include friction.
    """
    identified = stages.once(identified_device) if findings.loop is not None and findings.loop.adequate else None
    if identified is None or identified.loop.friction is not None:
        return None
    theory = Theory(SourcedLoop(loop=identified.loop, source="estimated from the logs"))
    return theory if theory.stabilised else None


def loop_quantities(basis: LoopBasis) -> dict[str, Quantity]:
    """Return the parameters of a loop outside its parts, by name. Estimates have intervals. Values of a file are as
    stated.

    All are effective values at the wall, per unit of command.
    """
    device = basis.devices[0]
    intervals = {name: basis.interval(name) for name in ("mass", "damping", "delay_samples")}
    intervals |= {name: device.interval(name) for name in ("stiffness", "actuator_lag_s") if name in device.values}
    return {name: as_quantity(name, interval, basis.loop.motion) for name, interval in intervals.items()}


def operator_quantities(operator: Operator, motion: Motion) -> dict[str, Quantity]:
    """Return the parameters of the operator of a device file by name."""
    values = dict(operator).items()
    return {key: as_quantity(f"operator.{key}", exact(float(value)), motion) for key, value in values}


def mode_quantities(basis: LoopBasis) -> dict[str, Quantity] | None:
    """Return the parameters of the vibration mode of a loop by name, or None without a mode."""
    if basis.loop.mode is None:
        return None
    device, at_load, mode = basis.devices[0], basis.loop.mode.sensor == "load", dict[str, Quantity]()
    for name in (name for name in device.values if PARAMETERS[name].part == "mode"):
        interval = device.interval(name)
        low, high = max(interval.low, 0.0), interval.high
        if name == "mode.mass":
            # With the sensor at the load and damping on both sides, the motion does not depend on the share of the
            # mass.
            low, high = (0.0, np.inf) if at_load and basis.nominal is None else (low, high)
            high = min(high, device.values["mass"])
        mode[PARAMETERS[name].key] = as_quantity(name, Interval(interval.value, low, high), basis.loop.motion)
    side = exact(float(at_load))
    return mode | {"sensor_at_load": Quantity(value=side.value, low=side.low, high=side.high)}


def as_quantity(name: str, interval: Interval, motion: Motion) -> Quantity:
    """Return a parameter of a loop with its unit, given its name in `PARAMETERS`."""
    unit = PARAMETERS[name].unit(motion)
    return Quantity(value=interval.value, low=interval.low, high=interval.high, unit=unit)


def filter_quantities(velocity: VelocityFilter, of_logs: Sequence[VelocityFilter] = ()) -> dict[str, Quantity]:
    """Return a filter with the parameter names of a device file. Intervals include the parameters of single logs.

    A single log determines its filter within the rounding of its commands, and may give a rounder number.
    """
    numbers = _filter_numbers(velocity)
    kind = (numbers.keys(), numbers.get("order"))
    others = [other for other in map(_filter_numbers, of_logs) if (other.keys(), other.get("order")) == kind]
    result = {}
    for name, value in numbers.items():
        low, high = np.quantile([other[name] for other in (numbers, *others)], (0.025, 0.975))
        # The interval is half of the last digit for a filter from logs. A device file is exact.
        digit = 10.0 ** (np.floor(np.log10(value)) + 1 - SET_DIGITS) if of_logs and name == "cutoff_hz" else 0.0
        result[name] = Quantity(value=value, low=min(low, value) - 0.5 * digit, high=max(high, value) + 0.5 * digit)
    return result


def filter_of_numbers(numbers: Mapping[str, float]) -> VelocityFilter:
    """Return the filter with parameters named as in `filter_quantities`.

    >>> filter_of_numbers({"order": 2.0, "cutoff_hz": 80.0})
    Butterworth(kind='butterworth', order=2, cutoff_hz=80.0)
    """
    if "samples" in numbers:
        return Difference(kind="difference", samples=int(numbers["samples"]))
    if "cutoff_hz" in numbers:
        return Butterworth(kind="butterworth", order=int(numbers["order"]), cutoff_hz=numbers["cutoff_hz"])
    b, a = (tuple(value for name, value in numbers.items() if name[0] == side) for side in "ba")
    return Coefficients(kind="coefficients", b=b, a=a)


def _filter_numbers(velocity: VelocityFilter) -> dict[str, float]:
    if not isinstance(velocity, Coefficients):
        return {name: float(value) for name, value in velocity.model_dump(exclude={"kind"}).items()}
    sides = (("b", velocity.b), ("a", velocity.a))
    return {f"{name}{i}": value for name, values in sides for i, value in enumerate(values)}


def exact(value: float) -> Interval:
    """Return an exact number as an interval of zero width."""
    return Interval(value, value, value)
