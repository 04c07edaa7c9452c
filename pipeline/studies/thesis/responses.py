"""Step and impulse responses of the loop over time, exact at every point.

Source: Hulin 2017, sec. 5.2 (Figs. 5.5, 5.6, 5.9, 5.11).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats

_MOST_POINTS = 1 << 22
"""Points of one response; more would take seconds and tell nothing."""


@dataclass(frozen=True, eq=False)
class Response:
    """Normalised position over time.

    Parameters
    ----------
    time : float64, shape (n,)
        Time [samples], from 0 on; the sampling instants are among it.
    position : float64, shape (n,)
        chi = x m/T^2 for a unit step of the force, or of a unit impulse.
    samples : float64, shape (samples + 1,)
        Position at the sampling instants 0, 1, ...
    """

    time: Floats
    position: Floats
    samples: Floats


def response(loop: Loop, alpha: float, beta: float, signal: str, samples: int, per_sample: int = 24) -> Response:
    """Return the response of a wall to a unit step or impulse of the external force at time 0.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float
        Normalised wall, stable or not; alpha + gamma = 0 is allowed.
    signal : {"step", "impulse"}
    samples : int
        Length [samples], >= 1.
    per_sample : int
        Points in each part of a sampling interval, >= 1; for a fractional delay it has two parts.

    Raises
    ------
    ParameterError
        For another signal, or sizes out of range.

    Source: Hulin 2017, secs. 3.1.5 and 5.2.
    """
    if signal not in ("step", "impulse"):
        raise ParameterError(f"signal = {signal!r}: expected 'step' or 'impulse'.")
    if samples < 1 or per_sample < 1 or samples * per_sample > _MOST_POINTS:
        raise ParameterError(
            f"samples = {samples}, per_sample = {per_sample}: expected 1 or more, together at most {_MOST_POINTS}."
        )
    force = 1.0 if signal == "step" else 0.0
    wall = np.array([alpha]), np.array([beta])
    rows = [loop.force_rows(*wall, segment.age)[0] for segment in loop.segments]
    state = np.zeros(loop.states)
    state[1] = 1.0 - force
    times, positions, at_samples = [np.zeros(1)], [np.zeros(1)], [0.0]
    for k in range(samples):
        start, begun = state[:2], float(k)
        for segment, motion, row in zip(loop.segments, loop.flows, rows, strict=True):
            push = float(row @ state) + force
            t = segment.duration * np.arange(1, per_sample + 1) / per_sample
            ones = np.ones(per_sample)
            positions.append(loop.position_after(t, start[0] * ones, start[1] * ones, push * ones))
            times.append(begun + t)
            start, begun = motion.transition @ start + motion.gain * push, begun + segment.duration
        state = np.concatenate([start, state[:1], state[2:-1]])
        at_samples.append(float(start[0]))
    return Response(np.concatenate(times), np.concatenate(positions), np.array(at_samples))


def extrema(found: Response) -> tuple[Floats, Floats]:
    """Return times and positions of the local extrema among the points of a response."""
    slope = np.sign(np.diff(found.position))
    at = np.flatnonzero(slope[1:] * slope[:-1] < 0) + 1
    return found.time[at], found.position[at]
