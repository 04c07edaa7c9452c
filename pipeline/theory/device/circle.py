"""The wall that puts a pole pair on the unit circle, over its angle, in doubles; with slopes, and solved for.

Angles theta are told by their place ln s, s = tan^2(theta/2): both ends of the circle keep their digits. The transfer
functions are ratios of polynomials in w = j sqrt(s), exact before they are rounded (`Loop.sampled`); above |w| = 1 in
powers of 1/w.

Source: Hulin 2017, eqs. 3.9 to 3.11 on |z| = 1, in another form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import as_floats
from pipeline.records.batch import Floats, Integers

_ITERATIONS = 120
"""More than any bracketed Newton iteration needs: halving the widest cell to rounding takes 60."""

_CONVERGED = 1e-8
"""Newton step in ln s after which the next one is below rounding."""

_NARROW = 1e-15
"""Width of a bracket relative to the place, below which it is rounding."""


@dataclass(frozen=True, eq=False)
class CirclePoints:
    """Walls with a pole pair on the unit circle, and their slopes over the place, shape (n,)."""

    alpha: Floats
    beta: Floats
    alpha_slope: Floats
    beta_slope: Floats


@dataclass(frozen=True, eq=False)
class Cells:
    """Stretches of places on which beta is monotone, shape (cells,): ends, and beta there, infinite at its poles."""

    low: Floats
    high: Floats
    beta_low: Floats
    beta_high: Floats


def place_of(angle: Floats) -> Floats:
    """Return the places of angles in (0, pi)."""
    return np.asarray(2 * np.log(np.tan(0.5 * angle)))


def angle_of(place: Floats) -> Floats:
    """Return the angles of places."""
    return np.asarray(2 * np.arctan(np.exp(0.5 * place)))


def inverse_and_rate(loop: Loop, place: Floats) -> NDArray[np.complex128]:
    """Return -1/G and N on the unit circle, and their slopes over the place, shape (2, 2, n): [value, slope]."""
    w = 1j * np.exp(0.5 * place)
    far = place > 0
    # ratios of polynomials of one degree; above |w| = 1 in powers of 1/w
    powers = np.vander(np.where(far, 1 / w, w), _rounded(loop).shape[2], increasing=True).T
    rising, falling = _rounded(loop) @ powers
    (motion, force, velocity, bottom), change = np.where(far, falling, rising).reshape(2, 4, -1)
    delay = loop.oldest_force
    # beyond |w| = 1 counted from theta = pi, where whole turns would take the digits
    half = np.where(far, -np.arctan(1 / w.imag), np.arctan(w.imag))
    turned = np.where(far & (delay % 2 == 1), -1.0, 1.0) * np.exp(2j * delay * half)
    lever = -turned / force
    turn = 2 * delay * w / (1 - w * w)
    inverse_slope = lever * (motion * (turn - change[1] / force) + change[0])
    share = 2 * w / (1 + w) / bottom
    rate_slope = share * (velocity * (1 / (1 + w) - change[3] / bottom) + change[2])
    return np.array([[lever * motion, share * velocity], [0.5 * inverse_slope, 0.5 * rate_slope]])


def circle_points(loop: Loop, place: Floats) -> CirclePoints:
    """Return the walls at places."""
    (inverse, rate), (inverse_slope, rate_slope) = inverse_and_rate(loop, place)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # at poles of beta
        beta = inverse.imag / rate.imag
        slope = (inverse_slope.imag - beta * rate_slope.imag) / rate.imag
        alpha_slope = inverse_slope.real - slope * rate.real - beta * rate_slope.real
        return CirclePoints(inverse.real - beta * rate.real, beta, alpha_slope, slope)


def solved(loop: Loop, cells: Cells, cell: Integers, beta: Floats) -> Floats:
    """Return the places at which beta has values within cells.

    Newton's method from an interpolation in s; a step that leaves the bracket is replaced by halving.
    """
    low, high = cells.low[cell], cells.high[cell]
    first, last = cells.beta_low[cell], cells.beta_high[cell]
    rises, active = last > first, np.arange(len(beta))
    with np.errstate(invalid="ignore"):
        place = high + np.log(np.exp(low - high) + (beta - first) / (last - first) * -np.expm1(low - high))
    place = np.where((place > low) & (place < high), place, 0.5 * (low + high))  # at an infinite end halves
    for _ in range(_ITERATIONS):
        if not len(active):
            break
        x = place[active]
        found = circle_points(loop, x)
        miss = found.beta - beta[active]
        above = (miss > 0) == rises[active]
        high[active] = np.where(above, x, high[active])
        low[active] = np.where(above, low[active], x)
        with np.errstate(divide="ignore", invalid="ignore"):
            new = x - miss / found.beta_slope
        newton = (new >= low[active]) & (new <= high[active])
        place[active] = np.where(newton, new, 0.5 * (low[active] + high[active]))
        done = (newton & (np.abs(new - x) <= _CONVERGED)) | (miss == 0)
        done |= high[active] - low[active] <= _NARROW * np.abs(high[active])
        active = active[~done]
    return place


@lru_cache(maxsize=512)
def _rounded(loop: Loop) -> Floats:
    """Return the four polynomials and w times their derivatives, upwards and downwards, shape (2, 8, degree + 1)."""
    g = loop.sampled
    result = np.zeros((2, 8, max(len(part) for part in (g.motion, g.velocity))))
    for i, part in enumerate((g.motion, g.force, g.velocity, g.filter)):
        upwards, power = as_floats(part), np.arange(len(part))
        result[:, i, : len(part)] = upwards, upwards[::-1]
        result[:, 4 + i, : len(part)] = upwards * power, (upwards * power)[::-1]
    return result
