"""Energy costs of the loop's step and impulse response, summed exactly to infinity.

The energy of a sampling interval is a form of few numbers, the device's state at its start and the wall's forces in it;
every energy cost follows from the sums of their products with the weights k^w. These are refined to the last digit
(`refinement`); for many points they come from the modes, much faster, and are refined only where these lose digits.
"""

from __future__ import annotations

from math import comb

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Booleans, Floats
from pipeline.theory.modes import TOGETHER, Modes, modes
from pipeline.theory.motion import WEIGHTS, energy_forms
from pipeline.theory.refinement import refined_sums

_ENTRIES = 1 << 18
"""Entries of the matrices that are doubled at a time: of some ten arrays, 20 MB."""

_CACHED = 1 << 15
"""Pairs of modes that are summed at a time."""

_FEW, _SHORT = 128, 12
"""Points and states up to which all sums are refined: that takes less time than the other ways."""

_EPS = np.finfo(np.float64).eps

_SKEW = 1e-11
"""Bound of the share that rounding may have in sums by modes, above which they are refined."""


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
    sums, rest = np.empty((len(WEIGHTS), n, q, q)), np.arange(n)
    if n > _FEW or loop.states > _SHORT:
        found, size = modes(loop, alpha, beta, signal), max(1, _CACHED // loop.states**2)
        good = np.zeros(n, np.bool_)
        for first in range(0, n, size):
            near = slice(first, first + size)
            sums[:, near], good[near] = _by_modes(loop, law[near], found.part(near))
        rest = np.flatnonzero(~good)
    chunk = max(1, _ENTRIES // loop.states**2)
    for some in (rest[i : i + chunk] for i in range(0, len(rest), chunk)):
        for w, part in enumerate(refined_sums(loop, alpha[some], beta[some], signal)):
            sums[w, some] = loop.seen(law[some], np.swapaxes(loop.seen(law[some], part), 1, 2))
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
        # poles are rounded by 1e-16 and more, and count by 1/(1 - ratio); modes that cancel magnify that
        size, slowness = np.abs(seen), np.abs(once)
        gross = ((size @ slowness) * size).sum(axis=2) / np.einsum("nii->ni", sums[0])
        good = (_EPS * slowness.max(axis=(1, 2)) * gross.max(axis=1) < _SKEW) & (np.abs(found.pole) < 1).all(axis=1)
        return sums, np.asarray(good)
