"""The sampled, delayed loop of virtual wall and device: its only definition on the theory side.

Everything is normalised (Table 3.1): time by the sampling period T, alpha = K T^2/m, beta = B T/m,
gamma = k T^2/m, delta = b T/m, d = t_d/T. The wall force of sample k acts on [k + d, k + 1 + d), also for
fractional d, where the plant input switches inside an interval (modified z-transform); an external step or impulse
acts at sample 0 without delay. Responses are written as deviations from the final position, relative to the final
displacement: they obey the homogeneous equation and lose no digits while they decay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.plant import Flow, flow, horner, motion_series
from pipeline.records.batch import Floats

LARGEST_DELAY = 256
"""Largest delay factor; beyond it the loop matrices of a map no longer fit into memory sensibly."""

LARGEST_DELTA = 1e100
"""Largest normalised damping of the device; far above it the products that describe its motion overflow."""


@dataclass(frozen=True)
class Normalised:
    """Factors between physical and normalised parameters (Table 3.1).

    Parameters
    ----------
    mass : float
        m [kg, kg m^2], > 0.
    sampling_period_s : float
        T [s], > 0.
    """

    mass: float
    sampling_period_s: float

    def __post_init__(self) -> None:
        for name, value in (("mass", self.mass), ("sampling_period_s", self.sampling_period_s)):
            if not (math.isfinite(value) and value > 0):
                raise ParameterError(f"{name} = {value}: expected a positive, finite number.")

    @property
    def stiffness(self) -> float:
        """Stiffness [N/m, Nm/rad] that alpha = 1 stands for: m/T^2."""
        return self.mass / self.sampling_period_s**2

    @property
    def damping(self) -> float:
        """Damping [Ns/m, Nms/rad] that beta = 1 stands for: m/T."""
        return self.mass / self.sampling_period_s

    def loop(self, stiffness: float, damping: float, delay_samples: float) -> Loop:
        """Return the normalised loop of a device with physical stiffness k, damping b and delay factor d."""
        return Loop(stiffness / self.stiffness, damping / self.damping, delay_samples)


@dataclass(frozen=True)
class Segment:
    """Part of a sampling interval with constant plant input: duration [T] and age of the force in samples."""

    duration: float
    age: int


@dataclass(frozen=True)
class Loop:
    """A plant behind a delay, without its wall; alpha and beta are arguments of what is computed from it.

    Parameters
    ----------
    gamma, delta : float
        Normalised physical stiffness and damping, >= 0; gamma <= pi^2 + delta^2/4, delta <= 1e100.
    delay : float
        Delay factor d = t_d/T, 0 <= d <= 256, integer or fractional.

    Raises
    ------
    ParameterError
        If a parameter is outside its range.

    Notes
    -----
    State z = (e_k, v_k, e_{k-1}, ..., e_{k-p}) with p = d + 1 for integer d (eq. 3.18: d + 3 states) and one more
    for fractional d.
    """

    gamma: float
    delta: float
    delay: float

    def __post_init__(self) -> None:
        for name, value in (("gamma", self.gamma), ("delta", self.delta), ("delay", self.delay)):
            if not math.isfinite(value) or value < 0:
                raise ParameterError(f"{name} = {value}: expected a finite number that is not negative.")
        if self.delay > LARGEST_DELAY:
            raise ParameterError(f"delay = {self.delay} samples: expected at most {LARGEST_DELAY}.")
        if self.delta > LARGEST_DELTA:
            raise ParameterError(f"delta = {self.delta}: expected at most {LARGEST_DELTA:g}.")
        largest = math.pi**2 + self.delta**2 / 4
        if self.gamma > largest:
            raise ParameterError(
                f"gamma = {self.gamma}: expected at most pi^2 + delta^2/4 = {largest:.6g} (4.15); above it the plant "
                "swings faster than it is sampled."
            )

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """Parts of a sampling interval, in order: one for an integer delay, two for a fractional one."""
        whole = math.floor(self.delay)
        fraction = self.delay - whole
        if fraction == 0:
            return (Segment(1.0, whole),)
        return Segment(fraction, whole + 1), Segment(1.0 - fraction, whole)

    @cached_property
    def flows(self) -> tuple[Flow, ...]:
        """Exact motion over each segment."""
        return tuple(flow(self.gamma, self.delta, s.duration) for s in self.segments)

    @cached_property
    def period(self) -> Flow:
        """Exact motion over a whole sampling interval."""
        return flow(self.gamma, self.delta, 1.0)

    @cached_property
    def _series(self) -> tuple[list[float], list[float]] | None:
        return motion_series(self.gamma, self.delta)

    def position_after(self, time: Floats, position: Floats, velocity: Floats, force: Floats) -> Floats:
        """Return the deviation after times in [0, 1] with constant input, from position and velocity at its start.

        All have one shape, that of the result, and are normalised (Table 3.1).
        """
        if self._series is not None:
            impulse, gain = self._series
            moved: Floats = time * (velocity * horner(impulse, time))
            return position + moved + time * time * ((force - self.gamma * position) * horner(gain, time))
        motion = flow(self.gamma, self.delta, time)
        moved = motion.transition[..., 0, 1] * velocity + motion.gain[..., 0] * force
        return motion.transition[..., 0, 0] * position + moved

    @property
    def oldest_force(self) -> int:
        """Age in samples of the oldest wall force that still acts."""
        return self.segments[0].age

    @property
    def states(self) -> int:
        """Number of states of the loop."""
        return self.oldest_force + 3

    def force_rows(self, alpha: Floats, beta: Floats, age: int) -> Floats:
        """Return the rows f with u = f @ z for the wall force of the sample ``age`` periods ago, shape (n, states).

        Source: Hulin 2017, eq. 3.1: minus alpha x_k minus beta (x_k - x_{k-1}).
        """
        rows = np.zeros((len(alpha), self.states))
        now, before = (0, 2) if age == 0 else (age + 1, age + 2)
        rows[:, now] = -(alpha + beta)
        rows[:, before] = beta
        return rows

    def segment_maps(self, alpha: Floats, beta: Floats) -> list[tuple[Floats, Floats]]:
        """Return for each segment the maps from z to (e, v) at its start (n, 2, states) and to its input (n, states).

        A last entry holds the end of the interval.
        """
        start = np.zeros((len(alpha), 2, self.states))
        start[:, 0, 0] = start[:, 1, 1] = 1.0
        maps = []
        for segment, motion in zip(self.segments, self.flows, strict=True):
            force = self.force_rows(alpha, beta, segment.age)
            maps.append((start, force))
            start = motion.transition @ start + motion.gain[None, :, None] * force[:, None, :]
        maps.append((start, force))
        return maps

    def matrix(self, alpha: Floats, beta: Floats) -> Floats:
        """Return the loop matrices A with z_{k+1} = A z_k, shape (n, states, states)."""
        result = np.zeros((len(alpha), self.states, self.states))
        result[:, :2] = self.segment_maps(alpha, beta)[-1][0]
        result[:, 2, 0] = 1.0
        for i in range(3, self.states):
            result[:, i, i - 1] = 1.0
        return result

    def initial(self, signal: str) -> Floats:
        """Return z_0 for a ``step`` (deviation -1 from the final position, at rest) or ``impulse`` (unit velocity)."""
        z = np.zeros(self.states)
        if signal == "step":
            z[:] = -1.0
            z[1] = 0.0
        elif signal == "impulse":
            z[1] = 1.0
        else:
            raise ParameterError(f"signal = {signal!r}: expected 'step' or 'impulse'.")
        return z


def as_points(alpha: object, beta: object) -> tuple[Floats, Floats]:
    """Return alpha and beta as equally long, finite float arrays of shape (n,).

    Raises
    ------
    ParameterError
        If lengths differ or a value is not finite.
    """
    a, b = np.broadcast_arrays(
        np.atleast_1d(np.asarray(alpha, dtype=np.float64)), np.atleast_1d(np.asarray(beta, dtype=np.float64))
    )
    if a.ndim != 1:
        raise ParameterError(f"alpha and beta have {a.ndim} dimensions; expected a list of points.")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ParameterError("alpha and beta must be finite numbers.")
    return np.ascontiguousarray(a), np.ascontiguousarray(b)
