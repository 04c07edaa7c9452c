"""The place of an optimum: its neighbourhood against a dense search of theory, its scatter against known noise."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.measured.experiment.optimum_place import (
    cost_scatter,
    is_alone,
    near_optimum,
    nearly_as_good,
    stable_damping_range,
)
from pipeline.records.findings import BoundaryPoint, DampingRange, Optimum
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


@pytest.mark.slow
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


def point(damping, low, censored=False):
    """Limit with a lower end. Without one, no trial decides."""
    known = low is not None
    return BoundaryPoint(
        damping=damping,
        stable=low,
        unstable=None if censored or not known else low + 400,
        censored=censored,
        estimate=None if censored or not known else low + 200,
        low=low,
        high=None if censored or not known else low + 400,
    )


def test_the_range_of_stable_dampings_is_that_of_a_dense_search():
    rng = np.random.default_rng(7)
    for _ in range(40):
        B = np.sort(rng.choice(np.arange(0.0, 200.0, 4.0), 9, replace=False))
        K = rng.uniform(500.0, 9000.0, 9)
        at = int(rng.integers(0, 9))
        stiffness = float(rng.uniform(0.3, 1.0) * K[at])
        found = stable_damping_range(
            [point(*each) for each in zip(B.tolist(), K.tolist(), strict=True)], stiffness, B[at]
        )
        dense = np.linspace(B[0], B[-1], 400_001)
        stable = np.interp(dense, B, K) >= stiffness
        here = int(np.searchsorted(dense, B[at]))
        below, above = np.flatnonzero(~stable[:here]), np.flatnonzero(~stable[here:])
        low = dense[below[-1] + 1] if len(below) else B[0]
        high = dense[here + above[0]] if len(above) else B[-1]
        assert (found.low, found.high) == pytest.approx((low, high), abs=2e-3)
        assert (found.low_is_limit, found.high_is_limit) == (len(below) > 0, len(above) > 0)


def test_a_range_ends_where_no_limit_is_known():
    points = [point(0.0, 4000.0), point(20.0, 4000.0), point(40.0, 5000.0, censored=True), point(60.0, None)]
    found = stable_damping_range(points, 3000.0, 20.0)
    assert (found.low, found.high, found.low_is_limit, found.high_is_limit) == (0.0, 40.0, False, False)
    assert found.margin == 2.0, "no damping at all is not an end"
    assert stable_damping_range(points, 3000.0, 0.0).margin is None
    assert stable_damping_range(points, 3000.0, 60.0) is None
    assert stable_damping_range(points, 3000.0, 80.0) is None
    assert stable_damping_range([], 3000.0, 20.0) is None


@pytest.mark.parametrize(
    ("margin", "low", "high", "close"),
    [(2.0, 50.0, 200.0, False), (1.2, 50.0, 200.0, True), (2.0, 90.0, 200.0, True), (2.0, 50.0, 110.0, True),
     (None, 50.0, 200.0, None)],
)  # fmt: skip
def test_an_optimum_is_close_to_the_border_in_stiffness_or_in_damping(margin, low, high, close):
    around = DampingRange(low=low, high=high, low_is_limit=True, high_is_limit=True, margin=1.0)
    best = Optimum(stiffness=1000.0, damping=100.0, cost=20.0, margin=margin, damping_range=around)
    assert best.at_border is close
    untested = around.model_copy(update={"low_is_limit": False, "high_is_limit": False})
    by_stiffness = True if margin == 1.2 else None
    if close is not False:
        assert best.model_copy(update={"damping_range": untested}).at_border is by_stiffness, "the tested range ends"
    assert best.model_copy(update={"damping_range": None}).at_border is by_stiffness


def test_a_wall_without_overshoot_is_alone_where_its_neighbours_overshoot():
    """As a Falcon: the region without overshoot ends at 3,000 N/m, and one trial at 6,800 N/m is lucky."""
    K, B = (values.ravel() for values in np.meshgrid(np.arange(400.0, 8001, 400), np.arange(0.0, 185, 8)))
    free = 3000 - 20 * np.abs(B - 104) >= K
    lucky = free | ((K == 6800) & (B == 128))
    assert is_alone(lucky, K, B, 6800.0, 128.0)
    # the stiffest wall of the region is at its tip, and not alone
    assert free[(K == 2800) & (B == 104)].all()
    assert not is_alone(free, K, B, 2800.0, 104.0)


def test_a_wall_without_neighbours_or_with_such_ones_alone_is_not_alone():
    assert not is_alone(np.array([True]), np.array([800.0]), np.array([8.0]), 800.0, 8.0)
    pair = np.array([800.0, 1200.0]), np.array([8.0, 8.0])
    assert not is_alone(np.array([True, True]), *pair, 800.0, 8.0)
    assert is_alone(np.array([True, False]), *pair, 800.0, 8.0)
