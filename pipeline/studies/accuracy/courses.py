"""How long a course of experiments must be: error of boundary and optimum over the number of trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from pipeline.measured.experiment.aggregate import choose_optimum
from pipeline.measured.experiment.boundary import measured_boundary
from pipeline.measured.experiment.boundary_area import boundary_area
from pipeline.measured.experiment.boundary_band import boundary_band
from pipeline.records.accuracy import Rung
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.records.findings import BoundaryPoint
from pipeline.simulation.course import run_course
from pipeline.simulation.setup import setup_of
from pipeline.studies.accuracy.cost_ladders import complete_energy, settling
from pipeline.studies.accuracy.jitter import jitter_limit
from pipeline.studies.accuracy.names import AREA, LIMITS, nth
from pipeline.studies.accuracy.rungs import best_time
from pipeline.studies.accuracy.truth import Trials, Truth, truth_of
from pipeline.theory.optimum.search import OptimalPoint

COURSES = 5
"""Simulated courses of each size; the error is the largest of them."""

MASS_RANGE, DAMPING_RANGE = 0.15, 0.5
"""Mass and damping of the courses' devices differ from the experiment's by up to this, relative: a grid of dampings
that happens to fit the boundary would otherwise look too good."""

JITTER_POINTS, JITTER_RANGE = 30, 1.3
"""Dampings at which the limit of the jittering loop is read (trapezoids between them err by 0.05 %), and how far it may
reach beyond that of the mean delay, in K and in B: 1.06 and 1.08 times for the Falcon."""

OPTIMA = {
    "optimum of settling time": ("settle_2pct", settling),
    "optimum of energy": ("energy_step_w0", complete_energy),
}
"""Optima that are looked for: their criterion, and what measures it."""

PASSES = {2: "two passes", 1: "one pass"}
"""Passes of a course: the first alone, or also the fine one behind the last stable trial."""


@dataclass(frozen=True)
class Condition:
    """A device and experiment whose courses are simulated.

    Parameters
    ----------
    label : str
        As the page names it.
    device, experiment : str
    jitter : bool
        With the jitter of the experiment. Then theory has no limit, and that of long responses is the truth
        (`jitter`); the devices do not differ.
    optimum : bool
        Whether the optima are looked for.
    damping_range : {"full", "tested"}
        Whether the course goes on until no stable K > 0 is found, or covers the dampings of the thesis.
    coarsenings : tuple of int
        Every how many dampings, and how many stiffness steps in one: 1 is the full course of the thesis.
    """

    label: str
    device: str
    experiment: str
    jitter: bool = False
    optimum: bool = False
    damping_range: Literal["tested", "full"] = "full"
    coarsenings: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12)


CONDITIONS = (
    Condition("Falcon, experiment 1", "falcon", "1", optimum=True),
    Condition("Falcon, experiment 1, with jitter", "falcon", "1", jitter=True),
    # numbers that divide the 40 steps of damping, so that all courses end at B = 40
    Condition("LWR, d = 2, B ≤ 40", "lwr", "delay-2", damping_range="tested", coarsenings=(1, 2, 4, 5, 8, 10)),
)
"""Courses that are simulated. The whole stable region of the LWR would take three times the trials of the thesis."""


def course_rungs(
    condition: Condition,
    coarsenings: Sequence[int] | None = None,
    courses: int = COURSES,
    say: Callable[[str], None] = lambda _: None,
) -> Iterator[Rung]:
    """Yield the rungs of courses from full to coarse: area, limits and, where asked for, optima.

    Parameters
    ----------
    condition : Condition
    coarsenings : sequence of int, optional
        In place of the condition's.
    courses : int
        Courses of each size.
    say : callable
        Gets the name of each size when it begins.

    Notes
    -----
    The area is that from B = 0 to the last damping of the course, held against the exact one up to there. With one
    pass the fine trials of a course are left out.
    """
    truths = _truths(condition, courses)
    reference = None
    if condition.jitter:
        say(f"limit of {condition.label}")
        reference = _jitter_reference(truths[0])
    for coarsen in condition.coarsenings if coarsenings is None else coarsenings:
        say(f"course of {condition.label}, {nth(coarsen, 'step')}")
        found = []
        for seed, truth in enumerate(truths):
            course = _judged(condition, truth, coarsen, seed)
            against = reference or _Reference(truth.area, truth.limit)
            found.append([*_limits(course, against), *(_optima(course) if condition.optimum else ())])
        for same in zip(*found, strict=True):
            yield _rung(condition.label, coarsen, same, truths[0].device.duration_s)


@dataclass(frozen=True)
class _Found:
    """What one course comes to by one method, with the trials and the run time [s] that it took."""

    quantity: str
    method: str
    error: float
    trials: int
    seconds: float


def _rung(label: str, coarsen: int, found: Sequence[_Found], trial_seconds: float) -> Rung:
    """Rung of all courses of one size: their largest error."""
    errors = np.abs([f.error for f in found])
    trials = round(float(np.mean([f.trials for f in found])))
    return Rung(
        quantity=f"{found[0].quantity}, {label}",
        method=found[0].method,
        setting=nth(coarsen, "step"),
        error=float(errors.max()) if np.isfinite(errors).all() else None,
        seconds=float(np.median([f.seconds for f in found])),
        trials=trials,
        device_seconds=trials * trial_seconds,
    )


@dataclass(frozen=True)
class _Reference:
    """True area under the limit up to a damping, and true limit at dampings."""

    area: Callable[[float], float]
    limit: Callable[[Floats], Floats]


def _jitter_reference(truth: Truth) -> _Reference:
    setup = setup_of(truth.device, truth.experiment)
    damping = np.linspace(0.0, JITTER_RANGE * truth.largest_damping, JITTER_POINTS)
    stiffest = JITTER_RANGE * float(truth.limit(damping).max())
    limit = jitter_limit(setup, damping, stiffest)
    area = float(np.trapezoid(limit, damping))
    return _Reference(lambda _: area, lambda at: np.interp(at, damping, limit))


def _truths(condition: Condition, courses: int) -> list[Truth]:
    random = np.random.default_rng(61)
    spread = 0.0 if condition.jitter else 1.0  # the limit of the jittering loop is read for one device
    factors = 1 + spread * random.uniform(-1, 1, (courses, 2)) * (MASS_RANGE, DAMPING_RANGE)
    return [
        truth_of(condition.device, condition.experiment, mass_factor=m, damping_factor=b) for m, b in factors.tolist()
    ]


@dataclass(frozen=True, eq=False)
class _Judged:
    """Trials of a course with verdicts, the pass of each, and the time that judging took [s]."""

    trials: Trials
    passes: Integers
    seconds: float


def _judged(condition: Condition, truth: Truth, coarsen: int, seed: int) -> _Judged:
    course = run_course(
        truth.device,
        condition.experiment,
        seed=seed,
        jitter=None if condition.jitter else (),
        damping_range=condition.damping_range,
        coarsen=coarsen,
    )
    trials, seconds = best_time(lambda: Trials.of(truth, course.batch), 0.0)
    return _Judged(trials, course.passes, seconds)


def _limits(course: _Judged, reference: _Reference) -> Iterator[_Found]:
    """Errors of area and limits by each method with each number of passes."""
    for name, limits in (("growth rates", _rates), ("verdicts", _brackets)):
        for passes, words in PASSES.items():
            inside = course.passes <= passes
            (points, area), seconds = best_time(partial(limits, course.trials, inside), 0.0)
            share = int(inside.sum()), seconds + course.seconds * float(inside.mean())
            error = np.nan if area is None else area / reference.area(points[-1].damping) - 1
            yield _Found(AREA, f"{name}, {words}", error, *share)
            exact = reference.limit(np.array([p.damping for p in points]))
            estimate = np.array([np.nan if p.estimate is None else p.estimate for p in points])
            median = float(np.nanmedian(np.abs(estimate - exact))) / float(exact.max())
            yield _Found(LIMITS, f"{name}, {words}", median, *share)


def _optima(course: _Judged) -> Iterator[_Found]:
    """Errors of cost and place of each optimum with each number of passes."""
    for quantity, (criterion, measure) in OPTIMA.items():
        costs, seconds = best_time(partial(measure, course.trials), 0.0)
        best = course.trials.truth.optimum(criterion)
        for passes, words in PASSES.items():
            inside = course.passes <= passes
            share = int(inside.sum()), (seconds + course.seconds) * float(inside.mean())
            for part, error in _distance(course.trials, costs[criterion], inside, criterion, best).items():
                yield _Found(f"{quantity}: {part}", f"least cost, {words}", error, *share)


def _rates(of: Trials, inside: Booleans) -> tuple[tuple[BoundaryPoint, ...], float | None]:
    """Limits by growth rates, and the area under them."""
    points = boundary_band(
        of.batch.stiffness[inside],
        of.batch.damping[inside],
        of.verdicts.verdict[inside],
        of.verdicts.growth_per_s[inside],
    )
    return points, boundary_area(points).value


def _brackets(of: Trials, inside: Booleans) -> tuple[tuple[BoundaryPoint, ...], float | None]:
    """Limits in the middle between the verdicts, and the area under them."""
    points = measured_boundary(of.batch.stiffness[inside], of.batch.damping[inside], of.verdicts.verdict[inside])
    middle = [None if p.unstable is None else 0.5 * ((p.stable or 0.0) + p.unstable) for p in points]
    points = tuple(p.model_copy(update={"estimate": m}) for p, m in zip(points, middle, strict=True))
    if any(m is None for m in middle):
        return points, None
    return points, float(np.trapezoid(np.array(middle, dtype=np.float64), [p.damping for p in points]))


def _distance(trials: Trials, cost: Floats, inside: Booleans, criterion: str, best: OptimalPoint) -> dict[str, float]:
    """Excess of the exact cost of the chosen trial over the least one, and how far it lies in K and B, relative."""
    batch, truth = trials.batch.select(inside), trials.truth
    unstable = trials.verdicts.verdict[inside] == "unstable"
    chosen = choose_optimum(cost[inside], batch.stiffness, batch.damping, batch.trial_id, unstable=unstable)
    if chosen is None:
        return dict.fromkeys(("cost", "stiffness", "damping"), np.nan)
    exact = truth.costs(np.array([chosen.stiffness]), np.array([chosen.damping]), (criterion,))[criterion]
    alpha, beta = chosen.stiffness / truth.units.stiffness, chosen.damping / truth.units.damping
    # where the optimum is a region, its box; a point is a box without extent
    box = best.box or (best.alpha, best.alpha, best.beta, best.beta)
    return {
        "cost": float(exact[0]) / best.cost - 1,
        "stiffness": max(box[0] - alpha, alpha - box[1], 0.0) / best.alpha,
        "damping": max(box[2] - beta, beta - box[3], 0.0) / best.beta,
    }
