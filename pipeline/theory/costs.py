"""Compute the costs of walls by criterion, at points or on a grid for figures. Criteria share computations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
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
    is_criterion,
)
from pipeline.records.trials import Booleans, Floats
from pipeline.theory.boundary import boundary, is_inside, is_well_inside
from pipeline.theory.energy import energy_costs
from pipeline.theory.poles import damping_ratio, spectral_radius
from pipeline.theory.settling_overshoot import first_reached, transient_costs

MAP_CRITERIA = tuple(c.name for c in CRITERIA.values() if not c.optimum_only)
"""Criteria of a map. For criteria of a response, ``_discrete`` may be appended."""

MAP_DEFAULT = tuple(name for name in REPORTED if CRITERIA[name].tabled)

MAP_LONGEST = 1 << 14
"""Largest number of samples of a response on a map. Only points near the boundary need more."""

LARGEST_MAP = 4001
"""Largest number of grid points along an axis, which takes minutes. The required memory is that of one block, for any
size."""

BLOCK = 1 << 16
"""Number of grid points of a block (at least one row). A block takes about 100 MB during computation. A map of 251 x
251 points is one block."""

_FEWEST = 8
"""Number of points of a boundary that is computed only for its extremes."""


def point_costs_by_name(
    loop: NormalisedLoop, alpha: Floats, beta: Floats, names: Sequence[str], longest: int
) -> dict[str, Floats]:
    """Return the requested costs of stable points, with names as keys.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : float64, shape (n,)
        Stable points with alpha + gamma > 0. Rise times are also defined for unstable points.
    names : sequence of str
        Names of criteria with costs. For criteria of a response, ``_discrete`` may be appended.
    longest : int
        Number of samples after which settling time and overshoot of a response that still moves are NaN.
    """
    of = {name: criterion_of(name) for name in names}
    found: dict[str, Floats] = {}
    transient = [name for name in names if of[name].family in (SETTLING, OVERSHOOT)]
    if transient:
        bands = sorted({band for name in transient if (band := of[name].band) is not None})
        whether = {
            "overshoot": any(of[name].family is OVERSHOOT for name in transient),
            "continuous": not all(name.endswith(DISCRETE) for name in transient),
        }
        found |= transient_costs(loop, alpha, beta, bands, longest=longest, **whether)
    energies = [criterion for criterion in of.values() if criterion.family is ENERGY]
    for signal in dict.fromkeys(criterion.signal for criterion in energies):
        weights = sorted({criterion.weight for criterion in energies if criterion.signal == signal})
        found |= energy_costs(loop, alpha, beta, signal, weights)
    if any(criterion.family is RISE for criterion in of.values()):
        levels = [share - 1.0 for share in RISE_LEVELS]
        exact, sampled = first_reached(loop, alpha, beta, levels, longest, "rise_time" in of)
        found |= {"rise_time": exact[-1] - exact[0], f"rise_time{DISCRETE}": sampled[-1] - sampled[0]}
    for name, function in (("pole_radius", spectral_radius), ("damping", damping_ratio)):
        if name in of:
            found[name] = function(loop, alpha, beta)
    return {name: found[name] for name in names}


def check_criteria(names: Sequence[str]) -> None:
    """Raise ParameterError if a name is neither in `MAP_CRITERIA` nor a criterion of a response with ``_discrete``."""
    unknown = [name for name in names if not is_criterion(name, MAP_CRITERIA)]
    if unknown:
        raise ParameterError(
            f"criterion {unknown[0]!r} is unknown; expected names from {', '.join(MAP_CRITERIA)}, "
            "criteria of a response with _discrete appended, or another band or weighting, such as settle_3pct or "
            "energy_step_w0.5."
        )


def cost_maps(loop: NormalisedLoop, alpha: Floats, beta: Floats, criteria: Sequence[str]) -> dict[str, Floats]:
    """Return `costs_at` on a grid with axes of shapes (p,) and (q,); costs have the shape (q, p)."""
    grid_alpha, grid_beta = np.meshgrid(alpha, beta)
    found = costs_at(loop, grid_alpha.ravel(), grid_beta.ravel(), criteria)
    return {criterion: values.reshape(grid_alpha.shape) for criterion, values in found.items()}


def costs_at(loop: NormalisedLoop, alpha: Floats, beta: Floats, criteria: Sequence[str]) -> dict[str, Floats]:
    """Return costs of the sampled step response, by criteria that apply to logs.

    Parameters
    ----------
    loop : NormalisedLoop
    alpha, beta : float64, shape (n,)
        Normalised stiffness and damping of each point.
    criteria : sequence of str

    Returns
    -------
    dict of float64, shape (n,)
        NaN as in `costs_inside`.

    Source: Hulin 2017, secs. 5.2 and 6.1.4 (theoretical maps of Figs. 6.5 to 6.7, 6.10, 6.11).
    """
    found = costs_inside(loop, alpha, beta, [f"{criterion}{DISCRETE}" for criterion in criteria])
    return dict(zip(criteria, found.values(), strict=True))


def costs_inside(
    loop: NormalisedLoop, alpha: Floats, beta: Floats, names: Sequence[str], longest: int = MAP_LONGEST
) -> dict[str, Floats]:
    """Return costs of points, shape (n,) each, in the order of the names.

    A cost is NaN if the point is unstable or within `boundary.MARGIN` of the boundary, or if its response still moves
    after ``longest`` samples.
    """
    inside = np.flatnonzero(is_well_inside(loop, alpha, beta))
    found = point_costs_by_name(loop, alpha[inside], beta[inside], names, longest)
    result = {name: np.full(len(alpha), np.nan) for name in names}
    for name, values in result.items():
        values[inside] = found[name]
    return result


def bounding_box(loop: NormalisedLoop) -> tuple[float, float, float, float]:
    """Return alpha_low, alpha_high, beta_low, beta_high of the stable region."""
    border = boundary(loop, _FEWEST)  # the extremes do not depend on the number of points
    return -loop.gamma, border.alpha_max, border.beta_min, border.beta_max


@dataclass(frozen=True, eq=False)
class MapBlock:
    """Rows of a map.

    They contain all points for some beta, with beta changing slowest, and costs by name (NaN without a cost).
    """

    alpha: Floats
    beta: Floats
    stable: Booleans
    costs: dict[str, Floats]


AXES = ("alpha", "beta")
"""Column names of a point of a map."""


@dataclass(frozen=True)
class CostMap:
    """Specification of a map, which is a grid over the bounding box of the stable region, including both ends.

    Parameters
    ----------
    loop : NormalisedLoop
    size : int
        Number of grid points along each axis, 2 to 4001.
    criteria : sequence of str
        Names from `MAP_CRITERIA`. For criteria of a response, ``_discrete`` may be appended.
    longest : int
        Number of samples after which a response that still moves has no cost.

    Raises
    ------
    ParameterError
        If a criterion is unknown, or the size is out of range.

    Notes
    -----
    Responses without overshoot are simulated down to a deviation of 1e-13.

    Source: Hulin 2017, ch. 5, footnote 1 (grid of 251 x 251 points).
    """

    loop: NormalisedLoop
    size: int = 251
    criteria: Sequence[str] = MAP_DEFAULT
    longest: int = MAP_LONGEST

    def __post_init__(self) -> None:
        check_criteria(self.criteria)
        if not 2 <= self.size <= LARGEST_MAP:
            raise ParameterError(f"size = {self.size}: expected 2 to {LARGEST_MAP} grid points along an axis.")
        if self.longest < 1:
            raise ParameterError(f"longest = {self.longest}: expected at least 1 sample.")

    @property
    def names(self) -> tuple[str, ...]:
        """Distinct criteria in their order."""
        return tuple(dict.fromkeys(self.criteria))

    def to_json(self) -> dict[str, Any]:
        """Return the entries of a document on the map."""
        return {"rows": self.size**2, "columns": [*AXES, "stable", *self.names]}

    def blocks(self, points: int = BLOCK) -> Iterator[MapBlock]:
        """Yield the map from the lowest beta, in blocks of about ``points`` points (at least one row).

        A cost is NaN if the point is not stable, or, for overshoot and settling time, if its response still moves after
        ``longest`` samples. The block size affects only rounding errors.
        """
        box = bounding_box(self.loop)
        alpha, beta = np.linspace(*box[:2], self.size), np.linspace(*box[2:], self.size)
        rows = max(1, points // self.size)
        for first in range(0, self.size, rows):
            a, b = (grid.ravel() for grid in np.meshgrid(alpha, beta[first : first + rows]))
            costs = costs_inside(self.loop, a, b, self.names, self.longest)
            yield MapBlock(a, b, is_inside(self.loop, a, b), costs)
