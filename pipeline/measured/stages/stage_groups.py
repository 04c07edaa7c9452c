"""What the rows of a stage are computed from: some trials, and what was found for their whole experiment.

A stage sees nothing else, so that its rows are known by the samples of a group, by what is given, and by the code.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from pipeline.measured.law.sample_grid import SampleGrid, sample_grid
from pipeline.measured.law.stamps import even
from pipeline.measured.law.wall_law import OtherWalls, WallLaw, other_walls, wall_law
from pipeline.measured.signal.response import NO_ROW, Response, declare_edge, find_response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.recording.check import check_trial
from pipeline.records.batch import Booleans, TrialBatch
from pipeline.records.findings import Finding

Given = Mapping[str, Any]
"""Values of the whole experiment by name, as JSON holds them."""

Columns = dict[str, Any]

Result = TypeVar("Result")


def _unjudged() -> Verdicts:
    return Verdicts(np.empty(0, dtype="<U9"), np.empty(0), ())


@dataclass
class TrialGroup:
    """Trials that are computed together, with their verdicts as stored; none before the stage that judges them.

    Parameters
    ----------
    logged : TrialBatch
        As the logs have them.
    verdicts : Verdicts
    """

    logged: TrialBatch
    verdicts: Verdicts = field(default_factory=_unjudged)
    _told: dict[tuple[Any, ...], Any] = field(default_factory=dict)

    def once(self, function: Callable[..., Result], *arguments: Hashable) -> Result:
        """Return what a function tells of batch and response by some values, computed once for all stages."""
        key = (function, *arguments)
        if key not in self._told:
            self._told[key] = function(self.batch, self.found, *arguments)
        result: Result = self._told[key]
        return result

    @cached_property
    def batch(self) -> TrialBatch:
        """The trials; at an operating point of a device without a wall, forces count from the level before the step.

        What holds the device there, gravity or a friction at its limit, is as large, so that the motion is that of the
        change alone. A wall has its operating point in the position at which it rests. Stamps that scatter are those of
        the samples that they count.
        """
        level = np.where(self.logged.stiffness == 0, self.found.level, 0.0)
        batch = even(self.logged)
        return batch.relative_to(level) if level.any() else batch

    def select(self, which: Booleans) -> TrialGroup:
        """Return the trials picked by a mask; the group itself where it picks all."""
        if which.all():
            return self
        index = np.flatnonzero(which)
        verdicts = self.verdicts.select(index) if self.verdicts.reason else self.verdicts
        some = TrialGroup(self.logged.select(index), verdicts)
        some.found = self.found.select(index)
        return some

    @cached_property
    def law(self) -> WallLaw:
        """How the logged commands obey the wall law, by stamps as logged."""
        return wall_law(replace(self.batch, time=self.logged.time), self.found)

    @cached_property
    def other_walls(self) -> OtherWalls:
        """Which commands obey another wall than their headers state."""
        return other_walls(self.law)

    @cached_property
    def findings(self) -> tuple[tuple[Finding, ...], ...]:
        """What is wrong with the recording of each trial."""
        return tuple(check_trial(self.logged, trial) for trial in range(len(self.logged)))

    @cached_property
    def unsafe(self) -> tuple[str, ...]:
        """Why each trial says nothing of its wall: its recording, or another wall than stated; empty where it does."""
        first = [next((each.sentence for each in found if each.is_unsafe), "") for found in self.findings]
        return tuple(own or other for own, other in zip(first, self.other_walls.reason, strict=True))

    def held_by(self, spring: float) -> TrialGroup:
        """Return the trials as costs see them where a spring k holds the device; the group itself where it is the same.

        It rests at x_0 + F_0/(K + k), and the wall that stores the energy has K + k (5.7). A log that is
        unsafe has no start of a response by which costs in these units would count.
        """
        other, found, logged = self.unsafe, self.found, self.logged
        if not spring and not any(other):
            return self
        if spring:
            wall = logged.stiffness
            logged = replace(logged, stiffness=np.where(wall > 0, wall + spring, wall))
            shift = logged.step / np.where(wall > 0, wall + spring, np.nan)
            found = replace(found, position_final_expected=found.position_start + shift)
        held = TrialGroup(logged, self.verdicts)
        held.found = replace(
            found,
            edge_row=np.where([bool(text) for text in other], NO_ROW, found.edge_row),
            edge_reason=tuple(text or why for text, why in zip(other, found.edge_reason, strict=True)),
        )
        return held

    @cached_property
    def grid(self) -> SampleGrid:
        """The trials with a row for every sample."""
        return sample_grid(self.batch, self.found, self.law)

    @cached_property
    def on_grid(self) -> TrialGroup:
        """Trials with a row for every sample; the group itself where all logs have one."""
        return self if self.grid.batch is self.batch else self._of(self.grid.batch)

    @cached_property
    def on_straight_grid(self) -> TrialGroup | None:
        """As `on_grid`, interpolated by straight lines; None where nothing is interpolated."""
        return self._of(self.grid.straight) if self.grid.filled.any() else None

    def _of(self, batch: TrialBatch) -> TrialGroup:
        group = TrialGroup(batch, self.verdicts)
        group.found, group.other_walls, group.findings = self.grid.response, self.other_walls, self.findings
        return group

    @cached_property
    def found(self) -> Response:
        """Edge and resolution of each trial; a declared step row stands for what the log does not show."""
        found = find_response(self.logged)
        declared = self.logged.step_row
        return found if declared is None else declare_edge(self.logged, found, declared)
