"""Energy costs of the loop's step and impulse response, summed exactly to infinity.

The energy of a sampling interval is a form of few numbers, the device's state at its start and the wall's forces in it;
every energy cost follows from the sums of their products with the weights k^w. They come from the modes; where these
lose digits, from the transfer function in many.
"""

from __future__ import annotations

from decimal import Decimal
from math import comb

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, as_points
from pipeline.loop.many_digits import Digits, as_exact, as_floats, from_w, many_digits
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.modes import TOGETHER, Modes, modes
from pipeline.theory.motion import WEIGHTS, energy_forms
from pipeline.theory.poles import characteristic

_CACHED = 1 << 15
"""Pairs of modes that are summed at a time."""

_SKEW = 1e-11
"""Bound of the share that rounding may have in sums by modes, above which they are computed in many digits."""


def energy_costs(loop: Loop, alpha: object, beta: object, signal: str = "step") -> dict[str, Floats]:
    """Return the continuous and discrete energy costs of stable points.

    Parameters
    ----------
    loop : Loop
    alpha, beta : array_like, shape (n,)
        Normalised virtual stiffness and damping; every point must be stable, with alpha + gamma > 0.
    signal : {"step", "impulse"}

    Returns
    -------
    dict of float64, shape (n,)
        ``energy_<signal>_w0`` to ``_w2`` and the same with ``_discrete`` appended; dimensionless. NaN where rounding
        leaves nothing of the sums.

    Raises
    ------
    ParameterError
        If alpha + gamma <= 0.

    Notes
    -----
    Continuous: (1/E_0) times the integral of tau^w E(tau), tau in samples, along the exact motion between samples.
    Discrete: (1/E_0) sum_k k^w [(alpha+gamma)/2 (chi_k - chi_inf)^2 + (chi_k - chi_{k-1})^2/2], chi_{-1} = chi_0.
    The energy is that of the sensed position and its velocity, with the mass of all: what the wall sees. A step's E_0
    is that of the thesis; an impulse of unit momentum has E_0 = 1/2.

    Source: Hulin 2017, eqs. 5.7, 5.14; discrete form as reproduced from Tables D.2, D.3, D.5 and D.6.
    """
    a, b = as_points(alpha, beta)
    if np.any(a + loop.gamma <= 0):
        raise ParameterError("energy costs need alpha + gamma > 0: without stiffness there is no final position.")
    result = {f"energy_{signal}_w{w}{suffix}": np.empty(len(a)) for suffix in ("", "_discrete") for w in WEIGHTS}
    for first in range(0, len(a), TOGETHER):
        some = slice(first, first + TOGETHER)
        for name, values in zip(result, _energies(loop, a[some], b[some], signal), strict=True):
            result[name][some] = values
    return result


