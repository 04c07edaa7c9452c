"""Plan of the next walls for an experiment, from its stored trials."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, floor, inf, log10
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.base.errors import DeviceError, UsageError
from pipeline.base.wording import commonest, counted, listed
from pipeline.device.parameters import unit_of
from pipeline.measured.experiment.identified_loop import nominal_loop
from pipeline.planning.campaign import (
    RANGE_NEEDED,
    Campaign,
    PlanOptions,
    forecast_of,
    open_campaign,
    snapped,
    wanted_dampings,
)
from pipeline.planning.cost_search import CostTarget, Search, search_walls
from pipeline.planning.next_wall import BOLDER, GENTLER, DampingState, Forecast, PlanGoal, PlanState, order, plan_state
from pipeline.planning.requests import RigRange, range_of, store_requests
from pipeline.records.findings import Record

NOTES = {
    "undecided": "verdicts stay undecided next to the limit: record longer logs there",
    "limit of the tests": "the walls that may be tried end there",
    "step of the rig": "the rig sets no wall between low and high: it answers by these each time",
    "stiffest of the rig": "the rig sets no wall above low: it answers by that wall each time",
    "softest of the rig": "the rig sets no wall below high: it answers by that wall each time",
    "no stable wall": "by the device that the logs show nothing is stable there",
    "from below": "estimated from the stable walls next to it and the device that all logs show",
    "longer": "no verdict yet: record longer logs, or larger steps",
}
"""Reasons why a damping is done, or has no estimate."""

REMEDIES = (
    ("no visible motion", "Record longer logs after the step, or larger steps."),
    ("the log ends before", "Record longer logs after the step."),
    ("at the limit", "Record longer logs, or walls farther from the limit."),
    ("a mode grows", "Record longer logs."),
)
"""Recommended recordings, by the beginning of the reason for a missing verdict."""

RECORD = "Record steps from rest, and longer logs."
"""Recommended recordings for other reasons."""

BOTH_DIRECTIONS = (
    "friction cannot be separated from the device by {}: the next wall is at most twice as stiff as the stable ones. "
    "Record {}"
)

OPTIMUM_ACCURACY = 0.05
"""Largest relative excess of the best cost tried over the best possible one."""

SURE = 0.75
"""Probability above which a verdict is expected."""


Expected = Literal["stable", "unstable", "undecided"]


MOST_MISFIT = 0.2
"""Error of the predicted limits, relative to the largest, above which no wall is expected to be stable by them."""


class PlannedWall(Record):
    """A wall to try: K [N/m, Nm/rad], B [Ns/m, Nms/rad], the expected verdict, and the reason."""

    stiffness: float
    damping: float
    expected: Expected
    why: str


class PlannedLimit(Record):
    """Limit of stability at a damping [N/m, Nm/rad].

    ``low`` and ``high`` are the stiffest stable and the softest unstable wall by verdicts, None if there is none;
    ``estimate`` lies between them, None without a stable or unstable trial there, or if verdicts do not bracket it.
    ``note`` is a remark on this damping.
    """

    damping: float
    estimate: float | None
    low: float | None
    high: float | None
    note: str = ""


class BestWall(Record):
    """Best trial so far by a criterion, the least cost predicted by the loop of all logs, and the region around it.

    ``region`` is the smallest and largest stiffness, and the smallest and largest damping, of walls whose predicted
    cost is within the wanted accuracy of the least; None if no loop predicts it.
    """

    criterion: str
    stiffness: float
    damping: float
    cost: float
    expected_cost: float | None
    region: tuple[float, float, float, float] | None


class Plan(Record):
    """A plan: the next walls, whether the campaign is done, the limits so far, and the numbers of trials.

    ``remarks`` are sentences on the basis of the plan. ``left_out`` names parts of the device file that its limits do
    not include, as long as the plan uses these limits.
    """

    next: tuple[PlannedWall, ...]
    done: bool
    boundary: tuple[PlannedLimit, ...]
    trials_used: int
    trials_expected: int
    remarks: tuple[str, ...] = ()
    optimum: BestWall | None = None
    left_out: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the plan as lines of text: walls, remarks, the best trial so far, and at the end the limits."""
        lines = [f"K = {w.stiffness:g}, B = {w.damping:g}: expected {w.expected}. {w.why}" for w in self.next]
        lines += self.remarks
        if self.left_out:
            lines.append(f"left out of linear theory: {', '.join(self.left_out)}")
        if (best := self.optimum) is not None:
            least = "" if best.expected_cost is None else f"; {best.expected_cost:.4g} expected at the least"
            place = f"K = {best.stiffness:g}, B = {best.damping:g}"
            lines.append(f"best {best.criterion} so far: {best.cost:.4g} at {place}{least}")
        for limit in self.boundary if self.done else ():
            value = "unknown" if limit.estimate is None else f"{limit.estimate:.5g}"
            ends = "no stable wall" if limit.low is None else f"stable at {limit.low:.5g}"
            ends += ", no unstable wall" if limit.high is None else f", unstable at {limit.high:.5g}"
            lines.append(f"B = {limit.damping:g}: limit {value} ({ends}){'; ' + limit.note if limit.note else ''}")
        total = "done" if self.done else f"about {self.trials_expected} in all"
        return "\n".join([*lines, f"{self.trials_used} trials so far, {total}"])


