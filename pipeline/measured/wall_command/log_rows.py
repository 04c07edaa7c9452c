"""Examine the rows of one log for rounding of printed digits, residual of the wall law, and missing or repeated rows.

A file may print decimals or significant digits, or contain single precision, which may have been printed again. The
numbers of a column show its format, which has the smallest number of digits that represents all of them. Each number
has a rounding error of up to half a unit in its last digit.
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
"""Number of significant digits that any double has. Further digits are rounding errors."""

ROUNDED = 4.0
"""Largest deviation of a number from its printed digits after parsing and a unit conversion, in rounding units."""

FEWEST_NUMBERS = 3
"""Smallest number of different values from which digits can be inferred. A column that contains only 0 and 8 does not
show its digits."""

SINGLE_DIGITS = (int(np.finfo(np.float32).precision) + 1, int(np.finfo(np.float32).precision) + 3)
"""Range of the number of digits with which single precision is printed."""

SET_DIGITS = 4
"""Largest number of digits of a value set by a person (wall, period, cut-off). A value with more digits was
truncated."""

_EPS, _SINGLE = float(np.finfo(np.float64).eps), float(np.finfo(np.float32).eps)


@dataclass(frozen=True, eq=False)
class Printed:
    """Print format of a column.

    Parameters
    ----------
    digits : int
        Smallest number of significant digits that represents all numbers, at most `FULL_DIGITS`.
    decimal : float
        Half a unit in the last common decimal of all numbers, or 0 if there is none.
    single : bool
        Whether the numbers have single precision, or had it before they were printed.
    half : float64, shape (N,)
        Half a unit in the last digit of each number, or 0 for 0.
    """

    digits: int
    decimal: float
    single: bool
    half: Floats

    @property
    def in_full(self) -> bool:
        """Whether the digits are exact up to the rounding of doubles."""
        return self.digits == FULL_DIGITS and not self.single


def printed(values: Floats) -> Printed:
    """Return the print format of a column, shape (N,), in the given unit or in degrees.

    Notes
    -----
    With a fixed number of decimals, smaller numbers have fewer significant digits. The coarser of the two resolutions
    is used. No number is more accurate than `FULL_DIGITS` digits.
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
        # Single precision has a fixed number of digits. A smaller number is due to printing.
        half = np.maximum(half * (digits < SINGLE_DIGITS[0]), 0.5 * _SINGLE * size)
        return Printed(digits, decimal, True, np.maximum(half, full))
    near = np.abs(rounded - size) <= half + ROUNDED * _EPS * size  # some numbers lie half-way between two digits
    single = SINGLE_DIGITS[0] <= digits <= SINGLE_DIGITS[1] and bool(near.all())
    return Printed(digits, decimal, single, np.maximum(half + 0.5 * _SINGLE * size * single, full))


def stated_resolution(values: Floats) -> Floats:
    """Return half a unit in the last digit of the numbers of a header, or 0 if all have few digits.

    All numbers are assumed to have the same format, since a number that ends in zeros seems to have fewer digits.
    """
    size = np.abs(values)
    digits = _digits(size)
    return _half(size, digits) if digits > SET_DIGITS else np.zeros(len(size))


def _digits(size: Floats) -> int:
    exponent = _exponent(size)
    return next((n for n in range(1, FULL_DIGITS) if _on_grid(size, n - 1 - exponent).all()), FULL_DIGITS)


def _exponent(size: Floats) -> Floats:
    """Return the exponent (power of ten) of the first digit, or 0 for a number of 0."""
    with np.errstate(divide="ignore"):
        result: Floats = np.where(size > 0, np.floor(np.log10(size) + _EPS), 0.0)
    return result


def _half(size: Floats, digits: int) -> Floats:
    return np.where(size > 0, 0.5 * 10.0 ** (_exponent(size) - digits + 1), 0.0)


def _on_grid(size: Floats, decimals: Floats | int) -> Booleans:
    """Return whether each number has at most the given number of decimals, up to rounding."""
    # a number that overflows is not on a grid
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = size * 10.0 ** np.asarray(decimals, dtype=np.float64)
        result: Booleans = np.abs(scaled - np.rint(scaled)) <= ROUNDED * _EPS * scaled
    return result


def _of_decimals(size: Floats) -> float:
    """Return half a unit in the last common decimal of all numbers, or 0 if there are not enough digits."""
    top = int(_exponent(np.array([size.max()]))[0])
    decimals = next((n for n in range(-top, FULL_DIGITS - 1 - top) if _on_grid(size, n).all()), None)
    return 0.0 if decimals is None else 0.5 * 10.0**-decimals


