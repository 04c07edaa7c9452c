"""Which stiffness and damping to use: stable, good trials far from the limit, and what is passive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.scores.overlap import MeasuredLimits, measured_limits
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Booleans, Floats
from pipeline.records.findings import Optimum
from pipeline.records.results import CostRange, ExperimentResult, UseRegion
from pipeline.rendering.labels import Units, significant
from pipeline.rendering.report.report_answer import use_facts

PREFERRED = ("settle_2pct", "settle_5pct", "settle_1pct", "energy_step_w1", "energy_step_w0", "energy_step_w2")
"""Criteria by which walls are recommended, the first one that has a cost: how fast a wall comes to rest is what a user
feels. Overshoot alone is no choice: its optimum is a limit, not a best point."""

NARROW = 1.25
"""Least margin of the stability limit over the stiffness of a wall to use: a mass or a delay that is wrong by a quarter
moves the limit that far."""

GOOD = (1.25, 1.5, 2.0)
"""Cost relative to the least level up to which a wall counts as good, the first one with a region of `FEWEST` trials:
nobody feels a quarter of a settling time, but valleys of settling time are narrower than the steps of many courses."""

MOSTLY = 0.9
"""Share of a region's trials that must be good."""

NEIGHBOURS = 8
"""Trials around one whose median cost is its level. Its own cost does not count: the best trial of many is the
luckiest, and a range of costs that were chosen by themselves says nothing of a further trial."""

FEWEST = 5
"""Trials below which no region is named: a further one would lie outside their range with a chance of a third."""

Rectangle = tuple[float, float, float, float]
"""Least and largest stiffness, least and largest damping."""


def recommended(result: ExperimentResult) -> tuple[str, Optimum] | None:
    """Return criterion and trial of the least cost, or None where no criterion of `PREFERRED` has a cost."""
    return next(((c, result.optimum[c]) for c in PREFERRED if c in result.optimum), None)


@dataclass(frozen=True, eq=False)
class WallTrials:
    """Trials at K > 0: stiffness, damping, cost (NaN where there is none) and whether stable, shape (n,) each."""

    stiffness: Floats
    damping: Floats
    cost: Floats
    stable: Booleans

    def inside(self, region: Rectangle) -> Booleans:
        """Tell which trials lie in a rectangle, its edges included."""
        K, B = self.stiffness, self.damping
        return (region[0] <= K) & (region[1] >= K) & (region[2] <= B) & (region[3] >= B)


def region_to_use(result: ExperimentResult, stages: ExperimentStages) -> tuple[UseRegion | None, str]:
    """Return the walls to use, or None and the reason.

    Parameters
    ----------
    result : ExperimentResult
        With its boundary and optima.
    stages : ExperimentStages
    """
    found = recommended(result)
    if found is None:
        return None, "no criterion by which walls are chosen has a cost"
    criterion, limits = found[0], measured_limits(result.boundary)
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    tested = WallTrials(K, B, stages.sure_cost(criterion), (stages.verdicts.verdict == "stable") & (K > 0))
    region, reason = best_rectangle(tested, limits)
    if region is None:
        return None, reason
    at = tested.inside(region)
    costs = {name: stages.sure_cost(name)[at] for name in result.optimum}
    margin, bound = _room(limits, region)
    return UseRegion(
        criterion=criterion,
        **dict(zip(("stiffness_low", "stiffness_high", "damping_low", "damping_high"), region, strict=True)),
        trials=int(at.sum()),
        costs={
            name: _range(values[np.isfinite(values)]) for name, values in costs.items() if np.isfinite(values).any()
        },
        margin=margin / region[1],
        bound=bound,
    ), ""


def best_rectangle(tested: WallTrials, limits: MeasuredLimits) -> tuple[Rectangle | None, str]:
    """Return a rectangle of walls to use, or None and the reason.

    Notes
    -----
    It starts at the trial of the least level (`NEIGHBOURS`) whose stiffness is `NARROW` times below the lower end of
    the limit at its damping, and grows by the next tested stiffness or damping, on the side that leaves most of its
    trials good, while all its trials are stable, `MOSTLY` of them are good, and its stiffest wall keeps the margin.
    """
    known = limits.known
    if not known.any():
        return None, "no stability limit is known"
    room = np.interp(tested.damping, limits.damping[known], limits.low[known], left=0.0, right=0.0)
    judged = tested.stable & np.isfinite(tested.cost)
    safe = judged & (NARROW * tested.stiffness <= room)
    if safe.sum() < FEWEST:
        return None, (
            f"{counted(int(safe.sum()), 'stable trial')} with this cost keep a margin of {NARROW} to the limit, and "
            f"{FEWEST} are needed"
        )
    level = _levels(tested, judged)
    centre = int(np.argmin(np.where(safe, level, np.inf)))
    for factor in GOOD:
        region = _grown(tested, level <= factor * level[centre], limits, centre)
        if tested.inside(region).sum() >= FEWEST:
            return region, ""
    return None, f"fewer than {FEWEST} neighbouring trials have a cost below {GOOD[-1]:g} times the least one"


