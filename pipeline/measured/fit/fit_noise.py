"""Whether a residual is noise, and how readings of a coarse sensor repeat."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Booleans, Floats

PORTMANTEAU_LAGS = 20
"""Lags of the portmanteau test: even, so that its chi-square tail is a finite sum; long enough for the slow
waves that a wrong model leaves, short enough for 100 rows."""


def over_rows(subscripts: str, *factors: Floats) -> Floats:
    """Return a sum by ``numpy.einsum`` whose last axis is the trials, rounded the same for one trial as for several.

    Of a single trial numpy would add the rows in another order, and a trial's fit must not depend on its company.
    """
    several = factors if factors[0].shape[-1] != 1 else tuple(np.repeat(factor, 2, axis=-1) for factor in factors)
    result: Floats = np.einsum(subscripts, *several)
    return result[..., : factors[0].shape[-1]]


def runs(readings: Floats, inside: Booleans) -> Floats:
    """Return the length of the run of equal readings around each one, shape (N, n), time along the first axis."""
    N, n = readings.shape
    row = np.broadcast_to(np.arange(N)[:, None], (N, n))
    starts = np.ones((N, n), dtype=np.bool_)
    starts[1:] = (readings[1:] != readings[:-1]) | ~inside[1:]
    first = np.maximum.accumulate(np.where(starts, row, 0), axis=0)
    ends = np.ones((N, n), dtype=np.bool_)
    ends[:-1] = starts[1:]
    last = np.minimum.accumulate(np.where(ends, row, N)[::-1], axis=0)[::-1]
    length: Floats = (last - first + 1).astype(np.float64)
    return length


def portmanteau(white: Floats, counted: Booleans, *, lags: int = PORTMANTEAU_LAGS) -> Floats:
    """Return the p-value of a test that residuals are not correlated, shape (n,); NaN for too few rows.

    Parameters
    ----------
    white : float64, shape (N, n)
        Whitened residuals.
    counted : bool, shape (N, n)
        The rows that count; they need not be neighbours.
    lags : int
        Even number of lags; at least twice as many rows are needed.

    Notes
    -----
    Sum over the lags of (sum of products)^2/(pairs sigma^4), Box and Pierce's statistic for rows that may be missing,
    against chi-square with as many degrees of freedom as lags: the few fitted parameters make it a little mild.
    """
    rows = np.flatnonzero(counted.any(axis=1))[-1:].sum() + 1
    white, counted = white[:rows], counted[:rows]
    used = np.where(counted, white, 0.0)
    ones = counted.astype(np.float64)
    count = counted.sum(axis=0)
    enough = count >= 2 * lags
    variance = over_rows("kn,kn->n", used, used) / np.maximum(count, 1)
    enough &= variance > 0
    variance = np.where(enough, variance, 1.0)
    statistic = np.zeros(white.shape[1])
    for lag in range(1, min(lags, len(white) - 1) + 1):
        pairs = over_rows("kn,kn->n", ones[lag:], ones[:-lag])
        product = over_rows("kn,kn->n", used[lag:], used[:-lag])
        statistic += product**2 / (np.maximum(pairs, 1) * variance**2)
    return np.where(enough, _chi_square_tail(statistic, lags), np.nan)


def _chi_square_tail(statistic: Floats, freedom: int) -> Floats:
    """Chance that chi-square with an even number of degrees of freedom exceeds the statistic."""
    half = 0.5 * np.minimum(statistic, 1400.0)  # exp underflows beyond
    term, total = np.ones_like(half), np.ones_like(half)
    for i in range(1, freedom // 2):
        term = term * half / i
        total = total + term
    tail: Floats = np.exp(-half) * total
    return tail
