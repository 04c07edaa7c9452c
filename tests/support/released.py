"""Trials without a step: released from a position or hit, by the controller or by hand; and their truth.

The truth is the spectral radius of the loop by a matrix exponential.
"""

from __future__ import annotations

import numpy as np
from simulated import plant, spectral_radius

from pipeline.records.trials import Trial, Trials

RIGS = {
    "paddle": {"mass": 7e-4, "b": 2e-4, "delay": 1, "T": 5e-3, "size": 0.1, "quantum": 7.67e-4},
    "falcon": {"mass": 0.58, "b": 4.0, "delay": 4, "T": 1e-3, "size": 0.02, "quantum": 1e-5},
    "joint": {"mass": 0.19, "b": 0.5, "delay": 2, "T": 1e-3, "size": -0.05, "quantum": 0.0},
}
GRIDS = {
    "paddle": ([0.2, 0.5, 0.8, 1.1, 4.8, 8.0], 0.01),
    "falcon": ([200.0, 500.0, 900.0, 6000.0, 12000.0], 20.0),
    "joint": ([100.0, 300.0, 600.0, 6000.0, 12000.0], 5.0),
}
WAYS = ("released by the controller", "released by hand", "hit by the controller", "hit by hand")


def walls(rig, way, rows=300):
    """Motions of a rig behind the walls of its grid, stepped with the matrix exponential."""
    (K, damping), begin = GRIDS[rig], 12
    about = RIGS[rig]
    m, T, delay, size, quantum = (about[name] for name in ("mass", "T", "delay", "size", "quantum"))
    A, g = plant(m, about["b"], T)
    K = np.array(K)
    B = np.full(len(K), damping)
    x0 = size if "released" in way else 0.0
    position, command = np.full((len(K), rows), np.nan), np.full((len(K), rows), np.nan)
    count = np.full(len(K), rows)
    for i, k in enumerate(K):
        state, sent, last = np.array([x0, 0.0]), [0.0] * delay, None
        hand = way == "released by hand"
        for row in range(rows):
            x = np.round(state[0] / quantum) * quantum if quantum else state[0]
            last = x if last is None else last
            wall = -k * x - damping * (x - last) / T
            force = wall if row >= begin or hand or "hit" in way else 0.0
            if way == "hit by the controller" and begin <= row < begin + 4:
                force += k * abs(size)
            last = x
            position[i, row], command[i, row] = x, force
            sent.append(force)
            acts = sent.pop(0)
            if row < begin and "released" in way:
                continue  # it is held
            if way == "hit by hand" and row == begin:
                state = state + np.array([0.0, size * np.sqrt(k / m)])
            state = A @ state + g * acts
            if abs(state[0]) > 20 * abs(size):
                count[i] = row + 1
                break
    trials = Trials.of(
        Trial(str(i), K[i], B[i], 0.0, T, np.arange(n) * T, command[i, :n], position[i, :n])
        for i, n in enumerate(count.tolist())
    )
    radius = [
        spectral_radius(k, b, **{n: about[n] for n in ("mass", "b", "delay", "T")}) for k, b in zip(K, B, strict=True)
    ]
    return trials, np.array(radius)
