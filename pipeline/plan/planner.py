"""Reads what is stored of an experiment and says which walls to try next."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, floor, inf, log10
from pathlib import Path

import numpy as np

from pipeline.base.disk import if_writable
from pipeline.base.errors import UsageError
from pipeline.base.lock import holder
from pipeline.plan.answer import Area, Best, Limit, Next, Plan
from pipeline.plan.course import Course, Wish, beginning, open_course, stated_loop, wanted_dampings
from pipeline.plan.limits import GENTLE_START, START, Aim, Column, State, order, state
from pipeline.plan.optimum import Foreseen, Search, Target, look_for
from pipeline.plan.requests import Requests, requests_folder, snapped, write_requests

NOTES = {
    "undecided": "not told: verdicts stay undecided between low and high",
    "limit of the tests": "the walls that may be tried end there",
    "beyond the region": "not tried: a softer damping has shown that the stable region ends before",
    "step of the rig": "the rig sets no wall between low and high",
    "from below": "told by the decay of stable walls and by the loop of all logs",
}
"""What is said of a damping that is done for a reason of its own."""

BESIDE = (
    "{} plans this experiment, too: both name the same walls, and each would be measured twice. End one of them, or "
    "give each its own dampings (--dampings)"
)
"""What is said where another planner runs beside a rig."""

NOWHERE = (
    "no damping is left at which the rig sets walls as asked: mend that, and remove the folder `.plan` of the store"
)
"""What is said of a rig that logs another damping each time."""

OPTIMUM_ACCURACY = 0.05
"""By which the best trial may be worse than the best wall, relative."""

SURE = 0.75
"""Chance from which on a verdict is expected."""


def plan(name: str, processed: Path, experiment: str | None = None, wish: Wish | None = None) -> Plan:
    """Return which walls to try next.

    Parameters
    ----------
    name : str
        Device by name, or a device file.
    processed : Path
        Folder of the stored tables; need not be there yet.
    experiment : str, optional
        By default the only one that is stored, else the first of the device file.
    wish : Wish, optional

    Raises
    ------
    DeviceError
        If neither a device file nor a log tells where to start, or the experiment is not known.
    UsageError
        If several experiments are stored and none is named, or a limit leaves nothing to try.
    """
    wish = wish or Wish()
    course = open_course(name, processed, experiment, wish)
    answer = plan_of(course, wish)
    folder = requests_folder(processed, course.name, course.experiment)
    if (other := holder(folder)) is not None:
        return with_remark(answer, BESIDE.format(other))
    if processed.is_dir():
        with if_writable():
            write_requests(folder, asked_of(course, answer))
    return answer


def asked_of(course: Course, answer: Plan) -> Requests:
    """Return what is asked for now, with all that was asked before."""
    return course.requests.asking([(wall.stiffness, wall.damping) for wall in answer.next], course.walls)


OF_THE_STEP = (
    "these limits are those of steps of {:g} {}: if friction is why, a harder push is unstable at softer walls "
    "(pipeline compare says from which stiffness on)"
)


def with_remark(answer: Plan, remark: str) -> Plan:
    """Return a plan of which something more is to be said."""
    return answer.model_copy(update={"remarks": (*answer.remarks, remark)})


def plan_of(course: Course, wish: Wish) -> Plan:
    """Return which walls to try next, from trials that are in memory."""
    dampings = course.requests.reachable(wanted_dampings(course, wish), course.tried.damping)
    if not dampings:
        said = (course.requests.remark(course.rotation) or "", NOWHERE)
        return Plan(
            next=(),
            done=True,
            boundary=(),
            trials_used=len(course.tried),
            trials_expected=len(course.tried),
            remarks=said,
        )
    course = replace(course, tried=snapped(course.tried, dampings))
    aim = aim_of(course, wish, dampings)
    around, start = beginning(course, dampings)
    found = state(course.tried, aim, around, start, course.fitted, course.requests)
    limits = tuple(
        Limit(
            damping=c.damping, estimate=c.estimate, low=c.bracket.low, high=c.bracket.high, note=NOTES.get(c.note, "")
        )
        for c in found.columns
    )
    known = {"boundary": limits, "trials_used": len(course.tried), "area": area_of(found)}
    if wish.goal == "optimum":
        search = _search(course, wish, found, aim)
        # a loop whose parts were not looked for may foretell costs that a lag or a mode forbids
        done = search.done and (course.fitted is None or course.fitted.climbed > 0)
        return Plan(
            next=() if done else _walls_of(search, course, wish, found, aim),
            done=done,
            trials_expected=len(course.tried) + (0 if done else len(search.walls)),
            remarks=_remarks(course, found),
            optimum=_best(search, course, wish),
            **known,
        )
    left = order(found.columns) if not found.done else []
    return Plan(
        next=tuple(_next(found.columns[i], found, aim, course) for i in left[: wish.count]),
        done=found.done,
        trials_expected=len(course.tried) + ceil(found.trials_left),
        remarks=_remarks(course, found),
        **known,
    )


def aim_of(course: Course, wish: Wish, dampings: tuple[float, ...]) -> Aim:
    """Return what is to be known within what limits; errors as of `plan`."""
    aim = Aim(
        dampings,
        wish.accuracy,
        wish.gentle,
        lowest=0.0 if wish.travel == inf else course.step / wish.travel,
        highest=wish.largest_stiffness,
        force=wish.largest_force,
        area=wish.area,
    )
    if aim.lowest >= aim.highest:
        raise UsageError(
            f"a travel of {wish.travel:g} needs K of at least F_0/travel = {aim.lowest:g}, and at most {aim.highest:g} "
            "is allowed: no wall is left to try. Allow more travel or stiffness, or take a smaller step."
        )
    return aim


def area_of(found: State) -> Area | None:
    """Return the area under the limits; None where one of them has no end yet."""
    columns = found.columns
    if len(columns) < 2 or any(c.bracket.high is None or c.estimate is None for c in columns):
        return None
    damping = [c.damping for c in columns]
    ends = (
        [c.estimate or 0.0 for c in columns],
        [c.bracket.bottom for c in columns],
        [c.bracket.top for c in columns],
    )
    value, low, high = (float(np.trapezoid(each, damping)) for each in ends)
    return Area(estimate=value, low=low, high=high)


def _remarks(course: Course, found: State) -> tuple[str, ...]:
    """Return what the plan rests on: contradictions, and whether a loop explains the logs."""
    differ = course.requests.remark(course.rotation)
    said = [] if differ is None else [differ]
    said += [
        f"stable walls lie above unstable ones at B = {c.damping:g}, each tried three times: the lowest limit counts"
        for c in found.columns
        if c.bracket.lasting
    ]
    if not found.forecast.adequate:
        said.append("no loop explains the limits: bisection alone")
    elif course.fitted is not None and course.fitted.climbed and not course.fitted.explains:
        said.append(
            "no one device with spring, lag or vibration mode explains all logs (friction, jitter or clipping would be "
            "why): its limits are off by some "
            f"{found.forecast.misfit:.0%}, and each damping is finished by its verdicts"
        )
        said.append(OF_THE_STEP.format(course.step, "Nm" if course.rotation else "N"))
    return tuple(said)


def rounded(wall: float, width: float) -> float:
    """Return a stiffness with no more digits than its purpose needs.

    Examples
    --------
    >>> rounded(12345.678, 500.0)
    12350.0
    """
    unit = 10.0 ** floor(log10(max(width, 1e-12) / 20))
    return round(wall / unit) * unit


def _next(column: Column, found: State, aim: Aim, course: Course) -> Next:
    assert column.wall is not None, "what is done is not asked for"
    bracket = column.bracket
    wall = column.wall if bracket.again else rounded(column.wall, aim.accuracy * found.largest)
    wall = min(max(wall, aim.lowest), aim.highest)
    K, B = ("Nm/rad", "Nms/rad") if course.rotation else ("N/m", "Ns/m")
    at = f"B = {column.damping:g} {B}"
    if bracket.again:
        said = ", ".join(f"{value:g}" for value in bracket.again)
        why = (
            f"the verdict at {said} {K} hardly stands out from the noise"
            if column.note == "weak"
            else f"logs contradict each other at {at}: stable above unstable between {min(bracket.again):g} and "
            f"{max(bracket.again):g} {K}; measured again first"
        )
        return Next(stiffness=wall, damping=column.damping, expected="undecided", why=why)
    assert column.split is not None, "a wall comes from a split"
    chance = column.split.unstable
    known = f"stable at {bracket.low:g} {K}" if bracket.low is not None else "no stable wall yet"
    known += f", unstable at {bracket.high:g} {K}" if bracket.high is not None else ", no unstable wall yet"
    if bracket.low is None and bracket.high is None:
        known = "no verdict at this damping yet"
    basis = (
        f"limit expected at {rounded(column.estimate, aim.accuracy * found.largest):g} {K}"
        if found.forecast.adequate and column.estimate is not None
        else f"bisection alone: no loop explains the limits (misfit {found.forecast.misfit:.0%})"
    )
    lasting = "; stable walls lie above unstable ones, the lowest limit counts" if bracket.lasting else ""
    expected = "unstable" if chance > SURE else "stable" if chance < 1 - SURE else "undecided"
    if aim.gentle and wall < (column.estimate or 0):
        expected = "stable"
    return Next(stiffness=wall, damping=column.damping, expected=expected, why=f"{known}; {basis}{lasting}")


def _search(course: Course, wish: Wish, found: State, aim: Aim) -> Search:
    """Return the search for the best cost within the limits that are expected."""
    by = None
    if course.fitted is not None:
        by = Foreseen(course.fitted.loop, course.fitted.units, course.fitted.explains)
    elif not len(course.tried):
        by = Foreseen(*stated_loop(course))
    limits = np.minimum(np.maximum(found.forecast.limit, 0.0), aim.highest)
    for i, column in enumerate(found.columns):
        limits[i] = np.clip(limits[i], column.bracket.bottom, min(column.bracket.top, aim.highest))
    if not limits.max() > aim.lowest:
        raise UsageError(f"device {course.name!r}: no wall is expected to be stable, so that none has a cost.")
    if not len(course.tried):
        limits *= GENTLE_START if aim.gentle else START
    target = Target(wish.criterion, np.array(aim.dampings), limits, by, course.requests)
    return look_for(course.tried, target, OPTIMUM_ACCURACY, wish.count)


def _walls_of(search: Search, course: Course, wish: Wish, found: State, aim: Aim) -> tuple[Next, ...]:
    so_far = "no cost yet" if search.best is None else f"best {wish.criterion} {course.tried.cost[search.best]:.4g}"
    return tuple(
        Next(
            stiffness=min(max(rounded(K, aim.accuracy * found.largest), aim.lowest), aim.highest),
            damping=rounded(B, 0.02 * aim.dampings[-1]),
            expected="stable",
            why=f"{so_far}, {cost:.4g} expected here, {search.least:.4g} at the least",
        )
        for K, B, cost in search.walls
    )


def _best(search: Search, course: Course, wish: Wish) -> Best | None:
    if search.best is None:
        return None
    K, B, cost = (
        float(each[search.best]) for each in (course.tried.stiffness, course.tried.damping, course.tried.cost)
    )
    return Best(
        criterion=wish.criterion, stiffness=K, damping=B, cost=cost, expected_cost=search.least, region=search.region
    )
