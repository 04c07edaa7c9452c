"""Parts of a loop, and the tables ``[loop]`` and ``[simulation]`` of a device file. Missing parts are ideal.

The table ``[simulation]`` lists undocumented faults that the logs of a lab may have. Theory and estimates
never read it.
"""

from __future__ import annotations

from math import sqrt
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

SMALLEST, LARGEST = 1e-30, 1e30
"""Range of nonzero magnitudes in SI units, for which the products in a formula neither overflow nor underflow."""


def _of_a_size(value: float) -> float:
    if value and not SMALLEST <= abs(value) <= LARGEST:
        raise ValueError(f"must be 0, or between {SMALLEST:g} and {LARGEST:g} in magnitude")
    return value


Number = Annotated[float, AfterValidator(_of_a_size)]
Positive = Annotated[float, Field(gt=0), AfterValidator(_of_a_size)]
NonNegative = Annotated[float, Field(ge=0), AfterValidator(_of_a_size)]


class Part(BaseModel):
    """Base of all parts. It is immutable and accepts no unknown fields, NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)


class Difference(Part):
    """Velocity as the mean over N samples, (x_k - x_{k-N})/(N T). N = 1 is the ideal case."""

    kind: Literal["difference"]
    samples: Annotated[int, Field(ge=1, le=1000)]


class Butterworth(Part):
    """Butterworth low-pass filter of (x_k - x_{k-1})/T by the bilinear transform, prewarped at the cut-off [Hz]."""

    kind: Literal["butterworth"]
    order: Annotated[int, Field(ge=1, le=4)]
    cutoff_hz: Positive


class Coefficients(Part):
    """Stable filter b(z)/a(z) of (x_k - x_{k-1})/T in powers of 1/z, with any static gain."""

    kind: Literal["coefficients"]
    b: Annotated[tuple[Number, ...], Field(min_length=1, max_length=64)]
    a: Annotated[tuple[Number, ...], Field(min_length=1, max_length=64)]

    @model_validator(mode="after")
    def _is_stable(self) -> Self:
        from numpy import roots

        if self.a[0] == 0:
            raise ValueError("a[0] must not be 0: it multiplies the newest velocity")
        if not any(self.b):
            raise ValueError("b must not be all 0: no damping would be rendered")
        radius = max(abs(roots(self.a)), default=0.0)
        if radius >= 1:
            raise ValueError(
                f"expected a stable filter, found a pole at distance {radius:.6g} from 0; the distance must be below 1"
            )
        return self


class Kalman(Part):
    """Steady-state Kalman filter of positions, with white sensor noise and a white acceleration that is constant in a
    sample.

    ``acceleration`` [m/s^2, rad/s^2] and ``noise`` [m, rad] are standard deviations. A sensor resolution q counts as
    noise of standard deviation q/sqrt(12). Only T^2 times their ratio, the tracking index, matters.

    Source: Kalata 1984, "The tracking index", IEEE Trans. Aerospace and Electronic Systems 20 (2).
    """

    kind: Literal["kalman"]
    acceleration: Positive
    noise: Positive

    def coefficients(self, sampling_period_s: float) -> Coefficients:
        """Return the coefficients of the equivalent filter of (x_k - x_{k-1})/T."""
        index = self.acceleration * sampling_period_s**2 / self.noise
        root = sqrt(index * (index + 8))
        # 1 - r and r = (4 + index - root)/4, in forms that avoid the cancellation of nearly equal numbers
        rest = 2 * index / (index + root)
        ratio = 4 / (4 + index + root)
        alpha, beta = rest * (1 + ratio), 2 * rest * rest
        return Coefficients(kind="coefficients", b=(beta,), a=(1.0, alpha + beta - 2, ratio * ratio))


class AdaptiveWindow(Part):
    """First-order adaptive window (FOAW): the slope over the longest window whose samples are near a line.

    ``bound`` [m, rad] is the largest distance of a sample from the line through the ends of the window. It is the error
    bound of the sensor, such as its resolution. ``longest`` is the largest window [samples].

    Source: Janabi-Sharifi, Hayward, Chen 2000, IEEE Trans. Control Systems Technology 8 (6), end-fit.
    """

    kind: Literal["foaw"]
    bound: Positive
    longest: Annotated[int, Field(ge=1, le=256)] = 16


class Levant(Part):
    """Levant's first-order differentiator, integrated by Euler's method with one step per sample.

    z' = -1.5 C^(1/2) |z - x|^(1/2) sign(z - x) + w, w' = -1.1 C sign(z - x). The velocity is w. The largest expected
    acceleration C is given by ``acceleration`` [m/s^2, rad/s^2].

    Source: Levant 1998, Automatica 34 (3), whose gains are used.
    """

    kind: Literal["levant"]
    acceleration: Positive


LinearFilter = Difference | Butterworth | Coefficients
"""Velocity filters of linear theory. A Kalman filter is converted to coefficients."""

VelocityFilter = Annotated[LinearFilter | Kalman | AdaptiveWindow | Levant, Field(discriminator="kind")]


class Mode(Part):
    """Vibration mode of two masses connected by a spring. Force, damping and operator act on the motor side.

    ``frequency_hz`` is the free-free resonance, and ``damping_ratio`` is the damping ratio of the relative motion.
    ``mass`` [kg, kg m^2] is the mass of the load; the experiment's mass is the sum of both masses. ``load_damping``
    [Ns/m, Nms/rad] is the part of the experiment's damping that acts on the load.
    """

    frequency_hz: Positive
    damping_ratio: NonNegative
    mass: Positive
    sensor: Literal["motor", "load"] = "motor"
    load_damping: NonNegative = 0.0


class Operator(Part):
    """Hand or arm, rigidly attached to the motor side. Mass, damping and stiffness are added to those of the device."""

    mass: Positive
    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0


class Friction(Part):
    """Coulomb friction and stiction [N, Nm] on the motor side, joined at ``stribeck_velocity`` [m/s, rad/s]."""

    coulomb: NonNegative
    stiction: NonNegative | None = None
    stribeck_velocity: Positive = 0.01

    @model_validator(mode="after")
    def _stiction_holds_more(self) -> Self:
        if self.stiction is not None and self.stiction < self.coulomb:
            raise ValueError(f"stiction ({self.stiction}) must not be below coulomb ({self.coulomb})")
        return self


class Sensor(Part):
    """Position sensor: quantisation step, and standard deviation of the white noise before quantisation [m, rad]."""

    quantum: NonNegative = 0.0
    noise: NonNegative = 0.0


class LoopTable(Part):
    """The ``[loop]`` table of a device or an experiment in a file. Parts that are not listed are ideal."""

    velocity: VelocityFilter | None = None
    actuator_lag_s: NonNegative = 0.0
    force_gain: Positive = 1.0
    mode: Mode | None = None
    operator: Operator | None = None
    friction: Friction | None = None

    def over(self, lower: LoopTable) -> LoopTable:
        """Return this table, with missing entries taken from ``lower``."""
        return LoopTable(**{**named(lower), **named(self)})


def named(parts: Part) -> dict[str, object]:
    """Return the fields that are given in a table, in the order of their definition."""
    return {name: getattr(parts, name) for name in type(parts).model_fields if name in parts.model_fields_set}


Share = Annotated[float, Field(ge=0, le=0.5)]
Deviation = Annotated[float, Field(ge=-0.5, le=0.5)]


class LaterStep(Part):
    """Additional step of the external force [N, Nm], which acts from the given time [s] of the log."""

    time_s: Positive
    size: Number


class SimulationParts(Part):
    """The ``[simulation]`` table of a device or an experiment. Faults that are not listed are absent.

    Parameters
    ----------
    one_sided_wall : bool
        Whether the wall acts only beyond its rest position in the direction of the step.
    constant_force : float
        Force on the device in addition to the command [N, Nm], such as gravity.
    gain_error : float
        Relative error of the rendered force: its ratio to ``force_gain`` times the command, minus 1.
    clock_error : float
        Relative error of the sampling period: ratio of the true to the stated period, minus 1.
    clipped_command_logged : bool
        Whether the log contains the command after the force limit instead of before it.
    lost_rows : float
        Fraction of rows that are missing from the log.
    lost_rows_hidden : bool
        Whether the time stamps are renumbered. They then do not show which rows are missing.
    held_samples : float
        Fraction of samples in which the sensor repeats its last value for both the controller and the log.
    repeated_rows : float
        Fraction of rows in which the log repeats the previous position, while the controller receives the true
        position.
    ramp_samples : int
        Number of samples in which the external force rises. It is 1 for an ideal step.
    later_steps : tuple of LaterStep
        Additional steps in the same log.
    """

    one_sided_wall: bool = False
    constant_force: Number = 0.0
    gain_error: Deviation = 0.0
    clock_error: Deviation = 0.0
    clipped_command_logged: bool = False
    lost_rows: Share = 0.0
    lost_rows_hidden: bool = False
    held_samples: Share = 0.0
    repeated_rows: Share = 0.0
    ramp_samples: Annotated[int, Field(ge=1, le=10_000)] = 1
    later_steps: tuple[LaterStep, ...] = ()

    def over(self, lower: SimulationParts) -> SimulationParts:
        """Return this table, with missing entries taken from ``lower``."""
        return SimulationParts(**{**named(lower), **named(self)})

    def mistakes(self, duration_s: float, force_limit: float | None) -> list[str]:
        """Return one sentence for each contradiction with the device's trial length [s] or force limit [N, Nm]."""
        found = [
            f"simulation.later_steps[{i}].time_s: found {step.time_s:g}; must be below duration_s, {duration_s:g}"
            for i, step in enumerate(self.later_steps, start=1)
            if step.time_s >= duration_s
        ]
        if self.clipped_command_logged and force_limit is None:
            found.append("simulation.clipped_command_logged: found true; needs a force limit, limits.force")
        if self.lost_rows_hidden and not self.lost_rows:
            found.append("simulation.lost_rows_hidden: found true; needs lost_rows above 0")
        return found
