"""Matrix exponential and power series of a linear motion x' = A x, for small matrices, in plain numpy."""

from __future__ import annotations

from math import ceil, factorial, log2

import numpy as np

from pipeline.records.batch import Floats

TERMS = 18
"""Terms of the series of an exponential: 0.5^19/19! of the largest entry, 1.6e-23, is left out."""


def exponential(rate: Floats, time: float) -> Floats:
    """Return exp(A t), shape (n, n), by a power series of a halved time and repeated squaring."""
    matrix = rate * time
    halvings = max(0, ceil(log2(max(float(np.abs(matrix).sum(axis=0).max()), 2.0**-60))) + 1)
    small = matrix / 2.0**halvings
    result = term = np.eye(len(rate))
    for k in range(1, TERMS + 1):
        term = term @ small / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result


def series(rate: Floats, time: float, terms: int) -> Floats:
    """Return (A t)^k/k! for k below ``terms``, shape (terms, n, n)."""
    result = [np.eye(len(rate))]
    for k in range(1, terms):
        result.append(result[-1] @ (rate * time) / k)
    return np.stack(result)


def terms_needed(rate: Floats, time: float, most: int, left_out: float) -> int | None:
    """Return the number of terms that leave out less than a share of the motion; None where more than ``most``."""
    power = np.eye(len(rate))
    for k in range(1, most + 1):
        power = power @ (rate * time)
        if np.abs(power).sum(axis=0).max() / factorial(k) < left_out:
            return k + 1
    return None
