"""The wall that puts a pole pair on the unit circle, over its angle, in doubles; with slopes, and solved for.

Angles theta are told by their place ln s, s = tan^2(theta/2): both ends of the circle keep their digits. The transfer
functions are ratios of polynomials in w = j sqrt(s), exact before they are rounded (`NormalisedLoop.sampled`); above
|w| = 1 in powers of 1/w.

Source: Hulin 2017, eqs. 3.9 to 3.11 on |z| = 1, in another form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.compiled import compiled, inlined
from pipeline.loop.many_digits import Digits, as_exact, as_floats, many_digits, power, product, total
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Booleans, Floats, Integers

Arrays = tuple[Any, ...]
Complexes = NDArray[np.complex128]

ITERATIONS = 120
"""More than any bracketed Newton iteration needs: halving the widest cell to rounding takes 60."""

CONVERGED = 1e-8
"""Newton step in ln s after which the next one is below rounding."""

NARROW = 1e-15
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


@inlined
def value_of(polynomials: Floats, row: int, x: complex) -> complex:
    """Return a polynomial, lowest power first."""
    value = 0j
    for k in range(polynomials.shape[1] - 1, -1, -1):
        value = value * x + polynomials[row, k]
    return value


@inlined
def on_circle_at(polynomials: Floats, delay: int, place: float) -> tuple[complex, complex, complex, complex]:
    """Return -1/G and N at a place of the unit circle, and their slopes over it."""
    size, far = math.exp(0.5 * place), place > 0
    # ratios of polynomials of one degree; above |w| = 1 in powers of 1/w
    w, x, side = complex(0.0, size), complex(0.0, -1 / size if far else size), polynomials[1 if far else 0]
    motion, force, velocity, bottom = (
        value_of(side, 0, x),
        value_of(side, 1, x),
        value_of(side, 2, x),
        value_of(side, 3, x),
    )
    motion_slope, force_slope, velocity_slope = value_of(side, 4, x), value_of(side, 5, x), value_of(side, 6, x)
    # beyond |w| = 1 counted from theta = pi, where whole turns would take the digits
    half = -math.atan(1 / size) if far else math.atan(size)
    sign = -1.0 if far and delay % 2 == 1 else 1.0
    lever = -sign * complex(math.cos(2 * delay * half), math.sin(2 * delay * half)) / force
    turn, share = 2 * delay * w / (1 - w * w), 2 * w / (1 + w) / bottom
    inverse_slope = lever * (motion * (turn - force_slope / force) + motion_slope)
    rate_slope = share * (velocity * (1 / (1 + w) - value_of(side, 7, x) / bottom) + velocity_slope)
    return lever * motion, share * velocity, 0.5 * inverse_slope, 0.5 * rate_slope


@compiled("void(f8[:,:,::1],i8,f8[::1],c16[:,::1])")
def values_on_circle(polynomials: Floats, delay: int, place: Floats, values: Complexes) -> None:
    """Set what `on_circle_at` returns, shape (4, n)."""
    for n in range(len(place)):
        values[0, n], values[1, n], values[2, n], values[3, n] = on_circle_at(polynomials, delay, place[n])


@compiled("void(f8[:,:,::1],i8,UniTuple(f8[::1],4),Tuple((i8[::1],f8[::1])),UniTuple(f8[::1],2))")
def solve_on_circle(polynomials: Floats, delay: int, cells: Arrays, asked: Arrays, found: Arrays) -> None:
    """Set place and alpha at which beta has values within cells.

    Newton's method from an interpolation in s; a step that leaves the bracket is replaced by halving.
    """
    (lows, highs, firsts, lasts), (cell, betas), (places, alphas) = cells, asked, found
    for n in range(len(betas)):
        beta, low, high = betas[n], lows[cell[n]], highs[cell[n]]
        first, last = firsts[cell[n]], lasts[cell[n]]
        share = (beta - first) / (last - first)
        place = high + math.log(math.exp(low - high) - share * math.expm1(low - high))
        if not low < place < high:  # at an infinite end halves
            place = 0.5 * (low + high)
        for _ in range(ITERATIONS):
            inverse, rate, inverse_slope, rate_slope = on_circle_at(polynomials, delay, place)
            there = inverse.imag / rate.imag
            slope = (inverse_slope.imag - there * rate_slope.imag) / rate.imag
            miss, before = there - beta, place
            low, high = (low, before) if (miss > 0) == (last > first) else (before, high)
            place = before - miss / slope
            newton = low <= place <= high
            if not newton:
                place = 0.5 * (low + high)
            if miss == 0 or (newton and abs(place - before) <= CONVERGED) or high - low <= NARROW * abs(high):
                break
        inverse, rate, _, _ = on_circle_at(polynomials, delay, place)
        places[n], alphas[n] = place, inverse.real - beta * rate.real


def inverse_and_rate(loop: NormalisedLoop, place: Floats) -> Complexes:
    """Return -1/G and N on the unit circle, and their slopes over the place, shape (2, 2, n): [value, slope]."""
    values = np.empty((4, len(place)), np.complex128)
    values_on_circle(_rounded(loop), loop.oldest_force, np.ascontiguousarray(place), values)
    return values.reshape(2, 2, len(place))


def circle_points(loop: NormalisedLoop, place: Floats) -> CirclePoints:
    """Return the walls at places."""
    (inverse, rate), (inverse_slope, rate_slope) = inverse_and_rate(loop, place)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # at poles of beta
        beta = inverse.imag / rate.imag
        slope = (inverse_slope.imag - beta * rate_slope.imag) / rate.imag
        alpha_slope = inverse_slope.real - slope * rate.real - beta * rate_slope.real
        return CirclePoints(inverse.real - beta * rate.real, beta, alpha_slope, slope)


def solved(loop: NormalisedLoop, cells: Cells, cell: Integers, beta: Floats) -> tuple[Floats, Floats]:
    """Return the places at which beta has values within cells, and alpha there."""
    places, alphas = np.empty((2, len(beta)))
    ends = tuple(map(np.ascontiguousarray, (cells.low, cells.high, cells.beta_low, cells.beta_high)))
    asked = np.ascontiguousarray(cell), np.ascontiguousarray(beta)
    solve_on_circle(_rounded(loop), loop.oldest_force, ends, asked, (places, alphas))
    return places, alphas


def bisect(holds: Callable[[Floats], Booleans], good: Floats, bad: Floats, halvings: int = 60) -> tuple[Floats, Floats]:
    """Return the last values towards ``bad`` at which a condition holds, and the next ones, to the last bit.

    Parameters
    ----------
    holds : callable
    good, bad : float64, shape (n,)
        Where it holds, and where it does not.
    halvings : int
    """
    for _ in range(halvings):
        middle = 0.5 * (good + bad)
        fine = holds(middle)
        good, bad = np.where(fine, middle, good), np.where(fine, bad, middle)
    return good, bad


@lru_cache(maxsize=512)
def _rounded(loop: NormalisedLoop) -> Floats:
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


@lru_cache(maxsize=512)
def ends(loop: NormalisedLoop) -> Ends:
    """Return what is known of both ends."""
    with many_digits(loop.digits):
        return Ends(_start(loop), *_at_minus_one(loop), _unstable_when_stiff(loop))


def _start(loop: NormalisedLoop) -> float:
    """-1/G is -(1 + 2 delay w) motion/force and N is 2 w velocity/filter, both up to w^2."""
    g = loop.sampled
    if not g.velocity[0]:
        return float("nan")
    turn = 2 * g.delay * g.motion[0] / g.force[0] + _slope(g.motion, g.force)
    return float(-turn * g.filter[0] / (2 * g.velocity[0]))


def _at_minus_one(loop: NormalisedLoop) -> tuple[float, float, tuple[float, float]]:
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


def _unstable_when_stiff(loop: NormalisedLoop) -> int:
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


_PER_TURN = 48
"""Samples of each turn of the delayed device."""

_SPACING = 0.5
"""Places between both ends of these turns and all zeros and poles of device and filter: ln s, 9 a decade of s."""

_BEFORE, _BEYOND = 5.0, 28.0
"""Places before the first of them, an angle of a tenth; and beyond the last, a distance from pi of 1e-6 of it."""

_AROUND = np.linspace(-5, 5, 33)
"""Places around each zero and pole, in units of its distance from the circle: sinh of this."""

_BESIDE = 1e-12
"""Distance of places beside a break."""

_LONG = 16
"""Delay from which on polynomials, whose degree is the delay's, take longer."""

