"""Decompose the deviation of a measured optimal cost from theory into range, grid, model, and selection of a trial.

The lowest measured cost comes from one noisy trial on a grid of limited range. The theoretical optimum is affected by
neither noise nor grid nor range. Let C be theory's cost, with its optimum at p* (unconstrained), p_r (in the tested
range) and p_g (among the tested points). Let s be the smoothed measured cost with its minimum at the tested point p_s,
and M the cost of a single trial with its minimum at p_m. Then

    M(p_m)/C(p*) = C(p_r)/C(p*) . C(p_g)/C(p_r) . s(p_s)/C(p_g) . M(p_m)/s(p_s)
"""

from __future__ import annotations

import numpy as np

from pipeline.comparison.scores.local_planes import LocalPlanes, local_planes
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.criteria import DISCRETE, criterion_of
from pipeline.records.findings import MATTERS, Optimum
from pipeline.records.models import Deviation
from pipeline.records.trials import Booleans, Floats, Integers
from pipeline.theory.costs import costs_at
from pipeline.theory.predictions import Predictions, Theory

FEWEST = 12
"""Smallest number of trials with both costs for which noise and deviation can be separated."""

RESAMPLED = 200
"""Number of resampled experiments for the interval of the model component."""

LIKELY = 100
"""Number of points with the lowest smoothed cost among which the optimum of each resampled experiment is searched."""

SEARCH, SEARCH_WHOLE, ZOOM, ROUNDS = 41, 201, 15, 4
"""Number of grid points along an axis of the tested range (second number: for integer costs, whose best region is
small), number of grid points along an axis of a window around the best point, and number of times that the window is
narrowed."""

Rectangle = tuple[tuple[float, float], tuple[float, float]]


def deviation_of(
    stages: ExperimentStages, optimum: Optimum | None, theory: Theory, criterion: str, predictions: Predictions
) -> Deviation | None:
    """Return the decomposition of the deviation of an experiment from a theory.

    The result is None if a cost is zero or missing, or if there are too few trials.

    Parameters
    ----------
    stages : ExperimentStages
    optimum : Optimum, optional
        The best trial.
    theory : Theory
    criterion : str
    predictions : Predictions
        Predictions, which must contain theory's discrete optimum of the criterion.
    """
    best = predictions.get(theory, f"{criterion}{DISCRETE}")
    if best is None or optimum is None or criterion_of(criterion).family.levels or not best.cost * optimum.cost > 0:
        return None
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    expected = predictions.costs_at(theory, K, B, [criterion])[criterion]
    measured = stages.sure_cost(criterion)
    alpha, beta = K / theory.units.stiffness, B / theory.units.damping
    use = (stages.verdicts.verdict == "stable") & (measured > 0) & (expected > 0)
    if use.sum() < FEWEST:
        return None
    point = best.stiffness / theory.units.stiffness, best.damping / theory.units.damping
    inside = all(axis.min() <= at <= axis.max() for axis, at in zip((alpha, beta), point, strict=True))
    ranged = best.cost if inside else _least_in_range(theory.normalised, alpha, beta, criterion)
    return deviation(alpha, beta, expected, measured, use, (best.cost, ranged, optimum.cost))


