"""Plan of the next walls for an experiment, based on its stored trials."""

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
from pipeline.records.findings import Record, UndecidedCode, undecided_code

NOTES = {
    "undecided": "verdicts are undecided next to the limit: record longer logs there",
    "limit of the tests": "the bounds permit no further wall",
    "step of the rig": "the rig sets no wall between low and high: it answered each request there by one of the two",
    "stiffest of the rig": "the rig sets no wall above low: it answered each stiffer request by this wall",
    "softest of the rig": "the rig sets no wall below high: it answered each softer request by this wall",
    "no stable wall": "the identified device has no stable wall there",
    "from below": "the limit is estimated from neighbouring stable walls and the identified device",
    "longer": "there is no verdict yet: record longer logs, or larger steps",
}
"""Reasons why a damping is done or has no estimate."""

REMEDIES: dict[UndecidedCode, str] = {
    "no_motion": "Record longer logs after the step, or larger steps.",
    "log_ends": "Record longer logs after the step.",
    "at_limit": "Record longer logs, or walls farther from the limit.",
    "mode_grows": "Record longer logs.",
    "other": "Record steps from rest, and longer logs.",
}
"""Recommended recordings, by the code of the reason for a missing verdict."""

BOTH_DIRECTIONS = (
    "friction cannot be identified from {}, so the next wall is at most twice as stiff as the stiffest stable wall. "
    "Record {}"
)

OPTIMUM_ACCURACY = 0.05
"""Largest relative excess of the best tried cost over the best possible cost."""

SURE = 0.75
"""Threshold for the probability of a verdict. Above it, the verdict is expected."""


Expected = Literal["stable", "unstable", "undecided"]


MOST_MISFIT = 0.2
"""Threshold for the error of the predicted limits, relative to the largest limit. Above it, the limits do not predict
stable walls."""


class PlannedWall(Record):
    """A wall to try: K [N/m, Nm/rad], B [Ns/m, Nms/rad], the expected verdict, and the reason."""

    stiffness: float
    damping: float
    expected: Expected
    why: str


class PlannedLimit(Record):
    """Limit of stability at a damping [N/m, Nm/rad].

    ``low`` and ``high`` are the stiffest stable and the softest unstable wall according to verdicts, or None if there
    is none. ``estimate`` lies between them. It is None if no trial at this damping is stable or unstable. It is also
    None if only one end is known, no device predicts the limit, and a wall remains to be tried. ``note`` is a remark on
    this damping.
    """

    damping: float
    estimate: float | None
    low: float | None
    high: float | None
    note: str = ""


class BestWall(Record):
    """Best trial so far by a criterion, the lowest cost predicted by the loop identified from all logs, and the region
    around it.

    ``region`` contains the walls whose predicted cost is within the wanted accuracy of the lowest cost: smallest and
    largest stiffness, then smallest and largest damping. It is None if no loop predicts the cost.
    """

    criterion: str
    stiffness: float
    damping: float
    cost: float
    expected_cost: float | None
    region: tuple[float, float, float, float] | None


