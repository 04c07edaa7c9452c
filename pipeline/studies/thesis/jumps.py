"""Jumps of the optimal curves of settling time and overshoot: where, and the dampings on both sides.

Source: Hulin 2017, secs. 5.2.1 and 5.2.2 (Figs. 5.4, 5.6, 5.8, 5.9).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.theory.optimum.curves import best_damping
from pipeline.theory.optimum.optimum import optimal_point
from pipeline.theory.stability.extent import stiffest_point

_SWEEP = 40
"""Stiffnesses behind the optimum at which the curve is looked at first."""

_ZOOM = 17
"""Stiffnesses of a closer look."""

_ROUNDS = 5
"""Rounds of closer looks, sixteenfold each: to 1e-8 of the region."""

_JUMP = 0.02
"""Least change of the best damping, relative to the largest of the curve, that counts as a jump."""


@dataclass(frozen=True)
class Jump:
    """Stiffness of a jump and the best dampings just before and just behind it."""

    alpha: float
    beta_before: float
    beta_behind: float


@lru_cache(maxsize=16)
def jump(loop: Loop, criterion: str, *, largest: bool = False) -> Jump:
    """Return the first jump of the best damping behind the optimum of a criterion, or the largest one.

    Raises
    ------
    ParameterError
        If the curve has none.
    """
    start, end = optimal_point(loop, criterion).alpha, stiffest_point(loop)[0]
    found = best_damping(loop, criterion, start + (end - start) * np.linspace(0.02, 0.85, _SWEEP))
    alpha, beta = found.given[found.found], found.best[found.found]
    steps = np.abs(np.diff(beta))
    least = _JUMP * float(beta.max())
    candidates = np.flatnonzero(steps > least)
    if largest:
        candidates = candidates[np.argsort(-steps[candidates])]
    for at in candidates:
        low, high = float(alpha[at]), float(alpha[at + 1])
        before, behind = float(beta[at]), float(beta[at + 1])
        for _ in range(_ROUNDS):
            if abs(behind - before) <= least:
                break  # steep, but no jump
            finer = best_damping(loop, criterion, np.linspace(low, high, _ZOOM))
            place = int(np.argmax(np.abs(np.diff(finer.best))))
            low, high = float(finer.given[place]), float(finer.given[place + 1])
            before, behind = float(finer.best[place]), float(finer.best[place + 1])
        else:
            return Jump(low, before, behind)
    raise ParameterError(f"{loop}: the best damping for {criterion} does not jump.")


def first_settling_jump(loop: Loop) -> Jump:
    """Return the first jump for the 2 % settling time behind its optimum."""
    return jump(loop, "settle_2pct")


def largest_overshoot_jump(loop: Loop) -> Jump:
    """Return the largest jump for the overshoot outside of the region without."""
    return jump(loop, "overshoot", largest=True)
