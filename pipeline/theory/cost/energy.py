"""Energy costs of the loop's step and impulse response, summed exactly to infinity.

The weighted sums X_w = sum_k k^w z_k z_k' of the loop state follow by doubling the number of samples, so no horizon
is cut; every energy cost is the trace of a small quadratic form with them. For many points or states the few sums that
these forms need come from linear equations instead (`pipeline.theory.cost.lagsums`), much faster.
"""

from __future__ import annotations

from functools import lru_cache, partial
from math import ceil, comb, log2

import numpy as np
from numpy.polynomial.legendre import leggauss

from pipeline.base.errors import ParameterError
from pipeline.loop.device_loop import DeviceLoop
from pipeline.loop.loop import Loop, as_points
from pipeline.loop.plant import flow
from pipeline.records.batch import Floats
from pipeline.theory.cost.doubling import doubled, size, weighted_sums
from pipeline.theory.cost.lagsums import LagSums, lag_sums, one_step
from pipeline.theory.cost.refinement import Sums, refined
from pipeline.theory.device.state_sums import device_energy

_SLOW = 25.0
"""Mean age of the energy [samples], times d + 1, from which on its sums are refined. Radii are then above 0.98 (d = 0)
and rounding, which grows with the age, reaches 1e-12 at the worst plants."""

_ENTRIES = 1 << 18
"""Entries of the matrices that are doubled at a time: of some ten arrays, 20 MB."""

_FEW, _SHORT = 128, 8
"""Points and delay up to which doubling takes less time than the linear equations; both reach 1e-11."""

_NODES = 24
"""Gauss points over each panel of an interval (or part of one); exact to rounding with the limit below, by test."""

_PANEL = 8.0
"""Largest delta times duration of a panel: a faster decay is integrated over panels that halve towards its start."""

