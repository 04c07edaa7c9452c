"""Course of a free motion quarter by quarter, without modes: does it fall, last or rise, and is its command bent?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.response import Response, external_force
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

FALLING = 0.9
"""Ratio of the size of neighbouring quarters up to which a motion falls. A quarter holds half a period or more of what
a wall does within its log; parts of a period make 5 % of difference."""

LASTING = 0.95
"""As `FALLING`, from which on a motion lasts."""

RISEN = 1.5
"""Size of the last quarter relative to the first from which on a motion that lasts has grown before."""

SLOWER = 1.5
"""By what the second half may exceed the size that its slowest mode allows after the first."""

DEPARTURE = 1e-3
"""Smallest departure of the command from the wall law, relative to the step, that is no rounding of a log."""

EQUAL = 1e-9
"""Relative difference of commands that are the same number."""

BENT_ROWS = 2
"""Rows of one and the same command off the wall law that show a limit: two equal numbers are no chance."""


@dataclass(frozen=True, eq=False)
class Course:
    """Size of a motion by its quarters, shape (n, 4) and (n,).

    Parameters
    ----------
    size : float64, shape (n, 4)
        Root mean square of the change from sample to sample [m, rad].
    begin, end : float64
        Half the range of the position in all of the motion and in its last half [m, rad].
    rows : int64
        Samples of the motion.
    bent : bool
        Whether the command stands at a limit, or at the step alone, in the last quarter although the wall law asks for
        more: it is clipped, or the wall does not push.
    """

    size: Floats
    begin: Floats
    end: Floats
    rows: Integers
    bent: Booleans

    @property
    def trend(self) -> Floats:
        """Size of the last quarter relative to the first."""
        return self._ratio(3, 0)

    @property
    def falls(self) -> Booleans:
        """Where each of the last quarters is smaller than the one before."""
        result: Booleans = (self._ratio(3, 2) <= FALLING) & (self._ratio(2, 1) <= FALLING)
        return result

    @property
    def lasts(self) -> Booleans:
        """Where the last quarter is no smaller than the one before."""
        result: Booleans = self._ratio(3, 2) >= LASTING
        return result

    @property
    def brakes(self) -> Booleans:
        """Where the motion falls ever faster, as under friction: the size of a sum of modes falls ever slower."""
        result: Booleans = self.falls & (self._ratio(3, 2) <= self._ratio(2, 1))
        return result & (self._ratio(2, 1) <= self._ratio(1, 0))

    @property
    def risen(self) -> Booleans:
        """Where the motion has grown and then lasts: no linear loop does both, but for a beat."""
        result: Booleans = self.lasts & (self.trend >= RISEN)
        return result

    def contradicts(self, rate: Floats) -> Booleans:
        """Whether the motion falls less than its slowest mode, at a rate per sample: then it has no such modes."""
        halves = np.hypot(self.size[:, 2], self.size[:, 3]), np.hypot(self.size[:, 0], self.size[:, 1])
        with np.errstate(invalid="ignore", over="ignore"):
            allowed = SLOWER * np.exp(np.minimum(rate, 0.0) * self.rows / 2)
            result: Booleans = halves[0] > allowed * halves[1]
        return result

    def _ratio(self, later: int, earlier: int) -> Floats:
        before = self.size[:, earlier]
        result: Floats = self.size[:, later] / np.where(before > 0, before, 1.0)
        return result


def course_of(batch: TrialBatch, start: Integers, count: Integers) -> Course:
    """Return the course of free motions that begin in a row and hold so many samples, shape (n,) each."""
    column = np.arange(batch.position.shape[1])[None, :] - start[:, None]
    after = batch.valid & (column >= 0)
    take = np.minimum(start[:, None] + np.arange(batch.position.shape[1]), batch.position.shape[1] - 1)
    change = np.diff(np.take_along_axis(batch.position, take, axis=1), axis=1)
    last = after & (column >= (0.75 * count)[:, None])
    step = batch.step[:, None]
    departs = np.abs(np.nan_to_num(external_force(batch) - step)) > DEPARTURE * np.abs(step)
    lowest = np.where(after, batch.command, np.inf).min(axis=1, initial=np.inf)
    highest = np.where(after, batch.command, -np.inf).max(axis=1, initial=-np.inf)
    bent = np.zeros(len(batch), dtype=np.bool_)
    for limit in (lowest, highest, batch.step):
        there = np.abs(batch.command - limit[:, None]) <= EQUAL * np.abs(limit)[:, None]
        bent |= (last & departs & there).sum(axis=1) >= BENT_ROWS
    begin, end = (_half_range(batch.position, part) for part in (after, after & (column >= (0.5 * count)[:, None])))
    return Course(sizes(change, count), begin, end, count, bent)


def sizes(signal: Floats, count: Integers) -> Floats:
    """Return the root mean square of the first samples of each signal, ``count`` of them, by quarters, shape (n, 4)."""
    quarter = np.arange(signal.shape[1])[None, :] / np.maximum(0.25 * count, 1.0)[:, None]
    parts = [(quarter >= q) & (quarter < q + 1) for q in range(4)]
    squares = [np.where(part, signal**2, 0.0).sum(axis=1) / np.maximum(part.sum(axis=1), 1) for part in parts]
    result: Floats = np.sqrt(np.stack(squares, axis=1))
    return result


def _half_range(position: Floats, part: Booleans) -> Floats:
    high = np.max(np.where(part, position, -np.inf), axis=1, initial=-np.inf)
    low = np.min(np.where(part, position, np.inf), axis=1, initial=np.inf)
    result: Floats = np.where(high >= low, 0.5 * (high - low), 0.0)
    return result


def in_first_swing(batch: TrialBatch, response: Response, change: Floats) -> Booleans:
    """Return which motions have neither turned nor passed their final position: behind any wall these speed up.

    Parameters
    ----------
    batch, response : TrialBatch, Response
        Of n trials with K other than 0; what is below the sensor's floor is no turn.
    change : float64, shape (n, N - 1)
        Way from each row to the next [m, rad].

    Returns
    -------
    bool, shape (n,)
    """
    way, floor = np.sign(batch.step)[:, None], response.floor[:, None]
    travel = np.abs(response.position_final_expected - response.position_start)[:, None]
    moved = np.nan_to_num(batch.displacement)[:, 1:] * way
    return np.asarray(~((change * way < -floor) | (moved > travel + floor)).any(axis=1))
