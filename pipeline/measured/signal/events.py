"""Limits that end a log or bend it: the travel of the device, rigid stops, the largest command."""

from __future__ import annotations

import numpy as np

from pipeline.measured.signal.disturbance import LONGEST_DELAY, Disturbance, PushResponse
from pipeline.measured.signal.edge import BENT, lasting
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, SETTLED_SAMPLES, Response, external_force
from pipeline.records.batch import Floats, Integers, TrialBatch

IMPACT = 6.0
"""Last change before a stand, in floors: a smooth turn that stays within a floor and the rounding of a quantum for 5
rows enters with 4 at most."""

ABRUPT, REBOUNDS, LOUD = 4.0, 3, 40.0
"""Way in the two samples before a turn, relative to the two after it, of which as many turns at the same extreme show a
stop; a smooth turn comes to 2.2. And that way in floors: below it a smooth turn stays for several samples."""

BLOW = 2.0
"""Force of an impact relative to the step: hands push by less, and impacts of 0.2 m/s give more."""

UNMOVED_SAMPLES = LONGEST_DELAY + 2 * FEWEST_SAMPLES
"""Samples after the step within which a device that has not moved may still be waiting for the command: twice what a
verdict needs behind the delay."""


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
    last = np.maximum(batch.rows[:, None] - [[1, 2]], 0)
    end, before = np.take_along_axis(distance, last, axis=1).T
    farthest = end >= distance.max(axis=1, initial=0.0)
    beyond = np.where(batch.stiffness > 0, np.abs(response.position_start - centre), 0.0)
    left = (batch.rows < usual) & farthest & (end > beyond + response.floor) & (end - before > response.floor)
    # with K = 0 a device always moves outwards: only a log that lasted for a while can have reached a limit
    left &= (batch.stiffness > 0) | (free_samples(batch, response) >= FEWEST_SAMPLES)
    return np.where(left, batch.rows - 1, NO_ROW).astype(np.int64)


def first_stop(batch: TrialBatch, response: Response, outside: Disturbance, device: PushResponse) -> Integers:
    """Return the first row at a rigid stop, -1 where there is none, shape (n,).

    Parameters
    ----------
    batch : TrialBatch
    response, outside, device : Response, Disturbance, PushResponse
        Of the same trials.

    Notes
    -----
    At a stop the position stands at its largest or smallest value for some rows that it reached at speed; or it is
    stopped there by a force that no command explains and that is larger than the step by far; or it turns there
    several times, each time faster on the way there than on the way back, where a free oscillation is as fast. A
    stop that is touched gently is not seen, nor is a soft one.
    """
    x, columns = batch.position, batch.position.shape[1]
    column = np.arange(columns)[None, :]
    after = batch.valid & (column >= np.maximum(response.edge_row, 0)[:, None])
    highest = np.max(np.where(after, x, -np.inf), axis=1, initial=-np.inf)[:, None]
    lowest = np.min(np.where(after, x, np.inf), axis=1, initial=np.inf)[:, None]
    # rounding of positions is far below a billionth of their range
    floor = np.maximum(response.floor[:, None], 1e-9 * (highest - lowest))
    change = np.abs(np.diff(x, axis=1, prepend=x[:, :1]))
    # the device may arrive between two samples: then the change before that one tells its speed
    speed = np.nan_to_num(np.maximum(change, np.roll(change, 1, axis=1)))
    before, behind = np.zeros_like(x), np.full_like(x, np.inf)
    before[:, 2:] = np.nan_to_num(np.abs(x[:, 2:] - x[:, :-2]))
    behind[:, :-2] = np.where(batch.valid[:, 2:], before[:, 2:], np.inf)
    blown = (outside.first_row >= 0) & (np.abs(outside.force) > BLOW * np.abs(batch.step))
    about = np.abs(column - outside.largest_row[:, None]) <= device.span
    first = np.full(len(batch), columns, dtype=np.int64)
    for side, depth in ((-1, highest - x), (1, x - lowest)):
        # twice the floor: from a quiet baseline the noise of a coarse sensor is read too small
        there = after & (depth <= 2 * floor)
        # a device that rests at its extreme before it moves has reached no stop
        there &= np.maximum.accumulate(after & ~there, axis=1)
        near = there & (depth <= 1.001 * floor)  # as far as rounding moves a position over the edge of a quantum
        arrives = near.copy()
        arrives[:, 1:] &= ~near[:, :-1]
        rebounds = arrives & (behind < before / ABRUPT) & (before > LOUD * floor)
        rebounds &= rebounds.sum(axis=1, keepdims=True) >= REBOUNDS
        # the force is inwards, at the extreme: the first time that the device was there
        thrown = there & (blown & (np.sign(outside.force) == side) & (there & about).any(axis=1))[:, None]
        hit = thrown | rebounds | (lasting(near, SETTLED_SAMPLES) & arrives & (speed > IMPACT * floor))
        first = np.where(hit.any(axis=1), np.minimum(first, np.argmax(hit, axis=1)), first)
    return np.where(first < columns, first, NO_ROW).astype(np.int64)


def first_clipped(batch: TrialBatch) -> tuple[Integers, Floats]:
    """Return the first row with a clipped command (-1: none) and the largest command [N, Nm], shape (n,) each.

    Notes
    -----
    A clipped command equals the largest one of the log, in two rows or more, and is not what the wall law asks for:
    nearer to zero by more than rounding. A velocity filter departs from the wall law too, but its extremes are not
    equal.
    """
    size = np.where(batch.valid, np.abs(batch.command), 0.0)
    largest = size.max(axis=1, initial=0.0)
    departure, step = external_force(batch), batch.step[:, None]
    # 0 or F_0 was asked for, whichever is nearer: before the edge and after it
    departure = np.where(np.abs(departure) < np.abs(departure - step), departure, departure - step)
    clipped = np.nan_to_num(-departure * np.sign(batch.command)) > BENT * np.abs(step)
    clipped &= size >= (1 - 1e-9) * largest[:, None]
    return np.where(clipped.sum(axis=1) >= 2, np.argmax(clipped, axis=1), NO_ROW).astype(np.int64), largest


def free_samples(batch: TrialBatch, response: Response) -> Integers:
    """Return the number of samples of free motion, shape (n,): after the step and twice the delay that it shows.

    Notes
    -----
    The first movement shows one delay; after another one the past before the step is forgotten. Sensor noise moves a
    soft device before the step does: a hundredth of the motion near the step is none. A log without any movement
    holds none.
    """
    column = np.arange(batch.position.shape[1])[None, :]
    edge = np.maximum(response.edge_row, 0)
    size = np.nan_to_num(np.abs(batch.displacement))
    largest = np.where(column <= (edge + UNMOVED_SAMPLES)[:, None], size, 0.0).max(axis=1, initial=0.0)
    still = np.maximum(np.maximum(response.floor, response.baseline_motion), 0.01 * largest)
    moved = (size > still[:, None]) & (column > response.edge_row[:, None])
    count = np.where(moved.any(axis=1), batch.rows - 1 - (2 * np.argmax(moved, axis=1) - edge), 0)
    return np.maximum(count, 0).astype(np.int64)
