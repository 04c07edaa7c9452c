"""A trial with what several stages measure of it.

A stage sees nothing else of a trial, so that its row is known by the trial's samples, by what the experiment gives, and
by the code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np

from pipeline.base.progress import report
from pipeline.measured.cost.costs import ReadingInputs
from pipeline.measured.cost.reading_error import ReadingError, reading_error
from pipeline.measured.signal.response import NO_ROW, Response, declare_edge, find_response
from pipeline.measured.signal.verdict import Verdict
from pipeline.measured.wall_command.sample_grid import SampleGrid, sample_grid
from pipeline.measured.wall_command.stamps import even
from pipeline.measured.wall_command.wall_law import OtherWalls, WallLaw, other_walls, wall_law
from pipeline.recording.check import check_trial
from pipeline.records.findings import Finding
from pipeline.records.trials import Trial, Trials

Result = TypeVar("Result")

NOT_JUDGED = Verdict("undecided", np.nan, "")
"""Verdict of a trial before the stage that judges it."""


@dataclass(frozen=True, eq=False)
class Readings:
    """A trial and its response as costs see them, with the errors of its readings."""

    trial: Trial
    response: Response
    error: ReadingError


@dataclass(eq=False)
class MeasuredTrial:
    """A trial and what several stages need of it, each measured once and when it is first asked for.

    Parameters
    ----------
    logged : Trial
        As the log has it.
    verdict : Verdict
        As stored.
    """

    logged: Trial
    verdict: Verdict = NOT_JUDGED
    _readings: dict[tuple[ReadingInputs, bool], tuple[Readings, ...]] = field(default_factory=dict, init=False)

    @cached_property
    def response(self) -> Response:
        """Edge and resolution; a declared step row replaces what the log shows."""
        response, declared = find_response(self.logged), self.logged.step_row
        return response if declared is None else declare_edge(self.logged, response, declared)

    @cached_property
    def trial(self) -> Trial:
        """The trial; at an operating point of a device without a wall, forces count from the level before the step.

        The balancing force there, gravity or friction at its limit, is as large, so that the motion is that of the
        change alone. A wall has its operating point in the position at which it rests. Stamps that scatter are those of
        the samples that they count.
        """
        trial = even(self.logged)
        level = self.response.level if trial.stiffness == 0 else 0.0
        return trial.relative_to(level) if level else trial

    @cached_property
    def law(self) -> WallLaw:
        """How the logged command obeys the wall law, by stamps as logged."""
        return wall_law(replace(self.trial, time=self.logged.time), self.response)

    @cached_property
    def other_walls(self) -> OtherWalls:
        """Which other wall than stated the command obeys."""
        return other_walls(self.law)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Faults of the recording."""
        return check_trial(self.logged)

    @cached_property
    def unsafe(self) -> str:
        """Why the trial says nothing of its wall: its recording, or another wall than stated; empty where it does."""
        sentences = (finding.sentence for finding in self.findings if finding.is_unsafe)
        return next(sentences, "") or self.other_walls.reason

    @cached_property
    def grid(self) -> SampleGrid:
        """The trial with a row for every sample."""
        return sample_grid(self.trial, self.response, self.law)

    def readings(self, inputs: ReadingInputs, *, on_grid: bool) -> tuple[Readings, ...]:
        """Return what costs are computed from: the trial, or that on its grid and, if there is one, on straight lines.

        The same inputs serve several costs.
        """
        # most trials are their own grid
        on_grid = on_grid and not (self.grid.trial is self.trial and self.grid.response is self.response)
        if (inputs, on_grid) not in self._readings:
            response = self.grid.response if on_grid else self.response
            trials = (self.grid.trial, self.grid.straight) if on_grid else (self.trial,)
            read = tuple(self._read(trial, response, inputs) for trial in trials if trial is not None)
            self._readings[inputs, on_grid] = read
        return self._readings[inputs, on_grid]

    def _read(self, trial: Trial, response: Response, inputs: ReadingInputs) -> Readings:
        trial, response = self.with_spring(trial, response, inputs.spring)
        sensor = np.nan if inputs.sensor is None else inputs.sensor
        error = reading_error(trial, response, inputs.delay, sensor=sensor, gain=inputs.gain)
        return Readings(trial, about(response, inputs.final), error)

    def with_spring(self, trial: Trial, response: Response, spring: float) -> tuple[Trial, Response]:
        """Return this trial, perhaps on its grid, as costs see it where a spring k acts on the device.

        It rests at x_0 + F_0/(K + k), and the wall that stores the energy has K + k (5.7). A log that is
        unsafe has no start of a response by which costs in these units would count.
        """
        if spring and trial.stiffness > 0:
            trial = replace(trial, stiffness=trial.stiffness + spring)
            final = response.position_start + trial.step / trial.stiffness
            response = replace(response, position_final_expected=final)
        return trial, replace(response, edge_row=NO_ROW, edge_reason=self.unsafe) if self.unsafe else response


def about(response: Response, final: str) -> Response:
    """Return a response whose costs count about its expected or its measured final position, see `Measuring`."""
    if final == "measured" and np.isfinite(response.position_final_expected):
        return replace(response, position_final_expected=response.position_final_measured)
    return response


class MapTrials(Protocol):
    """Maps a function over trials of an experiment: in this process (`MeasuredTrials`), or in others."""

    def __call__(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int], verdicts: Sequence[Verdict] | None
    ) -> list[Result]:
        """Return the results of a function of the trials at some places, which have these verdicts, in this order."""


class MeasuredTrials:
    """Trials of which each is measured once in this process.

    Parameters
    ----------
    trials : Trials
    """

    def __init__(self, trials: Trials) -> None:
        self._measured = [MeasuredTrial(trial) for trial in trials]

    def __call__(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int], verdicts: Sequence[Verdict] | None
    ) -> list[Result]:
        """Return the results of a function of the trials at some places, in this order, as `MapTrials`."""
        measured = [self._measured[place] for place in places]
        for trial, verdict in zip(measured, verdicts or (), strict=False):
            trial.verdict = verdict
        results = list[Result]()
        for number, trial in enumerate(measured):
            report(number / len(measured))
            results.append(function(trial))
        return results
