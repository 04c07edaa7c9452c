"""Limits that end a log or distort it: the travel of the device, rigid stops, the largest command."""

from __future__ import annotations

import numpy as np

from pipeline.measured.signal.disturbance import LONGEST_DELAY, Disturbance, PushResponse
from pipeline.measured.signal.edge import BENT, lasting
from pipeline.measured.signal.modes import FEWEST_SAMPLES
from pipeline.measured.signal.response import NO_ROW, SETTLED_SAMPLES, Response, external_force
from pipeline.records.trials import Booleans, Floats, Integers, Trial

IMPACT = 6.0
"""Smallest change before the position stops, in floors. A smooth reversal that stays within a floor and the rounding of
a quantum for 5 rows arrives with 4 at most."""

ABRUPT, REBOUNDS, LOUD = 4.0, 3, 40.0
"""Smallest distance travelled in the two samples before a reversal, relative to the two after it (2.2 at most for a
smooth reversal), number of such reversals at one extreme that show a stop, and this distance in floors: if it is
smaller, a smooth reversal stays for several samples."""

BLOW = 2.0
"""Smallest force of an impact relative to the step: hands push with less, and impacts at 0.2 m/s cause more."""

UNMOVED_SAMPLES = LONGEST_DELAY + 2 * FEWEST_SAMPLES
"""Number of samples after the step for which a device at rest may still be waiting for the command: twice the number
that a verdict needs after the delay."""


def usual_length(rows: Integers) -> int:
    """Return the most frequent number of rows of the logs, the largest of equally frequent ones; 0 without logs."""
    lengths, counts = np.unique(rows, return_counts=True)
    return int(lengths[len(counts) - 1 - np.argmax(counts[::-1])]) if len(counts) else 0


def left_travel(trial: Trial, response: Response, usual: int) -> int:
    """Return the last row of a log that ended because the device left its travel, -1 for other logs.

    Parameters
    ----------
    trial : Trial
    response : Response
    usual : int
        Number of rows of most logs of the experiment; a shorter log ended early.

    Notes
    -----
    Such a log is short, and ends while moving outwards, at the largest distance from the final position (K > 0; larger
    than that of the start, which is inside the travel) or from the start (K = 0). A growing oscillation whose recording
    was stopped by hand at that moment looks the same. The question cannot be decided for a single log, or if all logs
    of the experiment end early.
    """
    if trial.rows >= usual:
        return NO_ROW
    wall, start = trial.stiffness > 0, response.position_start
    centre = response.position_final_expected if wall else start
    distance = np.abs(trial.position - centre)
    end, before = float(distance[-1]), float(distance[max(trial.rows - 2, 0)])
    outwards = end > (abs(start - centre) if wall else 0.0) + response.floor and end - before > response.floor
    # with K = 0 a device always moves outwards: only a sufficiently long log can have reached a limit
    lasted = wall or free_samples(trial, response) >= FEWEST_SAMPLES
    return trial.rows - 1 if outwards and lasted and end >= distance.max() else NO_ROW


def first_stop(trial: Trial, response: Response, outside: Disturbance, device: PushResponse) -> int:
    """Return the first row at a rigid stop, -1 if there is none.

    Parameters
    ----------
    trial, response, outside, device : Trial, Response, Disturbance, PushResponse

    Notes
    -----
    At a stop the device reaches its largest or smallest position at speed and rests there for some rows; or it is
    stopped there by a force that the command does not explain and that is far larger than the step; or it reverses
    there several times, each time faster before than after the reversal, while a free oscillation is equally fast. A
    stop that is touched gently, or a soft one, is not detected.
    """
    edge = max(response.edge_row, 0)
    after = trial.position[edge:]
    highest, lowest = after.max(), after.min()
    # rounding of positions is far below a billionth of their range
    floor = max(response.floor, 1e-9 * (highest - lowest))
    blown = outside.first_row >= 0 and abs(outside.force) > BLOW * abs(trial.step)
    first = trial.rows
    for side, depth in ((-1, highest - after), (1, after - lowest)):
        # twice the floor: a quiet baseline underestimates the noise of a coarse sensor
        there = depth <= 2 * floor
        # a device that rests at its extreme before it moves has not reached a stop
        there[: int(there.argmin()) if not there.all() else None] = False
        rows = edge + np.flatnonzero(there)
        # inward force at the extreme: take the first time that the device was there
        about = (np.abs(rows - outside.largest_row) <= device.span).any()
        hits = rows[:1] if blown and np.sign(outside.force) == side and about else rows[:0]
        # allow for rounding that moves a position to the next quantum
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
    # the device may arrive between two samples: the previous change then shows its speed
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
    A clipped command equals the largest one of the log in two rows or more, and is closer to zero than the wall law
    demands, by more than rounding. A velocity filter also causes deviations from the wall law, but its extremes are not
    equal.
    """
    size = np.abs(trial.command)
    largest = float(size.max())
    rows = np.flatnonzero(size >= (1 - 1e-9) * largest)
    if len(rows) < 2:
        return NO_ROW, largest
    departure = external_force(trial)[rows]
    # the external force is 0 before the edge and F_0 after it: compare with the nearer one
    departure = np.where(np.abs(departure) < np.abs(departure - trial.step), departure, departure - trial.step)
    rows = rows[-departure * np.sign(trial.command[rows]) > BENT * abs(trial.step)]
    return int(rows[0]) if len(rows) >= 2 else NO_ROW, largest


def free_samples(trial: Trial, response: Response) -> int:
    """Return the number of samples of free motion, counted from the step plus twice the observed delay.

    Notes
    -----
    The first movement shows one delay; after a second one, commands from before the step no longer have an effect.
    Sensor noise may move a soft device before the step does, so a hundredth of the motion does not count near the step.
    A log without movement has no free samples.
    """
    edge = max(response.edge_row, 0)
    size = np.abs(trial.displacement)
    largest = float(size[: edge + UNMOVED_SAMPLES + 1].max())
    moved = size[response.edge_row + 1 :] > max(response.floor, response.baseline_motion, 0.01 * largest)
    if not moved.any():
        return 0
    onset = response.edge_row + 1 + int(moved.argmax())
    return max(trial.rows - 1 - (2 * onset - edge), 0)
