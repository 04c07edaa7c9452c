from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.experiment.best_trial import choose_optimum, without_overshoot

NONE = np.full(2, np.nan)


def grid():
    K, B = (a.ravel() for a in np.meshgrid(np.arange(1.0, 8.0), np.arange(0.0, 7.0)))
    names = tuple(f"{k:g}/{b:g}" for k, b in zip(K, B, strict=True))
    return K, B, names, K >= 7.0


def test_optimum_is_the_smallest_cost_of_a_stable_trial():
    K, B, names, unstable = grid()
    cost = (K - 3) ** 2 + (B - 2) ** 2
    cost[unstable] = -1.0
    found = choose_optimum(cost, K, B, names, unstable=unstable)
    assert (found.trial_id, found.cost, found.ties, found.censored) == ("3/2", 0.0, 1, False)


def test_ties_take_the_centre_of_their_bounding_box():
    K, B, names, unstable = grid()
    cost = np.where((K >= 2) & (K <= 4) & (B >= 1) & (B <= 5), 15.0, 16.0)
    found = choose_optimum(cost, K, B, names, unstable=unstable)
    assert (found.trial_id, found.ties) == ("3/3", 15)


def test_overshoot_takes_the_stiffest_trial_without_any():
    K, B, names, unstable = grid()
    cost = np.where(K <= 4, 0.0, 0.1)
    cost[(K == 5) & (B == 3)] = 1e-13
    cost[(K == 6) & (B == 3)] = 1e-3
    nothing = np.zeros_like(K)
    assert choose_optimum(cost, K, B, names, unstable=unstable, floor=nothing).trial_id == "5/3"
    assert choose_optimum(cost, K, B, names, unstable=unstable, floor=nothing + 2e-3).trial_id == "6/3"
    assert choose_optimum(cost + 0.2, K, B, names, unstable=unstable, floor=nothing).cost == pytest.approx(0.2)


def test_a_trial_with_a_wide_floor_is_not_known_to_be_without_overshoot():
    K, B, names, unstable = grid()
    cost = np.where(K <= 4, 0.0, 0.1)
    cost[(K == 6) & (B == 3)] = 0.04
    floor = np.where((K == 6) & (B == 3), 0.05, 1e-3)
    assert choose_optimum(cost, K, B, names, unstable=unstable, floor=floor).stiffness == 4.0
    assert without_overshoot(np.zeros(2), np.array([0.009, 0.011])).tolist() == [True, False]
    # where no trial is known to be without, the smallest overshoot is the best
    cost = np.where((K == 6) & (B == 3), 0.04, 0.1)
    assert choose_optimum(cost, K, B, names, unstable=unstable, floor=floor).trial_id == "6/3"


@pytest.mark.parametrize(("at", "censored"), [((3, 6), True), ((3, 0), False), ((3, 3), False), ((6, 3), False)])
def test_censored_at_the_largest_tested_damping(at, censored):
    K, B, names, unstable = grid()
    cost = (K - at[0]) ** 2 + (B - at[1]) ** 2
    assert choose_optimum(cost, K, B, names, unstable=unstable).censored == censored


def test_censored_where_nothing_stiffer_was_tested():
    K, B, names, unstable = grid()
    tested = ~unstable
    K, B, names = K[tested], B[tested], names[: tested.sum()]
    cost = -K - 0.01 * (B == 3)
    found = choose_optimum(cost, K, B, names, unstable=unstable[tested])
    assert (found.stiffness, found.damping, found.censored) == (6.0, 3.0, True)


def test_no_optimum_without_costs():
    assert choose_optimum(NONE, NONE, NONE, ("a", "b"), unstable=np.zeros(2, dtype=bool)) is None
