"""Step responses of devices with friction, spring, constant force, lag and fractional delay, by fine sub-steps.

Independent of the code under test: each sub-step moves under a constant force, and a device whose velocity crosses zero
sticks there unless the force exceeds the friction.
"""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import TrialBatch

EDGE = 20
MOTOR = {"mass": 1.2e-4, "b": 7e-5, "quantum": 2e-4}
"""A small motor, SI; its Coulomb friction is two thirds of the torque that drives it."""

HAPTIC = {"mass": 0.6, "b": 5.0, "quantum": 5e-6}
"""A haptic device of a few hundred grams, SI."""


def record(
    K, B, *, mass, b, step, c=0.0, k=0.0, constant=0.0, delay=3.0, lag=0.0, jitter=False, quantum=0.0, noise=0.0,
    T=1e-3, rows=600, fine=40, seed=0, reverse=None,
):  # fmt: skip
    """Trials of one experiment; ``delay`` in samples, ``lag`` in seconds, ``constant`` acts on the device at all times.

    ``reverse`` is the row at which the external step changes its sign, if it does.
    """
    random = np.random.default_rng(seed)
    K, B, step = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, dtype=float)) for a in (K, B, step)))
    n, h = len(K), T / fine
    late = round(delay * fine)
    # the device rests at first, its constant force held by friction or hand
    x, v, acting = np.zeros(n), np.zeros(n), np.zeros(n)
    moved = np.zeros(n, dtype=bool)
    command, position = np.zeros((n, rows)), np.zeros((n, rows))
    arrive = np.full((n, rows), np.inf)
    force = np.zeros(n)
    for i in range(rows):
        seen = x + noise * random.standard_normal(n)
        position[:, i] = np.round(seen / quantum) * quantum if quantum else seen
        change = (position[:, i] - position[:, max(i - 1, 0)]) / T
        external = step * (i >= EDGE) * (-1 if reverse is not None and i >= reverse else 1)
        command[:, i] = external - K * (position[:, i] - position[:, 0]) - B * change
        extra = random.integers(-1, 2, n) * fine if jitter else 0
        arrive[:, i] = i * fine + late + extra
        for s in range(fine):
            now = i * fine + s
            first = max(i - late // fine - 3, 0)
            there = arrive[:, first : i + 1] <= now
            # commands do not overtake: the latest that has arrived
            newest = first + there.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1)
            force = np.where(there.any(axis=1), command[np.arange(n), newest], 0.0)
            acting = force if lag == 0 else acting + (force - acting) * (1 - np.exp(-h / lag))
            moved |= acting != 0
            push = np.where(moved, acting + constant - k * x, 0.0)
            still = v == 0
            sign = np.where(still, np.sign(push), np.sign(v))
            net = np.where(still & (np.abs(push) <= c), 0.0, push - c * sign)
            decay = np.exp(-b * h / mass)
            fall = (1 - decay) / b if b else h / mass
            after = v * decay + net * fall
            after = np.where(~still & (after * v < 0), 0.0, after)
            x = x + 0.5 * (v + after) * h
            v = after
    full = np.full(n, T)
    return TrialBatch(
        tuple(f"t{i}" for i in range(n)), K.copy(), B.copy(), step.copy(), full, np.full(n, rows),
        np.tile(T * np.arange(rows), (n, 1)), command, position,
    )  # fmt: skip
