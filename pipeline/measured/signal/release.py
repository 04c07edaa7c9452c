"""Find the free motion of a trial without a step, in which the device is released from a position or hit.

The external force is the command plus the wall force, whatever moves the device. If the controller releases the device,
the external force steps to another level. If the controller hits the device, the force returns to its first level. If a
hand releases or hits the device, the force stays constant. The motion is free once the force is constant. The growth of
the motion then shows stability, as after a step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.measured.signal.edge import EDGE_SAMPLES, LEVEL, NO_ROW, external_force
from pipeline.measured.signal.sensor import position_quantum, sensor_floor, white_noise
from pipeline.records.trials import Floats, Trial

NOISE_ROWS = 10
"""Number of rows at the beginning of a log from which sensor noise is estimated. A motion in these rows is treated as
noise."""

CONSTANT = 1e-3
"""Largest change of the external force, relative to the largest wall force, that is attributed to printed digits. A
hand, and not the controller, then moves the device."""

SUDDEN = 0.25
"""Share of the first swing within which a device hit by a hand is fastest. A released device is fastest half-way."""

HELD = 0.1
"""Smallest command before the motion at which a hand counts as holding the device off its rest position, relative to
the largest command."""

CHANGES = "the external force continues to change, so the motion is not free"
RESTS = "the device does not move"
NO_WALL = "without virtual stiffness and damping, a motion contains no information on the loop"
"""Reasons why a trial without a step has no free motion to judge."""


@dataclass(frozen=True)
class Release:
    """Start of the motion of a trial without a step. The default values are for a trial with a step.

    Parameters
    ----------
    begin : int
        First row in which the external force has changed, or the last row at rest before a hand moves the device, or -1
        if there is no free motion.
    free : int
        First row from which the external force is constant, or -1 if there is no free motion.
    level : float
        External force after the motion begins, minus the force before [N, Nm], or 0 after a hit.
    size : float
        Largest change of the external force. If this force is constant, the largest change of the wall force in the
        first swing [N, Nm].
    kind : {"", "release", "hit"}
        Whether the device was released from a position, or hit.
    reason : str
        Reason why there is no free motion, or an empty text.
    """

    begin: int = NO_ROW
    free: int = NO_ROW
    level: float = 0.0
    size: float = np.nan
    kind: Literal["", "release", "hit"] = ""
    reason: str = ""


def find_release(trial: Trial) -> Release:
    """Find the free motion of a trial without a step.

    Parameters
    ----------
    trial : Trial

    Notes
    -----
    The tolerance of levels is as for a step (`edge.LEVEL`), relative to the largest change. With a velocity filter, the
    external force deviates from its level while the device moves. A release or a hit is then accepted if the force
    stays within half of its size, as for an edge.
    """
    if trial.step != 0:
        return Release()
    if trial.stiffness == 0 and trial.damping == 0:
        return Release(reason=NO_WALL)
    displacement = trial.displacement
    onset = _onset(displacement, position_quantum(trial.position))
    if onset is None:
        return Release(reason=RESTS)
    force = external_force(trial)
    wall = force - trial.command
    change = force - float(np.median(force[: max(onset, 1)]))
    size = float(np.abs(change).max())
    if size <= CONSTANT * np.abs(wall).max():
        return _by_hand(trial, wall, onset)
    level = float(np.median(change[len(change) // 2 :]))
    level = level if abs(level) > LEVEL * size else 0.0
    begin = int(np.argmax(np.abs(change) > 0.5 * size))
    off = np.flatnonzero(np.abs(change - level) > LEVEL * size)
    free = int(off[-1]) + 1 if len(off) else begin
    if free <= begin + (len(change) - begin) // 2:
        return Release(begin, free, level, size, "hit" if level == 0 else "release")
    return _bent(change, onset)


def _onset(displacement: Floats, quantum: float) -> int | None:
    """Return the first row in which the device has moved by more than quantum and noise, or None if it never moves."""
    noise = white_noise(displacement[:NOISE_ROWS]) if len(displacement) > 2 * NOISE_ROWS else 0.0
    moved = np.flatnonzero(np.abs(displacement) > sensor_floor(quantum, noise))
    return int(moved[0]) if len(moved) else None


def _bent(change: Floats, onset: int) -> Release:
    """Return a release or a hit if the external force stays within half of its largest change from a level."""
    early = np.abs(change[: onset + 1])
    size = float(early.max())
    begin = int(np.argmax(early > 0.5 * size)) if size > 0 else 0
    ahead = change[begin:] * np.sign(change[begin])
    high = ahead > 0.5 * size
    if size > 0 and high.all():
        return Release(begin, begin, float(np.sign(change[begin]) * size), size, "release")
    back = begin + int(np.argmin(high))
    if size > 0 and len(change) - back >= EDGE_SAMPLES and (np.abs(change[back:]) <= 0.5 * size).all():
        return Release(begin, back, 0.0, size, "hit")
    return Release(reason=CHANGES)


def _by_hand(trial: Trial, wall: Floats, onset: int) -> Release:
    """Return a release or a hit by hand, during which the external force stays constant.

    The hand has let go at the latest when the device is fastest in its first swing. Before a release, the hand keeps
    the device at the wall or moves it there.
    """
    begin = max(onset - 1, 0)
    speed = np.diff(trial.displacement[begin:])
    turns = np.flatnonzero(speed * speed[0] < 0)
    swing = np.abs(speed[: int(turns[0])]) if len(turns) else speed[:1]
    fastest = begin + int(np.argmax(swing))
    size = float(np.abs(wall[begin : begin + len(swing) + 1] - wall[begin]).max())
    held = abs(float(np.median(trial.command[: begin + 1]))) > HELD * float(np.abs(trial.command).max())
    kind: Literal["hit", "release"] = "hit" if not held and fastest - begin <= SUDDEN * len(swing) else "release"
    return Release(begin, fastest, 0.0, max(size, float(np.finfo(np.float64).tiny)), kind)


def at_rest_before(trial: Trial, begin: int) -> tuple[float, float]:
    """Return the sensor floor and the noise in the rows before a motion begins [m, rad]."""
    noise = white_noise(trial.position[:begin])
    return sensor_floor(position_quantum(trial.position), noise), noise
