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
from pipeline.records.batch import Floats

_SERIES = 0.1
"""Largest (d + 1) w for the power series of the boundary near w = 0, where the closed form loses w^2 relative to 1."""


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


def _checked(delay: float) -> float:
    if not (math.isfinite(delay) and 0 <= delay <= LARGEST_DELAY):
        raise ParameterError(f"delay = {delay} samples: expected 0 to {LARGEST_DELAY}.")
    return delay
