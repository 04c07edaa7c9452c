"""What there is of an experiment for a stage, which takes values of the whole experiment from it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import pyarrow as pa

from pipeline.measured.experiment.stored import Result, Stored
from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.stages.stage_groups import Given
from pipeline.records.batch import TrialGroups


class Experiment(Stored, Protocol):
    """What there is of an experiment: its samples, and what the stages before found."""

    @property
    def trials(self) -> pa.Table:
        """Rows of the trials table, in any order."""

    @property
    def spring(self) -> float:
        """Stiffness k of the device that its file declares [N/m, Nm/rad], 0 for none."""

    @property
    def samples(self) -> TrialGroups:
        """All samples."""

    @property
    def verdicts(self) -> Verdicts:
        """Verdict of each trial."""

    def of_each(self, function: Callable[..., Result], **given: Any) -> list[Result]:
        """Results of a function of each group."""


def nothing(of: Experiment) -> Given:
    """Return what a stage takes that looks at each trial alone."""
    return {}
