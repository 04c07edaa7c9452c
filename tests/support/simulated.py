"""Independent simulator of the sampled, delayed loop for tests of the measured branch.

It shares no code with the package: the plant is stepped with scipy's matrix exponential, the delay line is a
list of past commands, and the spectral radius comes from the eigenvalues of the loop matrix built from it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.linalg import expm

from pipeline.records.trials import Trial, Trials

FALCON = {"mass": 0.58, "b": 4.0, "delay": 4, "step": 8.0, "centre": 0.12, "travel": 0.05}
LWR = {"mass": 0.19, "b": 0.0, "delay": 2, "step": 15.0, "centre": 0.0, "travel": 0.3}


@cache
def plant(mass, b, T):
    """Exact transition and input gain of ``m x'' = F - b x'`` over T by the matrix exponential."""
    block = np.zeros((3, 3))
    block[0, 1] = 1.0
    block[1, 1] = -b / mass
    block[1, 2] = 1 / mass
    moved = expm(block * T)
    return moved[:2, :2], moved[:2, 2]


def spectral_radius(K, B, *, mass, b, delay, T=1e-3, poles_at_one=0, **_):
    """Largest eigenvalue modulus of the loop; ``poles_at_one`` poles nearest to z = 1 are left out."""
    A, g = plant(mass, b, T)
    size = 3 + delay
    loop = np.zeros((size, size))
    loop[:2, :2] = A
    loop[2, 0] = 1.0  # x_{k-1}
    now = np.zeros(size)
    now[0], now[2] = -(K + B / T), B / T
    if delay == 0:
        loop[:2] += np.outer(g, now)
    else:
        loop[:2, -1] = g  # the oldest stored command acts now
        loop[3] = now
        for i in range(4, size):
            loop[i, i - 1] = 1.0
    poles = np.linalg.eigvals(loop)
    if poles_at_one:
        poles = poles[np.argsort(abs(poles - 1))[poles_at_one:]]
    return float(abs(poles).max())


def simulate(
    K, B, *, mass, b, delay, step, centre, travel, T=1e-3, rows=400, baseline=20, noise=0.0, quantum=0.0,
    jitter=(), seed=0,
):  # fmt: skip
    """Step responses of every (K, B) pair."""
    K, B = np.atleast_1d(np.asarray(K, float)), np.atleast_1d(np.asarray(B, float))
    n = len(K)
    random = np.random.default_rng(seed)
    A, g = plant(mass, b, T)
    position = np.full((n, rows), np.nan)
    command = np.full((n, rows), np.nan)
    x = centre - np.divide(step, K, out=np.zeros(n), where=K != 0)
    v = np.zeros(n)
    newest = np.full(n, -1)
    last = np.full(n, rows)
    alive = np.ones(n, bool)
    longest = max((delay, *jitter))
    arrivals = np.full((n, rows + longest + 1), -1)
    for k in range(rows):
        seen = x + (noise * random.standard_normal(n) if noise else 0.0)
        if quantum:
            seen = np.round(seen / quantum) * quantum
        position[:, k] = np.where(alive, seen, np.nan)
        before = position[:, max(k - 1, 0)]
        force = step if k >= baseline else 0.0
        command[:, k] = force - K * (position[:, k] - position[:, 0]) - B * (position[:, k] - before) / T
        ended = alive & (abs(x - centre) > travel)
        last[ended] = k + 1
        alive &= ~ended
        lag = random.choice(jitter, n) if jitter else np.full(n, delay)
        slot = (np.arange(n), k + lag)
        arrivals[slot] = np.maximum(arrivals[slot], k)
        newest = np.maximum(newest, arrivals[:, k])
        u = np.where(newest >= 0, command[np.arange(n), np.maximum(newest, 0)], 0.0)
        u = np.where(alive, u, 0.0)
        x, v = A[0, 0] * x + A[0, 1] * v + g[0] * u, A[1, 0] * x + A[1, 1] * v + g[1] * u
    return Trials.of(
        Trial(f"t{i:05d}", K[i], B[i], float(step), T, np.arange(n) * T, command[i, :n], position[i, :n])
        for i, n in enumerate(last.tolist())
    )
