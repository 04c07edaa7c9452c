"""Parts of a loop, and the tables ``[loop]`` and ``[simulation]`` of a device file. Absent parts are ideal.

Theory and estimates never read ``[simulation]``: it lists undocumented faults that the logs of a lab may have.
"""

from __future__ import annotations

from math import sqrt
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

SMALLEST, LARGEST = 1e-30, 1e30
"""Range of nonzero magnitudes in SI: products within a formula neither overflow nor underflow."""


def _of_a_size(value: float) -> float:
    if value and not SMALLEST <= abs(value) <= LARGEST:
        raise ValueError(f"must be 0, or between {SMALLEST:g} and {LARGEST:g} in magnitude")
    return value


Number = Annotated[float, AfterValidator(_of_a_size)]
Positive = Annotated[float, Field(gt=0), AfterValidator(_of_a_size)]
NonNegative = Annotated[float, Field(ge=0), AfterValidator(_of_a_size)]


class Part(BaseModel):
    """Base of all parts: immutable, no unknown fields, no NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)


class Difference(Part):
    """Velocity as the mean over N samples, (x_k - x_{k-N})/(N T); N = 1 is the ideal case."""

    kind: Literal["difference"]
    samples: Annotated[int, Field(ge=1, le=1000)]


class Butterworth(Part):
    """Butterworth low-pass of (x_k - x_{k-1})/T by the bilinear transform, prewarped at the cut-off [Hz]."""

    kind: Literal["butterworth"]
    order: Annotated[int, Field(ge=1, le=4)]
    cutoff_hz: Positive


class Coefficients(Part):
    """Filter b(z)/a(z) of (x_k - x_{k-1})/T in powers of 1/z; stable, of any static gain."""

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
                f"expected a stable filter, found a pole at distance {radius:.6g} from 0; it must be below 1"
            )
        return self


class Kalman(Part):
    """Steady-state Kalman filter of positions: white acceleration, constant over each sample, and white sensor noise.

    ``acceleration`` [m/s^2, rad/s^2] and ``noise`` [m, rad] are standard deviations; a sensor resolution q counts as
    noise of standard deviation q/sqrt(12). Only T^2 times their ratio, the tracking index, matters.

    Source: Kalata 1984, "The tracking index", IEEE Trans. Aerospace and Electronic Systems 20 (2).
    """

    kind: Literal["kalman"]
    acceleration: Positive
    noise: Positive

    def coefficients(self, sampling_period_s: float) -> Coefficients:
        """Return the same filter of (x_k - x_{k-1})/T."""
        index = self.acceleration * sampling_period_s**2 / self.noise
        root = sqrt(index * (index + 8))
        # 1 - r and r = (4 + index - root)/4, both without cancellation of nearly equal numbers
        rest = 2 * index / (index + root)
        ratio = 4 / (4 + index + root)
        alpha, beta = rest * (1 + ratio), 2 * rest * rest
        return Coefficients(kind="coefficients", b=(beta,), a=(1.0, alpha + beta - 2, ratio * ratio))


class AdaptiveWindow(Part):
    """First-order adaptive window (FOAW): the slope over the longest window whose samples are all near its line.

    ``bound`` [m, rad] is the largest distance of a sample from the line through the window's ends: the error bound of
    the sensor, such as its resolution. ``longest`` is the largest window [samples].

    Source: Janabi-Sharifi, Hayward, Chen 2000, IEEE Trans. Control Systems Technology 8 (6), end-fit.
    """

    kind: Literal["foaw"]
    bound: Positive
    longest: Annotated[int, Field(ge=1, le=256)] = 16


class Levant(Part):
    """Levant's first-order differentiator, integrated once per sample by Euler's method.

    z' = -1.5 C^(1/2) |z - x|^(1/2) sign(z - x) + w, w' = -1.1 C sign(z - x); the velocity is w. ``acceleration``
    [m/s^2, rad/s^2] is C, the largest expected acceleration.

    Source: Levant 1998, Automatica 34 (3), with its gains.
    """

    kind: Literal["levant"]
    acceleration: Positive


LinearFilter = Difference | Butterworth | Coefficients
"""Velocity filters of linear theory; a Kalman filter is converted to coefficients."""

VelocityFilter = Annotated[LinearFilter | Kalman | AdaptiveWindow | Levant, Field(discriminator="kind")]


class Mode(Part):
    """One vibration mode: two masses connected by a spring. Force, damping and operator act on the motor side.

    ``frequency_hz`` is the free-free resonance, ``damping_ratio`` that of the relative motion, ``mass`` [kg, kg m^2]
    the load; the experiment's mass is the sum of both. ``load_damping`` [Ns/m, Nms/rad] is the part of the experiment's
    damping that acts on the load.
    """

    frequency_hz: Positive
    damping_ratio: NonNegative
    mass: Positive
    sensor: Literal["motor", "load"] = "motor"
    load_damping: NonNegative = 0.0


class Operator(Part):
    """A hand or arm, rigidly attached to the motor side: mass, damping and stiffness are added to the device's."""

    mass: Positive
    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0


