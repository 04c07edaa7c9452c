"""Searches that others use for boundaries and optima: gridding, bisection, Nelder-Mead."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pipeline.records.batch import Floats
from pipeline.studies.accuracy.methods import Case, radius_by_roots
from pipeline.theory.poles import bisect

_GRID = 11
"""Grid points along an axis in each round of an iterative gridding; the next round spans two cells around the best."""

Cost = Callable[[Floats, Floats], Floats]
"""Costs of points (alpha, beta); infinite where not stable."""


def bisect_limit(radius: Cost, beta: Floats, high: float, tolerance: float) -> Floats:
    """Return the largest stable alpha for each beta by a scan and bisection on the spectral radius, batched.

    Parameters
    ----------
    radius : callable
        Spectral radius of points (alpha, beta).
    beta : float64, shape (n,)
    high : float
        An alpha beyond the region.
    tolerance : float
        Width at which to stop, relative to ``high``.
    """
    low, up = _brackets(radius, beta, high)
    halvings = math.ceil(math.log2(1 / (tolerance * (_GRID - 1))))
    low, up = bisect(lambda alpha: radius(alpha, beta) < 1, low, up, halvings)
    return 0.5 * (low + up)


def _brackets(radius: Cost, beta: Floats, high: float) -> tuple[Floats, Floats]:
    """Largest stable point of a coarse scan, and its unstable neighbour."""
    scan = np.linspace(0, high, _GRID)
    grid_alpha, grid_beta = (g.ravel() for g in np.meshgrid(scan[1:-1], beta))
    stable = (radius(grid_alpha, grid_beta) < 1).reshape(len(beta), -1)
    last = np.where(stable.any(axis=1), stable.shape[1] - np.argmax(stable[:, ::-1], axis=1), 0)
    return scan[last], scan[last + 1]


def grid_limit(case: Case, beta: Floats, high: float, tolerance: float) -> Floats:
    """Return the largest stable alpha for each beta as the source does: poles on ever finer grids.

    Source: Hulin 2017, sec. 3.4: poles of the transfer function (3.9) at each grid point.
    """
    result = np.empty(len(beta))
    for i, value in enumerate(beta):
        low, up = 0.0, high
        while up - low > tolerance * high:
            alpha = np.linspace(low, up, _GRID)[1:-1]
            stable = radius_by_roots(case, alpha, np.full(len(alpha), value)) < 1
            last = len(alpha) - int(np.argmax(stable[::-1])) if stable.any() else 0
            edges = np.concatenate([[low], alpha, [up]])
            low, up = float(edges[last]), float(edges[last + 1])
        result[i] = 0.5 * (low + up)
    return result


def iterated_grid_optimum(cost: Cost, high: tuple[float, float], tolerance: float) -> tuple[float, float]:
    """Return the best point of ever finer grids, each two cells to either side of the best one so far.

    Source: Hulin 2017, sec. 5.1.2 (gridding with thresholds as in 3.4).
    """
    centre, half = np.array(high) / 2, np.array(high) / 2
    while float((half / high).max()) > tolerance:
        axes = (np.linspace(c - h, c + h, _GRID) for c, h in zip(centre, half, strict=True))
        alpha, beta = (g.ravel() for g in np.meshgrid(*axes))
        best = int(np.argmin(cost(alpha, beta)))
        centre = np.array([alpha[best], beta[best]])
        half = half * 4 / (_GRID - 1)
    return float(centre[0]), float(centre[1])


def nelder_mead(cost: Cost, start: tuple[float, float], size: float, tolerance: float) -> tuple[float, float]:
    """Return where the simplex search of Nelder and Mead ends, from one start.

    Parameters
    ----------
    size : float
        Edge of the first simplex relative to the start.
    tolerance : float
        Size of the simplex, relative to the start, at which to stop; 400 steps at most.
    """

    from scipy.optimize import minimize

    origin = np.array(start)
    found = minimize(
        lambda p: float(cost(p[:1], p[1:])[0]),
        origin,
        method="Nelder-Mead",
        options={
            "initial_simplex": [origin, origin * [1 + size, 1], origin * [1, 1 + size]],
            "xatol": tolerance * min(start),
            "fatol": np.inf,
            "maxiter": 400,
        },
    )
    return float(found.x[0]), float(found.x[1])
