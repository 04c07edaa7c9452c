"""Walls to use: rectangles against searches of all rectangles, and against trials that they were not chosen by."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.comparison.scores.agreement import MeasuredLimits
from pipeline.comparison.summary.advice import (
    FEWEST,
    GOOD,
    NARROW,
    NEIGHBOURS,
    WallTrials,
    best_rectangle,
    levels,
    room_at,
)


def limits(damping, limit, low=None, censored=False):
    flags = np.full(len(damping), censored)
    return MeasuredLimits(
        damping, limit, limit if low is None else low, limit, flags, np.ones(len(damping), dtype=bool)
    )


def course(cost, stiffness=None, damping=None, stable=None):
    """Trials on a grid of stiffness and damping; the cost is a function of both."""
    K = np.arange(200.0, 4000, 200) if stiffness is None else stiffness
    B = np.arange(0.0, 50, 5) if damping is None else damping
    k, b = (a.ravel() for a in np.meshgrid(K, B))
    usable = np.ones(len(k), dtype=bool) if stable is None else stable(k, b)
    return WallTrials(k, b, cost(k, b), levels(k, b, cost(k, b), usable), usable, usable)


def bowl(k, b):
    return 20 + 10 * (((k - 2000) / 600) ** 2 + ((b - 25) / 10) ** 2)


FLAT = limits(np.arange(0.0, 50, 5), np.full(10, 4000.0))


def test_a_rectangle_lies_around_the_least_cost_and_no_side_can_be_moved_out():
    tested = course(bowl)
    region = best_rectangle(tested, FLAT, NARROW)
    assert region[0] < 2000 < region[1]
    assert region[2] < 25 < region[3]
    inside = tested.inside(region)
    across = np.stack([tested.stiffness / tested.stiffness.std(), tested.damping / tested.damping.std()], axis=1)
    apart = np.hypot(*(across[:, None] - across).transpose(2, 0, 1))
    level = np.median(tested.cost[np.argsort(apart, axis=1, kind="stable")[:, 1 : NEIGHBOURS + 1]], axis=1)
    good = level <= GOOD[0] * level[tested.stiffness <= 4000 / NARROW].min()
    assert good[inside].mean() >= 0.9
    for wider in ((-200, 0, 0, 0), (0, 200, 0, 0), (0, 0, -5, 0), (0, 0, 0, 5)):
        grown = tested.inside(tuple(np.add(region, wider)))
        assert good[grown].mean() < 0.9


def test_walls_keep_the_margin_to_the_lower_end_of_the_limit():
    low = np.full(10, 4000.0)
    low[6] = 1500.0  # at B = 30 the interval of the limit reaches far down
    region = best_rectangle(course(bowl), limits(FLAT.damping, FLAT.limit, low), NARROW)
    assert region[1] * NARROW <= (1500 if region[2] <= 30 <= region[3] else 4000)
    fast = best_rectangle(course(lambda k, b: 1e5 / k), FLAT, NARROW)  # the stiffer the better
    assert fast[1] <= 4000 / NARROW


def test_no_unstable_or_undecided_trial_lies_inside():
    region = best_rectangle(course(bowl, stable=lambda k, b: ~((k == 2200) & (b == 25))), FLAT, NARROW)
    assert not (region[0] <= 2200 <= region[1] and region[2] <= 25 <= region[3])


def test_one_lucky_trial_is_not_where_the_walls_are():
    def lucky(k, b):
        return np.where((k == 800) & (b == 5), 4.0, bowl(k, b))

    assert best_rectangle(course(lucky), FLAT, NARROW) == best_rectangle(course(bowl), FLAT, NARROW)


def test_narrow_valleys_are_given_more_room_and_few_trials_are_none():
    narrow = best_rectangle(course(lambda k, b: 20 + np.abs(k - 2000) / 10 + 10 * np.abs(b - 25)), FLAT, NARROW)
    assert narrow is not None
    few = course(bowl, stiffness=np.array([2000.0]), damping=np.array([20.0, 25, 30]))
    assert best_rectangle(few, FLAT, NARROW) is None
    none = MeasuredLimits(*(np.zeros(1),) * 4, np.zeros(1, dtype=bool), np.zeros(1, dtype=bool))
    assert best_rectangle(few, none, NARROW) is None


def test_a_valley_along_the_damping_is_followed_where_the_steps_of_stiffness_are_coarse():
    """As lwr with 5 samples of delay: a first step along the stiffness, as good at first, ends in four trials."""

    def valley(k, b):
        return 50 + 40 * np.abs(np.log2(k / 1200)) + np.where(k == 1200, 0.5, 4.0) * np.abs(b - 20)

    tested = course(valley, stiffness=np.array([400.0, 800, 1200, 1600, 2000]), damping=np.arange(10.0, 34, 2))
    flat = limits(np.arange(0.0, 50, 5), np.full(10, 2200.0))
    region = best_rectangle(tested, flat, NARROW)
    assert tested.inside(region).sum() >= FEWEST
    assert region[0] <= 1200 <= region[1]
    assert region[3] - region[2] >= 6


def test_the_wall_to_set_is_neither_the_lucky_trial_nor_beside_good_ones_only():
    cost = np.array([10.0, 50, 30, 31, 40])
    level = np.array([45.0, 20, 32, 31, 41])
    tested = WallTrials(np.full(5, 1000.0), np.arange(5.0), cost, level, *[np.ones(5, dtype=bool)] * 2)
    room = np.full(5, 4000.0)
    assert tested.favoured((1000, 1000, 0, 4), room) == 3
    alike = WallTrials(tested.stiffness, tested.damping, np.ones(5), np.ones(5), tested.usable, tested.usable)
    assert alike.favoured((1000, 1000, 0, 4), np.array([2000.0, 3000, 9000, 4000, 1])) == 2


def test_where_no_limit_is_known_there_is_no_room():
    none = MeasuredLimits(*(np.zeros(1),) * 4, np.zeros(1, dtype=bool), np.zeros(1, dtype=bool))
    assert room_at(none, np.array([1.0, 2.0])).tolist() == [0, 0]


@pytest.mark.parametrize("seed", range(4))
def test_a_further_trial_lies_in_the_range_as_often_as_is_said(seed):
    """Scatter of single trials, drawn anew at the same walls: (n - 1)/(n + 1) of the new costs lie inside."""
    random = np.random.default_rng(900 + seed)
    held, expected = [], []
    for _ in range(60):
        tested = course(lambda k, b: bowl(k, b) * np.exp(0.15 * random.standard_normal(len(k))))
        region = best_rectangle(tested, FLAT, NARROW)
        at = tested.inside(region)
        seen, n = tested.cost[at], int(at.sum())
        new = bowl(tested.stiffness[at], tested.damping[at]) * np.exp(0.15 * random.standard_normal(n))
        held.append(np.mean((new >= seen.min()) & (new <= seen.max())))
        expected.append((n - 1) / (n + 1))
    # what neighbours share of each other's levels is left
    assert np.mean(held) == pytest.approx(np.mean(expected), abs=0.06)
