"""Compute limits, costs of listed walls, and optima in theory, for the command line, REST and Python.

Each result is a record. ``to_json`` returns its JSON document, and ``columns`` returns its rows. A number that cannot
be computed is NaN in a record and None in a document, with a reason. Maps are in `pipeline.theory.costs`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.records.criteria import CRITERIA, DISCRETE, ENERGY, is_criterion
from pipeline.records.trials import Booleans, Floats
from pipeline.theory.boundary import boundary, has_islands, is_well_inside, outline, robust_outline
from pipeline.theory.costs import check_criteria, point_costs_by_name
from pipeline.theory.optimum import POINT_CRITERIA, marked_point, optimal_point
from pipeline.theory.poles import spectral_radius, stable_by_radius
from pipeline.theory.reachable import COST_OF_DELAY, Reachable, reachable
from pipeline.theory.settling_overshoot import LONGEST

if TYPE_CHECKING:  # loading its classes takes longer than a short command
    from pipeline.records.models import Device, Experiment, Motion

WALL_COLUMNS = ("stiffness", "damping")
"""Columns of a CSV file of walls in SI."""

CASE_COLUMNS = ("alpha", "beta", "gamma", "delta", "delay")

POINT_COSTS = tuple(
    name + suffix
    for name in ("settle_2pct", "overshoot", *(c.name for c in CRITERIA.values() if c.family is ENERGY))
    for suffix in ("", DISCRETE)
)
"""Default costs of a listed wall."""

MARGINAL = 1e-12
"""Threshold for the distance of the spectral radius from 1. Below it, no cost is given. The rounding errors of poles
are about 1e-15, and energy costs grow with the inverse distance to the power of w + 1, so fewer than three digits would
remain."""

_ISLANDS = (
    "walls beyond an unstable gap, for which softer walls at their damping are unstable, were not searched; they exist "
    "for this loop and may have lower costs"
)

_NEGATIVE = "the stiffness is negative: the spring of the device or of an operator is stiffer than the optimum"

LARGEST = 1e200
"""Largest alpha and beta, far above any limit. Matrices would overflow for larger values."""


@dataclass(frozen=True)
class Case:
    """Loop with the units and names of its documents.

    Parameters
    ----------
    loop : NormalisedLoop
    units : LoopUnits, optional
        Units of the wall, if it is given in SI.
    names : dict
        Further entries of every document. Without units, the normalised parameters of the loop are also entries.
    motion : {"translation", "rotation"}, optional
        Motion of a device, which determines the units in files.
    """

    loop: NormalisedLoop
    units: LoopUnits | None = None
    names: dict[str, Any] = field(default_factory=dict)
    motion: Motion | None = None

    @property
    def axes(self) -> tuple[str, str]:
        """Names of stiffness and damping of a wall."""
        return WALL_COLUMNS if self.units is not None else CASE_COLUMNS[:2]

    @property
    def scale(self) -> tuple[float, float]:
        """Stiffness and damping for alpha = 1 and beta = 1."""
        return (1.0, 1.0) if self.units is None else (self.units.stiffness, self.units.damping)

    @property
    def loop_entries(self) -> dict[str, Any]:
        """Entries on the loop in every document."""
        plant = {} if self.units is not None else {name: getattr(self.loop, name) for name in CASE_COLUMNS[2:]}
        return {**plant, **self.names}


def case_of(device: Device, experiment: Experiment) -> Case:
    """Return the loop of an experiment of a device. If the delay jitters, its mean is used. `Case.names` contains its
    range."""
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
    return Case(NormalisedLoop.of(loop), LoopUnits.of(loop), names, device.motion)


@dataclass(frozen=True, eq=False)
class Cases:
    """Points of a CSV file, with values of shape (n, columns) in the order of the columns, and with their row
    numbers."""

    path: Path
    values: Floats
    row: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PointCosts:
    """Stability and costs of walls.

    Parameters
    ----------
    names : tuple of str
        Columns of a wall and, for a normalised case, of its loop.
    walls : float64, shape (n, names)
    stable : bool, shape (n,)
    spectral_radius : float64, shape (n,)
    costs : dict of float64, shape (n,)
        Costs by criterion, or NaN if there is no cost.
    reason : tuple of str or None, n
        Reason why costs are NaN.
    left_out : tuple of str, optional
        Parts of the device that the loop does not include.
    """

    names: tuple[str, ...]
    walls: Floats
    stable: Booleans
    spectral_radius: Floats
    costs: dict[str, Floats]
    reason: tuple[str | None, ...]
    left_out: tuple[str, ...] | None = None

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of a table, with None for a cost of NaN."""
        walls = {name: values.tolist() for name, values in zip(self.names, self.walls.T, strict=True)}
        stability = {"stable": self.stable.tolist(), "spectral_radius": self.spectral_radius.tolist()}
        costs = {name: _listed(values) for name, values in self.costs.items()}
        return {**walls, **stability, **costs, "reason": list(self.reason)}

    def to_json(self) -> list[dict[str, Any]]:
        """Return the document of ``theory points``, with one row of the columns per wall."""
        columns, more = self.columns(), {} if self.left_out is None else {"left_out": list(self.left_out)}
        return [dict(zip(columns, row, strict=True)) | more for row in zip(*columns.values(), strict=True)]