class Plan(Record):
    """A plan: the next walls, whether the campaign is done, the limits so far, and the numbers of trials.

    ``remarks`` are sentences on the basis of the plan. As long as the plan uses the limits of the device file,
    ``left_out`` names the parts of the file that these limits do not include.
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
        """Return the plan as lines of text, with walls, remarks, the best trial so far, and the limits."""
        lines = [f"K = {w.stiffness:g}, B = {w.damping:g}: expected {w.expected}. {w.why}" for w in self.next]
        lines += self.remarks
        if self.left_out:
            lines.append(f"not included in linear theory: {', '.join(self.left_out)}")
        if (best := self.optimum) is not None:
            least = "" if best.expected_cost is None else f"; lowest expected cost {best.expected_cost:.4g}"
            place = f"K = {best.stiffness:g}, B = {best.damping:g}"
            lines.append(f"best {best.criterion} so far: {best.cost:.4g} at {place}{least}")
        for limit in self.boundary if self.done else ():
            value = "unknown" if limit.estimate is None else f"{limit.estimate:.5g}"
            ends = "no stable wall" if limit.low is None else f"stable at {limit.low:.5g}"
            ends += ", no unstable wall" if limit.high is None else f", unstable at {limit.high:.5g}"
            lines.append(f"B = {limit.damping:g}: limit {value} ({ends}){'; ' + limit.note if limit.note else ''}")
        total = "done" if self.done else f"about {self.trials_expected} in total"
        return "\n".join([*lines, f"{self.trials_used} trials so far, {total}"])


def plan(
    name: str,
    processed: Path,
    experiment: str | None = None,
    options: PlanOptions | None = None,
    *,
    remembered: bool = False,
) -> Plan:
    """Return the plan with the walls to try next.

    Parameters
    ----------
    name : str
        Name of the device, or a device file.
    processed : Path
        Folder of the stored tables. It need not exist.
    experiment : str, optional
        By default, the stored experiment if there is exactly one, or the first of the device file if none is stored.
    options : PlanOptions, optional
    remembered : bool
        Whether to store the walls, so that the next plan can compare them with those that the rig set.

    Raises
    ------
    DeviceError
        If neither a device file nor a log gives an initial range, or the experiment is unknown.
    UsageError
        If several experiments are stored and none is named, or the bounds exclude every wall.
    """
    options = options or PlanOptions()
    campaign = open_campaign(name, processed, experiment, options)
    answer = plan_of(campaign, options)
    if remembered:
        remember(answer, campaign, processed)
    return answer


def remember(answer: Plan, campaign: Campaign, processed: Path) -> None:
    """Store the requested walls with the results of an experiment, if the experiment has trials."""
    if len(campaign.tried) or campaign.free:
        requested = [(wall.stiffness, wall.damping) for wall in answer.next]
        store_requests(processed, campaign.name, campaign.experiment, requested, campaign.walls, campaign.answers)


OF_THE_STEP = (
    "these limits are valid for steps of {:g} {}: if friction raises the limits, larger steps are unstable at softer "
    "walls (`pipeline compare` states their stiffness)"
)


def plan_of(campaign: Campaign, options: PlanOptions) -> Plan:
    """Return the walls to try next, for trials in memory."""
    dampings, used = wanted_dampings(campaign, options), len(campaign.tried)
    campaign = replace(campaign, tried=snapped(campaign.tried, dampings))
    forecast = forecast_of(campaign, dampings)
    if forecast is None and not used:
        raise DeviceError(
            f"device {campaign.name!r}: {campaign.unknown.rstrip('.') or 'it has no logs'}; {RANGE_NEEDED}."
        )
    rig = range_of(campaign.answers)
    goal = aim_of(campaign, options, dampings, forecast, rig)
    found = plan_state(campaign.tried, goal, forecast, campaign.trial_s, rig)
    done, best, more = found.done, None, ceil(sum(column.left for column in found.columns))
    left = order(found.columns)
    if not used:
        # If no stable wall is predicted, wait for the device identified at other dampings.
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
    """Return parts that the limits of the file do not include, or () if logs identify a device."""
    if campaign.found is not None or campaign.device is None or campaign.of_file is None:
        return ()
    return campaign.device.loop_for(campaign.of_file).left_out


def _limit(column: DampingState, *, blind: bool) -> PlannedLimit:
    """Return the current limit. If ``blind``, no device predicts the limit, so both ends are required."""
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
    """Return the goal and its bounds. The errors are those of `plan`.

    As long as the logs do not identify a device reliably, walls are at most a few times as stiff as stable walls.
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
            f"a travel of {options.travel:g} needs K of at least F_0/travel = {goal.lowest:g}, but at most "
            f"{goal.highest:g} is allowed. Allow more travel or stiffness, or a smaller step."
        )
    return goal


def _remarks(campaign: Campaign, found: PlanState, goal: PlanGoal) -> tuple[str, ...]:
    """Return remarks on the basis of the plan: contradictions, missing data, deviations from the device, and
    friction."""
    remarks = [
        f"stable walls lie above unstable walls at B = {c.damping:g}, although each was tried three times: "
        "the lowest limit is used"
        for c in found.columns
        if c.bracket.lasting
    ]
    remarks += _missing(campaign, goal)
    misfit, loop = found.forecast.misfit, campaign.found.loop if campaign.found is not None else None
    if len(campaign.tried) and not misfit <= goal.accuracy:
        off = f"measured limits deviate from those of the identified device by {misfit:.0%} of the largest limit"
        remarks.append(
            f"{off if misfit < inf else 'no device is identified'}, so the limit at each damping is bracketed by "
            "stable and unstable trials, without relying on the model"
        )
    if loop is not None and loop.friction:
        remarks.append(OF_THE_STEP.format(campaign.step, unit_of("force", campaign.motion)))
    return tuple(remarks)