def plan(
    name: str,
    processed: Path,
    experiment: str | None = None,
    options: PlanOptions | None = None,
    *,
    remembered: bool = False,
) -> Plan:
    """Return which walls to try next.

    Parameters
    ----------
    name : str
        Device by name, or a device file.
    processed : Path
        Folder of the stored tables; may not exist yet.
    experiment : str, optional
        By default the stored experiment if there is exactly one, or the first of the device file if none is stored.
    options : PlanOptions, optional
    remembered : bool
        Whether to store the walls, so that the next plan can compare them with those that the rig set.

    Raises
    ------
    DeviceError
        If neither a device file nor a log gives a range to start from, or the experiment is unknown.
    UsageError
        If several experiments are stored and none is named, or a bound leaves no wall to try.
    """
    options = options or PlanOptions()
    campaign = open_campaign(name, processed, experiment, options)
    answer = plan_of(campaign, options)
    if remembered:
        remember(answer, campaign, processed)
    return answer


def remember(answer: Plan, campaign: Campaign, processed: Path) -> None:
    """Store the requested walls with the results of an experiment that has trials."""
    if len(campaign.tried) or campaign.free:
        asked = [(wall.stiffness, wall.damping) for wall in answer.next]
        store_requests(processed, campaign.name, campaign.experiment, asked, campaign.walls, campaign.answers)


OF_THE_STEP = (
    "these limits are those of steps of {:g} {}: if friction is why, a harder push is unstable at softer walls "
    "(pipeline compare says from which stiffness on)"
)


def plan_of(campaign: Campaign, options: PlanOptions) -> Plan:
    """Return the walls to try next, from trials in memory."""
    dampings, used = wanted_dampings(campaign, options), len(campaign.tried)
    campaign = replace(campaign, tried=snapped(campaign.tried, dampings))
    forecast = forecast_of(campaign, dampings)
    if forecast is None and not used:
        raise DeviceError(
            f"device {campaign.name!r}: {campaign.unknown.rstrip('.') or 'no log of it'}; {RANGE_NEEDED}."
        )
    rig = range_of(campaign.answers)
    goal = aim_of(campaign, options, dampings, forecast, rig)
    found = plan_state(campaign.tried, goal, forecast, campaign.trial_s, rig)
    done, best, more = found.done, None, ceil(sum(column.left for column in found.columns))
    left = order(found.columns)
    if not used:
        # if no stable wall is predicted, wait for the device identified at other dampings
        left = [i for i in left if found.forecast.limit[i] > 0] or left
    following = [_next(found.columns[i], found, goal, campaign, rig) for i in left[: options.count]]
    if options.goal == "optimum" and (search := _search(campaign, options, found, goal)) is not None:
        done, best, more = search.done, _best(search, campaign, options), len(search.walls)
        following = _walls_of(search, campaign, options, found, goal, rig)
    return Plan(
        next=() if done else tuple(following),
        done=done,
        boundary=tuple(_limit(column, blind=found.forecast.misfit == inf) for column in found.columns),
        trials_used=used,
        trials_expected=used + (0 if done else more),
        remarks=(*_remarks(campaign, found, goal), *_answered(campaign, rig)),
        optimum=best,
        left_out=_left_out(campaign),
    )


def _left_out(campaign: Campaign) -> tuple[str, ...]:
    """Return parts that the file's limits leave out; empty if logs identify a device."""
    if campaign.found is not None or campaign.device is None or campaign.of_file is None:
        return ()
    return campaign.device.loop_for(campaign.of_file).left_out


