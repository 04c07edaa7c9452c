"""Detect limits that end or distort a log: the travel of the device, rigid stops, and the largest command."""

from __future__ import annotations

import numpy as np

from pipeline.measured.signal.disturbance import LONGEST_DELAY, Disturbance, PushResponse
from pipeline.measured.signal.edge import BENT, lasting
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, SETTLED_SAMPLES, Response, external_force
from pipeline.records.trials import Booleans, Floats, Integers, Trial

IMPACT = 6.0
"""Smallest change of the position before a stop, in sensor floors. Before a smooth reversal that stays within a floor
and the rounding to a quantum for 5 rows, the change is at most 4."""

ABRUPT, REBOUNDS, LOUD = 4.0, 3, 40.0
"""Smallest ratio of the distance in the two samples before a reversal to the distance in the two samples after it (at
most 2.2 for a smooth reversal), number of such reversals at one extreme that indicate a stop, and smallest distance
before a reversal in sensor floors. Below this distance, a smooth reversal stays for several samples."""

BLOW = 2.0
"""Smallest force of an impact relative to the step. Hands push with less force, whereas impacts at 0.2 m/s cause larger
forces."""

UNMOVED_SAMPLES = LONGEST_DELAY + 2 * FEWEST_SAMPLES
"""Number of samples after the step for which a device at rest may still be waiting for the command. It is the longest
delay plus twice the number of samples that a verdict requires."""


def usual_length(rows: Integers) -> int:
    """Return the most frequent number of rows, or the largest of equally frequent numbers. Without logs, return 0."""
    lengths, counts = np.unique(rows, return_counts=True)
    return int(lengths[len(counts) - 1 - np.argmax(counts[::-1])]) if len(counts) else 0


def left_travel(trial: Trial, response: Response, usual: int) -> int:
    """Return the last row of a log that ended because the device left its travel, or -1 for other logs.

    Parameters
    ----------
    trial : Trial
    response : Response
    usual : int
        Usual number of rows of the logs of the experiment. A shorter log ended early.

    Notes
    -----
    Such a log is short and ends while the device moves outwards. With K > 0, it ends at the largest distance from the
    final position, beyond the distance of the start, which is inside the travel. With K = 0, it ends at the largest
    distance from the start. A growing oscillation whose recording was stopped manually at that moment looks the same.
    A single log, or an experiment in which all logs end early, does not show whether the travel was left.
    """
    if trial.rows >= usual:
        return NO_ROW
    wall, start = trial.stiffness > 0, response.position_start
    centre = response.position_final_expected if wall else start
    distance = np.abs(trial.position - centre)
    end, before = float(distance[-1]), float(distance[max(trial.rows - 2, 0)])
    outwards = end > (abs(start - centre) if wall else 0.0) + response.floor and end - before > response.floor
    # with K = 0, a device always moves outwards: only a sufficiently long log can have reached a limit
    lasted = wall or free_samples(trial, response) >= FEWEST_SAMPLES
    return trial.rows - 1 if outwards and lasted and end >= distance.max() else NO_ROW


def first_stop(trial: Trial, response: Response, outside: Disturbance, device: PushResponse) -> int:
    """Return the first row at a rigid stop, or -1 if there is none.

    Parameters
    ----------
    trial, response, outside, device : Trial, Response, Disturbance, PushResponse

    Notes
    -----
    There are three kinds of evidence for a stop. The device reaches its largest or smallest position at speed and rests
    there for some rows. A force that the command does not explain, and that is far larger than the step, stops the
    device there. The device reverses there several times, each time faster before than after the reversal, whereas a
    free oscillation is equally fast. A soft stop, or a stop that is reached slowly, is not detected.
    """
    edge = max(response.edge_row, 0)
    after = trial.position[edge:]
    highest, lowest = after.max(), after.min()
    # rounding of positions is far below a billionth of their range
    floor = max(response.floor, 1e-9 * (highest - lowest))
    blown = outside.first_row >= 0 and abs(outside.force) > BLOW * abs(trial.step)
    first = trial.rows
    for side, depth in ((-1, highest - after), (1, after - lowest)):
        # twice the floor, since a quiet baseline underestimates the noise of a coarse sensor
        there = depth <= 2 * floor
        # a device that rests at its extreme before the motion has not reached a stop
        there[: int(there.argmin()) if not there.all() else None] = False
        rows = edge + np.flatnonzero(there)
        # if the force at the extreme points inwards, use the first row at the extreme
        about = (np.abs(rows - outside.largest_row) <= device.span).any()
        hits = rows[:1] if blown and np.sign(outside.force) == side and about else rows[:0]
        # allow for rounding of a position to the next quantum
        near = there & (depth <= 1.001 * floor)
        hits = np.concatenate((hits, _arrivals(trial.position, edge, near, floor)))
        first = min(first, int(hits.min(initial=first)))
    return first if first < trial.rows else NO_ROW


