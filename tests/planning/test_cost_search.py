"""The search for the best cost, on costs that are known everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.planning.cost_search import CostTarget, costs_of, search_walls
from pipeline.planning.loop_limits import linear_limits
from pipeline.planning.next_wall import TriedWalls
from pipeline.theory.optimum import optimal_point

BY = Loop(mass=0.5, damping=3.5, sampling_period_s=1e-3, delay_samples=4.0)
DAMPINGS = np.linspace(0, 120, 12)
LIMITS = linear_limits(BY, DAMPINGS)
LEAST = optimal_point(NormalisedLoop.of(BY), "settle_2pct").cost


def search(measured, by, holds=True):
    """Run a search whose trials have the costs of a function."""
    walls, costs = [], []
    while True:
        K, B = np.array(walls).reshape(-1, 2).T
        said = np.where(np.isfinite(costs), "stable", "unstable")
        tried = (
            TriedWalls(K, B, said, np.full(len(K), np.nan), cost=np.array(costs))
            if walls
            else TriedWalls(*[np.empty(0)] * 4)
        )
        found = search_walls(tried, CostTarget("settle_2pct", DAMPINGS, LIMITS, by, holds), 0.05, 1)
        if found.done or len(walls) == 40:
            return found, walls, costs
        walls.append(found.walls[0][:2])
        costs.append(float(measured(*(np.array([x]) for x in walls[-1]))[0]))


def exact(K, B):
    return np.ceil(costs_of(BY, K, B, "settle_2pct"))


def test_a_right_loop_finds_the_best_wall_at_once():
    found, walls, _ = search(exact, BY)
    assert found.done
    assert len(walls) <= 8
    best = [np.array([x]) for x in walls[found.best]]
    assert costs_of(BY, *best, "settle_2pct")[0] <= 1.05 * LEAST
    low, high, least, most = found.region
    assert low <= walls[found.best][0] * 1.1
    assert high >= walls[found.best][0] * 0.9
    assert least < most


@pytest.mark.slow
def test_a_wrong_loop_is_corrected_by_costs():
    found, walls, costs = search(exact, replace(BY, delay_samples=3.5), holds=False)
    best = [np.array([x]) for x in walls[found.best]]
    assert costs[found.best] == np.nanmin(costs)
    assert costs_of(BY, *best, "settle_2pct")[0] <= 1.3 * LEAST, "by its costs alone, which jump"
    assert len(walls) >= 15, "it does not believe the loop"


def test_a_search_is_done_from_six_costs_on_where_the_device_holds_and_else_from_fifteen_on():
    K, B = np.linspace(1000.0, 4000.0, 15), np.full(15, 50.0)
    tried = TriedWalls(K, B, np.full(15, "stable"), np.full(15, np.nan), cost=costs_of(BY, K, B, "settle_2pct"))
    for holds, enough in ((True, 6), (False, 15)):
        for rows in (enough - 1, enough):
            # to an accuracy that any wall reaches
            target = CostTarget("settle_2pct", DAMPINGS, LIMITS, BY, holds)
            assert search_walls(tried.select(slice(0, rows)), target, 1000.0, 1).done is (rows == enough)


def test_no_search_is_done_before_some_costs_are_known():
    K, B = np.array([1500.0]), np.array([40.0])
    tried = TriedWalls(K, B, np.array(["stable"]), np.array([np.nan]), cost=np.array([1.0]))
    assert not search_walls(tried, CostTarget("settle_2pct", DAMPINGS, LIMITS, BY), 0.05, 1).done


def test_a_batch_names_different_walls():
    tried = TriedWalls(*[np.empty(0)] * 4)
    walls = search_walls(tried, CostTarget("settle_2pct", DAMPINGS, LIMITS, None), 0.05, 4).walls
    assert len({wall[:2] for wall in walls}) == 4


def test_walls_beyond_the_loops_own_limit_have_no_cost():
    assert np.isnan(costs_of(BY, np.array([1.2 * LIMITS.max()]), np.array([40.0]), "settle_2pct")).all()
    assert costs_of(BY, np.array([1500.0]), np.array([40.0]), "settle_2pct")[0] == pytest.approx(50, abs=45)
