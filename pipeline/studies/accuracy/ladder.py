"""Ladders of methods, and how a rung of one is measured: its error against the truth, and its run time.

A ladder asks for quantities whose exact values are known; each of its methods is run at each of its settings. What
a method is and what is true is data; `Ladder.rungs` is the only place that runs and times.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from typing import Any, Literal, TypeVar

import numpy as np

from pipeline.base.errors import PipelineError
from pipeline.records.accuracy import Rung
from pipeline.records.batch import Floats

FAILURES = (ArithmeticError, np.linalg.LinAlgError, PipelineError, ValueError)
"""What a method raises that cannot give a number; anything else is a defect here."""

_SHORT = 2e-3
"""Run time [s] below which a single run is too short for the clock; it is repeated inside the timed loop."""

_T = TypeVar("_T")
Values = dict[str, Floats]
"""Values or errors by quantity, shape (n,) each."""


def largest(error: Floats) -> float:
    """Return the largest absolute error; a missing number counts as 1."""
    return float(np.where(np.isfinite(error), np.abs(error), 1.0).max())


@dataclass(frozen=True)
class Method:
    """A way to the quantities of a ladder, over its settings.

    Parameters
    ----------
    name : str
    run : callable
        Gives the values of the quantities at a setting; it has no argument where there is one setting alone.
    words : str
        Setting in words, with a place for its value.
    settings, quick : sequence
        Values of the setting, and those of a quick run where they are fewer.
    needs : str
        Optional library; without it the method is left out.
    """

    name: str
    run: Callable[..., Values]
    words: str = "one setting"
    settings: Sequence[Any] = ()
    quick: Sequence[Any] = ()
    needs: str = ""

    def runs(self, quick: bool) -> Iterator[tuple[str, Callable[[], Values]]]:
        """Yield each setting in words with the call that runs it; nothing where the library is not installed."""
        if self.needs and find_spec(self.needs) is None:
            return
        if not self.settings:
            yield self.words, self.run
        for setting in (self.quick or self.settings) if quick else self.settings:
            yield self.words.format(setting), partial(self.run, setting)


@dataclass(frozen=True)
class Ladder:
    """Quantities with their truth, the methods held against it, and what errors are relative to beside the truth."""

    exact: Mapping[str, Floats]
    methods: Sequence[Method]
    scale: Mapping[str, Floats | float] = field(default_factory=dict)

    def rungs(self, quick: bool, budget: float) -> Iterator[Rung]:
        """Yield all rungs, each as soon as it is measured.

        Parameters
        ----------
        quick : bool
            With the settings of a quick run.
        budget : float
            Seconds that a run is repeated for.
        """
        for method in self.methods:
            for setting, run in method.runs(quick):
                begin = time.perf_counter()
                found: Values = {}
                try:
                    with np.errstate(all="ignore"):
                        found, seconds = best_time(run, budget)
                except FAILURES:
                    seconds = time.perf_counter() - begin
                for quantity in self.exact:
                    error = self._error(quantity, found[quantity]) if found else None
                    yield Rung(quantity=quantity, method=method.name, setting=setting, error=error, seconds=seconds)

    def _error(self, quantity: str, values: Floats) -> float:
        exact = self.exact[quantity]
        return largest((values - exact) / self.scale.get(quantity, exact))


def grouped(rungs: Iterable[Rung], of: Literal["quantity", "method"]) -> dict[str, list[Rung]]:
    """Return rungs by quantity or by method, in the order in which these begin."""
    found: dict[str, list[Rung]] = {}
    for rung in rungs:
        found.setdefault(getattr(rung, of), []).append(rung)
    return found


def best_time(run: Callable[[], _T], budget: float) -> tuple[_T, float]:
    """Return the result of a call and the least time [s] of repeated calls after a first, uncounted one.

    Parameters
    ----------
    run : callable
    budget : float
        Seconds after which no further repetition begins; a call longer than that is timed by its first run, whose
        warm-up is then a small part.
    """
    begin = time.perf_counter()
    result = run()
    first = time.perf_counter() - begin
    if first > budget:
        return result, first
    inner = max(1, math.ceil(_SHORT / max(first, 1e-7)))
    best = math.inf
    end = time.perf_counter() + budget
    while True:
        begin = time.perf_counter()
        for _ in range(inner):
            run()
        now = time.perf_counter()
        best = min(best, (now - begin) / inner)
        if now > end:
            return result, best
