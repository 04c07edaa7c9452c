"""Costs of walls by the name of the criterion, computed together where they share work; over a grid for figures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.records.criteria import (
    CRITERIA,
    DISCRETE,
    ENERGY,
    OVERSHOOT,
    REPORTED,
    RISE,
    RISE_LEVELS,
    SETTLING,
    criterion_of,
    members,
    with_discrete,
)
from pipeline.theory.energy import energy_costs
from pipeline.theory.limits import is_well_inside
from pipeline.theory.modes import TOGETHER
from pipeline.theory.poles import damping_ratio, spectral_radius
from pipeline.theory.transient import QUIET, first_reached, transient_costs

MAP_CRITERIA = tuple(c.name for c in CRITERIA.values() if not c.optimum_only)
"""Criteria of a map; those of a response also as ``_discrete``."""

MAP_DEFAULT = tuple(name for name in REPORTED if CRITERIA[name].tabled)

MAP_SAMPLES = 1000
"""Samples after which a point of a map counts as not settled and stays empty; a log is some 400 long."""

MAP_QUIET = 1e-9
"""Deviation below which a map no longer looks for overshoot: far below what a contour of 10 % or a sensor shows."""


def point_costs_by_name(
    loop: Loop, alpha: Floats, beta: Floats, names: Sequence[str], longest: int, quiet: float = QUIET
) -> dict[str, Floats]:
    """Return costs of stable points by name, computing no more than what is asked for.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
        Stable points with alpha + gamma > 0; of rise times it does not matter whether they are.
    names : sequence of str
        Of criteria with costs; those of a response also with ``_discrete`` appended.
    longest : int
        Samples after which a response that still moves gets NaN for settling time and overshoot.
    quiet : float
        Deviation below which a response without overshoot is no longer followed.
    """
    result = {name: np.empty(len(alpha)) for name in names}
    for first in range(0, len(alpha), TOGETHER):  # they share their modes
        some = slice(first, first + TOGETHER)
        for name, values in _together(loop, alpha[some], beta[some], names, longest, quiet).items():
            if name in result:
                result[name][some] = values
    return result


def _together(
    loop: Loop, alpha: Floats, beta: Floats, names: Sequence[str], longest: int, quiet: float
) -> dict[str, Floats]:
    of = {name: criterion_of(name) for name in names}
    found: dict[str, Floats] = {}
    transient = [name for name in names if of[name].family in (SETTLING, OVERSHOOT)]
    if transient:
        bands = sorted({band for name in transient if (band := of[name].band) is not None})
        whether = {
            "overshoot": any(of[name].family is OVERSHOOT for name in transient),
            "continuous": not all(name.endswith(DISCRETE) for name in transient),
        }
        found |= transient_costs(loop, alpha, beta, bands, longest=longest, quiet=quiet, **whether)
    for signal in dict.fromkeys(criterion.signal for criterion in of.values() if criterion.family is ENERGY):
        found |= energy_costs(loop, alpha, beta, signal)
    if any(criterion.family is RISE for criterion in of.values()):
        levels = [share - 1.0 for share in RISE_LEVELS]
        exact, sampled = first_reached(loop, alpha, beta, levels, longest, "rise_time" in of)
        found |= {"rise_time": exact[-1] - exact[0], f"rise_time{DISCRETE}": sampled[-1] - sampled[0]}
    for name, function in (("pole_radius", spectral_radius), ("damping", damping_ratio)):
        if name in of:
            found[name] = function(loop, alpha, beta)
    return found


def check_criteria(names: Sequence[str]) -> None:
    """Raise ParameterError if a name is none of `MAP_CRITERIA`, nor of those of a response with ``_discrete``."""
    unknown = [name for name in names if name not in with_discrete(MAP_CRITERIA)]
    if unknown:
        raise ParameterError(
            f"criterion {unknown[0]!r} is unknown; expected some of {', '.join(MAP_CRITERIA)}, "
            "those of a response also with _discrete appended."
        )


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
