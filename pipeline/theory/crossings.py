"""All positive real roots of a polynomial, none missed: Descartes' rule of signs on halved intervals, in integers.

A polynomial has as many roots in (0, 1) as its transform (1 + x)^n p(1/(1 + x)) has changes of sign, or fewer by an
even number: intervals are halved until there are one or none. Roots above 1 are those of the reversed polynomial.

Source: Collins and Akritas 1976, Polynomial real root isolation using Descartes' rule of signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from functools import lru_cache
from itertools import accumulate, pairwise

import numpy as np
from numpy.polynomial.polynomial import polyder, polydiv, polyval

from pipeline.loop.many_digits import (
    Digits,
    as_exact,
    many_digits,
    power,
    product,
    total,
)
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.loop.state_space import LEAST_RATIO
from pipeline.records.trials import Floats, Integers
from pipeline.theory.circle import (
    Cells,
    ends,
    first_branch,
    is_sampled,
    sampled_cells,
    sampled_turns,
    solved,
)

_DEEPEST, _FINEST = 200, 60
"""Halvings, and of them those below the leading digit, after which roots count as one: they then differ by 1e-18."""

_MIDDLE = Decimal("0.98765432101")
"""Place that parts small roots from large ones: at it and its binary fractions lie none that filters have by design."""

_TOGETHER = Decimal("1e-13")
"""Relative distance within which two roots are one place."""

_NOISE = 20
"""Digits of the coefficients, relative to the largest, that are rounding."""

_STEPS = 200
"""More than the steps of any root."""

_BESIDE = Decimal("1e-40")
"""Share of a bracket by which its sign is looked at beside its ends."""

_FINE = Decimal("1e-18")
"""Relative width of a bracket at which a root is known: below the rounding of a double."""


def positive_roots(polynomial: Digits, digits: int) -> dict[Decimal, int]:
    """Return the positive real roots in order, to the precision of a double, and their multiplicities.

    Parameters
    ----------
    polynomial : Digits
        Coefficients, lowest power first.
    digits : int
        Digits to which the coefficients hold; the decimal context has as many.
    """
    largest = max((abs(c) for c in polynomial), default=Decimal(0))
    if largest == 0:
        return {}
    scale = Decimal(10) ** (digits - largest.adjusted())
    rounding = 10**_NOISE
    whole = [int(c * scale * _MIDDLE**k) for k, c in enumerate(polynomial)]
    whole = [w if abs(w) > rounding else 0 for w in whole]
    while whole[-1] == 0:
        whole.pop()
    while whole[0] == 0:
        whole.pop(0)
    up, down = as_exact(whole), as_exact(whole[::-1])
    roots = [(_MIDDLE * _refined(up, *place), place[2]) for place in _isolated(whole)]
    roots += [(_MIDDLE / _refined(down, *place), place[2]) for place in _isolated(whole[::-1])]
    return _joined(sorted(roots))


def _joined(roots: list[tuple[Decimal, int]]) -> dict[Decimal, int]:
    """Return roots that doubles cannot tell apart as one of their multiplicities' sum."""
    joined: list[tuple[Decimal, int]] = []
    for root, multiplicity in roots:
        if joined and root - joined[-1][0] <= _TOGETHER * root:
            root, multiplicity = joined[-1][0], multiplicity + joined.pop()[1]
        joined.append((root, multiplicity))
    return dict(joined)


def passed_roots(polynomial: Digits, digits: int) -> list[Decimal]:
    """Return the positive real roots, in order, at which a polynomial changes its sign."""
    return [root for root, multiplicity in positive_roots(polynomial, digits).items() if multiplicity % 2]


def _isolated(polynomial: list[int]) -> list[tuple[Decimal, Decimal, int]]:
    """Return intervals in (0, 1) with one root each, and its multiplicity."""
    found, degree = [], len(polynomial) - 1
    waiting = [(polynomial, 0, 0)]
    while waiting:  # ends: depth is bounded, and each halving keeps the number of changes or splits it
        p, depth, place = waiting.pop()
        changes = _changes(_shifted(p[::-1]))
        if changes == 1 or (changes and (depth == _DEEPEST or place.bit_length() > _FINEST)):
            found.append((place / Decimal(2) ** depth, (place + 1) / Decimal(2) ** depth, changes))
        elif changes:
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


