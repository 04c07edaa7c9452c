"""The wall that puts a pole pair on the unit circle, over its angle, in doubles; with slopes, and solved for.

Angles theta are told by their place ln s, s = tan^2(theta/2): both ends of the circle keep their digits. The transfer
functions are ratios of polynomials in w = j sqrt(s), exact before they are rounded (`Loop.sampled`); above |w| = 1 in
powers of 1/w.

Source: Hulin 2017, eqs. 3.9 to 3.11 on |z| = 1, in another form.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import Digits, as_exact, as_floats, many_digits, power, product, total
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


LOWEST = -82.89306334778564
"""ln s of the smallest s, 1e-36, and minus that of the largest: angles of 2e-18."""

_STIFF = Decimal("1e40")
"""Wall that counts as endlessly stiff: 1/G is below 1e12 where device and wall are those of a machine."""


@dataclass(frozen=True)
class Ends:
    """Ends of the unit circle.

    Parameters
    ----------
    start : float
        beta at which the first branch leaves the line alpha = -gamma, theta -> 0.
    last, slope : float
        alpha at which a pole lies at z = -1 is last - beta slope; infinite where there is none.
    bend : tuple of float
        The pole leaves the circle there as alpha rises where bend[0] + beta bend[1] > 0.
    unstable : int
        Number of unstable poles of an endlessly stiff wall.
    """

    start: float
    last: float
    slope: float
    bend: tuple[float, float]
    unstable: int

    def outward(self, beta: object) -> np.ndarray:
        """Return unstable poles that alpha gains, 1 or -1, by rising through the line of z = -1 at beta."""
        return np.where(self.bend[0] + np.asarray(beta) * self.bend[1] > 0, 1, -1)


@lru_cache(maxsize=512)
def ends(loop: Loop) -> Ends:
    """Return what is known of both ends."""
    with many_digits(loop.digits):
        return Ends(_start(loop), *_at_minus_one(loop), _unstable_when_stiff(loop))


def _start(loop: Loop) -> float:
    """-1/G is -(1 + 2 delay w) motion/force and N is 2 w velocity/filter, both up to w^2."""
    g = loop.sampled
    if not g.velocity[0]:
        return float("nan")
    turn = 2 * g.delay * g.motion[0] / g.force[0] + _slope(g.motion, g.force)
    return float(-turn * g.filter[0] / (2 * g.velocity[0]))


def _at_minus_one(loop: Loop) -> tuple[float, float, tuple[float, float]]:
    """Return value, slope and the two parts of the bend of the line on which a pole lies at z = -1.

    In u = 1/w, z^delay = (-1)^delay (1 + 2 delay u + ...), N = 2 velocity/((1 + u) filter), and z < -1 is u > 0.
    """
    g = loop.sampled
    motion, force, velocity, bottom = (part[::-1] for part in (g.motion, g.force, g.velocity, g.filter))
    if abs(force[0]) <= Decimal(10) ** (30 - loop.digits) * np.abs(force).max():
        return np.inf, 0.0, (1.0, 0.0)  # the device does not answer at half the sampling rate
    value_at = [-((-1) ** g.delay) * motion[0] / force[0], 2 * velocity[0] / bottom[0]]
    change = [
        -((-1) ** g.delay) * (_slope(motion, force) + 2 * g.delay * motion[0] / force[0]),
        2 * (_slope(velocity, bottom) - velocity[0] / bottom[0]),
    ]
    return float(value_at[0]), float(value_at[1]), (float(change[0]), -float(change[1]))


def _slope(top: Digits, bottom: Digits) -> Decimal:
    """Return the derivative at 0 of a ratio."""
    if len(top) == 1:
        return Decimal(0)
    return Decimal((top[1] * bottom[0] - top[0] * bottom[1]) / bottom[0] ** 2)


def _unstable_when_stiff(loop: Loop) -> int:
    """Number of poles outside the circle, the right half of w, of an endlessly stiff wall without damping."""
    g = loop.sampled
    up, down = as_exact([1, 1]), as_exact([1, -1])
    whole = total(product(power(up, g.delay), g.motion), _STIFF * product(power(down, g.delay), g.force))
    return right_half(whole)


def right_half(polynomial: Digits) -> int:
    """Return the number of roots with positive real part: sign changes of Routh's array."""
    upper, lower = polynomial[::-1][::2], polynomial[::-1][1::2]
    first = [upper[0]]
    while len(lower):  # each step takes a coefficient away
        first.append(lower[0])
        rest = np.append(lower[1:], as_exact([0] * (len(upper) - len(lower))))
        upper, lower = lower, upper[1:] - upper[0] / lower[0] * rest
    signs = [entry > 0 for entry in first]
    return sum(a != b for a, b in pairwise(signs))
