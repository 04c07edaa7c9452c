"""What the planner would have asked for of a course that is finished: as many trials would have been enough."""

from __future__ import annotations

import numpy as np

from pipeline.plan.limits import Aim, Column, order, state
from pipeline.plan.model import Range
from pipeline.plan.verdicts import Tried, bracket
from pipeline.records.batch import Floats
from pipeline.records.results import Saving

DAMPINGS = 12
"""Dampings of the course at which limits are looked for."""

FEWEST = 6
"""Dampings with an enclosed limit below which a course is not finished."""

ACCURACY = 0.02
"""Wanted largest error of a limit, relative to the largest."""

LEAST_TRIALS = 50
"""Trials of a course below which nothing can be saved that is worth a word."""


def saving_of(tried: Tried, sampling_period_s: float, trial_s: float) -> Saving | None:
    """Return how many trials of a finished course the planner would have asked for; None where it is not finished.

    Parameters
    ----------
    tried : Tried
        All trials with K > 0 and B >= 0.
    sampling_period_s, trial_s : float
        T, and how long a log goes on after its step [s].

    Notes
    -----
    Each wall that the planner asks for is replaced by the nearest one that the course has at that damping and that was
    not yet asked for. It is told the range of stiffness and no device, as a lab without a device file would.
    """
    dampings = _finished(tried)
    if len(tried) < LEAST_TRIALS or len(dampings) < FEWEST:
        return None
    largest = float(tried.stiffness[(tried.verdict == "stable") & np.isin(tried.damping, dampings)].max())
    around = Range(largest, 1.1 * float(dampings[-1]), sampling_period_s, trial_s)
    aim = Aim(tuple(dampings.tolist()), ACCURACY)
    asked: list[int] = []
    while len(asked) < len(tried):
        found = state(tried.select(np.array(asked, dtype=np.int64)), aim, around)
        place = next((p for i in order(found.columns) if (p := _nearest(tried, found.columns[i], asked)) >= 0), -1)
        if place < 0:
            break
        asked.append(place)
    return Saving(trials=len(tried), enough=len(asked), dampings=len(dampings), accuracy=ACCURACY)


def _finished(tried: Tried) -> Floats:
    """Return `DAMPINGS` of those whose limit is enclosed closely enough, spread evenly."""
    known, width = [], 2 * ACCURACY * float(tried.stiffness[tried.verdict == "stable"].max(initial=0.0))
    for damping in np.unique(tried.damping):
        own = tried.select(tried.damping == damping)
        ends = bracket(own.stiffness, own.verdict)
        if ends.low is not None and ends.high is not None and ends.high - ends.low <= width:
            known.append(damping)
    some = np.unique(np.round(np.linspace(0, len(known) - 1, min(len(known), DAMPINGS))).astype(np.int64))
    return np.array(known)[some] if known else np.empty(0)


def _nearest(tried: Tried, column: Column, asked: list[int]) -> int:
    """Return the place of the trial nearest to the wall that a damping asks for, within its bracket; -1 without one."""
    if column.wall is None:
        return -1
    left = np.setdiff1d(np.flatnonzero(tried.damping == column.damping), asked)
    again = np.isin(tried.stiffness[left], column.bracket.again)
    between = (tried.stiffness[left] > column.bracket.bottom) & (tried.stiffness[left] < column.bracket.top)
    left = left[again if column.bracket.again else between]
    if not len(left):
        return -1
    return int(left[np.argmin(np.abs(tried.stiffness[left] - column.wall))])
