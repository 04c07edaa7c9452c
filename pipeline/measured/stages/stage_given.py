"""What there is of an experiment for a stage, which takes values of the whole experiment from it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import pyarrow as pa

from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.stages.stage_groups import Given
from pipeline.records.batch import Floats
from pipeline.records.groups import TrialGroups

Result = TypeVar("Result")


class Experiment(Protocol):
    """What there is of an experiment: its samples, and what the stages before found."""

    @property
    def rotation(self) -> bool:
        """Whether units are rotational."""

    @property
    def trials(self) -> pa.Table:
        """Rows of the trials table, in any order."""

    @property
    def samples(self) -> TrialGroups:
        """All samples."""

    @property
    def verdicts(self) -> Verdicts:
        """Verdict of each trial."""

    @property
    def sampling_period_s(self) -> float:
        """Sampling period T [s], the same for all trials."""

    def column(self, stage: str, name: str) -> Floats:
        """Numeric column of an earlier stage, null as NaN."""

    def texts(self, stage: str, name: str) -> list[str]:
        """Text column of an earlier stage, null as an empty string."""

    def once(self, function: Callable[[Any], Result]) -> Result:
        """What a function finds in the experiment; it is called once."""

    def of_each(self, function: Callable[..., Result], **given: Any) -> list[Result]:
        """Results of a function of each group."""


def nothing(of: Experiment) -> Given:
    """Return what a stage takes that looks at each trial alone."""
    return {}


def is_open_loop(of: Experiment) -> bool:
    """Return whether no trial has a wall."""
    return not any(of.trials.column(name).to_numpy().any() for name in ("stiffness", "damping"))
