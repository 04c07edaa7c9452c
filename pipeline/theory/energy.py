"""Compute energy costs of the step and impulse responses of a loop, summed exactly to infinity.

The energy of a sampling interval is a quadratic form of the device state at its start and the wall forces in it. Every
energy cost follows from sums of products of these numbers with the weights k^w. The sums follow from the transforms of
the sequences by Astroem's recursion, in doubles, or with more digits if rounding matters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal
from functools import lru_cache
from typing import Any

import numpy as np

from pipeline.base.compiled import compiled, inlined
from pipeline.base.errors import ParameterError
from pipeline.loop.many_digits import Digits, as_exact, bilinear, from_w, many_digits, total
from pipeline.loop.normalised_loop import NormalisedLoop, as_points
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.motion import WEIGHTS, energy_forms, forms_at_nodes
from pipeline.theory.poles import characteristic_parts

Arrays = tuple[Any, ...]

Five = tuple[float, float, float, float, float]
"""Number with five parts, as in `_by_recursion`."""

POLYNOMIALS, WORK = (
    "Tuple((f8[:,:,::1],f8[:,:,:,::1],f8[:,::1],f8[:,:,::1]))",
    ("Tuple((f8[:,::1],f8[:,:,::1],f8[:,::1],f8[:,::1],f8[:,::1]))"),
)

EPSILON = 2.0**-52
"""Rounding error of a double."""

_IN_CACHE = 1 << 12
"""Number of points whose sums are in memory together."""

_TOGETHER = 1 << 17
"""Number of values of the recursion that are computed together, so that they fit into a cache."""

_LONG = 64
"""Smallest delay for which polynomials in z lose fewer digits than polynomials in w, because they avoid binomial
coefficients of the delay."""

LONGEST_SUM = 1 << 18
"""Largest number of samples of a sum with a non-integer exponent, for a spectral radius of about 1 - 1e-4."""

_BLOCK_SAMPLES, _NOTHING = 64, 1e-17
"""Number of samples per block of such a sum, and largest share of the sum at which a block is negligible."""

_ROUNDED, _ROUNDED_LONG = 1e-13, 2e-13
"""Largest estimated relative rounding errors of a sum. The estimate is usually correct within a factor of three."""


def energy_costs(
    loop: NormalisedLoop, alpha: object, beta: object, signal: str = "step", weights: Sequence[float] = WEIGHTS
) -> dict[str, Floats]:
    """Return the continuous and discrete energy costs of stable points.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping. Every point must be stable with alpha + gamma > 0. The relative error
        is 1e-12 up to a spectral radius of 1 - 1e-11.
    signal : {"step", "impulse"}
    weights : sequence of float
        Exponents w >= 0.

    Returns
    -------
    dict of float64, shape (n,)
        Dimensionless costs ``energy_<signal>_w<w>``, and the same with ``_discrete`` appended. NaN for an unstable
        point. With w other than 0, 1 and 2, also NaN for a point that still moves after `LONGEST_SUM` samples.

    Raises
    ------
    ParameterError
        If alpha + gamma <= 0.

    Notes
    -----
    Continuous: (1/E_0) times the integral of tau^w E(tau) along the exact motion between samples, with tau in samples.
    Discrete: (1/E_0) sum_k k^w [(alpha+gamma)/2 (chi_k - chi_inf)^2 + (chi_k - chi_{k-1})^2/2], chi_{-1} = chi_0.
    The energy is that of the sensed position and its velocity, with the total mass, as at the wall. E_0 of a step is
    that of the thesis. An impulse of unit momentum has E_0 = 1/2.

    Source: Hulin 2017, eqs. 5.7, 5.14; discrete form as reproduced from Tables D.2, D.3, D.5 and D.6.
    """
    a, b = as_points(alpha, beta)
    if np.any(a + loop.gamma <= 0):
        raise ParameterError("energy costs require alpha + gamma > 0: without stiffness, there is no final position.")
    costs = {w: _summed_costs(loop, a, b, signal, w) for w in weights if w not in WEIGHTS}
    if len(costs) < len(weights):
        exact = _exact_costs(loop, a, b, signal)
        costs |= {w: exact[:, int(w)] for w in weights if w in WEIGHTS}
    suffixes = enumerate(("", "_discrete"))
    return {f"energy_{signal}_w{w:g}{suffix}": costs[w][kind] for kind, suffix in suffixes for w in weights}


def _weighted(loop: NormalisedLoop, alpha: Floats, signal: str, potential: Floats, kinetic: Floats) -> Floats:
    """Return costs from sums of potential and kinetic energy, with points along the last axis.

    Deviations of a step are relative to chi_inf, so that E/E_0 = e^2 + v^2/(alpha + gamma). An impulse starts with
    v = 1.
    """
    stiffness = alpha + loop.gamma
    return potential + kinetic / stiffness if signal == "step" else potential * stiffness + kinetic


def _exact_costs(loop: NormalisedLoop, a: Floats, b: Floats, signal: str) -> Floats:
    """Return continuous and discrete costs from the transforms, for w = 0, 1, 2, shape (2, 3, n)."""
    costs, left = np.empty((len(a), 2 * len(WEIGHTS))), np.arange(len(a))

    def weighted(sums: Floats, some: Integers) -> Floats:
        potential, kinetic = np.split(sums.reshape(len(sums), -1) @ _weights(loop).T, 2, axis=1)
        return _weighted(loop, a[some], signal, potential.T, kinetic.T).T

    kinds: list[Any] = [np.float64, np.longdouble, np.object_]
    if loop.oldest_force <= _LONG:
        good = np.zeros(len(a), np.bool_)
        for some in (left[first : first + _IN_CACHE] for first in range(0, len(a), _IN_CACHE)):
            sums, good[some] = _in_doubles(loop, a[some], b[some], signal)
            costs[some] = weighted(sums, some)
        kinds, left = kinds[1:], np.flatnonzero(~good)
    for kind in kinds:
        good, size = np.zeros(len(left), np.bool_), max(1, _TOGETHER // loop.states**2)
        for part in (slice(first, first + size) for first in range(0, len(left), size)):
            with np.errstate(all="ignore"), many_digits(loop.digits) as context:
                context.clear_traps()  # NaN is not good
                sums, good[part] = _by_recursion(loop, a[left[part]], b[left[part]], signal, kind)
            costs[left[part]] = weighted(sums.transpose(2, 0, 1), left[part])
        left = left[~good]
    costs[left] = np.nan
    return costs.T.reshape(2, len(WEIGHTS), len(a)).copy()


def _summed_costs(loop: NormalisedLoop, a: Floats, b: Floats, signal: str, w: float) -> Floats:
    """Return continuous and discrete costs with any exponent, shape (2, n)."""
    some = max(1, _TOGETHER // (_BLOCK_SAMPLES * loop.states))
    parts = [slice(first, first + some) for first in range(0, len(a), some)]
    if not parts:
        return np.empty((2, 0))
    potential, kinetic = np.concatenate([_summed(loop, a[part], b[part], signal, w) for part in parts], axis=2)
    return _weighted(loop, a, signal, potential, kinetic)


def _summed(loop: NormalisedLoop, alpha: Floats, beta: Floats, signal: str, w: float) -> Floats:
    """Return sums with any exponent for potential and kinetic energy, continuous and discrete, shape (2, 2, n).

    The transform of k^w is not rational for non-integer w. The sum is therefore computed in blocks of samples until it
    no longer changes.
    """
    law, turn, state = loop.law(alpha, beta), loop.matrix(alpha, beta), loop.starts(alpha, signal)
    rows = [loop.seen(law, np.broadcast_to(np.eye(loop.states), turn.shape))]
    for _ in range(_BLOCK_SAMPLES - 1):
        rows.append(rows[-1] @ turn)
    ahead, left = np.stack(rows, axis=1), np.arange(len(alpha))
    leap = np.linalg.matrix_power(turn, _BLOCK_SAMPLES)
    result, quiet = np.zeros((len(alpha), 4)), np.zeros(len(alpha), np.int64)
    upper = np.triu_indices(ahead.shape[2])
    for first in range(0, LONGEST_SUM, _BLOCK_SAMPLES):
        seen = np.einsum("nkqs,ns->nkq", ahead, state)
        pairs = (seen[..., upper[0]] * seen[..., upper[1]]).reshape(len(left), -1)
        added = pairs @ _weights_from(loop, w, first)
        result[left] += added
        state = np.einsum("nrs,ns->nr", leap, state)
        quiet[left] = np.where(added.max(axis=1) <= _NOTHING * result[left].max(axis=1), quiet[left] + 1, 0)
        going = quiet[left] * _BLOCK_SAMPLES <= loop.oldest_force + _BLOCK_SAMPLES
        if not going.all():
            left, ahead, leap, state = left[going], ahead[going], leap[going], state[going]
        if not len(left):
            break
    result[left] = np.nan
    return np.asarray(result.T.reshape(2, 2, len(alpha)))


@lru_cache(maxsize=4096)
def _weights_from(loop: NormalisedLoop, w: float, first: int) -> Floats:
    """Return the weights of pairs in the samples of a block for `_summed`, shape (samples pairs, 4)."""
    k, exact = first + np.arange(_BLOCK_SAMPLES, dtype=np.float64), energy_forms(loop)
    times, at = forms_at_nodes(loop)
    between = np.einsum("kt,etpq->ekpq", (k[:, None] + times) ** w, at)
    if first == 0:
        between[:, 0] = forms_at_nodes(loop, w)[1].sum(axis=1)
    place, way = (form[:, None, None] * exact[kind, 1, 0] for kind, form in enumerate((k**w, (k + 1) ** w)))
    forms = np.array([between[0], place, between[1], way])
    rows, columns = np.triu_indices(forms.shape[-1])
    both = forms[..., rows, columns] + forms[..., columns, rows] * (rows != columns)
    return np.asarray(both.reshape(4, -1).T)


@lru_cache(maxsize=64)
def _weights(loop: NormalisedLoop) -> Floats:
    """Return the weights of sums in potential and kinetic energy, continuous and discrete, for each w.

    They follow from (k + tau)^w = sum_i binomial(w, i) k^(w-i) tau^i and have the shape (2 2 3, 3 pairs).
    """
    forms = energy_forms(loop)
    rows, columns = np.triu_indices(forms.shape[-1])
    both = forms[..., rows, columns] + forms[..., columns, rows] * (rows != columns)
    weights = np.zeros((2, 2, len(WEIGHTS), len(WEIGHTS), len(rows)))
    for w in WEIGHTS:
        for i in range(w + 1):
            weights[:, :, w, w - i] = math.comb(w, i) * both[:, :, i]
    return weights.reshape(12, -1)


def _in_doubles(loop: NormalisedLoop, alpha: Floats, beta: Floats, signal: str) -> tuple[Floats, Booleans]:
    """Return sums of k^w g_k g_k' of `NormalisedLoop.seen` over k, (n, 3, pairs of q numbers), and a mask of valid
    ones."""
    bottom, top = _transforms(loop, signal, np.float64)
    q, powers = top.shape[2:]
    pairs, chances = q * (q + 1) // 2, (_chances((powers + 1,)), _chances((q, powers)))
    sums, good = np.empty((len(alpha), len(WEIGHTS), pairs)), np.zeros(len(alpha), np.bool_)
    work = np.empty((powers + 1, 5)), np.empty((q, powers, 5)), *np.empty((2, q, 5)), np.empty((pairs, 5))
    sums_in_doubles((bottom, top, *chances), (alpha, beta), work, sums, good)
    sums[~good] = np.nan
    return sums, good


@inlined
def part_of(polynomial: Floats, i: int) -> Five:
    """Return a coefficient of a polynomial."""
    return polynomial[i, 0], polynomial[i, 1], polynomial[i, 2], polynomial[i, 3], polynomial[i, 4]


@inlined
def times(x: Five, y: Five) -> Five:
    """Return the product of two numbers with five parts."""
    first, second = x[0] * y[1] + x[1] * y[0], x[0] * y[2] + x[1] * y[1] + x[2] * y[0]
    return x[0] * y[0], first, second, x[0] * y[3] + x[3] * y[0], x[0] * y[4] + x[4] * y[0]


@inlined
def inverse(x: Five) -> Five:
    """Return the reciprocal of a number with five parts."""
    value = 1 / x[0]
    share = value * x[1]
    falls = -value * value
    return value, falls * x[1], falls * x[2] + value * share * share, falls * x[3], falls * x[4]


@inlined
def put(polynomial: Floats, i: int, x: Five) -> None:
    """Set a coefficient of a polynomial."""
    for part in range(5):
        polynomial[i, part] = x[part]


@inlined
def add(polynomial: Floats, i: int, x: Five, sign: float) -> None:
    """Add a number with five parts to a coefficient, with a sign."""
    for part in range(5):
        polynomial[i, part] += sign * x[part]


@inlined
def put_in(powers: Floats, chances: Floats, walls: Five, result: Floats) -> None:
    """Set the value, the first and half the second derivative, and two random perturbations of a polynomial at a
    wall."""
    for i in range(len(result)):
        for part in range(3):
            result[i, part] = 0.0
            for wall in range(len(powers[part])):
                result[i, part] += powers[part, wall, i] * walls[wall]
        size = 0.0
        for wall in range(len(powers[0])):
            size += abs(powers[0, wall, i] * walls[wall])
        result[i, 3], result[i, 4] = size * chances[0, i], size * chances[1, i]


@compiled(f"void({POLYNOMIALS},UniTuple(f8[::1],2),{WORK},f8[:,:,::1],b1[::1])")
def sums_in_doubles(polynomials: Arrays, walls: Arrays, work: Arrays, sums: Floats, good: Booleans) -> None:
    """Compute `_by_recursion` in doubles for each point, with polynomials in w.

    Parameters
    ----------
    polynomials : tuple
        Denominator and numerator of `_transforms`, and their `_chances`.
    walls : tuple
        alpha and beta, shape (n,).
    work : tuple
        Work arrays: polynomials at a wall, lowest powers of the numerator, the same divided by a scale, and sums.
    sums, good : float64, shape (n, 3, pairs); bool, shape (n,)
        Output: sums, and which of them are valid.
    """
    bottom, top, bottom_chances, top_chances = polynomials
    a, b, first, scaled, total = work
    for n in range(len(good)):
        alpha, beta = walls[0][n], walls[1][n]
        wall = 1.0, alpha, beta, alpha * alpha, alpha * beta
        put_in(bottom, bottom_chances, wall, a)
        for r in range(len(b)):
            put_in(top[:, :, r], top_chances[:, r], wall, b[r])
        total[:] = 0.0
        stable = True
        for k in range(len(a) - 1):
            lowest, over = part_of(a, k), inverse(part_of(a, k + 1))
            size = times(lowest, part_of(a, k + 1))
            stable = stable and size[0] > 0
            share, over_size = times(lowest, over), inverse(size)
            for r in range(len(b)):
                put(first, r, part_of(b[r], k))
                each = times(part_of(first, r), over)
                put(scaled, r, times(part_of(first, r), over_size))
                for i in range(k + 3, len(a), 2):
                    add(b[r], i - 1, times(each, part_of(a, i)), -1.0)
            for i in range(k + 3, len(a), 2):
                add(a, i - 1, times(share, part_of(a, i)), -1.0)
            pair = 0
            for r in range(len(b)):
                for c in range(r, len(b)):
                    add(total, pair, times(part_of(first, r), part_of(scaled, c)), 1.0)
                    pair += 1
        doubt, pair = 0.0, 0
        for r in range(len(b)):
            own = pair
            for c in range(r, len(b)):
                other = len(total) - (len(b) - c) * (len(b) - c + 1) // 2
                off = max(abs(total[pair, 3]), abs(total[pair, 4]))
                both = total[own, 0] * total[other, 0] if total[own, 0] > 0 else 0.0
                doubt = max(doubt, off / math.sqrt(both)) if both > 0 else math.inf
                pair += 1
        good[n] = stable and doubt * EPSILON < _ROUNDED
        if good[n]:
            for pair in range(len(total)):
                for w in range(3):
                    sums[n, w, pair] = total[pair, w] * max(w, 1)


def _by_recursion(loop: NormalisedLoop, alpha: Floats, beta: Floats, signal: str, kind: Any) -> tuple[Floats, Booleans]:
    """Return the sums as float64, and a mask of the valid points, which are stable and have small rounding errors.

    The sums are computed with the number type ``kind``. H is the transform of a sequence h. Then sum_k k^w h_k^2 is the
    w-th derivative, at s = 0, of the sum for H(z exp(-s/2)), which is an integral along the imaginary axis of w.
    Numbers have five parts: value, first and half the second derivative with respect to s, and the effects of two
    random relative perturbations of the polynomial terms on the value. These effects times the rounding unit of the
    number type estimate the rounding error.

    Source: Astroem 1970, Introduction to Stochastic Control Theory, ch. 5, theorem 3.1.
    """
    bottom, top = _transforms(loop, signal, kind)
    one, a, b = (_as(kind, values) for values in (np.ones(len(alpha)), alpha, beta))
    walls = np.stack([one, a, b, a * a, a * b])
    a, b = _at(bottom, walls[: bottom.shape[1]]), _at(top, walls)
    rows, columns = np.triu_indices(b.shape[1])
    sums, good = 0 * b[:, rows, 0], np.ones(len(alpha), np.bool_)
    step, limit = (_step_in_z, _ROUNDED_LONG) if loop.oldest_force > _LONG else (_step_in_w, _ROUNDED)
    while b.shape[2]:
        first, size, stable, a, b = step(a, b)
        good &= stable.astype(np.bool_)
        sums += _ratio(_times(first[:, rows], first[:, columns]), size[:, None])
    if kind is not np.object_:
        own = sums[0, rows == columns]
        doubt = (np.abs(sums[3:]) / np.sqrt(own[rows] * own[columns])).max(axis=(0, 1))
        good &= doubt * np.finfo(kind).eps < limit
    sums[2] *= 2
    return sums[:3].astype(np.float64), good


def _step_in_w(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Perform a step of the recursion in w, and return its results and the remaining polynomials.

    The results are coefficients, a scale, and whether the points are stable. The product of the coefficients divided by
    the scale is a part of the sum.
    """
    first, odd = b[:, :, 0], a[:, 3::2]
    size, share, each = _times(a[:, 0], a[:, 1]), _ratio(a[:, 0], a[:, 1]), _ratio(first, a[:, None, 1])
    a, b = a[:, 1:], b[:, :, 1:]
    a[:, 1 : 2 * odd.shape[1] : 2] -= _times(share[:, None], odd)
    b[:, :, 1 : 2 * odd.shape[1] : 2] -= _times(each[:, :, None], odd[:, None])
    return first, size, size[0] > 0, a, b