def _limit(column: DampingState, *, blind: bool) -> PlannedLimit:
    """Return the current limit; ``blind`` if no device predicts it, so that it needs both ends."""
    ends, estimate = column.bracket, column.estimate
    verdicts = (ends.low is not None) + (ends.high is not None)
    if column.note != "no stable wall" and (verdicts == 0 or (verdicts == 1 and blind and column.wall is not None)):
        estimate = None
    key = column.note
    if key == "step of the rig" and (ends.high is None or ends.low is None):
        key = "stiffest of the rig" if ends.high is None else "softest of the rig"
    note = NOTES.get(key, "") if column.wall is None or column.note == "longer" else ""
    return PlannedLimit(damping=column.damping, estimate=estimate, low=ends.low, high=ends.high, note=note)


def aim_of(
    campaign: Campaign,
    options: PlanOptions,
    dampings: tuple[float, ...],
    forecast: Forecast | None = None,
    rig: RigRange | None = None,
) -> PlanGoal:
    """Return the goal and its bounds; errors as of `plan`.

    While the logs do not identify a device reliably, walls are at most a few times as stiff as stable ones.
    """
    bold = inf if not len(campaign.tried) or (forecast is not None and campaign.is_sure) else BOLDER
    if bold < inf and forecast is None and options.gentle:
        bold = GENTLER
    goal = PlanGoal(
        dampings,
        options.accuracy,
        options.gentle,
        lowest=max(0.0 if options.travel == inf else campaign.step / options.travel, rig.lowest if rig else 0.0),
        highest=min(options.largest_stiffness, rig.highest if rig else inf),
        force=options.largest_force,
        bold=bold,
        few=bold < inf and campaign.few,
        foresees=not len(campaign.tried) or (not campaign.few and bool((campaign.tried.verdict != "undecided").any())),
    )
    if goal.lowest >= goal.highest:
        raise UsageError(
            f"a travel of {options.travel:g} needs K of at least F_0/travel = {goal.lowest:g}, and at most "
            f"{goal.highest:g} is allowed: no wall is left to try. Allow more travel or stiffness, or a smaller step."
        )
    return goal


def _remarks(campaign: Campaign, found: PlanState, goal: PlanGoal) -> tuple[str, ...]:
    """Return remarks on the basis of the plan: contradictions, and whether a loop explains the logs."""
    said = [
        f"stable walls lie above unstable ones at B = {c.damping:g}, each tried three times: the lowest limit counts"
        for c in found.columns
        if c.bracket.lasting
    ]
    said += _missing(campaign, goal)
    misfit, loop = found.forecast.misfit, campaign.found.loop if campaign.found is not None else None
    if len(campaign.tried) and not misfit <= goal.accuracy:
        off = f"limits lie off those of the found device by {misfit:.0%} of the largest"
        said.append(f"{off if misfit < inf else 'no device is identified'}: each damping is finished by its verdicts")
    if loop is not None and loop.friction:
        said.append(OF_THE_STEP.format(campaign.step, unit_of("force", campaign.motion)))
    return tuple(said)


def _missing(campaign: Campaign, goal: PlanGoal) -> list[str]:
    """Return the deficits of the logs, and what to record."""
    said = []
    if campaign.undecided:
        reason = commonest(campaign.undecided)
        remedy = next((text for begins, text in REMEDIES if reason.startswith(begins)), RECORD)
        count = f"{len(campaign.undecided)} of {counted(len(campaign.tried), 'trial')}"
        said.append(f"no verdict in {count}: {reason}. {remedy}")
    if campaign.free and not len(campaign.tried) and campaign.found is not None:
        said.append(f"{counted(campaign.free, 'trial')} without a wall identify the device; no wall was tried yet")
    if campaign.unknown:
        said.append(campaign.unknown[:1].upper() + campaign.unknown[1:])
    elif campaign.found is not None and goal.bold < inf and campaign.found.may_have_friction:
        few, one = campaign.few, campaign.found.directions < 2
        by = listed([*(["so few logs"] if few else []), *(["motion in one direction"] if one else [])])
        record = listed([*(["steps in both directions"] if one else []), *(["more logs"] if few else [])])
        if by:
            said.append(BOTH_DIRECTIONS.format(by, record) + ".")
    return said


