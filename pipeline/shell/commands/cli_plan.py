"""The command that says which wall to try next: parse, call, print."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pipeline.base.errors import UsageError
from pipeline.base.process import Ended
from pipeline.shell import console
from pipeline.shell.commands.options import DeviceName, Processed, ProfileFile, listed
from pipeline.shell.console import option

if TYPE_CHECKING:
    from pipeline.plan.planner import Plan

LIMITS = {
    "stiffness": "largest_stiffness",
    "damping": "largest_damping",
    "force": "largest_force",
    "travel": "travel",
}
"""Bounds of what is tried, with their names in `Wish`."""


def plan(
    device: DeviceName,
    experiment: Annotated[str | None, option("--experiment", "Experiment (default: the only one).", "-e")] = None,
    count: Annotated[int, option("--next", "Number of walls to name at once.", min=1)] = 1,
    goal: Annotated[str, option("--goal", "boundary, optimum, or a criterion.")] = "boundary",
    dampings: Annotated[list[str] | None, listed("--dampings", "Dampings B (default: the device's).")] = None,
    gentle: Annotated[bool, option("--gentle", "Prefer stable walls, approach limits from below.")] = False,
    limit: Annotated[list[str] | None, listed("--limit", "Bound on what is tried.", metavar="KEY=VALUE")] = None,
    processed: Processed = Path("processed"),
    watch: Annotated[
        list[Path] | None, option("--watch", "Folder where logs arrive.", exists=True, file_okay=False)
    ] = None,
    profile: ProfileFile = None,
) -> None:
    """Plan which wall (K, B) to try next, and when to stop.

    The goal `optimum` is the best wall by settle_2pct. A limit on force leaves out walls stiffer than one whose command
    exceeded it, one on travel those whose start is further from the centre.

    Example: pipeline plan --device falcon --experiment 1

    Example: pipeline plan --device falcon --experiment 1 --watch logs --gentle
    """
    from pipeline.plan.course import Wish
    from pipeline.plan.planner import plan as plan_stored
    from pipeline.records.criteria import MEASURED

    criterion = "settle_2pct" if goal in ("boundary", "optimum") else goal
    if criterion not in MEASURED:
        raise UsageError(f"--goal {goal}: expected boundary, optimum or a criterion: {', '.join(MEASURED)}.")
    walls = tuple(_number("--dampings", word, 0.0) for word in dampings or ())
    bounds = {}
    for word in limit or ():
        key, _, value = word.partition("=")
        if key not in LIMITS:
            raise UsageError(f"--limit {word}: expected one of {', '.join(LIMITS)}, = and a number.")
        bounds[LIMITS[key]] = _number("--limit", value, 1e-300)
    goal = goal if goal == "boundary" else "optimum"
    wish = Wish(goal, criterion, count, walls, gentle=gentle, **bounds)  # type: ignore[arg-type]
    if not watch:
        answer = plan_stored(device, processed, experiment, wish)
        console.tell(answer.model_dump(mode="json"), lines_of(answer))
        return
    from pipeline.shell.watch import plan_beside

    with suppress(Ended):
        for answer in plan_beside(watch, device, processed, experiment, wish, profile):
            console.tell_line(answer.model_dump(mode="json"), lines_of(answer))


def _number(option: str, text: str, least: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not least <= value < inf:
        kind = "above 0" if least else "of 0 or more"
        raise UsageError(f"{option} {text}: expected a number {kind}.")
    return value


def lines_of(answer: Plan) -> Iterator[str]:
    """Yield a plan as lines: walls, remarks, the best so far, limits at the end."""
    for wall in answer.next:
        yield f"K = {wall.stiffness:g}, B = {wall.damping:g}: expected {wall.expected}. {wall.why}"
    yield from answer.remarks
    if (best := answer.optimum) is not None:
        least = "" if best.expected_cost is None else f"; {best.expected_cost:.4g} expected at the least"
        place = f"K = {best.stiffness:g}, B = {best.damping:g}"
        yield f"best {best.criterion} so far: {best.cost:.4g} at {place}{least}"
    for limit in answer.boundary if answer.done else ():
        value = "unknown" if limit.estimate is None else f"{limit.estimate:.5g}"
        ends = "no stable wall" if limit.low is None else f"stable at {limit.low:.5g}"
        ends += ", no unstable wall" if limit.high is None else f", unstable at {limit.high:.5g}"
        yield f"B = {limit.damping:g}: limit {value} ({ends}){'; ' + limit.note if limit.note else ''}"
    yield f"{answer.trials_used} trials so far, {'done' if answer.done else f'about {answer.trials_expected} in all'}"
