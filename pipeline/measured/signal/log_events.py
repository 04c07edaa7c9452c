"""Limits that end a log or bend it: the travel of the device, rigid stops, the largest command."""

from __future__ import annotations

import numpy as np

from pipeline.measured.signal.disturbance import LONGEST_DELAY, Disturbance, PushResponse
from pipeline.measured.signal.edge import BENT, lasting
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, SETTLED_SAMPLES, Response, external_force
from pipeline.records.trials import Booleans, Floats, Integers, Trial

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


def left_travel(trial: Trial, response: Response, usual: int) -> int:
    """Return the last row of a log that ended because the device left its travel, -1 for another.

    Parameters
    ----------
    trial : Trial
    response : Response
    usual : int
        Rows of most logs of the experiment: a shorter one ended early.

    Notes
    -----
    Such a log is short, and ends with the largest distance from the final position (K > 0; larger than that of
    the start, which is inside the travel) or from the start (K = 0), moving outwards. A growing oscillation whose
    recording was stopped by hand at that moment looks the same. In an experiment whose logs all end early, or
    of a single log, it cannot be decided.
    """
    if trial.rows >= usual:
        return NO_ROW
    wall, start = trial.stiffness > 0, response.position_start
    centre = response.position_final_expected if wall else start
    distance = np.abs(trial.position - centre)
    end, before = float(distance[-1]), float(distance[max(trial.rows - 2, 0)])
    outwards = end > (abs(start - centre) if wall else 0.0) + response.floor and end - before > response.floor
    # with K = 0 a device always moves outwards: only a log that lasted for a while can have reached a limit
    lasted = wall or free_samples(trial, response) >= FEWEST_SAMPLES
    return trial.rows - 1 if outwards and lasted and end >= distance.max() else NO_ROW


def first_stop(trial: Trial, response: Response, outside: Disturbance, device: PushResponse) -> int:
    """Return the first row at a rigid stop, -1 where there is none.

    Parameters
    ----------
    trial, response, outside, device : Trial, Response, Disturbance, PushResponse

    Notes
    -----
    At a stop the position stands at its largest or smallest value for some rows that it reached at speed; or it is
    stopped there by a force that no command explains and that is larger than the step by far; or it turns there
    several times, each time faster on the way there than on the way back, where a free oscillation is as fast. A
    stop that is touched gently is not seen, nor is a soft one.
    """
    edge = max(response.edge_row, 0)
    after = trial.position[edge:]
    highest, lowest = after.max(), after.min()
    # rounding of positions is far below a billionth of their range
    floor = max(response.floor, 1e-9 * (highest - lowest))
    blown = outside.first_row >= 0 and abs(outside.force) > BLOW * abs(trial.step)
    first = trial.rows
    for side, depth in ((-1, highest - after), (1, after - lowest)):
        # twice the floor: from a quiet baseline the noise of a coarse sensor is read too small
        there = depth <= 2 * floor
        # a device that rests at its extreme before it moves has reached no stop
        there[: int(there.argmin()) if not there.all() else None] = False
        rows = edge + np.flatnonzero(there)
        # the force is inwards, at the extreme: the first time that the device was there
        about = (np.abs(rows - outside.largest_row) <= device.span).any()
        hits = rows[:1] if blown and np.sign(outside.force) == side and about else rows[:0]
        # as far as rounding moves a position over the edge of a quantum
        near = there & (depth <= 1.001 * floor)
        hits = np.concatenate((hits, _arrivals(trial.position, edge, near, floor)))
        first = min(first, int(hits.min(initial=first)))
    return first if first < trial.rows else NO_ROW


def _arrivals(x: Floats, edge: int, near: Booleans, floor: float) -> Integers:
    """Return the rows in which a device arrives at an extreme at speed, and stays or is thrown back.

    Parameters
    ----------
    x : float64, shape (rows,)
    edge : int
    near : bool, shape (rows - edge,)
        Rows from the edge on in which the device is at the extreme.
    floor : float
        Sensor floor [m, rad].
    """
    begins = np.flatnonzero(near[1:] & ~near[:-1]) + 1
    stays = lasting(near, SETTLED_SAMPLES)[begins]
    rows = edge + begins
    # the device may arrive between two samples: then the change before that one shows its speed
    speed = np.maximum(np.abs(x[rows] - x[rows - 1]), np.abs(x[rows - 1] - x[np.maximum(rows - 2, 0)]))
    before = np.where(rows > 1, np.abs(x[rows] - x[np.maximum(rows - 2, 0)]), 0.0)
    last = len(x) - 1
    behind = np.where(rows + 2 <= last, np.abs(x[np.minimum(rows + 2, last)] - x[rows]), np.inf)
    rebounds = (behind < before / ABRUPT) & (before > LOUD * floor)
    rebounds &= rebounds.sum() >= REBOUNDS
    return rows[rebounds | (stays & (speed > IMPACT * floor))]


def first_clipped(trial: Trial) -> tuple[int, float]:
    """Return the first row with a clipped command (-1: none) and the largest command [N, Nm].

    Notes
    -----
    A clipped command equals the largest one of the log, in two rows or more, and is not what the wall law asks for:
    nearer to zero by more than rounding. A velocity filter departs from the wall law too, but its extremes are not
    equal.
    """
    size = np.abs(trial.command)
    largest = float(size.max())
    rows = np.flatnonzero(size >= (1 - 1e-9) * largest)
    if len(rows) < 2:
        return NO_ROW, largest
    departure = external_force(trial)[rows]
    # 0 or F_0 was asked for, whichever is nearer: before the edge and after it
    departure = np.where(np.abs(departure) < np.abs(departure - trial.step), departure, departure - trial.step)
    rows = rows[-departure * np.sign(trial.command[rows]) > BENT * abs(trial.step)]
    return int(rows[0]) if len(rows) >= 2 else NO_ROW, largest


def free_samples(trial: Trial, response: Response) -> int:
    """Return the number of samples of free motion: after the step and twice the delay that it shows.

    Notes
    -----
    The first movement shows one delay; after another one the past before the step is forgotten. Sensor noise moves a
    soft device before the step does: a hundredth of the motion near the step is none. A log without any movement
    has none.
    """
    edge = max(response.edge_row, 0)
    size = np.abs(trial.displacement)
    largest = float(size[: edge + UNMOVED_SAMPLES + 1].max())
    moved = size[response.edge_row + 1 :] > max(response.floor, response.baseline_motion, 0.01 * largest)
    if not moved.any():
        return 0
    onset = response.edge_row + 1 + int(moved.argmax())
    return max(trial.rows - 1 - (2 * onset - edge), 0)