def costs_of_cases(cases: Cases, criteria: Sequence[str] = POINT_COSTS) -> PointCosts:
    """Return stability and costs for rows with `CASE_COLUMNS`, in the order of the file.

    Raises
    ------
    ParameterError
        If a criterion is unknown, or a value of a row is out of range.
    """
    check_criteria(criteria)
    for name, values in zip(CASE_COLUMNS[:2], cases.values.T, strict=False):
        too_large = np.flatnonzero(np.abs(values) > LARGEST)
        if len(too_large):
            raise ParameterError(
                f"{cases.path}, row {cases.row[too_large[0]]}, column {name}: expected at most {LARGEST:g}, found "
                f"{values[too_large[0]]:g}."
            )
    count = len(cases.row)
    stable, radius, reason = np.zeros(count, np.bool_), np.full(count, np.nan), np.full(count, None)
    costs = {name: np.full(count, np.nan) for name in criteria}
    plants, group = np.unique(cases.values[:, 2:], axis=0, return_inverse=True)
    for number, plant in enumerate(plants):
        members = np.flatnonzero(group.ravel() == number)
        try:
            gamma, delta, delay = map(float, plant)
            loop = NormalisedLoop.ideal(gamma, delta, delay)
        except ParameterError as error:
            raise ParameterError(f"{cases.path}, row {cases.row[members[0]]}: {error}") from error
        part = costs_of_walls(Case(loop), cases.values[members], criteria)
        stable[members], radius[members], reason[members] = part.stable, part.spectral_radius, part.reason
        for name, values in costs.items():
            values[members] = part.costs[name]
    return PointCosts(CASE_COLUMNS, cases.values, stable, radius, costs, tuple(reason))


def one_case(cases: Cases) -> Case:
    """Return the common loop of all rows with `CASE_COLUMNS`, for a figure.

    Raises
    ------
    ParameterError
        If there are several loops, or none.
    """
    plants = np.unique(cases.values[:, 2:], axis=0)
    if len(plants) != 1:
        raise ParameterError(
            f"{cases.path}: a figure shows the points of one loop, found {len(plants)} combinations of gamma, delta "
            "and delay. Use a separate file for each loop."
        )
    gamma, delta, delay = map(float, plants[0])
    return Case(NormalisedLoop.ideal(gamma, delta, delay))


