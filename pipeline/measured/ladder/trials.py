"""The trials that one device is fitted to, and those that are held out to judge it: spread over the tested plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from pipeline.measured.fit.fit import allowed_misfit, problems
from pipeline.measured.fit.fit_window import Window, cut, usable_rows
from pipeline.measured.ladder.open_loop import Commands
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

MOST_TRIALS = 400
"""Trials that are looked at, half of them held out: a parameter known to 1 % from one trial is known to 0.07 %."""

MOST_ROWS = 1000
"""Rows of a trial from shortly before the step on; one that lasts longer is no wall's trial, or says the same again."""


@dataclass(frozen=True, eq=False)
class LadderTrials:
    """Commands and readings of n trials over N rows.

    Parameters
    ----------
    command, position : float64, shape (n, N)
        [N, Nm], [m, rad]; the position relative to the first one; 0 outside.
    weight : float64, shape (n, N)
        Reciprocal standard deviation of a reading [1/m, 1/rad]; 0 outside. A reading that repeats counts once.
    information : float64, shape (n,)
        Number of independent readings.
    independent : bool, shape (n, N)
        Rows whose rounding errors are as good as independent.
    misfit_allowed : float64, shape (n,)
        Root mean square of weighted errors from which on a trial is not explained.
    level : float64, shape (n,)
        Mean command before the step [N, Nm].
    """

    command: Floats
    position: Floats
    weight: Floats
    information: Floats
    independent: Booleans
    misfit_allowed: Floats
    level: Floats

    @classmethod
    def of(cls, window: Window, misfit_allowed: Floats) -> Self:
        """Return the trials of windows."""
        w = window.head(min(len(window.position), MOST_ROWS))
        row = np.arange(len(w.position))[:, None]
        deviation = np.sqrt(w.variance * w.run) * w.travel
        command = w.force * w.force_scale
        before = row < w.edge
        return cls(
            command=command.T.copy(),
            position=(w.position * w.travel).T.copy(),
            weight=np.where(w.inside, 1 / deviation, 0.0).T.copy(),
            information=np.where(w.inside, 1 / w.run, 0.0).sum(axis=0),
            independent=(w.independent & w.inside).T.copy(),
            misfit_allowed=misfit_allowed,
            level=np.where(before, command, 0.0).sum(axis=0) / np.maximum(before.sum(axis=0), 1),
        )

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """Return the trials of several parts together, shorter ones padded, with the sensor that most of them show.

        A trial that moves fast, or ends early, does not show the quantum.
        """
        rows = max(part.command.shape[1] for part in parts)
        names = cls.__dataclass_fields__
        both = cls(*(np.concatenate([_padded(getattr(part, name), rows) for part in parts]) for name in names))
        return replace(both, weight=np.minimum(both.weight, np.median(both.weight.max(axis=1))))

    def select(self, which: Booleans | Integers) -> LadderTrials:
        """Return the trials picked by a mask or by indices."""
        return LadderTrials(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    def head(self, rows: int) -> LadderTrials:
        """Return the first rows of all trials."""
        cut = {name: value[:, :rows] for name, value in vars(self).items() if getattr(value, "ndim", 0) == 2}
        share = (cut["weight"] > 0).sum(axis=1) / np.maximum((self.weight > 0).sum(axis=1), 1)
        return replace(self, **cut, information=self.information * share)

    @cached_property
    def commands(self) -> Commands:
        """The commands in the form that responses are made from."""
        return Commands.of(self.command)

    def __len__(self) -> int:
        return len(self.command)


def windowed(batch: TrialBatch, response: Response) -> tuple[Integers, LadderTrials | None]:
    """Return the indices of the trials of a batch that can be fitted, and these; None where there are none."""
    edge = response.edge_row
    first, last = usable_rows(batch, response, edge)
    good = np.flatnonzero([not text for text in problems(batch, response, edge, first, last)])
    if not len(good):
        return good, None
    window = cut(batch.select(good), response.select(good), edge[good], first[good], last[good])
    return good, LadderTrials.of(window, allowed_misfit(window))


def _padded(values: np.ndarray, rows: int) -> np.ndarray:
    if values.ndim == 1:
        return values
    return np.pad(values, ((0, 0), (0, rows - values.shape[1])))


def spread_over_plane(stiffness: Floats, damping: Floats, usable: Booleans, most: int = MOST_TRIALS) -> Integers:
    """Return the indices of at most ``most`` usable trials, evenly from the order of damping and stiffness."""
    index = np.flatnonzero(usable)
    order = index[np.lexsort((stiffness[index], damping[index]))]
    if len(order) <= most:
        return order
    return np.asarray(order[np.round(np.linspace(0, len(order) - 1, most)).astype(np.int64)])
