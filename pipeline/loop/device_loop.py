"""The loop of a device that is not ideal: velocity filter, actuator lag, vibration mode; normalised like `Loop`.

A gain and an operator change nothing but the mass, damping and stiffness that the wall feels, so they are in the units
(`wall_units`) and leave the loop ideal. What is left is linear too: a continuous device with two to five states behind
a delay, and a wall law with a filter.

With w = (z - 1)/(z + 1) the unit circle is the imaginary axis, and both ends of it (slow motion at w = 0, half the
sampling rate at w = infinity) keep their digits. The transfer functions of device and filter are therefore kept as
polynomials in w, exact to many digits: `Sampled`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import LARGEST_DELAY, Loop, Normalised
from pipeline.loop.many_digits import Digits, as_exact, as_floats, bilinear, exponential, many_digits, total
from pipeline.loop.plant import Flow
from pipeline.loop.velocity_filter import filter_in_w, filter_in_z, filter_order, filter_steps, per_sample
from pipeline.records.batch import Floats

if TYPE_CHECKING:  # its classes take longer to load than a short command to run
    from pipeline.records.loop_parts import LoopParts, VelocityFilter

_Number = TypeVar("_Number", np.float64, np.complex128)

LARGEST_ORDER = 96
"""Delay [samples] plus length of the filter; its square is the time that the boundary takes: seconds beyond this."""

LARGEST_RATE = 1e7
"""Largest entry of the device's normalised matrix; a lag of 1e-7 samples is none."""

_DIGITS = 100
"""Digits of what is computed once, and one for each order, whose binomials take them. Boundaries need 16 at angles of
1e-6, where products of ten factors of 1e-6 meet others of 1."""


@dataclass(frozen=True)
class Vibration:
    """A mode, normalised: a mass far from the motor on a spring and damper, as shares of the mass of all.

    Parameters
    ----------
    far_mass : float
        Share of the far mass, in (0, 1).
    stiffness, damping : float
        Of the spring between both, normalised like gamma and delta.
    sensor_far : bool
        Whether the position is sensed at the far mass.
    """

    far_mass: float
    stiffness: float
    damping: float
    sensor_far: bool


@dataclass(frozen=True)
class Sampled:
    """Delayed device and filter as ratios of polynomials in w, each pair of one degree; Decimal, lowest power first.

    Position over wall force is z^-delay force/motion, filtered velocity over position
    2 w/(1 + w) velocity/filter.
    """

    delay: int
    force: Digits
    motion: Digits
    velocity: Digits
    filter: Digits


@dataclass(frozen=True)
class OwnSteps:
    """What a sample makes of all states but the delayed forces: ``free`` (own, own), and ``gains`` of the segments.

    ``position`` and ``velocity`` are the rows (own,) of sensed position and filtered velocity; all Decimal.
    """

    free: Digits
    gains: tuple[Digits, ...]
    position: Digits
    velocity: Digits


