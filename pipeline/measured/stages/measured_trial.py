"""Trial with quantities that several stages need.

A stage uses only these quantities of a trial. The samples of the trial, the inputs from the experiment, and the code
therefore determine a row of the stage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np

from pipeline.base.progress import report
from pipeline.measured.cost.costs import ReadingInputs
from pipeline.measured.cost.reading_error import ReadingError, reading_error
from pipeline.measured.signal.response import NO_ROW, Response, RestPositions, declare_edge, find_response
from pipeline.measured.signal.verdict import Verdict
from pipeline.measured.wall_command.sample_grid import SampleGrid, sample_grid
from pipeline.measured.wall_command.stamps import even
from pipeline.measured.wall_command.wall_law import WallLaw, wall_law
from pipeline.recording.check import check_trial
from pipeline.records.findings import Finding
from pipeline.records.trials import Trial, Trials

Result = TypeVar("Result")
Positions = TypeVar("Positions", Response, RestPositions)

NOT_JUDGED = Verdict("undecided", np.nan, "")
"""Verdict of a trial before the stage that determines verdicts."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Trial and its response as used by costs, with the errors of its readings."""

    trial: Trial
    response: Response
    error: ReadingError


@dataclass(eq=False)
class MeasuredTrial:
    """Trial with quantities that several stages need. Each quantity is measured once, when it is first used.

    Parameters
    ----------
    logged : Trial
        Trial as logged.
    verdict : Verdict
        Stored verdict.
    """

    logged: Trial
    verdict: Verdict = NOT_JUDGED

    @cached_property
    def response(self) -> Response:
        """Edge and resolution of the trial. A declared step row replaces the detected edge."""
        response, declared = find_response(self.logged), self.logged.step_row
        return response if declared is None else declare_edge(self.logged, response, declared)

    @cached_property
    def trial(self) -> Trial:
        """Trial with even time stamps, and with forces relative to the operating point if there is no wall.

        Without a wall, gravity or friction at its limit balances the force before the step. Only the change of the
        force therefore causes motion. With a wall, the rest position contains the operating point. Scattered time
        stamps are replaced by the sampling times to which they belong.
        """
        trial = even(self.logged)
        level = self.response.level if trial.stiffness == 0 else 0.0
        return trial.relative_to(level) if level else trial

    @cached_property
    def law(self) -> WallLaw:
        """Comparison of the logged command with the wall law, with the logged time stamps."""
        return wall_law(replace(self.trial, time=self.logged.time), self.response)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Faults of the recording."""
        return check_trial(self.logged)

    @cached_property
    def unsafe(self) -> str:
        """Reason why the trial contains no information on its wall: a fault, or a command that follows a different
        wall.

        The text is empty if there is no such reason.
        """
        sentences = (finding.sentence for finding in self.findings if finding.is_unsafe)
        other = self.law.other_wall
        return next(sentences, "") or ("" if other is None else other.evidence)

    @cached_property
    def grid(self) -> SampleGrid:
        """The trial with one row for each sample."""
        return sample_grid(self.trial, self.response, self.law)

    def readings(self, inputs: ReadingInputs, *, on_grid: bool) -> tuple[Readings, ...]:
        """Return the readings for costs.

        The readings are those of the trial or, with ``on_grid``, those of the trial on its sample grid and those of its
        linear interpolation, if there is one. They are not kept, because those of 20,000 trials would need 600 MB, and
        computing them again takes 30 microseconds a trial.
        """
        response = self.grid.response if on_grid else self.response
        trials = (self.grid.trial, self.grid.straight) if on_grid else (self.trial,)
        return tuple(self._read(trial, response, inputs) for trial in trials if trial is not None)

    def _read(self, trial: Trial, response: Response, inputs: ReadingInputs) -> Readings:
        if self.unsafe:  # no costs are computed from a response without a start
            response = replace(response, edge_row=NO_ROW, edge_reason=self.unsafe)
        trial, response = with_spring(trial, response, inputs.spring)
        sensor = np.nan if inputs.sensor is None else inputs.sensor
        error = reading_error(trial, response, inputs.delay, sensor=sensor, gain=inputs.gain)
        return Readings(trial, about(response, inputs.final), error)


def with_spring(trial: Trial, response: Positions, spring: float) -> tuple[Trial, Positions]:
    """Return the trial and the response from which costs are computed if a spring k acts on the device.

    The device comes to rest at x_0 + F_0/(K + k), and the energy is stored in a wall of stiffness K + k (5.7).
    """
    if spring and trial.stiffness > 0:
        trial = replace(trial, stiffness=trial.stiffness + spring)
        final = response.position_start + trial.step / trial.stiffness
        response = replace(response, position_final_expected=final)
    return trial, response


def about(response: Response, final: str) -> Response:
    """Return a response whose costs refer to the expected or the measured final position (see `Measuring`)."""
    if final == "measured" and np.isfinite(response.position_final_expected):
        return replace(response, position_final_expected=response.position_final_measured)
    return response


class MapTrials(Protocol):
    """Map of a function over trials of an experiment, in this process (`MeasuredTrials`) or in other processes."""

    def __call__(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int], verdicts: Sequence[Verdict] | None
    ) -> list[Result]:
        """Return the results of a function for the trials at the given places, with the given verdicts, in order."""


class MeasuredTrials:
    """Trials of an experiment in this process. Each trial is measured once.

    Parameters
    ----------
    trials : Trials
    """

    def __init__(self, trials: Trials) -> None:
        self._measured = [MeasuredTrial(trial) for trial in trials]

    def __call__(
        self, function: Callable[[MeasuredTrial], Result], places: Sequence[int], verdicts: Sequence[Verdict] | None
    ) -> list[Result]:
        """Return the results of a function for the trials at the given places, in order, as in `MapTrials`."""
        measured = [self._measured[place] for place in places]
        for trial, verdict in zip(measured, verdicts or (), strict=False):
            trial.verdict = verdict
        results = list[Result]()
        for number, trial in enumerate(measured):
            report(number / len(measured))
            results.append(function(trial))
        return results
