"""Four ways to the limits of stability, each with what is known after so many trials."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.plan.course import Wish
from pipeline.plan.planner import plan_of
from pipeline.plan.verdicts import bracket
from pipeline.records.batch import Floats
from pipeline.studies.planning.rig import Rig

MOST_TRIALS = 150
"""Trials after which a course of the planner is given up."""

RANGE = 1.3
"""Range of stiffness in which bisection and random walls look, relative to the largest limit: they are told it."""

COARSE_STEP, FINE_STEPS = 200.0, 5
"""Of the thesis's procedure for the Falcon [N/m] (6.1.1)."""


@dataclass(frozen=True, eq=False)
class Known:
    """Limits after some trials, NaN where they are not told; and whether the search says that it is done."""

    trials: int
    limit: Floats
    done: bool = False
    unstable: float = float("nan")


def planned(rig: Rig, wish: Wish) -> Iterator[Known]:
    """Yield what is known after each trial that the planner asks for."""
    while True:
        answer = plan_of(rig.course(), wish)
        said = [verdict == "unstable" for verdict, _ in rig.verdicts]
        limit = np.array([point.estimate for point in answer.boundary], dtype=np.float64)
        yield Known(answer.trials_used, limit, answer.done, float(np.mean(said)) if said else 0.0)
        if answer.done or answer.trials_used >= MOST_TRIALS:
            return
        rig.measure(answer.next[0].stiffness, answer.next[0].damping)


def bisected(rig: Rig, dampings: Sequence[float], largest: float, accuracy: float) -> Iterator[Known]:
    """Yield what is known after each round of a bisection at all dampings."""
    low, high = np.zeros(len(dampings)), np.full(len(dampings), RANGE * largest)
    trials = 0
    while (high - low).max() > 2 * accuracy * largest:
        middle = 0.5 * (low + high)
        unstable = rig.try_walls(middle, np.array(dampings)) == "unstable"
        low, high = np.where(unstable, low, middle), np.where(unstable, middle, high)
        trials += len(dampings)
        yield Known(trials, 0.5 * (low + high))


def at_random(rig: Rig, dampings: Sequence[float], largest: float, counts: Sequence[int]) -> Iterator[Known]:
    """Yield what is known after some numbers of random walls."""
    random = np.random.default_rng(rig.seed)
    K, place = random.uniform(0, RANGE * largest, max(counts)), random.integers(len(dampings), size=max(counts))
    verdict = rig.try_walls(K, np.array(dampings)[place])
    for count in counts:
        found = [
            bracket(K[:count][own], verdict[:count][own]) for own in (place[:count] == i for i in range(len(dampings)))
        ]
        yield Known(count, np.array([0.5 * (of.bottom + min(of.top, RANGE * largest)) for of in found]))


def as_in_the_thesis(low: Floats, high: Floats, coarsen: Sequence[int]) -> Iterator[Known]:
    """Yield what the procedure of sec. 6.1.1 tells with steps of so many times its own, from the true limits.

    Coarse steps up to the first unstable wall, then fine ones from the last stable wall on.
    """
    for factor in coarsen:
        coarse = COARSE_STEP * factor
        fine = coarse / FINE_STEPS
        climbed = np.ceil(np.maximum(high, 1.0) / coarse)
        start = (climbed - 1) * coarse
        steps = np.clip(np.ceil((0.5 * (low + high) - start) / fine), 1, FINE_STEPS)
        trials = int((climbed + np.minimum(steps, FINE_STEPS - 1)).sum())
        yield Known(trials, start + (steps - 0.5) * fine)


def error_of(known: Known, ends: tuple[Floats, Floats]) -> float:
    """Return the largest error of the limits that are told, relative to the largest true one; NaN where none is."""
    if not np.isfinite(known.limit).any():
        return float("nan")
    off = np.maximum(np.maximum(ends[0] - known.limit, known.limit - ends[1]), 0.0)
    return float(np.nanmax(off) / max(float(ends[0].max()), 1.0))
