"""Costs over the whole stable region as a table: what `pipeline theory map` writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.base.errors import ParameterError, PipelineError
from pipeline.base.provenance import stamp
from pipeline.records.tables import write_parquet
from pipeline.theory.loop import Loop
from pipeline.theory.pointcosts import IMPULSE_ENERGIES, SETTLING, STEP_ENERGIES, point_costs_by_name
from pipeline.theory.region import is_inside, is_well_inside
from pipeline.theory.stability import boundary, boundary_points, spectral_radius

MAP_CRITERIA = (*SETTLING, "overshoot", *STEP_ENERGIES, *IMPULSE_ENERGIES, "pole_radius")
"""Criteria of a map; all but ``pole_radius`` also as ``_discrete``."""

MAP_DEFAULT = ("settle_2pct", "overshoot", *STEP_ENERGIES)

MAP_LONGEST = 1 << 14
"""Samples after which a response on a map is given up; only cells along the boundary need more."""

MAP_QUIET = 1e-13
"""Deviation at which a response on a map without overshoot ends: below the 1e-12 that counts as none."""

LARGEST_MAP = 2001
"""Grid points along an axis; 2001 x 2001 points take about 1 GiB."""

_MARGIN = 1e-9
"""Distance from the boundary, as a share of alpha + gamma, within which costs would be rounding errors."""

_NEAR_ZERO = 1e-5
"""Angle that stands for theta -> 0: the boundary is off its limit by O(theta^2), rounding by 1e-16/theta."""


def bounding_box(loop: Loop) -> tuple[float, float, float, float]:
    """Return alpha_low, alpha_high, beta_low, beta_high of the stable region.

    The region's lowest beta is often the limit of the boundary for theta -> 0, on the line alpha = -gamma.
    """
    border = boundary(loop)
    start = float(boundary_points(loop, np.array([_NEAR_ZERO]))[1][0])
    return -loop.gamma, border.alpha_max, min(start, float(border.beta.min())), border.beta_max


def map_table(
    loop: Loop, size: int = 251, criteria: Sequence[str] = MAP_DEFAULT, longest: int = MAP_LONGEST
) -> pa.Table:
    """Return the costs on a grid over the bounding box of the stable region, both ends included.

    Parameters
    ----------
    loop : Loop
    size : int
        Grid points along each axis, 2 to 2001.
    criteria : sequence of str
        Any of `MAP_CRITERIA`, also with ``_discrete`` appended (not ``pole_radius``).
    longest : int
        Samples after which a response that still moves gets no cost.

    Returns
    -------
    pyarrow.Table
        ``size**2`` rows, beta changing slowest: alpha, beta, stable and one column for each criterion, null
        where not stable or (overshoot, settling time) where the response still moves after ``longest`` samples.

    Raises
    ------
    ParameterError
        For an unknown criterion or a size out of range.

    Notes
    -----
    Responses without overshoot are followed down to a deviation of 1e-13.

    Source: Hulin 2017, ch. 5, footnote 1 (grid of 251 x 251 points).
    """
    names = tuple(dict.fromkeys(criteria))
    known = {*MAP_CRITERIA, *(f"{name}_discrete" for name in MAP_CRITERIA if name != "pole_radius")}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ParameterError(
            f"criterion {unknown[0]!r} is unknown; expected some of {', '.join(MAP_CRITERIA)}, "
            "all but pole_radius also with _discrete appended."
        )
    if not 2 <= size <= LARGEST_MAP:
        raise ParameterError(f"size = {size}: expected 2 to {LARGEST_MAP} grid points along an axis.")
    if longest < 1:
        raise ParameterError(f"longest = {longest}: expected at least 1 sample.")
    box = bounding_box(loop)
    axes = np.meshgrid(np.linspace(*box[:2], size), np.linspace(*box[2:], size))
    alpha, beta = (axis.ravel() for axis in axes)
    stable = is_inside(loop, alpha, beta)
    inside = np.flatnonzero(is_well_inside(loop, alpha, beta, _MARGIN))
    costs = {name: np.full(len(alpha), np.nan) for name in names}
    if "pole_radius" in costs:
        costs["pole_radius"][inside] = spectral_radius(loop, alpha[inside], beta[inside])
    asked = [name for name in names if name != "pole_radius"]
    for name, values in point_costs_by_name(loop, alpha[inside], beta[inside], asked, longest, MAP_QUIET).items():
        costs[name][inside] = values
    meaning = f"null where not stable, within {_MARGIN:g} of the boundary, or still moving after {longest} samples"
    fields = [pa.field("alpha", pa.float64(), False), pa.field("beta", pa.float64(), False)]
    fields += [pa.field("stable", pa.bool_(), False)]
    fields += [pa.field(name, pa.float64(), metadata={"unit": "1", "meaning": meaning}) for name in names]
    plant = {"gamma": repr(loop.gamma), "delta": repr(loop.delta), "delay": repr(loop.delay)}
    columns = [pa.array(alpha), pa.array(beta), pa.array(stable)]
    columns += [pa.array(values, from_pandas=True) for values in costs.values()]
    return pa.table(columns, schema=pa.schema(fields, metadata=dict(stamp(**plant, size=str(size)))))


def write_map(path: Path, table: pa.Table) -> None:
    """Write a map to Parquet so that a reader sees all of it or nothing.

    Raises
    ------
    PipelineError
        If the file cannot be written; an earlier one stays as it was.
    """
    try:
        write_parquet(path, table)
    except OSError as error:
        raise PipelineError(
            f"{path}: map cannot be written ({error.strerror or error}). Choose another file (--out)."
        ) from error