def costs_of_walls(case: Case, walls: Floats, criteria: Sequence[str] = POINT_COSTS) -> PointCosts:
    """Return stability and costs of walls.

    Parameters
    ----------
    case : Case
    walls : float64, shape (n, 2 or more)
        Stiffness and damping in the units of the case.
    criteria : sequence of str
        Criteria as in `costs.CostMap`.

    Raises
    ------
    ParameterError
        If a criterion is unknown.

    Notes
    -----
    Points with alpha + gamma <= 0 have a real pole z >= 1 and no final position. They are not stable.
    """
    check_criteria(criteria)
    for name, values, scale in zip(case.axes, walls.T, case.scale, strict=False):
        largest = min(LARGEST * scale, np.finfo(np.float64).max)
        if (np.abs(values) > largest).any():
            raise ParameterError(f"{name}: expected at most {largest:g}, found {np.abs(values).max():g}.")
    loop, (alpha, beta) = case.loop, walls[:, :2].T / np.array(case.scale)[:, None]
    radius = spectral_radius(loop, alpha, beta)
    stable = stable_by_radius(loop, alpha, radius)
    usable = np.flatnonzero(stable & (radius < 1 - MARGINAL))
    known = point_costs_by_name(loop, alpha[usable], beta[usable], criteria, LONGEST)
    costs = {name: np.full(len(walls), np.nan) for name in criteria}
    for name, values in costs.items():
        values[usable] = known[name]
    reason = tuple(
        _why_missing(loop, a, r, [name for name in criteria if math.isnan(costs[name][i])])
        for i, (a, r) in enumerate(zip(alpha.tolist(), radius.tolist(), strict=True))
    )
    names: tuple[str, ...] = case.axes
    values = walls[:, :2]
    if case.units is None:
        names, plant = CASE_COLUMNS, [getattr(loop, name) for name in CASE_COLUMNS[2:]]
        values = np.column_stack([values, np.broadcast_to(plant, (len(walls), len(plant)))])
    left_out = tuple(case.names["left_out"]) if case.names else None
    return PointCosts(names, values, stable, radius, costs, reason, left_out)


def _why_missing(loop: NormalisedLoop, alpha: float, radius: float, missing: list[str]) -> str | None:
    """Return why a wall has no cost for some criteria, or None if all costs exist."""
    if alpha + loop.gamma <= 0:
        return "no final position: alpha + gamma <= 0"
    if radius >= 1:
        return "unstable"
    if radius >= 1 - MARGINAL:
        return f"spectral radius within {MARGINAL:g} of 1: costs would consist of rounding errors"
    return f"still moves after {LONGEST} samples: no {', '.join(missing)}" if missing else None