def _changes(polynomial: list[int]) -> int:
    signs = [c > 0 for c in polynomial if c]
    return sum(a != b for a, b in pairwise(signs))


def _refined(polynomial: Digits, low: Decimal, high: Decimal, multiplicity: int) -> Decimal:
    """Return the root between two places: false position, halved in turn, where they differ in sign."""
    if multiplicity % 2 == 0:
        return _between(low, high)
    # an end may be a root itself, which is another one
    beside = (high - low) * _BESIDE
    at_low, at_high = (polyval(end, polynomial) for end in (low + beside, high - beside))
    for step in range(_STEPS):
        middle = (low * at_high - high * at_low) / (at_high - at_low) if step % 3 else _between(low, high)
        there = polyval(middle, polynomial)
        if (there > 0) == (at_low > 0):
            low, at_low, at_high = middle, there, at_high / 2
        else:
            high, at_high, at_low = middle, there, at_low / 2
        if high - low <= _FINE * high or there == 0:
            break
    return middle


def _between(low: Decimal, high: Decimal) -> Decimal:
    return (low * high).sqrt() if low > 0 else high / 8


_END = Decimal("1e-36")
"""Smallest s and reciprocal of the largest: angles of 2e-18."""

_SHARPENINGS = 5
"""Newton's steps from the digits of a double to many: each doubles them."""

_POLISHINGS = 2

_FARTHEST = Decimal("1e-4")
"""Change of s that polishing may come to; where beta touches its value the slope is none."""

_NEXT = 1 + Decimal("1e-20")
"""Factor to a place beside another, to see whether beta rises."""


_NO_WALL = 1e-8
"""Largest alpha and beta that the least loss of a mode may keep stable, however light its near side; far below those of
any wall."""


@dataclass(frozen=True, eq=False)
class Branches:
    """Cells of a loop's crossings, and unstable poles that alpha gains (2) or loses (-2) by rising through each."""

    cells: Cells
    turn: Integers


@dataclass(frozen=True, eq=False)
class Lines:
    """Walls alpha - beta slope with poles at one place of the circle, shape (n,): nan for z = -1.

    There alpha gains ``turn`` unstable poles by rising where bend[0] + beta bend[1] > 0, and loses as many elsewhere;
    none where the pole only touches the circle.
    """

    alpha: Floats
    slope: Floats
    bend: Floats
    turn: Integers
    place: Floats


@dataclass(frozen=True, eq=False)
class OnCircle:
    """alpha + beta N = -1/G on the unit circle, over s; polynomials in s, as Decimal.

    beta = -twist/((1 + s)^delay turn), turn = rate size, alpha = -stretch/((1 + s)^delay size) - beta level/filter,
    which is rise/((1 + s)^delay turn). ``free`` are the s at which N and -1/G both are real, so that each beta has a
    crossing there, as often as both are; the polynomials are without these roots.
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


@lru_cache(maxsize=64)
def on_circle(loop: NormalisedLoop) -> OnCircle:
    """Return a loop's condition on the unit circle."""
    g = loop.sampled
    with many_digits(loop.digits):
        one_more, two_w = as_exact([1, 1]), as_exact([0, 2])
        inverse = product(power(one_more, 2 * g.delay), g.motion, _mirrored(g.force))
        top, bottom = product(two_w, g.velocity), product(one_more, g.filter)
        rate = product(top, _mirrored(bottom))
        size, square = _even(product(g.force, _mirrored(g.force))), _even(product(bottom, _mirrored(bottom)))
        stretch, level = _even(inverse), _even(rate)
        free, inverse, rate = _without_shared(_odd(inverse), _odd(rate), loop.digits)
        rise = total(product(inverse, level), -product(stretch, rate))
        twist, turn = product(inverse, square), product(rate, size)
        return OnCircle(free, g.delay, twist, rate, turn, rise, stretch, size, level, square)


