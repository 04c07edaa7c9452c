"""Record of a device in a sampled control loop, shared by files, theory, estimation, simulation and reports.

All values are in SI units. Its parameters are named as in `pipeline.device.parameters.PARAMETERS`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self

from pydantic import TypeAdapter, ValidationError

from pipeline.base.errors import ParameterError
from pipeline.device.parameters import MOTIONS, PARAMETERS, Motion, Parameter
from pipeline.device.parts import (
    AdaptiveWindow,
    Butterworth,
    Difference,
    Friction,
    Kalman,
    Levant,
    Mode,
    Operator,
    Part,
    Sensor,
    VelocityFilter,
)

LIGHTEST_LOAD, LEAST_LOSS = 1e-6, 1e-9
"""Thresholds for the load of a mode relative to the total mass, and for the damping ratio of the mode. If both values
are smaller, double precision cannot separate the crossings of the unit circle that the mode causes."""

PARTS: dict[str, Any] = {
    "velocity": VelocityFilter,
    "mode": Mode,
    "operator": Operator,
    "friction": Friction,
    "sensor": Sensor,
}
"""Types of the parts of a loop by name."""


@dataclass(frozen=True)
class Loop:
    """Device with delay, and all parts that act between the command and the position reading.

    Parameters
    ----------
    mass : float
        Mass m of the device [kg, kg m^2], > 0. The mass of the load of a vibration mode is included. The mass of the
        operator is not.
    damping : float
        Viscous damping b of the device [Ns/m, Nms/rad], >= 0. The damping of the load is included.
    sampling_period_s : float
        Sampling period T [s], > 0.
    delay_samples : float
        Delay t_d/T from command to force, >= 0. It may be fractional.
    stiffness : float
        Stiffness k of a spring from the device to ground [N/m, Nm/rad], >= 0.
    motion : {"translation", "rotation"}
        Type of motion, which determines the units.
    velocity : VelocityFilter or mapping, optional
        Filter of the velocity. It is given as in a device file (docs/devices.md), like all parts below.
    actuator_lag_s : float
        Time constant of the actuator [s], >= 0.
    force_gain : float
        Force per unit of command, > 0.
    mode : Mode or mapping, optional
        Vibration mode with ``frequency_hz``, ``damping_ratio``, ``mass`` of the load (part of the device's mass),
        ``sensor`` (``motor`` or ``load``) and ``load_damping`` (part of the device's damping).
    operator : Operator or mapping, optional
        Operator that is rigidly attached to the motor. Its ``mass``, ``damping`` and ``stiffness`` are added to those
        of the device.
    friction : Friction or mapping, optional
        Friction on the motor side, with ``coulomb``, ``stiction`` and ``stribeck_velocity``.
    sensor : Sensor or mapping
        Position sensor with ``quantum`` and ``noise`` [m, rad].
    jitter_samples : tuple of int
        Delays from which the delay of each command is drawn. ``delay_samples`` is then their mean.
    constant_force : float
        Force on the motor in addition to the command [N, Nm], such as gravity.
    force_limit : float, optional
        Magnitude at which the command is clipped [N, Nm].

    Raises
    ------
    ParameterError
        If a number is outside its range or contradicts another number. The error message states the key, the value and
        the expected range.

    Notes
    -----
    Source: Hulin 2017, ch. 2 and 3, for mass, damper and delay; docs/definitions.md for all other parts.

    Examples
    --------
    >>> falcon = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4)
    >>> gripped = falcon.replace({"operator.mass": 0.2, "force_gain": 2.0})
    >>> gripped.value("operator.mass"), round(gripped.apparent().mass, 12)
    (0.2, 0.39)
    """

    mass: float
    damping: float
    sampling_period_s: float
    delay_samples: float
    stiffness: float = 0.0
    motion: Motion = field(default="translation", kw_only=True)
    velocity: VelocityFilter | None = field(default=None, kw_only=True)
    actuator_lag_s: float = field(default=0.0, kw_only=True)
    force_gain: float = field(default=1.0, kw_only=True)
    mode: Mode | None = field(default=None, kw_only=True)
    operator: Operator | None = field(default=None, kw_only=True)
    friction: Friction | None = field(default=None, kw_only=True)
    sensor: Sensor = field(default_factory=Sensor, kw_only=True)
    jitter_samples: tuple[int, ...] = field(default=(), kw_only=True)
    constant_force: float = field(default=0.0, kw_only=True)
    force_limit: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "jitter_samples", tuple(self.jitter_samples))
        if self.motion not in MOTIONS:
            raise ParameterError(f"motion = {self.motion!r}: expected {' or '.join(MOTIONS)}.")
        for name, kind in PARTS.items():
            given = getattr(self, name)
            if given is not None and not isinstance(given, Part):
                object.__setattr__(self, name, _part(name, kind, given))
        for name in (name for name, parameter in PARAMETERS.items() if not parameter.part and name != "jitter_samples"):
            _check(name, getattr(self, name))
        if mistakes := self._contradictions():
            raise ParameterError("; ".join(mistakes))

    def _contradictions(self) -> list[str]:
        """Return one sentence for each contradiction between parameters."""
        mistakes, mode, velocity = [], self.mode, self.velocity
        low, high = self.delay_range
        if not low <= self.delay_samples <= high:
            mistakes.append(
                f"delay_samples: found {self.delay_samples:g}; must lie within jitter_samples, {low:g} to {high:g}: "
                "state their mean, or leave out the jitter"
            )
        if mode is not None and mode.mass >= self.mass:
            mistakes.append(f"loop.mode.mass: found {mode.mass:g}; must be below the mass of both sides, {self.mass:g}")
        if mode is not None and mode.mass < LIGHTEST_LOAD * self.mass and mode.damping_ratio < LEAST_LOSS:
            mistakes.append(
                f"loop.mode.mass: found {mode.mass:g}, below {LIGHTEST_LOAD:g} of the mass of both sides, with a "
                f"damping_ratio below {LEAST_LOSS:g}: the load is too light to compute its effect; leave the mode out"
            )
        if mode is not None and mode.load_damping > self.damping:
            mistakes.append(
                f"loop.mode.load_damping: found {mode.load_damping:g}; must not exceed the total damping of motor "
                f"and load side, {self.damping:g}"
            )
        if isinstance(velocity, Kalman):
            try:
                velocity.coefficients(self.sampling_period_s)
            except ValidationError:
                index = velocity.acceleration * self.sampling_period_s**2 / velocity.noise
                mistakes.append(
                    f"loop.velocity: found a tracking index acceleration T^2/noise of {index:.3g}; the filter's poles "
                    "would lie on the unit circle"
                )
        nyquist = 0.5 / self.sampling_period_s
        if isinstance(velocity, Butterworth) and velocity.cutoff_hz >= nyquist:
            mistakes.append(
                f"loop.velocity.cutoff_hz: found {velocity.cutoff_hz:g}; must be below half the sampling rate, "
                f"{nyquist:g} Hz"
            )
        return mistakes

    def value(self, name: str) -> float | None:
        """Return the value of a parameter of `PARAMETERS`, or None if the loop does not have the part to which the
        parameter belongs.

        Raises
        ------
        ParameterError
            If no parameter has this name.
        """
        parameter = _parameter(name)
        if name == "jitter_samples":
            mean = self.delay_samples
            return math.sqrt(sum((each - mean) ** 2 for each in self.jitter_samples) / max(len(self.jitter_samples), 1))
        owner = getattr(self, parameter.part) if parameter.part else self
        value = getattr(owner, parameter.key, None)
        return None if value is None else float(value)

    def replace(self, values: Mapping[str, float | None]) -> Self:
        """Return a loop with changed values, keyed by their names in `PARAMETERS`. Missing parts are added.

        A new delay is constant, so that `jitter_samples` is cleared.

        Raises
        ------
        ParameterError
            If no parameter has one of the names, or if a value is outside its range.
        """
        changes: dict[str, Any] = {"jitter_samples": ()} if "delay_samples" in values else {}
        for name, value in values.items():
            parameter = _parameter(name)
            if name == "jitter_samples":
                raise ParameterError("jitter_samples is a set of delays; use dataclasses.replace to change it.")
            if not parameter.part:
                changes[name] = value
                continue
            part = changes.get(parameter.part, getattr(self, parameter.part))
            changes[parameter.part] = {**dict(part or ()), parameter.key: value}
        return dataclasses.replace(self, **changes)

    @property
    def load_damping(self) -> float:
        """Part of the damping that acts on the load of a mode [Ns/m, Nms/rad]. It does not contribute to passivity."""
        return self.mode.load_damping if self.mode else 0.0

    @property
    def passive_damping(self) -> float:
        """Damping that contributes to passivity, per unit of command. It excludes the damping of operator and load."""
        return (self.damping - self.load_damping) / self.force_gain

    @property
    def delay_range(self) -> tuple[float, float]:
        """Shortest and longest delay [samples], which both equal `delay_samples` without jitter."""
        drawn = self.jitter_samples or (self.delay_samples,)
        return float(min(drawn)), float(max(drawn))

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the parts that linear theory cannot include: an adaptive velocity filter, friction and jitter."""
        low, high = self.delay_range
        names = {
            "velocity": isinstance(self.velocity, AdaptiveWindow | Levant),
            "friction": self.friction is not None,
            "jitter": low < high,
        }
        return tuple(name for name, present in names.items() if present)

    def with_damping(self, value: float) -> Self:
        """Return the loop with the damping of the device set to ``value`` [Ns/m, Nms/rad]. The load of a mode keeps its
        share."""
        changes: dict[str, float | None] = {"damping": value}
        if self.mode and self.damping > 0:
            changes["mode.load_damping"] = min(self.load_damping / self.damping, 1.0) * value
        return self.replace(changes)

    def with_operator(self) -> Loop:
        """Return the loop with its operator as part of the device.

        The operator moves with the motor. The added mass lowers the frequency of a vibration mode, because the spring
        of the mode is unchanged.
        """
        operator, mode = self.operator, self.mode
        if operator is None:
            return self
        mass = self.mass + operator.mass
        if mode is not None:
            free, held = (mode.mass * (whole - mode.mass) / whole for whole in (self.mass, mass))
            slower = math.sqrt(free / held)
            mode = mode.model_copy(
                update={"frequency_hz": mode.frequency_hz * slower, "damping_ratio": mode.damping_ratio * slower}
            )
        return self._changed(
            mass=mass,
            damping=self.damping + operator.damping,
            stiffness=self.stiffness + operator.stiffness,
            mode=mode,
            operator=None,
        )

    def apparent(self) -> Loop:
        """Return the device as seen from the wall: with the operator, and per unit of command.

        A command of 1 N is a force of ``force_gain`` newtons. Mass, damping, stiffness and forces are therefore divided
        by the gain.
        """
        if self.operator is None and self.force_gain == 1:
            return self
        # the force limit applies to the command, so it is not divided by the gain
        return self.with_operator()._in_units(self.force_gain, 1.0, force_gain=1.0, force_limit=self.force_limit)

    def normalised(self) -> Loop:
        """Return the apparent device in units of its mass and of the sampling period (Table 3.1).

        The stiffness is gamma = k T^2/m, the damping is delta = b T/m, and the lag is in samples. The mass and the
        sampling period are 1.
        """
        device = self.apparent()
        return device._in_units(device.mass, self.sampling_period_s)

    def _in_units(self, mass: float, time: float, **others: float | None) -> Loop:
        """Normalise all parameters with units derived from a mass and a time."""
        changes: dict[str, Any] = {}
        for name, parameter in PARAMETERS.items():
            value, unit = self.value(name), parameter.normalising_unit(mass, time)
            if value is None or unit == 1.0:
                continue
            if not parameter.part:
                changes[name] = value / unit
            else:
                part = changes.get(parameter.part, getattr(self, parameter.part))
                changes[parameter.part] = {**dict(part), parameter.key: value / unit}
        return self._changed(**changes | others)

    def _changed(self, **changes: Any) -> Loop:
        """Return the loop with changed fields."""
        return Loop(**{each.name: getattr(self, each.name) for each in fields(Loop)} | changes)

    def parts_in_words(self) -> str:
        """Describe the linear parts for captions. The text is empty for an ideal loop."""
        words, velocity = [], self.velocity
        if isinstance(velocity, Butterworth):
            words.append(f"velocity filter (Butterworth, order {velocity.order}, {velocity.cutoff_hz:g} Hz)")
        elif isinstance(velocity, Difference):
            words.append(f"velocity over {velocity.samples} samples")
        elif velocity is not None:
            words.append(f"velocity filter ({velocity.kind})")
        if self.actuator_lag_s > 0:
            words.append(f"actuator lag {1000 * self.actuator_lag_s:g} ms")
        if self.mode is not None:
            words.append(f"vibration mode at {self.mode.frequency_hz:g} Hz, sensed at the {self.mode.sensor}")
        if self.operator is not None:
            words.append("operator")
        if self.force_gain != 1:
            words.append(f"force gain {self.force_gain:g}")
        return ", ".join(words)


def _parameter(name: str) -> Parameter:
    if name not in PARAMETERS:
        raise ParameterError(f"{name!r} is not a parameter of a loop; expected one of {', '.join(PARAMETERS)}.")
    return PARAMETERS[name]


def _check(name: str, value: float | None) -> None:
    """Refuse a parameter of the loop that is outside its range."""
    if value is None:
        return
    parameter, number = PARAMETERS[name], as_number(value)
    if not math.isfinite(number) or number < parameter.lower or (parameter.positive and number <= parameter.lower):
        expected = "a finite positive number" if parameter.positive else "a finite nonnegative number"
        if parameter.lower < 0:
            expected = "a finite number"
        raise ParameterError(f"{name} = {value}: expected {expected}.")


def _part(name: str, kind: Any, given: object) -> Any:
    """Build a part of the loop from a mapping with the keys of a device file."""
    try:
        return TypeAdapter(kind).validate_python(given)
    except ValidationError as error:
        reasons = [
            f"{'.'.join((name, *(str(key) for key in fault['loc'] if key not in _KINDS)))} = {fault['input']!r}: "
            f"{fault['msg']}"
            for fault in error.errors()
        ]
        raise ParameterError(f"{'; '.join(reasons)}. Use the keys of a device file (docs/devices.md).") from None


_KINDS = ("difference", "butterworth", "coefficients", "kalman", "foaw", "levant")
"""Kinds of filters, which validation inserts into the path of a key."""


def as_number(value: float) -> float:
    """Convert a number to a float, or to infinity if it is an integer too large for a float."""
    try:
        return float(value)
    except OverflowError:
        return math.inf
