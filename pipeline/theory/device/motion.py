"""Points of a general loop in motion after a step: exact from sample to sample, and where it is asked for between."""

from __future__ import annotations

from copy import copy
from functools import lru_cache

import numpy as np

from pipeline.loop.device_loop import DeviceLoop
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.device.pieces import DEGREE, pieces, starts


@lru_cache(maxsize=64)
def _interval(loop: DeviceLoop) -> tuple[Floats, Floats, Floats, Floats]:
    """Return what a sampling interval makes of the loop's state, each as rows (r, states) and the force's part (r,).

    First what is `DeviceLoop.seen`; then sensed position, filtered velocity, the next state, and for each piece the
    position at its end and the velocities at both ends.
    """
    free, push, position, velocity = loop.open_loop
    newest, sensor = loop.states - loop.oldest_force - 1, loop.device[2]
    seen, seen_force = np.eye(len(sensor) + len(loop.segments), loop.states), np.zeros(len(sensor) + len(loop.segments))
    for row, segment in enumerate(loop.segments, len(sensor)):
        seen[row] = np.eye(loop.states)[newest + segment.age] * (segment.age > 0)
        seen_force[row] = segment.age == 0
    ends = [
        row @ given
        for piece, given in zip(pieces(loop), starts(loop), strict=True)
        for row in (sensor @ np.column_stack([piece.transition, piece.gain]), piece.speed[0], piece.speed.sum(axis=0))
    ]
    rows = np.array([position, velocity, *free, *(row @ seen for row in ends)])
    by_force = np.concatenate([[0.0, 0.0], push, [row @ seen_force for row in ends]])
    return seen, seen_force, rows, by_force


class Motion:
    """Points of a general loop in motion after a step.

    Parameters
    ----------
    loop : DeviceLoop
    alpha, beta : float64, shape (n,)
    between : bool
        Whether the motion between samples is asked for.

    Notes
    -----
    ``index`` are the points' numbers, ``sample`` the number of the sample that each is at, ``stop`` of the one at which
    it need not go on, ``since`` of the one from which on samples were left out.
    """

    _OF_POINTS = ("index", "alpha", "beta", "sample", "since", "stop", "state", "scale")

    def __init__(self, loop: DeviceLoop, alpha: Floats, beta: Floats, *, between: bool) -> None:
        self.loop, self.index, self.alpha, self.beta = loop, np.arange(len(alpha)), alpha, beta
        self.pieces = pieces(loop) if between else ()
        _, _, rows, by_force = _interval(loop)
        count = 2 + loop.states + 3 * len(self.pieces)
        self.rows, self.by_force = rows[:count], by_force[:count]
        self.driven = np.flatnonzero(self.by_force)
        self.state = np.ascontiguousarray(loop.starts(alpha, "step").T)
        self.scale = _levers(loop, alpha)
        self.sample = np.zeros(len(alpha))
        self.since, self.stop = np.full(len(alpha), np.inf), np.full(len(alpha), np.inf)

    def advance(self, count: int) -> None:
        """Move by so many sampling intervals, at least one."""
        n = self.loop.states
        self.made, self.force = (
            np.empty((count, *self.rows.shape[:1], len(self.index))),
            np.empty((count, len(self.index))),
        )
        self.first, state = self.state, self.state
        for made, force in zip(self.made, self.force, strict=True):
            np.matmul(self.rows, state, out=made)
            force[:] = -self.alpha * made[0] - self.beta * made[1]
            for row in self.driven:
                made[row] += self.by_force[row] * force
            state = made[2 : 2 + n]
        self.state, self.sample = state, self.sample + count

    @property
    def position(self) -> Floats:
        """Sensed position, shape (n,)."""
        return np.asarray(self.loop.open_loop[2] @ self.state)

    @property
    def sensed(self) -> Floats:
        """Positions at the end of each of the latest intervals, shape (count, n)."""
        return np.asarray(self.loop.open_loop[2] @ self.made[:, 2 : 2 + self.loop.states])

    def ends(self) -> Floats:
        """Return the latest intervals' pieces: position at start and end, velocity at both; (4, count pieces, n)."""
        count, each, n = len(self.made), len(self.pieces), len(self.index)
        result = np.empty((4, count, each, n))
        result[1:] = np.moveaxis(self.made[:, 2 + self.loop.states :].reshape(count, each, 3, n), 2, 0)
        result[0, :, 0], result[0, :, 1:] = self.made[:, 0], result[1, :, :-1]
        return result.reshape(4, count * each, n)

    def motion(self, row: Integers, point: Integers) -> Floats:
        """Return the coefficients of the sensed position over pieces, numbered as by `ends`; shape (13, events)."""
        seen, seen_force, _, _ = _interval(self.loop)
        result, interval = np.empty((DEGREE + 1, len(row))), row // len(self.pieces)
        for number, (piece, given) in enumerate(zip(self.pieces, starts(self.loop), strict=True)):
            some = np.flatnonzero(row % len(self.pieces) == number)
            k, at, rows = interval[some], point[some], piece.place @ given
            state = np.where(k > 0, self.made[k - 1, 2 : 2 + self.loop.states, at].T, self.first[:, at])
            result[:, some] = (rows @ seen) @ state + (rows @ seen_force)[:, None] * self.force[k, at]
        return result

    def size(self) -> Floats:
        """Return all motion as a deviation."""
        return np.asarray((np.abs(self.state[: len(self.scale)]) * self.scale).sum(axis=0))

    def part(self, which: Booleans | Integers | slice) -> Motion:
        """Return the motion of some points."""
        result = copy(self)
        for name in self._OF_POINTS:
            setattr(result, name, np.ascontiguousarray(getattr(self, name)[..., which]))
        return result

    @property
    def memory(self) -> int:
        """Samples that filter and delay remember."""
        return self.loop.oldest_force + len(self.loop.filter_in_z[0]) + 1


def joined(parts: list[Motion]) -> Motion:
    """Return the points of several motions of one loop in one."""
    result = copy(parts[0])
    for name in Motion._OF_POINTS:
        setattr(result, name, np.concatenate([getattr(part, name) for part in parts], axis=-1))
    return result


def _levers(loop: DeviceLoop, alpha: Floats) -> Floats:
    """Return what each state of the device may do to the position, shape (states, n)."""
    lever = np.maximum(8 * (loop.delay + loop.lag + 1), 2 / np.sqrt(alpha + loop.gamma))
    rows = [np.ones_like(lever), lever]
    if loop.mode is not None:
        near = 1 - loop.mode.far_mass
        turn = np.sqrt(loop.mode.stiffness * (1 / near + 1 / loop.mode.far_mass))
        rows += [np.ones_like(lever), np.minimum(lever, 1 / turn)]
    if loop.lag > 0:
        rows.append(loop.lag * lever)
    return np.array(rows)