def converted(values: Floats, half: float, others: Floats) -> float:
    """Return the step [N, Nm] of the converter grid on which all commands (N,) lie, or 0 if there is none.

    ``half`` is half a unit in the last digit of the commands. ``others`` are wall forces due to one quantum of the
    sensor. If they also lie on the grid, the grid is due to the sensor: with a coarse sensor, all wall forces may be
    multiples of one force. The step is found by Euclid's algorithm.
    """
    levels = np.unique(values)
    if len(levels) < FEWEST_ON_GRID:
        return 0.0
    change = np.diff(levels)
    common, *smallest = np.sort(change)[:FEWEST_ON_GRID].tolist()
    left_open = max(ROUNDED * half, GRID_TOLERANCE * common)
    for rest in smallest:
        while rest > left_open:  # terminates, since the remainder decreases by at least one half
            common, rest = rest, abs(common - rest * round(common / rest))
    if common < left_open / GRID:
        return 0.0
    counts = np.rint(change / common)
    step = float(change @ counts / (counts @ counts))
    share = others / step
    separate = (np.abs(share - np.rint(share)) > GRID).any() or not others.any()
    return step if separate and (np.abs(change - counts * step) <= GRID * step).all() else 0.0


ROUNDINGS = 16.0
"""Largest residual of the law that is attributed to rounding, in rounding units of its terms, for about a dozen
operations. For commands of single precision, one coarser unit is used instead."""

CAUGHT_UP = 1.3
"""Smallest change after a repeated reading, relative to the change before it. At constant speed, the ratio is 2."""


