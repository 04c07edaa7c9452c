"""Goal `optimum`: walls to try until the best cost by a criterion is found, by a local model of the cost."""

from __future__ import annotations

from math import erf

import numpy as np

from pipeline.plan.verdicts import Tried
from pipeline.records.batch import Floats

LENGTHS = (0.12, 0.08)
"""Lengths over which the logarithm of a cost changes, relative to the ranges of B and K."""

NUGGET = 0.03
"""Part of the logarithm of a cost that does not change smoothly: settling times jump from one swing to the next."""

FIRST = 8
"""Trials spread over the stable region before the model is asked."""

SHARES = (0.3, 0.12, 0.55)
"""Share of the limit at which the first walls lie, in turn."""

NO_COST = 1.5
"""Logarithm above the mean of those known at which a trial without a cost counts: it keeps the search away."""


def next_walls(tried: Tried, dampings: Floats, limits: Floats, count: int) -> list[tuple[float, float, float]]:
    """Return walls (K, B) to try and the cost that is expected there, best first.

    Parameters
    ----------
    tried : Tried
        With the costs.
    dampings, limits : float64, shape (n,)
        Dampings B, rising, and the largest stiffness that is thought to be stable at each.
    count : int

    Notes
    -----
    The logarithm of the cost is a Gaussian random function with lengths `LENGTHS`; the wall with the largest expected
    improvement is tried (Jones 1998). Of a batch, each wall is taken as tried with the expected cost.
    """
    reach, stiffest = float(dampings[-1]) or 1.0, max(float(limits.max()), 1e-300)
    B = np.repeat(np.linspace(dampings[0], reach, 45), 40)
    K = np.tile(np.linspace(0.03, 0.95, 40), 45) * np.interp(B, dampings, limits)
    place = np.column_stack([B / reach, K / stiffest])[K > 0]
    B, K = B[K > 0], K[K > 0]
    seen = np.column_stack([tried.damping / reach, tried.stiffness / stiffest])
    known = np.isfinite(tried.cost)
    chosen = []
    value = np.log(np.where(known, tried.cost, 1.0))
    usual = float(value[known].mean()) if known.any() else 0.0
    value = np.where(known, value, usual + NO_COST)
    for _ in range(count):
        if len(seen) < FIRST:
            pick = _spread(seen, place, K, B, dampings, limits, len(seen))
            expected = usual
        else:
            mean, spread = _gaussian(seen, value - usual, place)
            best = (
                float(value[np.isfinite(tried.cost)[: len(value)].nonzero()[0]].min()) - usual if known.any() else 0.0
            )
            z = (best - mean) / spread
            gain = spread * (z * np.array([0.5 * (1 + erf(x / 2**0.5)) for x in z]) + np.exp(-0.5 * z * z) / 2.5066)
            pick, expected = int(np.argmax(gain)), 0.0
            expected = float(mean[pick]) + usual
        chosen.append((float(K[pick]), float(B[pick]), float(np.exp(expected))))
        seen, value = np.vstack([seen, place[pick]]), np.append(value, expected)
    return chosen


def _spread(seen: Floats, place: Floats, K: Floats, B: Floats, dampings: Floats, limits: Floats, number: int) -> int:
    """Return the place farthest from those seen, at a share of the limit that takes turns."""
    share = K / np.maximum(np.interp(B, dampings, limits), 1e-300)
    near = np.flatnonzero(np.abs(share - SHARES[number % len(SHARES)]) < 0.03)
    if not len(seen):
        return int(near[len(near) // 2])
    apart = np.abs(place[near, None, :] - seen[None, :, :]).sum(axis=2).min(axis=1)
    return int(near[np.argmax(apart)])


def _gaussian(seen: Floats, value: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of the random function at places, given what was seen."""
    size = max(float(np.std(value)), 0.1)

    def likeness(first: Floats, second: Floats) -> Floats:
        apart = ((first[:, None, :] - second[None, :, :]) / np.array(LENGTHS)) ** 2
        distance = np.sqrt(3 * apart.sum(axis=2))
        return np.asarray((1 + distance) * np.exp(-distance))

    among = likeness(seen, seen) + np.eye(len(seen)) * (NUGGET / size) ** 2 + 1e-9 * np.eye(len(seen))
    toward = likeness(place, seen)
    gain = np.linalg.solve(among, toward.T).T
    variance = np.maximum(1 - (gain * toward).sum(axis=1), 1e-9)
    return gain @ value, size * np.sqrt(variance)
