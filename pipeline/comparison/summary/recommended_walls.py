"""Recommend stiffness and damping, as rectangles of tested walls around the best walls, far from the stability
limit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.comparison.limits import MeasuredLimits, measured_limits
from pipeline.device.parameters import unit_of
from pipeline.measured.experiment.optimum_place import stable_damping_range
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.findings import NARROW, Optimum
from pipeline.records.results import STIFFEST, CostRange, MeasuredExperiment, UsePoint, UseRegion
from pipeline.records.trials import Booleans, Floats
from pipeline.rendering.labels import at_least, cost_range_text, criterion_name, damping_text, stiffness_text

PREFERRED = ("settle_2pct", "settle_5pct", "settle_1pct", "energy_step_w1", "energy_step_w0", "energy_step_w2")
"""Criteria for recommended walls. The first criterion with a cost is used.

A user feels how fast a wall comes to rest. Overshoot is not used as the only criterion, because its optimum is a limit,
not a point.
"""

FAR = 2.0
"""Gain margin if no cost shows how good a wall is. A margin of two (6 dB) is usual in control."""

CALM = 0.25
"""Largest overshoot of a wall to use, for a damping ratio of 0.4.

A wall with more overshoot is not good, even if its motion settles early.
"""

SPOILT = ("no_step", "travel_limit", "too_short", "saturated", "disturbed")
"""Outcomes of logs that do not characterise the wall alone."""

STICKS = 2.0
"""Ratio of stiction to sliding friction. It is 1 to 2 in dry contacts."""

GOOD = (1.25, 1.5, 2.0)
"""Largest level of a good wall, relative to the lowest level. The first value with a region of `FEWEST` trials is used.

A quarter of a settling time cannot be felt, but valleys of this depth are narrower than the grid of many experiments.
"""

MOSTLY = 0.9
"""Smallest share of good trials in a region."""

NEIGHBOURS = 8
"""Number of neighbours of a trial whose median cost is the trial's level.

