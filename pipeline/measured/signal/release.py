"""Free motion of a trial without a step: released from a position, or hit.

Command plus wall force is the external force, whatever moves the device. Of a release by the controller it steps to
another level, of a hit by the controller it comes back to the first one; of a hand that lets go or hits it stays where
it is. From the row on from which it is constant the motion is free, and its growth shows stability as that of a step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.measured.signal.edge import EDGE_SAMPLES, LEVEL, NO_ROW, external_force
from pipeline.measured.signal.sensor import position_quantum, sensor_floor, white_noise
from pipeline.records.trials import Floats, Trial

NOISE_ROWS = 10
"""Rows at the begin of a log that show the noise of its sensor; a motion that begins in them counts as noise."""

CONSTANT = 1e-3
"""Change of the external force relative to the largest force of the wall up to which it is rounding of printed digits:
a hand moves the device, not the controller."""

SUDDEN = 0.25
"""Part of its first swing in which a device that a hand hits is fastest; one that is let go is so half-way."""

HELD = 0.1
"""Share of the largest command with which a wall pushes against a hand that keeps a device away from it."""

CHANGES = "the external force goes on to change: the motion is not free"
RESTS = "nothing moves"
NO_WALL = "without a wall and damping a motion shows no loop"
"""Why a trial without a step has no free motion to judge."""


@dataclass(frozen=True)
class Release:
    """What set a trial in motion; nothing does in a trial with a step.

    Parameters
    ----------
    begin : int
        First row in which the external force has changed, or the last one at rest before a hand moves the device;
        -1 where there is no free motion.
    free : int
        First row from which on the external force is constant; -1 likewise.
    level : float
        External force from then on, less that before [N, Nm]: 0 after a hit.
    size : float
        Largest change of the external force; where there is none, the force of the wall at the first turn [N, Nm].
    kind : {"", "release", "hit"}
        Whether the device was released from a position, or hit.
    reason : str
        Why there is no free motion; empty where there is.
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
    Levels are as near as those of a step (`edge.LEVEL`), relative to the largest change. With a velocity filter the
    external force is off it while the device moves; then a release or a hit counts whose force stays within half of its
    size, as an edge does.
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
    """Return the first row in which a device has moved by more than quantum and noise; None where it never does."""
    noise = white_noise(displacement[:NOISE_ROWS]) if len(displacement) > 2 * NOISE_ROWS else 0.0
    moved = np.flatnonzero(np.abs(displacement) > sensor_floor(quantum, noise))
    return int(moved[0]) if len(moved) else None


def _bent(change: Floats, onset: int) -> Release:
    """Return a release or a hit of which the external force stays within half of its size of a level."""
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
    """Return a release or a hit by hand: the external force stays, and the motion begins.

    The hand is gone when the device is fastest in its first swing, at the latest. Before a release it keeps the device
    at the wall, or moves it there.
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
    """Return the floor of the sensor and its noise by the rows before a motion begins [m, rad]."""
    noise = white_noise(trial.position[:begin])
    return sensor_floor(position_quantum(trial.position), noise), noise
