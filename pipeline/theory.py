"""Numbers behind the theory commands: costs of listed points, cost maps, boundaries and optima as documents.

All parameters are normalised (Table 3.1). What cannot be computed is None, with the reason beside it or in
the metadata of the column.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.batch import Booleans, Floats
from pipeline.energy import energy_costs
from pipeline.errors import ParameterError, PipelineError
from pipeline.loop import Loop
from pipeline.models import SETTLING_BANDS
from pipeline.optimum import STEP_CRITERIA, optimal_point
from pipeline.provenance import stamp
from pipeline.stability import boundary, boundary_points, spectral_radius
from pipeline.transient import LONGEST, QUIET, transient_costs

if TYPE_CHECKING:
    import pyarrow as pa

CASE_COLUMNS = ("alpha", "beta", "gamma", "delta", "delay")
ENERGIES = {signal: tuple(f"energy_{signal}_w{w}" for w in (0, 1, 2)) for signal in ("step", "impulse")}

POINT_COSTS = tuple(
    name + suffix
    for name in ("settle_2pct", "overshoot", *ENERGIES["step"], *ENERGIES["impulse"])
    for suffix in ("", "_discrete")
)
"""Costs of a listed point."""

MAP_CRITERIA = (*SETTLING_BANDS, "overshoot", *ENERGIES["step"], *ENERGIES["impulse"], "pole_radius")
"""Criteria of a map; all but ``pole_radius`` also as ``_discrete``."""

MAP_DEFAULT = ("settle_2pct", "overshoot", *ENERGIES["step"])

BOUNDARY_CRITERIA = ("alpha_max", "beta_max")
"""Criteria whose optimum is a point of the stability boundary; they have no cost."""

OPTIMUM_CRITERIA = (*BOUNDARY_CRITERIA, *STEP_CRITERIA)

MARGINAL = 1e-12
"""Distance of the spectral radius from 1 below which no cost is given: the poles are rounded to about 1e-15
and energy costs grow with the inverse distance to the power of w + 1, so hardly three digits would be left."""

MAP_LONGEST = 1 << 14
"""Samples after which a response on a map is given up: 0.5 to 3 % of the stable cells, all along the boundary,
where costs are a thousand times the optimum; following those too takes ten times as long."""

MAP_QUIET = 1e-13
"""Deviation at which a response on a map without overshoot ends: below the 1e-12 that counts as none."""

LARGEST_MAP = 2001
"""Grid points along an axis; 2001 x 2001 points take about 1 GiB."""


@dataclass(frozen=True, eq=False)
class Cases:
    """Points of a CSV file: values, shape (n, 5), in the order of `CASE_COLUMNS`, and the row of each."""

    path: Path
    values: Floats
    row: tuple[int, ...]


def read_cases(path: Path) -> Cases:
    """Read points from a CSV file with a header; columns in any order, further ones are ignored.

    Parameters
    ----------
    path : Path
        Columns alpha, beta, gamma, delta, delay, all normalised.

    Raises
    ------
    ParameterError
        If the file cannot be read, a column is missing or a cell is no finite number; rows are counted from
        1, header included.
    """
    values: list[list[float]] = []
    rows: list[int] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, strict=True)
            header = [name.strip() for name in next(reader, [])]
            missing = [name for name in CASE_COLUMNS if name not in header]
            if missing:
                raise ParameterError(
                    f"{path}, row 1: no column {', '.join(missing)}; expected a header with "
                    f"{', '.join(CASE_COLUMNS)}, found {', '.join(header) or 'nothing'}."
                )
            double = [name for name in CASE_COLUMNS if header.count(name) > 1]
            if double:
                raise ParameterError(f"{path}, row 1: column {double[0]} occurs twice; remove one.")
            places = [header.index(name) for name in CASE_COLUMNS]
            for cells in reader:
                if any(cell.strip() for cell in cells):
                    values.append(_numbers(path, reader.line_num, cells, len(header), places))
                    rows.append(reader.line_num)
    except OSError as error:
        raise ParameterError(
            f"{path}: cannot be read ({error.strerror or error}). Give a CSV file of points."
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ParameterError(f"{path}: is no CSV file in UTF-8 ({error}).") from error
    return Cases(path, np.array(values, dtype=np.float64).reshape(-1, len(CASE_COLUMNS)), tuple(rows))


def _numbers(path: Path, row: int, cells: list[str], width: int, places: list[int]) -> list[float]:
    if len(cells) != width:
        raise ParameterError(f"{path}, row {row}: expected {width} cells as in the header, found {len(cells)}.")
    numbers = []
    for name, place in zip(CASE_COLUMNS, places, strict=True):
        try:
            number = float(cells[place])
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ParameterError(f"{path}, row {row}, column {name}: expected a finite number, found {cells[place]!r}.")
        numbers.append(number)
    return numbers


def point_costs(cases: Cases) -> list[dict[str, Any]]:
    """Return stability and costs of each point, in the order of the file.

    Parameters
    ----------
    cases : Cases

    Returns
    -------
    list of dict
        The five parameters, ``stable``, ``spectral_radius``, each of `POINT_COSTS` (None where it cannot be
        had) and ``reason`` (why costs are None, else None).

    Raises
    ------
    ParameterError
        If gamma, delta or delay of a row is outside its range.

    Notes
    -----
    Points with alpha + gamma <= 0 have no final position, a real pole z >= 1, and are not stable.
    """
    documents: list[dict[str, Any]] = [{} for _ in cases.row]
    plants, group = np.unique(cases.values[:, 2:], axis=0, return_inverse=True)
    group = group.ravel()
    for number, plant in enumerate(plants):
        members = np.flatnonzero(group == number)
        try:
            loop = Loop(*(float(value) for value in plant))
        except ParameterError as error:
            raise ParameterError(f"{cases.path}, row {cases.row[members[0]]}: {error}") from error
        alpha, beta = cases.values[members, 0], cases.values[members, 1]
        for index, document in zip(members, _points_of_loop(loop, alpha, beta), strict=True):
            documents[index] = document
    return documents


def _points_of_loop(loop: Loop, alpha: Floats, beta: Floats) -> list[dict[str, Any]]:
    radius = spectral_radius(loop, alpha, beta)
    stable = _stable(loop, alpha, radius)
    usable = np.flatnonzero(stable & (radius < 1 - MARGINAL))
    costs = {name: np.full(len(alpha), np.nan) for name in POINT_COSTS}
    if len(usable):
        found = _costs(loop, alpha[usable], beta[usable], POINT_COSTS, LONGEST)
        for name, values in found.items():
            costs[name][usable] = values
    columns = {name: [None if math.isnan(v) else float(v) for v in values] for name, values in costs.items()}
    result = []
    for i in range(len(alpha)):
        point = {name: column[i] for name, column in columns.items()}
        result.append(
            {
                "alpha": float(alpha[i]),
                "beta": float(beta[i]),
                **_plant(loop),
                "stable": bool(stable[i]),
                "spectral_radius": float(radius[i]),
                **point,
                "reason": _reason(loop, float(alpha[i]), float(radius[i]), None in point.values()),
            }
        )
    return result


def _plant(loop: Loop) -> dict[str, float]:
    return {"gamma": loop.gamma, "delta": loop.delta, "delay": loop.delay}


def _reason(loop: Loop, alpha: float, radius: float, incomplete: bool) -> str | None:
    if alpha + loop.gamma <= 0:
        return "no final position: alpha + gamma <= 0"
    if radius >= 1:
        return "unstable"
    if radius >= 1 - MARGINAL:
        return f"spectral radius within {MARGINAL:g} of 1: costs would be rounding errors"
    return f"still moves after {LONGEST} samples" if incomplete else None


def _stable(loop: Loop, alpha: Floats, radius: Floats) -> Booleans:
    # with alpha + gamma <= 0 there is a real pole at or above z = 1, which rounding may show just below it
    return np.asarray((radius < 1) & (alpha + loop.gamma > 0))


def _costs(
    loop: Loop,
    alpha: Floats,
    beta: Floats,
    names: Sequence[str],
    longest: int,
    quiet: float = QUIET,
) -> dict[str, Floats]:
    """Costs of stable points by name, computing no more than what is asked for."""
    bases = {name.removesuffix("_discrete") for name in names}
    result: dict[str, Floats] = {}
    for signal, energies in ENERGIES.items():
        if bases & set(energies):
            result |= energy_costs(loop, alpha, beta, signal)
    bands = [width for criterion, width in SETTLING_BANDS.items() if criterion in bases]
    if bands or "overshoot" in bases:
        result |= transient_costs(
            loop,
            alpha,
            beta,
            bands,
            overshoot="overshoot" in bases,
            continuous=any(name in (*SETTLING_BANDS, "overshoot") for name in names),
            longest=longest,
            quiet=quiet,
        )
    return {name: result[name] for name in names}


def boundary_document(loop: Loop, points: int = 400) -> dict[str, Any]:
    """Return the stability boundary with its extreme points, as the document that `theory boundary` prints.

    Source: Hulin 2017, sec. 3.4.
    """
    border = boundary(loop, points)
    return {
        **_plant(loop),
        "alpha_max": border.alpha_max,
        "beta_at_alpha_max": border.beta_at_alpha_max,
        "beta_max": border.beta_max,
        "alpha_at_beta_max": border.alpha_at_beta_max,
        "alpha": border.alpha.tolist(),
        "beta": border.beta.tolist(),
    }


def optimum_document(loop: Loop, criterion: str, signal: str | None = None) -> dict[str, Any]:
    """Return the optimal point of a criterion as the document that `theory optimum` prints.

    Parameters
    ----------
    loop : Loop
    criterion : str
        One of `OPTIMUM_CRITERIA`; for the sampled response with ``_discrete`` appended, or by `signal`.
    signal : {"continuous", "discrete"}, optional
        Which response the cost is taken from; by default as the criterion's name says.

    Raises
    ------
    ParameterError
        For a criterion or signal that is not supported, or where both contradict each other.
    """
    base = criterion.removesuffix("_discrete")
    if base not in OPTIMUM_CRITERIA or (base in BOUNDARY_CRITERIA and criterion != base):
        raise ParameterError(
            f"no optimum for criterion {criterion!r}; supported are {', '.join(OPTIMUM_CRITERIA)}, "
            f"all but {' and '.join(BOUNDARY_CRITERIA)} also with _discrete appended."
        )
    if signal not in (None, "continuous", "discrete"):
        raise ParameterError(f"signal {signal!r}: expected continuous or discrete.")
    if signal == "continuous" and criterion != base:
        raise ParameterError(f"criterion {criterion!r} is a discrete one, but the signal is continuous.")
    document: dict[str, Any] = {"criterion": criterion, **_plant(loop)}
    if base in BOUNDARY_CRITERIA:
        border = boundary(loop)
        largest = (border.alpha_max, border.beta_at_alpha_max)
        alpha, beta = largest if base == "alpha_max" else (border.alpha_at_beta_max, border.beta_max)
        reason = "a point of the stability boundary has no cost"
        return {**document, "alpha": alpha, "beta": beta, "cost": None, "reason": reason}
    name = f"{base}_discrete" if signal == "discrete" else criterion
    point = optimal_point(loop, name)
    document["criterion"] = name
    document |= {"alpha": point.alpha, "beta": point.beta, "cost": point.cost}
    if point.box is not None:
        document["box"] = dict(zip(("alpha_low", "alpha_high", "beta_low", "beta_high"), point.box, strict=True))
    return document


def bounding_box(loop: Loop) -> tuple[float, float, float, float]:
    """Return alpha_low, alpha_high, beta_low, beta_high of the stable region.

    The region's lowest beta is often the limit of the boundary for theta -> 0, on the line alpha = -gamma.
    """
    border = boundary(loop)
    start = float(boundary_points(loop, np.array([_NEAR_ZERO]))[1][0])
    return -loop.gamma, border.alpha_max, min(start, float(border.beta.min())), border.beta_max


_NEAR_ZERO = 1e-5
"""Angle that stands for theta -> 0: the boundary is off its limit by O(theta^2), rounding by 1e-16/theta."""


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
    import pyarrow as pa

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
    radius = spectral_radius(loop, alpha, beta)
    stable = _stable(loop, alpha, radius)
    usable = np.flatnonzero(stable & (radius < 1 - MARGINAL))
    costs = {name: np.full(len(alpha), np.nan) for name in names}
    if "pole_radius" in costs:
        costs["pole_radius"][stable] = radius[stable]
    asked = [name for name in names if name != "pole_radius"]
    for name, values in _costs(loop, alpha[usable], beta[usable], asked, longest, MAP_QUIET).items():
        costs[name][usable] = values
    meaning = f"null where not stable or still moving after {longest} samples"
    fields = [pa.field("alpha", pa.float64(), False), pa.field("beta", pa.float64(), False)]
    fields += [pa.field("stable", pa.bool_(), False)]
    fields += [pa.field(name, pa.float64(), metadata={"unit": "1", "meaning": meaning}) for name in names]
    plant = {name: repr(value) for name, value in _plant(loop).items()}
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
    from pipeline.tables import write_parquet

    try:
        write_parquet(path, table)
    except OSError as error:
        raise PipelineError(
            f"{path}: map cannot be written ({error.strerror or error}). Choose another file (--out)."
        ) from error