def _step_in_z(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Perform the same step for polynomials in z, highest power first, with a monic denominator.

    Source: Astroem 1970, theorem 2.1.
    """
    last, size, turned = b[:, :, -1], a[:, 0], a[:, ::-1]
    share, each = _ratio(a[:, -1], size), _ratio(last, size[:, None])
    stable = (np.abs(share[0]) < 1) | (a.shape[1] == 1)
    b = (b - _times(each[:, :, None], turned[:, None]))[:, :, :-1]
    return last, size, stable, (a - _times(share[:, None], turned))[:, :-1], b


def _at(polynomials: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Return the values of polynomials at walls, shape (5, ..., powers, n).

    The first axis contains the value, two derivatives, and the effects of two random perturbations of the terms. The
    lowest power is first.
    """
    found = np.tensordot(np.moveaxis(polynomials, 1, -1), walls, 1)
    terms = np.tensordot(np.moveaxis(np.abs(polynomials[0]), 0, -1), np.abs(walls), 1)
    return np.concatenate([found, terms * _as(found.dtype.type, _chances(terms.shape[:-1])[..., None])])


def _chances(shape: tuple[int, ...]) -> Floats:
    """Return two pseudo-random perturbations of terms, shape (2, terms)."""
    number = np.arange(math.prod(shape)).reshape(shape)
    return np.cos([1.7 * number**2, 2.9 * number**2 + 1.0])


def _times(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return products of numbers with five parts, which are along the first axis."""
    result = x[0] * y
    result[1:] += x[1:] * y[0]
    result[2] += x[1] * y[1]
    return np.asarray(result)


def _ratio(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return ratios of numbers with five parts."""
    result, parts = x / y[0], y[1:] / y[0]
    result[1:] -= result[0] * parts
    result[2] -= result[1] * parts[0]
    return np.asarray(result)


@lru_cache(maxsize=64)
def _transforms(loop: NormalisedLoop, signal: str, kind: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the transforms of the inputs of an interval as ratios of polynomials in w, with a number type.

    The denominator has the shape (3, 3, powers). The axes are for the value, its first and half its second derivative
    with respect to s; and for the constant term and the factors of alpha and beta. A factor 1 + w turns the sum into an
    integral along the axis. The numerators, (3, 5, q, powers), also have factors of alpha^2 and alpha beta.
    """
    with many_digits(loop.digits):
        if kind is not np.object_:
            bottom, top = (_as(kind, part) for part in _transforms(loop, signal, np.object_))
            return bottom, top
        known = characteristic_parts(loop)
        none = as_exact(np.zeros(max(map(len, known))))
        parts, long = np.array([total(none, part) for part in known]), loop.oldest_force > _LONG
        if long:
            parts = np.array([from_w(part)[::-1] for part in parts])
            parts /= parts[0, 0]
        here, stiffer, softer, damped, both = (
            _tops(loop, parts, alpha, beta, signal) for alpha, beta in ((0, 0), (1, 0), (-1, 0), (0, 1), (1, 1))
        )
        even, odd = (stiffer + softer) / 2, (stiffer - softer) / 2
        top = np.array([here, odd, damped - here, even - here, both - stiffer - damped + here])
        by_s = _by_s_in_z if long else _by_s
        bottom, top = (np.stack([p, by_s(p), by_s(by_s(p)) / 2]) for p in (parts, top))
        if long:
            return bottom, top
        edge = np.zeros_like(bottom[..., :1])
        return np.concatenate([bottom, edge], axis=-1) + np.concatenate([edge, bottom], axis=-1), top


def _tops(loop: NormalisedLoop, parts: Digits, alpha: int, beta: int, signal: str) -> Digits:
    """Return the numerators of the inputs of an interval at a wall, shape (q, powers of w)."""
    long, bottom = loop.oldest_force > _LONG, parts[0] + alpha * parts[1] + beta * parts[2]
    bottom = bottom if long else from_w(bottom)[::-1]
    n = len(bottom) - 1
    seen = _sequences(loop, alpha, beta, signal, n + 1).T
    rows = [np.array([row[: i + 1] @ bottom[i::-1] for i in range(n + 1)]) for row in seen]
    if long:
        return np.array(rows, dtype=object)
    return np.asarray(np.array([bilinear(row[::-1], n) for row in rows]) / Decimal(2) ** n)  # of (1 + z)^n (1 - w)^n


def _by_s(polynomial: Digits) -> Digits:
    """Return the derivative of p(w(z exp(-s/2))) with respect to s along the last axis, without its common factor."""
    result: Digits = np.zeros_like(polynomial)
    k = np.arange(polynomial.shape[-1])
    result[..., :-1] -= polynomial[..., 1:] * k[1:] / 4
    result[..., 1:] -= polynomial[..., :-1] * k[:0:-1] / 4
    return np.asarray(result)


def _by_s_in_z(polynomial: Digits) -> Digits:
    return np.asarray(polynomial * np.arange(polynomial.shape[-1]) / 2, dtype=object)


def _as(kind: Any, values: np.ndarray) -> np.ndarray:
    """Return Decimal numbers or doubles as numbers of another type."""
    if kind is np.object_:
        return as_exact(values)
    found: np.ndarray = values.astype(np.float64).astype(kind)
    if kind is not np.float64 and values.dtype == np.object_:
        found += (values - as_exact(found.astype(np.float64))).astype(np.float64)
    return found


def _sequences(loop: NormalisedLoop, alpha: int, beta: int, signal: str, count: int) -> Digits:
    """Return the first samples of the inputs of an interval, shape (count, q)."""
    steps, p = loop.own, len(loop.device.sensor)
    start = as_exact(loop.starts(np.array([alpha]), signal)[0])
    state, forces = start[: len(steps.free)], list(start[len(steps.free) :][::-1])  # in order of time
    law, result = -(Decimal(alpha) * steps.position + Decimal(beta) * steps.velocity), []
    for _ in range(count):
        forces.append(law @ state)
        acting = [forces[len(forces) - 1 - segment.age] for segment in loop.segments]
        result.append([*state[:p], *acting])
        state = steps.free @ state + sum(gain * force for gain, force in zip(steps.gains, acting, strict=True))
    return np.array(result, dtype=object)
