"""Energy costs of a general loop, summed exactly to infinity: as `cost.energy`, for devices with more states."""

from __future__ import annotations

from math import comb

import numpy as np

from pipeline.loop.device_loop import DeviceLoop
from pipeline.records.batch import Floats
from pipeline.theory.cost.doubling import weighted_sums
from pipeline.theory.device.pieces import WEIGHTS, moments, pieces

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
    chunk = max(1, _ENTRIES // loop.states**2)
    for first in range(0, len(alpha), chunk):
        some = slice(first, first + chunk)
        for name, values in zip(names, _energy(loop, alpha[some], beta[some], signal), strict=True):
            result[name][some] = values
    return result


def _energy(loop: DeviceLoop, alpha: Floats, beta: Floats, signal: str) -> list[Floats]:
    free, push, position, velocity = loop.open_loop
    law = -alpha[:, None] * position - beta[:, None] * velocity
    matrix = free + push[:, None] * law[:, None, :]
    sums = weighted_sums(matrix, loop.starts(alpha, signal))
    stiffness, one = alpha + loop.gamma, np.ones_like(alpha)
    potential, kinetic = (one, 1 / stiffness) if signal == "step" else (stiffness, one)
    forms = _forms(loop, law, sums, potential, kinetic)
    # x_{k+1} - x_k of sample k, with weight (k + 1)^w
    move = position @ free - position + (position @ push) * law
    moves = [np.einsum("ni,nij,nj->n", move, part, move) for part in sums]
    stored = [np.einsum("i,nij,j->n", position, part, position) for part in sums]
    sampled = [potential * stored[w] + kinetic * sum(comb(w, i) * moves[i] for i in range(w + 1)) for w in WEIGHTS]
    return [*forms, *sampled]


def _forms(loop: DeviceLoop, law: Floats, sums: tuple[Floats, ...], potential: Floats, kinetic: Floats) -> list[Floats]:
    """Return the sums of the energy between samples, shape (n,) for each weight."""
    p, n = len(loop.device[1]), loop.states
    start = np.broadcast_to(np.eye(p, n), (len(law), p, n))
    result = [np.zeros(len(law)) for _ in WEIGHTS]
    for number, piece in enumerate(pieces(loop)):
        force = law if piece.age == 0 else np.broadcast_to(np.eye(n)[n - loop.oldest_force + piece.age - 1], law.shape)
        rows = np.concatenate([start, force[:, None, :]], axis=1)
        # X_w seen by the piece: small matrices, of which the forms take the trace
        seen = [rows @ part @ np.swapaxes(rows, 1, 2) for part in sums]
        for w in WEIGHTS:
            for i in range(w + 1):  # (k + tau)^w = sum_i binomial(w, i) k^(w-i) tau^i
                place, speed = (np.einsum("ij,nij->n", part[i][number], seen[w - i]) for part in moments(loop))
                result[w] += comb(w, i) * (potential * place + kinetic * speed)
        start = piece.transition @ start + piece.gain[:, None] * force[:, None, :]
    return result
