"""How long a course of experiments must be: error of boundary and optimum over the number of trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from pipeline.accuracy_measured.accuracy_measured_jitter import jitter_limit
from pipeline.accuracy_measured.accuracy_measured_truth import Trials, Truth, truth_of
from pipeline.measured import costs
from pipeline.measured.aggregate import choose_optimum
from pipeline.measured.boundary import measured_boundary
from pipeline.measured.boundary_band import boundary_area, boundary_band
from pipeline.measured.energy_intervals import energy_interval
from pipeline.measured.reading_error import reading_error
from pipeline.records.accuracy import Rung, best_time
from pipeline.records.accuracy_measured_advice import (
    AREA,
    BRACKET_ONE,
    BRACKET_TWO,
    ENERGY_OPTIMUM,
    LIMITS,
    OPTIMUM_ONE,
    OPTIMUM_TWO,
    RATES_ONE,
    RATES_TWO,
    SETTLING_OPTIMUM,
    nth,
)
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.records.models import BoundaryPoint
from pipeline.simulation.course import Course, run_course
from pipeline.simulation.simulate import setup_of
from pipeline.theory.search import OptimalPoint

COURSES = 5
"""Simulated courses of each size; the error is the largest of them."""

MASS_RANGE, DAMPING_RANGE = 0.15, 0.5
"""Mass and damping of the courses' devices differ from the experiment's by up to this, relative: a grid of dampings
that happens to fit the boundary would otherwise look too good."""

JITTER_POINTS, JITTER_RANGE = 30, 1.3
"""Dampings at which the limit of the jittering loop is read (trapezoids between them err by 0.05 %), and how far it may
reach beyond that of the mean delay, in K and in B: 1.06 and 1.08 times for the Falcon."""

CRITERIA = {SETTLING_OPTIMUM: "settle_2pct", ENERGY_OPTIMUM: "energy_step_w0"}
"""Optima that are looked for."""

PARTS = ("cost", "stiffness", "damping")
"""What of an optimum is held against the truth."""


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
        (`accuracy_measured_jitter`); the devices do not differ.
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


@dataclass(frozen=True)
class _Result:
    """Errors of one course by (quantity, method), trials by number of passes, and run times by (quantity, method)."""

    errors: dict[tuple[str, str], float]
    trials: dict[int, int]
    seconds: dict[tuple[str, str], float]


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
    The area is that from B = 0 to the last damping of the course, held against the exact one up to there. A course
    its second pass is the one whose fine trials are left out.
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
            course = _judged(truth, _run(condition, truth, coarsen, seed))
            found.append(_result(condition, course, reference or _Reference(truth.area, truth.limit)))
        yield from _rungs(condition, coarsen, found, truths[0].device.duration_s)


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


def _run(condition: Condition, truth: Truth, coarsen: int, seed: int) -> Course:
    return run_course(
        truth.device,
        condition.experiment,
        seed=seed,
        jitter=None if condition.jitter else (),
        damping_range=condition.damping_range,
        coarsen=coarsen,
    )


@dataclass(frozen=True, eq=False)
class _Judged:
    """Trials of a course with verdicts, the pass of each, and the time that judging took [s]."""

    trials: Trials
    passes: Integers
    seconds: float


def _judged(truth: Truth, course: Course) -> _Judged:
    trials, seconds = best_time(lambda: Trials.of(truth, course.batch), 0.0)
    return _Judged(trials, course.passes, seconds)


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


def _result(condition: Condition, course: _Judged, reference: _Reference) -> _Result:
    errors: dict[tuple[str, str], float] = {}
    seconds: dict[tuple[str, str], float] = {}
    methods = ((RATES_TWO, 2, _rates), (RATES_ONE, 1, _rates), (BRACKET_TWO, 2, _brackets), (BRACKET_ONE, 1, _brackets))
    for method, passes, limits in methods:
        inside = course.passes <= passes
        (points, area), time = best_time(partial(limits, course.trials, inside), 0.0)
        time += course.seconds * float(inside.mean())
        errors[AREA, method] = np.nan if area is None else area / reference.area(points[-1].damping) - 1
        exact = reference.limit(np.array([p.damping for p in points]))
        estimate = np.array([np.nan if p.estimate is None else p.estimate for p in points])
        errors[LIMITS, method] = float(np.nanmedian(np.abs(estimate - exact))) / float(exact.max())
        seconds[AREA, method] = seconds[LIMITS, method] = time
    if condition.optimum:
        _add_optima(course, errors, seconds)
    return _Result(errors, {passes: int((course.passes <= passes).sum()) for passes in (1, 2)}, seconds)


def _add_optima(course: _Judged, errors: dict[tuple[str, str], float], seconds: dict[tuple[str, str], float]) -> None:
    trials = course.trials
    for quantity, criterion in CRITERIA.items():
        cost, time = best_time(partial(_costs, trials, criterion), 0.0)
        time += course.seconds
        best = trials.truth.optimum(criterion)
        for method, passes in ((OPTIMUM_TWO, 2), (OPTIMUM_ONE, 1)):
            inside = course.passes <= passes
            for part, error in zip(PARTS, _distance(trials, cost, inside, criterion, best), strict=True):
                errors[f"{quantity}: {part}", method] = error
                seconds[f"{quantity}: {part}", method] = time * float(inside.mean())


def _costs(trials: Trials, criterion: str) -> Floats:
    """Measured costs with the true delay and mass, shape (n,)."""
    batch, response, verdicts, delay = trials.batch, trials.response, trials.verdicts, trials.delay_samples
    if criterion.startswith("settle"):
        return costs.settling(batch, response, verdicts, delay).samples[criterion]
    error = reading_error(batch, response, delay)
    found = energy_interval(batch, response, verdicts, error, delay, trials.truth.experiment.mass)
    return found.value[:, int(criterion[-1])]


def _distance(
    trials: Trials, cost: Floats, inside: Booleans, criterion: str, best: OptimalPoint
) -> tuple[float, float, float]:
    """Excess of the exact cost of the chosen trial over the least one, and how far it lies in K and B, relative."""
    batch, truth = trials.batch.select(inside), trials.truth
    unstable = trials.verdicts.verdict[inside] == "unstable"
    chosen = choose_optimum(cost[inside], batch.stiffness, batch.damping, batch.trial_id, unstable=unstable)
    if chosen is None:
        return np.nan, np.nan, np.nan
    K, B = np.array([chosen.stiffness]), np.array([chosen.damping])
    exact = float(truth.costs(K, B, (criterion,))[criterion][0])
    units = truth.units
    # where the optimum is a region, its box; a point is a box without extent
    box = best.box or (best.alpha, best.alpha, best.beta, best.beta)
    away = [
        max(low - value, value - high, 0.0) / centre
        for value, low, high, centre in (
            (chosen.stiffness / units.stiffness, box[0], box[1], best.alpha),
            (chosen.damping / units.damping, box[2], box[3], best.beta),
        )
    ]
    return exact / best.cost - 1, away[0], away[1]


def _rungs(condition: Condition, coarsen: int, found: list[_Result], trial_seconds: float) -> Iterator[Rung]:
    for quantity, method in found[0].errors:
        errors = np.abs([r.errors[quantity, method] for r in found])
        passes = 1 if method in (RATES_ONE, BRACKET_ONE, OPTIMUM_ONE) else 2
        trials = round(float(np.mean([r.trials[passes] for r in found])))
        yield Rung(
            quantity=f"{quantity}, {condition.label}",
            method=method,
            setting=nth(coarsen, "step"),
            error=float(errors.max()) if np.isfinite(errors).all() else None,
            seconds=float(np.median([r.seconds[quantity, method] for r in found])),
            trials=trials,
            device_seconds=trials * trial_seconds,
        )
