"""Step and impulse responses over time, exact at every point, also of unstable walls and of those without stiffness."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats

_MOST_POINTS = 1 << 22
"""Points of one response; more would take seconds and tell nothing."""

_SAME = 1e-12
"""Times of a sampling interval that close together are one."""


def response(loop: Loop, alpha: float, beta: float, signal: str, samples: int, per_sample: int = 24) -> Floats:
    """Return the sensed position after a unit step or impulse at time 0, shape (samples per_sample + 1,).

    Parameters
    ----------
    loop : Loop
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
        For another signal, or sizes out of range.

    Source: Hulin 2017, secs. 3.1.5 and 5.2.
    """
    if signal not in ("step", "impulse"):
        raise ParameterError(f"signal = {signal!r}: expected 'step' or 'impulse'.")
    if samples < 1 or per_sample < 1 or samples * per_sample > _MOST_POINTS:
        raise ParameterError(
            f"samples = {samples}, per_sample = {per_sample}: expected 1 or more, together at most {_MOST_POINTS}."
        )
    loop, wall, force = loop, (np.array([alpha]), np.array([beta])), float(signal == "step")
    matrix, push, sensor = loop.device
    p, newest = len(push), loop.states - loop.oldest_force - 1
    motion = np.zeros((p + 1, p + 1))
    motion[:p, :p], motion[:p, p] = matrix, push
    grid, begun, parts = np.arange(1, per_sample + 1) / per_sample, 0.0, []
    for segment in loop.segments:
        times = grid[(grid > begun + _SAME) & (grid <= begun + segment.duration + _SAME)] - begun
        rows = np.array([sensor @ expm(motion * time)[:p] for time in times]).reshape(-1, p + 1)
        parts.append((segment.age, rows, expm(motion * segment.duration)[:p]))
        begun += segment.duration
    law, turn = loop.law(*wall)[0], loop.matrix(*wall)[0]
    state = loop.starts(wall[0], "impulse")[0] * (1 - force)
    found = [np.array([sensor @ state[:p]])]
    for _ in range(samples):
        device, following = state[:p], turn @ state
        for age, rows, end in parts:
            driven = np.append(device, force + (state[newest + age] if age else law @ state))
            found.append(rows @ driven)
            device = end @ driven
        following[:p] = device
        state = following
    return np.concatenate(found)