def _answered(campaign: Campaign, rig: RigRange | None) -> list[str]:
    """Return the last wall that the rig set in place of a requested one, and the effect on the next walls."""
    off = [answer for answer in campaign.answers if answer.stiffness_off or answer.damping_off]
    if not off:
        return []
    K, B = unit_of("stiffness", campaign.motion), unit_of("damping", campaign.motion)
    last, count = off[-1], f"{len(off)} of {counted(len(campaign.answers), 'wall')} so far"
    sets = {
        "K": (last.stiffness_off, f"{last.asked[0]:g} {K}", f"{last.got[0]:g} {K}"),
        "B": (last.damping_off, f"{last.asked[1]:g} {B}", f"{last.got[1]:g} {B}"),
    }
    asked = ", ".join(f"{name} = {one}" for name, (_, one, _) in sets.items())
    got = ", ".join(f"{name} = {other}" for name, (differs, _, other) in sets.items() if differs)
    said = [f"asked for {asked}, the rig set {got} (others than asked for: {count})"]
    if rig is None:
        return said
    steps = sorted({grid.step for grid in rig.grids})
    if steps and rig.several:
        least = f"multiples of {steps[0]:g} {K}"
        said.append(f"the rig sets {least}" + (", or of more" if len(steps) > 1 else "") + ": next walls are such")
    if rig.factor != 1:
        said.append(f"the rig sets {rig.factor:g} times the K that it is asked for: next walls are divided by it")
    if rig.highest < inf:
        said.append(f"the rig sets no K above {rig.highest:g} {K}")
    if rig.lowest > 0:
        said.append(f"the rig sets no K below {rig.lowest:g} {K}")
    return said


def rounded_down(value: float, width: float) -> float:
    """Return a stiffness with no more digits than its purpose needs, and never above it.

    Examples
    --------
    >>> rounded_down(12347.678, 500.0), rounded_down(3.29, 500.0)
    (12340.0, 3.2)
    """
    if not value > 0:
        return value
    unit = 10.0 ** floor(log10(max(min(width, value), 1e-300) / 20))
    return float(f"{floor(value / unit * (1 + 1e-12)) * unit:.12g}")


def rounded(wall: float, width: float) -> float:
    """Return a stiffness with no more digits than its purpose needs.

    Examples
    --------
    >>> rounded(12345.678, 500.0)
    12350.0
    """
    unit = 10.0 ** floor(log10(max(width, 1e-12) / 20))
    return float(f"{round(wall / unit) * unit:.12g}")


def _next(
    column: DampingState, found: PlanState, goal: PlanGoal, campaign: Campaign, rig: RigRange | None
) -> PlannedWall:
    assert column.wall is not None, "what is done is not asked for"
    bracket = column.bracket
    if rig is not None:
        wall = rig.repeated(column.wall) if column.split is None else column.wall
        if not any(grid.holds(wall) for grid in rig.grids):
            # a rig may set walls between these digits
            wall = rounded_down(wall, 0.01 * goal.accuracy * found.largest)
    else:
        wall = column.wall if column.split is None else rounded_down(column.wall, goal.accuracy * found.largest)
        wall = min(max(wall, goal.lowest), goal.highest)
    K, B = unit_of("stiffness", campaign.motion), unit_of("damping", campaign.motion)
    at = f"B = {column.damping:g} {B}"
    if bracket.again:
        said = ", ".join(f"{value:g}" for value in bracket.again)
        if column.note == "weak":
            why = f"the verdict at {said} {K} hardly stands out from the noise"
        elif bracket.even:
            even = ", ".join(f"{value:g}" for value in bracket.even)
            why = f"logs contradict each other at {at}: as many stable as unstable trials at {even} {K}; "
            why += "measured again first"
        else:
            why = f"logs contradict each other at {at}: stable above unstable between {min(bracket.again):g} and "
            why += f"{max(bracket.again):g} {K}; measured again first"
        return PlannedWall(stiffness=wall, damping=column.damping, expected="undecided", why=why)
    if column.note == "longer":
        still = campaign.unknown.startswith("the position does not change")
        remedy = "with a larger step" if still else f"longer than {campaign.trial_s:.2g} s, or with a larger step"
        why = f"no verdict at this damping yet: record this wall again, {remedy}"
        return PlannedWall(stiffness=wall, damping=column.damping, expected="undecided", why=why)
    assert column.split is not None, "a wall comes from a split"
    chance = column.split.unstable
    known = "no verdict at this damping yet"
    if bracket.low is not None or bracket.high is not None:
        known = f"stable at {bracket.low:g} {K}" if bracket.low is not None else "no stable wall yet"
        known += f", unstable at {bracket.high:g} {K}" if bracket.high is not None else ", no unstable wall yet"
    basis = "bisection alone: no device predicts the limit"
    if found.forecast.misfit < inf and column.estimate is not None and column.estimate <= 0:
        basis, chance = "the found device has no stable wall there", 1.0
    elif found.forecast.misfit < inf and column.estimate is not None:
        basis = f"limit expected at {rounded_down(column.estimate, goal.accuracy * found.largest):g} {K}"
    lasting = "; stable walls lie above unstable ones, the lowest limit counts" if bracket.lasting else ""
    expected: Expected = "unstable" if chance > SURE else "stable" if chance < 1 - SURE else "undecided"
    # above stable walls a verdict is predicted only if all devices consistent with the logs agree
    place = [each.damping for each in found.columns].index(column.damping)
    limit, lowest = float(found.forecast.limit[place]), float(found.forecast.low[place])
    sure = lowest - max(limit - lowest, 0.0)
    if expected == "stable" and wall > bracket.bottom:
        is_predicted = goal.foresees and found.forecast.misfit <= MOST_MISFIT and wall <= sure
        expected = "stable" if is_predicted else "undecided"
    if column.note == "softer":
        basis = "too few logs for a stiffer wall: record this one"
        expected = "stable"
    elif goal.bold < inf and found.forecast.misfit == inf:
        basis = "no device is identified: " + (
            f"at most {goal.bold:g} times the stiffest stable wall"
            if bracket.low is not None
            else "near what was tried"
        )
    is_low = wall < min(column.estimate or 0, sure) and found.forecast.misfit <= goal.accuracy
    if goal.gentle and goal.foresees and is_low:
        expected = "stable"
    return PlannedWall(stiffness=wall, damping=column.damping, expected=expected, why=f"{known}; {basis}{lasting}")


