"""Values of an experiment from the stored columns of its stages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from pipeline.records.batch import Floats

Result = TypeVar("Result")


class Stored(Protocol):
    """What the estimates of an experiment are made from: stored columns of its stages."""

    @property
    def rotation(self) -> bool:
        """Whether units are rotational."""

    @property
    def sampling_period_s(self) -> float:
        """Sampling period T [s]."""

    @property
    def step_sizes(self) -> Floats:
        """Step F_0 of each trial by its header [N, Nm]."""

    def column(self, stage: str, name: str) -> Floats:
        """Numeric column of a stage, null as NaN."""

    def lists(self, stage: str, name: str) -> Floats:
        """Column of lists of one length, as rows; null as NaN."""

    def texts(self, stage: str, name: str) -> list[str]:
        """Text column of a stage, null as an empty string."""

    def once(self, function: Callable[[Any], Result]) -> Result:
        """What a function finds in the experiment; it is called once."""
