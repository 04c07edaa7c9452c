"""Measures all methods: the tables, the extreme cases, and what is left out."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pipeline.records import accuracy
from pipeline.records.accuracy import AccuracyReport, LeftOut, MeasuredAccuracy, Rung
from pipeline.studies.accuracy.extremes import sweeps
from pipeline.studies.accuracy.measure import Table, grouped
from pipeline.studies.accuracy.measured import measured_tables
from pipeline.studies.accuracy.theory import theory_tables

BUDGETS = {"theory": (0.12, 0.03), "measured": (0.02, 0.02)}
"""Seconds that a run is repeated for, and those of a quick one: thousands of trials in a call leave nothing to warm."""

Say = Callable[[str], None]


@cache
def words() -> dict[str, Any]:
    """Return meanings of quantities, paths of extreme cases, and what is left out, from ``words.toml`` beside it."""
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
    report = AccuracyReport(
        key=accuracy.key(),
        quick=quick,
        measured=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        machine=accuracy.machine(),
    )
    begin = time.perf_counter()
    if theory:
        rungs = _rungs(theory_tables(), quick, say, BUDGETS["theory"])
        say("extreme cases")
        found, seconds = tuple(sweeps(quick)), time.perf_counter() - begin
        parts = {"rungs": rungs, "sweeps": found, "left_out": left_out(), "seconds": seconds}
        report = report.model_copy(update=parts)
    if measured:
        begin = time.perf_counter()
        rungs = _rungs(measured_tables(quick), quick, say, BUDGETS["measured"])
        branch = MeasuredAccuracy(rungs=rungs, seconds=time.perf_counter() - begin)
        report = report.model_copy(update={"measured_branch": branch})
    return report


def _rungs(tables: Iterable[Table], quick: bool, say: Say, budgets: tuple[float, float]) -> tuple[Rung, ...]:
    """Return the rungs of all tables, one quantity after the other."""
    rungs: list[Rung] = []
    for table in tables:
        say(next(iter(table.exact)))
        rungs += table.rungs(quick, budgets[quick])
    return tuple(rung for group in grouped(rungs, "quantity").values() for rung in group)


def left_out() -> tuple[LeftOut, ...]:
    """Return the methods of theory that are not measured here, with reasons; those not installed first."""
    entries = [entry for entry in words()["left_out"] if "library" not in entry or find_spec(entry["library"]) is None]
    return tuple(LeftOut(**{name: entry[name] for name in LeftOut.model_fields}) for entry in entries)
