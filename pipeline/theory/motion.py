"""Describe the motion of a device between samples by polynomials over pieces of a sampling interval.

Each piece is short compared with the oscillations of the device. Pieces halve towards the start of a segment, where a
fast lag settles. A polynomial of degree 12 through exact points therefore has a relative error of 1e-12.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from pipeline.base.constants import Constants
from pipeline.base.errors import ParameterError
from pipeline.loop.many_digits import Digits, as_exact, as_floats, many_digits
from pipeline.loop.normalised_loop import NormalisedLoop, moved
from pipeline.records.trials import Floats

DEGREE = 12
"""Degree of the polynomials. A piece is at most one radian, so the next term is below 1/13!."""

_GAUSS = 14
"""Number of Gauss points that integrate the square of such a polynomial times tau^2 exactly."""

WEIGHTS = (0, 1, 2)

_NEGLIGIBLE = 1e-20
"""Threshold for the size of a coefficient of a motion, relative to the largest one. Below it, the coefficient is
neglected."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Part of a sampling interval with constant input.

    Parameters
    ----------
    age : int
        Delay of the wall force in samples.
    start, duration : float
        Position within the sampling interval [T].
    transition, gain : float64, shapes (p, p), (p,)
        Exact motion of the device over the piece.
    place : float64, shape (13, p + 1)
        Matrix that maps the device state at the start of the piece, and its input, to the coefficients of the sensed
        position over the share of the piece, lowest power first.
    """

    age: int
    start: float
    duration: float
    transition: Floats
    gain: Floats
    place: Floats

    @cached_property
    def speed(self) -> Floats:
        """Matrix like ``place`` for the velocity [1/T], shape (12, p + 1)."""
        return self.place[1:] * np.arange(1, DEGREE + 1)[:, None] / self.duration


@lru_cache(maxsize=64)
def pieces(loop: NormalisedLoop) -> tuple[Piece, ...]:
    """Return the pieces of a sampling interval in order."""
    result, offset, rates = [], 0.0, np.linalg.eigvals(loop.device.matrix)
    for segment in loop.segments:
        edges = _edges(rates, segment.duration)
        known: dict[float, tuple[Floats, Floats, Floats]] = {}
        for start, duration in zip(edges[:-1], np.diff(edges), strict=True):
            if duration not in known:
                turns = np.abs(rates).max() * duration > 1
                known[duration] = (_by_points if turns else _by_series)(loop, float(duration))
            result.append(Piece(segment.age, offset + start, duration, *known[duration]))
        offset += segment.duration
    return tuple(result)


@lru_cache(maxsize=64)
def energy_forms(loop: NormalisedLoop) -> Floats:
    """Return the contributions of an interval to the sums of e^2 and v^2, as quadratic forms of `NormalisedLoop.seen`.

    The shape is (2, 2, 3, q, q). The first axis is for position and velocity. The second axis is for integrals of tau^w
    over the interval and for the first sample, or the change to the next sample, with its weight 1^w. The third axis is
    for w = 0, 1, 2.
    """
    p, q = len(loop.device.sensor), len(loop.device.sensor) + len(loop.segments)
    forms, (times, at) = np.zeros((2, 2, len(WEIGHTS), q, q)), forms_at_nodes(loop)
    for w in WEIGHTS:
        forms[:, 0, w] = np.tensordot(times**w, at, (0, 1))
    place = np.append(loop.device.sensor, np.zeros(q - p))
    with many_digits(loop.digits):
        whole, gains = loop.pushes
        way = as_floats(as_exact(loop.device.sensor) @ (np.column_stack([whole, *gains]) - as_exact(np.eye(p, q))))
    forms[0, 1, 0] = np.outer(place, place)
    forms[1, 1] = np.outer(way, way)
    return forms


@lru_cache(maxsize=64)
def forms_at_nodes(loop: NormalisedLoop, power: float = 0.0) -> tuple[Floats, Floats]:
    """Return nodes of an interval, shape (n,), and quadratic forms whose sum is the integral with tau^power.

    The forms have the shape (2, n, q, q), for e^2 and v^2 in terms of `NormalisedLoop.seen`. They include the weights
    of Gauss-Legendre quadrature. In the first piece, where tau^power may not be differentiable, the weights are those
    of Gauss-Jacobi quadrature.
    """
    times, forms, at_start = list[Floats](), list[list[Floats]](), leggauss(_GAUSS)
    if power:
        from scipy.special import roots_jacobi  # loading this module takes longer than a theory command

        at_start = roots_jacobi(_GAUSS, 0.0, power)
    for piece, given in zip(pieces(loop), starts(loop), strict=True):
        begins = piece.start == 0
        nodes, weights = at_start if begins else leggauss(_GAUSS)
        share, sign = 0.5 * (nodes + 1), power if begins else 0.0
        weights = weights * (0.5 * piece.duration) * (0.5 * piece.duration) ** sign
        time = piece.start + piece.duration * share
        weights = weights * (1.0 if begins else time**power)
        rows = [np.vander(share, len(part), increasing=True) @ part @ given for part in (piece.place, piece.speed)]
        forms.append([weights[:, None, None] * each[:, :, None] * each[:, None, :] for each in rows])
        times.append(time)
    return np.concatenate(times), np.concatenate(forms, axis=1)


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


def _edges(rates: NDArray[Any], duration: float) -> Floats:
    turning = float(np.abs(rates[np.abs(rates.imag) > np.abs(rates.real)]).max(initial=0.0))
    settling = float(np.abs(rates[np.abs(rates.imag) <= np.abs(rates.real)]).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(settling * duration)))) if settling > 0 else 0
    edges = np.append(0.0, duration * 0.5 ** np.arange(halvings, -1, -1.0))
    fine = [
        np.linspace(low, high, max(1, int(np.ceil(turning * (high - low)))) + 1)[:-1]
        for low, high in itertools.pairwise(edges)
    ]
    return np.append(np.concatenate(fine), duration)


def _by_series(loop: NormalisedLoop, duration: float) -> tuple[Floats, Floats, Floats]:
    """Return the transition, the gain, and the coefficients of the polynomial through exact points, from power series.

    No digits cancel in a piece of at most one radian. The first omitted term is below 1/24!.
    """
    device, n = loop.device, loop.device.states
    factor, powers = np.zeros((n + 1, n + 1)), np.eye(n + 1)[None]
    factor[:n, :n], factor[:n, n] = device.matrix * duration, device.command * duration
    while len(powers) < 2 * DEGREE:
        powers, factor = np.concatenate([powers, powers @ factor]), factor @ factor
    terms = powers[: 2 * DEGREE, :n] / _factorials()
    whole, places = terms[::-1].sum(axis=0), device.sensor @ terms
    return whole[:, :n], whole[:, n], places[: DEGREE + 1] + _higher_powers(loop.digits) @ places[DEGREE + 1 :]


@lru_cache(maxsize=1)
def _factorials() -> Floats:
    """Return the factorials of the powers of a series, shape (24, 1, 1)."""
    return np.array([float(math.factorial(power)) for power in range(2 * DEGREE)])[:, None, None]


@lru_cache(maxsize=4)
def _higher_powers(digits: int) -> Floats:
    """Return the coefficients of the polynomials through x^13 to x^23 at equidistant points, shape (13, 11)."""
    with many_digits(digits):
        points = as_exact(range(DEGREE + 1)) / DEGREE
        return as_floats(_through(points[:, None] ** np.arange(DEGREE + 1, 2 * DEGREE)))


def _by_points(loop: NormalisedLoop, duration: float) -> tuple[Floats, Floats, Floats]:
    """Return the transition, the gain, and the coefficients of the polynomial through exact points."""
    with many_digits(loop.digits):
        transition, gain = moved(loop.plant, duration / DEGREE, loop.digits)
        sensor = as_exact(loop.device.sensor)
        n = len(gain)
        whole, push, rows = as_exact(np.eye(n)), as_exact(np.zeros(n)), [np.append(sensor, as_exact([0]))]
        for _ in range(DEGREE):
            whole, push = transition @ whole, transition @ push + gain
            rows.append(np.append(sensor @ whole, sensor @ push))
        return as_floats(whole), as_floats(push), as_floats(_through(np.array(rows, dtype=object)))


def _through(values: Digits) -> Digits:
    """Return coefficients of the polynomials through values at equidistant points of [0, 1] (Newton's differences)."""
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
    # t counts steps, so a share of the piece is t/DEGREE
    return np.asarray(result * as_exact([DEGREE**k for k in range(len(result))])[:, None], dtype=object)


@lru_cache(maxsize=64)
def interval_motion(loop: NormalisedLoop, between: bool) -> Constants:
    """Return the motion over a sampling interval, from own states and two forces, as an input of a march.

    Own states are the states without delayed forces, in the basis of `own_basis`. The wall forces in an interval are
    the older and the newer one. The newer force has no effect if the delay is an integer.

    Returns
    -------
    step : float64, shape (own, own + 2)
        Own states at the end of the interval.
    ends : float64, shape (2 (pieces - 1), own + 2)
        Sensed position and its velocity at the end of each piece, except the last one.
    curves : float64, shape (pieces, degree + 1, own + 2)
        Position over the share of each piece, lowest power first. It is zero if only samples are requested.
    timing : float64, shape (2, pieces)
        Start and duration of each piece.
    """
    free, push, _, _ = loop.open_loop
    ages, (basis, inverse) = [segment.age for segment in loop.segments], own_basis(loop)
    own, p = len(basis), len(loop.device.sensor)
    forces = np.zeros((own, 2))
    for column, age in enumerate(ages):
        forces[:, column] = free[:own, own - 1 + age] if age else push[:own]
    step = np.hstack([free[:own, :own], forces])
    seen = np.zeros((p + len(ages), own + 2))
    seen[:p, :p], seen[p:, own : own + len(ages)] = np.eye(p), np.eye(len(ages))
    curves, ends, timing = np.zeros((1, 2, own + 2)), np.zeros((0, own + 2)), np.array([[0.0], [1.0]])
    if between:
        given = list(zip(pieces(loop), starts(loop), strict=True))
        curves = np.array([piece.place @ start for piece, start in given]) @ seen
        timing = np.array([(piece.start, piece.duration) for piece, _ in given]).T
        rows = [rows.sum(axis=0) @ start @ seen for piece, start in given[:-1] for rows in (piece.place, piece.speed)]
        ends = np.array(rows).reshape(-1, own + 2)
        kept = np.flatnonzero(np.abs(curves).max(axis=(0, 2)) > _NEGLIGIBLE * np.abs(curves).max()).max(initial=1) + 1
        curves = curves[:, :kept]
    for part in (step, ends, curves):
        part[..., :own] = part[..., :own] @ inverse
    return Constants(np.ascontiguousarray(part) for part in (basis @ step, ends, curves, timing))


@lru_cache(maxsize=64)
def own_basis(loop: NormalisedLoop) -> tuple[Floats, Floats]:
    """Return the matrix that maps the own states of `NormalisedLoop.matrix` to those of a march, and its inverse.

    Own states of a march are the sensed position and its velocity, the last sample, the device states except the first
    two, and the filter states.
    """
    own, sensor = loop.states - loop.oldest_force, loop.device.sensor
    p = len(sensor)
    basis = np.eye(own)[[0, 1, p, *range(2, p), *range(p + 1, own)]]
    basis[:2, :p] = sensor, sensor @ loop.device.matrix
    return basis, np.asarray(np.linalg.inv(basis))


_MOST_POINTS = 1 << 22
"""Largest number of points of a response. More points would take seconds."""


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
        A step is added to the command. An impulse is an impact on the motor side.
    samples, per_sample : int
        Length [samples], and number of evenly spaced points in each sampling interval, both at least 1.

    Returns
    -------
    float64
        chi = x m/T^2 for a unit force, or x m/T for a unit momentum. Every ``per_sample``-th point is a sample.

    Raises
    ------
    ParameterError
        If the signal is unknown, a size is out of range, or the motion overflows.

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
        some = share > 0  # later pieces overwrite earlier ones
        places[some] = np.vander(share[some], DEGREE + 1, increasing=True) @ piece.place @ given
    pushed, state = np.zeros(loop.states), loop.starts(wall[0], "impulse")[0] * (1 - step)
    pushed[:p] = step * as_floats(np.sum(loop.pushes[1], axis=0))
    found = [loop.device.sensor @ state[:p]]
    with np.errstate(over="ignore", invalid="ignore"):  # an overflow is rejected below
        for _ in range(samples):
            seen = loop.seen(law, state[None, :, None])[0, :, 0]
            seen[p:] += step
            found.append(places @ seen)
            state = turn @ state + pushed
    result = np.hstack(found)
    if not np.isfinite(result).all():
        last = int(np.argmin(np.isfinite(result))) // per_sample
        raise ParameterError(
            f"this wall is unstable: its motion overflows after {last} samples. Request fewer samples."
        )
    return result
