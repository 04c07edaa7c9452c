"""Trials and what is measured of them as columns: one row a trial."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.records.trials import Trial, Trials

CODES = ("verdict", "outcome")
"""Texts that are compared as arrays."""


class Columns:
    """Records, one a trial, whose fields are columns: arrays with one row a trial, or lists of sentences."""

    def __init__(self, records: Iterable[Any]) -> None:
        self.records = list(records)

    def __getattr__(self, name: str) -> Any:
        values = [getattr(record, name) for record in self.records]
        return values if isinstance(values[0], str) and name not in CODES else np.array(values)


def responses(trials: Iterable[Trial]) -> Columns:
    """The response of each trial."""
    return Columns(map(find_response, trials))


def verdicts(trials: Iterable[Trial]) -> Columns:
    """The verdict of each trial."""
    return Columns(map(judge, trials))


def stacked(trials: Iterable[Trial], name: str = "displacement") -> np.ndarray:
    """Samples of trials of equal length, shape (n, rows)."""
    return np.stack([getattr(trial, name) for trial in trials])


def changed(trials: Iterable[Trial], **changes: Callable[[Trial], Any]) -> Trials:
    """Trials of which some fields are computed from the former ones."""
    return Trials.of(replace(trial, **{name: change(trial) for name, change in changes.items()}) for trial in trials)
