"""The motion of a device with Coulomb friction under known commands: several devices and all trials together.

Between two changes of its command the device moves as a linear one on which friction is a constant force, exactly. In
the sample in which the motor's side stops, lag, mode, damper and spring count as constant: what that misses is of third
order in the sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

import numpy as np

from pipeline.loop.device_loop import DeviceLoop
from pipeline.measured.ladder.plant import moved
from pipeline.records.batch import Floats, Integers


@dataclass(frozen=True, eq=False)
class _Part:
    """Part of a sample, for V devices of S states: transitions (V, S, S) sliding and sticking, inputs (V, S, 1)."""

    duration: Floats
    slides: Floats
    sticks: Floats
    command: Floats
    friction: Floats


def sliding(loops: list[DeviceLoop], coulomb: Floats, command: Floats, force: Floats) -> Floats:
    """Return the sensed position of devices of unit mass that rest before the first row, shape (V, n, N).

    Parameters
    ----------
    loops : list of DeviceLoop, length V
        With the same parts.
    coulomb, force : float64, shape (V,)
        Coulomb friction, and a constant force beside the command [N, Nm].
    command : float64, shape (n, N)
        [N, Nm].
    """
    n, rows = command.shape
    sensors = np.stack([loop.device[2] for loop in loops])
    rates = np.stack([loop.device[0][1] for loop in loops])[:, None, :]
    pushes = np.array([loop.device[1][1] for loop in loops])[:, None]
    holds = (coulomb * np.array([_blow(loop)[1] for loop in loops]))[:, None]
    whole = np.array([floor(loop.delay) for loop in loops])
    parts = _parts(loops, [loop.delay - floor(loop.delay) for loop in loops])
    state = np.zeros((len(loops), sensors.shape[1], n))
    position = np.empty((rows, len(loops), n))
    for k in range(rows):
        position[k] = np.einsum("vs,vsn->vn", sensors, state)
        for age, part in zip((1, 0), parts, strict=True):
            if part is None:
                continue
            u = _sent(command, k - whole - age) + force[:, None]
            state = _ahead(state, u, part, rates, pushes, holds, coulomb[:, None])
    return np.asarray(position.transpose(1, 2, 0))


def _sent(command: Floats, row: Integers) -> Floats:
    """Return the commands of a row for each device, 0 before the log, shape (V, n)."""
    return np.where((row >= 0)[:, None], command[:, np.maximum(row, 0)].T, 0.0)


def _ahead(
    state: Floats, u: Floats, part: _Part, rates: Floats, pushes: Floats, holds: Floats, coulomb: Floats
) -> Floats:
    """Return the states after a part of a sample under commands u, shape (V, S, n)."""
    v = state[:, 1]
    free = np.matmul(rates, state)[:, 0] + pushes * u
    rests = v == 0
    stuck = rests & (np.abs(free) <= holds)
    direction = np.where(rests, np.sign(free), np.sign(v))
    driven = part.command * u[:, None]
    after = np.matmul(part.slides, state) + driven - part.friction * (direction * coulomb)[:, None]
    if stuck.any():
        held = np.matmul(part.sticks, state) + driven
        held[:, :2] = state[:, :2]
        after = np.where(stuck[:, None], held, after)
    turns = ~stuck & (after[:, 1] * direction < 0)
    if turns.any():
        _stopped(after, state, turns, direction, holds, part.duration)
    result: Floats = after
    return result


def _stopped(
    after: Floats, state: Floats, turns: np.ndarray, direction: Floats, holds: Floats, duration: Floats
) -> None:
    """Set position and velocity of the motor's side where it stops within a part: it sticks, or turns back."""
    device, trial = np.nonzero(turns)
    x, v, end = state[device, 0, trial], state[device, 1, trial], after[device, 1, trial]
    sign, hold, h = direction[turns], holds[device, 0], duration[device]
    free = (end - v) / h + sign * hold
    until = h * v / (v - end)
    left, back = h - until, np.where(np.abs(free) <= hold, 0.0, free + sign * hold)
    after[device, 0, trial] = x + 0.5 * v * until + 0.5 * back * left**2
    after[device, 1, trial] = back * left


def _parts(loops: list[DeviceLoop], fractions: list[float]) -> tuple[_Part | None, _Part]:
    """Return the part of a sample before its command changes, None where no device has one, and the part behind."""
    early = _part(loops, np.array(fractions)) if any(fractions) else None
    return early, _part(loops, 1 - np.array(fractions))


def _part(loops: list[DeviceLoop], duration: Floats) -> _Part:
    slides, sticks, command, friction = [], [], [], []
    for loop, time in zip(loops, duration, strict=True):
        matrix, push, _ = loop.device
        held = matrix.copy()
        held[:2] = 0.0
        if loop.mode is not None:
            # what the motor's side does no longer moves the far mass
            spring = np.array([loop.mode.stiffness, loop.mode.damping])
            held[3] = 0.0
            held[3, 2:4] = -spring / loop.mode.far_mass
        transition, gain = moved(matrix, push, time)
        slides.append(transition)
        command.append(gain)
        friction.append(moved(matrix, _blow(loop), time)[1])
        sticks.append(moved(held, push, time)[0])
    named = (np.array(slides), np.array(sticks), np.array(command)[:, :, None], np.array(friction)[:, :, None])
    return _Part(np.maximum(duration, 1e-300), *named)


def _blow(loop: DeviceLoop) -> Floats:
    """Return what a unit of force on the motor's side itself does to the states: it passes no lag."""
    near = 1.0 - (loop.mode.far_mass if loop.mode else 0.0)
    result = np.zeros(len(loop.device[1]))
    result[1] = 1 / near
    if loop.mode is not None:
        result[3] = -1 / near
    return result
