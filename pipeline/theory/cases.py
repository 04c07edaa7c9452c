"""Numbers behind the theory commands: costs of listed points, boundaries and optima as documents.

All parameters are normalised (Table 3.1). What cannot be computed is None, with the reason beside it.
`pipeline.theory.map` makes maps of the same costs.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.device_loop import loop_of, wall_units
from pipeline.loop.loop import Loop, Normalised
from pipeline.records.batch import Floats
from pipeline.records.criteria import CRITERIA, DISCRETE, ENERGY, criterion_of, with_discrete
from pipeline.records.loop_parts import LoopParts
from pipeline.records.models import Device, Experiment
from pipeline.theory.costs import check_criteria, point_costs_by_name
from pipeline.theory.limits import boundary, has_islands, outline, robust_outline
from pipeline.theory.optimum import POINT_CRITERIA, marked_point, optimal_point
from pipeline.theory.poles import slowest_poles, spectral_radius, stable_by_radius
from pipeline.theory.transient import LONGEST

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

LARGEST = 1e200
"""Largest alpha and beta, far above any limit; the matrices of larger ones overflow."""


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
    values: list[list[float]] = []
    rows: list[int] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, strict=True)
            header = [name.strip() for name in next(reader, [])]
            missing = [name for name in columns if name not in header]
            if missing:
                raise ParameterError(
                    f"{path}, row 1: no column {', '.join(missing)}; expected a header with "
                    f"{', '.join(columns)}, found {', '.join(header) or 'nothing'}."
                )
            double = [name for name in columns if header.count(name) > 1]
            if double:
                raise ParameterError(f"{path}, row 1: column {double[0]} occurs twice; remove one.")
            places = {name: header.index(name) for name in columns}
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
    return Cases(path, np.array(values, dtype=np.float64).reshape(-1, len(columns)), tuple(rows))


def _numbers(path: Path, row: int, cells: list[str], width: int, places: dict[str, int]) -> list[float]:
    if len(cells) != width:
        raise ParameterError(f"{path}, row {row}: expected {width} cells as in the header, found {len(cells)}.")
    numbers = []
    for name, place in places.items():
        try:
            number = float(cells[place])
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ParameterError(f"{path}, row {row}, column {name}: expected a finite number, found {cells[place]!r}.")
        numbers.append(number)
    return numbers


def point_costs(cases: Cases, criteria: Sequence[str] = POINT_COSTS) -> list[dict[str, Any]]:
    """Return stability and costs of each point, in the order of the file.

    Parameters
    ----------
    cases : Cases
    criteria : sequence of str
        As of `map.CostMap`.

    Returns
    -------
    list of dict
        The five parameters, ``stable``, ``spectral_radius``, the cost by each criterion (None where it cannot be
        had) and ``reason`` (why costs are None, else None).

    Raises
    ------
    ParameterError
        For an unknown criterion, or if a value of a row is outside its range.

    Notes
    -----
    Points with alpha + gamma <= 0 have no final position, a real pole z >= 1, and are not stable.
    """
    check_criteria(criteria)
    for name, values in zip(CASE_COLUMNS[:2], cases.values.T, strict=False):
        too_large = np.flatnonzero(np.abs(values) > LARGEST)
        if len(too_large):
            raise ParameterError(
                f"{cases.path}, row {cases.row[too_large[0]]}, column {name}: expected at most {LARGEST:g}, found "
                f"{values[too_large[0]]:g}."
            )
    documents: list[dict[str, Any]] = [{} for _ in cases.row]
    plants, group = np.unique(cases.values[:, 2:], axis=0, return_inverse=True)
    group = group.ravel()
    for number, plant in enumerate(plants):
        members = np.flatnonzero(group == number)
        try:
            gamma, delta, delay = map(float, plant)
            loop = Loop(gamma, delta, delay)
        except ParameterError as error:
            raise ParameterError(f"{cases.path}, row {cases.row[members[0]]}: {error}") from error
        alpha, beta = cases.values[members, 0], cases.values[members, 1]
        radius = spectral_radius(loop, alpha, beta)
        for index, document in zip(members, points_of_loop(loop, alpha, beta, radius, criteria), strict=True):
            documents[index] = document
    return documents


def points_of_loop(
    loop: Loop, alpha: Floats, beta: Floats, radius: Floats, criteria: Sequence[str] = POINT_COSTS
) -> list[dict[str, Any]]:
    """Return the documents of `point_costs` for points of one loop whose spectral radius is known, shape (n,) each."""
    stable = stable_by_radius(loop, alpha, radius)
    usable = np.flatnonzero(stable & (radius < 1 - MARGINAL))
    costs = {name: np.full(len(alpha), np.nan) for name in criteria}
    if len(usable):
        found = point_costs_by_name(loop, alpha[usable], beta[usable], criteria, LONGEST)
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
                "reason": _reason(
                    loop, float(alpha[i]), float(radius[i]), [name for name in point if point[name] is None]
                ),
            }
        )
    return result


def _plant(loop: Loop) -> dict[str, float]:
    return {"gamma": loop.gamma, "delta": loop.delta, "delay": loop.delay}


def _reason(loop: Loop, alpha: float, radius: float, missing: list[str]) -> str | None:
    if alpha + loop.gamma <= 0:
        return "no final position: alpha + gamma <= 0"
    if radius >= 1:
        return "unstable"
    if radius >= 1 - MARGINAL:
        return f"spectral radius within {MARGINAL:g} of 1: costs would be rounding errors"
    reasons: dict[str, list[str]] = {f"still moves after {LONGEST} samples": [], "its sum is lost in rounding": []}
    for name in missing:
        reasons[list(reasons)[criterion_of(name).family is ENERGY]].append(name)
    return "; ".join(f"{why}: no {', '.join(names)}" for why, names in reasons.items() if names) or None


def boundary_document(loop: Loop, robust: bool = False, points: int = 400) -> dict[str, Any]:
    """Return the stability boundary with its extreme points, as the document that `theory boundary` prints.

    With ``robust`` also the region that is stable whatever spring the device is attached to, with the worst spring.

    Source: Hulin 2017, secs. 3.4 and 4.3.3.
    """
    border = boundary(loop, points)
    names = ("alpha", "beta", "gamma")
    outline = robust_outline(loop.delta, loop.delay) if robust else ()
    region = {"robust": {name: values.tolist() for name, values in zip(names, outline, strict=True)}} if robust else {}
    return {
        **_plant(loop),
        "alpha_max": border.alpha_max,
        "beta_at_alpha_max": border.beta_at_alpha_max,
        "beta_max": border.beta_max,
        "alpha_at_beta_max": border.alpha_at_beta_max,
        "alpha": border.alpha.tolist(),
        "beta": border.beta.tolist(),
        **region,
    }


def optimum_document(
    loop: Loop, criterion: str, signal: str | None = None, units: Normalised | None = None, **names: Any
) -> dict[str, Any]:
    """Return the optimal point of a criterion as the document that `theory optimum` prints.

    Parameters
    ----------
    loop : Loop
    criterion : str
        One of `CRITERIA` or `POINT_CRITERIA`; for the sampled response with ``_discrete`` appended, or by `signal`.
    signal : {"continuous", "discrete"}, optional
        Which response the cost is taken from; by default as the criterion's name says.
    units : Normalised, optional
        Of the wall, where it is to be told in SI.
    names
        What else is said of the loop; its normalised parameters by default.

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
    scale = (1.0, 1.0) if units is None else (units.stiffness, units.damping)
    axes = WALL_COLUMNS if units is not None else CASE_COLUMNS[:2]
    names = names or _plant(loop)
    if criterion in POINT_CRITERIA:
        mark = marked_point(loop, criterion)
        rule = criterion == "ziegler_nichols"
        reason = "a tuning rule has no cost" if rule else "a point of the stability boundary has no cost"
        wall = dict(zip(axes, (mark.alpha * scale[0], mark.beta * scale[1]), strict=True))
        return {"criterion": criterion, **names, **wall, "cost": None, "reason": reason}
    # criteria of the poles have no sampled response
    name = sampled if signal == "discrete" and (sampled := f"{criterion}{DISCRETE}") in known else criterion
    point = optimal_point(loop, name)
    wall = dict(zip(axes, (point.alpha * scale[0], point.beta * scale[1]), strict=True))
    document = {"criterion": name, **names, **wall, "cost": point.cost}
    if not point.attained:
        document["reason"] = "a limit at the edge of the stable region, which no stable point reaches"
    if has_islands(loop):
        document["note"] = _ISLANDS
    if point.box is not None:
        ends = [f"{axis}_{end}" for axis in axes for end in ("low", "high")]
        document["box"] = {
            end: value * scale[i // 2] for i, (end, value) in enumerate(zip(ends, point.box, strict=True))
        }
    return document


GRID_DAMPINGS, GRID_STIFFNESSES = 12, 30
"""Grid of walls where a device file states none: dampings over half of the stable ones, stiffnesses up to the limit."""


@dataclass(frozen=True)
class DeviceCase:
    """An experiment of a device: its loop in units of its wall."""

    device: Device
    experiment: Experiment

    @cached_property
    def parts(self) -> LoopParts:
        """What the loop has beside mass, damper and delay."""
        return self.device.loop_of(self.experiment)

    @cached_property
    def units(self) -> Normalised:
        """Factors between SI and the normalised wall."""
        return wall_units(self.experiment.mass, self.device.sampling_period_s, self.parts)

    @cached_property
    def loop(self) -> Loop:
        """Normalised loop; an ideal one where its parts leave it ideal."""
        e = self.experiment
        return loop_of(e.mass, e.damping, e.stiffness, e.delay_samples, self.device.sampling_period_s, self.parts)

    @property
    def names(self) -> dict[str, Any]:
        """What every document says of the device."""
        return {
            "device": self.device.name,
            "experiment": self.experiment.name,
            "delay_samples": self.experiment.delay_samples,
            "parts": self.parts.model_dump(mode="json", exclude_defaults=True, exclude={"friction"}),
            "left_out": self.parts.left_out,
        }


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
        case = DeviceCase(device, experiment)
        found = device_boundary(case, GRID_STIFFNESSES)
        last = max(found["damping"]) / 2 if e.damping_last is None else e.damping_last
        last = max(last, e.damping_first)
        step = (last - e.damping_first) / (GRID_DAMPINGS - 1) or case.units.damping
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


def device_boundary(case: DeviceCase, points: int = 400) -> dict[str, Any]:
    """Return the limit of a device's walls over damping, as the document that `theory boundary --device` prints.

    Raises
    ------
    ParameterError
        If no wall is stable at any damping.
    """
    found, k, b = outline(case.loop, points), case.units.stiffness, case.units.damping
    if not len(found.beta) and not len(found.islands):
        raise ParameterError(
            f"device {case.device.name!r}, experiment {case.experiment.name!r}: no stiffness and damping stabilise "
            "this loop. Check delay, lag and filter in the device file."
        )
    return {
        **case.names,
        "stiffness_max": float(found.alpha_max * k) if len(found.beta) else None,
        "damping_at_stiffness_max": float(found.beta_at_alpha_max * b) if len(found.beta) else None,
        "stiffness": (found.alpha * k).tolist(),
        "damping": (found.beta * b).tolist(),
        "islands": islands_in_si(found.islands, case.units),
    }


def islands_in_si(islands: Floats, units: Normalised) -> list[dict[str, float]]:
    """Return stable intervals, shape (n, 3) as of `Limits`, by name."""
    k, b = units.stiffness, units.damping
    return [
        {"damping": float(beta * b), "stiffness_low": float(low * k), "stiffness_high": float(high * k)}
        for beta, low, high in islands
    ]


def wall_documents(case: DeviceCase, walls: Cases, criteria: Sequence[str] = POINT_COSTS) -> list[dict[str, Any]]:
    """Return stability and costs of each wall of a file with `WALL_COLUMNS`, in order.

    Returns
    -------
    list of dict
        As of `theory.cases.point_costs`, with ``stiffness`` and ``damping`` in SI and ``separation`` (`SlowestPole`)
        in place of the normalised parameters.
    """
    check_criteria(criteria)
    alpha, beta = walls.values[:, 0] / case.units.stiffness, walls.values[:, 1] / case.units.damping
    slowest = slowest_poles(case.loop, alpha, beta)
    radius = np.array([pole.radius for pole in slowest])
    found = points_of_loop(case.loop, alpha, beta, radius, criteria)
    return [
        {
            "stiffness": float(stiffness),
            "damping": float(damping),
            "stable": document["stable"],
            "spectral_radius": pole.radius,
            "separation": pole.separation,
            **{name: document[name] for name in criteria},
            "reason": document["reason"],
            "left_out": case.parts.left_out,
        }
        for (stiffness, damping), pole, document in zip(walls.values, slowest, found, strict=True)
    ]
