"""Types of stages. A stage has typed inputs and a typed output. The fields of the output are the stored columns."""

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
    """Reason why an experiment does not provide the inputs of a stage. It is stored as the reason of all rows."""

    reason: str


def no_inputs(_: Experiment) -> None:
    """Return the inputs of a stage that needs no quantity of the experiment."""


@dataclass(frozen=True)
class TrialStage(Generic[Inputs, Output]):
    """Measurement of each trial of an experiment, with one row per trial.

    Parameters
    ----------
    measure : callable
        Function that measures one trial. Its source code and the samples are part of the key of a stored row.
    inputs : callable
        Function that returns the inputs common to all trials of the experiment, which are also part of the key.
    """

    measure: Callable[[MeasuredTrial, Inputs], Output]
    inputs: Callable[[Experiment], Inputs | Missing]


@dataclass(frozen=True)
class ExperimentStage(Generic[Output]):
    """Measurement of an experiment, with the rows of a table as a result.

    Parameters
    ----------
    measure : callable
    rests_on : callable, optional
        Function that returns a hash of all inputs of the rows, if the rows do not depend on the whole experiment.
        Stored rows are reused while the hash is unchanged.
    """

    measure: Callable[[Experiment], Sequence[Output]]
    rests_on: Callable[[Experiment], str] | None = None
