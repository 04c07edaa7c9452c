"""Motion between samples of a general loop, as polynomials over pieces of a sampling interval.

A piece is short beside the oscillations of the device, and pieces halve towards the start of a segment, where a fast
lag settles; so a polynomial of degree 12 through exact places follows the motion to 1e-12 of it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial.legendre import leggauss

from pipeline.loop.loop import Loop
from pipeline.loop.many_digits import Digits, as_exact, as_floats, many_digits
from pipeline.records.batch import Floats

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