The cost of the trial does not count: the best of many trials is partly lucky, and costs selected for being low do not
predict a further trial.
"""

FEWEST = 5
"""Smallest number of trials in a region. A further trial lies outside their range with a probability of one third."""

Rectangle = tuple[float, float, float, float]
"""Smallest and largest stiffness, smallest and largest damping."""


def recommended(result: MeasuredExperiment) -> tuple[str, Optimum] | None:
    """Return criterion and trial of the lowest cost, or None if no criterion of `PREFERRED` has a cost."""
    return next(((c, result.optimum[c]) for c in PREFERRED if c in result.optimum), None)


def region_to_use(
    result: MeasuredExperiment, stages: ExperimentStages, linear: Mapping[float, float] | None = None
) -> tuple[UseRegion | None, str]:
    """Return the walls to use, or None, with the reason why there are none or why the costs of a region did not decide.

    Parameters
    ----------
    result : MeasuredExperiment
    stages : ExperimentStages
    linear : mapping of damping to stiffness, optional
        For a device with friction, the limit for large motions at each tested damping. A wall within the margin
        `NARROW` of it is not recommended.

    Notes
    -----
    Usable trials are stable, have K > 0 and overshoot by at most `CALM`, if that is known. If too few of them have a
    cost, the stiffest walls at the margin `FAR` are recommended. If fewer than `FEWEST` good walls are neighbours, the
    wall with the least cost is recommended alone, if `FEWEST` of its neighbours are stable and calm. The wall to set
    has a cost, its log came to rest undisturbed, and no softer wall of its damping is undecided.
    """
    # Keep away from limits of which only a lower bound is known.
    limits = measured_limits([p for p in result.boundary if p.low is None or p.low > 0])
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    if not limits.known.any():
        return None, _no_limit(K, stages)
    stable = (stages.verdicts.verdict == "stable") & (K > 0)
    over = stages.sure_cost("overshoot") if "overshoot" in result.optimum else np.zeros_like(K)
    usable = calm = stable & ~(over > CALM)
    if linear:
        usable = calm & (np.array([linear[damping] for damping in B.tolist()]) >= NARROW * K)
    clean, finished = _judged(result, stages)
    finished &= ~_above_undecided(K, B, stages.verdicts.verdict == "undecided")
    found, why, region = recommended(result), "no criterion for the choice of walls has a cost", None
    criterion = found[0] if found else STIFFEST
    if found:
        cost = stages.sure_cost(criterion)
        tested = WallTrials(K, B, cost, np.where(clean, levels(K, B, cost, usable), np.inf), usable, finished)
        region = best_rectangle(tested, limits, NARROW)
        why = "" if region else _too_few(criterion, int((stable & np.isfinite(cost)).sum()), int(stable.sum()))
    if region is None:
        softness = np.where(K > 0, 1 / np.where(K > 0, K, 1.0), np.inf)
        stiff = WallTrials(K, B, softness, np.where(usable & clean, softness, np.inf), usable, finished)
        region = best_rectangle(stiff, limits, FAR)
        if region is not None:
            return _described(STIFFEST, stiff, region, limits, result, stages, linear or {}), f"stiffness: {why}"
        if found:
            tested = replace(tested, level=np.where(usable & np.isfinite(cost), cost, np.inf))
            region = _single(tested, limits, calm)
        if region is None:
            lacking = _lacking(limits, K, B, usable & clean, unit_of("stiffness", stages.motion))
            return None, f"{why}; {lacking}"
        why = f"the cost of its trial alone: {why}"
    return _described(criterion, tested, region, limits, result, stages, linear or {}), why


def _single(tested: WallTrials, limits: MeasuredLimits, calm: Booleans) -> Rectangle | None:
    """Return the wall with the lowest cost at the margin `NARROW` that has `FEWEST` stable and calm neighbours."""
    K, B = tested.stiffness, tested.damping
    walls = np.flatnonzero(K > 0)
    around = np.zeros(len(K), dtype=np.int64)
    if len(walls) > NEIGHBOURS:
        around[walls] = calm[walls][_nearest(K[walls], B[walls])].sum(axis=1)
    fit = tested.usable & tested.finished & (around >= FEWEST) & (room_at(limits, B) >= NARROW * K)
    level = np.where(fit, tested.level, np.inf)
    best = int(np.argmin(level))
    return (float(K[best]), float(K[best]), float(B[best]), float(B[best])) if np.isfinite(level[best]) else None


def _lacking(limits: MeasuredLimits, stiffness: Floats, damping: Floats, usable: Booleans, unit: str) -> str:
    """State how many trials are required around a wall, and two walls to test."""
    bound = np.interp(damping, limits.damping[limits.known], limits.limit[limits.known]) / FAR
    count = int((usable & (stiffness <= bound)).sum())
    best = np.flatnonzero(limits.known)[np.argsort(-limits.limit[limits.known])][:2]
    walls = [f"K = {float(f'{limits.limit[i] / FAR:.2g}'):g} {unit}, B = {limits.damping[i]:g}" for i in best]
    there = {0: "there is none", 1: "there is one"}.get(count, f"there are {count}")
    if count >= FEWEST:
        there += f", but no {FEWEST} good trials are neighbours"
    needed = f"a wall needs {FEWEST} stable trials around it, at half the limit or below"
    return f"{needed}; {there}. Record {' and '.join(walls)}"


def _no_limit(stiffness: Floats, stages: ExperimentStages) -> str:
    """Return why no stability limit is known, and the remedy."""
    wall = stiffness > 0
    if not wall.any():
        return "no wall was tried: record trials with K > 0"
    verdict = stages.verdicts.verdict[wall]
    if (verdict == "undecided").all():
        return "no stability limit is known, because all trials are undecided: record longer logs with larger steps"
    if not (verdict == "stable").any():
        return "no stability limit is known, because no trial was stable: record softer walls"
    unstable = int((verdict == "unstable").sum())
    stable = int((verdict == "stable").sum())
    return (
        f"no stability limit is known: it needs a stable and an unstable trial at one damping. There are {stable} "
        f"stable and {unstable} unstable trials. "
        f"Record {'other stiffnesses at their dampings' if unstable else 'stiffer walls'}"
    )


def _above_undecided(stiffness: Floats, damping: Floats, undecided: Booleans) -> Booleans:
    """Return a mask of the trials with a softer undecided trial with K > 0 at the same damping."""
    least = np.full(len(stiffness), np.inf)
    for B in np.unique(damping[undecided]):
        at = damping == B
        least[at] = stiffness[at & undecided & (stiffness > 0)].min(initial=np.inf)
    above: Booleans = stiffness > least
    return above


def _judged(result: MeasuredExperiment, stages: ExperimentStages) -> tuple[Booleans, Booleans]:
    """Return masks of the trials with a cost due to the wall alone, and of those that came to rest at x_0 + F_0/K.

    With friction a device comes to rest elsewhere. An offset within the range of friction is not a disturbance.
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
    return known & (held | ~np.isin(ended, SPOILT)), known & (ended == "settled")