_CLOSE = 0.02
"""Distance of zeros of a filter from one another, or from the circle, that may be rounding of a repeated one."""

_APART = 0.05
"""Distance between the first branch and all others, relative to the width, from which on the first surely encloses."""


@dataclass(frozen=True, eq=False)
class FirstBranch:
    """The branch from alpha = -gamma at theta -> 0 to where it meets that line again; beta rises all along it.

    Parameters
    ----------
    loop : NormalisedLoop
    cells : Cells
        Between its samples; it ends in the last one.
    turn : int
        Cell in which alpha is largest.
    """

    loop: NormalisedLoop
    cells: Cells
    turn: int

    @cached_property
    def peak(self) -> float:
        """Place of the largest alpha."""
        return self._within(self.turn, lambda p: p.alpha_slope)

    @cached_property
    def end(self) -> float:
        """Place of its end."""
        return self._within(-1, lambda p: p.alpha + self.loop.gamma)

    def met(self, beta: Floats) -> tuple[Integers, Floats, Floats]:
        """Return the indices of the beta that are met, the places and alpha there."""
        inside = np.flatnonzero((beta > self.cells.beta_low[0]) & (beta < self.cells.beta_high[-1]))
        cell = np.searchsorted(self.cells.beta_high, beta[inside])
        return inside, *solved(self.loop, self.cells, cell, beta[inside])

    def _within(self, cell: int, of: Callable[[CirclePoints], Floats]) -> float:
        low, high = self.cells.low[[cell]], self.cells.high[[cell]]
        return float(bisect(lambda place: of(circle_points(self.loop, place)) > 0, low, high)[0][0])