def _arrivals(x: Floats, edge: int, near: Booleans, floor: float) -> Integers:
    """Return the rows in which a device arrives at an extreme at speed, and stays or rebounds.

    Parameters
    ----------
    x : float64, shape (rows,)
    edge : int
    near : bool, shape (rows - edge,)
        Whether the device is at the extreme in each row from the edge onward.
    floor : float
        Sensor floor [m, rad].
    """
    begins = np.flatnonzero(near[1:] & ~near[:-1]) + 1
    stays = lasting(near, SETTLED_SAMPLES)[begins]
    rows = edge + begins
    # The device may arrive between two samples. In this case, the change before shows its speed.
    speed = np.maximum(np.abs(x[rows] - x[rows - 1]), np.abs(x[rows - 1] - x[np.maximum(rows - 2, 0)]))
    before = np.where(rows > 1, np.abs(x[rows] - x[np.maximum(rows - 2, 0)]), 0.0)
    last = len(x) - 1
    behind = np.where(rows + 2 <= last, np.abs(x[np.minimum(rows + 2, last)] - x[rows]), np.inf)
    rebounds = (behind < before / ABRUPT) & (before > LOUD * floor)
    rebounds &= rebounds.sum() >= REBOUNDS
    return rows[rebounds | (stays & (speed > IMPACT * floor))]


def first_clipped(trial: Trial) -> tuple[int, float]:
    """Return the first row with a clipped command (-1 if none) and the largest command [N, Nm].

    Notes
    -----
    A command is clipped if it has the largest value of the log in at least two rows, and is closer to zero than the
    wall law requires, by more than rounding. A velocity filter also causes deviations from the wall law, but its
    extremes differ from each other.
    """
    size = np.abs(trial.command)
    largest = float(size.max())
    rows = np.flatnonzero(size >= (1 - 1e-9) * largest)
    if len(rows) < 2:
        return NO_ROW, largest
    departure = external_force(trial)[rows]
    # the external force is 0 before the edge and F_0 after it: compare with the closer value
    departure = np.where(np.abs(departure) < np.abs(departure - trial.step), departure, departure - trial.step)
    rows = rows[-departure * np.sign(trial.command[rows]) > BENT * abs(trial.step)]
    return int(rows[0]) if len(rows) >= 2 else NO_ROW, largest


def free_samples(trial: Trial, response: Response) -> int:
    """Return the number of samples of free motion, counted from the step plus twice the observed delay.

    Notes
    -----
    The first movement shows one delay. After a second delay, commands from before the step have no effect. Sensor noise
    may move a soft device before the step does, so motion below a hundredth of the largest motion is ignored. A log
    without movement has no free samples.
    """
    edge = max(response.edge_row, 0)
    size = np.abs(trial.displacement)
    largest = float(size[: edge + UNMOVED_SAMPLES + 1].max())
    moved = size[response.edge_row + 1 :] > max(response.floor, response.baseline_motion, 0.01 * largest)
    if not moved.any():
        return 0
    onset = response.edge_row + 1 + int(moved.argmax())
    return max(trial.rows - 1 - (2 * onset - edge), 0)
