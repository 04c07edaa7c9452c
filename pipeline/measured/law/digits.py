"""What the printed digits of a column leave open: half a unit in the last digit of each of its numbers.

A file may print decimals or significant digits, or hold single precision, perhaps in print again. Which of these a
column did shows in its numbers: the fewest digits that have them all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.records.batch import Booleans, Floats

FULL_DIGITS = 15
"""Digits that a double holds whatever its size; more are those of arithmetic."""

ROUNDED = 4.0
"""Units of rounding by which a number may miss its digits: it was read, and perhaps converted to another unit."""

FEWEST_NUMBERS = 3
"""Different numbers that show digits: a column of 0 and 8 shows none."""

SINGLE_DIGITS = (7, 9)
"""Digits with which single precision is printed."""

STATED_DIGITS = 5
"""Digits from which on a number of a header was cut off rather than chosen."""

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
        Half a unit in the last digit of each number; 0 for 0 and for NaN.
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
    found = _printed(np.where(np.isfinite(values), np.abs(values), 0.0))
    if found.digits < FULL_DIGITS or found.single:
        return found
    degrees = _printed(np.rad2deg(np.where(np.isfinite(values), np.abs(values), 0.0)))
    if degrees.digits == FULL_DIGITS:
        return found
    return replace(degrees, half=np.deg2rad(degrees.half), decimal=float(np.deg2rad(degrees.decimal)), single=False)


def _printed(size: Floats) -> Printed:
    full = _half(size, FULL_DIGITS)
    if len(np.unique(size)) < FEWEST_NUMBERS:
        return Printed(FULL_DIGITS, 0.0, False, full)
    digits, decimal = _digits(size), _of_decimals(size)
    half = np.maximum(_half(size, digits), decimal)
    single = size.astype(np.float32).astype(np.float64)
    if np.array_equal(single, size):
        # single precision has its own digits; fewer are those of print
        half = np.maximum(half * (digits < SINGLE_DIGITS[0]), 0.5 * _SINGLE * size)
        return Printed(digits, decimal, True, np.maximum(half, full))
    rounded = SINGLE_DIGITS[0] <= digits <= SINGLE_DIGITS[1] and bool((np.abs(single - size) <= half).all())
    return Printed(digits, decimal, rounded, np.maximum(half + 0.5 * _SINGLE * size * rounded, full))


def full_resolution(values: Floats) -> Floats:
    """Return half a unit in the last digit of numbers that are printed in full, shape (N,)."""
    return _half(np.where(np.isfinite(values), np.abs(values), 0.0), FULL_DIGITS)


def stated_resolution(value: float) -> float:
    """Return half a unit in the last digit of a number of a header, 0 where it has few digits."""
    size = np.abs(np.array([value]))
    digits = _digits(size)
    return float(_half(size, digits)[0]) if digits >= STATED_DIGITS else 0.0


def _digits(size: Floats) -> int:
    return next((n for n in range(1, FULL_DIGITS) if _on_grid(size, n - 1 - _exponent(size)).all()), FULL_DIGITS)


def _exponent(size: Floats) -> Floats:
    """Return the power of ten of the first digit; 0 for 0."""
    with np.errstate(divide="ignore"):
        result: Floats = np.where(size > 0, np.floor(np.log10(size) + _EPS), 0.0)
    return result


def _half(size: Floats, digits: int) -> Floats:
    return np.where(size > 0, 0.5 * 10.0 ** (_exponent(size) - digits + 1), 0.0)


def _on_grid(size: Floats, decimals: Floats | int) -> Booleans:
    """Return which numbers have so many decimals, up to rounding."""
    scaled = size * 10.0 ** np.asarray(decimals, dtype=np.float64)
    result: Booleans = np.abs(scaled - np.rint(scaled)) <= ROUNDED * _EPS * scaled
    return result


def _of_decimals(size: Floats) -> float:
    """Return half a unit in the last decimal that all numbers have, 0 where they have more than digits allow."""
    top = int(_exponent(np.array([size.max()]))[0])
    found = (n for n in range(-top, FULL_DIGITS - 1 - top) if _on_grid(size, n).all())
    decimals = next(found, None)
    return 0.0 if decimals is None else 0.5 * 10.0**-decimals