class Friction(Part):
    """Coulomb friction and stiction [N, Nm] on the motor's side; the Stribeck velocity [m/s, rad/s] joins them."""

    coulomb: NonNegative
    stiction: NonNegative | None = None
    stribeck_velocity: Positive = 0.01

    @model_validator(mode="after")
    def _stiction_holds_more(self) -> Self:
        if self.stiction is not None and self.stiction < self.coulomb:
            raise ValueError(f"stiction ({self.stiction}) must not be below coulomb ({self.coulomb})")
        return self


class Sensor(Part):
    """Position sensor: quantisation step and standard deviation of white noise before it, in m or rad."""

    quantum: NonNegative = 0.0
    noise: NonNegative = 0.0


class LoopTable(Part):
    """The ``[loop]`` table of a device or an experiment, as in a file; parts that it does not name are ideal."""

    velocity: VelocityFilter | None = None
    actuator_lag_s: NonNegative = 0.0
    force_gain: Positive = 1.0
    mode: Mode | None = None
    operator: Operator | None = None
    friction: Friction | None = None

    def over(self, lower: LoopTable) -> LoopTable:
        """Return this table, completed by entries of another."""
        return LoopTable(**{**named(lower), **named(self)})


def named(parts: Part) -> dict[str, object]:
    """Return the fields that a table names, as given, in the order of their definition."""
    return {name: getattr(parts, name) for name in type(parts).model_fields if name in parts.model_fields_set}


Share = Annotated[float, Field(ge=0, le=0.5)]
Deviation = Annotated[float, Field(ge=-0.5, le=0.5)]


class LaterStep(Part):
    """A further step of the external force [N, Nm], added from a time [s] of the log on."""

    time_s: Positive
    size: Number


class SimulationParts(Part):
    """The ``[simulation]`` table of a device or an experiment; faults that it does not name are absent.

    Parameters
    ----------
    one_sided_wall : bool
        The wall acts only beyond its rest in the direction of the step; outside there is no wall force.
    constant_force : float
        Force on the device in addition to the command [N, Nm], such as gravity.
    gain_error : float
        Rendered force relative to ``force_gain`` times the command, less 1.
    clock_error : float
        True sampling period relative to the stated one, less 1.
    clipped_command_logged : bool
        The log contains the command after the force limit instead of before it.
    lost_rows : float
        Share of rows that are missing in the log.
    lost_rows_hidden : bool
        Time stamps are renumbered, so that they do not show which rows are missing.
    held_samples : float
        Fraction of samples in which the sensor repeats its last value; the controller receives it, too.
    repeated_rows : float
        Share of rows in which the log repeats the previous position; the controller had the true one.
    ramp_samples : int
        Samples over which the step rises; 1 is a step.
    later_steps : tuple of LaterStep
        Further steps in the same log.
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
        """Return these parts, with missing ones taken from ``lower``."""
        return SimulationParts(**{**named(lower), **named(self)})

    def mistakes(self, duration_s: float, force_limit: float | None) -> list[str]:
        """Return sentences on entries that contradict the trial length [s] or the force limit [N, Nm] of a device."""
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
