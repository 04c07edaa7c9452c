"""Runs the ladders and sweeps of `pipeline accuracy`, and says in words what they show."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from pipeline.accuracy.accuracy_ladders import QUANTITIES, Trial, trials
from pipeline.accuracy.accuracy_optional import load
from pipeline.accuracy.accuracy_sweeps import FAILURES, sweeps
from pipeline.records import accuracy
from pipeline.records.accuracy import AccuracyReport, Advice, LeftOut, Rung, best_time
from pipeline.records.accuracy_advice import advise, distrusted, summarise

BUDGET, QUICK_BUDGET = 0.12, 0.03
"""Seconds that a run is repeated for; its minimum settles within a few dozen repetitions."""

_LEFT_OUT = (
    LeftOut(
        method="harold",
        quantities="spectral radius, boundary",
        reason="hundreds of times slower than batched eigenvalues, and wrong verdicts from d = 48 on",
    ),
    LeftOut(
        method="python-control, scipy dlsim",
        quantities="map, optimum",
        reason="one call a point: minutes for a map of 251 x 251 points",
    ),
    LeftOut(
        method="printed formula (3.7)",
        quantities="settling time, overshoot, energy, optimum, map",
        reason="it gives the plant only, which costs nothing beside the rest; its errors are those of the plant",
    ),
    LeftOut(
        method="step_info and the like",
        quantities="settling time, overshoot",
        reason="they judge the samples that they are given by their last one; no accuracy beyond that of the samples",
    ),
)


def measure(quick: bool = False, progress: Callable[[str], None] | None = None) -> AccuracyReport:
    """Run every method on every quantity and return errors, times and what follows from them.

    Parameters
    ----------
    quick : bool
        Fewer rungs and repetitions.
    progress : callable, optional
        Gets the name of each quantity when it begins.
    """
    begin = time.perf_counter()
    say = progress or (lambda _: None)
    rungs: list[Rung] = []
    current = ""
    for trial in trials(quick):
        if trial.quantities[0] != current:
            current = trial.quantities[0]
            say(current)
        rungs += _measured(trial, QUICK_BUDGET if quick else BUDGET)
    say("numerical stability")
    order = {name: i for i, name in enumerate(QUANTITIES)}
    rungs.sort(key=lambda rung: order[rung.quantity])
    found = tuple(sweeps(quick))
    return AccuracyReport(
        key=accuracy.key(),
        quick=quick,
        measured=accuracy.now(),
        machine=accuracy.machine(),
        rungs=tuple(rungs),
        sweeps=found,
        left_out=left_out(),
        advice=tuple(Advice(quantity=name, text=advise(name, rungs, found)) for name in QUANTITIES),
        seconds=time.perf_counter() - begin,
        summary=summarise(rungs, found),
        distrusted=distrusted(found),
    )


def _measured(trial: Trial, budget: float) -> list[Rung]:
    begin = time.perf_counter()
    errors: dict[str, float] = {}
    try:
        with np.errstate(all="ignore"):
            result, seconds = best_time(trial.run, budget)
            errors = trial.errors(result)
    except FAILURES:
        seconds = time.perf_counter() - begin
    return [
        Rung(
            quantity=name,
            method=trial.method,
            setting=trial.setting,
            error=errors.get(name),
            seconds=seconds,
        )
        for name in trial.quantities
    ]


def left_out() -> tuple[LeftOut, ...]:
    """Return the methods that are not measured here, with reasons; those that are not installed first."""
    absent = [
        LeftOut(method=label, quantities=quantities, reason="not installed here; measured where it is")
        for name, label, quantities in (
            ("control", "python-control", "plant, boundary, spectral radius, settling time, overshoot"),
            ("scipy", "scipy", "plant, settling time, overshoot, energy"),
        )
        if load(name) is None
    ]
    return (*absent, *_LEFT_OUT)
