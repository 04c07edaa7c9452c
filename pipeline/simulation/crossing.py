"""When many motions, each a power series in time, first leave their bounds."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Booleans, Floats

STEPS = 2
"""Newton steps from the root of a parabola that are made before anything is tested: most are settled then."""

MOST_STEPS = 60
"""Steps of the search with bisection: alone it needs 53 for a double."""

ROUNDING = 2.0**-51
"""What is rounding: of a value relative to the sum of its terms' sizes, of a time relative to the span."""


def powers(time: Floats, terms: int) -> Floats:
    """Return 1, t, t^2, ... of each time, shape (n, terms)."""
    result = np.empty((len(time), terms))
    result[:, 0] = 1.0
    result[:, 1:] = time[:, None]
    return np.multiply.accumulate(result, axis=1, out=result)


def root(series: Floats) -> Floats:
    """Return where polynomials that are not negative at 0 and negative at 1 change their sign; shape (n,).

    Newton's method from the parabola through value and slope at 0 and value at 1, then, while anything is not settled,
    with a bisection wherever a step would leave the bracket.

    Parameters
    ----------
    series : float64, shape (n, terms)
        Coefficients, lowest power first.
    """
    count = series.shape[1]
    slopes, size = series[:, 1:] * np.arange(1, count), ROUNDING * np.abs(series).sum(axis=1)
    first, rate = series[:, 0], series[:, 1]
    bend = np.minimum(series.sum(axis=1), 0.0) - first - rate
    divisor = np.sqrt(np.maximum(rate * rate - 4 * bend * first, 0.0)) - rate
    time: Floats = np.divide(2 * first, divisor, out=np.zeros_like(first), where=divisor > 0)
    low, high = np.zeros_like(time), np.ones_like(time)
    for step in range(MOST_STEPS):
        terms = powers(time, count)
        found, rate = np.vecdot(series, terms), np.vecdot(slopes, terms[:, :-1])
        newton = time - np.divide(found, rate, out=np.full_like(rate, np.inf), where=rate < 0)
        if step < STEPS:
            time = np.minimum(np.maximum(newton, 0.0), 1.0)
            continue
        unsettled = (np.abs(found) > size) & (high - low > ROUNDING)
        if not unsettled.any():
            break
        inside = found >= 0
        low, high = np.where(inside, time, low), np.where(inside, high, time)
        ahead = np.where((newton > low) & (newton < high), newton, 0.5 * (low + high))
        time = np.where(unsettled, ahead, time)
    return time


def first_exit(series: Floats, low: Floats, high: Floats, span: Floats) -> tuple[Floats, Booleans, Booleans]:
    """Return when polynomials first leave their bounds within [0, span], whether they do, and whether upwards.

    One that does not leave has the span as its time. One that starts on a bound is judged by how it goes on. Within the
    span a polynomial may turn once: the span is to be short against the fastest oscillation.

    Parameters
    ----------
    series : float64, shape (n, terms)
        Coefficients, lowest power first.
    low, high, span : float64, shape (n,)
    """
    count = series.shape[1]
    scaled = series * powers(span, count)
    start, slope, end = scaled[:, 0], scaled[:, 1], scaled.sum(axis=1)
    slope_end, until = np.vecdot(scaled, np.arange(count, dtype=np.float64)), np.ones_like(span)
    turns = (slope * slope_end < 0) & outside(start + slope - slope_end, low, high)
    if turns.any():
        falling = np.sign(slope[turns])[:, None] * np.pad(scaled[turns, 1:] * np.arange(1, count), ((0, 0), (0, 1)))
        turn = root(falling)
        there = np.vecdot(scaled[turns], powers(turn, count))
        beyond = outside(there, low[turns], high[turns])
        until[turns], end[turns] = np.where(beyond, turn, 1.0), np.where(beyond, there, end[turns])
    up = (start > high) | ((start == high) & (slope > 0))
    at_once = up | (start < low) | ((start == low) & (slope < 0))
    above = np.where(at_once, up, end > high)
    exits: Booleans = at_once | above | (end < low)
    time = np.where(at_once, 0.0, span)
    search = (exits & ~at_once).nonzero()[0]
    if len(search):
        sign, share = np.where(above[search], -1.0, 1.0), until[search]
        inward = scaled[search] * (sign[:, None] * powers(share, count))
        inward[:, 0] -= sign * np.where(above, high, low)[search]
        on_edge = inward[:, 0] == 0
        if on_edge.any():
            inward[on_edge, :-1], inward[on_edge, -1] = inward[on_edge, 1:], 0.0
        time[search] *= share * root(inward)
    return time, exits, above


def outside(value: Floats, low: Floats | float, high: Floats | float) -> Booleans:
    """Return which values lie beyond a bound."""
    result: Booleans = (value < low) | (value > high)
    return result
