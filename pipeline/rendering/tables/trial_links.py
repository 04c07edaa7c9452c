"""References from the cells of tables to the trials of a report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from pipeline.base.json_object import JsonObject
from pipeline.rendering.table import Row


@dataclass(frozen=True)
class TrialPage:
    """Trials of all experiments of a report.

    Parameters
    ----------
    content : dict
        Input of the page's script as plain JSON values. The trials of each experiment are packed.
    trials, responses : int
        Number of trials, and number of trials with a response in the page.
    places : dict
        Map of ``(experiment, trial id)`` to the reference of the trial in the page.
    limits : dict
        Map of ``(experiment, damping, stiffness)`` to the reference of that boundary trial. The stiffness is that of
        the table of limits.
    """

    content: JsonObject
    trials: int
    responses: int
    places: dict[tuple[str, str], str] = field(default_factory=dict)
    limits: dict[tuple[str, float, float], str] = field(default_factory=dict)

    def place(self, experiment: str | None, trial_id: str | None) -> str:
        """Return the reference with which tables refer to a trial. It is empty if the page does not show the trial."""
        return self.places.get((experiment or "", trial_id or ""), "")


NO_TRIALS = TrialPage({}, 0, 0)
"""Trial page of a report without trials."""


def trial_of_row(trials: TrialPage) -> Callable[[Row], str]:
    """Return the function that refers to the trial of a row."""
    return lambda row: trials.place(row.get("experiment"), row.get("trial_id"))