def _grown(tested: WallTrials, good: Booleans, limits: MeasuredLimits, centre: int) -> Rectangle:
    """Return the rectangle around a trial that no side can be moved out of any more."""
    K, B = float(tested.stiffness[centre]), float(tested.damping[centre])
    region, grows = (K, K, B, B), True
    while grows:
        sides = {side: _share(side, tested, good, limits) for side in _wider(region, tested)}
        grows = max(sides.values(), default=0.0) >= MOSTLY
        region = max(sides, key=lambda side: sides[side]) if grows else region
    return region


def _levels(tested: WallTrials, judged: Booleans) -> Floats:
    """Return the median cost of the neighbours of each judged trial; inf for the others."""
    from scipy.spatial import cKDTree

    points = np.stack([tested.stiffness, tested.damping], axis=1)[judged]
    spread = points.std(axis=0)
    points = points / np.where(spread > 0, spread, 1.0)
    nearest = cKDTree(points).query(points, k=range(2, min(NEIGHBOURS + 1, len(points)) + 1))[1]
    level = np.full(len(judged), np.inf)
    level[judged] = np.median(tested.cost[judged][nearest], axis=1)
    return level


def _wider(region: Rectangle, tested: WallTrials) -> Iterator[Rectangle]:
    """Yield the rectangle with the next trial's stiffness or damping on each side that has one."""
    k0, k1, b0, b1 = region
    K, B = tested.stiffness, tested.damping
    along, across = K[(b0 <= B) & (b1 >= B) & (K > 0)], B[(k0 <= K) & (k1 >= K)]
    if (along < k0).any():
        yield float(along[along < k0].max()), k1, b0, b1
    if (along > k1).any():
        yield k0, float(along[along > k1].min()), b0, b1
    if (across < b0).any():
        yield k0, k1, float(across[across < b0].max()), b1
    if (across > b1).any():
        yield k0, k1, b0, float(across[across > b1].min())


def _share(region: Rectangle, tested: WallTrials, good: Booleans, limits: MeasuredLimits) -> float:
    """Return the share of good trials in a rectangle, 0 where one is not stable or the margin is too small."""
    at = tested.inside(region)
    if not tested.stable[at].all() or _room(limits, region)[0] < NARROW * region[1]:
        return 0.0
    return float(good[at].mean())


def _room(limits: MeasuredLimits, region: Rectangle) -> tuple[float, bool]:
    """Return the least lower end of the limit over the dampings of a rectangle, and whether it is a bound only."""
    ends, known = region[2:], limits.known
    B, low = limits.damping[known], limits.low[known]
    between = (ends[0] <= B) & (ends[1] >= B)
    both = np.concatenate([np.interp(ends, B, low, left=0.0, right=0.0), low[between]])
    return float(both.min()), bool(limits.censored[known][between].any())


def _range(values: Floats) -> CostRange:
    return CostRange(median=float(np.median(values)), low=float(values.min()), high=float(values.max()))


def use_text(result: ExperimentResult, units: Units) -> str:
    """Return the sentence that says which (K, B) to use, what to expect, and how far the limit is; else nothing."""
    use = result.use
    if use is None:
        return ""
    facts = use_facts(use, units)
    first, *costs, last = facts.items()
    told = ", ".join(f"{name} {text}" for name, text in costs)
    return (
        f"Use {first[1]} (experiment {result.experiment}): expect {told}, as in the {use.trials} trials there; the "
        f"limit is {last[1]}."
    )


def passive_choice(result: ExperimentResult, units: Units) -> str:
    """Return the sentence that names the stiffest passive wall, which is stable with every passive hand, or why none.

    Source: Hulin 2017, eqs. 4.6 and 4.11.
    """
    wall, loop = result.passive, result.loop
    if wall is None:
        return f"No passive wall is named: {result.passive_reason}." if result.passive_reason else ""
    reach = ""
    if loop is not None and loop.damping is not None and loop.delay_samples is not None:
        b, d = loop.damping, loop.delay_samples
        # a hand that lets go takes its damping along
        least = f"b = {significant(b.low, 4)} to {significant(b.high, 4)} {units.damping}"
        own = "the device's own damping" if loop.operator else f"all of {least}"
        reach = f" (4.6, for {own} and d = {significant(d.low, 4)} to {significant(d.high, 4)})"
    return (
        f"A wall that is passive, and so stable with every passive hand, has at most K = {wall.stiffness:.4g} "
        f"{units.stiffness} at B = {wall.damping:.4g} {units.damping}{reach}."
    )
