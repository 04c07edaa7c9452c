"""Numbers as unevaluated sums of two doubles: 32 digits by single roundings, the same on every processor.

Arrays of them have a first axis of length 2: the value rounded to a double, and what that leaves.
"""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal

import numpy as np

from pipeline.records.batch import Floats

_SPLIT = 2.0**27 + 1
"""Parts a double into two halves of 26 bits, whose products are exact (Dekker 1971)."""


def twofold(values: Floats) -> Floats:
    """Return doubles as twofold numbers, shape (2, ...)."""
    return np.stack([values, np.zeros_like(values)])


def from_decimals(rows: Iterable[Iterable[Decimal]]) -> Floats:
    """Return a matrix of decimals as twofold numbers, shape (2, rows, columns)."""
    pairs = [[(float(value), float(value - Decimal(float(value)))) for value in row] for row in rows]
    return np.moveaxis(np.array(pairs), 2, 0)


def add(a: Floats, b: Floats) -> Floats:
    """Return the sum of twofold numbers; shapes are broadcast."""
    high = a[0] + b[0]
    part = high - a[0]
    low = (a[0] - (high - part)) + (b[0] - part)  # what rounding took from the sum (Knuth)
    return _normalised(high, low + (a[1] + b[1]))


def multiply(a: Floats, b: Floats) -> Floats:
    """Return the product of twofold numbers; shapes are broadcast."""
    high = a[0] * b[0]
    (a_left, a_right), (b_left, b_right) = _halves(a[0]), _halves(b[0])
    low = ((a_left * b_left - high) + a_left * b_right + a_right * b_left) + a_right * b_right
    return _normalised(high, low + (a[0] * b[1] + a[1] * b[0]))


def _normalised(high: Floats, low: Floats) -> Floats:
    total = high + low
    return np.stack([total, low - (total - high)])


def _halves(value: Floats) -> tuple[Floats, Floats]:
    scaled = _SPLIT * value
    left = scaled - (scaled - value)
    return left, value - left
