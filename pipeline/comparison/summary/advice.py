"""Which stiffness and damping to use: stable, good trials far from the limit."""

from __future__ import annotations

import numpy as np

from pipeline.comparison.scores.overlap import MeasuredLimits, measured_limits
from pipeline.comparison.summary.rectangles import (
    FEWEST,
    Rectangle,
    WallTrials,
    best_rectangle,
    levels,
    room_at,
    room_of,
)
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Booleans, Floats
from pipeline.records.findings import Optimum
from pipeline.records.results import STIFFEST, CostRange, ExperimentResult, UsePoint, UseRegion
from pipeline.rendering.labels import criterion_name

PREFERRED = ("settle_2pct", "settle_5pct", "settle_1pct", "energy_step_w1", "energy_step_w0", "energy_step_w2")
"""Criteria by which walls are recommended, the first one that has a cost: how fast a wall comes to rest is what a user
feels. Overshoot alone is no choice: its optimum is a limit, not a best point."""

NARROW = 1.25
"""Least margin of the stability limit over the stiffness of a wall to use: a mass or a delay that is wrong by a quarter
moves the limit that far."""

FAR = 2.0
"""The same where no cost tells how good a wall is: a gain margin of two (6 dB) is the usual one of control."""

CALM = 0.25
"""Most overshoot of a wall to use, that of a damping ratio of 0.4: what swings on farther is no good wall, however
early it happens to stay inside a band."""


def recommended(result: ExperimentResult) -> tuple[str, Optimum] | None:
    """Return criterion and trial of the least cost, or None where no criterion of `PREFERRED` has a cost."""
    return next(((c, result.optimum[c]) for c in PREFERRED if c in result.optimum), None)


def region_to_use(result: ExperimentResult, stages: ExperimentStages) -> tuple[UseRegion | None, str]:
    """Return the walls to use, and why they are none or were not chosen by a cost.

    Parameters
    ----------
    result : ExperimentResult
        With its boundary and optima.
    stages : ExperimentStages

    Notes
    -----
    Usable are stable trials at K > 0 that overshoot by at most `CALM`, as far as that is known. Where too few of them
    have a cost, the stiffest walls at the margin `FAR` are named. The one to set has a cost of its own, its log came to
    rest undisturbed, and no softer wall of its damping is undecided.
    """
    # a limit that nothing bounds from below is none to keep away from: those beside it are
    limits = measured_limits([p for p in result.boundary if p.low is None or p.low > 0])
    if not limits.known.any():
        return None, "no stability limit is known"
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    stable = (stages.verdicts.verdict == "stable") & (K > 0)
    over = stages.sure_cost("overshoot") if "overshoot" in result.optimum else np.zeros_like(K)
    usable = stable & ~(over > CALM)
    clean, finished = _judged(result, stages)
    finished &= ~_above_undecided(K, B, stages.verdicts.verdict == "undecided")
    found, why, region = recommended(result), "no criterion by which walls are chosen has a cost", None
    criterion = found[0] if found else STIFFEST
    if found:
        cost = stages.sure_cost(criterion)
        tested = WallTrials(K, B, cost, np.where(clean, levels(K, B, cost, usable), np.inf), usable, finished)
        region = best_rectangle(tested, limits, NARROW)
        why = "" if region else _too_few(criterion, int((stable & np.isfinite(cost)).sum()), int(stable.sum()))
    if region is None:
        softness = np.where(K > 0, 1 / np.where(K > 0, K, 1.0), np.inf)
        tested = WallTrials(K, B, softness, np.where(usable & clean, softness, np.inf), usable, finished)
        criterion, region = STIFFEST, best_rectangle(tested, limits, FAR)
        if region is None:
            return None, f"{why}; fewer than {FEWEST} stable neighbours lie at half the limit or below"
    return _described(criterion, tested, region, limits, result, stages), why


def _above_undecided(stiffness: Floats, damping: Floats, undecided: Booleans) -> Booleans:
    """Return which trials have an undecided one of K > 0 below them, at the same damping."""
    least = np.full(len(stiffness), np.inf)
    for B in np.unique(damping[undecided]):
        at = damping == B
        least[at] = stiffness[at & undecided & (stiffness > 0)].min(initial=np.inf)
    above: Booleans = stiffness > least
    return above


SPOILT = ("no_step", "travel_limit", "too_short", "saturated", "disturbed")
"""Outcomes of logs that tell nothing of the wall alone."""

STICKS = 2.0
"""Force that friction holds a device at rest against, relative to that of sliding: 1 to 2 in dry contacts."""


def _judged(result: ExperimentResult, stages: ExperimentStages) -> tuple[Booleans, Booleans]:
    """Return which trials have a cost that is the wall's own, and which of them came to rest.

    With friction a device rests elsewhere than at x_0 + F_0/K: as far off as friction holds it, that is no disturbance.
    """
    costs = [np.isfinite(stages.sure_cost(name)) for name in result.optimum]
    known = np.any(costs, axis=0) if costs else np.zeros(len(stages.verdicts.verdict), dtype=np.bool_)
    if not result.outcomes:
        return known, known
    ended, moved = np.array(stages.texts("outcome", "outcome")), np.isfinite(stages.column("outcome", "outcome_row"))
    friction = result.estimates.get("friction")
    holds = STICKS * (friction.high or 0.0) if friction is not None and (friction.low or 0.0) > 0 else 0.0
    apart = stages.column("response", "position_final_measured") - stages.column("response", "position_final_expected")
    held = (ended == "disturbed") & ~moved & (np.abs(apart) * stages.column("response", "stiffness") <= holds)
    return known & (held | ~np.isin(ended, SPOILT)), known & (held | (ended == "settled"))


def _too_few(criterion: str, known: int, stable: int) -> str:
    return f"only {known} of {stable} stable trials have a {criterion_name(criterion)}"


def _described(
    criterion: str,
    tested: WallTrials,
    region: Rectangle,
    limits: MeasuredLimits,
    result: ExperimentResult,
    stages: ExperimentStages,
) -> UseRegion:
    """Return a region with the costs of its trials, and the one of them to set."""
    at = tested.inside(region)
    room, bound = room_of(limits, region)
    rooms = room_at(limits, tested.damping)
    best = tested.favoured(region, rooms)
    costs = {name: stages.sure_cost(name) for name in result.optimum}
    known = {name: cost[at & np.isfinite(cost)] for name, cost in costs.items()}
    return UseRegion(
        criterion=criterion,
        **dict(zip(("stiffness_low", "stiffness_high", "damping_low", "damping_high"), region, strict=True)),
        trials=int(at.sum()),
        costs={name: _range(values) for name, values in known.items() if len(values)},
        margin=room / region[1],
        bound=bound,
        point=UsePoint(
            stiffness=float(tested.stiffness[best]),
            damping=float(tested.damping[best]),
            trial_id=str(stages.texts("response", "trial_id")[best]),
            costs={name: float(cost[best]) for name, cost in costs.items() if np.isfinite(cost[best])},
            margin=float(rooms[best] / tested.stiffness[best]),
        ),
    )


def _range(values: Floats) -> CostRange:
    return CostRange(
        median=float(np.median(values)), low=float(values.min()), high=float(values.max()), trials=len(values)
    )
