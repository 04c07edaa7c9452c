"""Define the sampled, delayed loop of virtual wall and device for the theory, in normalised quantities.

Normalised quantities (Table 3.1) are time/T, alpha = K T^2/m, beta = B T/m, gamma = k T^2/m, delta = b T/m, and d =
t_d/T, with the sampling period T. The wall force of sample k acts on [k + d, k + 1 + d). For fractional d, the plant
input switches inside an interval (modified z-transform). An external step or impulse acts at sample 0 without delay.
Responses are deviations from the final position, relative to the final displacement. They obey the homogeneous equation
and keep their relative precision while they decay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.loop.many_digits import (
    Digits,
    as_exact,
    as_floats,
    bilinear,
    exponential,
    many_digits,
    resolvent,
    total,
    unit,
)
from pipeline.loop.state_space import Plant, StateSpace, plant_of, state_space
from pipeline.loop.velocity_filter import filter_in_w, filter_in_z, filter_order, filter_steps, per_sample
from pipeline.records.trials import Floats

if TYPE_CHECKING:  # loading the classes of this module takes longer than a short command
    from pipeline.device.loop import Loop
    from pipeline.device.parts import LinearFilter


_Number = TypeVar("_Number", np.float64, np.complex128)

LARGEST_DELAY = 256
"""Largest delay factor. For longer delays, the loop matrices of a map would need too much memory."""

LARGEST_FILTER = 96
"""Longest memory of a velocity filter in samples. For longer filters, the computation of boundaries and modes would
take seconds."""

SMALLEST, LARGEST = 1e-60, 1e60
"""Range of a mass per unit of command and of a sampling period, in which units of stiffness and damping neither
overflow nor underflow. The parameters of a device have narrower ranges (`device.parts`)."""

LARGEST_RATE = 1e7
"""Largest entry of the normalised matrix of the device. A lag below 1e-7 samples is ignored."""

_DIGITS = 100
"""Number of digits of quantities that are computed once per loop. Each order adds one digit for the binomial
coefficients. Boundaries need 16 digits at angles of 1e-6, where products of ten factors of 1e-6 are added to terms of
size 1."""

_DIGIT_STEP = 32
"""Step of the number of digits. Loops with similar delays thereby share the quantities that do not depend on the
integer part of the delay."""


@dataclass(frozen=True)
class LoopUnits:
    """Factors between physical and normalised parameters of a wall (Table 3.1).

    Parameters
    ----------
    mass : float
        Effective mass m of the device at the wall, per unit of command [kg, kg m^2], > 0.
    sampling_period_s : float
        Sampling period T [s], > 0.
    """

    mass: float
    sampling_period_s: float

    def __post_init__(self) -> None:
        for name, value in (("mass", self.mass), ("sampling_period_s", self.sampling_period_s)):
            if not (math.isfinite(value) and value > 0):
                raise ParameterError(f"{name} = {value}: expected a positive, finite number.")
            if not SMALLEST <= value <= LARGEST:
                raise ParameterError(f"{name} = {value}: expected a number from {SMALLEST:g} to {LARGEST:g}.")

    @classmethod
    def of(cls, loop: Loop) -> LoopUnits:
        """Return the units of walls for a device."""
        return cls(loop.apparent().mass, loop.sampling_period_s)

    @property
    def stiffness(self) -> float:
        """Stiffness [N/m, Nm/rad] for alpha = 1, m/T^2."""
        return self.mass / self.sampling_period_s**2

    @property
    def damping(self) -> float:
        """Damping [Ns/m, Nms/rad] for beta = 1, m/T."""
        return self.mass / self.sampling_period_s


@dataclass(frozen=True)
class Segment:
    """Part of a sampling interval with constant plant input, with its duration [T] and the delay of the applied force
    [samples]."""

    duration: float
    age: int


@dataclass(frozen=True, eq=False)
class Sampled:
    """Device and filter as ratios of polynomials in w with Decimal coefficients, lowest power first.

    The polynomials of a ratio have equal degree. The ratio of position to wall force is z^-delay force/motion, with the
    delay of the oldest force. The ratio of filtered velocity to position is 2 w/(1 + w) velocity/filter.
    """

    force: Digits
    motion: Digits
    velocity: Digits
    filter: Digits


@dataclass(frozen=True)
class OwnSteps:
    """Transition over a sample of all states except delayed forces: ``free`` (own, own) and ``gains`` of the segments.

    ``position`` and ``velocity`` are the rows (own,) of sensed position and filtered velocity. All have type Decimal.
    """

    free: Digits
    gains: tuple[Digits, ...]
    position: Digits
    velocity: Digits


@dataclass(frozen=True)
class NormalisedLoop:
    """Plant with delay, velocity filter and no particular wall. The wall (alpha, beta) is an argument of the methods.

    The loop is linear. It consists of a continuous device with two to five states and a wall law with a filter.

    Parameters
    ----------
    plant : Plant
        Plant of mass 1, with the sampling period as the unit of time: stiffness gamma = k T^2/m and damping delta =
        b T/m, with gamma <= pi^2 + delta^2/4, both >= 0 and <= 1e7.
    delay : float
        Delay factor d = t_d/T, integer or fractional, 0 <= d <= 256.
    velocity : LinearFilter, optional
        Filter with frequencies relative to the sampling rate and a memory of at most 96 samples.

    Raises
    ------
    ParameterError
        If a parameter is outside its range.

    Notes
    -----
    The states are those of the device, the last sampled position, those of the filter, and the wall forces of the last
    samples, newest first. An ideal loop with integer d has d + 3 states (eq. 3.18).

    With w = (z - 1)/(z + 1), the unit circle is the imaginary axis, and both of its ends have full precision (slow
    motion at w = 0, half the sampling rate at w = infinity). The transfer functions of device and filter are therefore
    polynomials in w, with many digits (`Sampled`).

    Examples
    --------
    >>> NormalisedLoop.ideal(0.0, 0.01, 2.0).states
    5
    """

    plant: Plant
    delay: float
    velocity: LinearFilter | None = None

    @classmethod
    def ideal(cls, gamma: float, delta: float, delay: float) -> NormalisedLoop:
        """Return the loop of a mass with damper and spring, with the backward difference as velocity."""
        return cls(Plant(1.0, delta, gamma), delay)

    @classmethod
    def of(cls, loop: Loop) -> NormalisedLoop:
        """Return the normalised loop of a device, without parts that linear theory cannot include (`Loop.left_out`).

        Raises
        ------
        ParameterError
            If a normalised parameter is outside its range.
        """
        device = loop.normalised()
        return cls(plant_of(device), device.delay_samples, per_sample(device.velocity, 1.0))

    def __post_init__(self) -> None:
        numbers = {"gamma": self.gamma, "delta": self.delta, "delay": self.delay, "lag": self.plant.lag}
        for name, value in numbers.items():
            if not math.isfinite(value) or value < 0:
                raise ParameterError(f"{name} = {value}: expected a finite nonnegative number.")
        if self.delay > LARGEST_DELAY:
            raise ParameterError(f"delay = {self.delay} samples: expected at most {LARGEST_DELAY}.")
        order = filter_order(self.velocity)
        if order > LARGEST_FILTER:
            raise ParameterError(f"the velocity filter uses {order} past samples: expected at most {LARGEST_FILTER}.")
        if self.delta > LARGEST_RATE:
            raise ParameterError(f"delta = {self.delta}: expected at most {LARGEST_RATE:g}.")
        largest = math.pi**2 + self.delta**2 / 4
        if self.gamma > largest:
            raise ParameterError(
                f"gamma = {self.gamma}: expected at most pi^2 + delta^2/4 = {largest:.6g} (4.15). Above it, the plant "
                "oscillates faster than it is sampled."
            )
        rate = float(np.abs(self.device.matrix).max())
        if rate > LARGEST_RATE:
            raise ParameterError(
                f"the fastest motion of the device takes {1 / rate:.2g} sampling periods: expected at least "
                f"{1 / LARGEST_RATE:g}. Remove the fast lag or mode."
            )

    @property
    def gamma(self) -> float:
        """Normalised stiffness of the device, k T^2/m."""
        return self.plant.stiffness

    @property
    def delta(self) -> float:
        """Normalised damping of the device, b T/m."""
        return self.plant.damping

    @cached_property
    def lag(self) -> float:
        """Delay that the actuator adds to a slow command [sampling periods].

        For a first-order lag, it is the time constant.
        """
        return self.device.mean_lag

    def with_delta(self, delta: float) -> NormalisedLoop:
        """Return the loop with a new damping of the device."""
        return replace(self, plant=replace(self.plant, damping=delta))

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """Parts of a sampling interval in order.

        There is one for an integer delay, and there are two for a fractional delay.
        """
        whole = math.floor(self.delay)
        fraction = self.delay - whole
        if fraction == 0:
            return (Segment(1.0, whole),)
        return Segment(fraction, whole + 1), Segment(1.0 - fraction, whole)

    @property
    def oldest_force(self) -> int:
        """Age in samples of the oldest wall force that still acts."""
        return self.segments[0].age

    @cached_property
    def device(self) -> StateSpace:
        """Continuous device."""
        return state_space(self.plant)

    @property
    def digits(self) -> int:
        """Number of digits of quantities that are computed once per loop."""
        needed = _DIGITS + int(self.delay) + filter_order(self.velocity)
        return -(-needed // _DIGIT_STEP) * _DIGIT_STEP

    @cached_property
    def pushes(self) -> tuple[Digits, tuple[Digits, ...]]:
        """Transition over a sampling interval, and input gain of the force in each segment."""
        return pushes(self.plant, tuple(segment.duration for segment in self.segments), self.digits)

    @cached_property
    def sampled(self) -> Sampled:
        """Exact transfer functions in w."""
        durations = tuple(segment.duration for segment in self.segments)
        return sampled(self.plant, durations, self.velocity, self.digits)

    @cached_property
    def filter_in_z(self) -> tuple[Floats, Floats]:
        """Coefficients b and a of the velocity filter in powers of 1/z, with a[0] = 1."""
        with many_digits(self.digits):
            b, a = filter_in_z(self.velocity)
            return as_floats(b), as_floats(a)

    @cached_property
    def own(self) -> OwnSteps:
        """Exact transition over one sampling period of all states except the delayed forces."""
        whole, gains = self.pushes
        with many_digits(self.digits):
            b, a, keep, rise = filter_steps(self.velocity)
            p, f = len(whole), len(b) - 1
            free, position = as_exact(np.zeros((p + 1 + f, p + 1 + f))), as_exact(np.zeros(p + 1 + f))
            position[:p] = as_exact(self.device.sensor)
            difference = position.copy()
            difference[p] -= 1
            velocity = b[0] * difference
            velocity[p + 1 : p + 2] += 1
            free[:p, :p], free[p] = whole, position
            for i in range(1, f + 1):
                free[p + i] = b[i] * difference - a[i] * velocity
                free[p + i, p + i] += Decimal(keep)
                free[p + i, p + i + 1 : p + f + 1] += as_exact([rise, *[0] * (f - 1 - i)][: f - i])
            return OwnSteps(free, tuple(np.append(gain, as_exact([0] * (f + 1))) for gain in gains), position, velocity)

    @cached_property
    def open_loop(self) -> tuple[Floats, Floats, Floats, Floats]:
        """State matrix (n, n) without a wall, input column of the wall force, and output rows of position and velocity.

        The position is sensed, and the velocity is filtered. The states are those of the device, the last sampled
        position, those of the filter, and the wall forces of the last samples, newest first.
        """
        steps, delay = self.own, self.oldest_force
        own = len(steps.free)
        matrix, (push, position, velocity) = np.zeros((own + delay, own + delay)), np.zeros((3, own + delay))
        matrix[:own, :own], position[:own], velocity[:own] = map(
            as_floats, (steps.free, steps.position, steps.velocity)
        )
        for segment, gain in zip(self.segments, steps.gains, strict=True):
            if segment.age == 0:
                push[:own] += as_floats(gain)
            else:
                matrix[:own, own - 1 + segment.age] += as_floats(gain)
        if delay:
            push[own] = 1.0
            matrix[own + 1 :, own:-1] = np.eye(delay - 1)
        return matrix, push, position, velocity

    @property
    def states(self) -> int:
        """Number of states of the loop."""
        return len(self.open_loop[0])

    def matrix(self, alpha: Floats, beta: Floats) -> Floats:
        """Return the loop matrices A with z_{k+1} = A z_k, shape (n, states, states)."""
        free, push, _, _ = self.open_loop
        return np.asarray(free + push[:, None] * self.law(alpha, beta)[:, None, :])

    def law(self, alpha: Floats, beta: Floats) -> Floats:
        """Return the feedback rows from the state to the wall force, shape (n, states)."""
        _, _, position, velocity = self.open_loop
        return np.asarray(-np.asarray(alpha)[:, None] * position - np.asarray(beta)[:, None] * velocity)

    def seen(self, law: Floats, values: NDArray[_Number]) -> NDArray[_Number]:
        """Return the quantities that determine the motion in a sampling interval, shape (n, q, m).

        The ``values`` are states of shape (n, states, m).

        These quantities are the device state at the start of the interval and the wall force in each of the `segments`.
        The newest wall force follows from the ``law`` of each point.
        """
        p, newest = len(self.device.sensor), self.states - self.oldest_force - 1
        forces = [
            values[:, newest + part.age] if part.age else np.einsum("ns,nsm->nm", law, values) for part in self.segments
        ]
        return np.concatenate([values[:, :p], np.stack(forces, axis=1)], axis=1)

    def starts(self, alpha: Floats, signal: str) -> Floats:
        """Return z_0 of each point, shape (n, states).

        A ``step`` (deviation -1 from the final position, at rest) is part of the command and passes through the lag. An
        ``impulse`` is an impact of unit momentum on the motor side.
        """
        p = len(self.device.sensor)
        z = np.zeros((len(alpha), self.states))
        if signal == "impulse":
            z[:, :p] = self.device.force
            return z
        if signal != "step":
            raise ParameterError(f"signal = {signal!r}: expected 'step' or 'impulse'.")
        z[:, :p] = -self.gamma * self.device.at_rest
        z[:, 0] = z[:, p] = -1.0
        z[:, self.states - self.oldest_force :] = np.asarray(alpha)[:, None]
        return z


def moved(plant: Plant, duration: float, digits: int) -> tuple[Digits, Digits]:
    """Return the exact transition (n, n) and input gain (n,) of a plant over a time [T] with constant input."""
    device = state_space(plant)
    n = device.states
    both = as_exact(np.zeros((n + 1, n + 1)))
    both[:n, :n], both[:n, n] = as_exact(device.matrix), as_exact(device.command)
    with many_digits(digits):
        result = exponential(both * Decimal(duration), digits)
    return result[:n, :n], result[:n, n]


@lru_cache(maxsize=64)
def pushes(plant: Plant, durations: tuple[float, ...], digits: int) -> tuple[Digits, tuple[Digits, ...]]:
    """Return the transition over segments of an interval, and the input gain of the force in each segment."""
    with many_digits(digits):
        whole = unit(state_space(plant).states)
        gains: list[Digits] = []
        for transition, gain in (moved(plant, duration, digits) for duration in durations):
            whole = transition @ whole
            gains = [transition @ earlier for earlier in gains] + [gain]
    return whole, tuple(gains)


@lru_cache(maxsize=64)
def sampled(plant: Plant, durations: tuple[float, ...], velocity: LinearFilter | None, digits: int) -> Sampled:
    """Return the exact transfer functions, which all delays with the same segments share."""
    with many_digits(digits):
        whole, gains = pushes(plant, durations, digits)
        bottom, adjugate = resolvent(whole)
        tops = [as_exact(state_space(plant).sensor) @ adjugate @ gain for gain in gains]
        # the newer force was computed one sample later, so its polynomial is multiplied by z
        top = total(tops[0], np.append(as_exact([0]), tops[1])) if len(tops) > 1 else tops[0]
        n = len(bottom) - 1
        return Sampled(bilinear(top, n), bilinear(bottom, n), *filter_in_w(velocity))


def as_points(alpha: object, beta: object) -> tuple[Floats, Floats]:
    """Return alpha and beta as finite float arrays of equal shape (n,).

    Raises
    ------
    ParameterError
        If the lengths differ, or a value is not finite.
    """
    a, b = np.broadcast_arrays(
        np.atleast_1d(np.asarray(alpha, dtype=np.float64)), np.atleast_1d(np.asarray(beta, dtype=np.float64))
    )
    if a.ndim != 1:
        raise ParameterError(f"alpha and beta have {a.ndim} dimensions; expected a list of points.")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ParameterError("alpha and beta must be finite numbers.")
    return np.ascontiguousarray(a), np.ascontiguousarray(b)
