"""The command that says which wall to try next: parse, call, print."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from math import inf
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.base.errors import UsageError
from pipeline.base.process import on_stop_signals
from pipeline.shell import console
from pipeline.shell.commands.options import Processed

if TYPE_CHECKING:
    from pipeline.plan.course import Wish
    from pipeline.plan.planner import Plan


LIMITS = {
    "stiffness": "largest_stiffness",
    "damping": "largest_damping",
    "force": "largest_force",
    "travel": "travel",
}
"""Bounds of what is tried, with their names in `Wish`."""


def plan(
    device: Annotated[str, typer.Option("--device", help="Device by name, or a device file (.toml).")],
    experiment: Annotated[
        str | None, typer.Option("--experiment", "-e", help="Experiment; the only stored one where not given.")
    ] = None,
    count: Annotated[int, typer.Option("--next", min=1, help="How many walls to name at once.")] = 1,
    goal: Annotated[
        str, typer.Option("--goal", help="boundary, optimum (of settle_2pct), or a criterion: its best wall.")
    ] = "boundary",
    dampings: Annotated[
        str | None, typer.Option("--dampings", help="Dampings at which limits are wanted, separated by commas.")
    ] = None,
    accuracy: Annotated[
        float, typer.Option("--accuracy", help="Wanted largest error of a limit, in percent of the largest limit.")
    ] = 2.0,
    gentle: Annotated[bool, typer.Option("--gentle", help="Prefer stable walls, approach limits from below.")] = False,
    limit: Annotated[
        list[str] | None,
        typer.Option(
            "--limit",
            metavar="KEY=VALUE",
            help="Largest stiffness or damping to try, travel (of the start from the centre) or force (no wall stiffer "
            "than one whose command exceeded it); may be given several times.",
        ),
    ] = None,
    processed: Processed = Path("processed"),
    watch: Annotated[
        list[Path] | None, typer.Option("--watch", help="Folder in which logs arrive: ingest them, plan after each.")
    ] = None,
    profile: Annotated[
        str | None, typer.Option("--profile", help="Log profile by name, or a profile file (.toml), for --watch.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document; with --watch one line each.")
    ] = False,
) -> None:
    """Plan which wall (K, B) to try next, and when to stop.

    Example: pipeline plan --device falcon --experiment 1

    Example: pipeline plan --device falcon --experiment 1 --watch logs --gentle
    """
    from pipeline.plan.course import Wish
    from pipeline.plan.planner import plan as plan_stored
    from pipeline.records.criteria import MEASURED

    criterion = "settle_2pct" if goal in ("boundary", "optimum") else goal
    if criterion not in MEASURED:
        raise UsageError(f"--goal {goal}: expected boundary, optimum or a criterion: {', '.join(MEASURED)}.")
    if not 0 < accuracy < 50:
        raise UsageError(f"--accuracy {accuracy:g}: expected a percentage above 0 and below 50.")
    wish = Wish(
        "boundary" if goal == "boundary" else "optimum",
        criterion,
        count,
        _numbers(dampings),
        accuracy / 100,
        gentle,
        **_limits(limit or ()),
    )
    if watch:
        _watch(watch, device, processed, experiment, wish, profile, as_json)
    else:
        _print(plan_stored(device, processed, experiment, wish), as_json)


def _numbers(text: str | None) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        values = (-1.0,)
    if not all(0 <= value < inf for value in values):
        raise UsageError(f"--dampings {text}: expected numbers of 0 or more, separated by commas, such as 0,20,40.")
    return values


def _limits(given: Sequence[str]) -> dict[str, float]:
    found = {}
    for word in given:
        key, _, value = word.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if key not in LIMITS or not number > 0:
            raise UsageError(f"--limit {word}: expected one of {', '.join(LIMITS)}, = and a number above 0.")
        found[LIMITS[key]] = number
    return found


def _watch(
    folders: list[Path],
    device: str,
    processed: Path,
    experiment: str | None,
    wish: Wish,
    profile: str | None,
    as_json: bool,
) -> None:
    from pipeline.shell.watch_plan import watch_plan

    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"{folder}: no such folder. Give folders in which logs arrive.")
    asked: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        asked.append(number)

    def emit(answer: Plan) -> None:
        _print(answer, as_json, line=True)

    with on_stop_signals(stop):
        watch_plan(
            folders,
            device,
            processed,
            experiment,
            wish,
            profile=profile,
            emit=emit,
            refused=console.note,
            stopped=lambda: bool(asked),
        )


def _print_limits(answer: Plan) -> None:
    """Print what is known of the limits."""
    for limit in answer.boundary:
        value = "not told" if limit.estimate is None else f"{limit.estimate:.5g}"
        ends = "no stable wall" if limit.low is None else f"stable at {limit.low:.5g}"
        ends += ", no unstable wall" if limit.high is None else f", unstable at {limit.high:.5g}"
        console.say(f"B = {limit.damping:g}: limit {value} ({ends}){'; ' + limit.note if limit.note else ''}")


def _print(answer: Plan, as_json: bool, line: bool = False) -> None:
    if as_json and line:
        sys.stdout.write(json.dumps(answer.model_dump(mode="json"), allow_nan=False) + "\n")
    elif as_json:
        console.print_json(answer.model_dump(mode="json"))
    else:
        for wall in answer.next:
            console.say(f"K = {wall.stiffness:g}, B = {wall.damping:g}: expected {wall.expected}. {wall.why}")
        for remark in answer.remarks:
            console.say(remark)
        if (best := answer.optimum) is not None:
            least = "" if best.expected_cost is None else f"; {best.expected_cost:.4g} expected at the least"
            console.say(
                f"best {best.criterion} so far: {best.cost:.4g} at K = {best.stiffness:g}, B = {best.damping:g}{least}"
            )
        if answer.done:
            _print_limits(answer)
        state = "done" if answer.done else f"about {answer.trials_expected} in all"
        console.say(f"{answer.trials_used} trials so far, {state}")
    if line:
        sys.stdout.flush()
