"""Documents of theory for command line, REST and Python: limits, costs of listed walls, optima.

What cannot be computed is None, with the reason beside it. `pipeline.theory.costs` makes maps of the same costs.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.records.criteria import CRITERIA, DISCRETE, ENERGY, with_discrete
from pipeline.records.trials import Floats
from pipeline.theory.boundary import boundary, has_islands, is_well_inside, outline
from pipeline.theory.costs import check_criteria, point_costs_by_name
from pipeline.theory.optimum import POINT_CRITERIA, marked_point, optimal_point
from pipeline.theory.poles import spectral_radius, stable_by_radius
from pipeline.theory.settling_overshoot import LONGEST

if TYPE_CHECKING:  # its classes take longer to load than a short command to run
    from pipeline.records.models import Device, Experiment

WALL_COLUMNS = ("stiffness", "damping")
"""Columns of a CSV file of walls in SI."""

CASE_COLUMNS = ("alpha", "beta", "gamma", "delta", "delay")

POINT_COSTS = tuple(
    name + suffix
    for name in ("settle_2pct", "overshoot", *(c.name for c in CRITERIA.values() if c.family is ENERGY))
    for suffix in ("", DISCRETE)
)
"""Costs of a listed point, where no others are asked for."""

MARGINAL = 1e-12
"""Distance of the spectral radius from 1 below which no cost is given: the poles are rounded to about 1e-15
and energy costs grow with the inverse distance to the power of w + 1, so hardly three digits would be left."""

_ISLANDS = (
    "not searched: walls beyond an unstable stretch (at their damping, softer ones are unstable), which exist for this "
    "loop and may cost less"
)

_NEGATIVE = "the stiffness is negative: the device's own spring, or that of an operator, is stiffer than is best"

LARGEST = 1e200
"""Largest alpha and beta, far above any limit; the matrices of larger ones overflow."""

GRID_DAMPINGS, GRID_STIFFNESSES = 12, 30
"""Grid of walls where a device file states none: dampings over half of the stable ones, stiffnesses up to the limit."""


@dataclass(frozen=True)
class Case:
    """A loop as documents tell of it.

    Parameters
    ----------
    loop : NormalisedLoop
    units : LoopUnits, optional
        Of the wall, where it is told in SI.
    names : dict
        What else is said of the loop; without units its normalised parameters.
    """

    loop: NormalisedLoop
    units: LoopUnits | None = None
    names: dict[str, Any] = field(default_factory=dict)

    @property
    def axes(self) -> tuple[str, str]:
        """Names of stiffness and damping of a wall."""
        return WALL_COLUMNS if self.units is not None else CASE_COLUMNS[:2]

    @property
    def scale(self) -> tuple[float, float]:
        """Stiffness and damping that alpha = 1 and beta = 1 stand for."""
        return (1.0, 1.0) if self.units is None else (self.units.stiffness, self.units.damping)

    @property
    def said(self) -> dict[str, Any]:
        """What every document says of the loop."""
        plant = {} if self.units is not None else {name: getattr(self.loop, name) for name in CASE_COLUMNS[2:]}
        return {**plant, **self.names}


def case_of(device: Device, experiment: Experiment) -> Case:
    """Return the loop of a device's experiment; where its delay jitters at the mean, with the range in `Case.names`."""
    loop, table = device.loop_for(experiment), device.loop_table(experiment)
    low, high = loop.delay_range
    names = {
        "device": device.name,
        "experiment": experiment.name,
        "delay_samples": loop.delay_samples,
        "delay_samples_low": low,
        "delay_samples_high": high,
        "parts": table.model_dump(mode="json", exclude_defaults=True, exclude={"friction"}),
        "left_out": list(loop.left_out),
    }
    return Case(NormalisedLoop.of(loop), LoopUnits.of(loop), names)


@dataclass(frozen=True)
class Grid:
    """Walls that are tested: dampings [Ns/m, Nms/rad], and the step by which the stiffness [N/m, Nm/rad] climbs."""

    damping_first: float
    damping_last: float
    damping_step: float
    stiffness_step: float


