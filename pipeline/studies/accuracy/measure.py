"""Build tables of methods, and measure the error of a row relative to the truth and its run time.

A table has quantities with known exact values. A row is a method with its settings. Only `Table.rungs` runs and times
methods.
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
from pipeline.records.trials import Floats

FAILURES = (ArithmeticError, np.linalg.LinAlgError, PipelineError, ValueError)
"""Exceptions of a method that cannot compute a number. Any other exception is a defect."""

_SHORT = 2e-3
"""Threshold for the run time [s]. Below it, a single run is too short for the clock, so that several runs are timed
together."""

_T = TypeVar("_T")
Values = dict[str, Floats]
"""Values or errors by quantity, shape (n,) each."""

Summary = Callable[[Floats], tuple[float | None, float | None]]
"""Summary of the errors, and the share of missing values if it is available."""


def largest(error: Floats) -> tuple[float | None, None]:
    """Return the largest absolute error. A missing number counts as an error of 1."""
    return float(np.where(np.isfinite(error), np.abs(error), 1.0).max()), None


def median(error: Floats) -> tuple[float | None, float]:
    """Return the median of absolute errors (None if there are none), and the share of trials without a value (NaN)."""
    known = np.abs(error[np.isfinite(error)])
    return (float(np.median(known)) if len(known) else None), 1 - len(known) / max(len(error), 1)


def mean(error: Floats) -> tuple[float | None, float]:
    """Return the mean of absolute errors and the share of missing values, in the form of `median`.

    It is used for integers, whose median error is 0 if more than half of them are exact.
    """
    known = np.abs(error[np.isfinite(error)])
    return (float(known.mean()) if len(known) else None), 1 - len(known) / max(len(error), 1)


@dataclass(frozen=True)
class Row:
    """A method with its name, its function, and its settings.

    Parameters
    ----------
    name : str
    run : callable
        Function that returns values by quantity for a setting. It has no argument if there is only one setting.
    words : str
        Text for a setting, with a placeholder for its value.
    settings : sequence
    quick : int or None
        Number of settings in a quick run, or None for all.
    given : callable, optional
        Function that prepares the argument of ``run`` from a setting before the timing starts.
    of : tuple of str
        Quantities of the table that the method computes. If it is empty, the method computes all.
    needs : str
        Optional library. If it is not installed, the row is left out.
    """

    name: str
    run: Callable[..., Values]
    words: str = "one setting"
    settings: Sequence[Any] = ()
    quick: int | None = None
    given: Callable[[Any], Any] | None = None
    of: tuple[str, ...] = ()
    needs: str = ""

    def runs(self, quick: bool) -> Iterator[tuple[str, Callable[[], Values]]]:
        """Yield the text of each setting and the call that runs it.

        Nothing is yielded if the library is not installed.
        """
        if self.needs and find_spec(self.needs) is None:
            return
        if not self.settings:
            yield self.words, self.run
        for setting in self.settings[: self.quick] if quick else self.settings:
            yield self.words.format(setting), partial(self.run, self.given(setting) if self.given else setting)


@dataclass(frozen=True)
class Table:
    """Quantities with their truth, and the methods that are compared with it.

    Parameters
    ----------
    exact : mapping of str to float64, shape (n,)
    rows : sequence of Row
    summary : callable
        Function that summarises the errors.
    scale : mapping of str to float64
        Values to which errors are relative, if they differ from the truth.
    trials : int
        Number of trials in a run. The time of a rung is divided by it.
    """

    exact: Mapping[str, Floats]
    rows: Sequence[Row]
    summary: Summary = largest
    scale: Mapping[str, Floats | float] = field(default_factory=dict)
    trials: int = 1

    def rungs(self, quick: bool, budget: float) -> Iterator[Rung]:
        """Yield the error and the time for each row, setting and quantity. Each run is repeated for ``budget``
        seconds."""
        for row in self.rows:
            for setting, run in row.runs(quick):
                begin, errors = time.perf_counter(), {}
                try:
                    with np.errstate(all="ignore"):
                        found, seconds = best_time(run, budget)
                        errors = {q: (v - self.exact[q]) / self.scale.get(q, self.exact[q]) for q, v in found.items()}
                except FAILURES:
                    seconds = time.perf_counter() - begin
                for quantity in row.of or self.exact:
                    error, missing = self.summary(errors[quantity]) if quantity in errors else (None, None)
                    yield Rung(
                        quantity=quantity,
                        method=row.name,
                        setting=setting,
                        error=error,
                        seconds=seconds / self.trials,
                        missing=missing,
                    )


def grouped(rungs: Iterable[Rung], of: Literal["quantity", "method"]) -> dict[str, list[Rung]]:
    """Return rungs by quantity or by method, in the order of first appearance."""
    found: dict[str, list[Rung]] = {}
    for rung in rungs:
        found.setdefault(getattr(rung, of), []).append(rung)
    return found


def best_time(run: Callable[[], _T], budget: float) -> tuple[_T, float]:
    """Return the result of a call, and the shortest time [s] of the calls that follow an initial call.

    No repetition starts after ``budget`` seconds. If the first call takes longer, its time is returned.
    """
    begin = time.perf_counter()
    result = run()
    first = time.perf_counter() - begin
    if first > budget:
        return result, first
    inner = max(1, math.ceil(_SHORT / max(first, 1e-7)))
    best, end = math.inf, time.perf_counter() + budget
    while True:
        begin = time.perf_counter()
        for _ in range(inner):
            run()
        now = time.perf_counter()
        best = min(best, (now - begin) / inner)
        if now > end:
            return result, best
