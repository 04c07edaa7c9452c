"""Simulator of loops that the model does not contain: clipping, one-sided walls, friction, a vibration mode, lag.

It shares no code with the package nor with `simulated`: the device moves in small semi-implicit steps, Coulomb friction
takes speed away but never turns it, the force arrives after a delay that need not be whole.
"""

from __future__ import annotations

import numpy as np

from pipeline.records.trials import Trial, Trials

PARTS = 20
"""Steps of the device in one sampling period."""


def simulate(
    K, B, *, mass=0.58, b=4.0, delay=4.0, step=8.0, T=1e-3, rows=400, baseline=20, noise=0.0, quantum=0.0, limit=np.inf,
    one_sided=False, friction=0.0, mode=None, lag=0.0, force=0.0, seed=0, shift=None, travel=np.inf, truth=False,
    most=np.inf,
):  # fmt: skip
    """Step responses of every (K, B) pair; ``mode`` is (frequency in Hz, damping ratio, far mass) of two masses.

    ``limit`` bounds the command that is logged, ``most`` the force that the drive makes of it.
    """
    K, B = np.broadcast_arrays(np.atleast_1d(np.asarray(K, float)), np.atleast_1d(np.asarray(B, float)))
    n, h, random = len(K), T / PARTS, np.random.default_rng(seed)
    x, v, far, far_v, acting = (np.zeros(n) for _ in range(5))
    hz, ratio, far_mass = mode if mode else (0.0, 0.0, 0.0)
    near = mass - far_mass
    reduced = near * far_mass / mass
    spring, damper = reduced * (2 * np.pi * hz) ** 2, 2 * ratio * reduced * 2 * np.pi * hz
    position, command, true = (np.full((n, rows), np.nan) for _ in range(3))
    offset = np.zeros(n) if shift is None else shift
    sent = np.zeros((rows, n))
    lasted, alive = np.full(n, rows), np.ones(n, bool)
    for k in range(rows):
        seen = offset + x + noise * random.standard_normal(n)
        position[:, k] = np.round(seen / quantum) * quantum if quantum else seen
        true[:, k] = offset + x
        depth = position[:, k] - position[:, 0]
        wall = K * depth + B * (position[:, k] - position[:, max(k - 1, 0)]) / T
        if one_sided:
            wall = np.where(depth * np.sign(step) > 0, wall, 0.0)
        command[:, k] = np.clip((step if k >= baseline else 0.0) - wall, -limit, limit)
        sent[k] = np.clip(command[:, k], -most, most)
        alive &= np.abs(x) <= travel
        lasted = np.where(alive, np.minimum(lasted, rows), np.minimum(lasted, k + 1))
        for part in range(PARTS):
            at = k + part / PARTS - delay
            u = sent[int(np.floor(at + 1e-9))] if at >= -1e-9 else np.zeros(n)
            acting = u if lag == 0 else acting + h / lag * (u - acting)
            inner = spring * (x - far) + damper * (v - far_v)
            v = v + h / near * (acting + force - b * v - inner)
            v = np.sign(v) * np.maximum(np.abs(v) - h * friction / near, 0.0)
            if far_mass:
                far_v = far_v + h / far_mass * inner
                far = far + h * far_v
            v = np.where(alive, v, 0.0)
            x = x + h * v
    trials = Trials.of(
        Trial(f"n{i:04d}", K[i], B[i], float(step), T, np.arange(n) * T, command[i, :n], position[i, :n])
        for i, n in enumerate(lasted.tolist())
    )
    return (trials, true) if truth else trials


def decays(K, B, rows=400, longer=8, part=0.02, **features):
    """Whether each loop comes to rest with an ideal sensor: at rest, or falling, at the end of a much longer log."""
    features = {**features, "noise": 0.0, "quantum": 0.0}
    trials, true = simulate(K, B, rows=longer * rows, truth=True, **features)
    quarter = longer * rows // 4
    sizes = [np.ptp(true[:, to - 2 * rows : to], axis=1) for to in (2 * quarter, 3 * quarter, 4 * quarter)]
    middle, late, end = (np.maximum(size, 1e-300) for size in sizes)
    # one mode falls by the same factor again and again, what tends to a limit cycle does not
    before, after = np.log(late / middle), np.log(end / late)
    evenly = (after < -0.005) & (np.abs(after - before) < 0.3 * np.abs(after))
    rests = (end <= part * np.abs(trials.step) / trials.stiffness) | (end < 0.75 * middle) | evenly
    return (trials.rows == longer * rows) & rests