def deviation(
    alpha: Floats, beta: Floats, expected: Floats, measured: Floats, use: Booleans, least: tuple[float, float, float]
) -> Deviation:
    """Return the four components in percent, with the 95 % interval of the model component.

    Parameters
    ----------
    alpha, beta : float64, shape (n,)
        Tested points.
    expected, measured : float64, shape (n,)
        Costs C and M of the tested points, NaN if missing.
    use : bool, shape (n,)
        Points with both costs, at least `FEWEST`.
    least : tuple of float
        C(p*), C(p_r) and M(p_m).

    Notes
    -----
    The smoothed quantity is the logarithm of M/C, which varies little even where C is curved. For the interval, random
    signs are assigned to the residuals of single trials, and the lowest cost is searched again. The reduction of the
    lowest cost by such residuals widens the interval on both sides. The component is ``steady`` if no single trial
    determines it. This is tested for the trials around the best point and around theory's optimum.
    """
    free, ranged, trial = least
    grid = float(np.nanmin(expected))
    ranged = min(max(ranged, free), grid)
    theory, ratio = np.log(expected[use]), np.log(measured[use] / expected[use])
    smooth = local_planes(alpha[use], beta[use], ratio)
    level = smooth.of(ratio)
    best = float((theory + level).min())
    error = ratio - level
    draws = np.random.default_rng(0).choice([-1.0, 1.0], size=(RESAMPLED, len(error)))
    likely = np.argsort(theory + level)[:LIKELY]
    near = LocalPlanes(smooth.nearest[likely], smooth.weight[likely])
    drawn = np.array([(theory[likely] + near.of(level + error * signs)).min() for signs in draws])
    half = float(np.abs(np.percentile(drawn, [2.5, 97.5]) - best).max())
    logs = {
        "range": np.log(ranged / free),
        "grid": np.log(grid / ranged),
        "model": best - np.log(grid),
        "selection": np.log(trial) - best,
        "model_low": best - half - np.log(grid),
        "model_high": best + half - np.log(grid),
    }
    around = np.unique(smooth.nearest[likely])
    decisive = np.union1d(smooth.nearest[int(np.argmin(theory + level))], [int(np.argmin(theory))])
    points = alpha[use][around], beta[use][around], theory[around], ratio[around]
    steady = _is_steady(*points, np.flatnonzero(np.isin(around, decisive)), half)
    return Deviation(**{name: 100 * float(np.expm1(value)) for name, value in logs.items()}, steady=steady)


def _is_steady(alpha: Floats, beta: Floats, theory: Floats, ratio: Floats, decisive: Integers, half: float) -> bool:
    """Return whether the model component is insensitive to single trials.

    Leaving out any trial must keep its sign, and must change it by at most ``half``/2.
    """

    def model(kept: Booleans) -> float:
        level = local_planes(alpha[kept], beta[kept], ratio[kept]).of(ratio[kept])
        return float((theory[kept] + level).min() - theory[kept].min())

    every = np.ones(len(theory), dtype=np.bool_)
    whole = model(every)
    for place in decisive:
        without = model(np.where(np.arange(len(every)) == place, False, every))
        turned = without * whole < 0 and max(abs(without), abs(whole)) > MATTERS
        if turned or abs(without - whole) > max(0.5 * half, MATTERS):
            return False
    return True


def _least_in_range(loop: NormalisedLoop, alpha: Floats, beta: Floats, criterion: str) -> float:
    """Return theory's lowest cost in the bounding box of the tested points, or inf if there is none."""
    ends = (float(alpha.min()), float(alpha.max())), (float(beta.min()), float(beta.max()))
    least, window = np.inf, ends
    points = SEARCH_WHOLE if criterion_of(criterion).family.whole else SEARCH
    for _ in range(ROUNDS):
        a, b = _grid(window, ends, points)
        found = costs_at(loop, a, b, [criterion])[criterion]
        if not np.isfinite(found).any():
            break
        at = int(np.nanargmin(found))
        least = min(least, float(found[at]))
        half = [1.5 * (high - low) / (points - 1) for low, high in window]
        window = (a[at] - half[0], a[at] + half[0]), (b[at] - half[1], b[at] + half[1])
        points = ZOOM
    return least


def _grid(window: Rectangle, ends: Rectangle, size: int) -> tuple[Floats, Floats]:
    """Return the points of a grid over a window, clipped to the tested range."""
    axes = (np.clip(np.linspace(*side, size), *end) for side, end in zip(window, ends, strict=True))
    a, b = np.meshgrid(*axes)
    return a.ravel(), b.ravel()
