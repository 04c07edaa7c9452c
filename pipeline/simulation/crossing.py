"""First root of many polynomials at once: when a motion written as a power series leaves its region."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Floats

MOST_STEPS = 60
"""Steps of the search: Newton needs about six, bisection alone 53 for a double."""

TIGHT = 2.0**-53
"""Last step of the search, relative to the span."""


def powers(time: Floats, terms: int) -> Floats:
    """Return 1, t, t^2, ... of each time, shape (n, terms); sums over the last axis do not depend on n."""
    result = np.empty((len(time), terms))
    result[:, 0] = 1.0
    result[:, 1:] = time[:, None]
    return np.multiply.accumulate(result, axis=1)


def value(series: Floats, time: Floats) -> Floats:
    """Return polynomials of shape (n, terms), lowest power first, at one time each."""
    total: Floats = (series * powers(time, series.shape[1])).sum(axis=1)
    return total


def derivative(series: Floats) -> Floats:
    """Return the coefficients of the derivatives, with the same number of terms."""
    result = np.zeros_like(series)
    result[:, :-1] = series[:, 1:] * np.arange(1, series.shape[1])
    return result


def root(series: Floats, span: Floats) -> Floats:
    """Return when polynomials, not negative at 0 and negative at ``span``, change their sign; shape (n,).

    Newton's method, with a bisection wherever a step would leave the bracket.
    """
    slope = derivative(series)
    low, high = np.zeros_like(span), span.copy()
    time = 0.5 * span
    for _ in range(MOST_STEPS):
        terms = powers(time, series.shape[1])
        found, rate = (series * terms).sum(axis=1), (slope * terms).sum(axis=1)
        inside = found >= 0
        low, high = np.where(inside, time, low), np.where(inside, high, time)
        newton = time - found / np.where(rate == 0, 1.0, rate)
        ahead = np.where((rate != 0) & (newton > low) & (newton < high), newton, 0.5 * (low + high))
        ahead = np.where(found == 0, time, ahead)
        step, time = np.abs(ahead - time), ahead
        if (step <= TIGHT * span).all():
            break
    return time


def first_exit(series: Floats, span: Floats) -> Floats:
    """Return when polynomials first fall below zero within [0, span], infinity where they do not; all of shape (n,).

    One that starts at zero exactly is judged by how it goes on. Within the span a polynomial may have one minimum: the
    span is to be short against the fastest oscillation.
    """
    on_edge = series[:, 0] == 0
    ahead = np.where(on_edge[:, None], np.roll(series, -1, axis=1), series)
    ahead[on_edge, -1] = 0.0
    result = np.full(len(span), np.inf)
    result[ahead[:, 0] < 0] = 0.0
    slope = derivative(ahead)
    out = value(ahead, span) < 0
    dips = ~out & (slope[:, 0] < 0) & (value(slope, span) > 0)
    until = span.copy()
    if dips.any():
        until[dips] = root(-slope[dips], span[dips])
        out[dips] = value(ahead[dips], until[dips]) < 0
    out &= result > 0
    if out.any():
        result[out] = root(ahead[out], until[out])
    return result
