"""Walls that are stable whatever spring the device is attached to: the intersection of stable regions over gamma.

Source: Hulin 2017, sec. 4.3.3, Fig. 4.5.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, as_points
from pipeline.records.batch import Floats
from pipeline.theory.stability.region import stable_intervals

_STIFFNESSES = 65
"""Springs of the first sweep, denser towards both ends; the limit is a smooth function of gamma between a few kinks."""

_ROUNDS = 4
"""Rounds that look closer around the worst spring of each beta."""

_FINER = 8
"""New springs in each gap beside a worst one, per round: 8^4 finer in the end, an error of 1e-9 at a smooth minimum."""


_POINTS = 40
"""Dampings up to that of the device, and beyond it, at which an outline is computed."""


def robust_outline(delta: float, delay: float) -> tuple[Floats, Floats, Floats]:
    """Return the outline of the region that is stable with every spring: alpha, beta and the worst spring gamma, (n,).

    Empty where there is none, as for delta = 0. Parameters and errors as for `robust_limits`.

    Source: Hulin 2017, Fig. 4.5.
    """
    beyond = np.geomspace(1.0, 1 + 4 / (delta * (delay + 0.5)), _POINTS) if delta > 0 else np.empty(0)
    beta = delta * np.concatenate([np.linspace(-1.0, 1.0, _POINTS), beyond[1:]])
    alpha, gamma = robust_limits(delta, delay, beta)
    inside = alpha > 1e-9 * alpha.max(initial=0.0)  # at B = -b it is what rounding leaves of 0
    return alpha[inside], beta[inside], gamma[inside]


def robust_limits(delta: float, delay: float, beta: object) -> tuple[Floats, Floats]:
    """Return the largest alpha that is stable with every spring, and the worst spring gamma, at each beta.

    Parameters
    ----------
    delta, delay : float
        Normalised damping of the device and delay factor.
    beta : array_like, shape (n,)

    Returns
    -------
    limit, gamma : float64, shape (n,)
        -inf where no alpha > 0 is stable with every spring (always for delta = 0, where the region vanishes).

    Raises
    ------
    ParameterError
        If delta or delay is out of range.

    Notes
    -----
    gamma runs from 0 to pi^2 + delta^2/4 (4.15). Every alpha between 0 and the limit is robustly stable: for each
    spring the end of the stable interval that starts at or below 0 is taken, and of these the smallest. Found by a
    sweep over gamma, refined around the worst springs. At long delays it is low, that is conservative: by 0.5 % at
    d = 128 and 0.7 % at d = 256.

    Source: Hulin 2017, sec. 4.3.3.
    """
    _, b = as_points(0.0, beta)
    if not (math.isfinite(delta) and delta >= 0):
        raise ParameterError(f"delta = {delta}: expected a finite number that is not negative.")
    largest = math.pi**2 + delta**2 / 4
    gamma = 0.5 * largest * (1 - np.cos(np.pi * np.linspace(0, 1, _STIFFNESSES)))
    limits = np.stack([_first_exit(delta, delay, float(g), b) for g in gamma])
    for _ in range(_ROUNDS):
        alive = np.flatnonzero((limits > 0).all(axis=0))
        worst = np.unique(np.argmin(limits[:, alive], axis=0)) if len(alive) else np.zeros(0, np.intp)
        gaps = np.unique(np.clip(np.concatenate([worst - 1, worst]), 0, len(gamma) - 2))
        if not len(worst):
            break
        share = np.arange(1, _FINER) / _FINER
        new = (gamma[gaps, None] + (gamma[gaps + 1] - gamma[gaps])[:, None] * share).ravel()
        rows = np.full((len(new), len(b)), np.inf)
        nearest = gamma[np.argmin(limits, axis=0)]
        for row, value in zip(rows, new, strict=True):  # each spring only for the beta whose worst one is next to it
            near = np.flatnonzero((limits > 0).all(axis=0) & (np.abs(value - nearest) <= _reach(gamma, value)))
            if len(near):
                row[near] = _first_exit(delta, delay, float(value), b[near])
        gamma, limits = np.concatenate([gamma, new]), np.concatenate([limits, rows])
        order = np.argsort(gamma)
        gamma, limits = gamma[order], limits[order]
    result = limits.min(axis=0)
    return np.where(result > 0, result, -np.inf), gamma[np.argmin(limits, axis=0)]


def _reach(gamma: Floats, value: float) -> float:
    """Width of the gap between springs that a value lies in."""
    at = int(np.clip(np.searchsorted(gamma, value), 1, len(gamma) - 1))
    return float(gamma[at] - gamma[at - 1])


def _first_exit(delta: float, delay: float, gamma: float, beta: Floats) -> Floats:
    """Upper end of the stable interval that begins at or below alpha = 0; -inf where there is none."""
    loop = Loop(gamma, delta, delay)
    found = stable_intervals(loop, beta)
    starts = (found.low <= 0) & (found.high > 0)
    result = np.full(len(beta), -np.inf)
    result[found.index[starts]] = found.high[starts]
    return result
