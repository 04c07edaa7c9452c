"""Costs of single points by the name of the criterion; those of a family are computed together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.records.criteria import (
    CRITERIA,
    DISCRETE,
    OVERSHOOT,
    REPORTED,
    RISE_LEVELS,
    SETTLING,
    criterion_of,
    members,
    with_discrete,
)
from pipeline.theory.energy import energy_costs
from pipeline.theory.limits import is_well_inside
from pipeline.theory.march import step_transients
from pipeline.theory.modes import TOGETHER
from pipeline.theory.poles import damping_ratio, spectral_radius
from pipeline.theory.transient import QUIET, first_reached, transient_costs

_MANY = 256
"""Points from which on the march in blocks is faster."""

_LARGEST_DELAY = 32
"""Delay up to which its buffers fit a cache."""


@dataclass(frozen=True)
class Following:
    """How long responses are followed: `point_costs_by_name` says what its values mean."""

    longest: int
    quiet: float = QUIET
    part: bool = False


PointCosts = Callable[[Loop, Floats, Floats, Sequence[str], Following], dict[str, Floats]]


def _transients(loop: Loop, alpha: Floats, beta: Floats, names: Sequence[str], follow: Following) -> dict[str, Floats]:
    bands = sorted({band for name in names if (band := criterion_of(name).band) is not None})
    blocks = len(alpha) >= (1 if follow.part else _MANY)
    if blocks and len(bands) == 1 and _can_march(loop):
        found = step_transients(loop, alpha, beta, bands[0], longest=follow.longest, quiet=follow.quiet)
        # a single band is not named in the march
        found |= {n: found[n.replace(criterion_of(n).name, "settle")] for n in names if criterion_of(n).band}
        rest = np.flatnonzero(np.isnan([found[name] for name in names]).any(axis=0))
        told = _followed(loop, alpha[rest], beta[rest], names, bands, follow)
        for name in names:
            found[name][rest] = told[name]
        return found
    return _followed(loop, alpha, beta, names, bands, follow)


def _followed(
    loop: Loop, alpha: Floats, beta: Floats, names: Sequence[str], bands: Sequence[float], follow: Following
) -> dict[str, Floats]:
    continuous = any(not name.endswith(DISCRETE) for name in names)
    overshoot = any(criterion_of(name).band is None for name in names)
    return transient_costs(
        *(loop, alpha, beta, bands),
        overshoot=overshoot,
        continuous=continuous,
        longest=follow.longest,
        quiet=follow.quiet,
    )


def _energies(loop: Loop, alpha: Floats, beta: Floats, names: Sequence[str], _: Following) -> dict[str, Floats]:
    signals = dict.fromkeys(criterion_of(name).signal for name in names)
    return {name: cost for signal in signals for name, cost in energy_costs(loop, alpha, beta, signal).items()}


def _poles(loop: Loop, alpha: Floats, beta: Floats, names: Sequence[str], _: Following) -> dict[str, Floats]:
    functions = {"pole_radius": spectral_radius, "damping": damping_ratio}
    return {name: functions[name](loop, alpha, beta) for name in names}


def _rises(loop: Loop, alpha: Floats, beta: Floats, names: Sequence[str], follow: Following) -> dict[str, Floats]:
    """Rise times; stability is not needed, so that they are also told along the edge of the stable region."""
    asked = alpha, beta, [share - 1.0 for share in RISE_LEVELS], follow.longest, "rise_time" in names
    exact, sampled = first_reached(loop, *asked)
    return {"rise_time": exact[-1] - exact[0], f"rise_time{DISCRETE}": sampled[-1] - sampled[0]}


FAMILIES: dict[str, PointCosts] = {
    "settling": _transients,
    "overshoot": _transients,
    "energy": _energies,
    "rise": _rises,
    "poles": _poles,
}
"""What computes the costs of a family, by name, of shape (n,)."""


def point_costs_by_name(
    loop: Loop,
    alpha: Floats,
    beta: Floats,
    names: Sequence[str],
    longest: int,
    quiet: float = QUIET,
    *,
    part: bool = False,
) -> dict[str, Floats]:
    """Return costs of stable points by name, computing no more than what is asked for.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
        Stable points with alpha + gamma > 0.
    names : sequence of str
        Of criteria with costs; those of a response also with ``_discrete`` appended.
    longest : int
        Samples after which a response that still moves gets NaN for settling time and overshoot.
    quiet : float
        Deviation below which a response without overshoot is no longer followed.
    part : bool
        Whether the points are part of very many: then their number does not choose the method, since the march in
        blocks tells costs of slow points that the plain one gives up.
    """
    follow = Following(longest, quiet, part)
    groups: dict[PointCosts, list[str]] = {}
    for name in names:
        groups.setdefault(FAMILIES[criterion_of(name).family.name], []).append(name)
    result = {name: np.empty(len(alpha)) for name in names}
    together = TOGETHER if loop.has_parts else max(1, len(alpha))  # they share their modes
    for first in range(0, len(alpha), together):
        some = slice(first, first + together)
        for function, group in groups.items():
            found = function(loop, alpha[some], beta[some], group, follow)
            for name in group:
                result[name][some] = found[name]
    return result


def _can_march(loop: Loop) -> bool:
    return not loop.has_parts and loop.oldest_force == loop.delay <= _LARGEST_DELAY


MAP_CRITERIA = tuple(c.name for c in CRITERIA.values() if not c.optimum_only)
"""Criteria of a map; those of a response also as ``_discrete``."""

MAP_DEFAULT = tuple(name for name in REPORTED if CRITERIA[name].tabled)

MAP_SAMPLES = 1000
"""Samples after which a point of a map counts as not settled and stays empty; a log is some 400 long."""

MAP_QUIET = 1e-9
"""Deviation below which a map no longer looks for overshoot: far below what a contour of 10 % or a sensor shows."""


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
