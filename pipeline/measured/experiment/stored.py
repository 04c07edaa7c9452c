"""Interface to the samples of an experiment and to the stored columns of its stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import pyarrow as pa

from pipeline.device.parameters import Motion
from pipeline.records.models import Measuring
from pipeline.records.trials import Floats, Trials

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Stored verdict of each trial of an experiment, shape (n,), with the fields of `signal.verdict.Verdict`."""

    verdict: np.ndarray[tuple[int, ...], np.dtype[np.str_]]
    growth_per_s: Floats
    reason: tuple[str, ...]


class Experiment(Protocol):
    """Samples of an experiment and the results of its stages."""

    @property
    def sampling_period_s(self) -> float:
        """Sampling period T [s]."""

    @property
    def step_sizes(self) -> Floats:
        """Step F_0 of each trial from its header [N, Nm]."""

    @property
    def motion(self) -> Motion:
        """Kind of motion, which determines the units."""

    def table(self, stage: str) -> pa.Table:
        """Return the result of a stage."""

    def column(self, stage: str, name: str) -> Floats:
        """Return a numeric column of a stage, with NaN for null."""

    def texts(self, stage: str, name: str) -> list[str]:
        """Return a text column of a stage, with an empty string for null."""

    def once(self, function: Callable[[Any], Result]) -> Result:
        """Return the result of a function of the experiment, which is called only once."""

    @property
    def trials(self) -> pa.Table:
        """Rows of the trials table, in any order."""

    @property
    def spring(self) -> float:
        """Stiffness k of the device as declared in its file [N/m, Nm/rad], or 0 if none is declared."""

    @property
    def measuring(self) -> Measuring:
        """Measuring conventions that follow the thesis."""

    @property
    def samples(self) -> Trials:
        """All trials with their samples."""

    @property
    def verdicts(self) -> Verdicts:
        """Verdict of each trial."""

    def map_trials(self, function: Callable[[Any], Result], places: Sequence[int] | None = None) -> list[Result]:
        """Return the results of a function for each `MeasuredTrial`, or for those at the given places, in order."""
