"""What a device does between two readings: exact motion under a late command, for regular and irregular rows.

Time is in sampling periods, mass 1. The states of the device are those of `loop.state_space`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.loop.state_space import Plant
from pipeline.records.batch import Floats, Integers

_TERMS = 14
"""Terms of the series of an exponential of a matrix of norm 1/2: 0.5^15/15! is left out."""

LARGEST_LOAD = 0.97
"""Largest load, as a fraction of the mass: of a lighter motor nothing is seen but its end."""

SMALL = 1e-20
"""Imaginary part of a number for a slope: its square is lost to rounding."""

SHORTEST_LAG = 0.02
"""Shortest lag [samples] that is a part: a shorter one moves the position by less than any sensor resolves."""


@dataclass(frozen=True)
class PlantShape:
    """What decides the shape of a device's motion, per sample and with mass 1.

    Parameters
    ----------
    delta, gamma : float
        Damping and stiffness.
    delay, lag : float
        Delay of the command, and time constant of the actuator [samples].
    mode_frequency : float
        Of a vibration mode [rad/sample].
    mode_damping_ratio : float
        Of all that its vibration loses, also to the damping of both sides: it is better identified than each part.
    load_mass_fraction : float
        Part of the mass that is the load; no mode where it and ``spring_damping_fraction`` are 0.
    load_damping : float
        Part of ``delta`` that acts on the load.
    spring_damping_fraction : float
        Where the load's position is read, any fraction of the mass moves it alike: in its place the part of the loss
        that the damper between both sides has; the motor has the rest.
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
        """Return the device of some numbers, without those that do not shape its motion."""
        return cls(**{each.name: numbers[each.name] for each in fields(cls) if each.name in numbers})

    @property
    def load_mass(self) -> float:
        """Mass of the load, of a whole of 1; 0 without a mode."""
        if not self.spring_damping_fraction:
            return self.load_mass_fraction
        lost = 2 * self.mode_damping_ratio * self.mode_frequency * (1 - self.spring_damping_fraction)
        # the motor's damping takes more of a vibration the lighter that side is; none takes it with no damping
        load = lost / (lost + self.delta) if np.real(self.delta) > 0 else LARGEST_LOAD
        return load if np.real(load) < LARGEST_LOAD else LARGEST_LOAD

    def along(self, name: str) -> PlantShape:
        """Return the device with a number that has a small imaginary part: that of a result is its slope, exactly.

        Source: Squire and Trapp 1998, "Using complex variables to estimate derivatives of real functions".
        """
        return replace(self, **{name: getattr(self, name) + SMALL * 1j})

    @property
    def kind(self) -> type[float] | type[complex]:
        """Kind of what is computed of its numbers."""
        return complex if any(isinstance(each, complex) for each in vars(self).values()) else float

    @property
    def plant(self) -> Plant:
        """Its linear motion."""
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


def transitions(matrix: Floats, inputs: Floats, times: Floats) -> tuple[Floats, Floats]:
    """Return transitions (m, n, n) over each time, and what constant inputs add, (m, n, i) for columns (n, i)."""
    n, i = inputs.shape
    both = np.zeros((n + i, n + i), np.result_type(matrix, inputs))
    both[:n, :n], both[:n, n:] = matrix, inputs
    norm = np.abs(both).sum(axis=0).max() * max(float(times.real.max(initial=0.0)), 1e-12)
    halvings = max(0, int(np.ceil(np.log2(norm))) + 1) if np.isfinite(norm) else 0
    small = both * (times / 2.0**halvings)[:, None, None]
    result = np.eye(n + i) + small
    term = small
    for k in range(2, _TERMS + 1):
        term = term @ small / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result[:, :n, :n], result[:, :n, n:]


def at_times(matrix: Floats, inputs: Floats, times: Floats) -> tuple[Floats, Floats]:
    """Return `transitions` at times of any shape, each distinct one (to 1e-9) made once."""
    moved, gained, place = _distinct(matrix, inputs, times)
    return moved[place], gained[place]


def _distinct(matrix: Floats, inputs: Floats, times: Floats) -> tuple[Floats, Floats, Integers]:
    """Return `transitions` at each distinct time, and the place among them of each."""
    alike = np.round(times.real, 9) + (1j * times.imag if np.iscomplexobj(times) else 0.0)
    _, first, place = np.unique(alike, return_index=True, return_inverse=True)
    moved, gained = transitions(matrix, inputs, times.ravel()[first])
    return moved, gained, place.reshape(times.shape)


OFF_BY_ONE = 0.7
"""Most of a variance of ages [samples^2] by commands that come one sample early or late, as is left for 0.5 beside a
whole one; what is more comes from further ones."""


