"""First root of many polynomials at once: when a motion written as a power series leaves its region."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Floats

MOST_STEPS = 60
"""Steps of the search: Newton needs about four, bisection alone 53 for a double."""

ROUNDING = 2.0**-51
"""What is rounding: of a value relative to the sum of its terms' sizes, of a step in time relative to the span."""


def powers(time: Floats, terms: int) -> Floats:
    """Return 1, t, t^2, ... of each time, shape (n, terms)."""
    result = np.empty((len(time), terms))
    result[:, 0] = 1.0
    result[:, 1:] = time[:, None]
    return np.multiply.accumulate(result, axis=1, out=result)


def derivative(series: Floats) -> Floats:
    """Return the coefficients of the derivatives, with the same number of terms."""
    result = np.zeros_like(series)
    result[:, :-1] = series[:, 1:] * np.arange(1, series.shape[1])
    return result


def root(series: Floats, slope: Floats, span: Floats, end: Floats) -> Floats:
    """Return when polynomials, not negative at 0 and negative at ``span``, change their sign; shape (n,).

    Newton's method, with a bisection wherever a step would leave the bracket.

    Parameters
    ----------
    series, slope : float64, shape (n, terms)
        Coefficients, lowest power first, and those of the derivatives.
    span, end : float64, shape (n,)
        End of the search and value there.
    """
    size = np.abs(series)
    low, high = np.zeros_like(span), span
    time = span * (series[:, 0] / (series[:, 0] - end))
    for _ in range(MOST_STEPS):
        terms = powers(time, series.shape[1])
        found, rate = np.vecdot(series, terms), np.vecdot(slope, terms)
        inside = found >= 0
        low, high = np.where(inside, time, low), np.where(inside, high, time)
        unsettled = (np.abs(found) > ROUNDING * np.vecdot(size, terms)) & (high - low > ROUNDING * span)
        if not unsettled.any():
            break
        newton = time - found / np.where(rate == 0, 1.0, rate)
        ahead = np.where((rate != 0) & (newton > low) & (newton < high), newton, 0.5 * (low + high))
        time = np.where(unsettled, ahead, time)
    return time


def first_exit(series: Floats, span: Floats) -> Floats:
    """Return when polynomials first fall below zero within [0, span], infinity where they do not; all of shape (n,).

    One that starts at zero exactly is judged by how it goes on. Within the span a polynomial may have one minimum: the
    span is to be short against the fastest oscillation.
    """
    on_edge = series[:, 0] == 0
    if on_edge.any():
        series = series.copy()
        series[on_edge, :-1], series[on_edge, -1] = series[on_edge, 1:], 0.0
    slope, terms = derivative(series), powers(span, series.shape[1])
    end, end_slope = np.vecdot(series, terms), np.vecdot(slope, terms)
    result = np.where(series[:, 0] < 0, 0.0, np.inf)
    out = end < 0
    dips = ~out & (slope[:, 0] < 0) & (end_slope > 0)
    if dips.any():
        down = -slope[dips]
        span = span.copy()
        span[dips] = root(down, derivative(down), span[dips], -end_slope[dips])
        end[dips] = np.vecdot(series[dips], powers(span[dips], series.shape[1]))
        out = end < 0
    out &= result > 0
    if out.any():
        result[out] = root(series[out], slope[out], span[out], end[out])
    return result
