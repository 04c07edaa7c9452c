from __future__ import annotations

import numpy as np
import pytest

from pipeline.comparison.figures.figure_optima import optimal_curve
from pipeline.loop.loop import Loop
from pipeline.theory.costs import cost_maps, costs_at, point_costs_by_name
from pipeline.theory.curves import best_damping, best_stiffness

LOOP = Loop(0.0, 0.007, 4.0)


def test_curves_of_a_map_follow_those_that_are_searched_for() -> None:
    alpha, beta = np.linspace(0, 0.025, 101), np.linspace(0, 0.33, 101)
    cost = cost_maps(LOOP, alpha, beta, ("energy_step_w1",))["energy_step_w1"]
    b, inside = optimal_curve(beta, cost, smooth=True)
    a, a_inside = optimal_curve(alpha, cost.T, smooth=True)
    some, others = np.arange(20, 90, 15), np.arange(20, 80, 15)
    assert inside[some].all()
    assert a_inside[others].all()
    # a parabola through three grid points of a smooth cost is off by far less than a step
    assert b[some] == pytest.approx(best_damping(LOOP, "energy_step_w1_discrete", alpha[some]).best, abs=0.1 * 0.0033)
    found = best_stiffness(LOOP, "energy_step_w1_discrete", beta[others]).best
    assert a[others] == pytest.approx(found, abs=0.1 * 0.00025)


def test_equal_costs_give_the_middle_of_their_first_stretch() -> None:
    nan = np.nan
    cost = np.array(
        [
            [9, 1, nan, nan, 5],
            [3, 2, nan, 4, 2],
            [3, 3, nan, 4, 7],
            [3, 4, nan, 4, 2],
            [8, 5, nan, nan, 9],
        ],
        dtype=float,
    )
    best, inside = optimal_curve(np.array([0.0, 1, 2, 3, 4]), cost, smooth=False)
    assert best[[0, 1, 3, 4]].tolist() == [2.0, 0.0, 2.0, 1.0]
    assert np.isnan(best[2])
    # the second touches the end of the range, the fourth the ends of what is known
    assert inside.tolist() == [True, False, False, False, True]


def test_parabola_is_exact_for_a_parabola_on_uneven_steps() -> None:
    values = np.array([0.0, 1.0, 2.5, 3.0, 5.0])
    cost = ((values - 2.2) ** 2)[:, None]
    best, _ = optimal_curve(values, cost, smooth=True)
    assert best[0] == pytest.approx(2.2)


def test_costs_at_points_are_those_of_the_exact_ones() -> None:
    rng = np.random.default_rng(3)
    alpha, beta = rng.uniform(-0.002, 0.02, 60), rng.uniform(0.02, 0.28, 60)
    names = ("settle_2pct", "overshoot", "energy_step_w2")
    found = costs_at(LOOP, alpha, beta, names)
    known = np.isfinite(found["energy_step_w2"])
    assert 10 < known.sum() < 60
    assert not known[alpha <= 0].any()
    exact = point_costs_by_name(LOOP, alpha[known], beta[known], [f"{n}_discrete" for n in names], 4096)
    for name in names:
        both = np.isfinite(found[name][known]) & np.isfinite(exact[f"{name}_discrete"])  # both end long responses
        assert both.sum() > 10
        assert found[name][known][both] == pytest.approx(exact[f"{name}_discrete"][both], rel=1e-9, abs=1e-9)
