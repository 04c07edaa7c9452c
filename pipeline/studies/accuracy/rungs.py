"""One rung of a ladder of the measured branch: what ran, how long it took, and how far it was from the truth."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from pipeline.records.accuracy import Rung, best_time
from pipeline.records.batch import Floats

BUDGET = 0.02
"""Seconds that a run is repeated for: thousands of estimates in one call leave nothing to warm up."""

_T = TypeVar("_T")


def median_error(error: Floats) -> tuple[float | None, float]:
    """Return the median of absolute errors, and the share of trials without a value (NaN).

    Parameters
    ----------
    error : float64, shape (n,)
        NaN where a trial has no value; the median is None where no trial has one.
    """
    return _summary(error, np.median)


def mean_error(error: Floats) -> tuple[float | None, float]:
    """Return the mean of absolute errors and the share without a value, as `median_error`.

    For costs that are whole numbers: their median error is 0 as soon as more than half are exact.
    """
    return _summary(error, np.mean)


def _summary(error: Floats, middle: Callable[[Floats], np.floating]) -> tuple[float | None, float]:
    known = np.abs(error[np.isfinite(error)])
    share = 1 - len(known) / max(len(error), 1)
    return (float(middle(known)) if len(known) else None), share


def measured_rung(
    quantity: str,
    method: str,
    setting: str,
    run: Callable[[], _T],
    error: Callable[[_T], Floats],
    *,
    trials: int,
    summary: Callable[[Floats], tuple[float | None, float]] = median_error,
) -> Rung:
    """Time a method on trials whose truth is known, and return its error and time.

    Parameters
    ----------
    quantity, method, setting : str
    run : callable
        Gives the values of all trials.
    error : callable
        Their errors, shape (n,), NaN where there is no value.
    trials : int
        Trials that ``run`` works on; the time of the rung is that of one of them.
    summary : callable
        What of the errors counts.
    """
    result, seconds = best_time(run, BUDGET)
    found, missing = summary(error(result))
    return Rung(
        quantity=quantity, method=method, setting=setting, error=found, seconds=seconds / trials, missing=missing
    )
