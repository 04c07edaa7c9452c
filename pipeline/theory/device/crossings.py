"""Where poles of a general loop cross the unit circle: all of them at every damping, and what is stable between.

A pole at z = exp(j theta) asks for alpha + beta N(z) = -1/G(z): with s = tan^2(theta/2) both alpha and beta are ratios
of polynomials in s. Between the zeros of beta's slope and its poles, which are real roots of polynomials and all found
(`real_roots`), beta is monotone, so each damping is met once or not at all: no angle is sampled. A pair of poles leaves
the circle outwards with alpha where beta rises (and N turns left); real ones cross on a line, at z = -1. From
the number of unstable poles of endlessly stiff walls this counts them everywhere.

Source: Hulin 2017, sec. 3.4, in another form; counting as in `stability.region`.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from functools import lru_cache
from itertools import pairwise

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import (
    Digits,
    as_exact,
    as_floats,
    derivative,
    many_digits,
    power,
    product,
    total,
    value,
)
from pipeline.records.batch import Floats, Integers
from pipeline.theory.device.real_roots import positive_roots

_END = Decimal("1e-24")
"""Smallest s and reciprocal of the largest: angles of 2e-12."""

_STIFF = Decimal("1e25")
"""Wall that counts as endlessly stiff: 1/G is below 1e12 where device and wall are those of a machine."""

_HALVINGS = 44
"""Of a cell in log s: from 110 to 6e-12, so that one Newton step in many digits reaches a double."""

_POLISHINGS = 2

_NEXT = 1 + Decimal("1e-20")
"""Factor to a place beside another, to see whether beta rises."""


@dataclass(frozen=True, eq=False)
class Branches:
    """What is known of a loop's crossings once.

    Parameters
    ----------
    low, high : float64, shape (cells,)
        ln s at the ends of the cells in which beta is monotone.
    beta_low, beta_high : float64, shape (cells,)
        beta at these ends; infinite at its poles.
    turn : int64, shape (cells,)
        Unstable poles that alpha gains (2) or loses (-2) by rising through a crossing of the cell.
    last, last_slope, last_bend : float
        alpha at which a pole lies at z = -1 is last - beta last_slope (infinite where there is none); the pole leaves
        the circle as alpha rises where last_bend[0] + beta last_bend[1] > 0.
    unstable : int
        Number of unstable poles of an endlessly stiff wall.
    """

    low: Floats
    high: Floats
    beta_low: Floats
    beta_high: Floats
    turn: Integers
    last: float
    last_slope: float
    last_bend: tuple[float, float]
    unstable: int


@dataclass(frozen=True, eq=False)
class OnCircle:
    """alpha + beta N = -1/G on the unit circle, over s; polynomials in s, as Decimal.

    beta = -twist/((1 + s)^delay turn), turn = rate size, alpha = -stretch/((1 + s)^delay size) - beta level/filter,
    which is rise/((1 + s)^delay turn).
    """

    delay: int
    twist: Digits
    rate: Digits
    turn: Digits
    rise: Digits
    stretch: Digits
    size: Digits
    level: Digits
    filter: Digits


@lru_cache(maxsize=64)
def on_circle(loop: Loop) -> OnCircle:
    """Return a loop's condition on the unit circle."""
    g = loop.sampled
    with many_digits(loop.digits):
        one_more, two_w = as_exact([1, 1]), as_exact([0, 2])
        inverse = product(power(one_more, 2 * g.delay), g.motion, _mirrored(g.force))
        top, bottom = product(two_w, g.velocity), product(one_more, g.filter)
        rate = product(top, _mirrored(bottom))
        size, square = _even(product(g.force, _mirrored(g.force))), _even(product(bottom, _mirrored(bottom)))
        twist, turn, stretch, level = (
            product(_odd(inverse), square),
            product(_odd(rate), size),
            _even(inverse),
            _even(rate),
        )
        rise = total(product(_odd(inverse), level), -product(stretch, _odd(rate)))
        return OnCircle(g.delay, twist, _odd(rate), turn, rise, stretch, size, level, square)