def _too_few(criterion: str, known: int, stable: int) -> str:
    if known == stable:
        return f"no {FEWEST} neighbours have a low {criterion_name(criterion)}"
    return f"only {known} of {stable} stable trials with K > 0 have a {criterion_name(criterion)}"


def _described(
    criterion: str,
    tested: WallTrials,
    region: Rectangle,
    limits: MeasuredLimits,
    result: MeasuredExperiment,
    stages: ExperimentStages,
    linear: Mapping[float, float],
) -> UseRegion:
    """Return a region with the costs of its trials and the recommended wall."""
    at = tested.inside(region)
    room, bound = room_of(limits, region)
    rooms = room_at(limits, tested.damping)
    costs = {name: stages.sure_cost(name) for name in result.optimum}
    best = tested.favoured(region, rooms, costs.get("overshoot", np.full(len(rooms), np.nan)))
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
            damping_range=stable_damping_range(
                result.boundary, float(tested.stiffness[best]), float(tested.damping[best])
            ),
            margin_large_motion=linear[float(tested.damping[best])] / float(tested.stiffness[best]) if linear else None,
            better=_not_chosen(criterion, tested, region, limits, result, stages.texts("response", "trial_id")),
        ),
    )


def _not_chosen(
    criterion: str,
    tested: WallTrials,
    region: Rectangle,
    limits: MeasuredLimits,
    result: MeasuredExperiment,
    trials: Sequence[str],
) -> str:
    """Return the trial with the lowest cost, and why it is not among the recommended walls.

    The text is empty if it is among them, if one of them has the same cost, or if no cost decides.
    """
    least = result.optimum.get(criterion)
    if least is None or not least.cost < np.nanmin(tested.cost[tested.inside(region)]):
        return ""
    K, B, at = least.stiffness, least.damping, trials.index(least.trial_id)
    margin = float(room_at(limits, np.array([B]))[0]) / K
    if margin < NARROW:
        at_least_known = bool(limits.censored[limits.damping == B].any())
        why = (
            "too few stiffer walls were tested there"
            if at_least_known
            else f"its limit may be at {at_least(margin)} × K"
        )
    elif not tested.usable[at]:
        why = "it overshoots, or a harder push is unstable"
    else:
        why = "its neighbours cost more" if tested.finished[at] else "it did not come to rest undisturbed"
    cost = cost_range_text(criterion, least.cost, least.cost)
    return f"{cost} at K = {stiffness_text(K)}, B = {damping_text(B)}: {why}"


def _range(values: Floats) -> CostRange:
    return CostRange(
        median=float(np.median(values)), low=float(values.min()), high=float(values.max()), trials=len(values)
    )


@dataclass(frozen=True, eq=False)
class WallTrials:
    """Stiffness, damping, cost (NaN if missing) and usability of trials, shape (n,) each.

    ``level`` is the cost by which trials are ranked, inf if unknown. A region contains only usable trials, and grows
    from a ``finished`` trial. The wall to set is also that of a finished trial.
    """

    stiffness: Floats
    damping: Floats
    cost: Floats
    level: Floats
    usable: Booleans
    finished: Booleans

    def inside(self, region: Rectangle) -> Booleans:
        """Return a mask of the trials in a rectangle, including its edges."""
        K, B = self.stiffness, self.damping
        return (region[0] <= K) & (region[1] >= K) & (region[2] <= B) & (region[3] >= B)

    def favoured(self, region: Rectangle, room: Floats, overshoot: Floats) -> int:
        """Return the trial of a region with low cost and level.

        If possible, the trial lies between other walls of the region and overshoots by at most the median of the
        region; an unknown overshoot counts as larger. At an edge, a small change of the loop leads out of the region.
        Among equal trials, the trial farthest from the limit is returned.
        """
        at = np.flatnonzero(self.inside(region) & np.isfinite(self.level) & self.finished)
        outer = _at_an_end(self.stiffness[at]).astype(np.int64) + _at_an_end(self.damping[at])
        known = np.isfinite(overshoot[at])
        usual = np.median(overshoot[at][known]) if known.any() else np.inf
        worse = np.maximum(self.cost[at], self.level[at])
        order = np.lexsort([-room[at] / self.stiffness[at], worse, ~(overshoot[at] <= usual), outer])
        return int(at[order[0]])


