"""Ladders of methods, and how a rung of one is measured: its error against the truth, and its run time.

A ladder asks for quantities whose exact values are known; each of its methods is run at each of its settings. What
a method is, what is true and what of its errors counts is data; `Ladder.rungs` is the only place that runs and times.
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

BUDGET = 0.02
"""Seconds that an estimate of many trials is repeated for: thousands in one call leave nothing to warm up."""

_SHORT = 2e-3
"""Run time [s] below which a single run is too short for the clock; it is repeated inside the timed loop."""

_T = TypeVar("_T")
Values = dict[str, Floats]
"""Values or errors by quantity, shape (n,) each."""

Summary = Callable[[Floats], tuple[float | None, float | None]]
"""What of the errors counts, and the share of missing values where it is told."""


def largest(error: Floats) -> tuple[float | None, None]:
    """Return the largest absolute error; a missing number counts as 1."""
    return float(np.where(np.isfinite(error), np.abs(error), 1.0).max()), None


def median(error: Floats) -> tuple[float | None, float]:
    """Return the median of absolute errors, and the share of trials without a value (NaN).

    Parameters
    ----------
    error : float64, shape (n,)
        NaN where a trial has no value; the median is None where no trial has one.
    """
    return _middle(error, np.median)


def mean(error: Floats) -> tuple[float | None, float]:
    """Return the mean of absolute errors and the share without a value, as `median`.

    For costs that are whole numbers: their median error is 0 as soon as more than half are exact.
    """
    return _middle(error, np.mean)


def _middle(error: Floats, of: Callable[[Floats], np.floating]) -> tuple[float | None, float]:
    known = np.abs(error[np.isfinite(error)])
    share = 1 - len(known) / max(len(error), 1)
    return (float(of(known)) if len(known) else None), share


@dataclass(frozen=True)
class Method:
    """A way to some quantities, over its settings.

    Parameters
    ----------
    name : str
    run : callable
        Gives the values of the quantities at a setting; it has no argument where there is one setting alone.
    words : str
        Setting in words, with a place for its value.
    settings, quick : sequence
        Values of the setting, and those of a quick run where they are fewer.
    given : callable, optional
        Makes the argument of ``run`` from a setting, beforehand and outside of the time.
    quantities : tuple of str
        Those of the ladder that the method gives; all of them where empty.
    needs : str
        Optional library; without it the method is left out.
    """

    name: str
    run: Callable[..., Values]
    words: str | Callable[[Any], str] = "one setting"
    settings: Sequence[Any] = ()
    quick: Sequence[Any] = ()
    given: Callable[[Any], Any] | None = None
    quantities: tuple[str, ...] = ()
    needs: str = ""

    def runs(self, quick: bool) -> Iterator[tuple[str, Callable[[], Values]]]:
        """Yield each setting in words with the call that runs it; nothing where the library is not installed."""
        if self.needs and find_spec(self.needs) is None:
            return
        if isinstance(self.words, str) and not self.settings:
            yield self.words, self.run
        for setting in (self.quick or self.settings) if quick else self.settings:
            words = self.words.format(setting) if isinstance(self.words, str) else self.words(setting)
            yield words, partial(self.run, self.given(setting) if self.given else setting)


@dataclass(frozen=True)
class Ladder:
    """Quantities with their truth, and the methods that are held against it.

    Parameters
    ----------
    exact : mapping of str to float64, shape (n,)
    methods : sequence of Method
    summary : callable
        Of the errors.
    scale : mapping of str to float64
        What errors are relative to, where it is not the truth.
    trials : int
        Trials that one run works on; the time of a rung is that of one of them.
    counted : int, optional
        Trials that belong to one value, where that is told.
    """

    exact: Mapping[str, Floats | float]
    methods: Sequence[Method]
    summary: Summary = largest
    scale: Mapping[str, Floats | float] = field(default_factory=dict)
    trials: int = 1
    counted: int | None = None

    def errors(self, found: Values) -> Values:
        """Return the error of each value."""
        with np.errstate(all="ignore"):
            return {
                name: (values - self.exact[name]) / self.scale.get(name, self.exact[name])
                for name, values in found.items()
            }

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
                yield from self._rungs(method, setting, run, budget)

    def _rungs(self, method: Method, setting: str, run: Callable[[], Values], budget: float) -> Iterator[Rung]:
        begin = time.perf_counter()
        errors: Values = {}
        try:
            with np.errstate(all="ignore"):
                found, seconds = best_time(run, budget)
            errors = self.errors(found)
        except FAILURES:
            seconds = time.perf_counter() - begin
        for quantity in method.quantities or self.exact:
            error, missing = self.summary(errors[quantity]) if quantity in errors else (None, None)
            yield Rung(
                quantity=quantity,
                method=method.name,
                setting=setting,
                error=error,
                seconds=seconds / self.trials,
                missing=missing,
                trials=self.counted,
            )


def grouped(rungs: Iterable[Rung], of: Literal["quantity", "method"]) -> dict[str, list[Rung]]:
    """Return rungs by quantity or by method, in the order in which these begin."""
    found: dict[str, list[Rung]] = {}
    for rung in rungs:
        found.setdefault(getattr(rung, of), []).append(rung)
    return found


def sorted_by(rungs: Iterable[Rung], of: Literal["quantity", "method"]) -> list[Rung]:
    """Return rungs one quantity after the other, or one method after the other."""
    return [rung for group in grouped(rungs, of).values() for rung in group]


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
