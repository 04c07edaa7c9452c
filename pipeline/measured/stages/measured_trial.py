"""Trial with the quantities that several stages measure of it.

A stage uses nothing else of a trial, so that its row is determined by the trial's samples, the inputs from the
experiment, and the code.
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
from pipeline.measured.wall_command.wall_law import WallLaw, wall_law
from pipeline.recording.check import check_trial
from pipeline.records.findings import Finding
from pipeline.records.trials import Trial, Trials

Result = TypeVar("Result")

NOT_JUDGED = Verdict("undecided", np.nan, "")
"""Verdict of a trial before the stage that judges it."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Trial and its response as used by costs, with the errors of its readings."""

    trial: Trial
    response: Response
    error: ReadingError


@dataclass(eq=False)
class MeasuredTrial:
    """Trial with the quantities that several stages need, each measured once on first use.

    Parameters
    ----------
    logged : Trial
        Trial as logged.
    verdict : Verdict
        Verdict as stored.
    """

    logged: Trial
    verdict: Verdict = NOT_JUDGED
    _readings: dict[tuple[ReadingInputs, bool], tuple[Readings, ...]] = field(default_factory=dict, init=False)

    @cached_property
    def response(self) -> Response:
        """Edge and resolution; a declared step row replaces the detected one."""
        response, declared = find_response(self.logged), self.logged.step_row
        return response if declared is None else declare_edge(self.logged, response, declared)

    @cached_property
    def trial(self) -> Trial:
        """Trial; at an operating point of a device without a wall, forces count from the level before the step.

        The balancing force there, gravity or friction at its limit, is equally large, so that only the change causes
        motion. The operating point of a wall is contained in its rest position. Scattering time stamps are replaced by
        those of the samples that they count.
        """
        trial = even(self.logged)
        level = self.response.level if trial.stiffness == 0 else 0.0
        return trial.relative_to(level) if level else trial

    @cached_property
    def law(self) -> WallLaw:
        """Comparison of the logged command with the wall law, with time stamps as logged."""
        return wall_law(replace(self.trial, time=self.logged.time), self.response)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Faults of the recording."""
        return check_trial(self.logged)

    @cached_property
    def unsafe(self) -> str:
        """Reason why the trial gives no information on its wall (its recording, or another wall); empty if it does."""
        sentences = (finding.sentence for finding in self.findings if finding.is_unsafe)
        other = self.law.other_wall
        return next(sentences, "") or ("" if other is None else other.evidence)

    @cached_property
    def grid(self) -> SampleGrid:
        """The trial with a row for every sample."""
        return sample_grid(self.trial, self.response, self.law)

    def readings(self, inputs: ReadingInputs, *, on_grid: bool) -> tuple[Readings, ...]:
        """Return the readings for costs: the trial, or the one on its grid and, if available, the linear interpolation.

        The same inputs are used for several costs.
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
        """Return this trial, possibly on its grid, as used by costs if a spring k acts on the device.

        It rests at x_0 + F_0/(K + k), and the wall that stores the energy has K + k (5.7). An unsafe log has no start
        of a response, so that no costs are computed from it.
        """
        if spring and trial.stiffness > 0:
            trial = replace(trial, stiffness=trial.stiffness + spring)
            final = response.position_start + trial.step / trial.stiffness
            response = replace(response, position_final_expected=final)
        return trial, replace(response, edge_row=NO_ROW, edge_reason=self.unsafe) if self.unsafe else response


def about(response: Response, final: str) -> Response:
    """Return a response whose costs refer to its expected or measured final position, see `Measuring`."""
    if final == "measured" and np.isfinite(response.position_final_expected):
        return replace(response, position_final_expected=response.position_final_measured)
    return response


class MapTrials(Protocol):
    """Map of a function over trials of an experiment, in this process (`MeasuredTrials`) or in others."""

    def __call__(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int], verdicts: Sequence[Verdict] | None
    ) -> list[Result]:
        """Return the results of a function of the trials at some places, with the given verdicts, in this order."""


class MeasuredTrials:
    """Trials that are each measured once in this process.

    Parameters
    ----------
    trials : Trials
    """

    def __init__(self, trials: Trials) -> None:
        self._measured = [MeasuredTrial(trial) for trial in trials]

    def __call__(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int], verdicts: Sequence[Verdict] | None
    ) -> list[Result]:
        """Return the results of a function of the trials at some places, in this order, as in `MapTrials`."""
        measured = [self._measured[place] for place in places]
        for trial, verdict in zip(measured, verdicts or (), strict=False):
            trial.verdict = verdict
        results = list[Result]()
        for number, trial in enumerate(measured):
            report(number / len(measured))
            results.append(function(trial))
        return results