def ages(delay: float, jitter: float) -> tuple[Floats, Floats]:
    """Return the ages [samples] of the command in force and their probabilities, by its mean and deviation.

    Commands arrive on whole samples as far as the deviation allows: of whole delays whose mean lies ``off`` beside one
    the variance is at least |off| - off^2.
    """
    if jitter <= 0:
        return np.array([delay]), np.ones(1)
    variance = min(jitter**2, OFF_BY_ONE)
    most = 0.5 * (1 - np.sqrt(max(1 - 4 * variance, 0.0)))
    off = np.clip(delay - np.round(np.real(delay)), -most, most)
    square = variance + off**2
    share = np.maximum(np.array([square - off, 2 * (1 - square), square + off]) / 2, 0.0)
    left = jitter**2 - variance
    for _ in range(int(np.ceil(left / OFF_BY_ONE))):
        variance = min(left, OFF_BY_ONE)
        share, left = np.convolve(share, [0.5 * variance, 1 - variance, 0.5 * variance]), left - variance
    reach = len(share) // 2
    return delay - off + np.arange(-reach, reach + 1.0), share


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of the intervals between rows over which the late command is constant.

    ``row`` (P, N, S) of the command, and the time from where each begins and ends to the interval's end; (P, 1, 1)
    where all rows are regular. ``age`` (P,) is the place of its age among those of `ages`, ``chances`` (A,) how likely
    each is.
    """

    row: Integers
    begins: Floats
    ends: Floats
    age: Integers
    chances: Floats

    @property
    def ageing(self) -> Floats:
        """Chances (A, A) of an age in force after another less those of it after any, for delays drawn anew each time.

        The newest command that has arrived is in force: one of age i has arrived with probability F_i, and the next
        row finds those that were on their way before with (F_i - F_(i-1))/(1 - F_(i-1)).
        """
        count = len(self.chances)
        left = 1 - np.append(0.0, np.cumsum(self.chances)[:-1])
        arrived = np.clip(self.chances / np.maximum(left, 1e-12), 0.0, 1.0)
        arrived = np.maximum.accumulate(np.append(arrived[:-1], 1.0))
        before = np.append(0.0, arrived[:-1])
        now = np.where(before < 1, (arrived - before) / np.where(before < 1, 1 - before, 1.0), 1.0)
        reached = now * np.append(1.0, np.cumprod(1 - now)[:-1])
        result = np.tril(np.broadcast_to(reached, (count, count)))
        oldest = np.minimum(np.arange(count) + 1, count - 1)
        result[np.arange(count), oldest] += 1 - result.sum(axis=1)
        return result - self.chances

    def gains(self, matrix: Floats, inputs: Floats) -> Floats:
        """Return what unit inputs over each piece add to the state at the interval's end, (P, N or 1, S or 1, n, i)."""
        # most intervals have fewer pieces than the longest
        used = self.begins != self.ends
        _, gained, place = _distinct(matrix, inputs, np.stack([self.begins[used], self.ends[used]]))
        whole = np.zeros((*used.shape, *inputs.shape), gained.dtype)
        whole[used] = gained[place[0]] - gained[place[1]]
        whole *= self.chances[self.age][:, None, None, None, None]
        return whole


def pieces(time: Floats, lead: int, delay: float, regular: bool, jitter: float = 0.0) -> Pieces:
    """Return the pieces of the intervals of stretches.

    Parameters
    ----------
    time : float64, shape (lead + N + 1, S)
        Of the commands [samples]; readings begin ``lead`` rows later. The last row ends the last interval.
    lead : int
    delay, jitter : float
        Mean and standard deviation of the age of the command in force [samples].
    regular : bool
        Whether all rows are one sample apart.
    """
    made = _even_pieces if regular else _uneven_pieces
    each_age, chances = ages(delay, jitter)
    found = [made(time, lead, age) for age in each_age]
    count = [len(row) for row, _, _ in found]
    row, begins, ends = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Pieces(row, begins, ends, np.repeat(np.arange(len(count)), count), chances)


def _even_pieces(time: Floats, lead: int, delay: float) -> tuple[Integers, Floats, Floats]:
    """Return rows of the command, begins and ends of the pieces of one age between even rows."""
    whole = int(np.floor(np.real(delay)))
    part = delay - whole
    newest = np.arange(len(time) - 1 - lead)[:, None] + lead - whole
    row = np.stack([newest - 1, newest])
    begins, ends = np.array([1.0, 1.0 - part])[:, None, None], np.array([1.0 - part, 0.0])[:, None, None]
    used = slice(None) if part else slice(1, None)
    return np.clip(row, 0, len(time) - 2)[used], begins[used], ends[used]


def _uneven_pieces(time: Floats, lead: int, delay: float) -> tuple[Integers, Floats, Floats]:
    """Return rows of the command, begins and ends of the pieces of one age between rows of any distance."""
    rows, count = time.shape[0] - 1 - lead, time.shape[1]
    start, stop = time[lead:-1], time[lead + 1 :]
    first = np.empty((rows, count), dtype=np.int64)
    last = np.empty_like(first)
    for s in range(count):
        late = time[:, s] + np.real(delay)
        first[:, s] = np.searchsorted(late, start[:, s] + 1e-9, side="right") - 1
        last[:, s] = np.searchsorted(late, stop[:, s] - 1e-9, side="left") - 1
    most = int(max((last - first).max(initial=0), 0)) + 1
    column = np.arange(count)[None, :]
    late = time + delay
    rows_of, begins_of, ends_of = [], [], []
    for piece in range(most):
        row = np.clip(first + piece, 0, len(time) - 2)
        begin = np.clip(stop - late[row, column], 0.0, stop - start)
        end = np.clip(stop - late[row + 1, column], 0.0, stop - start)
        begin = stop - start if piece == 0 else begin
        end = np.where(first + piece >= last, 0.0, end)
        begins_of.append(np.where(first + piece > last, 0.0, begin))
        ends_of.append(np.where(first + piece > last, 0.0, end))
        rows_of.append(row)
    return np.stack(rows_of), np.stack(begins_of), np.stack(ends_of)
