"""Find all walls with a pole on the unit circle. This is the only root search of the theory.

On the circle z = exp(j theta), a wall with alpha + beta N = -1/G has real alpha and beta. These are two equations,
whose solutions are ratios of polynomials in s = tan^2(theta/2). All changes along the crossings of a loop are positive
roots of such polynomials. At these points, beta has an extremum or is infinite, or alpha has an extremum or passes a
level. `positive_roots` isolates the roots by Descartes' rule of signs on halved intervals, in doubles with bounded
rounding errors. If doubles cannot decide an interval, exact integers are used, so that no root is missed. Between the
roots, every branch is monotone in beta. The order of the roots determines how a branch changes the number of unstable
poles.

The place of a crossing is x = ln s, so that both ends of the circle have full precision. Values on the circle are
computed from polynomials in w = j sqrt(s), or in 1/w for |w| > 1. They are exact before they are rounded
(`NormalisedLoop.sampled`).

Sources: Hulin 2017, eqs. 3.9 to 3.11 on |z| = 1, in another form. Collins and Akritas 1976, Polynomial real root
isolation using Descartes' rule of signs. Lane and Riesenfeld 1981, for the Bernstein basis.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise, zip_longest
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polydiv
from numpy.typing import NDArray

from pipeline.base.compiled import compiled, inlined
from pipeline.loop.many_digits import (
    Digits,
    as_exact,
    as_floats,
    binomial,
    derivative,
    many_digits,
    product,
    total,
    value_at,
)
from pipeline.loop.normalised_loop import NormalisedLoop, Sampled
from pipeline.loop.state_space import LEAST_RATIO
from pipeline.records.trials import Booleans, Floats, Integers

Arrays = tuple[Any, ...]
Complexes = NDArray[np.complex128]

EPSILON = 2.0**-52
"""Rounding error of a double."""

FLOOR = 1e-300
"""Threshold for the absolute value of a coefficient. Below it, the coefficient is unknown, because doubles lose digits
there."""

DEEPEST, NARROWEST = 160, 44
"""Largest number of halvings of an interval in doubles, first in total and then below the leading digit of its
position."""

ENCLOSED = 1e-9
"""Relative distance from a root, on both sides, at which doubles must determine the sign."""

_ENCLOSED = Decimal(ENCLOSED)

MAX_STEPS = 200
"""Largest number of steps to a root or a crossing. Bisection down to rounding takes 60 steps."""

_EXACT_HALVINGS = 200, 60
"""Largest number of halvings of an interval in integers, as above. Roots that are then not separated differ by 1e-18
and count as one root."""

_MIDDLE = Decimal("0.98765432101")
"""Value that separates small from large roots. Neither this value nor its binary fractions are roots of usual
filters."""

_TOGETHER = 1e-13
"""Relative distance within which roots are treated as equal."""

_NOISE_DIGITS = 20
"""Number of digits of the coefficients that are rounding errors. They are counted relative to the largest
coefficient."""


# --- roots of a polynomial -------------------------------------------------------------------------------------------


@inlined
def sign_changes(node: Floats) -> tuple[int, int]:
    """Return the smallest and the largest number of sign changes of uncertain coefficients, at most 2 and 3."""
    least, unknown, before, open_run = 0, 0, 0.0, 0
    for k in range(node.shape[1]):
        if abs(node[0, k]) <= node[1, k]:
            open_run += 1
            continue
        sign = 1.0 if node[0, k] > 0 else -1.0
        if before == 0:
            unknown += open_run
        elif sign != before:
            least += 1
            unknown += open_run > 1
        else:
            unknown += open_run
        before, open_run = sign, 0
        if least > 1:
            return 2, 3
    if before == 0:
        return 0, -1
    return least, least + unknown + open_run


@inlined
def value_in(node: Floats, share: float) -> tuple[float, float]:
    """Return the value of a Bernstein polynomial at a share of its interval, and a bound of the error."""
    n, rest, chances, reach = node.shape[1] - 1, 1.0 - share, 1.0, 1.0
    if n == 0:
        return node[0, 0], node[1, 0]
    rounding = (6 * n + 6) * EPSILON
    value, error = node[0, 0] * rest, (node[1, 0] + rounding * abs(node[0, 0])) * rest
    for k in range(1, n):
        reach *= share
        chances *= (n - k + 1) / k
        weight = reach * chances
        value = (value + weight * node[0, k]) * rest
        error = (error + weight * (node[1, k] + rounding * abs(node[0, k]))) * rest
    reach *= share
    return value + reach * node[0, n], error + reach * (node[1, n] + rounding * abs(node[0, n]))


@inlined
def enclosed_root(node: Floats, low: float, width: float) -> float:
    """Return the only root of a node, or -1 if doubles do not locate it within `ENCLOSED`."""
    n = node.shape[1] - 1
    left, right, first, last = 0.0, 1.0, node[0, 0], node[0, n]
    upward, middle = last > 0, 0.5
    for step in range(MAX_STEPS):
        middle = left + (right - left) * first / (first - last) if step % 3 else 0.5 * (left + right)
        value, _ = value_in(node, middle)
        if value == 0 or (right - left) * width <= EPSILON * low:
            break
        if (value > 0) == upward:
            right, last, first = middle, value, 0.5 * first
        else:
            left, first, last = middle, value, 0.5 * last
    root = low + middle * width
    aside = ENCLOSED * root / width
    before, error_before = value_in(node, max(middle - aside, 0.0))
    after, error_after = value_in(node, min(middle + aside, 1.0))
    known = abs(before) > error_before and abs(after) > error_after and (before > 0) != (after > 0)
    return root if known else -1.0


@compiled("void(f8[:,:,::1],f8[:,::1],f8[::1],i8[::1])")
def isolate(stack: Floats, places: Floats, roots: Floats, count: Integers) -> None:
    """Find all roots of a polynomial in (0, 1) in sorted order. The count is -1 if doubles cannot decide.

    Parameters
    ----------
    stack : float64, shape (depth, 2, n + 1)
        Nodes, which are Bernstein coefficients over an interval, and bounds of their errors. The first node is an
        input.
    places : float64, shape (depth, 2)
        Lower end and width of each interval. The first interval is an input.
    roots, count : float64, shape (n + 1,); int, shape (1,)
        Output: the roots and their number.
    """
    n, top = stack.shape[2] - 1, 1
    count[0] = 0
    while top > 0:
        top -= 1
        node, low, width = stack[top], places[top, 0], places[top, 1]
        least, most = sign_changes(node)
        if most == 0:
            continue
        if most < 0 or top + 2 > len(stack) or (low > 0 and width * 2.0**NARROWEST < low):
            count[0] = -1
            return
        if least == 1 and most == 1 and low > 0:
            root = enclosed_root(node, low, width)
            if root < 0:
                count[0] = -1
                return
            roots[count[0]] = root
            count[0] += 1
            continue
        if least > 0 and width < 2.0**-DEEPEST:
            count[0] = -1
            return
        # de Casteljau's algorithm: the node becomes the right half, and the next node the left half
        left = stack[top + 1]
        for part in range(2):
            left[part, 0] = node[part, 0]
        for level in range(1, n + 1):
            for k in range(n - level + 1):
                node[0, k] = 0.5 * (node[0, k] + node[0, k + 1])
                node[1, k] = 0.5 * (node[1, k] + node[1, k + 1]) + EPSILON * abs(node[0, k]) + FLOOR
            left[0, level], left[1, level] = node[0, 0], node[1, 0]
        places[top, 0], places[top, 1] = low + 0.5 * width, 0.5 * width
        places[top + 1, 0], places[top + 1, 1] = low, 0.5 * width
        top += 2


@dataclass(frozen=True, eq=False)
class Roots:
    """Sorted positive real roots to about 13 digits, multiplicities, shape (n,), and the sign before the first root."""

    value: Floats
    multiplicity: Integers
    first_sign: float

    def sign_at(self, place: float) -> float:
        """Return the sign of the polynomial at a point that is not a root."""
        return -self.first_sign if bisect_left(self.passed, place) % 2 else self.first_sign

    @cached_property
    def passed(self) -> list[float]:
        """Roots at which the polynomial changes its sign."""
        return [root for root, m in zip(self.value.tolist(), self.multiplicity.tolist(), strict=True) if m % 2]


def positive_roots(polynomial: Digits, digits: int, *, sharp: bool = True) -> Roots:
    """Return all positive real roots of a polynomial.

    Parameters
    ----------
    polynomial : Digits
        Coefficients, lowest power first.
    digits : int
        Number of known digits of the coefficients, which is also the precision of the decimal context.
    sharp : bool
        Whether roots are needed to the last digit of a double. Otherwise, they have about 11 digits.

    Notes
    -----
    Roots with a relative difference below 1e-13 are treated as one root with the sum of their multiplicities.
    """
    known = polynomial.tolist()
    largest = max(map(abs, known), default=Decimal(0))
    if largest == 0:
        return Roots(np.zeros(0), np.zeros(0, np.intp), 0.0)
    noise = largest.scaleb(_NOISE_DIGITS - digits)
    used = [k for k, c in enumerate(known) if abs(c) > noise]
    positive = {known[k] > 0 for k in used}
    sign = 1.0 if known[used[0]] > 0 else -1.0
    if len(positive) == 1:
        return Roots(np.zeros(0), np.zeros(0, np.intp), sign)
    scaled, power = [Decimal(0)] * (used[-1] + 1 - used[0]), 1 / largest
    for k in range(len(scaled)):
        if abs(known[used[0] + k]) > noise:
            scaled[k] = known[used[0] + k] * power
        power *= _MIDDLE
    middle = float(_MIDDLE)
    roots = [(middle * root, m) for root, m in _roots_below_one(scaled, digits, sharp)]
    roots += [(middle / root, m) for root, m in _roots_below_one(scaled[::-1], digits, sharp)]
    joined: list[tuple[float, int]] = []
    for root, multiplicity in sorted(roots):
        if joined and root - joined[-1][0] <= _TOGETHER * root:
            root, multiplicity = joined[-1][0], multiplicity + joined.pop()[1]
        joined.append((root, multiplicity))
    return Roots(np.array([root for root, _ in joined]), np.array([m for _, m in joined], np.intp), sign)


@lru_cache(maxsize=256)
def _bernstein(degree: int) -> Floats:
    """Return the matrix that converts coefficients, lowest power first, to the Bernstein basis of (0, 1)."""
    rows = [[math.comb(k, j) / math.comb(degree, j) for j in range(degree + 1)] for k in range(degree + 1)]
    return np.array(rows)


def _roots_below_one(polynomial: list[Decimal], digits: int, sharp: bool) -> list[tuple[float, int]]:
    """Return the unsorted roots in (0, 1) and their multiplicities, computed in doubles if these suffice."""
    values, matrix = np.array([float(c) for c in polynomial]), _bernstein(len(polynomial) - 1)
    errors = (len(values) + 3) * EPSILON * (matrix @ np.abs(values)) + FLOOR
    found = _isolated(np.array([matrix @ values, errors]), 0.0, 1.0)
    if found is None:
        return _exact_roots(polynomial, digits)
    return _sharpened(polynomial, found) if sharp else [(root, 1) for root in found.tolist()]


def _isolated(node: Floats, low: float, width: float) -> Floats | None:
    """Return the simple roots of a node, or None if doubles cannot decide."""
    size = node.shape[1]
    stack, places = np.empty((DEEPEST + NARROWEST, 2, size)), np.empty((DEEPEST + NARROWEST, 2))
    roots, count = np.empty(size), np.empty(1, np.int64)
    stack[0], places[0] = node, (low, width)
    isolate(stack, places, roots, count)
    return roots[: count[0]] if count[0] >= 0 else None


def _sharpened(polynomial: list[Decimal], roots: Floats) -> list[tuple[float, int]]:
    """Refine simple roots to the last digit of a double by one Newton step with many digits."""
    result = []
    for root in map(Decimal, roots.tolist()):
        value = slope = Decimal(0)
        for c in reversed(polynomial):
            slope = slope * root + value
            value = value * root + c
        change = value / slope if slope else root
        result.append((float(root - change if abs(change) <= _ENCLOSED * root else root), 1))
    return result


def _exact_roots(polynomial: list[Decimal], digits: int) -> list[tuple[float, int]]:
    """Return the roots in (0, 1). Intervals are halved in integers until doubles can decide or roots count as equal."""
    scale, degree = Decimal(10) ** digits, len(polynomial) - 1
    whole, (deepest, finest) = [int(c * scale) for c in polynomial], _EXACT_HALVINGS
    chances, found = [math.comb(degree, k) for k in range(degree + 1)], []
    waiting = [(whole, 0, 0)]
    # the loop terminates, because the depth is bounded and each halving keeps or splits the number of sign changes
    while waiting:
        p, depth, place = waiting.pop()
        over = _shifted(p[::-1])[::-1]
        signs = [c > 0 for c in over if c]
        changes = sum(a != b for a, b in pairwise(signs))
        if not changes:
            continue
        low, width = place / Decimal(2) ** depth, Decimal(2) ** -depth
        size = max(abs(c) // chance for c, chance in zip(over, chances, strict=True)) + 1
        values = np.array([c / (size * chance) for c, chance in zip(over, chances, strict=True)])
        roots = _isolated(np.array([values, EPSILON * np.abs(values) + FLOOR]), float(low), float(width))
        if roots is not None:
            found += _sharpened([Decimal(c) for c in whole], roots)
        elif depth == deepest or place.bit_length() > finest:
            found.append((float(low + width / 2), changes))
        else:
            left = [c << (degree - k) for k, c in enumerate(p)]
            waiting += [(left, depth + 1, 2 * place), (_shifted(left), depth + 1, 2 * place + 1)]
    return found


def _shifted(polynomial: list[int]) -> list[int]:
    """Return p(x + 1)."""
    rest, result = polynomial[::-1], []
    while rest:
        rest = list(accumulate(rest))
        result.append(rest.pop())
    return result


def bisect(
    is_true: Callable[[Floats], Booleans], good: Floats, bad: Floats, halvings: int = 60
) -> tuple[Floats, Floats]:
    """Return the last values towards ``bad`` at which a condition is true, and the next values, to the last bit.

    Parameters
    ----------
    is_true : callable
    good, bad : float64, shape (n,)
        Values at which the condition is true, and values at which it is false.
    halvings : int
    """
    for _ in range(halvings):
        middle = 0.5 * (good + bad)
        fine = is_true(middle)
        good, bad = np.where(fine, middle, good), np.where(fine, bad, middle)
    return good, bad


# --- values on the circle --------------------------------------------------------------------------------------------


@inlined
def polynomial_at(polynomials: Floats, row: int, x: complex) -> complex:
    """Return the value of a polynomial, lowest power first."""
    value = 0j
    for k in range(polynomials.shape[1] - 1, -1, -1):
        value = value * x + polynomials[row, k]
    return value


@inlined
def on_circle_at(polynomials: Floats, delay: int, place: float) -> tuple[complex, complex, complex, complex]:
    """Return -1/G and N at a place of the unit circle, and their derivatives with respect to the place."""
    size, far = math.exp(0.5 * place), place > 0
    # ratios of polynomials of equal degree; in powers of 1/w for |w| > 1
    w, x, side = complex(0.0, size), complex(0.0, -1 / size if far else size), polynomials[1 if far else 0]
    motion, force, velocity, bottom = (
        polynomial_at(side, 0, x),
        polynomial_at(side, 1, x),
        polynomial_at(side, 2, x),
        polynomial_at(side, 3, x),
    )
    motion_slope, force_slope, velocity_slope = (
        polynomial_at(side, 4, x),
        polynomial_at(side, 5, x),
        polynomial_at(side, 6, x),
    )
    # for |w| > 1, the angle is relative to theta = pi, since whole turns would reduce the precision
    half = -math.atan(1 / size) if far else math.atan(size)
    sign = -1.0 if far and delay % 2 == 1 else 1.0
    lever = -sign * complex(math.cos(2 * delay * half), math.sin(2 * delay * half)) / force
    turn, share = 2 * delay * w / (1 - w * w), 2 * w / (1 + w) / bottom
    inverse_slope = lever * (motion * (turn - force_slope / force) + motion_slope)
    rate_slope = share * (velocity * (1 / (1 + w) - polynomial_at(side, 7, x) / bottom) + velocity_slope)
    return lever * motion, share * velocity, 0.5 * inverse_slope, 0.5 * rate_slope


@compiled("void(f8[:,:,::1],i8,f8[::1],c16[:,::1])")
def values_on_circle(polynomials: Floats, delay: int, place: Floats, values: Complexes) -> None:
    """Compute the values of `on_circle_at` for several places, shape (4, n)."""
    for n in range(len(place)):
        values[0, n], values[1, n], values[2, n], values[3, n] = on_circle_at(polynomials, delay, place[n])


@dataclass(frozen=True, eq=False)
class CirclePoints:
    """Walls with a pole pair on the unit circle, and their derivatives with respect to the place, shape (n,)."""

    alpha: Floats
    beta: Floats
    alpha_slope: Floats
    beta_slope: Floats


def place_of(angle: Floats) -> Floats:
    """Return the places of angles in (0, pi)."""
    return np.asarray(2 * np.log(np.tan(0.5 * angle)))


def angle_of(place: Floats) -> Floats:
    """Return the angles of places."""
    return np.asarray(2 * np.arctan(np.exp(0.5 * place)))


def inverse_and_rate(loop: NormalisedLoop, place: Floats) -> Complexes:
    """Return -1/G and N on the unit circle and their derivatives along the place, shape (2, 2, n): [value, slope]."""
    values = np.empty((4, len(place)), np.complex128)
    values_on_circle(rounded(loop.sampled), loop.oldest_force, np.ascontiguousarray(place), values)
    return values.reshape(2, 2, len(place))


def circle_points(loop: NormalisedLoop, place: Floats) -> CirclePoints:
    """Return the walls at the given places."""
    (inverse, rate), (inverse_slope, rate_slope) = inverse_and_rate(loop, place)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # at poles of beta
        beta = inverse.imag / rate.imag
        slope = (inverse_slope.imag - beta * rate_slope.imag) / rate.imag
        alpha_slope = inverse_slope.real - slope * rate.real - beta * rate_slope.real
        return CirclePoints(inverse.real - beta * rate.real, beta, alpha_slope, slope)


@lru_cache(maxsize=512)
def rounded(g: Sampled) -> Floats:
    """Return the four polynomials of a loop and w times their derivatives, in doubles, shape (2, 8, degree + 1).

    The first axis is for ascending and descending order.
    """
    result = np.zeros((2, 8, max(len(part) for part in (g.motion, g.velocity))))
    for i, part in enumerate((g.motion, g.force, g.velocity, g.filter)):
        upwards, order = as_floats(part), np.arange(len(part))
        result[:, i, : len(part)] = upwards, upwards[::-1]
        result[:, 4 + i, : len(part)] = upwards * order, (upwards * order)[::-1]
    return result


# --- the ends of the circle ------------------------------------------------------------------------------------------

_STIFF = Decimal("1e40")
"""Stiffness that is treated as infinite. 1/G is below 1e12 for a realistic device and wall."""


@dataclass(frozen=True)
class Ends:
    """Walls at both ends of the unit circle.

    Parameters
    ----------
    start : float
        beta at which the first branch leaves the line alpha = -gamma, theta -> 0.
    last, slope : float
        There is a pole at z = -1 for alpha = last - beta slope. The values are infinite without such a pole.
    bend : tuple of float
        With rising alpha, this pole leaves the circle if bend[0] + beta bend[1] > 0.
    unstable : int
        Number of unstable poles of an infinitely stiff wall.
    """

    start: float
    last: float
    slope: float
    bend: tuple[float, float]
    unstable: int


@lru_cache(maxsize=512)
def ends(loop: NormalisedLoop) -> Ends:
    """Return the walls at both ends of the circle."""
    with many_digits(loop.digits):
        return Ends(_start(loop), *_at_minus_one(loop), _unstable_when_stiff(loop))


def _start(loop: NormalisedLoop) -> float:
    """Return the start, from -1/G = -(1 + 2 delay w) motion/force and N = 2 w velocity/filter, both up to w^2."""
    g = loop.sampled
    if not g.velocity[0]:
        return float("nan")
    turn = 2 * loop.oldest_force * g.motion[0] / g.force[0] + _slope(g.motion, g.force)
    return float(-turn * g.filter[0] / (2 * g.velocity[0]))


def _at_minus_one(loop: NormalisedLoop) -> tuple[float, float, tuple[float, float]]:
    """Return value, slope and both parts of the bend of the line on which a pole is at z = -1.

    With u = 1/w, z^delay = (-1)^delay (1 + 2 delay u + ...), N = 2 velocity/((1 + u) filter), and z < -1 means u > 0.
    """
    g, delay = loop.sampled, loop.oldest_force
    motion, force, velocity, bottom = (part[::-1] for part in (g.motion, g.force, g.velocity, g.filter))
    if abs(force[0]) <= Decimal(10) ** (30 - loop.digits) * np.abs(force).max():
        return np.inf, 0.0, (1.0, 0.0)  # the device does not respond at half the sampling rate
    value_at = [-((-1) ** delay) * motion[0] / force[0], 2 * velocity[0] / bottom[0]]
    change = [
        -((-1) ** delay) * (_slope(motion, force) + 2 * delay * motion[0] / force[0]),
        2 * (_slope(velocity, bottom) - velocity[0] / bottom[0]),
    ]
    return float(value_at[0]), float(value_at[1]), (float(change[0]), -float(change[1]))


def _slope(top: Digits, bottom: Digits) -> Decimal:
    """Return the derivative of a ratio at 0."""
    if len(top) == 1:
        return Decimal(0)
    return Decimal((top[1] * bottom[0] - top[0] * bottom[1]) / bottom[0] ** 2)


def _unstable_when_stiff(loop: NormalisedLoop) -> int:
    """Return the number of unstable poles (right half plane of w) for an infinitely stiff wall without damping."""
    g, delay = loop.sampled, loop.oldest_force
    stiff = _STIFF * product(binomial(delay, -1), g.force)
    return right_half(total(product(binomial(delay), g.motion), stiff))


def right_half(polynomial: Digits) -> int:
    """Return the number of roots with a positive real part, from the sign changes of Routh's array."""
    upper, lower = polynomial[::-1][::2].tolist(), polynomial[::-1][1::2].tolist()
    first = [upper[0]]
    while lower:  # each step removes a coefficient
        first.append(lower[0])
        ratio = upper[0] / lower[0]
        rest = zip_longest(upper[1:], lower[1:], fillvalue=Decimal(0))
        upper, lower = lower, [high - ratio * low for high, low in rest]
    signs = [entry > 0 for entry in first]
    return sum(a != b for a, b in pairwise(signs))