def _without_shared(first: Digits, second: Digits, digits: int) -> tuple[list[Decimal], Digits, Digits]:
    """Return the positive roots that two polynomials share, as often as they do, and both without them."""
    shared = []
    for root, multiplicity in positive_roots(second, digits).items():
        simple = second
        for _ in range(multiplicity - 1):
            simple = polyder(simple)
        for _ in range(_SHARPENINGS):
            root -= polyval(root, simple) / polyval(root, polyder(simple))
        for _ in range(multiplicity):
            if abs(polyval(root, first)) > polyval(root, np.abs(first)) * Decimal(10) ** (-digits // 2):
                break
            shared.append(root)
            first, second = (polydiv(part, as_exact([-root, 1]))[0] for part in (first, second))
    return shared, first, second


@lru_cache(maxsize=64)
def branches(loop: NormalisedLoop) -> Branches:
    """Return what is known of a loop's crossings once."""
    return sampled_branches(loop) if is_sampled(loop) else exact_branches(loop)


def sampled_branches(loop: NormalisedLoop) -> Branches:
    """Return them by samples, of a loop whose polynomials are long."""
    c = on_circle(loop)
    with many_digits(loop.digits):
        free = {float(root.ln()): float(_beta(c, root)) for root in _beside(c.free, _poles(loop))}
    return Branches(*sampled_cells(loop, _breaks(loop), free))


@lru_cache(maxsize=64)
def _poles(loop: NormalisedLoop) -> dict[Decimal, int]:
    """Return the places s at which beta is infinite, in order, and their multiplicities."""
    with many_digits(loop.digits):
        return positive_roots(on_circle(loop).rate, loop.digits)


def _breaks(loop: NormalisedLoop) -> Floats:
    with many_digits(loop.digits):
        return np.array([float(root.ln()) for root in _poles(loop)])


def _beside(roots: list[Decimal], poles: dict[Decimal, int]) -> list[Decimal]:
    """Return the roots that are no poles, each once."""
    return [root for root in dict.fromkeys(roots) if all(abs(root - p) > _TOGETHER * p for p in poles)]


@lru_cache(maxsize=64)
def _lines(loop: NormalisedLoop) -> Lines:
    """Return the lines of a loop: at z = -1, and where N and -1/G are both real."""
    known, c = ends(loop), on_circle(loop)
    with many_digits(loop.digits):
        free = list(dict.fromkeys(c.free))
        place = np.array([float(root.ln()) for root in free])
        none = [float(_exact_alpha(c, root, Decimal(0))) for root in free]
        slope = [float(polyval(root, c.level) / polyval(root, c.filter)) for root in free]
        bend = [[float(side * part) for part in _pull(c, root)] for root in free for side in [_side(c, root)]]
    return Lines(
        alpha=np.append(known.last, none),
        slope=np.append(known.slope, slope),
        bend=np.array([known.bend, *bend]).T,
        turn=np.append(1, [2 * (c.free.count(root) % 2) for root in free]).astype(np.intp),
        place=np.append(np.nan, place),
    )


def exact_branches(loop: NormalisedLoop) -> Branches:
    """Return them by real roots, of any loop."""
    c = on_circle(loop)
    with many_digits(loop.digits):
        turning, poles = passed_roots(_bend(c, c.twist), loop.digits), _poles(loop)
        inner: dict[Decimal, Decimal | None] = {s: _beta(c, s) for s in _beside([*turning, *c.free], poles)}
        inner |= dict.fromkeys(poles)
        edges = [_END, *sorted(root for root in inner if _END < root < 1 / _END), 1 / _END]
        values = [inner[s] if s in inner else _beta(c, s) for s in edges]
        low, high, turns = [], [], []
        for (s, start), (t, end) in pairwise(zip(edges, values, strict=True)):
            middle = (s * t).sqrt()
            rises = _beta(c, middle * _NEXT) > _beta(c, middle)
            # beta is infinite where it has no value: at its poles
            low.append(start if start is not None else Decimal("-Infinity" if rises else "Infinity"))
            high.append(end if end is not None else Decimal("Infinity" if rises else "-Infinity"))
            turns.append(2 if rises == (_side(c, middle) * polyval(middle, c.rate) > 0) else -2)
        logs, at_low, at_high = (np.array([float(v) for v in row]) for row in ([s.ln() for s in edges], low, high))
        return Branches(Cells(logs[:-1], logs[1:], at_low, at_high), np.array(turns))


@lru_cache(maxsize=64)
def turning_dampings(loop: NormalisedLoop) -> Floats:
    """Return every beta, in order, at which stable stretches may begin or end, join, or their ends have an extremum.

    Between two of these each end of a stretch is monotone in beta, and soft walls (alpha -> 0 or -gamma) are all stable
    or all not: along the branches alpha or beta turns there, or alpha passes 0 or -gamma. What is left are corners,
    where two branches cross.
    """
    cells, lines, levels = branches(loop).cells, _lines(loop), sorted({0.0, -loop.gamma})
    dampings = sampled_turns(loop, levels, _breaks(loop)) if is_sampled(loop) else _exact_turns(loop, levels)
    with np.errstate(divide="ignore", invalid="ignore"):
        passing = [(lines.alpha - level) / lines.slope for level in levels]
    found = np.concatenate([dampings, cells.beta_low, cells.beta_high, *passing])
    return np.unique(found[np.isfinite(found)])


def _exact_turns(loop: NormalisedLoop, levels: list[float]) -> Floats:
    c = on_circle(loop)
    with many_digits(loop.digits):
        whole = product(power(as_exact([1, 1]), c.delay), c.turn)
        passing = [total(c.rise, -Decimal(level) * whole) for level in levels]
        roots = [root for part in (_bend(c, c.rise), *passing) for root in passed_roots(part, loop.digits)]
        beside = _beside(roots, _poles(loop))
        return np.array([float(_beta(c, root)) for root in beside if polyval(root, c.turn) != 0])


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


def stretches(loop: NormalisedLoop, beta: Floats) -> Stretches:
    """Return the stable intervals of alpha above -gamma at each beta, upwards; ends to some 11 digits.

    Parameters
    ----------
    loop : NormalisedLoop
    beta : float64, shape (n,)
    """
    first = first_branch(loop)
    if first is not None:
        index, place, high = first.met(beta)
        on = np.flatnonzero(high > -loop.gamma)
        low, unknown = np.full(len(on), -loop.gamma), np.full(len(on), np.nan)
        return Stretches(index[on], low, high[on], unknown, place[on], np.zeros(len(on), np.intp))
    return counted_stretches(loop, branches(loop), beta)


def counted_stretches(loop: NormalisedLoop, b: Branches, beta: Floats) -> Stretches:
    """Return the same by counting the unstable poles over all crossings, downwards from an endlessly stiff wall."""
    lines, everyone = _lines(loop), np.arange(len(beta))
    below_low, below_high = (side[None, :] < beta[:, None] for side in (b.cells.beta_low, b.cells.beta_high))
    which, cell = np.nonzero(below_low != below_high)
    place, crossed = solved(loop, b.cells, cell, beta[which])
    on, line = (grid.ravel() for grid in np.meshgrid(everyone, np.arange(len(lines.alpha)), indexing="ij"))
    outward = np.where(lines.bend[0, line] + beta[on] * lines.bend[1, line] > 0, 1, -1)
    none = np.zeros(len(beta), np.intp)
    i = np.concatenate([which, on, everyone])
    level = lines.alpha[line] - beta[on] * lines.slope[line]
    a = np.concatenate([crossed, level, np.full(len(beta), -loop.gamma)])
    jump = np.concatenate([b.turn[cell], lines.turn[line] * outward, none])
    at = np.concatenate([place, lines.place[line], np.full(len(beta), np.nan)])
    source = np.concatenate([cell + 1 + len(lines.alpha), line + 1, none])
    kept = np.isfinite(a) & (a >= -loop.gamma)
    order = np.flatnonzero(kept)[np.lexsort((a[kept], i[kept]))]
    a, i, jump, at, source = a[order], i[order], jump[order], at[order], source[order]
    total_jump = np.cumsum(jump)
    last = np.searchsorted(i, everyone, side="right") - 1
    above = ends(loop).unstable - (total_jump[last][i] - total_jump)
    if _has_no_loss(loop):  # what the least loss of a mode keeps stable is none
        a = np.where((a > 0) & (a < _NO_WALL) & (np.abs(beta[i]) < _NO_WALL), 0.0, a)
    stable = np.flatnonzero((above[:-1] == 0) & (i[1:] == i[:-1]) & (a[1:] > a[:-1]))
    outline = source[stable] * (len(b.turn) + 1 + len(lines.alpha)) + source[stable + 1]
    return Stretches(i[stable], a[stable], a[stable + 1], at[stable], at[stable + 1], outline)


def _has_no_loss(loop: NormalisedLoop) -> bool:
    """Return whether nothing damps a loop's mode but the wall."""
    plant = loop.plant
    return plant.has_mode and loop.delta == 0 and plant.spring_damping <= 2 * LEAST_RATIO * plant.spring**0.5


def polished(loop: NormalisedLoop, beta: Floats, place: Floats) -> Floats:
    """Return alpha of crossings at ln s near ``place``, shape (n,), to the last digit or two of a double."""
    c, result, lines = on_circle(loop), [], set(_lines(loop).place)
    with many_digits(loop.digits):
        twist, turn = polyder(c.twist), polyder(c.turn)
        for b, start in zip(as_exact(beta), place, strict=True):
            first = s = Decimal(float(np.exp(start)))
            for _ in range(0 if start in lines else _POLISHINGS):
                # of twist + beta (1 + s)^delay turn
                pull, lever = b * (1 + s) ** c.delay, polyval(s, c.turn)
                slope = polyval(s, twist) + pull * (polyval(s, turn) + c.delay * lever / (1 + s))
                s -= (polyval(s, c.twist) + pull * lever) / slope
            touches = abs(s - first) > _FARTHEST * first
            result.append(_exact_alpha(c, first if touches else s, b))
    return np.array([float(a) for a in result])


def _bend(c: OnCircle, over: Digits) -> Digits:
    """Return the slope of over/((1 + s)^delay turn) without its positive factors."""
    plain = total(product(polyder(over), c.turn), -product(over, polyder(c.turn)))
    return total(product(as_exact([1, 1]), plain), -c.delay * product(over, c.turn))


def _beta(c: OnCircle, s: Decimal) -> Decimal:
    return Decimal(-polyval(s, c.twist) / ((1 + s) ** c.delay * polyval(s, c.turn)))


def _pull(c: OnCircle, s: Decimal) -> Digits:
    """Return the imaginary parts of -1/G and -N without their shared roots and a positive factor."""
    return np.array([-polyval(s, c.twist) / (1 + s) ** c.delay, -polyval(s, c.turn)])


def _side(c: OnCircle, s: Decimal) -> int:
    """Return the sign of the product of (s - root) over all shared roots but s."""
    return -1 if sum(root > s for root in c.free) % 2 else 1


def _exact_alpha(c: OnCircle, s: Decimal, beta: Decimal) -> Decimal:
    stretch = polyval(s, c.stretch) / ((1 + s) ** c.delay * polyval(s, c.size))
    return Decimal(-stretch - beta * polyval(s, c.level) / polyval(s, c.filter))


def _mirrored(polynomial: Digits) -> Digits:
    """Return p(-w): the conjugate on the imaginary axis."""
    return np.asarray(polynomial * as_exact([(-1) ** k for k in range(len(polynomial))]), dtype=object)


def _even(polynomial: Digits) -> Digits:
    """Return the real part on w = j sqrt(s), as a polynomial in s."""
    return _mirrored(polynomial[::2])


def _odd(polynomial: Digits) -> Digits:
    """Return the imaginary part on w = j sqrt(s) over sqrt(s), as a polynomial in s."""
    return _mirrored(polynomial[1::2])
