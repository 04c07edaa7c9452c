"""The motion of a device with Coulomb friction under known commands: several devices and all trials together.

Between two changes of its command the device moves as a linear one on which friction is a constant force, exactly. In
the sample in which the motor's side stops or is let go, what drives it counts as straight: beside a lag the motion is
right to some 4e-4 of its size, beside a mode to 1e-2, else to 1e-6.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.measured.ladder.open_loop import moved
from pipeline.records.batch import Booleans, Floats, Integers

_ROOT_STEPS = 2
"""Newton's steps to the time of a stop, which is a straight line's to a percent."""


@dataclass(frozen=True, eq=False)
class _Part:
    """Part of a sample, for V devices of S states: transitions (V, S, S) sliding and sticking, inputs (V, S, 1)."""

    duration: Floats
    slides: Floats
    sticks: Floats
    command: Floats
    friction: Floats


def sliding(loops: list[Loop], coulomb: Floats, command: Floats, force: Floats) -> Floats:
    """Return the sensed position of devices of unit mass that rest before the first row, shape (V, n, N).

    Parameters
    ----------
    loops : list of Loop, length V
        With the same parts.
    coulomb, force : float64, shape (V,)
        Coulomb friction, and a constant force beside the command [N, Nm].
    command : float64, shape (V, n, N)
        Of each device [N, Nm].
    """
    _, n, rows = command.shape
    devices = [_by_sides(loop) for loop in loops]
    sensors = np.stack([sensor for _, _, sensor in devices])
    rates = np.stack([matrix[1] for matrix, _, _ in devices])[:, None, :]
    pushes = np.array([push[1] for _, push, _ in devices])[:, None]
    holds = (coulomb * np.array([_blow(loop)[1] for loop in loops]))[:, None]
    whole = np.array([floor(loop.delay) for loop in loops])
    parts = _parts(loops, [loop.delay - floor(loop.delay) for loop in loops])
    sent = [
        (part, _sent(command, whole + age) + force[:, None]) for age, part in zip((1, 0), parts, strict=True) if part
    ]
    state = np.zeros((len(loops), sensors.shape[1], n))
    states = np.empty((rows, *state.shape))
    for k in range(rows):
        states[k] = state
        for part, u in sent:
            state = _ahead(state, u[k], part, rates, pushes, holds, coulomb[:, None])
    return np.asarray(np.einsum("vs,kvsn->vnk", sensors, states))


def _sent(command: Floats, late: Integers) -> Floats:
    """Return the commands in each row of devices that get them so many rows late, 0 before, shape (N, V, n)."""
    result = np.zeros((command.shape[2], *command.shape[:2]))
    for device, rows in enumerate(np.minimum(late, len(result)).tolist()):
        result[rows:, device] = command[device].T[: len(result) - rows]
    return result


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
        _let_go(held, free, np.matmul(rates, held)[:, 0] + pushes * u, holds, part.duration[:, None])
        after = np.where(stuck[:, None], held, after)
    turns = ~stuck & (after[:, 1] * direction < 0)
    if turns.any():
        forces = _Forces(free, holds, rates[:, 0, 1], part.duration)
        _stopped(after, state, turns, direction, forces)
    result: Floats = after
    return result


def _let_go(held: Floats, before: Floats, behind: Floats, holds: Floats, duration: Floats) -> None:
    """Set position and velocity where friction no longer holds the motor's side behind a part, from the time on.

    ``before`` and ``behind`` are the accelerations that it would have without friction, straight over the part.
    """
    goes = (np.abs(before) <= holds) & (np.abs(behind) > holds)
    if not goes.any():
        return
    device, trial = np.nonzero(goes)
    h, pull, push = duration[device, 0], before[goes], behind[goes]
    rise = (push - pull) / h
    left = np.minimum((push - np.sign(push) * holds[device, 0]) / rise, h)
    _shift(held, device, trial, rise * left**3 / 6, 0.5 * rise * left**2)


@dataclass(frozen=True, eq=False)
class _Forces:
    """Accelerations of the motor's side without friction (V, n), by friction (V, 1), and by a unit of speed (V,).

    ``duration`` (V,) is that of the part.
    """

    free: Floats
    holds: Floats
    by_speed: Floats
    duration: Floats


def _stopped(after: Floats, state: Floats, turns: Booleans, direction: Floats, forces: _Forces) -> None:
    """Set position and velocity of the motor's side where it stops within a part: it sticks, or turns back.

    What drives it counts as straight over the part.
    """
    device, trial = np.nonzero(turns)
    x, v, end = state[device, 0, trial], state[device, 1, trial], after[device, 1, trial]
    sign, hold, h = direction[turns], forces.holds[device, 0], forces.duration[device]
    free = forces.free[turns]
    slows = free - sign * hold
    jerk = 2 * (end - v - slows * h) / h**2
    until = h * v / (v - end)
    for _ in range(_ROOT_STEPS):
        until -= (v + until * (slows + 0.5 * jerk * until)) / (slows + jerk * until)
    until = np.clip(np.nan_to_num(until), 0.0, h)
    left, pull = h - until, free + jerk * until
    back = pull + sign * hold
    bend = jerk + forces.by_speed[device] * (back - slows)
    back, bend = (np.where(np.abs(pull) <= hold, 0.0, each) for each in (back, bend))
    stop = x + until * (v + until * (0.5 * slows + jerk * until / 6))
    position, velocity = stop + left**2 * (0.5 * back + bend * left / 6), left * (back + 0.5 * bend * left)
    _shift(after, device, trial, position - after[device, 0, trial], velocity - end)


def _shift(state: Floats, device: Integers, trial: Integers, position: Floats, velocity: Floats) -> None:
    """Move the motor's side; a far mass, whose place is relative to it, stays where it is."""
    mode = state.shape[1] > 3
    for row, change in ((0, position), (1, velocity), *(((2, -position), (3, -velocity)) if mode else ())):
        state[device, row, trial] += change


def _parts(loops: list[Loop], fractions: list[float]) -> tuple[_Part | None, _Part]:
    """Return the part of a sample before its command changes, None where no device has one, and the part behind."""
    early = _part(loops, np.array(fractions)) if any(fractions) else None
    return early, _part(loops, 1 - np.array(fractions))


def _part(loops: list[Loop], duration: Floats) -> _Part:
    slides, sticks, command, friction = [], [], [], []
    for loop, time in zip(loops, duration, strict=True):
        matrix, push, _ = _by_sides(loop)
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


def _by_sides(loop: Loop) -> tuple[Floats, Floats, Floats]:
    """Return matrix, input and sensor of a device by its sides: the motor's, and the far mass's from there."""
    matrix, push, sensor = loop.device
    if loop.mode is None:
        return matrix, push, sensor
    near = 1.0 - loop.mode.far_mass
    turn = np.eye(len(push))
    turn[0, 2] = turn[1, 3] = -loop.mode.far_mass / near
    turn[2, 2] = turn[3, 3] = 1 / near
    back = np.linalg.inv(turn)
    return turn @ matrix @ back, turn @ push, sensor @ back


def _blow(loop: Loop) -> Floats:
    """Return what a unit of force on the motor's side itself does to the states: it passes no lag."""
    near = 1.0 - (loop.mode.far_mass if loop.mode else 0.0)
    result = np.zeros(len(loop.device[1]))
    result[1] = 1 / near
    if loop.mode is not None:
        result[3] = -1 / near
    return result