def is_sampled(loop: NormalisedLoop) -> bool:
    """Return whether the branches of a loop are better known by samples than by their polynomials' roots.

    Beside a repeated zero of the filter on the circle, doubles know no branch.
    """
    return loop.oldest_force > _LONG and not _has_repeated_zeros(loop)


@lru_cache(maxsize=512)
def _has_repeated_zeros(loop: NormalisedLoop) -> bool:
    zeros = np.roots(loop.filter_in_z[0])
    # at both ends of the circle, where those of Butterworth filters lie, there is no branch beside them
    zeros = zeros[(np.abs(np.abs(zeros) - 1) < _CLOSE) & (np.abs(zeros.imag) > _CLOSE)]
    return bool((np.abs(zeros[:, None] - zeros) < _CLOSE).sum() > len(zeros))


def _is_smooth(loop: NormalisedLoop) -> bool:
    return len(loop.sampled.motion) <= 3 and len(loop.sampled.filter) == 1


@lru_cache(maxsize=512)
def first_branch(loop: NormalisedLoop) -> FirstBranch | None:
    """Return the first branch where it alone encloses what is stable.

    It does if beta grows along it, alpha has one maximum and returns to -gamma, all other branches, also where they
    pass alpha = -gamma, and the line of z = -1 lie outside, and the count of unstable poles inside is 0.
    """
    if not _is_smooth(loop):
        return None
    place, known = _places(loop), ends(loop)
    p = circle_points(loop, place)
    width = p.alpha + loop.gamma
    back = int(np.argmax(width <= 0))
    if width[back] > 0 or back == 0:
        return None
    end, falls = back + 1, p.alpha_slope[: back + 1] < 0
    a, b, others = p.alpha[:end], np.append(known.start, p.beta[:end]), slice(end, None)
    if (
        falls[0]
        or not falls[-1]
        or np.diff(falls).sum() != 1
        or (np.diff(b) <= 0).any()
        or (p.beta_slope[:end] <= 0).any()
    ):
        return None
    room = 1 + _APART
    limit = np.interp(p.beta[others], b[1:], a, left=-np.inf, right=-np.inf)
    outside = (width[others] <= 0) | (width[others] >= room * (limit + loop.gamma))
    # what enters between two samples enters by the line alpha = -gamma
    meets, beyond = _passings(width[back:], p.beta[back:]), _APART * (b[-1] - b[0])
    line = np.append(known.slope * b[0] - loop.gamma, a + known.slope * b[1:])
    beside = known.last > line.max() * room or known.last < line.min()
    apart = ((meets < b[0] - beyond) | (meets > b[-1] + beyond)).all()
    if not (outside.all() and apart and beside and _unstable_poles(loop, p, int(np.argmax(a))) == 0):
        return None
    edges = np.append(LOWEST, place[:end])
    return FirstBranch(loop, Cells(edges[:-1], edges[1:], b[:-1], b[1:]), int(np.argmax(falls)))


