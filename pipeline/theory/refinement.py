"""Sums over all samples of what a stable loop's states do: by doubling, and refined with twice the digits of a double.

A sum over 10^k samples magnifies the rounding of the loop matrix and of its powers by as much, and again by as much as
its modes are skew: next to resonance (gamma = 9.87, d = 0.25) the last bit of alpha counts 1e-10 at a pole radius of
1 - 1e-4, and which digits are left differs between processors. So what the equations of the sums leave unmet is
computed with twice the digits, from a plant that is known to as many, and the sums are changed until they meet them.
"""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal
from math import comb

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats

Sums = tuple[Floats, Floats, Floats]
"""Three matrices a point, each of shape (n, states, states), for the weights w = 0, 1, 2."""

_DOUBLINGS = 60
"""2^60 samples: the sum of any response with a spectral radius below 1 - 1e-16 has ended long before."""

_CONVERGED = 1e-18
"""Relative size of a last addend that no longer changes a double."""

_SLOW = 25.0
"""Mean age of the energy [samples], times d + 1, from which on its sums are refined. Radii are then above 0.98 (d = 0)
and rounding, which grows with the age, reaches 1e-12 at the worst plants."""

_ROUNDS = 8
"""Rounds of refinement: each multiplies the error by that of a solution in doubles, 1e-4 at a pole radius of
1 - 1e-12, more where modes are skew; what has not met its equations by then has no digits."""

_MET = 1e-9
"""Relative change after which the next would be below the last digit."""


def weighted_sums(matrix: Floats, initial: Floats) -> Sums:
    """Return X_w = sum_k k^w z_k z_k' for w = 0, 1, 2 of z_{k+1} = A z_k, each of shape (n, states, states).

    Parameters
    ----------
    matrix : float64, shape (n, states, states)
        Stable matrices A.
    initial : float64, shape (states,) or (n, states)
        z_0, the same for all or one each.

    Notes
    -----
    From the sums over N samples, those over 2 N follow as X_w + A^N [sum_i binomial(w, i) N^(w-i) X_i] A^N', so m
    doublings sum 2^m samples. All addends are positive semidefinite: nothing cancels.
    """
    first = np.broadcast_to(initial[..., :, None] * initial[..., None, :], matrix.shape)
    return _doubled(matrix, (first, np.zeros_like(matrix), np.zeros_like(matrix)))


