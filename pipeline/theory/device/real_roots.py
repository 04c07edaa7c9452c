"""All positive real roots of a polynomial, none missed: Descartes' rule of signs on halved intervals, in integers.

A polynomial has as many roots in (0, 1) as its transform (1 + x)^n p(1/(1 + x)) has changes of sign, or fewer by an
even number: intervals are halved until there are one or none. Roots above 1 are those of the reversed polynomial.

Source: Collins and Akritas 1976, Polynomial real root isolation using Descartes' rule of signs.
"""

from __future__ import annotations

from decimal import Decimal
from itertools import accumulate, pairwise

from pipeline.loop.many_digits import Digits, as_exact, value

_DEEPEST = 200
"""Halvings after which two roots count as one that is touched: they then differ by 1e-60."""

_NOISE = 20
"""Digits of the coefficients, relative to the largest, that are rounding."""

_STEPS = 200
"""More than the steps of any root."""

_BESIDE = Decimal("1e-40")
"""Share of a bracket by which its sign is looked at beside its ends."""

_FINE = Decimal("1e-15")
"""Relative width of a bracket at which a root is known: below the rounding of a double."""


def positive_roots(polynomial: Digits, digits: int) -> list[Decimal]:
    """Return the positive real roots of odd multiplicity in order, to the precision of a double.

    Parameters
    ----------
    polynomial : Digits
        Coefficients, lowest power first.
    digits : int
        Digits to which the coefficients hold; the decimal context has as many.
    """
    largest = max((abs(c) for c in polynomial), default=Decimal(0))
    if largest == 0:
        return []
    scale = Decimal(10) ** (digits - largest.adjusted())
    rounding = 10**_NOISE
    whole = [w if abs(w) > rounding else 0 for w in (int(c * scale) for c in polynomial)]
    while whole[-1] == 0:
        whole.pop()
    while whole[0] == 0:
        whole.pop(0)
    up, down = as_exact(whole), as_exact(whole[::-1])
    roots = [_refined(up, *bracket) for bracket in _isolated(whole)]
    roots += [1 / _refined(down, *bracket) for bracket in _isolated(whole[::-1])]
    if sum(whole) == 0:
        roots.append(Decimal(1))
    return sorted(roots)


def _isolated(polynomial: list[int]) -> list[tuple[Decimal, Decimal]]:
    """Return intervals in (0, 1) with one root each."""
    found, degree = [], len(polynomial) - 1
    waiting = [(polynomial, 0, 0)]
    while waiting:  # ends: depth is bounded, and each halving keeps the number of changes or splits it
        p, depth, place = waiting.pop()
        changes = _changes(_shifted(p[::-1]))
        if changes == 0:
            continue
        if changes == 1:
            found.append((place / Decimal(2) ** depth, (place + 1) / Decimal(2) ** depth))
        elif depth < _DEEPEST:
            left = [c << (degree - k) for k, c in enumerate(p)]
            right = _shifted(left)
            waiting += [(left, depth + 1, 2 * place), (right, depth + 1, 2 * place + 1)]
            if right[0] == 0:
                middle = (2 * place + 1) / Decimal(2) ** (depth + 1)
                found.append((middle, middle))
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


def _refined(polynomial: Digits, low: Decimal, high: Decimal) -> Decimal:
    """Return the root between two places of different sign: false position, halved in turn."""
    if low == high:
        return low
    # an end may be a root itself, which is another one
    beside = (high - low) * _BESIDE
    at_low, at_high = (value(polynomial, end) for end in (low + beside, high - beside))
    for step in range(_STEPS):
        middle = (low * at_high - high * at_low) / (at_high - at_low) if step % 3 else _between(low, high)
        there = value(polynomial, middle)
        if (there > 0) == (at_low > 0):
            low, at_low, at_high = middle, there, at_high / 2
        else:
            high, at_high, at_low = middle, there, at_low / 2
        if high - low <= _FINE * high or there == 0:
            break
    return middle


def _between(low: Decimal, high: Decimal) -> Decimal:
    return (low * high).sqrt() if low > 0 else high / 8
