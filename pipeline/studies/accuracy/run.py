"""Runs the ladders and sweeps of `pipeline accuracy`."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pipeline.records import accuracy
from pipeline.records.accuracy import AccuracyReport, LeftOut, MeasuredAccuracy, Rung
from pipeline.studies.accuracy.cost_ladders import cost_ladders
from pipeline.studies.accuracy.device_ladders import device_ladders
from pipeline.studies.accuracy.ladder import BUDGET, sorted_by
from pipeline.studies.accuracy.parameter_ladders import parameter_rungs
from pipeline.studies.accuracy.sweeps import sweeps
from pipeline.studies.accuracy.theory_ladders import theory_ladders

THEORY_BUDGET, QUICK_THEORY_BUDGET = 0.12, 0.03
"""Seconds that a method of theory is repeated for; its minimum settles within a few dozen repetitions."""

Say = Callable[[str], None]


@cache
def words() -> dict[str, Any]:
    """Return meanings of quantities, paths of sweeps, and what is left out, from ``words.toml`` beside it."""
    return tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))


def measure(
    quick: bool = False, say: Say = lambda _: None, *, theory: bool = True, measured: bool = True
) -> AccuracyReport:
    """Run every method on every quantity and return errors and times.

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
    for ladder in (*theory_ladders(), *device_ladders()):
        say(next(iter(ladder.exact)))
        rungs += ladder.rungs(quick, QUICK_THEORY_BUDGET if quick else THEORY_BUDGET)
    say("numerical stability")
    found = tuple(sweeps(quick))
    return {
        "rungs": tuple(sorted_by(rungs, "quantity")),
        "sweeps": found,
        "left_out": left_out(),
        "seconds": time.perf_counter() - begin,
    }


def measure_measured(quick: bool = False, say: Say = lambda _: None) -> MeasuredAccuracy:
    """Return what a report says of the measured branch: every estimator and cost, on simulated truth."""
    begin = time.perf_counter()
    say("measured branch: delay, mass, damping")
    rungs = list(parameter_rungs(quick))
    say("measured branch: costs")
    for ladder in cost_ladders(quick):
        rungs += ladder.rungs(quick, BUDGET)
    return MeasuredAccuracy(rungs=tuple(sorted_by(rungs, "quantity")), seconds=time.perf_counter() - begin)


def left_out() -> tuple[LeftOut, ...]:
    """Return the methods of theory that are not measured here, with reasons; those not installed first."""
    entries = [entry for entry in words()["left_out"] if "library" not in entry or find_spec(entry["library"]) is None]
    return tuple(LeftOut(**{name: entry[name] for name in LeftOut.model_fields}) for entry in entries)
