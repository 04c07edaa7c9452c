"""Theoretical cost maps over a grid of stiffness and damping, for figures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.records.criteria import DISCRETE, OVERSHOOT, SETTLING, criterion_of, members
from pipeline.theory.cost.pointcosts import point_costs_by_name
from pipeline.theory.cost.settling_overshoot import transient_costs
from pipeline.theory.stability.region import is_well_inside

MAP_SAMPLES = 1000
"""Samples after which a point of a map counts as not settled and stays empty; a log is some 400 long."""

MAP_QUIET = 1e-9
"""Deviation below which a map no longer looks for overshoot: far below what a contour of 10 % or a sensor shows."""


def cost_maps(loop: Loop, alpha: Floats, beta: Floats, criteria: Sequence[str]) -> dict[str, Floats]:
    """Return the discrete step-response costs on a grid.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shapes (p,), (q,)
        Axes of normalised stiffness and damping.
    criteria : sequence of str
        Those that a log can be judged by; the costs of the sampled response, as of logs.

    Returns
    -------
    dict of float64, shape (q, p)
        NaN where unstable or without final position (alpha + gamma <= 0); the settling time also where the response
        still moves after `MAP_SAMPLES`. The overshoot is the largest one within that time: a stable response reaches
        it in its first oscillations, but for a slow beat (spectral radius above 0.99), seen to add 0.001 later.

    Source: Hulin 2017, secs. 5.2 and 6.1.4 (theoretical maps of Figs. 6.5 to 6.7, 6.10, 6.11).
    """
    grid_alpha, grid_beta = np.meshgrid(alpha, beta)
    found = costs_at(loop, grid_alpha.ravel(), grid_beta.ravel(), criteria)
    return {criterion: values.reshape(grid_alpha.shape) for criterion, values in found.items()}


def costs_at(loop: Loop, alpha: Floats, beta: Floats, criteria: Sequence[str]) -> dict[str, Floats]:
    """Return the costs of `cost_maps` at single points.

    Parameters
    ----------
    loop, criteria
        As of `cost_maps`.
    alpha, beta : float64, shape (n,)
        Normalised stiffness and damping of each point.

    Returns
    -------
    dict of float64, shape (n,)
        NaN as in `cost_maps`.
    """
    usable = np.flatnonzero(alpha + loop.gamma > 0)
    usable = usable[is_well_inside(loop, alpha[usable], beta[usable])]
    a, b = alpha[usable], beta[usable]
    others = [f"{c}{DISCRETE}" for c in criteria if criterion_of(c).family not in (SETTLING, OVERSHOOT)]
    costs = point_costs_by_name(loop, a, b, others, MAP_SAMPLES, MAP_QUIET)
    bands = [c.band for c in members(SETTLING, criteria) if c.band]
    if bands:
        costs |= transient_costs(loop, a, b, bands, overshoot=False, continuous=False, longest=MAP_SAMPLES)
    if OVERSHOOT.name in criteria:
        # on its own: a response that has long settled may still move by more than `MAP_QUIET` at the end
        costs |= transient_costs(
            *(loop, a, b, ()), continuous=False, longest=MAP_SAMPLES, quiet=MAP_QUIET, unfinished_overshoot=True
        )
    result = {}
    for criterion in criteria:
        result[criterion] = np.full(alpha.shape, np.nan)
        result[criterion][usable] = costs[f"{criterion}{DISCRETE}"]
    return result
