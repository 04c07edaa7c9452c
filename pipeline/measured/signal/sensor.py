"""How finely a sensor sees: its quantum, its noise, and the amplitude that both can cause."""

from __future__ import annotations

import numpy as np

from pipeline.recording.samples import NOISE_GAIN, last_digit
from pipeline.records.batch import Booleans, Floats, TrialBatch

BASELINE_SAMPLES = 5
"""Fewest baseline rows for the noise, whose own error then is 60 % (25 % for 20 rows); none would be zero."""

NOISE_FACTOR = 6.0
"""Four standard deviations (2 % chance in 400 samples) of the difference of two readings, 4 sqrt 2 and more."""

AT_REST = 2.0
"""Sensor floors within which readings of a device at rest stay: it may lie between two, and beat."""

GRID_TOLERANCE = 1e-3
"""Largest distance of a change from a multiple of the quantum, relative to the quantum."""

STORED_TOLERANCE = 0.15
"""As `GRID_TOLERANCE` for positions that were stored in single precision or with few digits: six units of the
last digit in one quantum still pass."""

STORED_GAP = 4.0
"""Ratio between neighbours of the sorted changes that parts one quantum from what the storing rounded."""

STORED_MULTIPLES = 20.0
"""Largest multiple that tests a grid in rounded positions: beyond, its own error reaches the tolerance."""

FEWEST_ON_GRID = 12
"""Changes that must lie on such a grid, of a command too: those of a continuous signal all do with a chance of
0.3^12 = 5e-7."""

DIGITS, CHANGE_DIGITS = 8.0, 2.5
"""Changes of fewer digits than the first are those of print; and the error of a second difference in digits: each of
four readings is off by half of one."""

BY_CHANCE, FEWEST_COARSE = 14.5, 4
"""Logarithm of the inverse chance that changes lie on a grid by accident, that of `FEWEST_ON_GRID`; fewest of them."""

COARSE_MULTIPLES = 1e3
"""Largest multiple that tests a grid among printed positions."""

ROUNDING_UNITS = 64.0
"""Changes below this many units of rounding are arithmetic, not the sensor."""


def sensor_floor(quantum: Floats, noise: Floats) -> Floats:
    """Return the position amplitude that quantum and noise alone can cause [m, rad]; a noise of NaN counts as none."""
    floor: Floats = quantum + NOISE_FACTOR * np.nan_to_num(noise)
    return floor


def sensor_quantum(batch: TrialBatch) -> Floats:
    """Return the step of the sensor [m, rad] of each trial, shape (n,): see `position_quantum`."""
    quantum = np.zeros(len(batch))
    for some, part in batch.portions():
        quantum[some] = position_quantum(part.position)
    return quantum