def tested_grid(device: Device, experiment: Experiment) -> Grid:
    """Return the walls that a course tests: as the device file says, and where it does not, over those that are stable.

    Raises
    ------
    ParameterError
        If the file names no grid and no wall is stable.
    """
    e = experiment
    if e.damping_last is None or e.damping_step is None or e.stiffness_step is None:
        case = case_of(device, experiment)
        found = boundary_document(case, points=GRID_STIFFNESSES)
        last = max(found["damping"]) / 2 if e.damping_last is None else e.damping_last
        last = max(last, e.damping_first)
        step = (last - e.damping_first) / (GRID_DAMPINGS - 1) or case.scale[1]
        return Grid(
            e.damping_first,
            last,
            rounded(step) if e.damping_step is None else e.damping_step,
            rounded(found["stiffness_max"] / GRID_STIFFNESSES) if e.stiffness_step is None else e.stiffness_step,
        )
    return Grid(e.damping_first, e.damping_last, e.damping_step, e.stiffness_step)


def rounded(step: float) -> float:
    """Return a step as a person would choose it: 1, 2 or 5 times a power of ten, at most the one given."""
    power = 10.0 ** math.floor(math.log10(step))
    return max(power * nice for nice in (1, 2, 5) if power * nice <= step * (1 + 1e-9))


@dataclass(frozen=True, eq=False)
class Cases:
    """Points of a CSV file: values, shape (n, columns), in the order of the columns, and the row of each."""

    path: Path
    values: Floats
    row: tuple[int, ...]