def refined_sums(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> Sums:
    """Return the weighted sums of responses to the last digit or two of a double.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
    signal : {"step", "impulse"}

    Notes
    -----
    X_0 = z z' + A X_0 A', X_1 = A (X_1 + X_0) A', X_2 = A (X_2 + 2 X_1 + X_0) A'.
    NaN where these have no solution in doubles.
    """
    matrix, start = loop.matrix(alpha, beta), loop.starts(alpha, signal)
    sums = weighted_sums(matrix, start)
    slow = np.flatnonzero(_size(sums[1]) > _SLOW * (loop.delay + 1) * _size(sums[0]))
    if loop.mode is not None:  # modes of a light side are skew
        slow = np.arange(len(alpha))
    if len(slow):
        rough = [_symmetric(part[slow]) for part in sums]
        exact = _refined(loop, (alpha[slow], beta[slow]), matrix[slow], start[slow], rough)
        for part, better in zip(sums, exact, strict=True):
            part[slow] = better
    return sums


def _refined(loop: Loop, walls: tuple[Floats, Floats], matrix: Floats, start: Floats, x: list[Floats]) -> Sums:
    top, columns = _matrix_rows(loop, *walls)
    known = multiply(twofold(start)[..., :, None], twofold(start)[..., None, :])
    for _ in range(_ROUNDS):
        right = [_moved(loop, top, columns, _raised(x, w)) for w in range(3)]
        right[0] = add(right[0], known)
        rest = [add(side, twofold(-part))[0] for side, part in zip(right, x, strict=True)]
        change = _doubled(matrix, (rest[0], rest[1], rest[2]))
        x = [_symmetric(part + more) for part, more in zip(x, change, strict=True)]
        met = np.all([_largest(more) <= _MET * _largest(part) for part, more in zip(x, change, strict=True)], axis=0)
        if met.all():
            break
    for part in x:
        part[~met] = np.nan
    return x[0], x[1], x[2]


def _doubled(matrix: Floats, addends: Sums) -> Sums:
    """Solutions of X_0 = R_0 + A X_0 A', X_1 = R_1 + A (X_1 + X_0) A', X_2 = R_2 + A (X_2 + 2 X_1 + X_0) A'.

    NaN where they do not converge: of a matrix that is not stable, or is not to the digits of a double.
    """
    x0, x1, x2 = addends
    power, count = matrix, 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            turned = np.swapaxes(power, 1, 2)
            add2 = power @ (x2 + 2 * count * x1 + count * count * x0) @ turned
            add1 = power @ (x1 + count * x0) @ turned
            add0 = power @ x0 @ turned
            x0, x1, x2 = x0 + add0, x1 + add1, x2 + add2
            total = _size(x2)
            finite = np.isfinite(total)
            ended = finite & (_size(add2) <= _CONVERGED * total) & (_size(add0) <= _CONVERGED * _size(x0))
            if np.all(ended | ~finite):
                break
            power = power @ power
            count *= 2
    for sums in (x0, x1, x2):
        sums[~ended] = np.nan
    return x0, x1, x2


def _size(matrices: Floats) -> Floats:
    """Sum of the sizes along the diagonal, where sums of squares have their largest entries."""
    return np.asarray(np.abs(np.diagonal(matrices, axis1=1, axis2=2)).sum(axis=1))


def _largest(matrices: Floats) -> Floats:
    return np.asarray(np.abs(matrices).max(axis=(1, 2)))


def _symmetric(matrices: Floats) -> Floats:
    """What rounding made skew would grow from round to round, as the equations are those of the upper half."""
    return 0.5 * (matrices + np.swapaxes(matrices, 1, 2))


def _raised(x: list[Floats], w: int) -> Floats:
    """Sum of (k + 1)^w z_k z_k' from those of k^i z_k z_k'."""
    result = twofold(x[w])
    for i in range(w):
        result = add(result, twofold(comb(w, i) * x[i]))
    return result


def _moved(loop: Loop, top: Floats, columns: list[int], z: Floats) -> Floats:
    """A Z A' for symmetric Z: below its first rows, A only moves forces on to the next place."""
    result, rows, own = np.empty_like(z), top.shape[2], len(loop.own.free)
    source = slice(own, z.shape[-1] - 1)
    side = _product(top, columns, z)
    result[..., rows:, rows:] = z[..., source, source]
    result[..., :rows, rows:] = side[..., source]
    result[..., rows:, :rows] = np.swapaxes(side[..., source], -1, -2)
    result[..., :rows, :rows] = _product(top, columns, np.swapaxes(side, -1, -2))
    return result


def _product(top: Floats, columns: list[int], z: Floats) -> Floats:
    parts = [multiply(top[..., i, None], z[:, :, None, column]) for i, column in enumerate(columns)]
    result = parts[0]
    for part in parts[1:]:
        result = add(result, part)
    return result


def _matrix_rows(loop: Loop, alpha: Floats, beta: Floats) -> tuple[Floats, list[int]]:
    """First rows of the loop matrix, down to the newest force: their columns, shape (2, n, rows, columns), and which.

    Source: Hulin 2017, eq. 3.1, as `Loop.matrix`.
    """
    steps, points = loop.own, np.ones((len(alpha), 1))
    position, velocity, *gains = from_decimals([steps.position, steps.velocity, *steps.gains]).swapaxes(0, 1)
    pulls = ((-alpha, position), (-beta, velocity))
    law = add(*(multiply(twofold(by[:, None]), row[:, None]) for by, row in pulls))
    block, columns, own = from_decimals(steps.free)[:, None] * points[..., None], [*range(len(position[0]))], law
    if loop.oldest_force:
        block = np.concatenate([block, law[:, :, None]], axis=2)
    for segment, gain in zip(loop.segments, gains, strict=True):
        if segment.age == 0:
            rows = slice(len(gain[0]))
            block[:, :, rows, rows] = add(block[:, :, rows, rows], multiply(gain[:, None, :, None], own[:, :, None]))
    for segment, gain in zip(loop.segments, gains, strict=True):
        if segment.age:
            late = np.zeros((*block.shape[:3], 1))
            late[:, :, : len(gain[0]), 0] = gain[:, None]
            block, columns = np.concatenate([block, late], axis=3), [*columns, len(gain[0]) - 1 + segment.age]
    return block, columns


_SPLIT = 2.0**27 + 1
"""Parts a double into two halves of 26 bits, whose products are exact (Dekker 1971)."""


def twofold(values: Floats) -> Floats:
    """Return doubles as twofold numbers, shape (2, ...)."""
    return np.stack([values, np.zeros_like(values)])


def from_decimals(rows: Iterable[Iterable[Decimal]]) -> Floats:
    """Return a matrix of decimals as twofold numbers, shape (2, rows, columns)."""
    pairs = [[(float(value), float(value - Decimal(float(value)))) for value in row] for row in rows]
    return np.moveaxis(np.array(pairs), 2, 0)


def add(a: Floats, b: Floats) -> Floats:
    """Return the sum of twofold numbers; shapes are broadcast."""
    high = a[0] + b[0]
    part = high - a[0]
    low = (a[0] - (high - part)) + (b[0] - part)  # what rounding took from the sum (Knuth)
    return _normalised(high, low + (a[1] + b[1]))


def multiply(a: Floats, b: Floats) -> Floats:
    """Return the product of twofold numbers; shapes are broadcast."""
    high = a[0] * b[0]
    (a_left, a_right), (b_left, b_right) = _halves(a[0]), _halves(b[0])
    low = ((a_left * b_left - high) + a_left * b_right + a_right * b_left) + a_right * b_right
    return _normalised(high, low + (a[0] * b[1] + a[1] * b[0]))


def _normalised(high: Floats, low: Floats) -> Floats:
    total = high + low
    return np.stack([total, low - (total - high)])


def _halves(value: Floats) -> tuple[Floats, Floats]:
    scaled = _SPLIT * value
    left = scaled - (scaled - value)
    return left, value - left
