"""Motion between samples of a general loop, as polynomials over pieces of a sampling interval.

A piece is short beside the oscillations of the device, and pieces halve towards the start of a segment, where a fast
lag settles; so a polynomial of degree 12 through exact places follows the motion to 1e-12 of it.
"""

from __future__ import annotations

import itertools
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial.legendre import leggauss

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import Digits, as_exact, as_floats, many_digits
from pipeline.records.batch import Booleans, Floats, Integers

DEGREE = 12
"""Of the polynomials: a piece is at most one radian, so the next term is below 1/13!."""

_GAUSS = 14
"""Points that integrate the square of such a polynomial times tau^2 exactly."""

WEIGHTS = (0, 1, 2)


@dataclass(frozen=True, eq=False)
class Piece:
    """Part of a sampling interval with constant input.

    Parameters
    ----------
    age : int
        Age of the wall's force in samples.
    start, duration : float
        Within the sampling interval [T].
    transition, gain : float64, shapes (p, p), (p,)
        Exact motion of the device over the piece.
    place : float64, shape (13, p + 1)
        From the device's state at the piece's start and its input to the coefficients of the sensed position over the
        share of the piece, lowest power first.
    """

    age: int
    start: float
    duration: float
    transition: Floats
    gain: Floats
    place: Floats

    @cached_property
    def speed(self) -> Floats:
        """As ``place``, of the velocity [1/T], shape (12, p + 1)."""
        return self.place[1:] * np.arange(1, DEGREE + 1)[:, None] / self.duration


@lru_cache(maxsize=64)
def pieces(loop: Loop) -> tuple[Piece, ...]:
    """Return the pieces of a sampling interval in order."""
    result, offset = [], 0.0
    for segment in loop.segments:
        edges = _edges(loop, segment.duration)
        known: dict[float, tuple[Digits, Digits, Floats]] = {}
        for start, duration in zip(edges[:-1], np.diff(edges), strict=True):
            if duration not in known:
                known[duration] = _motion(loop, float(duration))
            transition, gain, place = known[duration]
            result.append(Piece(segment.age, offset + start, duration, as_floats(transition), as_floats(gain), place))
        offset += segment.duration
    return tuple(result)


@lru_cache(maxsize=64)
def energy_forms(loop: Loop) -> Floats:
    """Return what an interval adds to the sums of e^2 and of v^2, as forms of `Loop.seen`.

    Shape (2, 2, 3, q, q): position and velocity; integrals of tau^w over the interval, and for w = 0, 1, 2 the first
    sample, or the way to the next, with its weight 1^w.
    """
    nodes, weights = leggauss(_GAUSS)
    share, weights = 0.5 * (nodes + 1), 0.5 * weights
    p, q = len(loop.device[1]), len(loop.device[1]) + len(loop.segments)
    forms = np.zeros((2, 2, len(WEIGHTS), q, q))
    for piece, given in zip(pieces(loop), starts(loop), strict=True):
        time = piece.start + piece.duration * share
        for form, part in zip(forms, (piece.place, piece.speed), strict=True):
            rows = np.vander(share, len(part), increasing=True) @ part @ given
            for w in WEIGHTS:
                form[0, w] += (piece.duration * weights * time**w * rows.T) @ rows
    place = np.append(loop.device[2], np.zeros(q - p))
    with many_digits(loop.digits):
        whole, gains = loop.pushes
        way = as_floats(as_exact(loop.device[2]) @ (np.column_stack([whole, *gains]) - as_exact(np.eye(p, q))))
    forms[0, 1, 0] = np.outer(place, place)
    forms[1, 1] = np.outer(way, way)
    return forms


@lru_cache(maxsize=64)
def starts(loop: Loop) -> tuple[Floats, ...]:
    """Return the device's state at the start of each piece, and its input, from `Loop.seen`; (p + 1, q) each."""
    p, q = len(loop.device[1]), len(loop.device[1]) + len(loop.segments)
    ages, start, result = [segment.age for segment in loop.segments], np.eye(p, q), []
    for piece in pieces(loop):
        given = np.vstack([start, np.eye(q)[p + ages.index(piece.age)]])
        result.append(given)
        start = np.column_stack([piece.transition, piece.gain]) @ given
    return tuple(result)


def _edges(loop: Loop, duration: float) -> Floats:
    rates = np.linalg.eigvals(loop.device[0])
    turning = float(np.abs(rates[np.abs(rates.imag) > np.abs(rates.real)]).max(initial=0.0))
    settling = float(np.abs(rates[np.abs(rates.imag) <= np.abs(rates.real)]).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(settling * duration)))) if settling > 0 else 0
    edges = np.append(0.0, duration * 0.5 ** np.arange(halvings, -1, -1.0))
    fine = [
        np.linspace(low, high, max(1, int(np.ceil(turning * (high - low)))) + 1)[:-1]
        for low, high in itertools.pairwise(edges)
    ]
    return np.append(np.concatenate(fine), duration)


def _motion(loop: Loop, duration: float) -> tuple[Digits, Digits, Floats]:
    """Return transition, gain, and the coefficients of the polynomial through exact places."""
    with many_digits(loop.digits):
        transition, gain = loop.moved(duration / DEGREE)
        sensor = as_exact(loop.device[2])
        n = len(gain)
        whole, push, rows = as_exact(np.eye(n)), as_exact(np.zeros(n)), [np.append(sensor, as_exact([0]))]
        for _ in range(DEGREE):
            whole, push = transition @ whole, transition @ push + gain
            rows.append(np.append(sensor @ whole, sensor @ push))
        return whole, push, as_floats(_through(np.array(rows, dtype=object)))


def _through(values: Digits) -> Digits:
    """Return the coefficients of the polynomials through values at even steps of [0, 1] (Newton's differences)."""
    differences = [values[0]]
    for order in range(1, len(values)):
        values = (values[1:] - values[:-1]) / order
        differences.append(values[0])
    result = differences[-1][None]
    for step in range(len(differences) - 2, -1, -1):
        # times (t - step), plus the next difference
        longer = np.concatenate([0 * result[:1], result])
        longer[:-1] -= step * result
        longer[0] += differences[step]
        result = longer
    # t counts steps: a share is t/DEGREE
    return np.asarray(result * as_exact([DEGREE**k for k in range(len(result))])[:, None], dtype=object)


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