# --- crossings of a loop ---------------------------------------------------------------------------------------------

_END = 1e-36
"""Smallest s, and reciprocal of the largest s, for angles of 2e-18 from both ends."""

_SHARPENINGS = 5
"""Number of Newton steps from double precision to many digits. Each step doubles the number of digits."""

_POLISHINGS, _FARTHEST = 2, Decimal("1e-4")
"""Number of Newton steps that refine a crossing, and their largest relative change. The slope is zero where beta
touches its value."""

NO_WALL = 1e-8
"""Largest alpha and beta that the assumed loss of a mode may stabilise, for any mass on its near side. They are far
below any real wall."""

CONVERGED, STRAIGHT, NARROW = 1e-8, 0.01, 1e-15
"""Thresholds for the Newton step in ln s and for the relative change of the slope, below which the next step is a
rounding error. The third number is the largest relative width of a bracket that is treated as rounding."""


@dataclass(frozen=True, eq=False)
class CircleCondition:
    """Condition alpha + beta N = -1/G on the unit circle, as polynomials in s of type Decimal.

    beta = -twist/((1 + s)^delay turn), with turn = rate size. alpha = -stretch/((1 + s)^delay size) - beta level/filter
    = rise/((1 + s)^delay turn). ``free`` contains the s at which both N and -1/G are real, with their multiplicity.
    Every beta has a crossing there. The polynomials do not contain these roots.
    """

    free: list[Decimal]
    delay: int
    twist: Digits
    rate: Digits
    turn: Digits
    rise: Digits
    stretch: Digits
    size: Digits
    level: Digits
    filter: Digits

    def bend(self, over: Digits) -> Digits:
        """Return the derivative of over/((1 + s)^delay turn), without its positive factors."""
        plain = total(product(derivative(over), self.turn), -product(over, derivative(self.turn)))
        return total(product(binomial(1), plain), -self.delay * product(over, self.turn))

    def beta(self, s: Decimal) -> Decimal:
        """Return beta at the point s of the curve. It is infinite at a pole of beta."""
        bottom = value_at(self.turn, s)
        return -value_at(self.twist, s) / ((1 + s) ** self.delay * bottom) if bottom else Decimal("inf")

    def alpha(self, s: Decimal, beta: Decimal) -> Decimal:
        """Return alpha at the point s of the curve, given beta at s."""
        stretch = value_at(self.stretch, s) / ((1 + s) ** self.delay * value_at(self.size, s))
        return Decimal(-stretch - beta * value_at(self.level, s) / value_at(self.filter, s))


