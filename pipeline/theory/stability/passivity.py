"""Passivity of the virtual wall: condition, passive region, largest passive stiffness.

The passive region depends on the device's damping alone, not on mass, stiffness or hand. It is drawn in its own
normalisation, kappa = K T/b and eta_B = B/b (Fig. 4.1); times delta these are alpha and beta (4.12). Delay factors d
may be fractional.

Source: Hulin 2017, ch. 4.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import LARGEST_DELAY, as_points
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.stability.extent import maximum_stiffness

_ITERATIONS = 60
"""Halves an interval of angles to the last bit of a double."""

_SERIES = 0.1
"""Largest (d + 1) w for the power series of the boundary near w = 0, where the closed form loses w^2 relative to 1."""


def required_damping(delay: float, stiffness: object, damping: object, angle: object) -> Floats:
    """Return the damping that the wall needs of the device at a frequency: the right side of (4.6).

    With kappa = K T and B it is (sin((d + 1/2) w) kappa + 2 sin(w/2) cos((d + 1) w) (-B)) / (2 sin(w/2)): the
    quotient of cosines without its cancellation at small w.

    Parameters
    ----------
    delay : float
        Delay factor d, 0 <= d <= 256.
    stiffness, damping : array_like
        K T and B, or normalised alpha and beta, or K T/b and B/b: the result has the unit of B.
    angle : array_like
        w = omega T, 0 <= w <= pi; the limit is taken at 0. Arrays broadcast.

    Raises
    ------
    ParameterError
        If the delay is out of range.

    Source: Hulin 2017, eq. 4.6.
    """
    d = _checked(delay)
    w = np.asarray(angle, dtype=np.float64)
    k, b = np.asarray(stiffness, dtype=np.float64), np.asarray(damping, dtype=np.float64)
    half = np.sin(0.5 * w)
    flat = half == 0
    ratio = np.where(flat, 2 * d + 1, np.sin((d + 0.5) * w) / np.where(flat, 1.0, half))
    return 0.5 * k * ratio - b * np.cos((d + 1) * w)


def boundary_angle(delay: float) -> float:
    """Return the angle omega T = pi/(d + 1) at which the boundary of the passive region ends, at K = 0 and B = b.

    Later branches of (4.8) lie outside. At d = 0 the boundary is reached at the angles 0 and pi only (4.7).
    """
    return math.pi / (_checked(delay) + 1)


def passive_boundary(delay: float, angle: object) -> tuple[Floats, Floats]:
    """Return the boundary of the passive region, K T/b and B/b (alpha/delta and beta/delta), over an angle.

    Parameters
    ----------
    delay : float
        Delay factor d.
    angle : array_like, shape (n,)
        omega T in [0, pi/(d + 1)]; 0 gives the end of the straight part (4.9), which goes on to (0, -1).

    Raises
    ------
    ParameterError
        If the delay or an angle is out of range.

    Notes
    -----
    For d = 0 all angles give the corner (2, 0) where the lines of (4.7) meet, the last one too; the region ends at
    (0, 1) and (0, -1).

    Source: Hulin 2017, eqs. 4.8 and 4.12.
    """
    d = _checked(delay)
    w, _ = as_points(angle, 0.0)
    last = boundary_angle(d)
    if ((w < 0) | (w > last * (1 + 1e-12))).any():
        raise ParameterError(f"omega T = {w.min():.6g} to {w.max():.6g}: expected 0 to pi/(d + 1) = {last:.6g}.")
    if d == 0:
        return np.full(len(w), 2.0), np.zeros(len(w))
    n = d + 1
    small = n * w < _SERIES
    x = np.where(small, last, w)
    bottom = np.sin(2 * n * x) - 2 * n * np.sin(x)
    k = -8 * n * np.sin(n * x) * np.sin(0.5 * x) ** 2 / bottom
    b = 2 * (d * np.sin(n * x) - n * np.sin(d * x)) / bottom
    # both quotients of (4.8) are 0/0 of third order at 0: sin(a w)/w in powers of w^2, after the terms that cancel
    bottom_series = _rest(2 * n, w) - 2 * n * _rest(1.0, w)
    k_series = -2 * n * n * np.sinc(n * w / np.pi) * np.sinc(0.5 * w / np.pi) ** 2 / bottom_series
    b_series = 2 * (d * _rest(n, w) - n * _rest(d, w)) / bottom_series
    return np.where(small, k_series, k), np.where(small, b_series, b)


def _rest(a: float, w: Floats) -> Floats:
    """(sin(a w) - a w)/w^3 for small a w."""
    x = (a * w) ** 2
    total = np.zeros_like(w)
    for order in range(11, 1, -2):
        total = (1 - x * total) / (order * (order - 1)) if order > 3 else -(a**3) * (1 - x * total) / 6
    return total


def passive_limits(delay: float, damping: object) -> Floats:
    """Return the largest passive K T/b at given B/b; -inf for |B/b| > 1, where nothing is passive.

    Parameters
    ----------
    delay : float
        Delay factor d.
    damping : array_like, shape (n,)
        B/b (beta/delta).

    Notes
    -----
    Below B/b = d/(2 d + 3) the limit is the line (4.10), above it lies on (4.8), whose B/b grows with the angle.

    Source: Hulin 2017, eqs. 4.7 to 4.10.
    """
    d = _checked(delay)
    b, _ = as_points(damping, 0.0)
    if d == 0:
        return np.where(np.abs(b) <= 1, 2 * (1 - np.abs(b)), -np.inf)
    low, high = np.zeros(len(b)), np.full(len(b), boundary_angle(d))
    for _ in range(_ITERATIONS):
        middle = 0.5 * (low + high)
        below = passive_boundary(d, middle)[1] < b
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    straight = (1 + b) / (0.5 + d)
    limit = np.where(b <= d / (2 * d + 3), straight, passive_boundary(d, 0.5 * (low + high))[0])
    return np.where(np.abs(b) <= 1, np.maximum(limit, 0.0), -np.inf)


def is_passive(delta: float, delay: float, alpha: object, beta: object) -> Booleans:
    """Return which walls are passive: 0 <= alpha/delta below `passive_limits` at beta/delta.

    Parameters
    ----------
    delta, delay : float
        Normalised damping of the device and delay factor.
    alpha, beta : array_like, shape (n,)
        Normalised wall.

    Source: Hulin 2017, eqs. 4.6 and 4.12.
    """
    a, b = as_points(alpha, beta)
    if not (math.isfinite(delta) and delta >= 0):
        raise ParameterError(f"delta = {delta}: expected a finite number that is not negative.")
    if delta == 0:  # (4.6) asks for more than 0
        return np.zeros(len(a), dtype=np.bool_)
    return np.asarray((a >= 0) & (a < delta * passive_limits(delay, b / delta)) & (np.abs(b) < delta))


def maximum_passive_stiffness(delays: object) -> tuple[Floats, Floats]:
    """Return the largest passive K T/b and its B/b over delay factors d, shape (n,) each.

    Source: Hulin 2017, eq. 4.11 and Fig. 4.2.
    """
    d, _ = as_points(delays, 0.0)
    for value in d:
        _checked(float(value))
    quarter = 0.25 * np.pi / (d + 1)
    # cos(pi d/(2 (d + 1))) = sin(pi/(2 (d + 1))): 4.11 becomes 2 tan
    stiffness = 2 * np.tan(quarter)
    damping = np.where(d == 0, 0.0, (np.cos(2 * quarter) - d / (d + 1)) / np.sin(2 * quarter))
    return stiffness, damping


def passive_to_stable(delays: object, gamma: float, delta: float) -> Floats:
    """Return the ratio eta of the largest passive to the largest stable stiffness over delay factors, shape (n,).

    Raises
    ------
    ParameterError
        If a parameter is out of range, or no wall is stable.

    Source: Hulin 2017, Fig. 4.4; eta = alpha_max(passive)/alpha_max(stable).
    """
    return delta * maximum_passive_stiffness(delays)[0] / maximum_stiffness(delays, gamma, delta)[0]


def _checked(delay: float) -> float:
    if not (math.isfinite(delay) and 0 <= delay <= LARGEST_DELAY):
        raise ParameterError(f"delay = {delay} samples: expected 0 to {LARGEST_DELAY}.")
    return delay
