"""Prepare logs for the estimator, with rows in SI units, smoothed motion, and units in which values are near 1."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256

import numpy as np

from pipeline.measured.signal.sensor import position_quantum
from pipeline.records.trials import Floats, Integers

SHORTEST = 8
"""Smallest number of rows of a segment that contains information in addition to its initial state."""

SURE = 4.0
"""Smallest speed, in standard errors, at which the direction is known. It is wrong in 6e-5 of the rows."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Log with a name, time [s], command [N, Nm] and position [m, rad] of shape (rows,), and sampling period [s].

    ``edge`` is the row, counted from 0, of a step from rest, if it is declared. ``wall`` contains damping and stiffness
    of the wall. ``turns`` states whether the position is an angle, so that gravity may act. ``force`` is the measured
    force or torque [N, Nm] of shape (rows,), if the log has it.
    """

    name: str
    time: Floats
    command: Floats
    position: Floats
    period: float
    edge: int | None = None
    wall: tuple[float, float] = (0.0, 0.0)
    turns: bool = False
    force: Floats | None = field(default=None, repr=False)

    @cached_property
    def rank(self) -> tuple[float, float, bytes, bytes]:
        """Sort key: the wall, then hashes of the samples for equal walls.

        Neighbours are left out together, so that unmodelled effects that are common to similar walls widen the
        intervals.
        """
        samples = (sha256(np.ascontiguousarray(each).data).digest() for each in (self.command, self.position))
        of_command, of_position = samples
        return *self.wall, of_command, of_position

    @property
    def digest(self) -> str:
        """Hash of the recording without its name."""
        known = sha256(repr((self.period, self.edge, self.wall, self.turns)).encode())
        for each in (self.time, self.command, self.position):
            known.update(np.ascontiguousarray(each).data)
        return known.hexdigest()

    @cached_property
    def motion(self) -> Motion:
        """Smoothed motion of the recording."""
        return motion_of(self)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the error of a reading."""
        return reading_noise(self.position, self.rounding)

    @cached_property
    def rounding(self) -> float:
        """Standard deviation of the rounding of a reading, or 0 if no rounding is visible."""
        return rounding(self.position)


@dataclass(frozen=True)
class LogUnits:
    """Units of the estimator: the sampling period [s], the position relative to an origin [m, rad], and the command
    [N, Nm].

    The origin is the position at which a spring is relaxed. This is the initial position of most logs. If the origin is
    None, the initial position of each log is used, e.g. if a hand grips the device there. A further offset acts like a
    constant force.
    """

    period: float
    position: float
    command: float
    origin: float | None

    @classmethod
    def of(cls, recordings: list[Recording]) -> LogUnits:
        """Return units in which the readings and commands of the recordings are near 1."""
        spread = max((float(np.ptp(each.position)) for each in recordings), default=0.0)
        force = max((float(np.abs(each.command).max()) for each in recordings), default=0.0)
        period = float(np.median([each.period for each in recordings]))
        origin = float(np.median([each.position[0] for each in recordings]))
        return cls(period, spread or 1.0, force or 1.0, origin)


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a recording, with the velocity smoothed over ``half`` rows on each side, its error, and known
    directions."""

    velocity: Floats
    error: float
    half: int
    direction: Integers = field(repr=False)


def motion_of(recording: Recording) -> Motion:
    """Return the smoothed motion, from parabolas over enough rows for an error of a thirtieth of the top speed."""
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
    # near both ends, half of the rows are reflections of other rows: the error is larger, and 3 is a safe factor
    near = np.minimum(np.arange(rows), np.arange(rows)[::-1]) < half
    seen = np.abs(velocity) > SURE * error * np.where(near, 3.0, 1.0)
    return Motion(velocity, float(error), half, np.where(seen, np.sign(velocity), 0).astype(np.int64))


def median(values: Floats) -> float:
    """Return the median of a vector that is not empty. For short vectors, it takes a fifth of the time of
    `numpy.median`.

    >>> median(np.array([3.0, 1.0, 2.0])), median(np.array([4.0, 1.0]))
    (2.0, 2.5)
    """
    low, high = (len(values) - 1) // 2, len(values) // 2
    parted = np.partition(values, (low, high) if low < high else low)
    return float(0.5 * (parted[low] + parted[high]))


def reading_noise(position: Floats, rounded: float) -> float:
    """Return the standard deviation of a reading's error, from third differences or its ``rounded`` part."""
    third = np.diff(position, 3)
    noise = median(np.abs(third)) / 0.6745 / np.sqrt(20.0) if len(third) else 0.0
    return float(max(noise, rounded, 1e-12 * float(np.ptp(position))))


def rounding(position: Floats) -> float:
    """Return the standard deviation of a reading's rounding to the sensor resolution, or 0 if none is visible."""
    return position_quantum(position) / float(np.sqrt(12.0))
