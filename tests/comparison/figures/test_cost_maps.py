"""What cost maps draw: optimal curves against theory's, levels that all panels share, and lines around the optimum."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure

from pipeline.comparison.figures.maps import CostMap, _at_optimum, _contours, _levels
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.measured.experiment.best_trial import LARGEST_OVERSHOOT_FLOOR
from pipeline.records.findings import Optimum
from pipeline.theory.costs import cost_maps
from pipeline.theory.curves import best_damping, best_stiffness
from pipeline.theory.optimum import optimal_point

LOOP = NormalisedLoop.ideal(0.0, 0.01, 2.0)


@pytest.fixture(scope="module")
def grid():
    alpha, beta = np.linspace(0.0, 0.1, 101), np.linspace(0.0, 0.5, 101)
    cost = cost_maps(LOOP, alpha, beta, ("energy_step_w1",))["energy_step_w1"]
    best = optimal_point(LOOP, "energy_step_w1")
    return CostMap(
        "theory",
        alpha,
        beta,
        cost,
        (),
        Optimum(stiffness=best.alpha, damping=best.beta, cost=best.cost),
        np.empty((3, 0)),
    )


def as_trials(grid, noise=0.0, stiffness=slice(10, 70, 3), damping=slice(5, 95, 3)):
    K, B = np.meshgrid(grid.stiffness[stiffness], grid.damping[damping])
    cost = grid.cost[damping, stiffness] * np.exp(noise * np.random.default_rng(1).standard_normal(K.shape))
    known = np.isfinite(cost)
    trials = np.stack([K[known], B[known], cost[known]])
    i = int(np.argmin(trials[2]))
    best = Optimum(stiffness=trials[0, i], damping=trials[1, i], cost=trials[2, i])
    return CostMap("experiment", trials[0], trials[1], trials[2], (), best, trials)


def test_optimal_curves_are_those_of_theory(grid):
    K, B = grid.best(along_stiffness=True)
    some = (K > 0.01) & (K < 0.06)
    exact = best_damping(LOOP, "energy_step_w1", K[some])
    np.testing.assert_allclose(B[some], exact.best, atol=2e-3)
    K, B = grid.best(along_stiffness=False)
    some = (B > 0.1) & (B < 0.35)
    np.testing.assert_allclose(K[some], best_stiffness(LOOP, "energy_step_w1", B[some]).best, atol=5e-4)


def test_curves_of_trials_use_what_was_tested_at_many_places(grid):
    some = as_trials(grid)
    K, B = some.best(along_stiffness=True)
    exact = best_damping(LOOP, "energy_step_w1", K)
    step = 3 * 0.5 / 100
    assert np.abs(B - exact.best).max() <= step
    # a stiffness with two trials is no point of the curve, nor of the front view
    lone = np.array([[0.0333, 0.0333], [0.2, 0.21], [50.0, 51.0]])
    trials = np.concatenate([some.trials, lone], axis=1)
    more = CostMap("experiment", *trials, (), some.optimum, trials)
    assert 0.0333 not in more.best(along_stiffness=True)[0]
    assert 0.0333 not in more.least[0]
    assert set(more.least[0]) <= set(np.unique(some.trials[0]))
    assert len(more.least[0]) > 10


def test_levels_are_counted_from_theorys_optimum_and_shared(grid):
    trials = as_trials(grid, noise=0.05)
    levels = _levels("energy_step_w1", [grid, trials])
    assert np.isclose(levels, grid.optimum.cost, rtol=1e-5).sum() == 1
    np.testing.assert_allclose(levels[2:] / levels[:-2], 2.0)
    # without theory: from the least optimum
    assert np.isclose(_levels("energy_step_w1", [trials]), trials.optimum.cost, rtol=1e-5).any()


def test_no_line_is_drawn_that_the_plus_would_lie_outside_of(grid):
    trials = as_trials(grid, noise=0.2)
    smooth = np.maximum(trials.cost, 1.3 * trials.optimum.cost)
    shown = CostMap("experiment", trials.stiffness, trials.damping, smooth, (), trials.optimum, trials.trials)
    assert _at_optimum(shown) == pytest.approx(1.3 * trials.optimum.cost)


def test_the_region_without_overshoot_has_one_level_for_theory_and_logs():
    """Otherwise, the same device would have a smaller region in its logs than in theory."""
    K, B = np.linspace(100, 8000, 41), np.linspace(0, 184, 24)
    cost = np.maximum(0.0, (K[None, :] - 5000) / 5000 + 0 * B[:, None]) + 0.004
    k, b = (values.ravel() for values in np.meshgrid(K, B))
    stiffest = Optimum(stiffness=7000.0, damping=100.0, cost=0.4)
    theory = CostMap("theory", K, B, cost, (), stiffest, np.empty((3, 0)))
    logs = CostMap("experiment", k, b, cost.ravel(), (), stiffest, np.stack([k, b, cost.ravel()]))
    levels = _levels("overshoot", [theory, logs])
    assert levels[0] == LARGEST_OVERSHOOT_FLOOR
    edges = []
    for shown in (theory, logs):
        axes = Figure().add_subplot()
        _contours(shown, "overshoot", levels, axes)
        (drawn,) = (each for each in axes.collections if isinstance(each, ContourSet))
        heavy = drawn.get_paths()[list(drawn.levels).index(levels[0])]
        assert max(drawn.get_linewidths()) == 1.5
        edges.append(float(heavy.vertices[:, 0].mean()))
    # 0.4 % and a fifth of a permille per N/m beyond 5,000 N/m
    assert edges == pytest.approx([5030.0, 5030.0], abs=100.0)
