"""Points of a general loop in motion after a step: exact from sample to sample, and where it is asked for between."""

from __future__ import annotations

from copy import copy
from functools import lru_cache

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.theory.device.pieces import DEGREE, pieces, starts


@lru_cache(maxsize=64)
def _interval(loop: Loop) -> Floats:
    """Return what a sampling interval makes of what it starts with, shape (rows, columns).

    Columns: the loop's state but the forces of former samples, and the wall's force in each of `segments`. Rows: sensed
    position, filtered velocity and the next state but the forces; then for each piece the position at its end and the
    velocities at both ends.
    """
    free, push, position, velocity = loop.open_loop
    newest, sensor = loop.states - loop.oldest_force - 1, loop.device[2]
    own = newest + 1
    ages = [segment.age for segment in loop.segments]
    forces = [free[:own, newest + age] if age else push[:own] for age in ages]
    seen = np.zeros((len(sensor) + len(ages), own + len(ages)))
    seen[: len(sensor), : len(sensor)], seen[len(sensor) :, own:] = np.eye(len(sensor)), np.eye(len(ages))
    ends = [
        row @ given @ seen
        for piece, given in zip(pieces(loop), starts(loop), strict=True)
        for row in (sensor @ np.column_stack([piece.transition, piece.gain]), piece.speed[0], piece.speed.sum(axis=0))
    ]
    state = np.column_stack([free[:own, :own], *forces])
    known = np.zeros((2, own + len(ages)))
    known[:, :own] = position[:own], velocity[:own]
    return np.array([*known, *state, *ends])


class Motion:
    """Points of a general loop in motion after a step.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
    between : bool
        Whether the motion between samples is asked for.

    Notes
    -----
    ``index`` are the points' numbers, ``sample`` the number of the sample that each is at, ``stop`` of the one at which
    it need not go on, ``since`` of the one from which on samples were left out.
    """

    _OF_POINTS = ("index", "alpha", "beta", "sample", "since", "stop", "state", "scale")

    def __init__(self, loop: Loop, alpha: Floats, beta: Floats, *, between: bool) -> None:
        self.loop, self.index, self.alpha, self.beta = loop, np.arange(len(alpha)), alpha, beta
        self.pieces = pieces(loop) if between else ()
        self.own = loop.states - loop.oldest_force
        self.rows = _interval(loop)[: 2 + self.own + 3 * len(self.pieces)]
        self.state = np.ascontiguousarray(loop.starts(alpha, "step").T)
        self.scale = _levers(loop, alpha)
        self.sample = np.zeros(len(alpha))
        self.since, self.stop = np.full(len(alpha), np.inf), np.full(len(alpha), np.inf)

    def advance(self, count: int) -> None:
        """Move by so many sampling intervals, at least one."""
        own, delay, n = self.own, self.loop.oldest_force, len(self.index)
        ages = [segment.age for segment in self.loop.segments]
        self.made = np.empty((count, len(self.rows), n))
        force = np.empty((delay + count, n))  # in order of time
        force[:delay] = self.state[own:][::-1]
        start = np.empty((count, own + len(ages), n))
        state, minus_alpha, minus_beta = self.state[:own], -self.alpha, -self.beta
        law = self.rows[:2, :own]
        for k, (given, made) in enumerate(zip(start, self.made, strict=True)):
            given[:own] = state
            position, speed = law @ state
            np.multiply(minus_alpha, position, out=force[delay + k])
            force[delay + k] += minus_beta * speed
            for row, age in enumerate(ages, own):
                given[row] = force[delay + k - age]
            np.matmul(self.rows, given, out=made)
            state = made[2 : 2 + own]
        self.start = start
        self.state = np.concatenate([state, force[count:][::-1]])
        self.sample = self.sample + count

    @property
    def position(self) -> Floats:
        """Sensed position, shape (n,)."""
        return np.asarray(self.loop.open_loop[2] @ self.state)

    @property
    def sensed(self) -> Floats:
        """Positions at the end of each of the latest intervals, shape (count, n)."""
        return np.asarray(self.loop.open_loop[2][: self.own] @ self.made[:, 2 : 2 + self.own])

    def ends(self) -> Floats:
        """Return the latest intervals' pieces: position at start and end, velocity at both; (4, count pieces, n)."""
        count, each, n = len(self.made), len(self.pieces), len(self.index)
        result = np.empty((4, count, each, n))
        result[1:] = np.moveaxis(self.made[:, 2 + self.own :].reshape(count, each, 3, n), 2, 0)
        result[0, :, 0], result[0, :, 1:] = self.made[:, 0], result[1, :, :-1]
        return result.reshape(4, count * each, n)

    def motion(self, row: Integers, point: Integers) -> Floats:
        """Return the coefficients of the sensed position over pieces, numbered as by `ends`; shape (13, events)."""
        result, interval, device = np.empty((DEGREE + 1, len(row))), row // len(self.pieces), len(self.loop.device[2])
        for number, (piece, given) in enumerate(zip(self.pieces, starts(self.loop), strict=True)):
            some = np.flatnonzero(row % len(self.pieces) == number)
            began = self.start[interval[some], :, point[some]].T
            result[:, some] = (piece.place @ given) @ np.concatenate([began[:device], began[self.own :]])
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


def _levers(loop: Loop, alpha: Floats) -> Floats:
    """Return what each state of the device may do to the position, shape (states, n)."""
    lever = np.maximum(8 * (loop.delay + loop.lag + 1), 2 / np.sqrt(alpha + loop.gamma))
    rows = [np.ones_like(lever), lever]
    if loop.mode is not None:
        near = 1 - loop.mode.far_mass
        turn = np.sqrt(loop.mode.stiffness * (1 / near + 1 / loop.mode.far_mass))
        sensed = abs(loop.device[2][2])
        rows += [sensed * np.ones_like(lever), sensed * np.minimum(lever, 1 / turn)]
    if loop.lag > 0:
        rows.append(loop.lag * lever)
    return np.array(rows)
