"""One log as rows: what its printed digits leave open, the residual of its wall law, and rows missing or repeated.

A file may print decimals or significant digits, or have single precision, perhaps printed again. Which of these a
column did shows in its numbers: the fewest digits that have them all. Each leaves half a unit in its last digit open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.measured.signal.response import Response
from pipeline.measured.signal.sensor import FEWEST_ON_GRID, GRID_TOLERANCE
from pipeline.measured.student import ROUNDING
from pipeline.records.trials import Booleans, Floats, Integers, Trial

FULL_DIGITS = int(np.finfo(np.float64).precision)
"""Digits of a double of any size; more are those of arithmetic."""

ROUNDED = 4.0
"""Units of rounding by which a number may miss its digits: it was read, and perhaps converted to another unit."""

FEWEST_NUMBERS = 3
"""Different numbers that show digits: a column of 0 and 8 shows none."""

SINGLE_DIGITS = (int(np.finfo(np.float32).precision) + 1, int(np.finfo(np.float32).precision) + 3)
"""Digits with which single precision is printed."""

SET_DIGITS = 4
"""Digits that a person sets: a wall, a period, a cut-off. A number with more was cut off rather than chosen."""

_EPS, _SINGLE = float(np.finfo(np.float64).eps), float(np.finfo(np.float32).eps)


@dataclass(frozen=True, eq=False)
class Printed:
    """How a column was printed.

    Parameters
    ----------
    digits : int
        Fewest significant digits that have all numbers, at most `FULL_DIGITS`.
    decimal : float
        Half a unit in the last decimal that all numbers have, 0 for none.
    single : bool
        Whether they are, or were before they were printed, of single precision.
    half : float64, shape (N,)
        Half a unit in the last digit of each number; 0 for 0.
    """

    digits: int
    decimal: float
    single: bool
    half: Floats

    @property
    def in_full(self) -> bool:
        """Whether the digits leave nothing open but rounding of doubles."""
        return self.digits == FULL_DIGITS and not self.single


def printed(values: Floats) -> Printed:
    """Return how a column was printed, shape (N,), in its own unit or in degrees.

    Notes
    -----
    Numbers with decimals have as many significant digits as their size allows, and few where they are small: of both
    the coarser counts. No number is better than `FULL_DIGITS` digits.
    """
    result = _printed(np.abs(values))
    if not result.in_full:
        return result
    degrees = _printed(np.rad2deg(np.abs(values)))
    if degrees.digits == FULL_DIGITS:
        return result
    return replace(degrees, half=np.deg2rad(degrees.half), decimal=float(np.deg2rad(degrees.decimal)), single=False)


def _printed(size: Floats) -> Printed:
    full = _half(size, FULL_DIGITS)
    if len(np.unique(size)) < FEWEST_NUMBERS:
        return Printed(FULL_DIGITS, 0.0, False, full)
    digits, decimal = _digits(size), _of_decimals(size)
    half = np.maximum(_half(size, digits), decimal)
    rounded = size.astype(np.float32).astype(np.float64)
    if np.array_equal(rounded, size):
        # single precision has its own digits; fewer are those of print
        half = np.maximum(half * (digits < SINGLE_DIGITS[0]), 0.5 * _SINGLE * size)
        return Printed(digits, decimal, True, np.maximum(half, full))
    near = np.abs(rounded - size) <= half + ROUNDED * _EPS * size  # some lie half way between two of their digits
    single = SINGLE_DIGITS[0] <= digits <= SINGLE_DIGITS[1] and bool(near.all())
    return Printed(digits, decimal, single, np.maximum(half + 0.5 * _SINGLE * size * single, full))


def stated_resolution(values: Floats) -> Floats:
    """Return half a unit in the last digit of the numbers of a header, 0 where all have few digits.

    They are printed in the same way: one that ends in zeros has fewer digits than the others.
    """
    size = np.abs(values)
    digits = _digits(size)
    return _half(size, digits) if digits > SET_DIGITS else np.zeros(len(size))


def _digits(size: Floats) -> int:
    exponent = _exponent(size)
    return next((n for n in range(1, FULL_DIGITS) if _on_grid(size, n - 1 - exponent).all()), FULL_DIGITS)


def _exponent(size: Floats) -> Floats:
    """Return the power of ten of the first digit; 0 for 0."""
    with np.errstate(divide="ignore"):
        result: Floats = np.where(size > 0, np.floor(np.log10(size) + _EPS), 0.0)
    return result


def _half(size: Floats, digits: int) -> Floats:
    return np.where(size > 0, 0.5 * 10.0 ** (_exponent(size) - digits + 1), 0.0)


def _on_grid(size: Floats, decimals: Floats | int) -> Booleans:
    """Return which numbers have so many decimals, up to rounding."""
    # what overflows lies on no grid
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = size * 10.0 ** np.asarray(decimals, dtype=np.float64)
        result: Booleans = np.abs(scaled - np.rint(scaled)) <= ROUNDED * _EPS * scaled
    return result


def _of_decimals(size: Floats) -> float:
    """Return half a unit in the last decimal that all numbers have, 0 where they have more than digits allow."""
    top = int(_exponent(np.array([size.max()]))[0])
    decimals = next((n for n in range(-top, FULL_DIGITS - 1 - top) if _on_grid(size, n).all()), None)
    return 0.0 if decimals is None else 0.5 * 10.0**-decimals


def converted(values: Floats, half: float, others: Floats) -> float:
    """Return the step [N, Nm] of a converter on whose grid all commands (N,) are; 0 for none.

    ``half`` is half a unit in their last digit, and ``others`` forces of the wall by one quantum of the sensor.

    Source: Euclid's algorithm. A grid that ``others`` are on as well is theirs: all forces of a wall on a coarse sensor
    may be multiples of one.
    """
    levels = np.unique(values)
    if len(levels) < FEWEST_ON_GRID:
        return 0.0
    change = np.diff(levels)
    common, *smallest = np.sort(change)[:FEWEST_ON_GRID].tolist()
    left_open = max(ROUNDED * half, GRID_TOLERANCE * common)
    for rest in smallest:
        while rest > left_open:  # ends: at most half is left of the smaller one
            common, rest = rest, abs(common - rest * round(common / rest))
    if common < left_open / GRID:
        return 0.0
    counts = np.rint(change / common)
    step = float(change @ counts / (counts @ counts))
    share = others / step
    separate = (np.abs(share - np.rint(share)) > GRID).any() or not others.any()
    return step if separate and (np.abs(change - counts * step) <= GRID * step).all() else 0.0


ROUNDINGS = 16.0
"""Units of rounding of the terms of the law up to which its residual is rounding: they are a dozen operations. One
unit where commands are of single precision, whose own digit leaves more open."""

CAUGHT_UP = 1.3
"""Change in the row after a repeated reading, relative to the change before it: twice at an even speed."""


@dataclass(frozen=True, eq=False)
class LogRows:
    """One log: rows as arrays of shape (N,), and its conditions.

    ``of_command`` and ``of_position`` are what the digits of a number leave open, ``coarser`` what those of a position
    do if it was rounded, though it may be the reading as it was; ``left_open`` what those of K and B do. ``kept`` are
    the rows that a law must explain.
    """

    stiffness: float
    damping: float
    step: float
    period: float
    edge: int
    floor: float
    quantum: float
    time: Floats
    command: Floats
    position: Floats
    of_command: Floats
    of_position: Floats
    left_open: Floats
    arithmetic: float
    kept: Booleans
    coarser: Floats | None = None

    @classmethod
    def of(cls, trial: Trial, response: Response) -> LogRows:
        """Return the rows of a trial."""
        command, position = printed(trial.command), printed(trial.position)
        K, B, T = trial.stiffness, trial.damping, trial.sampling_period_s
        forces = response.sensor_quantum * np.array([K, B / T])
        step = converted(trial.command, float(command.half.max()), forces)
        # of positions with fewer digits than a file has room for, the digits are those of the sensor
        finer = position.digits < command.digits and position.decimal > command.decimal
        read = command.in_full or position.in_full or (finer and not position.single)
        return cls(
            *(K, B, trial.step, T, response.edge_row, response.floor, response.sensor_quantum),
            *(trial.time, trial.command, trial.position),
            of_command=np.maximum(command.half, 0.5 * step),
            of_position=_half(np.abs(trial.position), FULL_DIGITS) if read else position.half,
            left_open=stated_resolution(np.array([K, B])),
            arithmetic=_SINGLE if command.single else ROUNDINGS * _EPS,
            kept=np.ones(trial.rows, dtype=np.bool_),
            coarser=position.half if read and not command.in_full else None,
        )

    @property
    def readings(self) -> Iterator[LogRows]:
        """The log if its positions are what the controller read, where they may be, and if they were rounded."""
        yield self
        if self.coarser is not None:
            yield replace(self, of_position=self.coarser, coarser=None)

    @cached_property
    def change(self) -> Floats:
        """Change of the position since the row before [m, rad]."""
        result: Floats = np.diff(self.position, prepend=self.position[:1])
        return result

    @cached_property
    def displacement(self) -> Floats:
        """Position from where the wall rests [m, rad]."""
        result: Floats = self.position - self.position[0]
        return result

    @cached_property
    def wall(self) -> Floats:
        """Force of the wall by the law [N, Nm]."""
        return self.stiffness * self.displacement + self.damping / self.period * self.change

    @cached_property
    def external(self) -> Floats:
        """Command less the force of the wall [N, Nm]."""
        return self.command + self.wall

    @cached_property
    def residual(self) -> Floats:
        """Command less wall and step [N, Nm]."""
        return self.external - self.step * self.after

    @cached_property
    def rounding(self) -> Floats:
        """Largest residual that the digits of the log leave open in each row [N, Nm]."""
        K, B = abs(self.stiffness), abs(self.damping) / self.period
        of_displacement = self.of_position + self.of_position[0]
        of_change = self.of_position + np.append(self.of_position[:1], self.of_position[:-1])
        displacement, change = np.abs(self.displacement), np.abs(self.change)
        terms = np.abs(self.command) + abs(self.step) + K * displacement + B * change
        stated = self.left_open[0] * displacement + self.left_open[1] / self.period * change
        result: Floats = self.of_command + K * of_displacement + B * of_change + stated + self.arithmetic * terms
        return result

    @cached_property
    def after(self) -> Booleans:
        """Rows from the edge on."""
        result: Booleans = np.arange(len(self.position)) >= self.edge
        return result

    def without(self, rows: Booleans) -> LogRows:
        """Return the log with rows that no law must explain."""
        return replace(self, kept=self.kept & ~rows)

    def moved(self, rows: int) -> LogRows:
        """Return the log with commands so many rows earlier; its edge is the first row beyond half the step."""
        later = slice(max(rows, 0), len(self.command) + min(rows, 0))
        earlier = slice(max(-rows, 0), len(self.command) + min(-rows, 0))
        commands = {name: getattr(self, name)[later] for name in ("command", "of_command")}
        readings = {name: getattr(self, name)[earlier] for name in ("time", "position", "of_position")}
        coarser = None if self.coarser is None else self.coarser[earlier]
        # a row that either part of is left out is left out
        log = replace(self, **commands, **readings, kept=self.kept[later] & self.kept[earlier], coarser=coarser)
        return replace(log, edge=int(np.argmax(log.external * np.sign(self.step) > 0.5 * abs(self.step))))

    def off(self, predicted: NDArray[np.floating[Any]], rows: Booleans | None = None) -> bool:
        """Whether the command is not the predicted one, over some rows or all that are kept."""
        inside = self.kept if rows is None else self.kept & rows
        return bool((np.abs(self.command - predicted)[inside] > self.rounding[inside]).any())


def stands_still(change: Floats, first: int, least: float | Floats) -> Integers:
    """Return the rows from one on that stand still while the device moves by more than ``least`` before and behind."""
    rows = first + np.flatnonzero(change[first:] == 0)
    # the row behind makes up for the way of the one that stood still; a device that turns comes back instead
    behind = np.append(change[1:], 0.0)[rows]
    last, last_but_one = (np.take(change, rows - lag, mode="wrap") for lag in (1, 2))
    before = np.where(last != 0, last, last_but_one)
    moves = (np.abs(before) > np.broadcast_to(least, change.shape)[rows]) & (behind * before > 0)
    result: Integers = rows[moves & (np.abs(behind) > CAUGHT_UP * np.abs(before))]
    return result


PLATEAU = 2
"""Rows of equal extreme command that show a limit: two equal numbers are no chance."""

STILL_FLOORS = 3.0
"""Change of position on both sides of a row, in sensor floors, between which a device cannot stand still for a row."""

STILL_DIGITS = 60.0
"""The same in half units of the last digit: a quantum of a few of these is not seen as one."""

GRID = 0.05
"""Part of a quantum that a reading may be off its grid."""


def hidden_rows(log: LogRows) -> Integers:
    """Return the rows before which rows are missing by the wall law, while the stamps may not show it."""
    off = (np.abs(log.residual) > log.rounding) & log.after
    moving = off & (log.change != 0)
    if not moving.any() or log.damping == 0:
        return np.empty(0, dtype=np.int64)
    # over a row that is missing the position changed by more than since the row before: the residual is the damping
    # force of the change that is lost, which is like its neighbours
    lost = log.residual * log.period / log.damping
    near = np.max(np.abs([np.roll(log.change, 1), log.change, np.roll(log.change, -1)]), axis=0)
    like = np.mean((np.abs(lost) < 2 * (near + log.floor))[off]) > 0.9
    onward = np.median((lost * log.change)[moving]) > 0
    # a row that stands still amid a motion is repeated
    same = (log.change == 0) & (np.diff(log.command, prepend=np.nan) == 0)
    repeated = same & (near > STILL_FLOORS * log.floor)
    single = (off & ~np.roll(off, 1)).sum() >= 0.7 * off.sum() - 1
    missing = like and onward and repeated[off].mean() < 0.4 and single and _on_sensor_grid(log, off)
    return np.flatnonzero(off & missing)


def _on_sensor_grid(log: LogRows, off: Booleans) -> bool:
    """Return whether the readings that would be missing lie on the grid of the sensor, to the printed digits."""
    scale = log.period / abs(log.damping)
    tolerance = GRID * log.quantum + scale * log.rounding[off]
    lost = scale * np.abs(log.residual[off])
    resolved = tolerance < 2 * GRID * log.quantum
    away = np.abs(lost - np.rint(lost / log.quantum) * log.quantum) if log.quantum else lost
    return bool((away <= tolerance)[resolved].all())


def repeated_rows(log: LogRows) -> tuple[Integers, Integers]:
    """Return the rows that stand still while the device moves before and behind them, in all two or more.

    Then the same with those that only the plain wall law distinguishes from a slow device; one counts, too.
    """
    digits = STILL_DIGITS * log.of_position
    # a quantum that print hides is at most the least change
    hidden = np.abs(log.change)[np.abs(log.change) > digits].min(initial=np.inf) if not log.quantum else 0.0
    least = STILL_FLOORS * max(log.floor, hidden) + ROUNDING * np.ptp(log.position) + digits
    still = stands_still(log.change, log.edge, least)
    # the row itself is off the law where the device moved before, the row behind where it moves on
    off = np.abs(log.residual) > log.rounding
    same = np.diff(log.command, prepend=np.nan) == 0
    by_law = log.after & (log.change == 0) & ((same & off) | ((same | off) & np.append(off[1:], False)))
    return still if len(still) >= PLATEAU else still[:0], np.union1d(still, np.flatnonzero(by_law))


def is_equal(values: Floats, limit: float) -> Booleans:
    """Return which values are the same number as a limit, up to rounding."""
    result: Booleans = np.abs(values - limit) <= ROUNDING * max(abs(limit), 1e-300)
    return result
