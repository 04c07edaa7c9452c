"""Samples of a log with the conditions of the trial, and quantities that are used by several checks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import sqrt
from statistics import NormalDist

import numpy as np

from pipeline.device.parameters import Dimension, Motion, unit_of
from pipeline.records.findings import Finding, FindingCode, Severity
from pipeline.records.trials import Floats, Integers

NOISE_GAIN = 6.0
"""Ratio of the variance of the second difference of white noise to the variance of the noise, 1 + 4 + 1."""

THIRD_GAIN = 20.0
"""Ratio of the variance of the third difference of white noise to the variance of the noise, 1 + 9 + 9 + 1."""

NORMAL_QUARTILE = NormalDist().inv_cdf(0.75)
"""Median of the absolute value of a standard normal variable."""

THIRD_MEDIAN = NORMAL_QUARTILE * sqrt(THIRD_GAIN)
"""Median size of the third difference of white noise relative to the standard deviation of the noise."""

FINE = 1e-6
"""Smallest sensor step, relative to the range of the position. A smaller step is a printed digit."""

SMALLEST_STEP = 1e-9
"""Smallest position change, relative to the range, that counts as a step of the sensor. Smaller changes are rounding
errors."""

LAW_RESIDUAL = 0.02
"""Largest residual, relative to the changes of the command, for which a command matches the stated wall law. It allows
for rounding and sensor errors."""

MOST_DECIMALS = 12
"""Largest number of decimals for which the last printed digit of a position can be detected."""

ON_DIGIT = 1e-4
"""Tolerance for an integer number of digits, in digits, which allows for errors of a unit conversion."""

QUIET = 0.15
"""Limit on the command of a wall before the step, and on its deviation from the step in the first row of the step,
relative to the step."""


def middle(values: Floats) -> float:
    """Return the median of at least one value. For an even number of values, this is the larger one of the two middle
    values."""
    place = len(values) // 2
    return float(np.partition(values, place)[place])


def last_digit(position: Floats) -> float:
    """Return the decimal unit in which all positions (rows,) of a log are printed, or 0 if there is none.

    >>> last_digit(np.array([0.25, 0.5]))
    0.01
    """
    digit = 0.0
    largest = np.abs(position).max(initial=0.0)
    # values that are not on a fine grid are not on any coarser grid
    for decimals in range(MOST_DECIMALS, 0, -1):
        scaled = position * 10.0**decimals
        off = np.abs(scaled - np.rint(scaled)).max(initial=0.0)
        if not off <= ON_DIGIT + 4 * np.finfo(np.float64).eps * (largest * 10.0**decimals):
            break
        digit = 10.0**-decimals
    return digit


UNEVEN, MOST_UNEVEN = 0.05, 0.1
"""Thresholds for the relative deviation of a time step from the median, and for the share of larger deviations. Above
them, rows are treated as polled. A command may then have changed at any time between two rows."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one log in SI units.

    Parameters
    ----------
    time, command, position : float64, shape (rows,)
        Time stamps [s], total commanded force [N, Nm], and measured position [m, rad]. All values are finite.
    period : float
        Stated sampling period T [s].
    stiffness, damping, step : float
        Virtual wall K [N/m, Nm/rad] and B [Ns/m, Nms/rad], and external step F_0 [N, Nm]; all 0 for a free motion.
    step_row : int, optional
        Declared row of the step, counted from 0.
    motion : {"translation", "rotation"} or a motion with the unit of a drive, optional
        Kind of motion, for the units in sentences. None if the log does not state it.
    """

    time: Floats
    command: Floats
    position: Floats
    period: float
    stiffness: float = 0.0
    damping: float = 0.0
    step: float = 0.0
    step_row: int | None = None
    motion: Motion | None = None

    def unit(self, dimension: Dimension) -> str:
        """Return the unit of a dimension, or both units if the motion is unknown.

        >>> nothing = np.empty(0)
        >>> Samples(nothing, nothing, nothing, 1e-3).unit("velocity")
        'm/s (or rad/s)'
        """
        if self.motion is None:
            return " (or ".join(unit_of(dimension, motion) for motion in ("translation", "rotation")) + ")"
        return unit_of(dimension, self.motion)

    def __len__(self) -> int:
        return len(self.position)

    def before(self, row: int) -> Samples:
        """Return the samples before a row, but at least two."""
        rows = max(row, 2)
        return replace(self, time=self.time[:rows], command=self.command[:rows], position=self.position[:rows])

    @cached_property
    def change(self) -> Floats:
        """Change of the position between rows, shape (rows - 1,)."""
        return self.position[1:] - self.position[:-1]

    @cached_property
    def size(self) -> Floats:
        """Absolute value of `change`."""
        return np.abs(self.change)

    @cached_property
    def moves(self) -> Integers:
        """Indices of `change` at which the position changes."""
        return self.change.nonzero()[0]

    @cached_property
    def range(self) -> float:
        """Difference between the largest and the smallest position."""
        return float(self.position.max() - self.position.min())

    @cached_property
    def fastest(self) -> float:
        """Largest change of the position between rows."""
        return float(self.size.max())

    @cached_property
    def least_change(self) -> float:
        """Smallest position change above rounding, which is at least the sensor step, or 0 for a constant position."""
        if self.fastest == 0:
            return 0.0
        seen = self.size[self.moves] if self.resting else self.size
        least = float(seen.min())
        if least > SMALLEST_STEP * self.range:
            return least
        least = float(seen[seen > SMALLEST_STEP * self.range].min(initial=np.inf))
        return least if least < np.inf else 0.0

    @property
    def resting(self) -> int:
        """Number of rows in which the position does not change."""
        return len(self.change) - len(self.moves)

    @cached_property
    def pauses(self) -> Integers:
        """Number of constant rows after each change except the last one. The array has one element fewer than
        ``moves``."""
        return np.asarray(self.moves[1:] - self.moves[:-1] - 1)

    @property
    def is_free(self) -> bool:
        """True if there is no wall. The command then does not depend on the position."""
        return self.stiffness == 0.0 and self.damping == 0.0

    def finding(
        self,
        code: FindingCode,
        severity: Severity,
        evidence: str,
        remedy: str,
        first_row: int | None = None,
        rows: int | None = None,
    ) -> Finding:
        """Return a finding for this log, by default for all of its rows."""
        count = len(self) if rows is None else rows
        return Finding(code=code, severity=severity, evidence=evidence, remedy=remedy, first_row=first_row, rows=count)

    @cached_property
    def steps(self) -> Floats:
        """Time between two rows [s], shape (rows - 1,)."""
        return self.time[1:] - self.time[:-1]

    @cached_property
    def is_even(self) -> bool:
        """True if nearly all rows are equally spaced in time, as for a controller."""
        usual = middle(self.steps)
        return float(np.mean(np.abs(self.steps - usual) > UNEVEN * usual)) <= MOST_UNEVEN

    @cached_property
    def bend(self) -> Floats:
        """Second difference of the position, shape (rows - 2,)."""
        return self.change[1:] - self.change[:-1]

    @cached_property
    def jumps(self) -> Floats:
        """Change of the command between rows, shape (rows - 1,)."""
        return self.command[1:] - self.command[:-1]

    @cached_property
    def third(self) -> Floats:
        """Absolute third difference of the position, shape (rows - 3,)."""
        return np.abs(self.bend[1:] - self.bend[:-1])

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a reading, estimated from rounding and from third differences, in which motion is
        negligible."""
        of_readings = middle(self.third) / THIRD_MEDIAN if len(self.third) else 0.0
        steps = self.least_change / 12.0**0.5 if self.least_change > FINE * self.range else 0.0
        return max(of_readings, steps)

    def is_noisier_than(self, size: float) -> bool:
        """Return True if the noise in third differences exceeds a size. Their median is not computed."""
        above = int(np.count_nonzero(self.third > size * THIRD_MEDIAN))
        return above >= len(self.third) - len(self.third) // 2 > 0

    @cached_property
    def wall_steps(self) -> Floats:
        """Change of the wall force K x + B dx/T between rows [N, Nm], shape (rows - 1,)."""
        per_row = self.damping / self.period
        force = (self.stiffness + per_row) * self.change
        if per_row:
            force[1:] -= per_row * self.change[:-1]
        return force

    def wall_residual(self, sign: float = 1.0) -> float:
        """Return the rms residual of the command changes after subtraction of the stated wall and the step.

        A sign of -1 reverses the force of the stated wall.
        """
        rest = np.abs(self.jumps + sign * self.wall_steps)
        largest = float(rest.max())
        return sqrt(max(float(rest @ rest) - largest * largest, 0.0) / len(rest))

    def wall_residuals(self, most: int) -> Floats:
        """Return the residual of the stated wall for commands that are 0 to ``most`` rows late, shape (most + 1,)."""
        count = len(self.jumps)
        rest = self._late_jumps(most) + self.wall_steps
        for late in range(1, most + 1):  # rows after the end of the log
            rest[late, count - late :] = 0.0
        largest = np.maximum(rest.max(axis=1), -rest.min(axis=1))
        power = np.maximum(np.einsum("ij,ij->i", rest, rest) - largest * largest, 0.0)
        return np.asarray(np.sqrt(power / (count - np.arange(most + 1))))

    def least_wall_residuals(self, most: int) -> Floats:
        """Return lower bounds of `wall_residuals`, from sums of squares and products only."""
        jumps, force, rows = self.jumps, self.wall_steps, np.arange(most + 1)
        products = self._late_jumps(most) @ force
        before = np.concatenate([[0.0], np.cumsum(jumps * jumps)])
        behind = np.concatenate([[0.0], np.cumsum(force * force)])
        power = before[-1] - before[rows] + behind[len(jumps) - rows] + 2 * products
        largest = float(np.abs(jumps).max() + np.abs(force).max())
        return np.asarray(np.sqrt(np.maximum(power - largest * largest, 0.0) / (len(jumps) - rows)))

    def _late_jumps(self, most: int) -> Floats:
        """Return the command changes 0, 1, ... rows later, padded with 0 at the end, shape (most + 1, rows - 1)."""
        return np.lib.stride_tricks.sliding_window_view(np.append(self.jumps, np.zeros(most)), len(self.jumps))

    @cached_property
    def obeys_wall(self) -> bool:
        """True if the command matches the stated wall for the position of its row. The controller then used this
        reading."""
        if self.is_free:
            return False
        force = self.wall_steps
        return self.wall_residual() <= LAW_RESIDUAL * sqrt(float(force @ force) / len(force))

    @cached_property
    def obeys_reversed_wall(self) -> bool:
        """True if the command matches the stated wall for the position of its row after reversal of one sign."""
        if self.is_free:
            return False
        force = self.wall_steps
        return self.wall_residual(-1.0) <= LAW_RESIDUAL * sqrt(float(force @ force) / len(force))

    @cached_property
    def wall_edge(self) -> int:
        """Row in which the command of a wall steps from about 0 by about the stated step, or 0 if there is no such
        row."""
        if self.step_row is not None and self.step_row > 0:
            return self.step_row
        if self.step == 0:
            return 0
        near = QUIET * abs(self.step)
        before, behind = np.abs(self.command[:-1]) <= near, np.abs(self.command[1:] - self.step) <= near
        found = int(np.argmax(before & behind))
        # if the wall force due to noise exceeds this limit, the command alone does not show the edge
        return found + 1 if before[found] and behind[found] and before[:found].all() else 0
