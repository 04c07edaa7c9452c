"""Logs as the estimator takes them: rows in SI, how they move, and the units in which they are near 1."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256

import numpy as np

from pipeline.measured.signal.sensor import position_quantum
from pipeline.records.trials import Floats, Integers

SHORTEST = 8
"""Rows of the shortest stretch that says more than its own start."""

SURE = 4.0
"""Speed in its standard errors from which on its direction counts as seen; wrong in 6e-5 of the rows."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One log: time [s], command [N, Nm] and position [m, rad], shape (rows,); its name and sampling period [s].

    ``edge`` is the row, counted from 0, that is declared as that of a step from rest; ``wall`` damping and stiffness
    that it was recorded behind.
    """

    name: str
    time: Floats
    command: Floats
    position: Floats
    period: float
    edge: int | None = None
    wall: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def rank(self) -> tuple[float, float, bytes, bytes]:
        """Place among others: by its wall, and by its samples where walls are equal.

        Neighbours are left out together, so that what the model lacks at similar walls widens intervals.
        """
        samples = (sha256(np.ascontiguousarray(each).data).digest() for each in (self.command, self.position))
        of_command, of_position = samples
        return *self.wall, of_command, of_position

    @property
    def digest(self) -> str:
        """Hash of all but its name."""
        known = sha256(repr((self.period, self.edge, self.wall)).encode())
        for each in (self.time, self.command, self.position):
            known.update(np.ascontiguousarray(each).data)
        return known.hexdigest()

    @cached_property
    def motion(self) -> Motion:
        """How it moves."""
        return motion_of(self)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a reading's error."""
        return reading_noise(self.position)

    @cached_property
    def rounding(self) -> float:
        """Standard deviation of a reading's rounding, 0 where none is seen."""
        return rounding(self.position)


@dataclass(frozen=True)
class LogUnits:
    """Units of the estimator: sampling period [s], position from its origin [m, rad] and command [N, Nm].

    The origin is where a spring is relaxed: where most logs begin, or None for the beginning of each log, as of a hand
    that grips the device there. What else acts on the device is a constant force.
    """

    period: float
    position: float
    command: float
    origin: float | None

    @classmethod
    def of(cls, recordings: list[Recording]) -> LogUnits:
        """Return the units in which readings and commands of recordings are near 1."""
        spread = max((float(np.ptp(each.position)) for each in recordings), default=0.0)
        force = max((float(np.abs(each.command).max()) for each in recordings), default=0.0)
        period = float(np.median([each.period for each in recordings]))
        origin = float(np.median([each.position[0] for each in recordings]))
        return cls(period, spread or 1.0, force or 1.0, origin)


@dataclass(frozen=True, eq=False)
class Motion:
    """How a recording moves: velocity smoothed over ``half`` rows to each side, its error, directions seen."""

    velocity: Floats
    error: float
    half: int
    direction: Integers = field(repr=False)


def motion_of(recording: Recording) -> Motion:
    """Return the smoothed motion: a parabola over as many rows as bring the error to a thirtieth of the top speed."""
    x, rows = recording.position, len(recording.position)
    noise = recording.noise
    half, velocity, error = 1, np.gradient(x), np.inf
    while 2 * half + 1 <= max(rows // 4, 3):
        about = np.arange(half, -half - 1, -1.0)
        squares = float(about @ about)
        reflected = np.pad(x, half, mode="reflect", reflect_type="odd")
        velocity = np.convolve(reflected, about / squares, mode="valid")
        error = noise / np.sqrt(squares)
        if error * 30 <= np.abs(velocity).max(initial=0.0):
            break
        half = max(half + 1, int(half * 1.5))
    # at both ends half of the rows are reflections: their error is that of half as many rows, and counts twice
    near = np.minimum(np.arange(rows), np.arange(rows)[::-1]) < half
    seen = np.abs(velocity) > SURE * error * np.where(near, 3.0, 1.0)
    return Motion(velocity, float(error), half, np.where(seen, np.sign(velocity), 0).astype(np.int64))


def reading_noise(position: Floats) -> float:
    """Return the standard deviation of a reading's error: of third differences, or of rounding to the quantum."""
    third = np.diff(position, 3)
    noise = float(np.median(np.abs(third))) / 0.6745 / np.sqrt(20.0) if len(third) else 0.0
    return float(max(noise, rounding(position), 1e-12 * float(np.ptp(position))))


def rounding(position: Floats) -> float:
    """Return the standard deviation of a reading's rounding to the sensor's resolution, 0 where none is seen.

    A fast motion may change by several steps of the sensor in every row, a steady one by a whole number of them.
    """
    return position_quantum(position) / float(np.sqrt(12.0))