@lru_cache(maxsize=64)
def circle_condition(loop: NormalisedLoop) -> CircleCondition:
    """Return the condition of a loop on the unit circle."""
    g, delay = loop.sampled, loop.oldest_force
    with many_digits(loop.digits):
        opposite, rate, level, size, square = _undelayed(g)
        inverse = product(binomial(2 * delay), opposite)
        stretch = _even(inverse)
        free, inverse, rate = _without_shared(_odd(inverse), rate, loop.digits)
        rise = total(product(inverse, level), -product(stretch, rate))
        twist, turn = product(inverse, square), product(rate, size)
        return CircleCondition(free, delay, twist, rate, turn, rise, stretch, size, level, square)


@lru_cache(maxsize=64)
def _undelayed(g: Sampled) -> tuple[Digits, ...]:
    """Return motion times mirrored force, both parts of N, and both squared denominators."""
    bottom = product(binomial(1), g.filter)
    rate = product(as_exact([0, 2]), g.velocity, _mirrored(bottom))
    return product(g.motion, _mirrored(g.force)), _odd(rate), _even(rate), squared(g.force), squared(bottom)


def _without_shared(first: Digits, second: Digits, digits: int) -> tuple[list[Decimal], Digits, Digits]:
    """Return the common positive roots of two polynomials, with multiplicity, and the polynomials without them."""
    shared, roots = [], positive_roots(second, digits)
    for start, multiplicity in zip(roots.value.tolist(), roots.multiplicity.tolist(), strict=True):
        root, simple = Decimal(start), second
        for _ in range(multiplicity - 1):
            simple = derivative(simple)
        for _ in range(_SHARPENINGS):
            root -= value_at(simple, root) / value_at(derivative(simple), root)
        for _ in range(multiplicity):
            if abs(value_at(first, root)) > value_at(np.abs(first), root) * Decimal(10) ** (-digits // 2):
                break
            shared.append(root)
            first, second = (polydiv(part, as_exact([-root, 1]))[0] for part in (first, second))
    return shared, first, second


def squared(polynomial: Digits) -> Digits:
    """Return the squared modulus of a polynomial in w on the circle, as a polynomial in s."""
    return _even(product(polynomial, _mirrored(polynomial)))


def _mirrored(polynomial: Digits) -> Digits:
    """Return p(-w), which is the complex conjugate on the imaginary axis."""
    result = polynomial.copy()
    result[1::2] *= -1
    return result


def _even(polynomial: Digits) -> Digits:
    """Return the real part for w = j sqrt(s), as a polynomial in s."""
    return _mirrored(polynomial[::2])


def _odd(polynomial: Digits) -> Digits:
    """Return the imaginary part for w = j sqrt(s), divided by sqrt(s), as a polynomial in s."""
    return _mirrored(polynomial[1::2])


@dataclass(frozen=True, eq=False)
class Branches:
    """All crossings of a loop.

    Parameters
    ----------
    cells : float64, shape (5, cells)
        Intervals of places with monotone beta: both ends, beta at both ends (infinite at its poles), and the change of
        the number of unstable poles (2 or -2) as alpha rises through the branch.
    lines : float64, shape (6, lines)
        Walls alpha - beta slope with poles at one place of the circle, at z = -1 first. The rows are alpha, slope,
        both parts of a bend, a number of poles, and the place (nan for z = -1). As alpha rises, this number of unstable
        poles is gained if bend_0 + beta bend_1 > 0 and lost otherwise. It is 0 if the pole only touches the circle.
    unstable : int
        Number of unstable poles of an infinitely stiff wall.
    """

    cells: Floats
    lines: Floats
    unstable: int


@lru_cache(maxsize=64)
def branches(loop: NormalisedLoop) -> Branches:
    """Return all crossings of a loop."""
    c, known, cells = circle_condition(loop), ends(loop), []
    with many_digits(loop.digits):
        poles, turning = _rate_roots(loop), positive_roots(c.bend(c.twist), loop.digits, sharp=False)
        endless, exact = poles.value.tolist(), {float(root): root for root in c.free}
        edges = _inside([*_no_poles([*turning.passed, *exact], endless), *endless])
        beta = _dampings(c, (exact.get(s) or Decimal(s) for s in (_END, *edges, 1 / _END)))
        lines = [_line(c, root) for root in dict.fromkeys(c.free)]
    if not math.isnan(known.start):
        beta[0] = known.start
    for (left, low), (right, high) in pairwise(zip((_END, *edges, 1 / _END), beta, strict=True)):
        middle = math.sqrt(left * right)
        rises = turning.sign_at(middle) < 0
        side = -1 if sum(root > middle for root in c.free) % 2 else 1
        gain = 2.0 if rises == (side * poles.sign_at(middle) > 0) else -2.0
        far = math.inf if rises else -math.inf
        ends_at = -far if left in endless else low, far if right in endless else high
        cells.append((math.log(left), math.log(right), *ends_at, gain))
    last = (known.last, known.slope, *known.bend, 1.0, math.nan)
    of_cells, of_lines = (np.ascontiguousarray(np.transpose(rows)) for rows in (cells, [last, *lines]))
    return Branches(of_cells, of_lines, known.unstable)


def _inside(roots: Iterable[float]) -> list[float]:
    """Return the sorted distinct roots between both ends of the circle."""
    return sorted({root for root in roots if _END < root < 1 / _END})


def distinct(values: Floats) -> Floats:
    """Return the sorted distinct values. (`np.unique` would load numpy's masked arrays.)"""
    ordered = np.sort(values)
    return np.asarray(ordered[np.append(True, np.diff(ordered) > 0)[: len(ordered)]])


def _no_poles(roots: Iterable[float], poles: Sequence[float]) -> list[float]:
    """Return the roots that are not poles of beta."""
    return [root for root in roots if all(abs(root - pole) > _TOGETHER * pole for pole in poles)]


@lru_cache(maxsize=64)
def _rate_roots(loop: NormalisedLoop) -> Roots:
    """Return the s at which N is real, except those at which -1/G is also real. beta is infinite there."""
    return positive_roots(circle_condition(loop).rate, loop.digits)


def _line(c: CircleCondition, root: Decimal) -> tuple[float, ...]:
    """Return a row of `Branches.lines` for a root at which both N and -1/G are real."""
    slope, side = value_at(c.level, root) / value_at(c.filter, root), -1 if sum(r > root for r in c.free) % 2 else 1
    bend = (-side * value_at(c.twist, root) / (1 + root) ** c.delay, -side * value_at(c.turn, root))
    turn = 2.0 * (c.free.count(root) % 2)
    first, *rest = map(float, bend)
    return float(c.alpha(root, Decimal(0))), float(slope), first, *rest, turn, float(root.ln())


def _dampings(c: CircleCondition, roots: Iterable[Decimal]) -> list[float]:
    """Return beta at the given s, to the last digit of a double."""
    return [float(c.beta(s)) for s in roots]


@lru_cache(maxsize=64)
def stiffness_turns(loop: NormalisedLoop) -> Floats:
    """Return the sorted s at which alpha has an extremum along a branch."""
    c = circle_condition(loop)
    with many_digits(loop.digits):
        return _passed(loop, c.bend(c.rise))


@lru_cache(maxsize=64)
def level_passings(loop: NormalisedLoop, level: float) -> Floats:
    """Return the sorted s at which alpha passes a level along a branch."""
    c = circle_condition(loop)
    with many_digits(loop.digits):
        passing = total(c.rise, -Decimal(level) * product(binomial(c.delay), c.turn)) if level else c.rise
        return _passed(loop, passing)


def _passed(loop: NormalisedLoop, polynomial: Digits) -> Floats:
    """Return the roots at which a polynomial changes its sign, without poles of beta."""
    poles = [*_rate_roots(loop).value, *positive_roots(circle_condition(loop).size, loop.digits).value]
    return np.array(_inside(_no_poles(positive_roots(polynomial, loop.digits).passed, poles)))


@lru_cache(maxsize=64)
def turning_dampings(loop: NormalisedLoop) -> Floats:
    """Return all beta at which stable intervals may begin, end, join or have extreme ends, in sorted order.

    At these beta, alpha or beta turns along a branch, or alpha passes 0 or -gamma. Between two of them, each end of an
    interval is monotone in beta, and soft walls (alpha -> 0 or -gamma) are either all stable or all unstable. Only
    corners, where two branches cross, may lie between them.
    """
    b, levels = branches(loop), sorted({0.0, -loop.gamma})
    turns = np.concatenate([stiffness_turns(loop), *(level_passings(loop, level) for level in levels)])
    (_, _, low, high, _), (alpha, slope, *_) = b.cells, b.lines
    with np.errstate(divide="ignore", invalid="ignore"), many_digits(loop.digits):
        passing = [(alpha - level) / slope for level in levels]
        found = np.concatenate([_dampings(circle_condition(loop), map(Decimal, turns.tolist())), low, high, *passing])
    return distinct(found[np.isfinite(found)])


# --- stable intervals ------------------------------------------------------------------------------------------------


@inlined
def solved(
    polynomials: Floats, delay: int, cell: tuple[float, float, float, float], beta: float, first: float
) -> tuple[float, float, float]:
    """Return the place within a cell at which beta has a given value, alpha there, and the slope of beta.

    Newton's method starts from the given place, or from an interpolation in s. If a step leaves the bracket, bisection
    replaces it.
    """
    low, high, beta_low, beta_high = cell
    share = (beta - beta_low) / (beta_high - beta_low)
    place = first
    if not low < place < high:
        place = high + math.log(math.exp(low - high) - share * math.expm1(low - high))
    if not low < place < high:  # bisection at an infinite end
        place = 0.5 * (low + high)
    alpha, slope = 0.0, 0.0
    for number in range(MAX_STEPS):
        inverse, rate, inverse_slope, rate_slope = on_circle_at(polynomials, delay, place)
        there, former = inverse.imag / rate.imag, slope
        slope = (inverse_slope.imag - there * rate_slope.imag) / rate.imag
        miss, before = there - beta, place
        low, high = (low, before) if (miss > 0) == (beta_high > beta_low) else (before, high)
        place = before - miss / slope
        newton = low <= place <= high
        if not newton:
            place = 0.5 * (low + high)
        # next to a pole of beta, the first steps are short, and each step is twice as long as the previous one
        ends = newton and abs(place - before) <= CONVERGED and abs(slope - former) <= STRAIGHT * abs(slope)
        if miss == 0 or ends or high - low <= NARROW * abs(high) or number == MAX_STEPS - 1:
            step = place - before
            alpha = inverse.real - beta * rate.real + step * (inverse_slope.real - beta * rate_slope.real)
            break
    return place, alpha, slope


@compiled("void(f8[:,:,::1],Tuple((i8,i8,f8,b1)),f8[:,::1],f8[:,::1],f8[::1],UniTuple(f8[:,::1],3),i8[::1])")
def count_intervals(
    polynomials: Floats, about: Arrays, cells: Floats, lines: Floats, betas: Floats, out: Arrays, count: Integers
) -> None:
    """Find the stable intervals of alpha at each beta by counting unstable poles, from a stiff wall downwards.

    ``about`` contains the delay, the number of unstable poles of an infinitely stiff wall, -gamma, and whether a mode
    is undamped. ``out`` contains the last solution of each cell (3, cells), events (4, cells + lines + 1), and the
    resulting intervals: index of beta, both ends, their places, and a number for the pair of branches that bound it.
    """
    delay, unstable, line, lossless = about
    known, events, intervals = out
    count[0] = 0
    for n in range(len(betas)):
        beta, number, total_gain = betas[n], 1, 0.0
        events[0, 0], events[1, 0], events[2, 0], events[3, 0] = line, 0.0, math.nan, 0.0
        for i in range(lines.shape[1] + cells.shape[1]):
            c = i - lines.shape[1]
            if c < 0:
                alpha, place = lines[0, i] - beta * lines[1, i], lines[5, i]
                gain = lines[4, i] if lines[2, i] + beta * lines[3, i] > 0 else -lines[4, i]
            else:
                if (cells[2, c] < beta) == (cells[3, c] < beta):
                    continue
                cell = (cells[0, c], cells[1, c], cells[2, c], cells[3, c])
                first = known[0, c] + (beta - known[1, c]) / known[2, c]
                place, alpha, slope = solved(polynomials, delay, cell, beta, first)
                gain = cells[4, c]
                known[0, c], known[1, c], known[2, c] = place, beta, slope
            if not (math.isfinite(alpha) and alpha >= line):
                continue
            if lossless and 0 < alpha < NO_WALL and abs(beta) < NO_WALL:
                alpha = 0.0  # ignore intervals that only the assumed loss of a mode stabilises
            at = number
            while at > 0 and events[0, at - 1] > alpha:
                for row in range(4):
                    events[row, at] = events[row, at - 1]
                at -= 1
            events[0, at], events[1, at], events[2, at], events[3, at] = alpha, gain, place, i + 1
            number, total_gain = number + 1, total_gain + gain
        above = unstable - total_gain
        for e in range(number - 1):
            above += events[1, e]
            if above == 0 and events[0, e + 1] > events[0, e]:
                row = intervals[count[0]]
                row[0], row[1], row[2], row[3], row[4] = (
                    n,
                    events[0, e],
                    events[0, e + 1],
                    events[2, e],
                    events[2, e + 1],
                )
                row[5] = events[3, e] * (lines.shape[1] + cells.shape[1] + 1) + events[3, e + 1]
                count[0] += 1


@dataclass(frozen=True, eq=False)
class StableIntervals:
    """Stable intervals of alpha, shape (n,): index of beta, ends, and places of the crossings at the ends.

    The place is nan for z = 1 and z = -1. ``bounds`` identifies the pair of branches that bound an interval.
    """

    index: Integers
    low: Floats
    high: Floats
    low_at: Floats
    high_at: Floats
    bounds: Integers


_MANY = 2500
"""Threshold for the number of crossings. Above it, a test whether the first branch alone encloses the stable region
takes less time than all crossings."""


def stable_intervals(loop: NormalisedLoop, beta: Floats) -> StableIntervals:
    """Return the stable intervals of alpha above -gamma at each beta, in ascending order, to about 11 digits.

    Parameters
    ----------
    loop : NormalisedLoop
        Its crossings are computed once, in 2 ms for a delay of 8 samples, 0.1 s for 64, and 1 s for 256.
    beta : float64, shape (n,)
        Finite dampings.
    """
    known = branches(loop)
    if len(beta) * known.cells.shape[1] > _MANY and first_branch(loop) is not None:
        # the branch is the limit of the stable walls
        known = Branches(known.cells[:, :1].copy(), known.lines[:, :0].copy(), 2)
    return _counted_intervals(loop, known, beta)


def _counted_intervals(loop: NormalisedLoop, b: Branches, beta: Floats) -> StableIntervals:
    cells = b.cells.shape[1]
    most = cells + b.lines.shape[1] + 1
    out = np.full((3, cells), np.nan), np.empty((4, most)), np.empty((len(beta) * most, 6))
    count, about = np.zeros(1, np.int64), (loop.oldest_force, b.unstable, -loop.gamma, _has_no_loss(loop))
    count_intervals(rounded(loop.sampled), about, b.cells, b.lines, np.ascontiguousarray(beta), out, count)
    index, low, high, low_at, high_at, bounds = out[2][: count[0]].T.copy()
    return StableIntervals(index.astype(np.intp), low, high, low_at, high_at, bounds.astype(np.intp))


@dataclass(frozen=True)
class FirstBranch:
    """Branch from alpha = -gamma at theta -> 0 to its next point on that line. beta rises along it.

    Parameters
    ----------
    start : float
        beta at theta -> 0.
    end : float
        Place of the end of the branch.
    """

    start: float
    end: float


_SIDES = np.array([1e-9, 0.5, 1 - 1e-9])
"""Relative positions between two dampings at which branches turn. Stable intervals are counted at these positions."""


@lru_cache(maxsize=512)
def first_branch(loop: NormalisedLoop) -> FirstBranch | None:
    """Return the first branch of a mass with damper and spring if it alone encloses the stable region, otherwise
    None."""
    b, ends = branches(loop), level_passings(loop, -loop.gamma)
    _, high, start, top, gain = b.cells[:, 0]
    plain = len(loop.sampled.motion) <= 3 and len(loop.sampled.filter) == 1
    if not (plain and start < top and gain > 0 and len(ends) and math.log(ends[0]) < high):
        return None
    with np.errstate(divide="ignore", invalid="ignore"), many_digits(loop.digits):
        passings = _dampings(circle_condition(loop), map(Decimal, ends.tolist()))
        found = np.concatenate([passings, b.cells[2], b.cells[3], (b.lines[0] + loop.gamma) / b.lines[1]])
    turning = distinct(found[np.isfinite(found)])
    nodes = (turning[:-1, None] + np.diff(turning)[:, None] * _SIDES).ravel()
    intervals = _counted_intervals(loop, b, nodes)
    alone = np.array_equal(intervals.index, np.flatnonzero((nodes > start) & (nodes < passings[0])))
    alone = alone and bool((intervals.bounds == b.lines.shape[1] + 1).all())
    return FirstBranch(float(start), math.log(ends[0])) if alone else None


def _has_no_loss(loop: NormalisedLoop) -> bool:
    """Return whether only the wall damps the mode of a loop."""
    plant = loop.plant
    return plant.has_mode and loop.delta == 0 and plant.spring_damping <= 2 * LEAST_RATIO * plant.spring**0.5


def polished(loop: NormalisedLoop, beta: Floats, place: Floats) -> Floats:
    """Return alpha of crossings near given places, shape (n,), accurate to the last one or two digits of a double."""
    c, result, lines = circle_condition(loop), [], set(branches(loop).lines[5])
    with many_digits(loop.digits):
        twist, turn = derivative(c.twist), derivative(c.turn)
        for b, start in zip(as_exact(beta), place, strict=True):
            first = s = Decimal(float(np.exp(start)))
            for _ in range(0 if start in lines else _POLISHINGS):
                # Newton's method for twist + beta (1 + s)^delay turn = 0
                pull, lever = b * (1 + s) ** c.delay, value_at(c.turn, s)
                slope = value_at(twist, s) + pull * (value_at(turn, s) + c.delay * lever / (1 + s))
                s -= (value_at(c.twist, s) + pull * lever) / slope
            touches = abs(s - first) > _FARTHEST * first
            result.append(c.alpha(first if touches else s, b))
    return np.array([float(a) for a in result])