def _missing(campaign: Campaign, goal: PlanGoal) -> list[str]:
    """Return remarks on missing data in the logs, with recommended recordings."""
    remarks = []
    if campaign.undecided:
        reason = commonest(campaign.undecided)
        remedy = REMEDIES[undecided_code(reason)]
        count = f"{len(campaign.undecided)} of {counted(len(campaign.tried), 'trial')}"
        remarks.append(f"no verdict in {count}: {reason}. {remedy}")
    if campaign.free and not len(campaign.tried) and campaign.found is not None:
        remarks.append(f"{counted(campaign.free, 'trial')} without a wall identify the device; no wall has been tried")
    if campaign.unknown:
        remarks.append(campaign.unknown[:1].upper() + campaign.unknown[1:])
    elif campaign.found is not None and goal.bold < inf and campaign.found.may_have_friction:
        few, one = campaign.few, campaign.found.directions < 2
        by = listed([*(["so few logs"] if few else []), *(["motion in one direction"] if one else [])])
        record = listed([*(["steps in both directions"] if one else []), *(["more logs"] if few else [])])
        if by:
            remarks.append(BOTH_DIRECTIONS.format(by, record) + ".")
    return remarks


def _answered(campaign: Campaign, rig: RigRange | None) -> list[str]:
    """Return remarks on the last wall that the rig set in place of a requested wall, and on the effect on the plan."""
    off = [answer for answer in campaign.answers if answer.stiffness_off or answer.damping_off]
    if not off:
        return []
    K, B = unit_of("stiffness", campaign.motion), unit_of("damping", campaign.motion)
    last, count = off[-1], f"{len(off)} of {counted(len(campaign.answers), 'wall')} so far"
    sets = {
        "K": (last.stiffness_off, f"{last.asked[0]:g} {K}", f"{last.got[0]:g} {K}"),
        "B": (last.damping_off, f"{last.asked[1]:g} {B}", f"{last.got[1]:g} {B}"),
    }
    requested = ", ".join(f"{name} = {one}" for name, (_, one, _) in sets.items())
    got = ", ".join(f"{name} = {other}" for name, (differs, _, other) in sets.items() if differs)
    remarks = [f"requested {requested}, the rig set {got} (deviating walls: {count})"]
    if rig is None:
        return remarks
    steps = sorted({grid.step for grid in rig.grids})
    if steps and rig.several:
        least = f"multiples of {steps[0]:g} {K}"
        remarks.append(
            f"the rig sets {least}"
            + (", or of a larger step" if len(steps) > 1 else "")
            + "; the next walls are such multiples"
        )
    if rig.factor != 1:
        remarks.append(f"the rig sets {rig.factor:g} times the requested K; next walls are divided by this factor")
    if rig.highest < inf:
        remarks.append(f"the rig limits K to at most {rig.highest:g} {K}")
    if rig.lowest > 0:
        remarks.append(f"the rig limits K to at least {rig.lowest:g} {K}")
    return remarks