def sampled_cells(loop: NormalisedLoop, breaks: Floats, free: dict[float, float]) -> tuple[Cells, Integers]:
    """Return the cells of all branches, and unstable poles that alpha gains or loses by rising through each.

    ``breaks`` are the places, in order, at which beta is infinite; ``free`` those that are met at each beta, with the
    beta of the branch that passes there.
    """
    place = _places(loop)
    inner = np.concatenate([_zeros(loop, place, breaks, lambda p: p.beta_slope), breaks, list(free)])
    edges = np.concatenate([[LOWEST], np.sort(inner), [-LOWEST]])
    beta, start = circle_points(loop, edges).beta, ends(loop).start
    beta = np.array([free.get(float(edge), value) for edge, value in zip(edges, beta, strict=True)])
    beta[0] = beta[0] if np.isnan(start) else start
    middle = 0.5 * (np.maximum(edges[:-1], place[0]) + np.minimum(edges[1:], place[-1]))
    rises, rate = circle_points(loop, middle).beta_slope > 0, inverse_and_rate(loop, middle)[0, 1].imag
    endless, far = np.isin(edges, breaks), np.where(rises, np.inf, -np.inf)
    low, high = np.where(endless[:-1], -far, beta[:-1]), np.where(endless[1:], far, beta[1:])
    return Cells(edges[:-1], edges[1:], low, high), np.where(rises == (rate > 0), 2, -2)


def sampled_turns(loop: NormalisedLoop, levels: list[float], breaks: Floats) -> Floats:
    """Return beta where alpha has an extremum along a branch, or one of some values."""
    place = _places(loop)
    found = [_zeros(loop, place, breaks, lambda p: p.alpha_slope)]
    found += [_zeros(loop, place, breaks, partial(_above, level)) for level in levels]
    return circle_points(loop, np.concatenate(found)).beta


def _above(level: float, p: CirclePoints) -> Floats:
    return p.alpha - level


def _zeros(loop: NormalisedLoop, place: Floats, breaks: Floats, of: Callable[[CirclePoints], Floats]) -> Floats:
    place = np.unique(np.concatenate([place, breaks - _BESIDE, breaks + _BESIDE]))
    positive, part = of(circle_points(loop, place)) > 0, np.searchsorted(breaks, place)
    at = np.flatnonzero((positive[1:] != positive[:-1]) & (part[1:] == part[:-1]))
    low, high = bisect(lambda x: (of(circle_points(loop, x)) > 0) == positive[at], place[at], place[at + 1])
    return np.asarray(0.5 * (low + high))


def _places(loop: NormalisedLoop) -> Floats:
    """Return places that sample all branches, in order: on the scale of a turn, and around all zeros and poles."""
    step = np.pi / int(_PER_TURN * (loop.delay + 1))
    b, a = (np.roots(part) for part in loop.filter_in_z)
    root = np.concatenate([np.roots(as_floats(part)[::-1]) for part in (loop.sampled.motion, loop.sampled.force)])
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.concatenate([root, (b - 1) / (b + 1), (a - 1) / (a + 1)])
        middle = 2 * np.log(np.abs(root))
    root, middle = (values[np.abs(middle) < -LOWEST] for values in (root, middle))
    around = middle[:, None] + np.abs(root.real / root)[:, None] * np.sinh(_AROUND)
    turns = place_of(np.arange(step, np.pi - 0.5 * step, step))
    low, high = np.append(middle, turns[0]).min() - _BEFORE, np.append(middle, turns[-1]).max() + _BEYOND
    tails = np.append(np.arange(low, turns[0], _SPACING), np.arange(turns[-1], high, _SPACING)[1:])
    found = np.sort(np.concatenate([turns, tails, around.ravel()]))
    apart = np.append(True, np.diff(found) > 0)  # np.unique would load numpy.ma
    return np.asarray(found[apart & (found >= low) & (found <= min(high, -LOWEST))])


def _passings(width: Floats, beta: Floats) -> Floats:
    """Return beta where the width between successive points passes zero."""
    at = np.flatnonzero((width[:-1] > 0) != (width[1:] > 0))
    return np.asarray(beta[at] + width[at] / (width[at] - width[at + 1]) * (beta[at + 1] - beta[at]))


def _unstable_poles(loop: NormalisedLoop, p: CirclePoints, index: int) -> int:
    """Count the unstable poles just left of a sampled point, by crossings to its right read from the samples."""
    known, alpha, beta = ends(loop), np.append(-loop.gamma, p.alpha), np.append(ends(loop).start, p.beta)
    level = p.beta[index] * (1 - 1e-9)
    at = np.flatnonzero((beta[:-1] < level) != (beta[1:] < level))
    crossing = alpha[at] + (level - beta[at]) / (beta[at + 1] - beta[at]) * (alpha[at + 1] - alpha[at])
    point = p.alpha[index] - 1e-3 * (p.alpha[index] + loop.gamma)
    gained = 2 * int((np.sign(beta[at + 1] - beta[at]) * (crossing > point)).sum())
    line = known.last - level * known.slope
    outward = 1 if known.bend[0] + level * known.bend[1] > 0 else -1
    return known.unstable - gained - (outward if point < line < np.inf else 0)
