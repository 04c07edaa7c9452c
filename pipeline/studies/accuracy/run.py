"""Runs the ladders, courses and sweeps of `pipeline accuracy`, and says in words what they show."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

from pipeline.records import accuracy
from pipeline.records.accuracy import AccuracyReport, Advice, LeftOut, MeasuredAccuracy, Rung
from pipeline.studies.accuracy import measured_advice, theory_advice
from pipeline.studies.accuracy.cost_ladders import cost_ladders
from pipeline.studies.accuracy.courses import CONDITIONS, COURSES, course_rungs
from pipeline.studies.accuracy.libraries import load
from pipeline.studies.accuracy.names import words
from pipeline.studies.accuracy.parameter_ladders import parameter_rungs
from pipeline.studies.accuracy.rungs import BUDGET, grouped, sorted_by
from pipeline.studies.accuracy.sweeps import sweeps
from pipeline.studies.accuracy.theory_ladders import theory_ladders
from pipeline.studies.planning.rungs import planning_rungs, saving

THEORY_BUDGET, QUICK_THEORY_BUDGET = 0.12, 0.03
"""Seconds that a method of theory is repeated for; its minimum settles within a few dozen repetitions."""

QUICK_COARSENINGS, QUICK_COURSES = (4, 8), 2
"""Courses of a quick run: some seconds instead of most of a minute."""

Say = Callable[[str], None]


def measure(
    quick: bool = False, say: Say = lambda _: None, *, theory: bool = True, measured: bool = True
) -> AccuracyReport:
    """Run every method on every quantity and return errors, times and what follows from them.

    Parameters
    ----------
    quick : bool
        Fewer settings, trials and repetitions.
    say : callable
        Gets the name of each part when it begins.
    theory, measured : bool
        Which branches are measured; the other one stays empty.
    """
    parts = measure_theory(quick, say) if theory else {}
    return AccuracyReport(
        key=accuracy.key(),
        quick=quick,
        measured=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        machine=accuracy.machine(),
        measured_branch=measure_measured(quick, say) if measured else None,
        **parts,
    )


def measure_theory(quick: bool = False, say: Say = lambda _: None) -> dict[str, Any]:
    """Return what a report says of the theory, by the names of its record."""
    begin = time.perf_counter()
    rungs: list[Rung] = []
    for ladder in theory_ladders():
        say(next(iter(ladder.exact)))
        rungs += ladder.rungs(quick, QUICK_THEORY_BUDGET if quick else THEORY_BUDGET)
    rungs = sorted_by(rungs, "quantity")
    say("numerical stability")
    found = tuple(sweeps(quick))
    return {
        "rungs": tuple(rungs),
        "sweeps": found,
        "left_out": left_out(),
        "advice": _advice(theory_advice.advise, rungs, found),
        "summary": theory_advice.summarise(rungs, found),
        "distrusted": theory_advice.distrusted(found),
        "seconds": time.perf_counter() - begin,
    }


def measure_measured(quick: bool = False, say: Say = lambda _: None) -> MeasuredAccuracy:
    """Return what a report says of the measured branch: every estimator, cost and course."""
    begin = time.perf_counter()
    conditions = CONDITIONS[:1] if quick else CONDITIONS
    coarsenings, courses = (QUICK_COARSENINGS, QUICK_COURSES) if quick else (None, COURSES)
    say("measured branch: delay, mass, damping")
    rungs = list(parameter_rungs(quick))
    say("measured branch: costs")
    for ladder in cost_ladders(quick):
        rungs += ladder.rungs(quick, BUDGET)
    for condition in conditions:
        rungs += course_rungs(condition, coarsenings, courses, say)
    rungs += planning_rungs(quick, say)
    return assemble(rungs, tuple(c.label for c in conditions), time.perf_counter() - begin, courses)


def assemble(rungs: Sequence[Rung], labels: Sequence[str], seconds: float, courses: int = COURSES) -> MeasuredAccuracy:
    """Return finished rungs of the measured branch with the sentences that follow from them.

    Parameters
    ----------
    rungs : sequence of Rung
    labels : sequence of str
        Of the conditions under which courses were simulated.
    seconds : float
        Time that it took.
    courses : int
        Courses of each size.
    """
    rungs = sorted_by(rungs, "quantity")
    return MeasuredAccuracy(
        rungs=tuple(rungs),
        advice=_advice(measured_advice.advise, rungs),
        course_length=(*(measured_advice.course_length(label, rungs) for label in labels), *saving(rungs)),
        summary=measured_advice.summarise(rungs),
        conditions=tuple(text.format(courses=courses) for text in words()["conditions"]),
        seconds=seconds,
    )


def _advice(advise: Callable[..., str], rungs: Sequence[Rung], *more: object) -> tuple[Advice, ...]:
    return tuple(Advice(quantity=name, text=advise(name, rungs, *more)) for name in grouped(rungs, "quantity"))


def left_out() -> tuple[LeftOut, ...]:
    """Return the methods of theory that are not measured here, with reasons; those not installed first."""
    entries = [entry for entry in words()["left_out"] if "library" not in entry or load(entry["library"]) is None]
    return tuple(LeftOut(**{name: entry[name] for name in LeftOut.model_fields}) for entry in entries)
