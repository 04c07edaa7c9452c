"""Costs over the whole stable region, in blocks of rows: what `pipeline theory map` writes (`map_file`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import replacing
from pipeline.base.errors import ParameterError, PipelineError
from pipeline.base.provenance import stamp
from pipeline.loop.loop import Loop, Normalised
from pipeline.records.batch import Booleans, Floats
from pipeline.records.table_files import WRITING
from pipeline.theory.costs import MAP_DEFAULT, check_criteria, point_costs_by_name
from pipeline.theory.limits import boundary, is_inside, is_well_inside

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
        found = point_costs_by_name(*points, self.names, self.longest, MAP_QUIET)
        for name, values in found.items():
            costs[name][inside] = values
        return MapBlock(alpha, beta, stable, costs)


def write_map(
    path: Path, cost_map: CostMap, progress: Callable[[int, int], None] | None = None, points: int = BLOCK
) -> int:
    """Write a map to Parquet so that a reader sees all of it or nothing; return how many of its points are stable.

    Parameters
    ----------
    path : Path
    cost_map : CostMap
    progress : callable, optional
        Told the points done and those in all after each block.
    points : int
        Points of a block, which becomes a row group: memory does not grow with the map.

    Raises
    ------
    PipelineError
        If the file cannot be written; an earlier one stays as it was.
    """
    schema = map_schema(cost_map)
    stable = done = 0
    try:
        with replacing(path) as stream, pq.ParquetWriter(stream, schema, **WRITING) as writer:
            for block in cost_map.blocks(points):
                writer.write_table(block_table(block, schema, cost_map.units))
                stable += int(block.stable.sum())
                done += len(block.alpha)
                if progress is not None:
                    progress(done, cost_map.size**2)
    except OSError as error:
        raise PipelineError(
            f"{path}: map cannot be written ({error.strerror or error}). Choose another file (--out)."
        ) from error
    return stable


def map_schema(cost_map: CostMap) -> pa.Schema:
    """Return columns of the point, stable and one for each criterion, with units and parameters as metadata."""
    loop = cost_map.loop
    meaning = (
        f"null where not stable, within {MARGIN:g} of the boundary, or still moving after {cost_map.longest} samples"
    )
    fields = [pa.field(name, pa.float64(), False) for name in cost_map.axes]
    fields += [pa.field("stable", pa.bool_(), False)]
    fields += [pa.field(name, pa.float64(), metadata={"unit": "1", "meaning": meaning}) for name in cost_map.names]
    plant = {field.name: repr(getattr(loop, field.name)) for field in dataclasses.fields(loop)}
    return pa.schema(fields, metadata=dict(stamp(**plant, size=str(cost_map.size))))


def block_table(block: MapBlock, schema: pa.Schema, units: Normalised | None = None) -> pa.Table:
    """Return a block as an Arrow table; NaN becomes null."""
    stiffness, damping = (units.stiffness, units.damping) if units is not None else (1.0, 1.0)
    columns = [_column(block.alpha * stiffness), _column(block.beta * damping), _bits(block.stable)]
    return pa.table([*columns, *(_column(values) for values in block.costs.values())], schema=schema)


def _column(values: Floats) -> pa.Array:
    """Return floats as a column without a copy; `pa.array` would load numpy's masked arrays first."""
    known = ~np.isnan(values)
    valid = None if known.all() else _bits(known).buffers()[1]
    return pa.Array.from_buffers(pa.float64(), len(values), [valid, pa.py_buffer(np.ascontiguousarray(values))])


def _bits(values: Booleans) -> pa.Array:
    return pa.Array.from_buffers(pa.bool_(), len(values), [None, pa.py_buffer(np.packbits(values, bitorder="little"))])
