"""Resolution of a sensor: its quantum, its noise, and the amplitude that both can cause."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.recording.samples import NOISE_GAIN, last_digit
from pipeline.records.trials import Floats

Size = TypeVar("Size", float, Floats)

BASELINE_SAMPLES = 5
"""Smallest number of baseline rows for a noise estimate, whose error is then 60 % (25 % for 20 rows)."""

NOISE_FACTOR = 6.0
"""Four standard deviations (2 % chance in 400 samples) of the difference of two readings, 4 sqrt 2 and more."""

AT_REST = 2.0
"""Largest deviation of readings of a device at rest, in sensor floors: it may lie between two quanta and alternate."""

GRID_TOLERANCE = 1e-3
"""Largest deviation of a change from a multiple of the quantum, relative to the quantum."""

STORED_TOLERANCE = 0.15
"""Like `GRID_TOLERANCE` for positions stored in single precision or with few digits: six units of the last digit per
quantum still pass."""

STORED_GAP = 4.0
"""Smallest ratio between neighbouring sorted changes that separates one quantum from rounding errors of storage."""

STORED_MULTIPLES = 20.0
"""Largest multiple that tests a grid in rounded positions; beyond it, the error of the grid reaches the tolerance."""

FEWEST_ON_GRID = 12
"""Smallest number of changes that must lie on such a grid, also for a command: the probability that those of a
continuous signal all do is 0.3^12 = 5e-7."""

DIGITS, CHANGE_DIGITS = 8.0, 2.5
"""First value: changes smaller than this many printed digits are due to printing. Second value: error, in digits, of
the difference of two changes, which has four readings, each off by up to half a digit."""

BY_CHANCE, FEWEST_COARSE = 14.5, 4
"""Negative logarithm of the probability that changes lie on a grid by accident, as for `FEWEST_ON_GRID`; and the
smallest number of changes."""

COARSE_MULTIPLES = 1e3
"""Largest multiple that tests a grid among printed positions."""

ROUNDING_UNITS = 64.0
"""Changes below this many rounding units are numerical errors, not sensor steps."""


def sensor_floor(quantum: Size, noise: Size) -> Size:
    """Return the position amplitude that quantum and noise alone can cause [m, rad]; a NaN noise counts as zero."""
    floor: Size = quantum + NOISE_FACTOR * np.fmax(noise, 0.0)
    return floor


def position_quantum(position: Floats) -> float:
    """Return the step of the coarsest grid on which positions (rows,) lie, 0 if there is none.

    Single precision and printed digits put the positions on another, finer grid that is not that of the sensor. A
    coarser grid on which they lie up to that rounding takes precedence.

    >>> position_quantum(0.25 * np.array([1.0, 2.0, 2.0, 5.0, 9.0]))
    0.25
    """
    if len(position) < 3:
        return 0.0
    # a fast motion never changes by one quantum a sample, but its changes differ by one
    change = position[1:] - position[:-1]
    bend = np.abs(change[1:] - change[:-1])
    change = np.abs(change)
    rounding = ROUNDING_UNITS * np.finfo(np.float64).eps * np.abs(position).max(initial=0.0)
    change = change[change > rounding]
    size = np.sort(np.concatenate((change, bend[bend > rounding])))
    if not len(size):
        return 0.0
    exact = _grid(change, size[0], GRID_TOLERANCE, np.inf, 1)
    # beyond 1/tolerance multiples, rounding of the positions hides the grid
    quantum = exact = exact if exact > rounding / GRID_TOLERANCE else 0.0
    # without a gap the smallest change is not a candidate: changes of a smooth motion have common divisors, too
    ratio = size[1:] / size[:-1]
    gap = int(ratio.argmax()) if len(ratio) else 0
    if len(ratio) and ratio[gap] > STORED_GAP:
        stored = _grid(size, size[gap + 1], STORED_TOLERANCE, STORED_MULTIPLES, FEWEST_ON_GRID)
        quantum = stored if stored > STORED_GAP * exact else exact
    # on the grid of its digits a fast motion has few changes, each of which is known to a few of them
    digit = exact if exact > 0 else last_digit(position)
    coarse = size[np.searchsorted(size, DIGITS * digit, side="right") :]
    if digit > 0 and len(coarse):
        tolerance = min(max(CHANGE_DIGITS * digit / coarse[0], GRID_TOLERANCE), STORED_TOLERANCE)
        if tolerance < STORED_TOLERANCE:
            fewest = max(np.ceil(BY_CHANCE / np.log(0.5 / tolerance)), FEWEST_COARSE)
            quantum = max(quantum, _grid(coarse, coarse[0], tolerance, COARSE_MULTIPLES, fewest))
    return float(quantum)


@compiled("f8(f8[::1], f8, f8, f8, f8)")
def _grid(size: Floats, smallest: float, tolerance: float, most: float, fewest: float) -> float:
    """Return the step of the grid on which at least ``fewest`` changes of up to ``most`` steps lie; 0 if none.

    Parameters
    ----------
    size : float64, shape (changes,)
        Positive changes of a position [m, rad].
    smallest : float
        Change of one, two or three steps, because there may be no change of a single step.
    tolerance : float
        Largest distance of a change from a multiple of the step, relative to the step.
    """
    for parts in range(1, 4):
        step = smallest / parts
        # the smallest change carries the rounding of two readings, the mean of all hardly any: step by step, for an
        # error of the step is one of its multiples as many times over
        if np.isfinite(most):
            for limit in (3.0 * parts, 8.0 * parts, most):
                square = total = 0.0
                for change in size:
                    multiple = np.rint(change / step)
                    if 1 <= multiple <= limit:
                        square += multiple * multiple
                        total += multiple * change
                step = total / square if square > 0 else np.inf
        if not np.isfinite(step):
            continue
        error, number = 0.0, 0
        for change in size:
            multiple = np.rint(change / step)
            if multiple <= most:
                error = max(error, abs(change / step - multiple))
                number += multiple >= 1
        if error < tolerance and number >= fewest:
            return step
    return 0.0


def white_noise(position: Floats) -> float:
    """Return the standard deviation [m, rad] of white noise from second differences; NaN for too few positions."""
    if len(position) < BASELINE_SAMPLES:
        return np.nan
    return float(np.sqrt(np.mean(np.diff(position, n=2) ** 2) / NOISE_GAIN))
