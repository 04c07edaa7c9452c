"""The weighted sums of slow responses in more digits than doubles hold.

A sum over 10^k samples magnifies the rounding of the loop matrix and of its powers by as much, and again by as much as
its modes are skew: next to resonance (gamma = 9.87, d = 0.25) the last bit of alpha counts 1e-10 at a pole radius of
1 - 1e-4, and which digits are left differs between processors. So what the equations of the sums leave unmet is
computed with twice the digits, from a plant that is known to as many, and the sums are changed until they meet them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal, localcontext
from functools import lru_cache
from math import comb

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.theory.cost.twofold import add, from_decimals, multiply, twofold

Sums = tuple[Floats, Floats, Floats]
"""Three matrices a point, each of shape (n, states, states), for the weights w = 0, 1, 2."""

Rows = list[list[Decimal]]

_DIGITS = 50
"""Of the plant: 32 are used, and each squaring loses a bit; strong damping takes more and has small gains."""

_TERMS = 32
"""Of the exponential series at norms up to 1/2: what follows is below 1e-45."""

_ROUNDS = 4
"""Rounds of refinement: each squares the relative error, 1e-4 at a pole radius of 1 - 1e-12."""

_MET = 1e-9
"""Relative change after which the next would be below the last digit."""


def refined(loop: Loop, alpha: Floats, beta: Floats, signal: str, sums: Sums, solve: Callable[[Sums], Sums]) -> Sums:
    """Return weighted sums that meet their equations to the last digit of a double.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
    signal : {"step", "impulse"}
    sums : Sums
        X_0 = z z' + A X_0 A', X_1 = A (X_1 + X_0) A', X_2 = A (X_2 + 2 X_1 + X_0) A', roughly.
    solve : callable
        From what these equations leave unmet, gives the change that meets them, to some digits.
    """
    top, columns = _matrix_rows(loop, alpha, beta)
    start = loop.initial(signal)
    known = twofold(np.multiply.outer(np.ones(len(alpha)), np.outer(start, start)))
    x = [_symmetric(part) for part in sums]
    for _ in range(_ROUNDS):
        right = [_moved(top, columns, _raised(x, w)) for w in range(3)]
        right[0] = add(right[0], known)
        rest = [add(side, twofold(-part))[0] for side, part in zip(right, x, strict=True)]
        change = solve((rest[0], rest[1], rest[2]))
        x = [_symmetric(part + more) for part, more in zip(x, change, strict=True)]
        if all(np.all(_size(more) <= _MET * _size(part)) for part, more in zip(x, change, strict=True)):
            break
    return x[0], x[1], x[2]


def _size(matrices: Floats) -> Floats:
    return np.asarray(np.abs(matrices).max(axis=(1, 2)))


def _symmetric(matrices: Floats) -> Floats:
    """What rounding made skew would grow from round to round, as the equations below are those of the upper half."""
    return 0.5 * (matrices + np.swapaxes(matrices, 1, 2))


def _raised(x: list[Floats], w: int) -> Floats:
    """Sum of (k + 1)^w z_k z_k' from those of k^i z_k z_k'."""
    result = twofold(x[w])
    for i in range(w):
        result = add(result, twofold(comb(w, i) * x[i]))
    return result


def _moved(top: Floats, columns: list[int], z: Floats) -> Floats:
    """A Z A' for symmetric Z: below its first two rows, A only moves states on to the next place."""
    result = np.empty_like(z)
    source = [0, *range(2, z.shape[-1] - 1)]
    side = _product(top, columns, z)
    result[..., 2:, 2:] = z[..., source, :][..., source]
    result[..., :2, 2:] = side[..., source]
    result[..., 2:, :2] = np.swapaxes(side[..., source], -1, -2)
    result[..., :2, :2] = _product(top, columns, np.swapaxes(side, -1, -2))
    return result


def _product(top: Floats, columns: list[int], z: Floats) -> Floats:
    parts = [multiply(top[..., i, None], z[:, :, None, column]) for i, column in enumerate(columns)]
    result = parts[0]
    for part in parts[1:]:
        result = add(result, part)
    return result


def _matrix_rows(loop: Loop, alpha: Floats, beta: Floats) -> tuple[Floats, list[int]]:
    """First two rows of the loop matrix: their columns other than zero, shape (2, n, 2, columns), and which these are.

    Source: Hulin 2017, eq. 3.1, as `Loop.force_rows`.
    """
    move, pushes = _plant(loop)
    a, b = twofold(-alpha)[..., None], twofold(beta)[..., None]
    parts = {column: move[:, None, :, column] for column in (0, 1)}
    now = add(a, -b)
    for segment, push in zip(loop.segments, np.moveaxis(pushes, 2, 0), strict=True):
        places = (0, 2) if segment.age == 0 else (segment.age + 1, segment.age + 2)
        for place, factor in zip(places, (now, b), strict=True):
            term = multiply(push[:, None], factor)
            parts[place] = add(parts[place], term) if place in parts else term
    return np.stack(np.broadcast_arrays(*parts.values()), axis=-1), list(parts)


@lru_cache(maxsize=64)
def _plant(loop: Loop) -> tuple[Floats, Floats]:
    """Motion of (e, v) over a sample, (2, 2, 2), and what the force of each segment adds to it, (2, 2, segments)."""
    with localcontext() as context:
        context.prec = _DIGITS + 2 * math.ceil(math.log10(1 + loop.delta))
        first = Decimal(loop.delay) - math.floor(loop.delay)
        times = [first, 1 - first] if first else [Decimal(1)]
        flows = [_motion(Decimal(loop.gamma), Decimal(loop.delta), time) for time in times]
        late = flows[-1]
        whole = _times(late, flows[0]) if first else late
        # a force over one segment moves on freely in the next
        pushes = [[row[2] for row in late]]
        if first:
            pushes.insert(0, [row[0] * flows[0][0][2] + row[1] * flows[0][1][2] for row in late[:2]])
        return (
            from_decimals([row[:2] for row in whole[:2]]),
            from_decimals([[push[i] for push in pushes] for i in (0, 1)]),
        )


def _motion(gamma: Decimal, delta: Decimal, time: Decimal) -> Rows:
    """Exponential of the plant's motion of (x, v, u), by squaring that over a time short enough for its series."""
    zero, one = Decimal(0), Decimal(1)
    halvings = max(0, math.ceil(math.log2(2 * float(time) * (1 + float(gamma) + float(delta)))))
    t = time / 2**halvings
    rate = [[zero, t, zero], [-gamma * t, -delta * t, t], [zero, zero, zero]]
    result = [[one if i == j else zero for j in range(3)] for i in range(3)]
    term = result
    for n in range(1, _TERMS):
        term = [[value / n for value in row] for row in _times(term, rate)]
        result = [[a + b for a, b in zip(*rows, strict=True)] for rows in zip(result, term, strict=True)]
    for _ in range(halvings):
        result = _times(result, result)
    return result


def _times(a: Rows, b: Rows) -> Rows:
    return [[sum((row[k] * b[k][j] for k in range(3)), Decimal(0)) for j in range(3)] for row in a]
