"""Limits that end a log or bend it: the travel of the device, rigid stops, the largest command."""

from __future__ import annotations

import numpy as np

from pipeline.measured.signal.disturbance import Disturbance
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, Response, external_force
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

IDEAL_FLOOR = 1e-9
"""Floor of a log without noise and quantum, relative to its range: rounding of positions is far below."""

STANDING_SAMPLES = 5
"""Rows for which a position stands at its extreme before it counts as a stop."""

IMPACT = 6.0
"""Last change before a stand, in floors: a smooth turn that stays within a floor and the rounding of a quantum for 5
rows enters with 4 at most."""

ABRUPT = 4.0
"""Way in the two samples before an abrupt turn, relative to the two after it: a smooth turn comes to 2.2."""

ROUNDING = 1e-3
"""Part of a floor by which rounding moves a position over the edge of a quantum."""

REBOUNDS = 3
"""Abrupt turns at the same extreme that show a stop."""

LOUD = 40.0
"""Way in the two samples before an abrupt turn, in floors: below it a smooth turn stays within a floor of its extreme
for several samples, and its first one lies far before the turn."""

UNMOVED_SAMPLES = 36
"""Samples after the step within which a device that has not moved may still be waiting for the command: 12 of
delay, and twice what a verdict needs."""

ONSET = 0.01
"""Part of the largest displacement within `UNMOVED_SAMPLES` that is a movement: sensor noise moves a soft device
before the step does."""

BLOW = 2.0
"""Force of an impact relative to the step: hands push by less, and impacts of 0.2 m/s give more."""

DEPARTURE = 1e-3
"""Smallest departure of the command from the wall law, relative to the step, that shows clipping: logs with few
digits are rounded by less."""

CLIPPED_ROWS = 2
"""Rows of equal largest command off the wall law: two equal numbers are no chance."""

EQUAL = 1e-9
"""Commands within this part of the largest one are equal to it."""

CHUNK = 64
"""Trials that are looked at together: an array of theirs, 0.5 MB at 1,000 rows, stays in a processor's cache."""


def usual_length(rows: Integers) -> int:
    """Return the number of rows that most logs have, of equally common ones the largest; 0 without logs."""
    lengths, counts = np.unique(rows, return_counts=True)
    return int(lengths[len(counts) - 1 - np.argmax(counts[::-1])]) if len(counts) else 0


def left_travel(batch: TrialBatch, response: Response, usual: int) -> Integers:
    """Return the last row of logs that ended because the device left its travel, -1 for others, shape (n,).

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    usual : int
        Rows of most logs of the experiment: a shorter one ended early.

    Notes
    -----
    Such a log is short, and ends with the largest distance from the final position (K > 0; larger than that of
    the start, which is inside the travel) or from the start (K = 0), moving outwards. A growing oscillation whose
    recording was stopped by hand at that moment looks the same. In an experiment whose logs all end early, or
    of a single log, it cannot be told.
    """
    centre = np.where(batch.stiffness > 0, response.position_final_expected, response.position_start)
    distance = np.where(batch.valid, np.abs(batch.position - centre[:, None]), 0.0)
    end, before = (_row(distance, batch.rows - back) for back in (1, 2))
    farthest = end >= distance.max(axis=1, initial=0.0)
    beyond = np.where(batch.stiffness > 0, np.abs(response.position_start - centre), 0.0)
    left = (batch.rows < usual) & farthest & (end > beyond + response.floor) & (end - before > response.floor)
    # with K = 0 a device always moves outwards: only a log that lasted for a while can have reached a limit
    left &= (batch.stiffness > 0) | (free_samples(batch, response) >= FEWEST_SAMPLES)
    return np.where(left, batch.rows - 1, NO_ROW).astype(np.int64)


def first_stop(batch: TrialBatch, response: Response, outside: Disturbance) -> Integers:
    """Return the first row at a rigid stop, -1 where there is none, shape (n,).

    Parameters
    ----------
    batch : TrialBatch
    response, outside : Response, Disturbance
        Of the same trials.

    Notes
    -----
    At a stop the position stands at its largest or smallest value for some rows that it reached at speed; or it is
    stopped there by a force that no command explains and that is larger than the step by far; or it turns there
    several times, each time faster on the way there than on the way back, where a free oscillation is as fast. A
    stop that is touched gently is not seen, nor is a soft one.
    """
    first = np.full(len(batch), NO_ROW, dtype=np.int64)
    for some, part in batch.portions(CHUNK):
        first[some] = _first_stop(part, response.select(some), outside.select(some))
    return first


