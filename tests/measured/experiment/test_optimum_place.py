"""The place of an optimum: its neighbourhood against a dense search of theory, its scatter against known noise."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.measured.experiment.optimum_place import cost_scatter, near_optimum, nearly_as_good
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.optimum import optimal_point

LOOP = NormalisedLoop.ideal(0.0, 0.01, 2.0)


def costs_on_a_grid(criterion, size):
    alpha, beta = (
        values.ravel() for values in np.meshgrid(np.linspace(0.002, 0.1, size), np.linspace(0.05, 0.5, size))
    )
    return alpha, beta, point_costs_by_name(LOOP, alpha, beta, (criterion,), 500)[criterion]


def box_of(criterion, size):
    alpha, beta, cost = costs_on_a_grid(criterion, size)
    best = int(np.nanargmin(cost))
    near = nearly_as_good(cost, alpha, cost[best], alpha[best], np.zeros(len(cost), np.bool_))
    return near_optimum(near, alpha, beta)


@pytest.mark.parametrize("criterion", ["energy_step_w0", "energy_step_w2"])
def test_walls_within_five_percent_are_those_of_a_dense_search(criterion):
    best = optimal_point(LOOP, criterion)
    alpha, beta, cost = costs_on_a_grid(criterion, 121)
    inside = cost <= 1.05 * best.cost
    found = box_of(criterion, 31)
    step = (0.1 - 0.002) / 30, (0.5 - 0.05) / 30
    ends = (alpha[inside].min(), alpha[inside].max(), beta[inside].min(), beta[inside].max())
    boxes = (found.stiffness_low, found.stiffness_high, found.damping_low, found.damping_high)
    for one, other, width in zip(boxes, ends, (step[0], step[0], step[1], step[1]), strict=True):
        assert abs(one - other) <= 1.5 * width


def test_the_optimum_gets_sharper_with_the_weight_of_time():
    # 6.2.4: flat for w = 0, sharp for w = 2
    flat, sharp = box_of("energy_step_w0", 51), box_of("energy_step_w2", 51)
    assert sharp.stiffness_high - sharp.stiffness_low < 0.7 * (flat.stiffness_high - flat.stiffness_low)


def test_of_walls_without_overshoot_the_stiffest_are_near():
    cost, stiffness = np.array([0.0, 0.0, 0.0, 0.3]), np.array([100.0, 97.0, 90.0, 120.0])
    free = cost == 0
    assert nearly_as_good(cost, stiffness, 0.0, 100.0, free).tolist() == [True, True, False, False]


@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_scatter_is_that_of_the_noise(sigma):
    alpha, beta, cost = costs_on_a_grid("energy_step_w1", 41)
    some = np.isfinite(cost) & (cost < 3 * np.nanmin(cost))
    noisy = cost[some] * np.exp(sigma * np.random.default_rng(5).standard_normal(some.sum()))
    found = cost_scatter(noisy, alpha[some], beta[some])
    assert found == pytest.approx(100 * sigma, rel=0.25)
    assert cost_scatter(cost[some], alpha[some], beta[some]) < 1.0


def test_few_trials_have_no_scatter():
    values = np.arange(1.0, 20.0)
    assert cost_scatter(values, values, values) is None
    # on one line a parabola is still one of these trials
    assert cost_scatter(np.full(25, 3.0), np.arange(25.0), np.zeros(25)) == pytest.approx(0.0, abs=1e-9)