@dataclass(frozen=True, eq=False)
class Boundary:
    """Limit of walls with its extremes, in the units of a case.

    Parameters
    ----------
    case : Case
    stiffness, damping : float64, shape (n,)
        Points along the limit; NaN between separate regions.
    stiffest, most_damped : (float, float), optional
        Stiffness and damping at the largest stiffness and at the largest damping, or None if no wall is stable.
    islands : float64, shape (i, 3)
        Stable intervals beyond an unstable gap, each given by damping, smallest and largest stiffness.
    """

    case: Case
    stiffness: Floats
    damping: Floats
    stiffest: tuple[float, float] | None
    most_damped: tuple[float, float] | None
    islands: Floats

    @property
    def stiffness_max(self) -> float:
        """Largest stable stiffness, or NaN if no wall is stable."""
        return math.nan if self.stiffest is None else self.stiffest[0]

    def columns(self) -> dict[str, list[Any]]:
        """Return the points of a table, each with stiffness, damping, and the index of the separate region, counted
        from 0."""
        known = ~np.isnan(self.stiffness)
        values = {name: part[known].tolist() for name, part in zip(self.case.axes, self.curve, strict=True)}
        return {**values, "region": np.cumsum(~known)[known].tolist()}

    @property
    def curve(self) -> tuple[Floats, Floats]:
        """Stiffness and damping."""
        return self.stiffness, self.damping

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``theory boundary``."""
        k, b = self.case.axes
        stiffest, most_damped = self.stiffest or (None, None), self.most_damped or (None, None)
        document = {**self.case.loop_entries, f"{k}_max": stiffest[0], f"{b}_at_{k}_max": stiffest[1]}
        if self.case.units is None:
            document |= {f"{b}_max": most_damped[1], f"{k}_at_{b}_max": most_damped[0]}
        document |= {k: _listed(self.stiffness), b: _listed(self.damping)}
        return document if self.case.units is None else document | {"islands": named_islands(self.islands)}


def limits_of_walls(case: Case, points: int = 400) -> Boundary:
    """Return the limit of walls.

    The result is the whole boundary for a normalised case. For a case in SI, it is the limit of walls with K > 0 over
    the damping, with islands.

    Raises
    ------
    ParameterError
        If no wall is stable at any damping.

    Source: Hulin 2017, sec. 3.4.
    """
    k, b = case.scale
    if case.units is None:
        border = boundary(case.loop, points)
        stiffest, most_damped = (
            (border.alpha_max, border.beta_at_alpha_max),
            (border.alpha_at_beta_max, border.beta_max),
        )
        return Boundary(case, border.alpha, border.beta, stiffest, most_damped, border.islands)
    limits = outline(case.loop, points)
    if not len(limits.beta) and not len(limits.islands):
        raise ParameterError(
            f"device {case.names['device']!r}, experiment {case.names['experiment']!r}: no stiffness and damping "
            "stabilise this loop. Check delay, lag and filter in the device file."
        )
    gaps, some = np.flatnonzero(np.diff(limits.part)) + 1, len(limits.beta) > 0
    return Boundary(
        case,
        np.insert(limits.alpha * k, gaps, np.nan),
        np.insert(limits.beta * b, gaps, np.nan),
        (float(limits.alpha_max * k), float(limits.beta_at_alpha_max * b)) if some else None,
        (float(limits.alpha[-1] * k), float(limits.beta[-1] * b)) if some else None,
        limits.islands * (b, k, k),
    )


def _listed(values: Floats) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


def named_islands(islands: Floats) -> list[dict[str, float]]:
    """Return stable intervals in SI, shape (n, 3), as a list of dicts with named numbers."""
    return [dict(zip(("damping", "stiffness_low", "stiffness_high"), row, strict=True)) for row in islands.tolist()]


def check_robust(parts: str) -> None:
    """Raise ParameterError if a loop has parts, listed in a text, for which the robust region is unknown (4.3.3)."""
    if parts:
        raise ParameterError(
            "walls that are stable with every spring are known only for mass, damper, spring and delay, but this loop "
            f"has more parts: {parts} (4.3.3). Remove these parts, or use the passive walls (Loop.passive)."
        )


def robust_boundary(case: Case) -> Boundary:
    """Return the limit of the walls that are stable with every spring in parallel to the device.

    Raises
    ------
    ParameterError
        If the loop has more than mass, damper, spring and delay, or has no damping, so that there is no such region.

    Source: Hulin 2017, sec. 4.3.3, eq. 4.15, Fig. 4.5.
    """
    loop, (k, b) = case.loop, case.scale
    check_robust(", ".join(case.names.get("parts", {})))
    alpha, beta, _ = robust_outline(loop.delta, loop.delay)
    if not len(alpha):
        raise ParameterError(
            "no wall is stable with every spring if the device has no damping (delta = 0, 4.3.3). Specify the damping "
            "of the device."
        )
    best, last = int(np.argmax(alpha)), int(np.argmax(beta))
    extremes = [(float(alpha[i] * k), float(beta[i] * b)) for i in (best, last)]
    return Boundary(case, alpha * k, beta * b, extremes[0], extremes[1], np.empty((0, 3)))


def _unstable_rule(loop: NormalisedLoop, alpha: float, beta: float) -> str | None:
    """Return why the wall of a tuning rule is unsuitable, or None if this wall and all softer walls are stable."""
    radius = float(spectral_radius(loop, alpha, beta)[0])
    if not stable_by_radius(loop, np.array([alpha]), np.array([radius]))[0]:
        return (
            f"this tuning is unstable here: spectral radius {radius:.6g}; the rule assumes a device without these parts"
        )
    if not is_well_inside(loop, np.array([alpha]), np.array([beta]), islands=False)[0]:
        return "softer walls at the damping of this tuning are unstable here"
    return None


@dataclass(frozen=True)
class Optimum:
    """Best wall by a criterion, in the units of a case.

    Parameters
    ----------
    case : Case
    criterion : str
    stiffness, damping : float
    cost : float, optional
    reason : str, optional
        Reason why there is no cost, or a note that the optimum is a limit that no stable point reaches.
    note : str, optional
        Note on walls that were not searched, a negative stiffness, or an unstable tuning.
    box : tuple of float, optional
        Smallest and largest stiffness, and smallest and largest damping, of equally good walls.
    """

    case: Case
    criterion: str
    stiffness: float
    damping: float
    cost: float | None
    reason: str | None = None
    note: str | None = None
    box: tuple[float, float, float, float] | None = None

    @property
    def reachable(self) -> Reachable | None:
        """Lowest cost that the delay allows (5.19), or None for criteria whose cost does not grow with the delay."""
        whole = self.case.names.get("delay_samples", self.case.loop.delay)
        return reachable(self.criterion, whole) if is_criterion(self.criterion, COST_OF_DELAY) else None

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of a table with a single row."""
        wall = dict(zip(self.case.axes, (self.stiffness, self.damping), strict=True))
        row = {"criterion": self.criterion, **wall, "cost": self.cost, **self._ends}
        return {name: [value] for name, value in (row | {"reason": self.reason, "note": self.note}).items()}

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``theory optimum``."""
        k, b = self.case.axes
        document = {
            "criterion": self.criterion,
            **self.case.loop_entries,
            k: self.stiffness,
            b: self.damping,
            "cost": self.cost,
        }
        document |= {name: text for name, text in (("reason", self.reason), ("note", self.note)) if text}
        if self.reachable is not None:
            about = asdict(self.reachable)
            document["reachable"] = {name: about[name] for name in ("cost", "per_sample", "within")}
        return document | ({"box": self._ends} if self.box is not None else {})

    @property
    def _ends(self) -> dict[str, float]:
        names = [f"{axis}_{end}" for axis in self.case.axes for end in ("low", "high")]
        return dict(zip(names, self.box, strict=True)) if self.box is not None else {}


@dataclass(frozen=True)
class BestDamping:
    """Best damping for a given stiffness, in the units of a case.

    Parameters
    ----------
    case : Case
    criterion : str
    stiffness : float
    damping, cost : float, optional
        None if no damping stabilises the wall or no damping has a cost. In this case, `reason` states why.
    low, high : float, optional
        Ends of the range of equally good dampings. `damping` is in the middle.
    critical, amplitude : float
        Critical damping, and damping that is optimal in amplitude (ratio 1/sqrt 2), by the rules for continuous time
        (5.17).
    reason : str, optional
    """

    case: Case
    criterion: str
    stiffness: float
    damping: float | None
    cost: float | None
    low: float | None
    high: float | None
    critical: float
    amplitude: float
    reason: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``theory optimum --stiffness``."""
        k, b = self.case.axes
        document = {"criterion": self.criterion, **self.case.loop_entries, k: self.stiffness, b: self.damping}
        document |= {"cost": self.cost, f"{b}_low": self.low, f"{b}_high": self.high}
        document |= {f"critical_{b}": self.critical, f"amplitude_optimal_{b}": self.amplitude}
        return document | ({"reason": self.reason} if self.reason else {})

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of a table with a single row."""
        of_loop = {*self.case.loop_entries}
        return {name: [value] for name, value in ({"reason": None} | self.to_json()).items() if name not in of_loop}


def continuous_rules(mass: float, damping: float, spring: float, stiffness: float) -> tuple[float, float]:
    """Return the critical damping of a wall and the damping that is optimal for the amplitude, in continuous time.

    Parameters
    ----------
    mass, damping, spring : float
        m, b and k of the device, in any consistent units.
    stiffness : float
        Stiffness K of the wall. The sum K + k must be positive.

    Notes
    -----
    The dampings are 2 sqrt(m (K + k)) - b and sqrt(2 m (K + k)) - b. Without delay and sampling, the damping ratio is
    then 1 and 1/sqrt(2), respectively.

    Source: Hulin 2017, eq. 5.17.

    Examples
    --------
    >>> continuous_rules(2.0, 1.0, 0.0, 8.0)
    (7.0, 4.656854249492381)
    """
    square = mass * (stiffness + spring)
    return 2 * math.sqrt(square) - damping, math.sqrt(2 * square) - damping


def best_damping_for(case: Case, criterion: str, stiffness: float) -> BestDamping:
    """Return the best damping for a stiffness, and the dampings from the rules for continuous time.

    Raises
    ------
    ParameterError
        If the criterion has no optimal curve, or the stiffnesses of wall and device do not have a positive sum.

    Source: Hulin 2017, secs. 5.1 and 5.2, eq. 5.17.
    """
    from pipeline.theory.curves import best_damping

    loop, (k, b) = case.loop, case.scale
    alpha = stiffness / k
    if not alpha + loop.gamma > 0:
        raise ParameterError(
            f"stiffness {stiffness:g}: expected a value whose sum with the stiffness of the device is positive."
        )
    found = best_damping(loop, criterion, alpha)
    best, cost, low, high = (float(each[0]) for each in (found.best, found.cost, found.low, found.high))
    known = bool(found.found[0])
    top = limits_of_walls(case).stiffness_max
    reason = f"no damping stabilises this stiffness; the largest stable stiffness is {top:.6g}"
    if alpha * k < top:
        reason = "no response settles within the samples of the search"
    rules = continuous_rules(1.0, loop.delta, loop.gamma, alpha)
    return BestDamping(
        case,
        criterion,
        stiffness,
        damping=best * b if known else None,
        cost=cost if known else None,
        low=low * b if known else None,
        high=high * b if known else None,
        critical=rules[0] * b,
        amplitude=rules[1] * b,
        reason=None if known else reason,
    )


def criterion_for(criterion: str, signal: str | None) -> str:
    """Return the name of a criterion for the response `signal`. Criteria of poles have no sampled version.

    Raises
    ------
    ParameterError
        As in `best_wall`.
    """
    if criterion not in POINT_CRITERIA and not is_criterion(criterion, CRITERIA):
        raise ParameterError(
            f"no optimum for criterion {criterion!r}; expected one of {', '.join((*POINT_CRITERIA, *CRITERIA))}, "
            "a criterion of a response with _discrete appended, or a settling time for any band, such as settle_3pct."
        )
    if signal not in (None, "continuous", "discrete"):
        raise ParameterError(f"signal {signal!r}: expected continuous or discrete.")
    if signal == "continuous" and criterion.endswith(DISCRETE):
        raise ParameterError(f"criterion {criterion!r} is discrete, but the signal is continuous.")
    sampled = f"{criterion}{DISCRETE}"
    return sampled if signal == "discrete" and is_criterion(sampled, CRITERIA) else criterion


def best_wall(case: Case, criterion: str, signal: str | None = None) -> Optimum:
    """Return the best wall by a criterion.

    Parameters
    ----------
    case : Case
    criterion : str
        One of `CRITERIA` or `POINT_CRITERIA`. ``_discrete`` is appended for the sampled response, or `signal` is given.
    signal : {"continuous", "discrete"}, optional
        Response that determines the cost. By default, it follows from the name of the criterion.

    Raises
    ------
    ParameterError
        If the criterion or the signal is not supported, or they contradict each other.
    """
    name = criterion_for(criterion, signal)
    loop, (k, b) = case.loop, case.scale
    if criterion in POINT_CRITERIA:
        mark = marked_point(loop, criterion)
        rule = criterion == "ziegler_nichols"
        reason = "a tuning rule has no cost" if rule else "a point of the stability boundary has no cost"
        note = _unstable_rule(loop, mark.alpha, mark.beta) if rule else None
        return Optimum(case, criterion, mark.alpha * k, mark.beta * b, None, reason, note)
    point = optimal_point(loop, name)
    cost, why = point.cost, None
    if not point.attained:
        why = "a limit at the edge of the stable region that no stable point reaches"
    elif float(spectral_radius(loop, point.alpha, point.beta)[0]) >= 1 - MARGINAL:
        why = f"spectral radius within {MARGINAL:g} of 1 for all stable walls: costs would consist of rounding errors"
    elif math.isnan(cost):
        why = "no response settles within the samples of the search"
    notes = [text for text, is_so in ((_ISLANDS, has_islands(loop)), (_NEGATIVE, point.alpha < 0)) if is_so]
    ends = point.box and (point.box[0] * k, point.box[1] * k, point.box[2] * b, point.box[3] * b)
    known_cost = None if math.isnan(cost) or (why and point.attained) else cost
    return Optimum(case, name, point.alpha * k, point.beta * b, known_cost, why, "; ".join(notes) or None, ends)