def position_quantum(position: Floats) -> Floats:
    """Return the step of the grid on which positions (n, N) lie, shape (n,): the coarsest one, 0 where there is none.

    Single precision and printed digits put the positions on a finer grid of their own, whose step is not the
    sensor's: a grid that is coarser, and on which they lie but for that rounding, goes first. NaN is padding.
    """
    # padding does not move; a fast motion never changes by one quantum a sample, but its changes differ by one
    steps = [np.abs(np.nan_to_num(np.diff(position, n=n, axis=1))) for n in (1, 2)]
    size = np.concatenate(steps, axis=1)
    if size.shape[1] < 2:
        return np.zeros(len(position))
    rounding = ROUNDING_UNITS * np.finfo(np.float64).eps * np.nanmax(np.abs(position), axis=1, initial=0.0)
    size = np.sort(np.where(size > rounding[:, None], size, np.inf), axis=1)
    change = np.where(steps[0] > rounding[:, None], steps[0], 0.0)
    exact = _grid(change, size[:, 0], GRID_TOLERANCE, np.inf, 1)
    # beyond 1/tolerance multiples the rounding of the positions themselves hides the grid
    exact[exact <= rounding / GRID_TOLERANCE] = 0.0
    with np.errstate(invalid="ignore"):
        ratio = np.where(np.isfinite(size[:, 1:]), size[:, 1:] / size[:, :-1], 0.0)
    # without a gap the smallest change is no candidate: those of a smooth motion have common measures of their own
    gap, trial = np.argmax(ratio, axis=1), np.arange(len(position))
    above = np.where(ratio[trial, gap] > STORED_GAP, size[trial, gap + 1], np.inf)
    finite = np.where(np.isfinite(size), size, 0.0)
    stored = _grid(finite, above, STORED_TOLERANCE, STORED_MULTIPLES, FEWEST_ON_GRID)
    found = np.where(stored > STORED_GAP * exact, stored, exact)
    # on the grid of its digits a fast motion has few changes, each of which is known to a few of them
    digit = np.where(exact > 0, exact, last_digit(position))
    tested = np.isfinite(size) & (size > DIGITS * digit[:, None]) & (digit > 0)[:, None]
    above = np.min(size, axis=1, initial=np.inf, where=tested)
    tolerance = np.clip(CHANGE_DIGITS * digit / above, GRID_TOLERANCE, STORED_TOLERANCE)
    fewest = np.maximum(np.ceil(BY_CHANCE / np.log(0.5 / tolerance)), FEWEST_COARSE)
    usable = np.isfinite(above) & (tolerance < STORED_TOLERANCE)
    changes = np.where(tested, size, 0.0)
    coarse = _grid(changes, np.where(usable, above, np.inf), tolerance, COARSE_MULTIPLES, fewest)
    return np.asarray(np.where(coarse > found, coarse, found))


def _grid(size: Floats, smallest: Floats, tolerance: float | Floats, most: float, fewest: int | Floats) -> Floats:
    """Step of the grid on which changes of up to ``most`` steps lie, ``fewest`` at least; 0 for none."""
    result = np.zeros(len(size))
    tolerance, fewest = (np.broadcast_to(each, (len(size),)) for each in (tolerance, fewest))
    # no single change may have been one step: then the smallest is two or three of them
    for parts in (1, 2, 3):
        open_ = np.flatnonzero(np.isfinite(smallest) & (result == 0))
        if not len(open_):
            break
        own, grid = size[open_], smallest[open_] / parts
        # the smallest change carries the rounding of two readings, the mean of all hardly any: step by step, for an
        # error of the grid is one of its multiples as many times over
        for limit in (3.0 * parts, 8.0 * parts, most) if np.isfinite(most) else ():
            multiple = np.round(own / grid[:, None])
            tested = (multiple >= 1) & (multiple <= limit)
            square = np.where(tested, multiple**2, 0.0).sum(axis=1)
            mean = np.where(tested, multiple * own, 0.0).sum(axis=1) / np.maximum(square, 1.0)
            grid = np.where(square > 0, mean, np.inf)
        multiple = np.round(own / grid[:, None])
        error = np.where(multiple <= most, np.abs(own / grid[:, None] - multiple), 0.0).max(axis=1, initial=0.0)
        number = ((multiple >= 1) & (multiple <= most)).sum(axis=1)
        found = np.isfinite(grid) & (error < tolerance[open_]) & (number >= fewest[open_])
        result[open_] = np.where(found, grid, 0.0)
    return result


def white_noise(position: Floats, baseline: Booleans) -> Floats:
    """Return the standard deviation [m, rad] of white noise from the second differences of the baseline, shape (n,)."""
    second = np.diff(position, n=2, axis=1)
    where = baseline[:, 2:]
    count = where.sum(axis=1)
    mean_square = np.where(where, second**2, 0.0).sum(axis=1) / np.maximum(count, 1)
    enough = count >= BASELINE_SAMPLES - 2
    result: Floats = np.where(enough, np.sqrt(mean_square / NOISE_GAIN), np.nan)
    return result
