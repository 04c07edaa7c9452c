"""Costs over the whole stable region, in blocks of rows: what `pipeline theory map` writes (`map_file`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, Normalised
from pipeline.records.batch import Booleans, Floats
from pipeline.records.criteria import CRITERIA, REPORTED, with_discrete
from pipeline.theory.cost.pointcosts import point_costs_by_name
from pipeline.theory.stability.boundary import boundary
from pipeline.theory.stability.region import is_inside, is_well_inside

MAP_CRITERIA = tuple(c.name for c in CRITERIA.values() if not c.optimum_only)
"""Criteria of a map; those of a response also as ``_discrete``."""

MAP_DEFAULT = tuple(name for name in REPORTED if CRITERIA[name].tabled)

MAP_LONGEST = 1 << 14
"""Samples after which a response on a map is given up; only cells along the boundary need more."""

MAP_QUIET = 1e-13
"""Deviation at which a response on a map without overshoot ends: below the 1e-12 that counts as none."""

LARGEST_MAP = 4001
"""Grid points along an axis, for the sake of time: minutes. Memory is that of a block, whatever the size."""

BLOCK = 1 << 16
"""Grid points of a block, but at least one row: some 100 MB while its costs are computed, a map of 251 x 251 in one."""

MARGIN = 1e-9
"""Distance from the boundary, as a share of alpha + gamma, within which costs would be rounding errors."""

_FEWEST = 8
"""Points of a boundary whose extremes alone are asked for."""


def check_criteria(names: Sequence[str]) -> None:
    """Raise ParameterError if a name is none of `MAP_CRITERIA`, nor of those of a response with ``_discrete``."""
    unknown = [name for name in names if name not in with_discrete(MAP_CRITERIA)]
    if unknown:
        raise ParameterError(
            f"criterion {unknown[0]!r} is unknown; expected some of {', '.join(MAP_CRITERIA)}, "
            "those of a response also with _discrete appended."
        )


def bounding_box(loop: Loop) -> tuple[float, float, float, float]:
    """Return alpha_low, alpha_high, beta_low, beta_high of the stable region."""
    border = boundary(loop, _FEWEST)  # its extremes are known whatever the points between
    return -loop.gamma, border.alpha_max, border.beta_min, border.beta_max


@dataclass(frozen=True, eq=False)
class MapBlock:
    """Rows of a map: all points of some beta, beta changing slowest; costs by name, NaN where there is none."""

    alpha: Floats
    beta: Floats
    stable: Booleans
    costs: dict[str, Floats]


@dataclass(frozen=True)
class CostMap:
    """What a map shows: a grid over the bounding box of the stable region, both ends included.

    Parameters
    ----------
    loop : Loop
    size : int
        Grid points along each axis, 2 to 4001.
    criteria : sequence of str
        Any of `MAP_CRITERIA`; those of a response also with ``_discrete`` appended.
    longest : int
        Samples after which a response that still moves gets no cost.
    units : Normalised, optional
        Of stiffness and damping, where the map is to be in SI.

    Raises
    ------
    ParameterError
        For an unknown criterion or a size out of range.

    Notes
    -----
    Responses without overshoot are followed down to a deviation of 1e-13.

    Source: Hulin 2017, ch. 5, footnote 1 (grid of 251 x 251 points).
    """

    loop: Loop
    size: int = 251
    criteria: Sequence[str] = MAP_DEFAULT
    longest: int = MAP_LONGEST
    units: Normalised | None = None

    def __post_init__(self) -> None:
        check_criteria(self.criteria)
        if not 2 <= self.size <= LARGEST_MAP:
            raise ParameterError(f"size = {self.size}: expected 2 to {LARGEST_MAP} grid points along an axis.")
        if self.longest < 1:
            raise ParameterError(f"longest = {self.longest}: expected at least 1 sample.")

    @property
    def names(self) -> tuple[str, ...]:
        """Criteria, each once."""
        return tuple(dict.fromkeys(self.criteria))

    @property
    def axes(self) -> tuple[str, str]:
        """Names of the columns that tell a point."""
        return ("alpha", "beta") if self.units is None else ("stiffness", "damping")

    def blocks(self, points: int = BLOCK) -> Iterator[MapBlock]:
        """Compute the map from the lowest beta on, in blocks of about so many points (at least a row).

        Costs are null where a point is not stable or (overshoot, settling time) its response still moves after
        ``longest`` samples. A block's size changes no more than rounding of them.
        """
        box = bounding_box(self.loop)
        alpha, beta = np.linspace(*box[:2], self.size), np.linspace(*box[2:], self.size)
        rows = max(1, points // self.size)
        for first in range(0, self.size, rows):
            yield self._block(*(grid.ravel() for grid in np.meshgrid(alpha, beta[first : first + rows])))

    def _block(self, alpha: Floats, beta: Floats) -> MapBlock:
        stable = is_inside(self.loop, alpha, beta)
        inside = np.flatnonzero(is_well_inside(self.loop, alpha, beta, MARGIN))
        costs = {name: np.full(len(alpha), np.nan) for name in self.names}
        points = self.loop, alpha[inside], beta[inside]
        found = point_costs_by_name(*points, self.names, self.longest, MAP_QUIET, part=True)
        for name, values in found.items():
            costs[name][inside] = values
        return MapBlock(alpha, beta, stable, costs)