def read_cases(path: Path, columns: tuple[str, ...] = CASE_COLUMNS) -> Cases:
    """Read points from a CSV file with a header; columns in any order, further ones are ignored.

    Parameters
    ----------
    path : Path
    columns : tuple of str
        Names of its columns; by default the normalised parameters of a wall and its loop.

    Raises
    ------
    ParameterError
        If the file cannot be read, a column is missing or a cell is no finite number; rows are counted from
        1, header included.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, strict=True)
            header = [name.strip() for name in next(reader, [])]
            lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except OSError as error:
        raise ParameterError(
            f"{path}: cannot be read ({error.strerror or error}). Give a CSV file of points."
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ParameterError(f"{path}: is no CSV file in UTF-8 ({error}).") from error
    missing = [name for name in columns if name not in header]
    if missing:
        raise ParameterError(
            f"{path}, row 1: no column {', '.join(missing)}; expected a header with "
            f"{', '.join(columns)}, found {', '.join(header) or 'nothing'}."
        )
    double = [name for name in columns if header.count(name) > 1]
    if double:
        raise ParameterError(f"{path}, row 1: column {double[0]} occurs twice; remove one.")
    places = [header.index(name) for name in columns]
    values = np.empty((len(lines), len(columns)))
    for value, (row, cells) in zip(values, lines, strict=True):
        if len(cells) != len(header):
            raise ParameterError(
                f"{path}, row {row}: expected {len(header)} cells as in the header, found {len(cells)}."
            )
        for i, place in enumerate(places):
            try:
                value[i] = float(cells[place])
            except ValueError:
                value[i] = math.nan
            if not math.isfinite(value[i]):
                raise ParameterError(
                    f"{path}, row {row}, column {columns[i]}: expected a finite number, found {cells[place]!r}."
                )
    return Cases(path, values, tuple(row for row, _ in lines))


def case_documents(cases: Cases, criteria: Sequence[str] = POINT_COSTS) -> list[dict[str, Any]]:
    """Return `point_documents` of rows with `CASE_COLUMNS`, in the order of the file.

    Raises
    ------
    ParameterError
        For an unknown criterion, or if a value of a row is outside its range.
    """
    for name, values in zip(CASE_COLUMNS[:2], cases.values.T, strict=False):
        too_large = np.flatnonzero(np.abs(values) > LARGEST)
        if len(too_large):
            raise ParameterError(
                f"{cases.path}, row {cases.row[too_large[0]]}, column {name}: expected at most {LARGEST:g}, found "
                f"{values[too_large[0]]:g}."
            )
    documents: list[dict[str, Any]] = [{} for _ in cases.row]
    plants, group = np.unique(cases.values[:, 2:], axis=0, return_inverse=True)
    for number, plant in enumerate(plants):
        members = np.flatnonzero(group.ravel() == number)
        try:
            gamma, delta, delay = map(float, plant)
            loop = NormalisedLoop.ideal(gamma, delta, delay)
        except ParameterError as error:
            raise ParameterError(f"{cases.path}, row {cases.row[members[0]]}: {error}") from error
        for index, document in zip(members, point_documents(Case(loop), cases.values[members], criteria), strict=True):
            documents[index] = document
    return documents


def point_documents(case: Case, walls: Floats, criteria: Sequence[str] = POINT_COSTS) -> list[dict[str, Any]]:
    """Return stability and costs of walls.

    Parameters
    ----------
    case : Case
    walls : float64, shape (n, 2 or more)
        Stiffness and damping in the case's units.
    criteria : sequence of str
        As of `map.CostMap`.

    Returns
    -------
    list of dict
        Stiffness and damping, ``stable``, ``spectral_radius``, the cost by each criterion (None where it cannot be
        had) and ``reason`` (why costs are None, else None); normalised ones with the loop's parameters, those of a
        device with ``left_out``.

    Raises
    ------
    ParameterError
        For an unknown criterion.

    Notes
    -----
    Points with alpha + gamma <= 0 have no final position, a real pole z >= 1, and are not stable.
    """
    check_criteria(criteria)
    for name, values, scale in zip(case.axes, walls.T, case.scale, strict=False):
        largest = min(LARGEST * scale, np.finfo(np.float64).max)
        if (np.abs(values) > largest).any():
            raise ParameterError(f"{name}: expected at most {largest:g}, found {np.abs(values).max():g}.")
    loop, (alpha, beta) = case.loop, walls[:, :2].T / np.array(case.scale)[:, None]
    radius = spectral_radius(loop, alpha, beta)
    stable = stable_by_radius(loop, alpha, radius)
    usable, found = np.flatnonzero(stable & (radius < 1 - MARGINAL)), np.full((len(criteria), len(walls)), np.nan)
    known = point_costs_by_name(loop, alpha[usable], beta[usable], criteria, LONGEST)
    for row, name in zip(found, criteria, strict=True):
        row[usable] = known[name]
    result = []
    for i, wall in enumerate(walls):
        costs = dict(zip(criteria, _listed(found[:, i]), strict=True))
        missing = [name for name, cost in costs.items() if cost is None]
        document: dict[str, Any] = {case.axes[0]: float(wall[0]), case.axes[1]: float(wall[1])}
        document |= case.said if case.units is None else {}
        document |= {"stable": bool(stable[i]), "spectral_radius": float(radius[i])}
        document |= {**costs, "reason": _why_missing(loop, float(alpha[i]), float(radius[i]), missing)}
        result.append(document | ({"left_out": case.names["left_out"]} if case.names else {}))
    return result


def _why_missing(loop: NormalisedLoop, alpha: float, radius: float, missing: list[str]) -> str | None:
    """Return why a wall has no costs by some criteria, None where none is missing."""
    if alpha + loop.gamma <= 0:
        return "no final position: alpha + gamma <= 0"
    if radius >= 1:
        return "unstable"
    if radius >= 1 - MARGINAL:
        return f"spectral radius within {MARGINAL:g} of 1: costs would be rounding errors"
    return f"still moves after {LONGEST} samples: no {', '.join(missing)}" if missing else None


def boundary_document(case: Case, points: int = 400) -> dict[str, Any]:
    """Return the limit of walls with its extreme points, as the document that `theory boundary` prints.

    LoopUnits it is the whole boundary; in SI that of walls with stiffness, over damping, with islands beside it; None
    lies between separate regions.

    Raises
    ------
    ParameterError
        If no wall is stable at any damping.

    Source: Hulin 2017, sec. 3.4.
    """
    (k, b), (stiffness, damping) = case.scale, case.axes
    if case.units is None:
        border = boundary(case.loop, points)
        extremes = {
            f"{stiffness}_max": border.alpha_max,
            f"{damping}_at_{stiffness}_max": border.beta_at_alpha_max,
            f"{damping}_max": border.beta_max,
            f"{stiffness}_at_{damping}_max": border.alpha_at_beta_max,
        }
        return {**case.said, **extremes, stiffness: _listed(border.alpha), damping: _listed(border.beta)}
    found = outline(case.loop, points)
    if not len(found.beta) and not len(found.islands):
        raise ParameterError(
            f"device {case.names['device']!r}, experiment {case.names['experiment']!r}: no stiffness and damping "
            "stabilise this loop. Check delay, lag and filter in the device file."
        )
    gaps = np.flatnonzero(np.diff(found.part)) + 1
    return {
        **case.said,
        "stiffness_max": float(found.alpha_max * k) if len(found.beta) else None,
        "damping_at_stiffness_max": float(found.beta_at_alpha_max * b) if len(found.beta) else None,
        stiffness: _listed(np.insert(found.alpha * k, gaps, np.nan)),
        damping: _listed(np.insert(found.beta * b, gaps, np.nan)),
        "islands": islands_in_si(found.islands, case.units),
    }


def _listed(values: Floats) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


def islands_in_si(islands: Floats, units: LoopUnits) -> list[dict[str, float]]:
    """Return stable intervals, shape (n, 3) as of `Limits`, by name."""
    k, b = units.stiffness, units.damping
    return [
        {"damping": float(beta * b), "stiffness_low": float(low * k), "stiffness_high": float(high * k)}
        for beta, low, high in islands
    ]


def _unstable_rule(loop: NormalisedLoop, alpha: float, beta: float) -> str | None:
    """Return what is wrong with the wall of a tuning rule; None where it and all softer ones are stable."""
    radius = float(spectral_radius(loop, alpha, beta)[0])
    if not stable_by_radius(loop, np.array([alpha]), np.array([radius]))[0]:
        return (
            f"this tuning is unstable here: spectral radius {radius:.6g}; the rule assumes a device without these parts"
        )
    if not is_well_inside(loop, np.array([alpha]), np.array([beta]), islands=False)[0]:
        return "softer walls at the damping of this tuning are unstable here"
    return None


def optimum_document(case: Case, criterion: str, signal: str | None = None) -> dict[str, Any]:
    """Return the optimal point of a criterion as the document that `theory optimum` prints.

    Parameters
    ----------
    case : Case
    criterion : str
        One of `CRITERIA` or `POINT_CRITERIA`; for the sampled response with ``_discrete`` appended, or by `signal`.
    signal : {"continuous", "discrete"}, optional
        Which response the cost is taken from; by default as the criterion's name says.

    Raises
    ------
    ParameterError
        For a criterion or signal that is not supported, or where both contradict each other.
    """
    known = with_discrete(CRITERIA)
    if criterion not in (*POINT_CRITERIA, *known):
        raise ParameterError(
            f"no optimum for criterion {criterion!r}; supported are {', '.join((*POINT_CRITERIA, *CRITERIA))}, "
            "those of a response also with _discrete appended."
        )
    if signal not in (None, "continuous", "discrete"):
        raise ParameterError(f"signal {signal!r}: expected continuous or discrete.")
    if signal == "continuous" and criterion.endswith(DISCRETE):
        raise ParameterError(f"criterion {criterion!r} is a discrete one, but the signal is continuous.")
    loop, (k, b), (stiffness, damping) = case.loop, case.scale, case.axes
    if criterion in POINT_CRITERIA:
        mark = marked_point(loop, criterion)
        rule = criterion == "ziegler_nichols"
        reason = "a tuning rule has no cost" if rule else "a point of the stability boundary has no cost"
        wall = {stiffness: mark.alpha * k, damping: mark.beta * b}
        document = {"criterion": criterion, **case.said, **wall, "cost": None, "reason": reason}
        note = _unstable_rule(loop, mark.alpha, mark.beta) if rule else None
        return document | ({"note": note} if note else {})
    # criteria of the poles have no sampled response
    name = sampled if signal == "discrete" and (sampled := f"{criterion}{DISCRETE}") in known else criterion
    point = optimal_point(loop, name)
    document = {"criterion": name, **case.said, stiffness: point.alpha * k, damping: point.beta * b, "cost": point.cost}
    if not point.attained:
        document["reason"] = "a limit at the edge of the stable region, which no stable point reaches"
    elif float(spectral_radius(loop, point.alpha, point.beta)[0]) >= 1 - MARGINAL:
        document["cost"] = None
        document["reason"] = (
            f"spectral radius within {MARGINAL:g} of 1 wherever it is stable: costs would be rounding errors"
        )
    notes = [_ISLANDS] if has_islands(loop) else []
    if point.alpha < 0:
        notes.append(_NEGATIVE)
    if notes:
        document["note"] = "; ".join(notes)
    if point.box is not None:
        ends = [f"{axis}_{end}" for axis in case.axes for end in ("low", "high")]
        document["box"] = dict(
            zip(ends, (value * scale for value, scale in zip(point.box, (k, k, b, b), strict=True)), strict=True)
        )
    return document
