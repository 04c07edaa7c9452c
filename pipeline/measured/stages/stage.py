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
class NoInputs:
    """A stage of trials that takes nothing from the whole experiment."""


@dataclass(frozen=True)
class Missing:
    """Why an experiment lacks what the rows of a stage need: it is the reason of all of them."""

    reason: str


def no_inputs(_: Experiment) -> NoInputs:
    """Return the inputs of a stage that takes nothing from the whole experiment."""
    return NoInputs()


@dataclass(frozen=True)
class TrialStage(Generic[Inputs, Output]):
    """A measurement of each trial of an experiment, one row a trial.

    Parameters
    ----------
    measure : callable
        Measures one trial; its source is part of the key under which the row is stored, as are the samples.
    inputs : callable
        What all trials of the experiment have in common; part of that key, too.
    """

    measure: Callable[[MeasuredTrial, Inputs], Output]
    inputs: Callable[[Experiment], Inputs | Missing]


@dataclass(frozen=True)
class ExperimentStage(Generic[Output]):
    """A measurement of a whole experiment, as rows of a table.

    Parameters
    ----------
    measure : callable
    rests_on : callable, optional
        A hash of all that the rows are computed from, where that is less than the experiment: while it is the same,
        what is stored is kept.
    """

    measure: Callable[[Experiment], Sequence[Output]]
    rests_on: Callable[[Experiment], str] | None = None