@lru_cache(maxsize=64)
def branches(loop: Loop) -> Branches:
    """Return what is known of a loop's crossings once."""
    c = on_circle(loop)
    with many_digits(loop.digits):
        turning = positive_roots(_bend(c, c.twist), loop.digits)
        inner = {root: _beta(c, root) for root in turning} | dict.fromkeys(positive_roots(c.rate, loop.digits))
        edges = [_END, *sorted(root for root in inner if _END < root < 1 / _END), 1 / _END]
        values = [inner[s] if s in inner else _beta(c, s) for s in edges]
        low, high, turns = [], [], []
        for (s, start), (t, end) in pairwise(zip(edges, values, strict=True)):
            middle = (s * t).sqrt()
            rises = _beta(c, middle * _NEXT) > _beta(c, middle)
            # beta is infinite where it has no value: at its poles
            low.append(start if start is not None else Decimal("-Infinity" if rises else "Infinity"))
            high.append(end if end is not None else Decimal("Infinity" if rises else "-Infinity"))
            turns.append(2 if rises == (value(c.rate, middle) > 0) else -2)
        logs = [float(s.ln()) for s in edges]
        return Branches(
            np.array(logs[:-1]),
            np.array(logs[1:]),
            as_floats(np.array(low, dtype=object)),
            as_floats(np.array(high, dtype=object)),
            np.array(turns),
            *_at_minus_one(loop),
            _unstable_when_stiff(loop),
        )


@lru_cache(maxsize=64)
def turning_dampings(loop: Loop) -> Floats:
    """Return every beta, in order, at which stable stretches may begin or end, join, or their ends have an extremum.

    Between two of these each end of a stretch is monotone in beta, and soft walls (alpha -> 0 or -gamma) are all stable
    or all not: along the branches alpha or beta turns there, or alpha passes 0 or -gamma. What is left are corners,
    where two branches cross.
    """
    c, b = on_circle(loop), branches(loop)
    with many_digits(loop.digits):
        whole = product(power(as_exact([1, 1]), c.delay), c.turn)
        levels = [total(c.rise, Decimal(level) * whole) for level in sorted({0.0, loop.gamma})]
        roots = [root for polynomial in (_bend(c, c.rise), *levels) for root in positive_roots(polynomial, loop.digits)]
        dampings = [float(_beta(c, root)) for root in roots if value(c.turn, root) != 0]
    line = [(b.last + level) / b.last_slope for level in (0.0, loop.gamma)] if b.last_slope else []
    known = np.concatenate([dampings, b.beta_low, b.beta_high, line])
    return np.unique(known[np.isfinite(known)])


@dataclass(frozen=True, eq=False)
class Stretches:
    """Stable intervals of alpha, shape (n,): index of their beta, ends, and ln s of the crossings there.

    ln s is nan at z = 1 and z = -1. ``outline`` is a number for the pair of branches that bound an interval.
    """

    index: Integers
    low: Floats
    high: Floats
    low_at: Floats
    high_at: Floats
    outline: Integers


def stretches(loop: Loop, beta: Floats) -> Stretches:
    """Return the stable intervals of alpha above -gamma at each beta, upwards; ends to some 11 digits.

    Parameters
    ----------
    loop : Loop
    beta : float64, shape (n,)
    """
    b, everyone = branches(loop), np.arange(len(beta))
    below_low, below_high = (side[None, :] < beta[:, None] for side in (b.beta_low, b.beta_high))
    which, cell = np.nonzero(below_low != below_high)
    place = _solved(loop, b, cell, beta[which])
    alpha = _alpha(loop, place, beta[which])
    level = b.last - beta * b.last_slope
    ends = np.full(len(beta), -loop.gamma)
    outward = np.where(b.last_bend[0] + beta * b.last_bend[1] > 0, 1, -1)
    i = np.concatenate([which, everyone, everyone])
    a = np.concatenate([alpha, level, ends])
    jump = np.concatenate([b.turn[cell], outward, np.zeros(len(beta), np.intp)])
    at = np.concatenate([place, np.full(2 * len(beta), np.nan)])
    source = np.concatenate([cell + 2, np.ones(len(beta), np.intp), np.zeros(len(beta), np.intp)])
    kept = np.isfinite(a) & (a >= -loop.gamma)
    order = np.flatnonzero(kept)[np.lexsort((a[kept], i[kept]))]
    a, i, jump, at, source = a[order], i[order], jump[order], at[order], source[order]
    # counted downwards from an endlessly stiff wall: above each crossing are those that the ones above it do not gain
    total_jump = np.cumsum(jump)
    last = np.searchsorted(i, everyone, side="right") - 1
    above = b.unstable - (total_jump[last][i] - total_jump)
    stable = np.flatnonzero((above[:-1] == 0) & (i[1:] == i[:-1]) & (a[1:] > a[:-1]))
    outline = source[stable] * (len(b.low) + 2) + source[stable + 1]
    return Stretches(i[stable], a[stable], a[stable + 1], at[stable], at[stable + 1], outline)


