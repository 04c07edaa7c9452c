"""Values of an experiment from the stored columns of its stages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from pipeline.base.wording import of_most
from pipeline.measured.experiment.combine import combine
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate

Result = TypeVar("Result")

SHARED = 0.3
"""Part of the error of one trial that all trials of an experiment share, so that more of them do not average it out: by
simulation the bias of fitted masses, dampings and delays is up to 0.31 of it (docs/verification.md)."""


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


def combined(of: Stored, columns: tuple[str, str, str], unit: str, method: str) -> Estimate:
    """Return the value of an experiment from stage, column of values and column of errors of its trials."""
    stage, value, error = columns
    reasons = of_most(of.texts(stage, "reason")) if stage != "wall_law" else ""
    return combine(
        *(of.column(stage, value), of.column(stage, error), of.texts(stage, "trial_id"), unit, method),
        f"no trial has a value with an interval{reasons}",
        stiffness=of.column(stage, "stiffness"),
        damping=of.column(stage, "damping"),
        rotation=of.rotation,
        shared=SHARED,
    )
