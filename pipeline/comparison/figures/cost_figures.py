"""Cost maps: theory on a grid, and measured costs smoothed over the trials around."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.comparison.figures.boundary_curves import measured_curve, theory_curve
from pipeline.comparison.figures.figure_optima import optimal_curve
from pipeline.comparison.scores.deviation import FEWEST, NEIGHBOURS, smooth_of
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.criteria import criterion_of
from pipeline.records.figure_records import CostMap, Curve
from pipeline.records.findings import Optimum
from pipeline.records.results import ExperimentResult
from pipeline.theory.costs import cost_maps
from pipeline.theory.predictions import Predictions, Theory

MAP_POINTS = 101
"""Grid points along each axis of a drawn map; finer ones change no contour visibly."""

FEW_NEIGHBOURS = 9
"""Trials by which a cost is smoothed without a theory beside it: a plane over more would fill its valleys."""

SHARE = 8
"""The part of the trials, at most, by which what differs from theory is smoothed: it changes over the plane, too."""

TOLD = 0.9
"""Share of the trials for which theory must have a cost, so that what differs from it is smoothed."""

FEWEST_DRAWN, LEAST_SHARE = 20, 0.2
"""Stable trials with a cost, in number and as a share of all, below which no lines of equal cost are drawn: they would
lie where few others have one."""

NO_TRIALS = (np.empty(0), np.empty(0), np.empty(0))


def theory_maps(
    theory: Theory, shown: Sequence[ExperimentResult], criteria: Sequence[str], predictions: Predictions
) -> dict[str, CostMap]:
    """Maps of theory by criterion over its stable region and all that was tested."""
    points = [point for result in shown for point in result.boundary]
    p, border, units = theory.parameters, theory.boundary, theory.units
    stiffest = max([border.alpha_max * units.stiffness, *(p.unstable or p.stable or 0.0 for p in points)])
    dampings = [border.beta_max * units.damping, *(p.damping for p in points)]
    stiffness = np.linspace(0, stiffest, MAP_POINTS)
    damping = np.linspace(min(0.0, *dampings), max(dampings), MAP_POINTS)
    costs = cost_maps(theory.loop, stiffness / units.stiffness, damping / units.damping, criteria)
    label = f"theory, d = {p.delay_samples:g}, m = {p.mass:.3g}, b = {p.damping:.3g}"
    maps = {}
    for criterion, cost in costs.items():
        lines = without_steps(cost) if criterion_of(criterion).family.whole else cost
        found = predictions.get(theory, f"{criterion}_discrete")
        best = None if found is None else Optimum(stiffness=found.stiffness, damping=found.damping, cost=found.cost)
        curves = _optimal_curves(stiffness, damping, lines, criterion, exact=True)
        edge = theory_curve(theory, "boundary")
        maps[criterion] = CostMap(label, "theory", stiffness, damping, cost, edge, best, *NO_TRIALS, *curves, lines)
    return maps


def without_steps(cost: Floats) -> Floats:
    """Return costs that are whole numbers as a smooth map: their steps fray lines of equal cost.

    Each point is the mean of the logarithms around it, weighed by 1, 4, 6, 4, 1 along both axes: some two grid points,
    which no reader could tell.

    Parameters
    ----------
    cost : float64, shape (q, p)
        NaN where there is none, and there remains none.
    """
    known = np.isfinite(cost) & (cost > 0)
    total, weight = np.where(known, np.log(np.where(known, cost, 1.0)), 0.0), known.astype(np.float64)
    for axis in (0, 1):
        total, weight = (_five(values, axis) for values in (total, weight))
    return np.where(known, np.exp(np.where(known, total, 0.0) / np.where(known, weight, 1.0)), np.nan)


def _five(values: Floats, axis: int) -> Floats:
    """Sum over five neighbours along an axis, weighed by binomials."""
    size = values.shape[axis]
    padded = np.pad(values, [(2, 2) if each == axis else (0, 0) for each in (0, 1)])
    parts = (w * np.take(padded, range(n, n + size), axis) for n, w in enumerate((1.0, 4.0, 6.0, 4.0, 1.0)))
    result: Floats = sum(parts, np.zeros_like(values))
    return result


def _smoothed(
    stages: ExperimentStages, cost: Floats, criterion: str, theory: Theory | None, predictions: Predictions
) -> Floats:
    """Costs of stable trials freed from the noise of single ones; as they are where there are too few to tell.

    Smoothed is what differs from theory, which is curved less than the cost; without theory, or where it has no cost
    for more than a few of the trials, the cost itself by fewer neighbours.
    """
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    use = (stages.verdicts.verdict == "stable") & np.isfinite(cost) & (K > 0)
    result = np.where(use, cost, np.nan)
    differs = bool(criterion_of(criterion).family.levels)
    use &= differs | (cost > 0)
    base, neighbours = np.zeros(len(cost)) if differs else np.ones(len(cost)), FEW_NEIGHBOURS
    if theory is not None:
        expected = predictions.costs_at(theory, K, B, [criterion])[criterion]
        told = use & np.isfinite(expected) & (differs | (expected > 0))
        if told.sum() >= TOLD * use.sum():
            use, base = told, expected
            neighbours = min(NEIGHBOURS, max(FEW_NEIGHBOURS, int(told.sum()) // SHARE))
    if use.sum() < FEWEST:
        return result
    values = cost[use] - base[use] if differs else np.log(cost[use] / base[use])
    level = smooth_of(K[use], B[use], values, neighbours).of(values)
    smooth = np.full(len(cost), np.nan)
    smooth[use] = np.maximum(base[use] + level, 0.0) if differs else base[use] * np.exp(level)
    return smooth


def _optimal_curves(
    stiffness: Floats, damping: Floats, cost: Floats, criterion: str, *, exact: bool
) -> tuple[Curve, Curve]:
    """Best damping for each stiffness and best stiffness for each damping, where the map has costs on both sides."""
    smooth = exact and criterion_of(criterion).family.smooth
    b, b_inside = optimal_curve(damping, cost, smooth=smooth)
    k, k_inside = optimal_curve(stiffness, cost.T, smooth=smooth)
    return (
        Curve("best damping", "optimal", stiffness, np.where(b_inside, b, np.nan)),
        Curve("best stiffness", "optimal", np.where(k_inside, k, np.nan), damping),
    )


def measured_map(
    result: ExperimentResult,
    stages: ExperimentStages,
    criterion: str,
    theory: Theory | None,
    predictions: Predictions,
) -> CostMap:
    """Return the map of an experiment: the smoothed costs on a grid of what was tested, and the trials as they are."""
    cost = stages.sure_cost(criterion)
    smooth = _smoothed(stages, cost, criterion, theory, predictions)
    k, b = stages.column("response", "stiffness"), stages.column("response", "damping")
    shown = (k > 0) & (stages.verdicts.verdict != "unstable")
    k, b, cost, smooth = k[shown], b[shown], cost[shown], smooth[shown]
    levels = np.unique(b) if len(b) else np.zeros(1)
    optimum = result.optimum.get(criterion)
    axis = _stiffness_axis(k, len(levels), optimum)
    grid = np.full((len(levels), len(axis)), np.nan)
    costly, stable = np.isfinite(smooth).sum(), int((stages.verdicts.verdict[shown] == "stable").sum())
    drawn = costly >= max(FEWEST_DRAWN, LEAST_SHARE * stable)
    for row, level in enumerate(levels if drawn else ()):
        at = np.flatnonzero((b == level) & np.isfinite(smooth))
        if len(at) > 1:
            order = at[np.argsort(k[at], kind="stable")]
            # along K a course is dense enough to interpolate; beyond its first and last trial nothing is claimed
            grid[row] = np.interp(axis, k[order], smooth[order], left=np.nan, right=np.nan)
    name = f"experiment {result.experiment}" + (f", {result.configuration}" if result.configuration else "")
    # where nothing overshoots, no damping is best
    flat = bool(criterion_of(criterion).family.levels)
    curves = (None, None) if flat else _optimal_curves(axis, levels, grid, criterion, exact=False)
    return CostMap(name, "measured", axis, levels, grid, measured_curve(result), optimum, k, b, cost, *curves)


def _stiffness_axis(stiffness: Floats, levels: int, optimum: Optimum | None) -> Floats:
    """Stiffness values that were tried at a tenth of the dampings or more, and that of the optimum.

    The second pass of a course refines each column around its own limit only; as grid lines those values would be gaps.
    """
    values, count = np.unique(stiffness, return_counts=True)
    common = values[count >= min(max(2, 0.1 * levels), count.max(initial=1))]
    axis = np.union1d(common, [optimum.stiffness] if optimum else [])
    return axis if len(axis) > 1 else np.array([0.0, 1.0])