def _first_stop(batch: TrialBatch, response: Response, outside: Disturbance) -> Integers:
    x = batch.position
    column = np.arange(x.shape[1])[None, :]
    after = batch.valid & (column >= np.maximum(response.edge_row, 0)[:, None])
    highest = np.max(np.where(after, x, -np.inf), axis=1, initial=-np.inf)[:, None]
    lowest = np.min(np.where(after, x, np.inf), axis=1, initial=np.inf)[:, None]
    floor = np.maximum(response.floor[:, None], IDEAL_FLOOR * (highest - lowest))
    change = np.zeros_like(x)
    change[:, 1:] = np.abs(np.diff(x, axis=1))
    # the device may arrive between two samples: then the change before that one tells its speed
    speed = np.nan_to_num(np.maximum(change, np.roll(change, 1, axis=1)))
    before, behind = np.zeros_like(x), np.full_like(x, np.inf)
    before[:, 2:] = np.abs(x[:, 2:] - x[:, :-2])
    behind[:, :-2] = before[:, 2:]
    before, behind = np.nan_to_num(before), np.nan_to_num(behind, nan=np.inf)
    first = np.full(len(batch), x.shape[1], dtype=np.int64)
    blown = (outside.first_row >= 0) & (np.abs(outside.force) > BLOW * np.abs(batch.step))
    about = np.abs(column - outside.largest_row[:, None]) <= outside.span
    for side, depth in ((-1, highest - x), (1, x - lowest)):
        # twice the floor: from a quiet baseline the noise of a coarse sensor is read too small
        there = after & (depth <= 2 * floor)
        # a device that rests at its extreme before it moves has reached no stop
        there &= np.maximum.accumulate(after & ~there, axis=1)
        near = there & (depth <= (1 + ROUNDING) * floor)
        # the force is inwards, at the extreme: the first time that the device was there
        thrown = blown & (np.sign(outside.force) == side) & (there & about).any(axis=1)
        first = np.where(thrown, np.minimum(first, np.argmax(there, axis=1)), first)
        arrives = near.copy()
        arrives[:, 1:] &= ~near[:, :-1]
        rebounds = arrives & (behind < before / ABRUPT) & (before > LOUD * floor)
        often = rebounds.sum(axis=1) >= REBOUNDS
        first = np.where(often, np.minimum(first, np.argmax(rebounds, axis=1)), first)
        stands = near.copy()
        for shift in range(1, STANDING_SAMPLES):
            stands[:, :-shift] &= near[:, shift:]
            stands[:, -shift:] = False
        hit = stands & arrives & (speed > IMPACT * floor)
        first = np.where(hit.any(axis=1), np.minimum(first, np.argmax(hit, axis=1)), first)
    return np.where(first < x.shape[1], first, NO_ROW).astype(np.int64)


def first_clipped(batch: TrialBatch) -> tuple[Integers, Floats]:
    """Return the first row with a clipped command (-1: none) and the largest command [N, Nm], shape (n,) each.

    Notes
    -----
    A clipped command equals the largest one of the log and is not what the wall law asks for: nearer to zero by
    more than rounding. A velocity filter departs from the wall law too, but its extremes are not equal.
    """
    first, largest = np.full(len(batch), NO_ROW, dtype=np.int64), np.zeros(len(batch))
    for some, part in batch.portions(CHUNK):
        first[some], largest[some] = _first_clipped(part)
    return first, largest


def _first_clipped(batch: TrialBatch) -> tuple[Integers, Floats]:
    size = np.where(batch.valid, np.abs(batch.command), 0.0)
    largest = size.max(axis=1, initial=0.0)
    departure = external_force(batch)
    # 0 or F_0 was asked for, whichever is nearer: before the edge and after it
    step = batch.step[:, None]
    departure = np.where(np.abs(departure) < np.abs(departure - step), departure, departure - step)
    inwards = np.nan_to_num(-departure * np.sign(batch.command)) > DEPARTURE * np.abs(step)
    clipped = inwards & (size >= (1 - EQUAL) * largest[:, None])
    found = clipped.sum(axis=1) >= CLIPPED_ROWS
    return np.where(found, np.argmax(clipped, axis=1), NO_ROW).astype(np.int64), largest


def _row(values: Floats, row: Integers) -> Floats:
    result: Floats = np.take_along_axis(values, np.maximum(row, 0)[:, None], axis=1)[:, 0]
    return result


def free_samples(batch: TrialBatch, response: Response) -> Integers:
    """Return the number of samples of free motion, shape (n,): after the step and twice the delay that it shows.

    Notes
    -----
    The first movement shows one delay; after another one the past before the step is forgotten. A log without
    any movement holds none.
    """
    column = np.arange(batch.position.shape[1])[None, :]
    size = np.nan_to_num(np.abs(batch.displacement))
    soon = column <= (np.maximum(response.edge_row, 0) + UNMOVED_SAMPLES)[:, None]
    largest = np.where(soon, size, 0.0).max(axis=1, initial=0.0)
    still = np.maximum(np.maximum(response.floor, response.baseline_motion), ONSET * largest)
    moved: Booleans = size > still[:, None]
    moved &= column > response.edge_row[:, None]
    onset = np.argmax(moved, axis=1)
    count = np.where(moved.any(axis=1), batch.rows - 1 - (2 * onset - np.maximum(response.edge_row, 0)), 0)
    return np.maximum(count, 0).astype(np.int64)
