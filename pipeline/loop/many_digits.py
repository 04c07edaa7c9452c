"""Compute with small matrices and polynomials with many digits, which avoids cancellation in quantities of a loop.

Matrices and polynomials are numpy arrays of `decimal.Decimal`. Polynomials have the lowest power first. The decimal
context of `many_digits` determines the number of digits.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from decimal import MAX_EMAX, MIN_EMIN, Context, Decimal, localcontext
from functools import lru_cache
from itertools import accumulate
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

Digits = NDArray[np.object_]
"""Array of Decimal."""

_SMALL = 1.0
"""Norm to which a matrix is scaled down by halving before the series of its exponential is summed."""

exact = np.frompyfunc(Decimal, 1, 1)
"""Function that converts floats to Decimal without rounding."""


def many_digits(digits: int) -> AbstractContextManager[Context]:
    """Return a Decimal context with the given number of digits and an unlimited exponent range."""
    return localcontext(_context(digits))


@lru_cache(maxsize=64)
def _context(digits: int) -> Context:
    return Context(prec=digits, Emax=MAX_EMAX, Emin=MIN_EMIN)


def as_exact(values: Any) -> Digits:
    """Return numbers or arrays of numbers as an array of Decimal."""
    return np.asarray(exact(np.asarray(values, dtype=object)), dtype=object)


def as_floats(values: Digits) -> NDArray[np.float64]:
    """Return Decimal numbers rounded to doubles."""
    return values.astype(np.float64)


def derivative(polynomial: Digits) -> Digits:
    """Return the derivative of a polynomial."""
    if len(polynomial) == 1:
        return as_exact([0])
    return np.asarray(polynomial[1:] * np.arange(1, len(polynomial)), dtype=object)


def value_at(polynomial: Digits, x: Decimal) -> Decimal:
    """Return the value of a polynomial at x."""
    value = Decimal(0)
    for c in polynomial[::-1].tolist():
        value = value * x + c
    return value


@lru_cache(maxsize=64)
def unit(size: int) -> Digits:
    """Return the unit matrix."""
    return as_exact(np.eye(size))


def resolvent(matrix: Digits) -> tuple[Digits, Digits]:
    """Return determinant and adjugate of x - matrix as polynomials in x, shapes (n + 1,) and (n, n, n).

    The first axis is the power.

    Source: Faddeev and LeVerrier.
    """
    one = unit(len(matrix))
    adjugate, determinant = [one], [Decimal(1)]
    for k in range(1, len(matrix) + 1):
        if k > 1:
            adjugate.append(matrix @ adjugate[-1] + determinant[-1] * one)
        determinant.append(-(matrix * adjugate[-1].T).sum() / k)  # the trace of their product
    return np.array(determinant[::-1], dtype=object), np.array(adjugate[::-1], dtype=object)


def exponential(matrix: Digits, digits: int) -> Digits:
    """Return the exponential of a square matrix, from the power series of the scaled matrix and repeated squaring.

    Powers n and above of an n x n matrix are combinations of lower powers (Cayley and Hamilton). Terms of the series
    are therefore vectors of n coefficients. They are at most of size 1, and summed as multiples of a power of 2.
    """
    norm = float(np.abs(matrix).sum(axis=1).max())
    halvings = max(0, int(np.ceil(np.log2(norm / _SMALL)))) if norm > 0 else 0
    part, one = matrix / Decimal(2) ** halvings, unit(len(matrix))
    bits = math.ceil((digits + halvings) * math.log2(10))
    bottom = [int(c * (1 << bits)) for c in resolvent(part)[0][:-1]]
    sums = term = [1 << bits] + [0] * (len(bottom) - 1)
    for n in range(1, 4 * digits):
        carried = term[-1]
        term = [(low - (carried * c >> bits)) // n for low, c in zip([0, *term[:-1]], bottom, strict=True)]
        sums = [a + b for a, b in zip(sums, term, strict=True)]
        if max(map(abs, term)) <= 1:
            break
    powers: list[Digits] = [Decimal(factor) / (1 << bits) * one for factor in reversed(sums)]
    result = powers[0]
    for power in powers[1:]:
        result = result @ part + power
    for _ in range(halvings):
        result = result @ result
    return result


def product(*factors: Digits) -> Digits:
    """Return the product of polynomials."""
    result = factors[0]
    for factor in factors[1:]:
        result = np.convolve(result, factor)
    return result


@lru_cache(maxsize=256)
def binomial(exponent: int, sign: int = 1) -> Digits:
    """Return (1 + sign x)^exponent as a polynomial in x."""
    return as_exact([sign**k * comb(exponent, k) for k in range(exponent + 1)])


def total(first: Digits, second: Digits) -> Digits:
    """Return the sum of polynomials."""
    longer, shorter = (first, second) if len(first) >= len(second) else (second, first)
    result = longer.copy()
    result[: len(shorter)] += shorter
    return result


def shifted(polynomial: Digits, by: int) -> Digits:
    """Return p(x + by)."""
    result = as_exact([0] * len(polynomial))
    for coefficient in polynomial[::-1]:
        result[1:], result[0] = result[:-1] + by * result[1:], by * result[0]
        result[0] += coefficient
    return result


def bilinear(polynomial: Digits, degree: int) -> Digits:
    """Return (1 - w)^degree p(z) as a polynomial in w, with z = (1 + w)/(1 - w). On the unit circle, w is imaginary."""
    return np.asarray(_bilinear(degree)[:, : len(polynomial)] @ polynomial, dtype=object)


@lru_cache(maxsize=64)
def _bilinear(degree: int) -> Digits:
    """Return the matrix whose columns are (1 + w)^k (1 - w)^(degree - k), lowest power first."""
    row, columns = [(-1) ** i * comb(degree, i) for i in range(degree + 1)], []
    for _ in range(degree + 1):
        columns.append(row)
        # times (1 + w)/(1 - w)
        over = list(accumulate(row))[:degree]
        row = [a + b for a, b in zip([*over, 0], [0, *over], strict=True)]
    return as_exact(np.array(columns, dtype=object).T)


def from_w(polynomial: Digits) -> Digits:
    """Return (1 + z)^degree p(w) as a polynomial in z, with w = (z - 1)/(z + 1)."""
    back = bilinear(polynomial, len(polynomial) - 1)[::-1]
    return np.asarray(back * _signs(len(back))[::-1], dtype=object)


def _signs(count: int) -> Digits:
    return as_exact([(-1) ** k for k in range(count)])
