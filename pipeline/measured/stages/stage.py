"""A stage: typed inputs, typed output; the fields of the output are the stored columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from pipeline.measured.experiment.stored import Experiment
from pipeline.measured.stages.measured_trial import MeasuredTrial

Inputs = TypeVar("Inputs")
Output = TypeVar("Output")


@dataclass(frozen=True)
class Missing:
    """Reason why an experiment lacks the inputs of a stage; it is the reason of all rows."""

    reason: str


def no_inputs(_: Experiment) -> None:
    """Return the inputs of a stage that needs nothing from the whole experiment."""


@dataclass(frozen=True)
class TrialStage(Generic[Inputs, Output]):
    """Measurement of each trial of an experiment, with one row per trial.

    Parameters
    ----------
    measure : callable
        Function that measures one trial; its source and the samples are part of the key under which the row is stored.
    inputs : callable
        Function that returns the inputs common to all trials of the experiment; also part of that key.
    """

    measure: Callable[[MeasuredTrial, Inputs], Output]
    inputs: Callable[[Experiment], Inputs | Missing]


@dataclass(frozen=True)
class ExperimentStage(Generic[Output]):
    """Measurement of a whole experiment, as rows of a table.

    Parameters
    ----------
    measure : callable
    rests_on : callable, optional
        Function that returns a hash of everything from which the rows are computed, if that is less than the
        experiment; stored rows are reused while it is unchanged.
    """

    measure: Callable[[Experiment], Sequence[Output]]
    rests_on: Callable[[Experiment], str] | None = None