def polished(loop: Loop, beta: Floats, place: Floats) -> Floats:
    """Return alpha of crossings at ln s near ``place``, shape (n,), to the last digit or two of a double."""
    c, result = on_circle(loop), []
    with many_digits(loop.digits):
        for b, start in zip(as_exact(beta), place, strict=True):
            condition = total(c.twist, b * product(c.turn, power(as_exact([1, 1]), c.delay)))
            slope, s = derivative(condition), Decimal(float(np.exp(start)))
            for _ in range(_POLISHINGS):
                s -= value(condition, s) / value(slope, s)
            result.append(_exact_alpha(c, s, b))
    return np.array([float(a) for a in result])


def _solved(loop: Loop, b: Branches, cell: Integers, beta: Floats) -> Floats:
    """Return ln s at which a cell meets its beta, by halving."""
    low, high = b.low[cell], b.high[cell]
    rises = b.beta_high[cell] > b.beta_low[cell]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        inverse, rate = _inverse_and_rate(loop, middle)
        further = (inverse.imag / rate.imag < beta) == rises
        low, high = np.where(further, middle, low), np.where(further, high, middle)
    return 0.5 * (low + high)


def _alpha(loop: Loop, place: Floats, beta: Floats) -> Floats:
    inverse, rate = _inverse_and_rate(loop, place)
    return np.asarray(inverse.real - beta * rate.real)


def on_circle_response(loop: Loop, angle: Floats) -> tuple[np.ndarray, np.ndarray]:
    """Return -1/G and N at angles in (0, pi), complex, shape (n,)."""
    return _inverse_and_rate(loop, 2 * np.log(np.tan(0.5 * angle)))


def _inverse_and_rate(loop: Loop, place: Floats) -> tuple[np.ndarray, np.ndarray]:
    """Return -1/G and N on the unit circle at ln s, complex, shape (n,)."""
    w = 1j * np.exp(0.5 * place)
    far = place > 0
    # ratios of polynomials of one degree; above |w| = 1 in powers of 1/w
    powers = np.vander(np.where(far, 1 / w, w), _rounded(loop).shape[2], increasing=True).T
    rising, falling = _rounded(loop) @ powers
    motion, force, velocity, bottom = np.where(far, falling, rising)
    delay = np.exp(2j * loop.oldest_force * np.arctan(w.imag))
    return -delay * motion / force, 2 * w / (1 + w) * velocity / bottom


@lru_cache(maxsize=64)
def _rounded(loop: Loop) -> Floats:
    """Return the coefficients of the four polynomials, upwards and downwards, shape (2, 4, degree + 1)."""
    g = loop.sampled
    degree = max(len(part) for part in (g.motion, g.velocity))
    upwards, downwards = np.zeros((2, 4, degree))
    for i, part in enumerate((g.motion, g.force, g.velocity, g.filter)):
        upwards[i, : len(part)] = as_floats(part)
        downwards[i, : len(part)] = as_floats(part)[::-1]
    return np.stack([upwards, downwards])


def _bend(c: OnCircle, over: Digits) -> Digits:
    """Return the slope of over/((1 + s)^delay turn) without its positive factors."""
    plain = total(product(derivative(over), c.turn), -product(over, derivative(c.turn)))
    return total(product(as_exact([1, 1]), plain), -c.delay * product(over, c.turn))


def _beta(c: OnCircle, s: Decimal) -> Decimal:
    return Decimal(-value(c.twist, s) / ((1 + s) ** c.delay * value(c.turn, s)))


def _exact_alpha(c: OnCircle, s: Decimal, beta: Decimal) -> Decimal:
    stretch = value(c.stretch, s) / ((1 + s) ** c.delay * value(c.size, s))
    return Decimal(-stretch - beta * value(c.level, s) / value(c.filter, s))


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


def _mirrored(polynomial: Digits) -> Digits:
    """Return p(-w): the conjugate on the imaginary axis."""
    return np.asarray(polynomial * as_exact([(-1) ** k for k in range(len(polynomial))]), dtype=object)


def _even(polynomial: Digits) -> Digits:
    """Return the real part on w = j sqrt(s), as a polynomial in s."""
    return _mirrored(polynomial[::2])


def _odd(polynomial: Digits) -> Digits:
    """Return the imaginary part on w = j sqrt(s) over sqrt(s), as a polynomial in s."""
    return _mirrored(polynomial[1::2])
