"""Energy costs of a general loop, summed exactly to infinity: as `cost.energy`, for devices with more states.

The energy of a sampling interval is a form of few numbers, the device's state at its start and the wall's forces in
it. The sums of their products follow from the modes; where these cancel, by doubling as `cost.doubling`.
"""

from __future__ import annotations

from math import comb

import numpy as np

from pipeline.loop.device_loop import DeviceLoop
from pipeline.records.batch import Floats
from pipeline.theory.cost.doubling import weighted_sums
from pipeline.theory.device.modes import TOGETHER, Modes, modes
from pipeline.theory.device.pieces import WEIGHTS, energy_forms

_ENTRIES = 1 << 18
"""Entries of the matrices that are doubled at a time: of some ten arrays, 20 MB."""


def device_energy(loop: DeviceLoop, alpha: Floats, beta: Floats, signal: str) -> dict[str, Floats]:
    """Return the energy costs of stable points, named as by `cost.energy.energy_costs`, shape (n,).

    Parameters
    ----------
    loop : DeviceLoop
    alpha, beta : float64, shape (n,)
        Stable, alpha + gamma > 0.
    signal : {"step", "impulse"}

    Notes
    -----
    The energy is that of the sensed position and its velocity, with the mass of all: what the wall sees. A step's E_0
    is that of the thesis; an impulse of unit momentum has E_0 = 1/2.
    """
    names = [f"energy_{signal}_w{w}{suffix}" for suffix in ("", "_discrete") for w in WEIGHTS]
    result = {name: np.empty(len(alpha)) for name in names}
    for first in range(0, len(alpha), TOGETHER):
        some = slice(first, first + TOGETHER)
        for name, values in zip(names, _energy(loop, alpha[some], beta[some], signal), strict=True):
            result[name][some] = values
    return result


def _energy(loop: DeviceLoop, alpha: Floats, beta: Floats, signal: str) -> list[Floats]:
    law = loop.law(alpha, beta)
    sums = _by_modes(loop, law, modes(loop, alpha, beta, signal))
    rest, chunk = np.flatnonzero(np.isnan(sums[0, :, 0, 0])), max(1, _ENTRIES // loop.states**2)
    for some in (rest[i : i + chunk] for i in range(0, len(rest), chunk)):
        sums[:, some] = _by_doubling(loop, alpha[some], beta[some], signal)
    stiffness, one = alpha + loop.gamma, np.ones_like(alpha)
    potential, kinetic = (one, 1 / stiffness) if signal == "step" else (stiffness, one)
    forms = energy_forms(loop)
    traces = sums.reshape(len(WEIGHTS), len(alpha), -1) @ forms.reshape(-1, sums.shape[-1] ** 2).T
    parts = np.moveaxis(traces, 1, 2).reshape(len(WEIGHTS), *forms.shape[:3], len(alpha))
    summed = potential * parts[:, 0] + kinetic * parts[:, 1]
    # (k + tau)^w = sum_i binomial(w, i) k^(w-i) tau^i
    return [sum(comb(w, i) * summed[w - i, kind, i] for i in range(w + 1)) for kind in (0, 1) for w in WEIGHTS]


def _by_modes(loop: DeviceLoop, law: Floats, found: Modes) -> Floats:
    """Return sum_k k^w g_k g_k' of what an interval sees (`DeviceLoop.seen`), shape (3, n, q, q)."""
    seen = loop.seen(law, found.state)
    back = np.swapaxes(seen.conj(), 1, 2)
    ratio = found.pole[:, :, None] * found.pole[:, None, :].conj()
    once = 1 / (1 - ratio)
    first = ratio * once * once
    weights = (once, first, (1 + ratio) * first * once)  # sum_k k^w ratio^k
    return np.stack([((seen @ weight) @ back).real for weight in weights])


def _by_doubling(loop: DeviceLoop, alpha: Floats, beta: Floats, signal: str) -> Floats:
    law = loop.law(alpha, beta)
    sums = weighted_sums(loop.matrix(alpha, beta), loop.starts(alpha, signal))
    return np.stack([loop.seen(law, np.swapaxes(loop.seen(law, part), 1, 2)) for part in sums])