def _search(campaign: Campaign, options: PlanOptions, found: PlanState, goal: PlanGoal) -> Search | None:
    """Return the search for the best cost within the expected limits; None if no limit is known yet."""
    if found.forecast.misfit == inf and all(column.bracket.low is None for column in found.columns):
        return None
    loop, holds = None, found.forecast.misfit <= goal.accuracy
    if campaign.found is not None and found.forecast.misfit < inf:
        loop, holds = campaign.found.loop, holds and not campaign.found.loop.friction
    elif campaign.device is not None and campaign.of_file is not None:
        loop = nominal_loop(campaign.device.loop_for(campaign.of_file)).loop
    ends = [(column.bracket.bottom, min(column.bracket.top, goal.highest)) for column in found.columns]
    limits = np.clip([column.estimate or 0.0 for column in found.columns], *np.array(ends).T)
    limits = np.minimum(limits, [max(column.most, column.bracket.bottom) for column in found.columns])
    if not limits.max() > goal.lowest:
        if not found.done:
            return None
        raise UsageError(f"device {campaign.name!r}: no wall is expected to be stable, so that none has a cost.")
    target = CostTarget(options.criterion, np.array(goal.dampings), limits, loop, holds)
    off = [answer.asked for answer in campaign.answers if answer.stiffness_off or answer.damping_off]
    return search_walls(campaign.tried, target, OPTIMUM_ACCURACY, options.count, np.array(off).reshape(-1, 2))


def _walls_of(
    search: Search, campaign: Campaign, options: PlanOptions, found: PlanState, goal: PlanGoal, rig: RigRange | None
) -> list[PlannedWall]:
    so_far = (
        "no cost yet" if search.best is None else f"best {options.criterion} {campaign.tried.cost[search.best]:.4g}"
    )
    walls: dict[tuple[float, float], PlannedWall] = {}
    for K, B, cost in search.walls:
        stiffness = min(max(rounded_down(K, goal.accuracy * found.largest), goal.lowest), goal.highest)
        damping = rounded(B, 0.02 * goal.dampings[-1])
        if rig is not None:
            stiffness = rig.wall(stiffness, 0.0, inf, goal.highest) or stiffness
        why = f"{so_far}, {cost:.4g} expected here, {search.least:.4g} at the least"
        if search.region is None:
            why = f"{so_far}; no device predicts costs"
        # neighbours may round to the same wall
        walls.setdefault(
            (stiffness, damping), PlannedWall(stiffness=stiffness, damping=damping, expected="stable", why=why)
        )
    return [*walls.values()]


def _best(search: Search, campaign: Campaign, options: PlanOptions) -> BestWall | None:
    if search.best is None:
        return None
    found = {name: float(getattr(campaign.tried, name)[search.best]) for name in ("stiffness", "damping", "cost")}
    return BestWall(criterion=options.criterion, expected_cost=search.least, region=search.region, **found)
