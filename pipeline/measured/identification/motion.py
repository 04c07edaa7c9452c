"""Compute the exact motion of a device between two readings under a delayed command, for even and uneven rows.

Time is in sampling periods, and the mass is 1. The states of the device are those of `loop.state_space`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from pipeline.loop.state_space import Plant, state_space
from pipeline.measured.identification.kernels import exponentials
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats, Integers

LARGEST_LOAD = 0.97
"""Largest load, as a fraction of the mass. If the motor is lighter, the logs show only that it is light."""

SMALL = 1e-20
"""Imaginary perturbation of a number for the derivative of a matrix. Its square vanishes by rounding."""

SHORTEST_LAG = 0.02
"""Shortest lag [samples] that counts as a part. A shorter lag shifts the position by less than a sensor resolves."""


@dataclass(frozen=True)
class PlantShape:
    """Numbers that determine the shape of a device's motion, per sample and for a mass of 1.

    Parameters
    ----------
    delta, gamma : float
        Damping and stiffness.
    delay, lag : float
        Delay of the command, and time constant of the actuator [samples].
    mode_frequency : float
        Frequency of a vibration mode [rad/sample].
    mode_damping_ratio : float
        Total damping ratio of the vibration, including the damping of both sides. It is better identified than its
        components.
    load_mass_fraction : float
        Fraction of the mass that is the load. There is no mode if this fraction and ``spring_damping_fraction`` are
        both 0.
    load_damping : float
        Part of ``delta`` that acts on the load.
    spring_damping_fraction : float
        Share of the loss that occurs in the damper between both sides. The rest occurs at the motor. It replaces
        ``load_mass_fraction`` if the position of the load is measured, since any load mass then gives the same motion.
    """

    delta: float = 0.0
    gamma: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    mode_frequency: float = 0.0
    mode_damping_ratio: float = 0.0
    load_mass_fraction: float = 0.0
    load_damping: float = 0.0
    spring_damping_fraction: float = 0.0

    @classmethod
    def of(cls, numbers: Mapping[str, float]) -> PlantShape:
        """Return the shape of a device with the given numbers. Numbers that do not affect the shape are ignored."""
        return cls(**{name: numbers[name] for name in SHAPE_NUMBERS if name in numbers})

    @property
    def load_mass(self) -> float:
        """Mass of the load for a total mass of 1, or 0 without a mode."""
        if not self.spring_damping_fraction:
            return self.load_mass_fraction
        lost = 2 * self.mode_damping_ratio * self.mode_frequency * (1 - self.spring_damping_fraction)
        # a lighter motor absorbs more of a vibration by its damping, and nothing without damping
        load = lost / (lost + self.delta) if np.real(self.delta) > 0 else LARGEST_LOAD
        return load if np.real(load) < LARGEST_LOAD else LARGEST_LOAD

    @property
    def plant(self) -> Plant:
        """Linear plant of this shape."""
        load = self.load_mass
        if not load:
            return Plant(1.0, self.delta, self.gamma, self.lag)
        motor = 1 - load
        lost = (self.delta - self.load_damping) * load / motor + self.load_damping * motor / load
        reduced, damper = motor * load, 2 * self.mode_damping_ratio * self.mode_frequency - lost
        return Plant(
            1.0,
            self.delta,
            self.gamma,
            self.lag,
            load,
            self.load_damping,
            reduced * self.mode_frequency**2,
            reduced * damper,
            bool(self.spring_damping_fraction),
        )


SHAPE_NUMBERS = tuple(each.name for each in fields(PlantShape))
"""Names of the numbers of `PlantShape`, in order."""


@lru_cache(maxsize=64)
def matrices_of(shape: PlantShape, along: tuple[str, ...]) -> tuple[Floats, Floats]:
    """Return the matrix of motion and inputs, (1 + P, n + 2, n + 2), and the sensor row, (1 + P, n), of a shape.

    The inputs are a command and a force on the motor. Derivatives along P parameters follow the first entry. They are
    complex-step derivatives of the entries of the state space, which are rational in the parameters. The arrays are
    cached and must not be changed.

    Source: Squire and Trapp 1998, "Using complex variables to estimate derivatives of real functions".
    """
    systems = [state_space(shape.plant)]
    # the state space does not include the delay
    shaping = [name for name in along if name != "delay"]
    systems += [state_space(replace(shape, **{name: getattr(shape, name) + SMALL * 1j}).plant) for name in shaping]
    n, places = systems[0].states, [0, *(1 + along.index(name) for name in shaping)]
    matrices, sensors = np.zeros((1 + len(along), n + 2, n + 2)), np.zeros((1 + len(along), n))
    for place, system in zip(places, systems, strict=True):
        part = (lambda values: np.imag(values) / SMALL) if place else np.real
        matrices[place, :n, :n], sensors[place] = part(system.matrix), part(system.sensor)
        matrices[place, :n, n], matrices[place, :n, n + 1] = part(system.command), part(system.force)
    return matrices, sensors


GRAVITY = ("gravity_sine", "gravity_cosine")
"""Accelerations a and b of gravity, -(a sin q + b cos q), for a device that turns by the angle q. They do not change
the shape of the motion, which is linear in them."""

OFF_BY_ONE = 0.7
"""Largest variance of ages [samples^2] that is modelled by commands one sample early or late. This variance is possible
even for a mean delay of half a sample. A larger variance requires larger deviations."""


@dataclass(frozen=True, eq=False)
class Ages:
    """Ages [samples] of the applied command, shape (A,), their probabilities, and derivatives along the delay."""

    age: Floats
    chance: Floats
    age_slope: float
    chance_slope: Floats

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, delay: float, jitter: float) -> Ages:
        """Return the ages for their mean and standard deviation [samples].

        Ages are whole numbers of samples if the standard deviation allows it. If the mean differs by ``off`` from a
        whole number, the variance of whole ages is at least |off| - off^2.
        """
        if jitter <= 0:
            return cls(np.array([delay]), np.ones(1), 1.0, np.zeros(1))
        variance = min(jitter**2, OFF_BY_ONE)
        most = 0.5 * (1 - np.sqrt(max(1 - 4 * variance, 0.0)))
        free = delay - np.round(delay)
        off = float(np.clip(free, -most, most))
        moves = 1.0 if off == free else 0.0
        square = variance + off**2
        chance = np.array([square - off, 2 * (1 - square), square + off]) / 2
        slope = moves * np.array([2 * off - 1, -4 * off, 2 * off + 1]) / 2 * (chance > 0)
        chance, left = np.maximum(chance, 0.0), jitter**2 - variance
        for _ in range(int(np.ceil(left / OFF_BY_ONE))):
            variance = min(left, OFF_BY_ONE)
            spread, left = np.array([0.5 * variance, 1 - variance, 0.5 * variance]), left - variance
            chance, slope = np.convolve(chance, spread), np.convolve(slope, spread)
        reach = len(chance) // 2
        return cls(delay - off + np.arange(-reach, reach + 1.0), chance, 1.0 - moves, slope)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (A, A) of the indicators of the ages."""
        return np.diag(self.chance) - np.outer(self.chance, self.chance)

    @cached_property
    def ageing(self) -> Floats:
        """Transition probabilities of the applied age for independent delays, three numbers per age, shape (3, A).

        The newest command that has arrived is applied. A command of age i has arrived with probability F_i. If it has
        not, it arrives by the next row with probability (F_i - F_(i-1))/(1 - F_(i-1)). Therefore, the probability of
        the next age j is equal for all present ages i >= j. The three numbers are: this probability, the probability
        of age i + 1 after age i (the remainder), and the probability of the age if the present age is unknown.
        """
        left = 1 - np.append(0.0, np.cumsum(self.chance)[:-1])
        arrived = np.clip(self.chance / np.maximum(left, 1e-12), 0.0, 1.0)
        arrived = np.maximum.accumulate(np.append(arrived[:-1], 1.0))
        before = np.append(0.0, arrived[:-1])
        now = np.where(before < 1, (arrived - before) / np.where(before < 1, 1 - before, 1.0), 1.0)
        reached = now * np.append(1.0, np.cumprod(1 - now)[:-1])
        return np.stack([reached, 1 - np.cumsum(reached), self.chance])


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of the intervals after rows. One command is applied in each piece.

    The pieces of the interval after row r are ``offset[r]`` to ``offset[r + 1]``; there are two offsets if all rows are
    even. The other arrays have the shape (Q,). The command is ``back`` rows old, and ``age`` is the index of its age in
    `Ages`. ``begin`` and ``end`` are times before the end of the interval [samples]. Their derivatives with respect to
    the age are ``begin_slope`` and ``end_slope``. ``times`` (m,) contains the lengths of all intervals, followed by
    these times, without duplicates; ``places`` are their indices.
    """

    offset: Integers
    back: Integers
    age: Integers
    begin: Floats
    end: Floats
    begin_slope: Floats
    end_slope: Floats
    times: Floats
    places: Integers

    @classmethod
    def of(cls, segments: Segments, ages: Sequence[float] | Floats) -> Pieces:
        """Return the pieces of all rows."""
        return cls._even(tuple(ages)) if segments.even else cls._uneven(segments, ages)

    @classmethod
    @lru_cache(maxsize=64)
    def _even(cls, ages: tuple[float, ...]) -> Pieces:
        whole = np.floor(ages)
        part = np.asarray(ages) - whole
        back = np.stack([whole + 1, whole], axis=1).astype(np.int64).ravel()
        begin = np.stack([np.ones_like(part), 1 - part], axis=1).ravel()
        end = np.stack([1 - part, np.zeros_like(part)], axis=1).ravel()
        first, count = np.arange(2 * len(whole)) % 2 == 0, len(whole)
        slopes = (np.where(first, 0.0, -1.0), np.where(first, -1.0, 0.0))
        place = np.arange(1, count + 1)
        begins, ends = np.stack([0 * place, place], axis=1), np.stack([place, 0 * place + count + 1], axis=1)
        places = np.concatenate([[0], begins.ravel(), ends.ravel()])
        times = np.concatenate([[1.0], 1 - part, [0.0]])
        return cls(np.array([0, 2 * count]), back, np.repeat(np.arange(count), 2), begin, end, *slopes, times, places)

    @classmethod
    def _uneven(cls, segments: Segments, ages: Sequence[float] | Floats) -> Pieces:
        parts: list[list[Any]] = []
        for first, behind in zip(segments.offsets[:-1].tolist(), segments.offsets[1:].tolist(), strict=True):
            time, span = segments.time[first:behind], np.diff(segments.time[first:behind])
            for place, age in enumerate(ages):
                late = time + age
                oldest = np.searchsorted(late, time[:-1] + 1e-9, side="right") - 1
                newest = np.maximum(np.searchsorted(late, time[1:] - 1e-9, side="left") - 1, oldest)
                count = newest - oldest + 1
                at = np.repeat(np.arange(len(span)), count)
                row = np.repeat(oldest - (np.cumsum(count) - count), count) + np.arange(len(at))
                is_first, is_last = row == oldest[at], row == newest[at]
                stop = time[1:][at]
                begin = np.where(is_first, span[at], stop - late[np.maximum(row, 0)])
                end = np.where(is_last, 0.0, stop - late[np.minimum(row + 1, len(late) - 1)])
                slopes = (np.where(is_first, 0.0, -1.0), np.where(is_last, 0.0, -1.0))
                parts.append([first + at, at - row, np.full(len(at), place), begin, end, *slopes])
        row, back, age, *times = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.argsort(row, kind="stable")
        offset = np.searchsorted(row[order], np.arange(len(segments.time) + 1))
        begin, end, begin_slope, end_slope = (each[order] for each in times)
        lengths = np.concatenate([segments.spans[0], begin, end])
        _, first, places = np.unique(np.round(lengths, 9), return_index=True, return_inverse=True)
        return cls(
            offset.astype(np.int64), back[order], age[order], begin, end, begin_slope, end_slope, lengths[first], places
        )


@dataclass(frozen=True, eq=False)
class Transitions:
    """Transitions of the states over the intervals after rows, and gains of the inputs, with tangents.

    The tuples are arguments of the loops in `kernels`: ``motion`` is (kind, F, F', W, W', H, H'), and ``pieces`` is
    (offset, back, age, width, G, G'). Derivatives are taken along P parameters.
    """

    motion: tuple[Integers, Floats, Floats, Floats, Floats, Floats, Floats]
    pieces: tuple[Integers, Integers, Integers, Floats, Floats, Floats]
    ages: Ages

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.motion[5])

    @classmethod
    def of(cls, segments: Segments, shape: PlantShape, jitter: float = 0.0, along: Sequence[str] = ()) -> Transitions:
        """Return the state transitions of a shape over the rows of segments, with derivatives along some parameters."""
        matrices, sensors = matrices_of(shape, tuple(along))
        ages = Ages.of(shape.delay, jitter)
        pieces = Pieces.of(segments, ages.age)
        spans, kind = segments.spans
        n, ends = sensors.shape[1], len(spans) + len(pieces.begin)
        moved = exponentials(matrices, pieces.times)[pieces.places]
        whole, begin, end = moved[: len(spans)], moved[len(spans) : ends], moved[ends:]
        gain = begin[:, :, :n, n:] - end[:, :, :n, n:]
        chance = ages.chance[pieces.age][:, None, None]
        G, dG = gain[:, 0] * chance, gain[:, 1:] * chance[:, None]
        if "delay" in along:
            slope = sum(
                sign * by[:, None, None] * (each[:, 0, :n, :n] @ matrices[0, :n, n:])
                for sign, by, each in ((1, pieces.begin_slope, begin), (-1, pieces.end_slope, end))
            )
            more = gain[:, 0] * ages.chance_slope[pieces.age][:, None, None]
            dG[:, list(along).index("delay")] = ages.age_slope * chance * slope + more
        F, W = whole[:, :, :n, :n], whole[:, :, :n, n + 1]
        span = spans[kind] if segments.even else np.repeat(spans[kind], np.diff(pieces.offset))
        width = (pieces.begin - pieces.end) / span
        arrays = (F[:, 0], F[:, 1:], W[:, 0], W[:, 1:], sensors[0], sensors[1:])
        motion: Any = (kind, *(np.ascontiguousarray(each) for each in arrays))
        gains = (pieces.offset, pieces.back, pieces.age, width, np.ascontiguousarray(G), np.ascontiguousarray(dG))
        return cls(motion, gains, ages)
