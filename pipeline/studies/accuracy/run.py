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
from pipeline.records.accuracy import AccuracyReport, LeftOut, Rung
from pipeline.studies.accuracy.device_ladders import device_ladders
from pipeline.studies.accuracy.ladder import grouped
from pipeline.studies.accuracy.sweeps import sweeps
from pipeline.studies.accuracy.theory_ladders import theory_ladders

BUDGET, QUICK_BUDGET = 0.12, 0.03
"""Seconds that a method is repeated for; its minimum settles within a few dozen repetitions."""


@cache
def words() -> dict[str, Any]:
    """Return meanings of quantities, paths of sweeps, and what is left out, from ``words.toml`` beside it."""
    return tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))


def measure(quick: bool = False, say: Callable[[str], None] = lambda _: None) -> AccuracyReport:
    """Run every method on every quantity and return errors and times.

    Parameters
    ----------
    quick : bool
        Fewer settings and repetitions.
    say : callable
        Gets the name of each part when it begins.
    """
    begin = time.perf_counter()
    rungs: list[Rung] = []
    for ladder in (*theory_ladders(), *device_ladders()):
        say(next(iter(ladder.exact)))
        rungs += ladder.rungs(quick, QUICK_BUDGET if quick else BUDGET)
    say("numerical stability")
    return AccuracyReport(
        key=accuracy.key(),
        quick=quick,
        measured=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        machine=accuracy.machine(),
        rungs=tuple(rung for group in grouped(rungs, "quantity").values() for rung in group),
        sweeps=tuple(sweeps(quick)),
        left_out=left_out(),
        seconds=time.perf_counter() - begin,
    )


def left_out() -> tuple[LeftOut, ...]:
    """Return the methods that are not measured here, with reasons; those not installed first."""
    entries = [entry for entry in words()["left_out"] if "library" not in entry or find_spec(entry["library"]) is None]
    return tuple(LeftOut(**{name: entry[name] for name in LeftOut.model_fields}) for entry in entries)
