"""Trials of a report as its interactive part shows them: finished content of the page, and how tables refer to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class TrialPage:
    """Trials of all experiments of a report.

    Parameters
    ----------
    content : dict
        What the page's script reads: plain JSON values, with the trials of each experiment packed (see `trial_codec`).
    trials, responses : int
        Number of trials, and of those whose response is in the page.
    places : dict
        ``(experiment, trial id)`` to the trial's reference in the page.
    limits : dict
        ``(experiment, damping, stiffness)`` to the reference of the trial that stands in the boundary there; the
        stiffness is that of the table of limits.
    """

    content: dict[str, Any]
    trials: int
    responses: int
    places: dict[tuple[str, str], str] = field(default_factory=dict)
    limits: dict[tuple[str, float, float], str] = field(default_factory=dict)

    def place(self, experiment: str | None, trial_id: str | None) -> str:
        """Return how tables refer to a trial; empty where the page does not show it."""
        return self.places.get((experiment or "", trial_id or ""), "")


NO_TRIALS = TrialPage({}, 0, 0)
"""Of a report without trials."""


def reference(experiment: int, trial: int) -> str:
    """Return how cells and addresses refer to a trial: numbers of experiment and trial in the page, from 0."""
    return f"{experiment}-{trial}"