WEIGHTS = (0, 1, 2)
"""Weighting exponents w of the energy criteria (5.14)."""


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
        ``energy_<signal>_w0`` to ``_w2`` and the same with ``_discrete`` appended; dimensionless.

    Raises
    ------
    ParameterError
        If alpha + gamma <= 0.

    Notes
    -----
    Continuous: (1/E_0) times the integral of tau^w E(tau), tau in samples, along the exact motion between samples.
    Discrete: (1/E_0) sum_k k^w [(alpha+gamma)/2 (chi_k - chi_inf)^2 + (chi_k - chi_{k-1})^2/2], chi_{-1} = chi_0.

    Source: Hulin 2017, eqs. 5.7, 5.14; discrete form as reproduced from Tables D.2, D.3, D.5 and D.6.
    """
    a, b = as_points(alpha, beta)
    if np.any(a + loop.gamma <= 0):
        raise ParameterError("energy costs need alpha + gamma > 0: without stiffness there is no final position.")
    if isinstance(loop, DeviceLoop):
        return device_energy(loop, a, b, signal)
    result = {f"energy_{signal}_w{w}{suffix}": np.empty(len(a)) for w in WEIGHTS for suffix in ("", "_discrete")}
    rest = np.arange(len(a))
    if len(a) > _FEW or loop.delay > _SHORT:
        sums = lag_sums(loop, a, b, signal)
        result = _energy_of_sums(loop, a, sums, signal)
        rest = np.flatnonzero(~sums.trusted)
    chunk = max(1, _ENTRIES // loop.states**2)
    for some in (rest[i : i + chunk] for i in range(0, len(rest), chunk)):
        for name, values in _energy_by_doubling(loop, a[some], b[some], signal).items():
            result[name][some] = values
    return result


def _scales(stiffness: Floats, signal: str) -> tuple[Floats, Floats]:
    """Factors of e^2 and v^2 in E/E_0."""
    one = np.ones_like(stiffness)
    # deviations of a step are relative to chi_inf, E/E_0 = e^2 + v^2/(alpha + gamma); an impulse starts with v = 1
    return (one, 1 / stiffness) if signal == "step" else (stiffness, one)


def _energy_of_sums(loop: Loop, alpha: Floats, sums: LagSums, signal: str) -> dict[str, Floats]:
    potential, kinetic = _scales(alpha + loop.gamma, signal)
    step = one_step(loop)
    result = {f"energy_{signal}_w{w}": np.zeros(len(alpha)) for w in WEIGHTS}
    offset = 0.0
    for segment, start in zip(loop.segments, step.starts, strict=True):
        moments = _motion_moments(loop.gamma, loop.delta, offset, segment.duration)
        offset += segment.duration
        for w in WEIGHTS:
            # (k + tau)^w = sum_i binomial(w, i) k^(w-i) tau^i
            for i, (place, speed) in enumerate(moments[: w + 1]):
                stored, moving = (sums.form(start.T @ form @ start, w - i) for form in (place, speed))
                result[f"energy_{signal}_w{w}"] += comb(w, i) * (potential * stored + kinetic * moving)
    # chi_{k+1} - chi_k of sample k, with weight (k + 1)^w
    moves = [sums.form(np.outer(step.move, step.move), w) for w in WEIGHTS]
    for w in WEIGHTS:
        move = sum(comb(w, i) * moves[i] for i in range(w + 1))
        result[f"energy_{signal}_w{w}_discrete"] = potential * sums.moments[w, 0, 0] + kinetic * move
    return result


def _energy_by_doubling(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> dict[str, Floats]:
    sums = _sums_of_points(loop, alpha, beta, signal)
    potential, kinetic = _scales(alpha + loop.gamma, signal)
    moments = np.zeros((len(WEIGHTS), *sums[0].shape))
    # chi_{k+1} - chi_k of sample k, with weight (k + 1)^w: a difference of sums would cancel for slow motion
    move = loop.segment_maps(alpha, beta)[-1][0][:, 0].copy()
    move[:, 0] -= 1.0
    offset = 0.0
    for segment, (start, force) in zip(loop.segments, loop.segment_maps(alpha, beta), strict=False):
        rows = np.concatenate([start, force[:, None, :]], axis=1)
        for w, (place, speed) in enumerate(_motion_moments(loop.gamma, loop.delta, offset, segment.duration)):
            form = potential[:, None, None] * place + kinetic[:, None, None] * speed
            moments[w] += np.swapaxes(rows, 1, 2) @ form @ rows
        offset += segment.duration
    result = {}
    for w in WEIGHTS:
        # (k + tau)^w = sum_i binomial(w, i) k^(w-i) tau^i
        parts = [comb(w, i) * np.einsum("nij,nij->n", moments[i], sums[w - i]) for i in range(w + 1)]
        result[f"energy_{signal}_w{w}"] = np.sum(parts, axis=0)
        step = np.sum([comb(w, i) * np.einsum("ni,nij,nj->n", move, sums[i], move) for i in range(w + 1)], axis=0)
        result[f"energy_{signal}_w{w}_discrete"] = potential * sums[w][:, 0, 0] + kinetic * step
    return result


def _sums_of_points(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> Sums:
    matrix = loop.matrix(alpha, beta)
    sums = weighted_sums(matrix, loop.initial(signal))
    slow = np.flatnonzero(size(sums[1]) > _SLOW * (loop.delay + 1) * size(sums[0]))
    if len(slow):
        rough = sums[0][slow], sums[1][slow], sums[2][slow]
        exact = refined(loop, alpha[slow], beta[slow], signal, rough, partial(doubled, matrix[slow]))
        for part, better in zip(sums, exact, strict=True):
            part[slow] = better
    return sums


@lru_cache(maxsize=64)
def _motion_moments(gamma: float, delta: float, offset: float, duration: float) -> tuple[tuple[Floats, Floats], ...]:
    """Integrals of (offset + tau)^w p p' over a segment for w = 0, 1, 2, with p the row of position, then velocity."""
    nodes, weights = leggauss(_NODES)
    halvings = max(0, ceil(log2(delta * duration / _PANEL))) if delta > 0 else 0
    edges = np.append(0.0, duration * 0.5 ** np.arange(halvings, -1, -1.0))
    widths = np.diff(edges)[:, None]
    time = (edges[:-1, None] + 0.5 * widths * (nodes + 1)).ravel()
    weights = (0.5 * widths * weights).ravel()
    motion = flow(gamma, delta, time)
    rows = np.concatenate([motion.transition, motion.gain[..., None]], axis=2)
    result = []
    for w in WEIGHTS:
        weight = weights * (offset + time) ** w
        place, speed = (np.einsum("t,ti,tj->ij", weight, rows[:, part], rows[:, part]) for part in (0, 1))
        result.append((place, speed))
    return tuple(result)
