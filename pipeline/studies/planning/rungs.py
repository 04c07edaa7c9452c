"""Error of the limits over the number of trials, by each way to them: what the accuracy page shows of the planner."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from pipeline.plan.course import Wish, wanted_dampings
from pipeline.records.accuracy import Rung
from pipeline.studies.planning.best_cost import look_for_best
from pipeline.studies.planning.rig import KINDS, Rig
from pipeline.studies.planning.searches import Known, as_in_the_thesis, at_random, bisected, error_of, planned

QUANTITY = "limits at 12 dampings"

PLANNER = "planner"

AFTER = (6, 12, 18, 24)
"""Trials after which the planner's limits are looked at, before it is done."""

RANDOM = (12, 24, 48, 96, 192, 384)
"""Numbers of random walls."""

COARSENINGS = (8, 4, 2, 1)
"""Steps of the thesis's procedure, in its own."""

COURSES = 2
"""Devices of each kind; 20 of each are run by ``benchmarks/plan.py``."""

FINEST = 0.01
"""Accuracy to which bisection goes on, relative to the largest limit."""


def planning_rungs(
    quick: bool = False, say: Callable[[str], None] = lambda _: None, courses: int = COURSES
) -> Iterator[Rung]:
    """Yield the rungs of the planner, bisection, random walls and the thesis's procedure for each kind of device.

    Parameters
    ----------
    quick : bool
        One ideal device alone.
    say : callable
        Gets the name of each kind when it begins.
    courses : int
        Devices of each kind; errors and trials are medians over them.
    """
    for kind in ("ideal",) if quick else KINDS:
        say(f"{QUANTITY}, {kind} device")
        rigs = [Rig(kind, seed) for seed in range(1 if quick else courses)]
        found = [dict(_ladders(rig)) for rig in rigs]
        for method in found[0]:
            yield from _rungs(kind, method, [each[method] for each in found], rigs[0].case.stated.duration_s)
        if not quick:
            yield _best_cost(kind, courses)


Step = tuple[str, Known, float, float]
"""Setting, what is known, its error, and the time that it took to choose the walls [s]."""


def _ladders(rig: Rig) -> Iterator[tuple[str, list[Step]]]:
    """Yield each method with its steps."""
    dampings = wanted_dampings(rig.course(), Wish())
    ends = rig.truth(dampings)
    largest = float(ends[0].max())
    ways = {
        PLANNER: planned(rig, Wish()),
        "bisection": bisected(rig, dampings, largest, FINEST),
        "random walls": at_random(rig, dampings, largest, RANDOM),
        "thesis's procedure": as_in_the_thesis(*ends, COARSENINGS),
    }
    for name, way in ways.items():
        begin = time.process_time()
        steps = [(known, error_of(known, ends), time.process_time() - begin) for known in way]
        yield name, list(_named(name, steps))


def _named(name: str, steps: Sequence[tuple[Known, float, float]]) -> Iterator[Step]:
    """Yield steps with their settings, of the planner those after `AFTER` trials and the last."""
    for number, (known, error, seconds) in enumerate(steps):
        if name != PLANNER:
            setting = f"step {number + 1}"
            if name.startswith("thesis"):
                setting = "own steps" if COARSENINGS[number] == 1 else f"steps {COARSENINGS[number]} times as long"
            yield setting, known, error, seconds
        elif known.trials in AFTER and number < len(steps) - 1:
            yield f"after {known.trials}", known, error, seconds
    if name == PLANNER:
        yield "done" if steps[-1][0].done else "given up", *steps[-1]


def _rungs(kind: str, method: str, courses: Sequence[Sequence[Step]], trial_seconds: float) -> Iterator[Rung]:
    for setting in dict.fromkeys(step[0] for course in courses for step in course):
        same = [step for course in courses for step in course if step[0] == setting]
        errors = [error for _, _, error, _ in same]
        trials = round(float(np.median([known.trials for _, known, _, _ in same])))
        yield Rung(
            quantity=f"{QUANTITY}, {kind} device",
            method=method,
            setting=setting,
            error=float(np.median(errors)) if np.isfinite(errors).all() else None,
            seconds=float(np.median([seconds for *_, seconds in same])),
            trials=trials,
            device_seconds=trials * trial_seconds,
        )


def _best_cost(kind: str, courses: int) -> Rung:
    """Return the rung of the search for the best settling time."""
    begin = time.process_time()
    found = [look_for_best(Rig(kind, seed)) for seed in range(courses)]
    trials = round(float(np.median([each.trials for each in found])))
    return Rung(
        quantity=f"optimum of settling time: cost, {kind} device",
        method=PLANNER,
        setting="done" if all(each.done for each in found) else "given up",
        error=float(np.median([each.above for each in found])),
        seconds=(time.process_time() - begin) / courses,
        trials=trials,
        device_seconds=trials * Rig(kind, 0).case.stated.duration_s,
    )


def saving(rungs: Sequence[Rung]) -> tuple[str, ...]:
    """Return, for each kind of device, how many trials the planner and the others took to the same accuracy."""
    said = []
    for quantity in dict.fromkeys(r.quantity for r in rungs if r.quantity.startswith(QUANTITY)):
        here = [r for r in rungs if r.quantity == quantity]
        own = next((r for r in here if r.method == PLANNER and r.setting == "done"), None)
        if own is None or own.error is None:
            said.append(f"{quantity}: the planner was not done.")
            continue
        wanted = max(own.error, Wish().accuracy)
        parts = []
        for method in dict.fromkeys(r.method for r in here if r.method != PLANNER):
            enough = [r for r in here if r.method == method and r.error is not None and r.error <= wanted]
            least = min((r.trials or 0 for r in enough), default=None)
            most = max(r.trials or 0 for r in here if r.method == method)
            parts.append(f"{method} {least}" if least is not None else f"{method} more than {most}")
        said.append(
            f"{quantity}: to {wanted:.1%} of the largest the planner takes {own.trials} trials, {', '.join(parts)}."
        )
    return tuple(said)