def _energies(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> list[Floats]:
    sums, forms = _sums(loop, alpha, beta, signal), energy_forms(loop)
    stiffness, one = alpha + loop.gamma, np.ones_like(alpha)
    # deviations of a step are relative to chi_inf, E/E_0 = e^2 + v^2/(alpha + gamma); an impulse starts with v = 1
    potential, kinetic = (one, 1 / stiffness) if signal == "step" else (stiffness, one)
    with np.errstate(invalid="ignore"):  # of sums that rounding left nothing of
        traces = sums.reshape(len(WEIGHTS), len(alpha), -1) @ forms.reshape(-1, sums.shape[-1] ** 2).T
    parts = np.moveaxis(traces, 1, 2).reshape(len(WEIGHTS), *forms.shape[:3], len(alpha))
    summed = potential * parts[:, 0] + kinetic * parts[:, 1]
    # (k + tau)^w = sum_i binomial(w, i) k^(w-i) tau^i
    return [sum(comb(w, i) * summed[w - i, kind, i] for i in range(w + 1)) for kind in (0, 1) for w in WEIGHTS]


def _sums(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> Floats:
    """Return sum_k k^w g_k g_k' of what an interval sees (`Loop.seen`), shape (3, n, q, q)."""
    law, n, q = loop.law(alpha, beta), len(alpha), len(loop.device[1]) + len(loop.segments)
    found, sums, good = modes(loop, alpha, beta, signal), np.empty((len(WEIGHTS), n, q, q)), np.zeros(n, np.bool_)
    size = max(1, _CACHED // loop.states**2)
    for first in range(0, n, size):
        near = slice(first, first + size)
        sums[:, near], good[near] = _by_modes(loop, law[near], found.part(near))
    for i in np.flatnonzero(~good):
        sums[:, i] = _exact(loop, float(alpha[i]), float(beta[i]), signal)
    return sums


def _by_modes(loop: Loop, law: Floats, found: Modes) -> tuple[Floats, Booleans]:
    """Return the sums, and where rounding has a small share in them."""
    seen = loop.seen(law, found.state)
    back = np.swapaxes(seen.conj(), 1, 2)
    ratio = found.pole[:, :, None] * found.pole[:, None, :].conj()
    with np.errstate(divide="ignore", invalid="ignore"):  # a pole on the circle leaves no sum, and is not good
        once = 1 / (1 - ratio)
        first = ratio * once * once
        weights = (once, first, (1 + ratio) * first * once)  # sum_k k^w ratio^k
        sums = np.stack([((seen @ weight) @ back).real for weight in weights])
        # what moves 1/(1 - ratio) by a share moves the sum of k^2 ratio^k by three
        size, slowness = np.abs(seen), np.abs(once)
        doubt = 3 * (found.rounding[:, :, None] + found.rounding[:, None, :]) * slowness**2
        share = ((size @ doubt) * size).sum(axis=2) / np.einsum("nii->ni", sums[0])
        good = (share.max(axis=1) < _SKEW) & (np.abs(found.pole) < 1).all(axis=1)
        return sums, np.asarray(good)


def _exact(loop: Loop, alpha: float, beta: float, signal: str) -> Floats:
    """Return the sums of one point in many digits, shape (3, q, q); nan where it is not stable.

    With G = B/A the transform of the sequences, sum_k k^w g_k^2 is the w-th derivative by s, at 0, of the sum of those
    of G(z exp(-s/2)): Astroem's recursion for it, on coefficients with their derivatives.

    Source: Astroem 1970, Introduction to Stochastic Control Theory, ch. 5, theorem 2.1.
    """
    bottom = characteristic(loop, alpha, beta)
    with many_digits(loop.digits):
        a = from_w(bottom)[::-1]
        a = a / a[0]
        place, orders = _sequences(loop, alpha, beta, signal, len(a)), as_exact(np.arange(len(a))) / 2
        b = np.array([[row[: i + 1] @ a[i::-1] for i in range(len(a))] for row in place.T])
        powers = np.array([as_exact(np.ones(len(a))), orders, orders * orders])
        a, b = powers * a, powers[:, None] * b
        total = as_exact(np.zeros((len(WEIGHTS), len(b[0]), len(b[0]))))
        for _ in range(a.shape[1]):
            last = b[:, :, -1]
            total = total + _ratio(_times(last[:, :, None], last[:, None, :]), a[:, 0, None, None])
            share, each = _ratio(a[:, -1], a[:, 0]), _ratio(last, a[:, 0, None])
            if a.shape[1] > 1 and abs(share[0]) >= 1:
                return np.full(total.shape, np.nan)
            turned = a[:, ::-1]
            b = (b - _times(each[:, :, None], turned[:, None, :]))[:, :, :-1]
            a = (a - _times(share[:, None], turned))[:, :-1]
        return as_floats(total)


def _times(x: Digits, y: Digits) -> Digits:
    """Return products of numbers with their first two derivatives along the first axis."""
    return np.array([x[0] * y[0], x[1] * y[0] + x[0] * y[1], x[2] * y[0] + 2 * x[1] * y[1] + x[0] * y[2]])


def _ratio(x: Digits, y: Digits) -> Digits:
    """Return ratios of such numbers."""
    value = x[0] / y[0]
    slope = (x[1] - value * y[1]) / y[0]
    return np.array([value, slope, (x[2] - 2 * slope * y[1] - value * y[2]) / y[0]])


def _sequences(loop: Loop, alpha: float, beta: float, signal: str, count: int) -> Digits:
    """Return the first samples of what an interval sees, shape (count, q)."""
    steps, p = loop.own, len(loop.device[1])
    start = as_exact(loop.starts(np.array([alpha]), signal)[0])
    state, forces = start[: len(steps.free)], list(start[len(steps.free) :][::-1])  # in order of time
    law, result = -(Decimal(alpha) * steps.position + Decimal(beta) * steps.velocity), []
    for _ in range(count):
        forces.append(law @ state)
        acting = [forces[len(forces) - 1 - segment.age] for segment in loop.segments]
        result.append([*state[:p], *acting])
        state = steps.free @ state + sum(gain * force for gain, force in zip(steps.gains, acting, strict=True))
    return np.array(result, dtype=object)
