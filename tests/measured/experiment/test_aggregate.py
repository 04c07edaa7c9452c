from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from pipeline.measured.experiment.aggregate import (
    choose_optimum,
    estimate_damping,
    estimate_mass,
    estimate_median,
)
from pipeline.measured.experiment.known_delay import estimate_delay
from pipeline.records.findings import Estimate

NONE = np.array([np.nan, np.nan])


def test_delay_is_the_median_and_its_range():
    factors = np.r_[np.full(30, 3), np.full(45, 4), np.full(25, 5), -1, -1]
    found = estimate_delay(factors, sampling_period_s=1e-3)
    assert (found.value, found.low, found.high, found.trials) == (4.0, 3.0, 6.0, 100)
    # Falcon jitter: 3 ms <= t_d < 6 ms
    mean = found.by_method["mean_delay"]
    assert (mean.low, mean.high) == (pytest.approx(3e-3), pytest.approx(6e-3))
    assert mean.value == pytest.approx((3.95 + 0.5) * 1e-3)


def test_a_constant_delay_keeps_its_bracket_and_a_few_strays_do_not_widen_it():
    found = estimate_delay(np.r_[np.full(99, 2), 0])
    assert (found.value, found.low, found.high) == (2.0, 2.0, 3.0)


def test_delay_of_an_even_number_is_one_that_occurred():
    assert estimate_delay(np.array([3, 4])).value == 3.0


def test_no_delay():
    found = estimate_delay(np.array([-1, -1]))
    assert found.value is None
    assert "no trial of 2" in found.reason


@pytest.mark.parametrize("n", [6, 7, 12, 25, 100, 2300])
def test_interval_of_the_median_covers_95_percent(n):
    values = np.arange(n, dtype=float)
    found = estimate_median(values[::-1], "kg", "m", "none")
    rank = int(found.low) + 1
    assert found.high == n - rank
    # P(the median lies below the rank-th value) = P(fewer than `rank` of n lie below it), each with 1/2
    assert 2 * binom.cdf(rank - 1, n, 0.5) <= 0.05
    assert 2 * binom.cdf(rank, n, 0.5) > 0.05


def test_interval_covers_the_true_median_of_simulated_trials():
    random = np.random.default_rng(4)
    samples = random.exponential(size=(2000, 31))
    found = [estimate_median(s, "", "m", "none") for s in samples]
    inside = np.mean([f.low <= np.log(2) <= f.high for f in found])
    assert 0.94 < inside < 0.985  # at least 95 %, discrete ranks make it 97 %


def test_few_trials_say_that_they_are_few():
    found = estimate_median(np.array([1.0, np.nan, 3.0]), "kg", "balance", "none")
    assert (found.value, found.low, found.high, found.trials) == (2.0, 1.0, 3.0, 2)
    assert "range of 2 trials" in found.method
    assert estimate_median(NONE, "kg", "balance", "no trial").reason == "no trial"


def test_mass_keeps_the_method_of_the_thesis_beside():
    found = estimate_mass(np.full(9, 0.58), np.full(9, 0.61))
    assert found.value == 0.58
    assert found.by_method["thesis_momentum_balance"].value == 0.61
    lost = estimate_mass(NONE, np.full(9, 0.61))
    assert lost.value is None
    assert lost.reason


def test_damping_prefers_the_limit():
    limit = Estimate(value=4.0, low=3.2, high=4.8, unit="Ns/m", method="limit", trials=8)
    found = estimate_damping(limit, np.full(9, 4.4))
    assert (found.value, found.low, found.high) == (4.0, 3.2, 4.8)
    assert found.by_method["momentum_balance"].value == 4.4
    missing = Estimate(value=None, unit="Ns/m", method="limit", reason="no usable trial at K = 0")
    assert estimate_damping(missing, np.full(9, 4.4)).value == 4.4
    neither = estimate_damping(missing, NONE)
    assert neither.value is None
    assert "K = 0" in neither.reason


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