def _at_an_end(values: Floats) -> Booleans:
    """Return a mask of the smallest and the largest values. All values are ends if none lies between them."""
    inner: Booleans = (values > values.min()) & (values < values.max())
    return ~inner


def levels(stiffness: Floats, damping: Floats, cost: Floats, usable: Booleans) -> Floats:
    """Return the median cost of the `NEIGHBOURS` of each usable trial with a cost, or inf for the other trials."""
    judged = usable & np.isfinite(cost)
    level = np.full(len(cost), np.inf)
    if judged.sum() >= FEWEST:
        level[judged] = np.median(cost[judged][_nearest(stiffness[judged], damping[judged])], axis=1)
    return level


def _nearest(stiffness: Floats, damping: Floats) -> np.ndarray:
    """Return the indices of the `NEIGHBOURS` of each trial, or of all other trials if there are fewer, shape (n,
    count)."""
    from scipy.spatial import cKDTree

    points = np.stack([stiffness, damping], axis=1)
    spread = points.std(axis=0)
    points = points / np.where(spread > 0, spread, 1.0)
    found: np.ndarray = cKDTree(points).query(points, k=range(2, min(NEIGHBOURS + 1, len(points)) + 1))[1]
    return found


def room_at(limits: MeasuredLimits, damping: Floats) -> Floats:
    """Return the lower end of the limit [N/m, Nm/rad] at the given dampings, and 0 where the limit is unknown."""
    known = limits.known
    if not known.any():
        return np.zeros_like(damping)
    found: Floats = np.interp(damping, limits.damping[known], limits.low[known], left=0.0, right=0.0)
    return found


def room_of(limits: MeasuredLimits, region: Rectangle) -> tuple[float, bool]:
    """Return the smallest lower end of the limit over the dampings of a rectangle, and whether it is only a bound."""
    ends, known = np.array(region[2:]), limits.known
    B, low = limits.damping[known], limits.low[known]
    between = (ends[0] <= B) & (ends[1] >= B)
    least = np.concatenate([room_at(limits, ends), low[between]]).min()
    return float(least), bool(limits.censored[known][between].any())


def best_rectangle(tested: WallTrials, limits: MeasuredLimits, margin: float) -> Rectangle | None:
    """Return a rectangle of good walls, or None if there are fewer than `FEWEST` good neighbours.

    Parameters
    ----------
    tested : WallTrials
    limits : MeasuredLimits
    margin : float
        Smallest ratio of the limit's lower end to the stiffness of a wall.

    Notes
    -----
    The rectangle starts at the trial with the lowest level that has the margin. It grows by the next tested stiffness
    or damping, on the side with the lowest median level, as long as all its trials are usable, the share `MOSTLY` of
    them is good, and its stiffest wall has the margin. If it remains too small, the next good trial outside it is the
    start.
    """
    starts = tested.usable & tested.finished & (margin * tested.stiffness <= room_at(limits, tested.damping))
    order = np.argsort(np.where(starts, tested.level, np.inf), kind="stable")
    least = tested.level[order[0]] if starts.any() else np.inf
    for factor in GOOD if np.isfinite(least) else ():
        good = tested.level <= factor * least
        tried = np.zeros(len(good), dtype=bool)
        for start in order[(starts & good)[order]]:
            if tried[start]:
                continue
            region = _grown(tested, good, limits, margin, int(start))
            inside = tested.inside(region)
            if inside.sum() >= FEWEST:
                return region
            tried |= inside
    return None


def _grown(tested: WallTrials, good: Booleans, limits: MeasuredLimits, margin: float, start: int) -> Rectangle:
    """Return the largest rectangle around a trial, none of whose sides can be moved outwards."""
    K, B = float(tested.stiffness[start]), float(tested.damping[start])
    region = (K, K, B, B)

    def holds(side: Rectangle) -> bool:
        at = tested.inside(side)
        kept = margin * side[1] <= room_of(limits, side)[0]
        return kept and bool(tested.usable[at].all()) and float(good[at].mean()) >= MOSTLY

    while sides := [side for side in _wider(region, tested) if holds(side)]:
        region = min(sides, key=lambda side: float(np.median(tested.level[tested.inside(side)])))
    return region


def _wider(region: Rectangle, tested: WallTrials) -> Iterator[Rectangle]:
    """Yield the rectangle, extended on one side at a time to the next tested stiffness or damping."""
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