@dataclass(frozen=True)
class DeviceLoop(Loop):
    """A linear device behind a delay and a lag, with a velocity filter, without its wall.

    Parameters
    ----------
    gamma, delta, delay : float
        As of `Loop`; gamma and delta of the motor's side with what holds it, per mass of all.
    lag : float
        Time constant of the actuator [T], >= 0.
    mode : Vibration, optional
    velocity : VelocityFilter, optional
        With frequencies per sampling rate.

    Raises
    ------
    ParameterError
        If a parameter is out of range, or delay and filter together are longer than 96 samples (256 without parts).
    """

    lag: float = 0.0
    mode: Vibration | None = None
    velocity: VelocityFilter | None = None

    def __post_init__(self) -> None:
        for name, value in (("gamma", self.gamma), ("delta", self.delta), ("delay", self.delay), ("lag", self.lag)):
            if not math.isfinite(value) or value < 0:
                raise ParameterError(f"{name} = {value}: expected a finite number that is not negative.")
        order = self.delay + filter_order(self.velocity)
        plain = self.velocity is None and self.mode is None and self.lag == 0
        if order > (LARGEST_DELAY if plain else LARGEST_ORDER):
            raise ParameterError(
                f"delay and velocity filter together last {order:g} samples: expected at most {LARGEST_ORDER}."
            )
        rate = float(np.abs(self.device[0]).max())
        if rate > LARGEST_RATE:
            raise ParameterError(
                f"the device changes within {1 / rate:.2g} sampling periods: expected no faster than "
                f"{1 / LARGEST_RATE:g}. Leave out the lag or mode that is so fast."
            )

    @cached_property
    def device(self) -> tuple[Floats, Floats, Floats]:
        """Continuous device: its matrix (n, n), the input's column (n,) and the row of the sensed position (n,).

        States: position and velocity of the centre of mass; with a mode the distance of the far mass from it, and its
        rate; with a lag the actuator's force. So a blow on however light a near side is one of 1 in each.
        """
        mode = self.mode or Vibration(0.0, 0.0, 0.0, False)
        count = 2 + 2 * (self.mode is not None)
        near = 1.0 - mode.far_mass
        motor = np.array([1.0, -mode.far_mass / near])[: count // 2]
        held = -np.kron(motor, [self.gamma, self.delta])
        matrix, push, sensor = np.zeros((count, count)), np.zeros(count), np.zeros(count)
        matrix[0, 1] = push[1] = 1.0
        matrix[1] = held
        sensor[::2] = motor
        if self.mode is not None:
            matrix[2, 3] = 1.0
            matrix[3] = -held
            matrix[3, 2:] -= np.array([mode.stiffness, mode.damping]) * (1 / mode.far_mass + 1 / near)
            push[3] = -1.0
            if mode.sensor_far:
                sensor[2] = 1.0
        if self.lag == 0:
            return matrix, push, sensor
        lagged = np.zeros((count + 1, count + 1))
        lagged[:count, :count], lagged[:count, count], lagged[count, count] = matrix, push, -1 / self.lag
        return lagged, np.append(np.zeros(count), 1 / self.lag), np.append(sensor, 0.0)

    @property
    def digits(self) -> int:
        """Digits for what is computed once."""
        return _DIGITS + int(self.delay) + filter_order(self.velocity)

    def moved(self, duration: float) -> tuple[Digits, Digits]:
        """Return the exact transition (n, n) and input gain (n,) over a time [T] with constant input."""
        matrix, push, _ = self.device
        n = len(matrix)
        both = as_exact(np.zeros((n + 1, n + 1)))
        both[:n, :n], both[:n, n] = as_exact(matrix), as_exact(push)
        with many_digits(self.digits):
            result = exponential(both * Decimal(duration), self.digits)
        return result[:n, :n], result[:n, n]

    @cached_property
    def over_segments(self) -> tuple[tuple[Digits, Digits], ...]:
        """Exact motion over each of `segments`."""
        return tuple(self.moved(segment.duration) for segment in self.segments)

    @cached_property
    def pushes(self) -> tuple[Digits, tuple[Digits, ...]]:
        """Transition of a whole sampling interval, and what the force of each segment adds at its end."""
        with many_digits(self.digits):
            whole = as_exact(np.eye(len(self.device[1])))
            gains: list[Digits] = []
            for transition, gain in self.over_segments:
                whole = transition @ whole
                gains = [transition @ earlier for earlier in gains] + [gain]
        return whole, tuple(gains)

    @cached_property
    def sampled(self) -> Sampled:
        """Transfer functions in w; exact."""
        with many_digits(self.digits):
            whole, gains = self.pushes
            bottom, tops = _transfer(whole, gains, as_exact(self.device[2]))
            # the newer force comes first by one sample: z times its polynomial
            top = total(tops[0], np.append(as_exact([0]), tops[1])) if len(tops) > 1 else tops[0]
            n = len(bottom) - 1
            return Sampled(self.oldest_force, bilinear(top, n), bilinear(bottom, n), *filter_in_w(self.velocity))

    @cached_property
    def filter_in_z(self) -> tuple[Floats, Floats]:
        """Coefficients b and a of the velocity filter in powers of 1/z, a[0] = 1."""
        with many_digits(self.digits):
            b, a = filter_in_z(self.velocity)
            return as_floats(b), as_floats(a)

    @cached_property
    def own(self) -> OwnSteps:
        """Motion of all states but the delayed forces, over a sample; exact."""
        whole, gains = self.pushes
        with many_digits(self.digits):
            b, a, keep, rise = filter_steps(self.velocity)
            p, f = len(whole), len(b) - 1
            free, position = as_exact(np.zeros((p + 1 + f, p + 1 + f))), as_exact(np.zeros(p + 1 + f))
            position[:p] = as_exact(self.device[2])
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
        """State matrix (n, n) without wall, column of the wall's force, rows of sensed position and filtered velocity.

        States: the device's, the last sampled position, the filter's, and the wall's forces of the last samples, newest
        first.
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

    @cached_property
    def flows(self) -> tuple[Flow, ...]:
        """Not for this loop: whoever asks takes it for an ideal one."""
        raise ParameterError(f"{self}: this quantity is known for ideal loops only, without filter, lag and mode.")

    @cached_property
    def period(self) -> Flow:
        """Not for this loop, as `flows`."""
        return self.flows[0]

    def matrix(self, alpha: Floats, beta: Floats) -> Floats:
        """Return the loop matrices A with z_{k+1} = A z_k, shape (n, states, states)."""
        free, push, _, _ = self.open_loop
        return np.asarray(free + push[:, None] * self.law(alpha, beta)[:, None, :])

    def law(self, alpha: Floats, beta: Floats) -> Floats:
        """Return the rows that make the wall's force of the state, shape (n, states)."""
        _, _, position, velocity = self.open_loop
        return np.asarray(-np.asarray(alpha)[:, None] * position - np.asarray(beta)[:, None] * velocity)

    def seen(self, law: Floats, values: NDArray[_Number]) -> NDArray[_Number]:
        """Return what a sampling interval's motion follows from, shape (n, q, m), of states, shape (n, states, m).

        The device's state at the start, and the wall's force in each of `segments`, for the ``law`` of each point.
        """
        p, newest = len(self.device[1]), self.states - self.oldest_force - 1
        forces = [
            values[:, newest + part.age] if part.age else np.einsum("ns,nsm->nm", law, values) for part in self.segments
        ]
        return np.concatenate([values[:, :p], np.stack(forces, axis=1)], axis=1)

    def starts(self, alpha: Floats, signal: str) -> Floats:
        """Return z_0 of each point, shape (n, states).

        A ``step`` (deviation -1 from the final position, at rest) is part of the command, so it passes the lag; an
        ``impulse`` is a hit of unit momentum on the motor's side.
        """
        p = len(self.device[1])
        z = np.zeros((len(alpha), self.states))
        if signal == "impulse":
            z[:, 1] = 1.0
            if self.mode is not None:
                z[:, 3] = -1.0
            return z
        if signal != "step":
            raise ParameterError(f"signal = {signal!r}: expected 'step' or 'impulse'.")
        z[:, 0] = z[:, p] = -1.0
        if self.lag > 0:
            z[:, p - 1] = -self.gamma
        z[:, self.states - self.oldest_force :] = np.asarray(alpha)[:, None]
        return z


def general(loop: Loop) -> DeviceLoop:
    """Return a loop as a general one, also where it is ideal."""
    return loop if isinstance(loop, DeviceLoop) else DeviceLoop(loop.gamma, loop.delta, loop.delay)


def has_general(loop: Loop) -> bool:
    """Return whether `general` takes a loop: not an ideal one whose motion ends within 1e-7 samples."""
    return isinstance(loop, DeviceLoop) or max(loop.gamma, loop.delta) <= LARGEST_RATE


def wall_units(mass: float, sampling_period_s: float, parts: LoopParts) -> Normalised:
    """Return the units of a device's wall: its mass with the operator's, per unit of command."""
    held = parts.operator.mass if parts.operator is not None else 0.0
    return Normalised((mass + held) / parts.force_gain, sampling_period_s)


def loop_of(
    mass: float,
    damping: float,
    stiffness: float,
    delay_samples: float,
    sampling_period_s: float,
    parts: LoopParts,
) -> Loop:
    """Return the normalised loop of a device: an ideal one where its parts leave it ideal.

    Parameters
    ----------
    mass, damping, stiffness : float
        Of the device, both sides of a mode together, without operator: m [kg, kg m^2], b [Ns/m, Nms/rad] and
        k [N/m, Nm/rad].
    delay_samples : float
        t_d/T, integer or fractional.
    sampling_period_s : float
        T [s].
    parts : LoopParts
        Friction is no part of a linear loop (`LoopParts.left_out`).

    Raises
    ------
    ParameterError
        If a parameter is out of range, or parts do not fit mass or sampling period.
    """
    mistakes = parts.mistakes(mass, sampling_period_s)
    if mistakes:
        raise ParameterError("; ".join(mistakes))
    operator, mode = parts.operator, parts.mode
    everything = mass
    if operator is not None:
        everything, damping, stiffness = (
            mass + operator.mass,
            damping + operator.damping,
            stiffness + operator.stiffness,
        )
    ideal = Normalised(everything, sampling_period_s).loop(stiffness, damping, delay_samples)
    if _is_ideal(parts):
        return ideal
    vibration = None
    if mode is not None:
        # the free-free resonance is that of the device alone, without the operator
        reduced = mode.mass * (mass - mode.mass) / mass / everything
        turn = 2 * math.pi * mode.frequency_hz * sampling_period_s
        vibration = Vibration(
            mode.mass / everything, reduced * turn**2, 2 * mode.damping_ratio * turn * reduced, mode.sensor == "load"
        )
    return DeviceLoop(
        ideal.gamma,
        ideal.delta,
        delay_samples,
        parts.actuator_lag_s / sampling_period_s,
        vibration,
        per_sample(parts.velocity, sampling_period_s),
    )


def longest_delay(parts: LoopParts) -> int:
    """Return the delay [samples] up to which theory is computed for a loop with these parts."""
    return LARGEST_DELAY if _is_ideal(parts) else LARGEST_ORDER - filter_order(parts.velocity)


def _is_ideal(parts: LoopParts) -> bool:
    velocity = parts.velocity
    plain = velocity is None or (velocity.kind == "difference" and velocity.samples == 1)
    return plain and parts.mode is None and parts.actuator_lag_s == 0


def _transfer(whole: Digits, gains: tuple[Digits, ...], sensor: Digits) -> tuple[Digits, list[Digits]]:
    """Return the characteristic polynomial in z, and the numerator of each gain (Faddeev and LeVerrier)."""
    n = len(whole)
    one = as_exact(np.eye(n))
    adjugate, bottom = one, [Decimal(1)]
    tops: list[list[Decimal]] = [[] for _ in gains]
    for k in range(1, n + 1):
        for top, gain in zip(tops, gains, strict=True):
            top.append(sensor @ adjugate @ gain)
        turned = whole @ adjugate
        bottom.append(-sum(np.diagonal(turned), Decimal(0)) / k)
        adjugate = turned + bottom[-1] * one
    return np.array(bottom[::-1], dtype=object), [np.array(top[::-1], dtype=object) for top in tops]
