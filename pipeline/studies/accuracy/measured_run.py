"""Runs the ladders of the measured branch on simulated truth, and says in words what they show."""

from __future__ import annotations

import time
from collections.abc import Callable

from pipeline.accuracy_measured.accuracy_measured_costs import cost_rungs
from pipeline.accuracy_measured.accuracy_measured_courses import CONDITIONS, COURSES, course_rungs
from pipeline.accuracy_measured.accuracy_measured_trials import parameter_rungs
from pipeline.records.accuracy import Advice, MeasuredAccuracy, Rung
from pipeline.records.accuracy_measured_advice import advise, course_length, summarise

QUICK_COARSENINGS, QUICK_COURSES = (4, 8), 2
"""Courses of a quick run: some seconds instead of most of a minute."""

_SIMULATED = (
    "Simulated truth: the Falcon of experiment 1 (m = 0.58 kg, b = 4 Ns/m, sensor quantum 2 µm, noise 0.5 µm, 1 kHz, "
    "400 rows of which 20 lie before the step), without jitter of the delay unless a figure says so; noise is seeded.",
    "Delay: five constant delays from 4.1 to 4.9 samples. Mass, damping, costs: 4 samples. Trials are drawn over the "
    "whole stable region, with spectral radii up to 0.999, for costs up to 0.985.",
    "Costs are held against the exact costs of the same sampled loop by theory, limits and areas against its exact "
    "boundary; with jitter, for which theory has no limit, against that of responses of 3,000 ideal samples.",
)


def measure_measured(quick: bool = False, progress: Callable[[str], None] | None = None) -> MeasuredAccuracy:
    """Run every estimator, cost and course of the ladders and return errors, times and what follows from them.

    Parameters
    ----------
    quick : bool
        Fewer trials and settings, and coarse courses of one device alone.
    progress : callable, optional
        Gets the name of each part when it begins.
    """
    begin = time.perf_counter()
    say = progress or (lambda _: None)
    say("measured branch: delay, mass, damping")
    rungs: list[Rung] = list(parameter_rungs(quick))
    say("measured branch: costs")
    rungs += cost_rungs(quick)
    conditions = CONDITIONS[:1] if quick else CONDITIONS
    coarsenings, courses = (QUICK_COARSENINGS, QUICK_COURSES) if quick else (None, COURSES)
    for condition in conditions:
        rungs += course_rungs(condition, coarsenings, courses, say)
    return assemble(rungs, tuple(c.label for c in conditions), time.perf_counter() - begin, courses)


def assemble(rungs: list[Rung], labels: tuple[str, ...], seconds: float, courses: int = COURSES) -> MeasuredAccuracy:
    """Return finished rungs with the sentences that follow from them.

    Parameters
    ----------
    rungs : list of Rung
    labels : tuple of str
        Of the conditions under which courses were simulated.
    seconds : float
        Time that it took.
    courses : int
        Courses of each size.
    """
    quantities = dict.fromkeys(r.quantity for r in rungs)
    return MeasuredAccuracy(
        rungs=tuple(rungs),
        advice=tuple(Advice(quantity=name, text=advise(name, rungs)) for name in quantities),
        course_length=tuple(course_length(label, rungs) for label in labels),
        summary=summarise(rungs),
        conditions=(
            *_SIMULATED,
            f"Courses: {courses} of each size, with devices whose mass differs by up to 15 % and whose damping by up "
            "to 50 % (with jitter: one device); the error is the largest of them. The Falcon's cover "
            "the whole stable region with K ≥ 0 and B ≥ 0. Measuring time: 0.40 s a trial (Falcon), 0.35 s (LWR), with "
            "its reset.",
        ),
        seconds=seconds,
    )