def rounded_down(value: float, width: float) -> float:
    """Return a stiffness rounded down to the digits that its purpose needs.

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
    """Return a stiffness rounded to the digits that its purpose needs.

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
    assert column.wall is not None, "a damping that is done has no next wall"
    bracket = column.bracket
    if rig is not None:
        wall = rig.repeated(column.wall) if column.split is None else column.wall
        if not any(grid.holds(wall) for grid in rig.grids):
            # The rig may set walls between the more coarsely rounded values.
            wall = rounded_down(wall, 0.01 * goal.accuracy * found.largest)
    else:
        wall = column.wall if column.split is None else rounded_down(column.wall, goal.accuracy * found.largest)
        wall = min(max(wall, goal.lowest), goal.highest)
    K, B = unit_of("stiffness", campaign.motion), unit_of("damping", campaign.motion)
    at = f"B = {column.damping:g} {B}"
    if bracket.again:
        if column.note == "weak":
            weak = "verdict is"
            if len(bracket.again) > 1:
                weak = f"verdicts at {listed([f'{value:g}' for value in bracket.again])} {K} are"
            why = f"repeat this wall: the {weak} hardly distinguishable from noise"
        elif bracket.even:
            even = ", ".join(f"{value:g}" for value in bracket.even)
            why = f"logs contradict each other at {at}: equal numbers of stable and unstable trials at {even} {K}; "
            why += "repeat these walls first"
        else:
            why = (
                f"logs contradict each other at {at}: stable walls lie above unstable walls between "
                f"{min(bracket.again):g} and "
            )
            why += f"{max(bracket.again):g} {K}; repeat these walls first"
        return PlannedWall(stiffness=wall, damping=column.damping, expected="undecided", why=why)
    if column.note == "longer":
        still = campaign.unknown.startswith("the position does not change")
        remedy = "with a larger step" if still else f"longer than {campaign.trial_s:.2g} s, or with a larger step"
        why = f"no verdict at this damping yet: repeat this wall, {remedy}"
        return PlannedWall(stiffness=wall, damping=column.damping, expected="undecided", why=why)
    assert column.split is not None, "a damping with a wall has a split"
    chance = column.split.unstable
    known = "no verdict at this damping yet"
    if bracket.low is not None or bracket.high is not None:
        known = f"stable at {bracket.low:g} {K}" if bracket.low is not None else "no stable wall yet"
        known += f", unstable at {bracket.high:g} {K}" if bracket.high is not None else ", no unstable wall yet"
    basis = "bisection, because no device predicts the limit"
    if found.forecast.misfit < inf and column.estimate is not None and column.estimate <= 0:
        basis, chance = "the identified device has no stable wall there", 1.0
    elif found.forecast.misfit < inf and column.estimate is not None:
        basis = f"limit expected at {rounded_down(column.estimate, goal.accuracy * found.largest):g} {K}"
    lasting = "; stable walls lie above unstable walls, so the lowest limit is used" if bracket.lasting else ""
    expected: Expected = "unstable" if chance > SURE else "stable" if chance < 1 - SURE else "undecided"
    # Above stable walls, a verdict is predicted only if all devices consistent with the logs agree.
    place = [each.damping for each in found.columns].index(column.damping)
    limit, lowest = float(found.forecast.limit[place]), float(found.forecast.low[place])
    sure = lowest - max(limit - lowest, 0.0)
    if expected == "stable" and wall > bracket.bottom:
        is_predicted = goal.foresees and found.forecast.misfit <= MOST_MISFIT and wall <= sure
        expected = "stable" if is_predicted else "undecided"
    if column.note == "softer":
        basis = "there are too few logs to try a stiffer wall"
        expected = "stable"
    elif goal.bold < inf and found.forecast.misfit == inf:
        basis = "no device is identified, so K " + (
            f"is at most {goal.bold:g} times that of the stiffest stable wall"
            if bracket.low is not None
            else "stays near the tried walls"
        )
    is_low = wall < min(column.estimate or 0, sure) and found.forecast.misfit <= goal.accuracy
    if goal.gentle and goal.foresees and is_low:
        expected = "stable"
    return PlannedWall(stiffness=wall, damping=column.damping, expected=expected, why=f"{known}; {basis}{lasting}")


def _search(campaign: Campaign, options: PlanOptions, found: PlanState, goal: PlanGoal) -> Search | None:
    """Return the search for the best cost within the expected limits, or None if no limit is known yet."""
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
        raise UsageError(f"device {campaign.name!r}: no wall is expected to be stable, so no wall has a cost.")
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
        why = f"{so_far}; expected cost here {cost:.4g}, lowest expected cost {search.least:.4g}"
        if search.region is None:
            why = f"{so_far}; no device predicts costs"
        # Neighbours may round to the same wall.
        walls.setdefault(
            (stiffness, damping), PlannedWall(stiffness=stiffness, damping=damping, expected="stable", why=why)
        )
    return [*walls.values()]


def _best(search: Search, campaign: Campaign, options: PlanOptions) -> BestWall | None:
    if search.best is None:
        return None
    found = {name: float(getattr(campaign.tried, name)[search.best]) for name in ("stiffness", "damping", "cost")}
    return BestWall(criterion=options.criterion, expected_cost=search.least, region=search.region, **found)
