"""What the rows of a stage are computed from: some trials, and what was found for their whole experiment.

A stage sees nothing else, so that its rows are known by the samples of a group, by what is given, and by the code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.measured.response import Response, declare_edge, find_response
from pipeline.measured.verdict import Verdicts
from pipeline.records.batch import Booleans, TrialBatch

Given = Mapping[str, Any]
"""Values of the whole experiment by name, as JSON holds them."""

Columns = dict[str, Any]


def _unjudged() -> Verdicts:
    return Verdicts(np.empty(0, dtype="<U9"), np.empty(0), ())


@dataclass
class TrialGroup:
    """Trials that are computed together, with their verdicts as stored; none before the stage that judges them."""

    batch: TrialBatch
    verdicts: Verdicts = field(default_factory=_unjudged)

    def select(self, which: Booleans) -> TrialGroup:
        """Return the trials picked by a mask; the group itself where it picks all."""
        if which.all():
            return self
        index = np.flatnonzero(which)
        verdicts = self.verdicts.select(index) if self.verdicts.reason else self.verdicts
        some = TrialGroup(self.batch.select(index), verdicts)
        some.found = self.found.select(index)
        return some

    @cached_property
    def found(self) -> Response:
        """Edge and resolution of each trial; a declared step row stands for what the log does not show."""
        found = find_response(self.batch)
        declared = self.batch.step_row
        return found if declared is None else declare_edge(self.batch, found, declared)