@dataclass(frozen=True, eq=False)
class LogRows:
    """Rows of one log as arrays of shape (N,), and the conditions of the log.

    ``of_command`` and ``of_position`` are rounding errors of the printed numbers. ``coarser`` is the error of a
    position that may be rounded or exact, in case it is rounded. ``left_open`` contains the rounding errors of K and B.
    ``kept`` marks the rows that a law must explain.
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
        # if positions have fewer digits than the file format allows, the digits show the resolution of the sensor
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
        """Yield the log with exact positions, if they may be exact, and with rounded positions."""
        yield self
        if self.coarser is not None:
            yield replace(self, of_position=self.coarser, coarser=None)

    @cached_property
    def change(self) -> Floats:
        """Change of the position since the previous row [m, rad]."""
        result: Floats = np.diff(self.position, prepend=self.position[:1])
        return result

    @cached_property
    def displacement(self) -> Floats:
        """Position relative to the rest position of the wall [m, rad]."""
        result: Floats = self.position - self.position[0]
        return result

    @cached_property
    def wall(self) -> Floats:
        """Wall force according to the law [N, Nm]."""
        return self.stiffness * self.displacement + self.damping / self.period * self.change

    @cached_property
    def external(self) -> Floats:
        """Command plus wall force [N, Nm], i.e. the external force."""
        return self.command + self.wall

    @cached_property
    def residual(self) -> Floats:
        """Command plus wall force minus step [N, Nm]."""
        return self.external - self.step * self.after

    @cached_property
    def rounding(self) -> Floats:
        """Largest residual in each row that rounding of the logged digits may cause [N, Nm]."""
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
        """Whether each row is at or after the edge."""
        result: Booleans = np.arange(len(self.position)) >= self.edge
        return result

    def without(self, rows: Booleans) -> LogRows:
        """Return the log without the given rows in comparisons with a law."""
        return replace(self, kept=self.kept & ~rows)

    def moved(self, rows: int) -> LogRows:
        """Return the log with its commands shifted to earlier rows. Its edge is the first row beyond half the step."""
        later = slice(max(rows, 0), len(self.command) + min(rows, 0))
        earlier = slice(max(-rows, 0), len(self.command) + min(-rows, 0))
        commands = {name: getattr(self, name)[later] for name in ("command", "of_command")}
        readings = {name: getattr(self, name)[earlier] for name in ("time", "position", "of_position")}
        coarser = None if self.coarser is None else self.coarser[earlier]
        # a row is excluded if its command or its position is excluded
        log = replace(self, **commands, **readings, kept=self.kept[later] & self.kept[earlier], coarser=coarser)
        return replace(log, edge=int(np.argmax(log.external * np.sign(self.step) > 0.5 * abs(self.step))))

    def off(self, predicted: NDArray[np.floating[Any]], rows: Booleans | None = None) -> bool:
        """Return whether the command differs from a prediction, in the given rows or in all kept rows."""
        inside = self.kept if rows is None else self.kept & rows
        return bool((np.abs(self.command - predicted)[inside] > self.rounding[inside]).any())


def stands_still(change: Floats, first: int, least: float | Floats) -> Integers:
    """Return the constant rows from ``first`` on between rows in which the device moves by more than ``least``."""
    rows = first + np.flatnonzero(change[first:] == 0)
    # the next row catches up with the motion of the constant row, unless the device has reversed
    behind = np.append(change[1:], 0.0)[rows]
    last, last_but_one = (np.take(change, rows - lag, mode="wrap") for lag in (1, 2))
    before = np.where(last != 0, last, last_but_one)
    moves = (np.abs(before) > np.broadcast_to(least, change.shape)[rows]) & (behind * before > 0)
    result: Integers = rows[moves & (np.abs(behind) > CAUGHT_UP * np.abs(before))]
    return result


PLATEAU = 2
"""Smallest number of rows with an equal extreme command that shows a limit of the command. Two equal numbers are not
attributed to chance."""

STILL_FLOORS = 3.0
"""Smallest change of position on both sides of a row, in sensor floors, at which the device counts as moving there."""

STILL_DIGITS = 60.0
"""Smallest change of position, in half units of the last digit, at which the device counts as moving in a row. A
smaller quantum is not detected."""

GRID = 0.05
"""Largest deviation of a reading from its grid, in quanta."""


def hidden_rows(log: LogRows) -> Integers:
    """Return the rows after missing rows, as implied by the wall law. The time stamps may not show them."""
    off = (np.abs(log.residual) > log.rounding) & log.after
    moving = off & (log.change != 0)
    if not moving.any() or log.damping == 0:
        return np.empty(0, dtype=np.int64)
    # across a missing row, the logged change of position is larger than the change that the controller used; the
    # residual is the damping force due to the lost change, which is similar to its neighbours
    lost = log.residual * log.period / log.damping
    near = np.max(np.abs([np.roll(log.change, 1), log.change, np.roll(log.change, -1)]), axis=0)
    like = np.mean((np.abs(lost) < 2 * (near + log.floor))[off]) > 0.9
    onward = np.median((lost * log.change)[moving]) > 0
    # a constant row within a motion is repeated
    same = (log.change == 0) & (np.diff(log.command, prepend=np.nan) == 0)
    repeated = same & (near > STILL_FLOORS * log.floor)
    single = (off & ~np.roll(off, 1)).sum() >= 0.7 * off.sum() - 1
    missing = like and onward and repeated[off].mean() < 0.4 and single and _on_sensor_grid(log, off)
    return np.flatnonzero(off & missing)


def _on_sensor_grid(log: LogRows, off: Booleans) -> bool:
    """Return whether the implied missing readings lie on the grid of the sensor, up to the printed digits."""
    scale = log.period / abs(log.damping)
    tolerance = GRID * log.quantum + scale * log.rounding[off]
    lost = scale * np.abs(log.residual[off])
    resolved = tolerance < 2 * GRID * log.quantum
    away = np.abs(lost - np.rint(lost / log.quantum) * log.quantum) if log.quantum else lost
    return bool((away <= tolerance)[resolved].all())


def repeated_rows(log: LogRows) -> tuple[Integers, Integers]:
    """Return constant rows before and after which the device moves (none if fewer than two), and a larger set.

    The larger set also contains rows that only the plain wall law distinguishes from a slow device. One such row
    suffices.
    """
    digits = STILL_DIGITS * log.of_position
    # a quantum that printing hides is at most the smallest change
    hidden = np.abs(log.change)[np.abs(log.change) > digits].min(initial=np.inf) if not log.quantum else 0.0
    least = STILL_FLOORS * max(log.floor, hidden) + ROUNDING * np.ptp(log.position) + digits
    still = stands_still(log.change, log.edge, least)
    # A repeated row violates the law if the device moved before. The next row also violates it if the device continues
    # to move.
    off = np.abs(log.residual) > log.rounding
    same = np.diff(log.command, prepend=np.nan) == 0
    by_law = log.after & (log.change == 0) & ((same & off) | ((same | off) & np.append(off[1:], False)))
    return still if len(still) >= PLATEAU else still[:0], np.union1d(still, np.flatnonzero(by_law))


def is_equal(values: Floats, limit: float) -> Booleans:
    """Return whether each value equals a limit, up to rounding."""
    result: Booleans = np.abs(values - limit) <= ROUNDING * max(abs(limit), 1e-300)
    return result
