"""Two experiments against each other: what differs, by how much, and whether more than their intervals allow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import hypot

import numpy as np

from pipeline.base.wording import counted
from pipeline.measured.intervals import NORMAL_95
from pipeline.records.against_records import (
    BoundaryDifference,
    CostDifference,
    LimitDifference,
    PairDifference,
    Plane,
    Side,
    ValueDifference,
)
from pipeline.records.batch import Floats
from pipeline.records.criteria import criterion_of
from pipeline.records.findings import BoundaryPoint, Estimate, Optimum
from pipeline.records.models import Motion
from pipeline.records.results import ExperimentResult
from pipeline.records.score_records import Scores
from pipeline.rendering.labels import UNITS, criterion_name, percent_text, significant

FEWEST_POINTS = 6
"""Points that a median needs for an interval of 95 % by its ranks: with five, smallest to largest hold 94 %."""

TRIAL_RANGE = ("delay_samples",)
"""Estimates whose interval is the range of the trials, not the error of their mean: it judges no difference."""

Trials = Mapping[str, tuple[Floats, Floats, Floats]]
"""Stiffness, damping and cost of the trials by criterion; NaN where a trial has no cost."""


def compare_pair(
    first: Side,
    second: Side,
    results: tuple[ExperimentResult, ExperimentResult],
    trials: tuple[Trials, Trials] | None,
    motions: tuple[Motion, Motion],
    scales: tuple[tuple[float, float], tuple[float, float]] | None = None,
) -> PairDifference:
    """Return what two experiments differ in, second minus first.

    Parameters
    ----------
    first, second : Side
    results : (ExperimentResult, ExperimentResult)
    trials : (Trials, Trials) or None
        Costs of the single trials; None where only finished documents are there.
    motions : (motion, motion)
    scales : ((K, B), (K, B)), optional
        Units of stiffness m/T^2 and damping m/T of each side: with them the boundaries are compared in the plane of
        alpha and beta (Table 3.1), as devices must be.
    """
    a, b = results
    plane: Plane = "physical" if scales is None else "normalised"
    units = UNITS[motions[0]]
    boundary, reason = compare_boundaries(a.boundary, b.boundary, *(scales or ((1.0, 1.0), (1.0, 1.0))))
    if scales is None:
        estimates = compare_estimates(a.estimates, b.estimates)
        optima = compare_optima(a.optimum, b.optimum, units.stiffness, units.damping)
    else:
        estimates = tuple(
            ValueDifference(
                name=n,
                unit=_both_units(e.unit, b.estimates[n].unit),
                first=e.value,
                second=b.estimates[n].value,
                reason="devices differ",
            )
            for n, e in a.estimates.items()
            if n in b.estimates
        )
        optima = compare_optima(_scaled(a.optimum, scales[0]), _scaled(b.optimum, scales[1]), "1", "1")
    costs = () if trials is None or scales is not None else compare_costs(*trials)
    pair = PairDifference(
        first=first,
        second=second,
        plane=plane,
        estimates=estimates,
        boundary=boundary,
        boundary_reason=reason,
        optima=optima,
        scores=compare_scores(a.scores, b.scores, None if scales else units.stiffness),
        costs=costs,
        sentences=(),
    )
    return pair.model_copy(update={"sentences": sentences_of(pair)})


def compare_estimates(first: Mapping[str, Estimate], second: Mapping[str, Estimate]) -> tuple[ValueDifference, ...]:
    """Return the difference of each estimate that both have, and of the delay by the model."""
    pairs = {name: (first[name], second[name]) for name in first if name in second}
    if "delay_samples" in pairs:
        fitted = tuple(e.by_method.get("model") for e in pairs["delay_samples"])
        if fitted[0] is not None and fitted[1] is not None:
            pairs["delay_by_model"] = (fitted[0], fitted[1])
    return tuple(_difference(name, a, b) for name, (a, b) in pairs.items())


def _both_units(first: str, second: str) -> str:
    """Unit of two values; those of a device that turns and of one that does not differ."""
    return first if first == second else f"{first} and {second}"


def _difference(name: str, a: Estimate, b: Estimate) -> ValueDifference:
    values = ValueDifference(name=name, unit=_both_units(a.unit, b.unit), first=a.value, second=b.value)
    if a.value is None or b.value is None:
        return values.model_copy(update={"reason": a.reason if a.value is None else b.reason})
    if a.unit != b.unit:
        return values.model_copy(update={"reason": f"units differ: {a.unit} and {b.unit}"})
    if name in TRIAL_RANGE:
        why = "its interval is the range of the trials, not the error of their mean"
        return values.model_copy(update={"difference": b.value - a.value, "reason": why})
    return _judged(values, (a.value, a.low, a.high), (b.value, b.low, b.high))


_Interval = tuple[float, float | None, float | None]


def _judged(values: ValueDifference, a: _Interval, b: _Interval) -> ValueDifference:
    """Add difference, its interval, and whether that leaves out zero."""
    difference = b[0] - a[0]
    if None in (*a, *b):
        why = "no interval on both sides"
        return values.model_copy(update={"difference": difference, "reason": why})
    low, high = difference_interval(a, b)  # type: ignore[arg-type]  # no end is None here
    update = {"difference": difference, "low": low, "high": high, "significant": not low <= 0 <= high}
    return values.model_copy(update=update)


def difference_interval(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float]:
    """Return the 95 % interval of b - a for two independent values with their 95 % intervals.

    The errors are added as squares, each side with the half of its interval that faces the other way: an interval may
    be longer on one side.

    Parameters
    ----------
    a, b : (float, float, float)
        Value, lower and upper end.
    """
    (x, x_low, x_high), (y, y_low, y_high) = a, b
    return y - x - hypot(y - y_low, x_high - x), y - x + hypot(y_high - y, x - x_low)


def compare_boundaries(
    first: Sequence[BoundaryPoint],
    second: Sequence[BoundaryPoint],
    first_scale: tuple[float, float],
    second_scale: tuple[float, float],
) -> tuple[BoundaryDifference | None, str | None]:
    """Return the difference of two boundaries at the dampings of the first that both cover, or the reason why not.

    A limit is that by the growth rates where a point has one, else the middle between stable and unstable; censored
    points, which are lower bounds, are left out. Between its dampings the second boundary is taken as straight.
    """
    a, b = (_limits(points, scale) for points, scale in ((first, first_scale), (second, second_scale)))
    if len(a) < 1 or len(b) < 2:
        return None, "one of them has no limits: its tested ranges ended before a trial was unstable"
    inside = (a[:, 0] >= b[0, 0]) & (a[:, 0] <= b[-1, 0]) & (a[:, 1] > 0)
    if not inside.any():
        return None, "they cover no common damping"
    a = a[inside]
    common = np.isin(a[:, 0], b[:, 0])
    other = np.column_stack([a[:, 0], *(np.interp(a[:, 0], b[:, 0], b[:, k]) for k in (1, 2, 3))])
    percent = 100 * (other[:, 1] - a[:, 1]) / a[:, 1]
    low = other[:, 1] - a[:, 1] - np.hypot(other[:, 1] - other[:, 2], a[:, 3] - a[:, 1])
    high = other[:, 1] - a[:, 1] + np.hypot(other[:, 3] - other[:, 1], a[:, 1] - a[:, 2])
    known = np.isfinite(low) & np.isfinite(high)
    differs = known & ((low > 0) | (high < 0))
    worst = int(np.argmax(np.abs(percent)))
    points = tuple(
        LimitDifference(damping=d, first=x, second=y, percent=p, significant=bool(s) if k else None)
        for d, x, y, p, s, k in zip(
            *(v.tolist() for v in (a[:, 0], a[:, 1], other[:, 1], percent, differs, known)), strict=True
        )
    )
    return BoundaryDifference(
        median_percent=float(np.median(percent)),
        largest_percent=float(percent[worst]),
        largest_damping=float(a[worst, 0]),
        judged=int(known.sum()),
        significant=int(differs.sum()),
        interpolated=not bool(common.all()),
        points=points,
    ), None


def _limits(points: Sequence[BoundaryPoint], scale: tuple[float, float]) -> Floats:
    """Return damping, limit and both ends of its interval (NaN without), by damping; shape (n, 4)."""
    rows = []
    for p in points:
        if p.estimate is not None and p.low is not None and p.high is not None:
            rows.append((p.damping, p.estimate, p.low, p.high))
        elif p.stable is not None and p.unstable is not None and not p.censored:
            rows.append((p.damping, (p.stable + p.unstable) / 2, np.nan, np.nan))
    found = np.array(sorted(rows), dtype=np.float64).reshape(-1, 4)
    divisor = np.array([scale[1], scale[0], scale[0], scale[0]], dtype=np.float64)
    return np.asarray(found / divisor, dtype=np.float64)


def compare_optima(
    first: Mapping[str, Optimum], second: Mapping[str, Optimum], stiffness: str, damping: str
) -> tuple[ValueDifference, ...]:
    """Return the differences of stiffness, damping and cost of each optimum that both have."""
    found = []
    for criterion in first:
        if criterion not in second:
            continue
        a, b = first[criterion], second[criterion]
        for name, unit in (("stiffness", stiffness), ("damping", damping)):
            x, y = float(getattr(a, name)), float(getattr(b, name))
            why = "the place of an optimum has no interval"
            found.append(
                ValueDifference(name=f"{criterion}/{name}", unit=unit, first=x, second=y, difference=y - x, reason=why)
            )
        values = ValueDifference(name=f"{criterion}/cost", unit="", first=a.cost, second=b.cost)
        found.append(_judged(values, (a.cost, a.cost_low, a.cost_high), (b.cost, b.cost_low, b.cost_high)))
    return tuple(found)


def _scaled(optima: Mapping[str, Optimum], scale: tuple[float, float]) -> dict[str, Optimum]:
    k, b = scale
    return {
        name: o.model_copy(update={"stiffness": o.stiffness / k, "damping": o.damping / b})
        for name, o in optima.items()
    }


_SCORES = (
    ("region", "overlap", ""),
    ("region", "covered", ""),
    ("region", "area_ratio", ""),
    ("distance", "median", ""),
    ("verdicts", "agreement", ""),
    ("delay", "implied", "samples"),
)
_BOUND = (("bound", "stiffness", ""), ("bound", "slope", "1/s"))
"""Scores that are compared: record, number, unit. A bound is one of K and B, which two devices do not share."""


def compare_scores(
    first: Sequence[Scores], second: Sequence[Scores], stiffness: str | None
) -> tuple[ValueDifference, ...]:
    """Return the differences of the scores against theory that both have; ``stiffness`` is the unit that they share."""
    if not first or not second:
        return ()
    a, b = first[0], second[0]
    found = []
    for part, name, unit in (*_SCORES, *(_BOUND if stiffness else ())):
        x, y = getattr(a, part), getattr(b, part)
        if x is None or y is None:
            continue
        unit = stiffness or "" if name == "stiffness" else unit
        values = ValueDifference(name=f"{part}/{name}", unit=unit, first=getattr(x, name), second=getattr(y, name))
        if a.basis != b.basis:
            why = f"one is against theory by the {a.basis}, the other by the {b.basis}"
            found.append(values.model_copy(update={"reason": why}))
            continue
        ends = ((getattr(each, f"{name}_low", None), getattr(each, f"{name}_high", None)) for each in (x, y))
        low_high = [(value, *both) for value, both in zip((getattr(x, name), getattr(y, name)), ends, strict=True)]
        found.append(_judged(values, *low_high))
    return tuple(found)


def compare_costs(first: Trials, second: Trials) -> tuple[CostDifference, ...]:
    """Return for each criterion the median of the costs of the second over those of the first at equal (K, B).

    Several trials at one (K, B) count by their median. The interval is that of the median by ranks (binomial), which
    assumes nothing of how ratios are distributed.
    """
    return tuple(_cost_difference(c, first[c], second[c]) for c in first if c in second)


def _cost_difference(
    criterion: str, first: tuple[Floats, Floats, Floats], second: tuple[Floats, Floats, Floats]
) -> CostDifference:
    kind = "difference" if criterion_of(criterion).family.levels else "ratio"
    (a_points, a), (b_points, b) = (_by_point(*trials) for trials in (first, second))
    places = {point: n for n, point in enumerate(b_points)}
    shared = [(n, places[point]) for n, point in enumerate(a_points) if point in places]
    rows = np.array(shared, dtype=np.int64).reshape(-1, 2)
    x, y = a[rows[:, 0]], b[rows[:, 1]]
    if kind == "ratio":
        x, y = x[x > 0], y[x > 0]
    values = np.sort(y - x if kind == "difference" else y / x)
    if not len(values):
        reason = "no trial of both has this cost at the same stiffness and damping"
        return CostDifference(criterion=criterion, kind=kind, points=0, reason=reason)
    result = CostDifference(criterion=criterion, kind=kind, points=len(values), median=float(np.median(values)))
    if len(values) < FEWEST_POINTS:
        return result.model_copy(update={"reason": f"fewer than {FEWEST_POINTS} points allow no interval"})
    # ranks of the ends by the normal approximation of the binomial distribution, rounded outwards
    half = NORMAL_95 * np.sqrt(len(values)) / 2
    low = values[max(int(np.floor(len(values) / 2 - half)) - 1, 0)]
    high = values[min(int(np.ceil(len(values) / 2 + half)), len(values) - 1)]
    equal = 0.0 if kind == "difference" else 1.0
    return result.model_copy(
        update={"low": float(low), "high": float(high), "significant": not bool(low <= equal <= high)}
    )


def _by_point(stiffness: Floats, damping: Floats, cost: Floats) -> tuple[list[tuple[float, float]], Floats]:
    """Return the points that have a cost, and the median cost at each."""
    known = np.isfinite(cost)
    points, place = np.unique(np.column_stack([stiffness[known], damping[known]]), axis=0, return_inverse=True)
    order = np.lexsort((cost[known], place.ravel()))
    count = np.bincount(place.ravel(), minlength=len(points))
    start = np.cumsum(count) - count
    ordered = cost[known][order]
    if not len(points):
        return [], np.empty(0)
    middle = (ordered[start + (count - 1) // 2] + ordered[start + count // 2]) / 2
    return [(k, b) for k, b in points.tolist()], middle


def sentences_of(pair: PairDifference) -> tuple[str, ...]:
    """Return what it comes to, in sentences."""
    a, b = pair.labels
    found = []
    edge = pair.boundary
    if edge is None:
        found.append(f"The boundaries of {a} and {b} cannot be compared: {pair.boundary_reason}.")
    else:
        where = f"{'B' if pair.plane == 'physical' else 'β'} = {significant(edge.largest_damping, 3)}"
        found.append(
            f"The boundary of {b} lies {percent_text(edge.median_percent)} % from that of {a} in stiffness (median of "
            f"{counted(len(edge.points), 'damping')}; at most {percent_text(edge.largest_percent)} % at {where}); "
            f"{edge.significant} of {counted(edge.judged, 'limit')} with intervals "
            f"{'differs' if edge.judged == 1 else 'differ'} significantly."
        )
    told = [v for v in pair.estimates if v.significant is not None]
    differ = [v.name.removesuffix("_samples").replace("_", " ") for v in told if v.significant]
    if told:
        found.append(
            f"Of {len(told)} estimates with intervals, {', '.join(differ) if differ else 'none'} "
            f"{'differs' if len(differ) < 2 else 'differ'} significantly."
        )
    for cost in pair.costs:
        if cost.median is None:
            continue
        name = criterion_name(cost.criterion)
        size = (
            f"{significant(cost.median, 3)} times as large"
            if cost.kind == "ratio"
            else f"{'larger' if cost.median >= 0 else 'smaller'} by {significant(abs(100 * cost.median), 3)} "
            "percentage points"
        )
        sure = {True: "significant", False: "not significant", None: "not judged"}[cost.significant]
        found.append(f"Costs of {b} at {cost.points} common points, {name}: {size} in the median ({sure}).")
    return tuple(found)
