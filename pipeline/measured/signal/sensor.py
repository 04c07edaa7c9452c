"""Estimate the quantum and the noise of a sensor, and the amplitude that both can cause."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.recording.samples import NOISE_GAIN, last_digit
from pipeline.records.trials import Floats

Size = TypeVar("Size", float, Floats)

BASELINE_SAMPLES = 5
"""Smallest number of baseline rows for a noise estimate. Its error is then 60 % (25 % for 20 rows)."""

NOISE_FACTOR = 6.0
"""Four standard deviations of the difference of two readings, 4 sqrt 2, rounded up (2 % chance in 400 samples)."""

AT_REST = 2.0
"""Largest deviation of readings of a device at rest, in sensor floors. The device may alternate between two quanta."""

GRID_TOLERANCE = 1e-3
"""Largest deviation of a change from a multiple of the quantum, relative to the quantum."""

STORED_TOLERANCE = 0.15
"""Tolerance like `GRID_TOLERANCE` for positions in single precision or with few digits. A quantum of six units in the
last digit is still detected."""

STORED_GAP = 4.0
"""Smallest ratio between neighbouring sorted changes that separates a quantum from rounding errors of storage."""

STORED_MULTIPLES = 20.0
"""Largest multiple of the step by which a grid of rounded positions is tested. For larger multiples, the error of the
grid reaches the tolerance."""

FEWEST_ON_GRID = 12
"""Smallest number of changes, of a position or of a command, that must lie on such a grid. The probability that all
changes of a continuous signal lie on it is 0.3^12 = 5e-7."""

DIGITS, CHANGE_DIGITS = 8.0, 2.5
"""Two limits in units of the last printed digit. Changes below the first limit are due to printing. The second limit is
the error of the difference of two changes, which contains four readings with errors of up to half a digit."""

BY_CHANCE, FEWEST_COARSE = 14.5, 4
"""Negative logarithm of the probability that changes lie on a grid by chance, as for `FEWEST_ON_GRID`, and smallest
number of changes."""

COARSE_MULTIPLES = 1e3
"""Largest multiple of the step by which a grid of printed positions is tested."""

ROUNDING_UNITS = 64.0
"""Threshold for the number of rounding units. Below it, changes are numerical errors and not sensor steps."""


def sensor_floor(quantum: Size, noise: Size) -> Size:
    """Return the position amplitude that quantum and noise can cause [m, rad]. A noise of NaN counts as 0."""
    floor: Size = quantum + NOISE_FACTOR * np.fmax(noise, 0.0)
    return floor


def position_quantum(position: Floats) -> float:
    """Return the step of the coarsest grid on which positions (rows,) lie, or 0 if there is none.

    Single precision and printed digits put the positions on a finer grid that is not due to the sensor. A coarser grid
    takes precedence if the positions lie on it up to this rounding.

    >>> position_quantum(0.25 * np.array([1.0, 2.0, 2.0, 5.0, 9.0]))
    0.25
    """
    if len(position) < 3:
        return 0.0
    # A fast motion never changes by one quantum per sample, but consecutive changes may differ by one quantum.
    change = position[1:] - position[:-1]
    bend = np.abs(change[1:] - change[:-1])
    change = np.abs(change)
    rounding = ROUNDING_UNITS * np.finfo(np.float64).eps * np.abs(position).max(initial=0.0)
    change = change[change > rounding]
    size = np.sort(np.concatenate((change, bend[bend > rounding])))
    if not len(size):
        return 0.0
    exact = _grid(change, size[0], GRID_TOLERANCE, np.inf, 1)
    # beyond 1/tolerance multiples, the rounding of positions hides the grid
    quantum = exact = exact if exact > rounding / GRID_TOLERANCE else 0.0
    # without a gap, the smallest change is not a candidate, since changes of a smooth motion also have common divisors
    ratio = size[1:] / size[:-1]
    gap = int(ratio.argmax()) if len(ratio) else 0
    if len(ratio) and ratio[gap] > STORED_GAP:
        stored = _grid(size, size[gap + 1], STORED_TOLERANCE, STORED_MULTIPLES, FEWEST_ON_GRID)
        quantum = stored if stored > STORED_GAP * exact else exact
    # on the grid of its digits, a fast motion has few changes, each with an error of a few digits
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
    """Return the step of a grid that contains at least ``fewest`` changes of up to ``most`` steps, or 0 if there is
    none.

    Parameters
    ----------
    size : float64, shape (changes,)
        Positive changes of a position [m, rad].
    smallest : float
        Change of one, two or three steps, since a change of a single step may not occur.
    tolerance : float
        Largest distance of a change from a multiple of the step, relative to the step.
    """
    for parts in range(1, 4):
        step = smallest / parts
        # the smallest change has the rounding error of two readings, so the step is refined by least squares over all
        # changes; the passes begin with small multiples, because the error of a multiple of the step grows with the
        # multiple
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
    """Return the standard deviation of white noise [m, rad] from second differences, or NaN for too few positions."""
    if len(position) < BASELINE_SAMPLES:
        return np.nan
    return float(np.sqrt(np.mean(np.diff(position, n=2) ** 2) / NOISE_GAIN))
