"""Points of a loop in motion: exact from sample to sample, and between samples polynomials over pieces of an interval.

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

from pipeline.base.errors import ParameterError
from pipeline.loop.many_digits import Digits, as_exact, as_floats, many_digits
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Booleans, Floats, Integers

DEGREE = 12
"""Of the polynomials: a piece is at most one radian, so the next term is below 1/13!."""

_GAUSS = 14
"""Points that integrate the square of such a polynomial times tau^2 exactly."""

WEIGHTS = (0, 1, 2)

_NEWTON = 5
"""Steps to a turning point from a first guess within a piece of at most one radian: each doubles its digits."""

_FOUND = 1e-9
"""Step after which the next would be rounding."""


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
def pieces(loop: NormalisedLoop) -> tuple[Piece, ...]:
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
def energy_forms(loop: NormalisedLoop) -> Floats:
    """Return what an interval adds to the sums of e^2 and of v^2, as forms of `NormalisedLoop.seen`.

    Shape (2, 2, 3, q, q): position and velocity; integrals of tau^w over the interval, and for w = 0, 1, 2 the first
    sample, or the way to the next, with its weight 1^w.
    """
    nodes, weights = leggauss(_GAUSS)
    share, weights = 0.5 * (nodes + 1), 0.5 * weights
    p, q = len(loop.device.sensor), len(loop.device.sensor) + len(loop.segments)
    forms = np.zeros((2, 2, len(WEIGHTS), q, q))
    for piece, given in zip(pieces(loop), starts(loop), strict=True):
        time = piece.start + piece.duration * share
        for form, part in zip(forms, (piece.place, piece.speed), strict=True):
            rows = np.vander(share, len(part), increasing=True) @ part @ given
            for w in WEIGHTS:
                form[0, w] += (piece.duration * weights * time**w * rows.T) @ rows
    place = np.append(loop.device.sensor, np.zeros(q - p))
    with many_digits(loop.digits):
        whole, gains = loop.pushes
        way = as_floats(as_exact(loop.device.sensor) @ (np.column_stack([whole, *gains]) - as_exact(np.eye(p, q))))
    forms[0, 1, 0] = np.outer(place, place)
    forms[1, 1] = np.outer(way, way)
    return forms


@lru_cache(maxsize=64)
def starts(loop: NormalisedLoop) -> tuple[Floats, ...]:
    """Return state and input of the device at the start of each piece, (p + 1, q) each, for `NormalisedLoop.seen`."""
    p, q = len(loop.device.sensor), len(loop.device.sensor) + len(loop.segments)
    ages, start, result = [segment.age for segment in loop.segments], np.eye(p, q), []
    for piece in pieces(loop):
        given = np.vstack([start, np.eye(q)[p + ages.index(piece.age)]])
        result.append(given)
        start = np.column_stack([piece.transition, piece.gain]) @ given
    return tuple(result)


def _edges(loop: NormalisedLoop, duration: float) -> Floats:
    rates = np.linalg.eigvals(loop.device.matrix)
    turning = float(np.abs(rates[np.abs(rates.imag) > np.abs(rates.real)]).max(initial=0.0))
    settling = float(np.abs(rates[np.abs(rates.imag) <= np.abs(rates.real)]).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(settling * duration)))) if settling > 0 else 0
    edges = np.append(0.0, duration * 0.5 ** np.arange(halvings, -1, -1.0))
    fine = [
        np.linspace(low, high, max(1, int(np.ceil(turning * (high - low)))) + 1)[:-1]
        for low, high in itertools.pairwise(edges)
    ]
    return np.append(np.concatenate(fine), duration)


def _motion(loop: NormalisedLoop, duration: float) -> tuple[Digits, Digits, Floats]:
    """Return transition, gain, and the coefficients of the polynomial through exact places."""
    with many_digits(loop.digits):
        transition, gain = loop.moved(duration / DEGREE)
        sensor = as_exact(loop.device.sensor)
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
def _interval(loop: NormalisedLoop, between: bool) -> Floats:
    """Return what a sampling interval makes of what it starts with, shape (rows, columns).

    Columns: the loop's state but the forces of former samples, and the wall's force in each of `segments`. Rows: the
    same states at its end, and sensed position and velocity at the end of each piece; else that of the interval.
    """
    free, push, position, _ = loop.open_loop
    own, p = loop.states - loop.oldest_force, len(loop.device.sensor)
    ages = [segment.age for segment in loop.segments]
    state = np.column_stack([free[:own, :own], *(free[:own, own - 1 + age] if age else push[:own] for age in ages)])
    if not between:
        return np.vstack([state, position[:own] @ state])
    seen = np.zeros((p + len(ages), own + len(ages)))
    seen[:p, :p], seen[p:, own:] = np.eye(p), np.eye(len(ages))
    ends = [
        row @ given @ seen
        for piece, given in zip(pieces(loop), starts(loop), strict=True)
        for row in (piece.place.sum(axis=0), piece.speed.sum(axis=0))
    ]
    return np.vstack([state, *ends])


class Motion:
    """Points of a loop in motion after a step.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : float64, shape (n,)
    between : bool
        Whether the motion between samples is asked for.

    Notes
    -----
    ``index`` are the points' numbers, ``sample`` the number of the sample that each is at, ``stop`` of the one at which
    it need not go on, ``since`` of the one from which on samples were left out, ``begun`` the state there.
    """

    _OF_POINTS = ("index", "alpha", "beta", "sample", "since", "stop", "state", "begun", "scale")

    def __init__(self, loop: NormalisedLoop, alpha: Floats, beta: Floats, *, between: bool) -> None:
        self.loop, self.index, self.alpha, self.beta = loop, np.arange(len(alpha)), alpha, beta
        self.own = loop.states - loop.oldest_force
        self.rows = _interval(loop, between)
        self.each = len(pieces(loop)) if between else 1
        self.state = self.begun = np.ascontiguousarray(loop.starts(alpha, "step").T)
        self.scale = _levers(loop, alpha)
        self.sample = np.zeros(len(alpha))
        self.since, self.stop = np.full(len(alpha), np.inf), np.full(len(alpha), np.inf)
        matrix, sensor = loop.device.matrix, loop.device.sensor
        self.watched = np.zeros((2, self.own))
        self.watched[:, : len(sensor)] = sensor, sensor @ matrix

    def advance(self, count: int) -> None:
        """Move by so many sampling intervals, at least one, noting ``position`` and ``velocity``.

        Shape (count each + 1, n): at the ends of all pieces, or at samples (and then no velocity).
        """
        own, delay, n = self.own, self.loop.oldest_force, len(self.index)
        ages = [segment.age for segment in self.loop.segments]
        made = np.empty((count, len(self.rows), n))
        force = np.empty((delay + count, n))  # in order of time
        force[:delay] = self.state[own:][::-1]
        start = np.empty((count, own + len(ages), n))
        state, minus_alpha, minus_beta = self.state[:own], -self.alpha, -self.beta
        law = np.array(self.loop.open_loop[2:])[:, :own]
        path = np.empty((2, count * self.each + 1, n))
        path[:, 0] = self.watched @ state
        for k in range(count):
            given = start[k]
            given[:own] = state
            position, speed = law @ state
            np.multiply(minus_alpha, position, out=force[delay + k])
            force[delay + k] += np.multiply(minus_beta, speed, out=speed)
            for row, age in enumerate(ages, own):
                given[row] = force[delay + k - age]
            np.matmul(self.rows, given, out=made[k])
            state = made[k, :own]
        ends = made[:, own:].reshape(count, self.each, -1, n)
        for values, found in zip(path, np.moveaxis(ends, 2, 0), strict=False):
            values[1:] = found.reshape(-1, n)
        self.start, (self.position, self.velocity) = start, path
        self.state = np.concatenate([state, force[count:][::-1]])
        self.sample = self.sample + count

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


def within_pieces(loop: NormalisedLoop, piece: Integers, given: Floats) -> Floats:
    """Return the coefficients of the sensed position over pieces, from what their intervals start with; (13, n)."""
    result, p, own = np.empty((DEGREE + 1, len(piece))), len(loop.device.sensor), loop.states - loop.oldest_force
    for number, (of, start) in enumerate(zip(pieces(loop), starts(loop), strict=True)):
        some = np.flatnonzero(piece == number)
        result[:, some] = (of.place @ start) @ np.concatenate([given[:p, some], given[own:, some]])
    return result


def at_share(motion: Floats, share: Floats) -> Floats:
    """Return polynomials, shape (13, n), at shares of their piece."""
    result: Floats = motion[-1].copy()
    for coefficient in motion[-2::-1]:
        result = result * share + coefficient
    return result


def turning_share(motion: Floats) -> Floats:
    """Return the share of a piece at which a motion that turns has no velocity; 1 where it does not turn."""
    speed = motion[1:] * np.arange(1, len(motion))[:, None]
    start, end = speed[0], speed.sum(axis=0)
    turns = np.flatnonzero(start * end < 0)
    result = np.ones(motion.shape[1])
    speed, start, end = speed[:, turns], start[turns], end[turns]
    change = speed[1:] * np.arange(1, len(speed))[:, None]
    share: Floats = start / (start - end)
    for _ in range(_NEWTON):
        bend, before = at_share(change, share), share
        share = np.clip(share - at_share(speed, share) / np.where(bend == 0, np.inf, bend), 0.0, 1.0)
        if np.abs(share - before).max(initial=0.0) < _FOUND:
            break
    result[turns] = share
    return result


def _levers(loop: NormalisedLoop, alpha: Floats) -> Floats:
    """Return what each state of the device may do to the position, shape (states, n)."""
    lever = np.maximum(8 * (loop.delay + loop.lag + 1), 2 / np.sqrt(alpha + loop.gamma))
    rows = [np.ones_like(lever), lever]
    if loop.plant.has_mode:
        load = loop.plant.load_mass
        turn = np.sqrt(loop.plant.spring * (1 / (1 - load) + 1 / load))
        sensed = abs(loop.device.sensor[2])
        rows += [sensed * np.ones_like(lever), sensed * np.minimum(lever, 1 / turn)]
    rows += [loop.lag * lever] * (loop.device.states - loop.device.mechanical)
    return np.array(rows)


_MOST_POINTS = 1 << 22
"""Points of one response; more would take seconds and tell nothing."""


def response(
    loop: NormalisedLoop, alpha: float, beta: float, signal: str, samples: int, per_sample: int = 24
) -> Floats:
    """Return the sensed position after a unit step or impulse at time 0, shape (samples per_sample + 1,).

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : float
        Normalised wall.
    signal : {"step", "impulse"}
        A step is part of the command, an impulse a hit on the motor's side.
    samples, per_sample : int
        Length [samples] and evenly spaced points in each sampling interval, both at least 1.

    Returns
    -------
    float64
        chi = x m/T^2 for a unit force, x m/T for a unit momentum; every ``per_sample``-th point is a sample.

    Raises
    ------
    ParameterError
        For another signal, sizes out of range, or a motion that grows beyond all numbers.

    Source: Hulin 2017, secs. 3.1.5 and 5.2.
    """
    if signal not in ("step", "impulse"):
        raise ParameterError(f"signal = {signal!r}: expected 'step' or 'impulse'.")
    if samples < 1 or per_sample < 1 or samples * per_sample > _MOST_POINTS:
        raise ParameterError(
            f"samples = {samples}, per_sample = {per_sample}: expected 1 or more, together at most {_MOST_POINTS}."
        )
    wall, step, p = (np.array([alpha]), np.array([beta])), float(signal == "step"), len(loop.device.sensor)
    law, turn, times = loop.law(*wall), loop.matrix(*wall)[0], np.arange(1, per_sample + 1) / per_sample
    places = np.empty((per_sample, p + len(loop.segments)))
    for piece, given in zip(pieces(loop), starts(loop), strict=True):
        share = (times - piece.start) / piece.duration
        some = share > 0  # later pieces overwrite
        places[some] = np.vander(share[some], DEGREE + 1, increasing=True) @ piece.place @ given
    pushed, state = np.zeros(loop.states), loop.starts(wall[0], "impulse")[0] * (1 - step)
    pushed[:p] = step * as_floats(np.sum(loop.pushes[1], axis=0))
    found = [loop.device.sensor @ state[:p]]
    with np.errstate(over="ignore", invalid="ignore"):  # what grows beyond numbers is refused below
        for _ in range(samples):
            seen = loop.seen(law, state[None, :, None])[0, :, 0]
            seen[p:] += step
            found.append(places @ seen)
            state = turn @ state + pushed
    result = np.hstack(found)
    if not np.isfinite(result).all():
        last = int(np.argmin(np.isfinite(result))) // per_sample
        raise ParameterError(
            f"this wall is unstable: after {last} samples its motion is beyond all numbers; ask for fewer."
        )
    return result
