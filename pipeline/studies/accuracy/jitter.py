"""Limit of stability of a loop whose delay jitters: where its long response neither grows nor decays on average.

Theory has no such limit, and the limits that courses find are what is to be judged. This one is read from responses
far longer than any trial, with an ideal sensor and without a travel limit.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from pipeline.records.batch import Floats
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import simulate

SEARCH_ROWS, SEARCH_POINTS = 1000, 40
"""Rows of the responses and stiffness values at each damping of the first search."""

ROWS, POINTS, REPETITIONS = 3000, 9, 32
"""As above for the second one, and responses at each stiffness: the mean rate of all of them scatters by 1e-4 per
sample, which is 0.5 % of the stiffness at high damping; areas over 30 dampings differed by 0.2 % between seeds."""

REACH = 0.06
"""Range of the second search about the zero of the first, relative: more than a step of it in the
upper part of the region."""

WINDOW = 100
"""Samples over which the size of the motion is averaged: more than a period of any mode near the limit."""

FIRST_WINDOW = 3
"""Window from which on growth is read: before it the modes that decay fast are still seen."""


def growth_per_sample(setup: Setup, stiffness: Floats, damping: Floats, *, seed: int) -> Floats:
    """Return the mean growth rate of long, ideal responses, shape (n,) [1/sample].

    Parameters
    ----------
    setup : Setup
        Its jitter is used, its sensor and limits are not.
    stiffness, damping : float64, shape (n,)
        K [N/m, Nm/rad] > 0 and B [Ns/m, Nms/rad]; equal pairs have equal jitter.
    seed : int
    """
    ideal = replace(setup, quantum=0.0, noise=0.0, travel=inf, force_limit=None, stop=inf)
    batch = simulate(ideal, stiffness, damping, seed=seed)
    away = batch.position[:, setup.edge_row :] - setup.centre
    windows = away.shape[1] // WINDOW
    parts = away[:, : windows * WINDOW].reshape(len(batch), windows, WINDOW)
    # a response that has died out to the last digit still counts as decaying
    size = np.log(np.sqrt(np.mean(parts**2, axis=2)) + np.finfo(np.float64).tiny)
    rate: Floats = (size[:, -1] - size[:, FIRST_WINDOW]) / ((windows - 1 - FIRST_WINDOW) * WINDOW)
    return rate


def jitter_limit(setup: Setup, damping: Floats, stiffest: float, *, seed: int = 0) -> Floats:
    """Return the largest stable stiffness at each damping, 0 where there is none, shape (n,) [N/m, Nm/rad].

    Parameters
    ----------
    setup : Setup
    damping : float64, shape (n,)
        B >= 0 [Ns/m, Nms/rad].
    stiffest : float
        Stiffness that is unstable at every damping [N/m, Nm/rad].
    seed : int

    Notes
    -----
    The growth rate is first sampled up to ``stiffest``; about its last zero a parabola is fitted to the rates of
    `REPETITIONS` responses at each of `POINTS` stiffness values. With a constant delay that is the exact limit but for
    0.1 %, as a test shows.
    """
    result = np.zeros(len(damping))
    # finer where it is soft: there the limit falls to 0 with B
    grid = stiffest * (np.arange(1, SEARCH_POINTS + 1) / SEARCH_POINTS) ** 2
    factor = np.linspace(1 - REACH, 1 + REACH, POINTS)
    # equal pairs would be given equal jitter
    apart = 1 + 1e-9 * np.arange(REPETITIONS)
    for i, value in enumerate(damping.tolist()):
        rate = growth_per_sample(replace(setup, rows=SEARCH_ROWS), grid, np.full(len(grid), value), seed=seed)
        # the last change of sign: a motion that died out to the last digit before it was read has a rate of about 0
        stable = np.flatnonzero(rate < 0)
        if not len(stable) or stable[-1] == len(grid) - 1:
            continue
        grows = int(stable[-1]) + 1
        share = rate[grows - 1] / (rate[grows - 1] - rate[grows])
        centre = grid[grows - 1] + share * (grid[grows] - grid[grows - 1])
        K = np.outer(centre * factor, apart).ravel()
        fine = growth_per_sample(replace(setup, rows=ROWS), K, np.full(len(K), value), seed=seed + 1)
        parabola = np.polynomial.Polynomial.fit(np.repeat(factor, REPETITIONS), fine, 2)
        roots = parabola.roots()
        real = roots[np.abs(roots.imag) < 1e-9].real
        nearest = float(real[np.argmin(np.abs(real - 1))]) if len(real) else 1.0
        # no further than the rates were looked at; where they hardly depend on K the parabola has no zero near
        result[i] = centre * float(np.clip(nearest, 1 - REACH, 1 + REACH))
    return result
