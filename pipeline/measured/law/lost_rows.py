"""Rows of a log that are missing or repeated, by its positions and by the wall law."""

from __future__ import annotations

import numpy as np

from pipeline.measured.law.log_rows import LogRows, stands_still
from pipeline.records.batch import Booleans, Floats, Integers

PLATEAU = 2
"""Rows of equal extreme command that show a limit: two equal numbers are no chance."""

EQUAL = 1e-12
"""Relative difference of commands that are the same number."""

MOST_SPIKES = 0.34
"""Largest share of rows off the law that single lost or repeated rows cause; with more, nothing is single."""

STILL_FLOORS = 3.0
"""Change of position on both sides of a row, in sensor floors, between which a device cannot stand still for a row."""

STILL_DIGITS = 60.0
"""The same in half units of the last digit: a quantum of a few of these is not seen as one."""

GRID = 0.05
"""Part of a quantum that a reading may be off its grid."""


def hidden_rows(log: LogRows) -> Integers:
    """Return the rows before which rows are missing by the wall law, while the stamps may not show it."""
    none = np.empty(0, dtype=np.int64)
    off = (np.abs(log.residual) > log.rounding) & log.after
    if not off.any() or log.damping == 0 or off.mean() > MOST_SPIKES:
        return none
    # over a row that is missing the position changed by more than since the row before: the residual is a part of
    # the damping force that the logged rows would give
    moving = off & (log.change != 0)
    if not moving.any():
        return none
    part = log.residual[moving] * log.period / (log.damping * log.change[moving])
    single = off & ~np.roll(off, 1)
    if np.median(part) > 0 and np.mean((part > -1) & (part < 2)) > 0.9 and single.sum() > 0.7 * off.sum():
        return np.flatnonzero(off) if _on_grid(log, off) else none
    return none


def _on_grid(log: LogRows, off: Booleans) -> bool:
    """Return whether the readings that would be missing lie on the grid of the sensor, as far as digits tell."""
    scale = log.period / abs(log.damping)
    tolerance = GRID * log.quantum + scale * log.rounding[off]
    lost = scale * np.abs(log.residual[off])
    told = tolerance < 2 * GRID * log.quantum
    away = np.abs(lost - np.rint(lost / log.quantum) * log.quantum) if log.quantum else lost
    return bool((away <= tolerance)[told].all())


def repeated_rows(log: LogRows, *, by_law: bool = True) -> Integers:
    """Return the rows that stand still while the device moves before and after them; one alone may be chance.

    ``by_law`` counts those, too, that only the plain wall law tells from a device that is slow.
    """
    least = STILL_FLOORS * log.floor + EQUAL * np.ptp(log.position) + STILL_DIGITS * log.of_position
    still = stands_still(log.change, log.after, least)
    # the row itself is off the law where the device moved before, the row behind where it moves on
    off = np.abs(log.residual) > log.rounding
    same = np.diff(log.command, prepend=np.nan) == 0
    still |= by_law & log.after & (log.change == 0) & ((same & off) | ((same | off) & np.append(off[1:], False)))
    rows = np.flatnonzero(still)
    return rows if len(rows) >= PLATEAU else rows[:0]


def is_equal(values: Floats, limit: float) -> Booleans:
    """Return which values are the same number as a limit, up to rounding."""
    result: Booleans = np.abs(values - limit) <= EQUAL * max(abs(limit), 1e-300)
    return result
