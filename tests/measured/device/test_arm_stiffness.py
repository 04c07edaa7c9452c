from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from pipeline.measured.device.arm_stiffness import by_limit
from pipeline.measured.experiment.estimates import stiffness_estimate
from pipeline.measured.signal.verdict import judge
from pipeline.records.batch import TrialBatch

T = 1e-3


def held(K, B, *, k, mass=1.0, b=34.0, delay=4, step=2.0, rows=1000, baseline=20, travel=0.05, quantum=0.0, noise=0.0):
    """Step responses of a device in an arm of stiffness k, at any sign of K, stepped by the matrix exponential."""
    random = np.random.default_rng(3)
    block = np.zeros((3, 3))
    block[0, 1], block[1] = 1.0, (-k / mass, -b / mass, 1 / mass)
    moved = expm(block * T)
    state = np.zeros((2, len(K)))
    position, command = np.full((len(K), rows), np.nan), np.full((len(K), rows), np.nan)
    last = np.full(len(K), rows)
    for i in range(rows):
        seen = state[0] + noise * random.standard_normal(len(K))
        position[:, i] = np.round(seen / quantum) * quantum if quantum else seen
        change = position[:, i] - position[:, max(i - 1, 0)]
        command[:, i] = step * (i >= baseline) - K * (position[:, i] - position[:, 0]) - B * change / T
        force = command[:, i - delay] if i >= delay else np.zeros(len(K))
        state = moved[:2, :2] @ state + np.outer(moved[:2, 2], force)
        last = np.where((np.abs(state[0]) > travel) & (last == rows), i + 1, last)
    valid = np.arange(rows) < last[:, None]
    time = np.broadcast_to(np.arange(rows) * T, position.shape)
    return TrialBatch(
        tuple(f"t{i}" for i in range(len(K))), K, B, np.full(len(K), step), np.full(len(K), T), last,
        *(np.where(valid, a, np.nan) for a in (time, command, position)),
    )  # fmt: skip


LEVELS = -np.array([0.0, 50, 150, 250, 350, 500])


@pytest.mark.parametrize("sensor", [{}, {"quantum": 2e-6, "noise": 5e-7}])
@pytest.mark.parametrize("k", [200.0, 300.0])
def test_arm_stiffness_lies_in_its_bracket_and_near_it(k, sensor):
    K, B = (a.ravel() for a in np.meshgrid(LEVELS, [10.0, 30.0]))
    growth = judge(held(K, B, k=k, **sensor)).growth_per_s
    found = by_limit(K, B, growth)
    assert found.reason is None
    assert found.low <= k <= found.high
    assert found.high - found.low == 100.0
    # the slow pole is not quite linear in K: (k + K) m/(b + B)^2, at most 50/1936, bends it by some 3 % of 50 N/m
    assert found.value == pytest.approx(k, abs=5.0)
    assert found.trials == np.isfinite(growth).sum()


@pytest.mark.parametrize("k", [0.0, 20.0])
def test_a_small_stiffness_is_extrapolated_to_between_0_and_the_first_unstable_trial(k):
    K, B = LEVELS, np.full(len(LEVELS), 30.0)
    found = by_limit(K, B, judge(held(K, B, k=k)).growth_per_s)
    assert (found.low, found.high) == (0.0, 50.0)
    # the same bend as above, now over the 50 to 150 N/m of the two trials used: (k + K) m/(b + B)^2 of it
    assert found.value == pytest.approx(k, abs=0.04 * 100)


def test_one_trial_on_either_side_of_0_gives_a_bracket_and_no_value():
    found = by_limit(np.array([0.0, -50.0]), np.full(2, 30.0), np.array([-3.0, 1.0]))
    assert (found.value, found.low, found.high) == (None, 0.0, 50.0)
    assert "between 0 and 50" in found.reason


def test_the_narrowest_bracket_counts():
    K = np.array([-100.0, -300.0, -150.0, -200.0])
    found = by_limit(K, np.array([10.0, 10.0, 30.0, 30.0]), np.array([-1.0, 1.0, -1.0, 3.0]))
    assert (found.low, found.high) == (150.0, 200.0)
    assert found.method.endswith("B = 30")
    assert found.value == pytest.approx(162.5)


def test_reasons():
    one = np.ones(3)
    assert "K < 0" in by_limit(np.array([0.0, 100.0, 200.0]), one, -one).reason
    assert "unstable side" in by_limit(np.array([-1.0, -2.0, -3.0]), one, one).reason
    assert "stable side" in by_limit(np.array([-1.0, -2.0, -3.0]), one, -one).reason
    folded = by_limit(np.array([-1.0, -2.0, -3.0]), one, np.array([1.0, -1.0, 1.0]))
    assert folded.value is None
    assert "one side" in folded.reason
    assert by_limit(-one, one, one * np.nan).trials == 0


class Stored:
    """An experiment whose trials went below K = 0, and whose balances tell nothing."""

    rotation, sampling_period_s = False, T

    def __init__(self, K):
        self.K = K

    def column(self, stage, name):
        held_by_200 = np.where(self.K > -200.0, -1.0, 1.0)
        return {"stiffness": self.K, "damping": np.full(len(self.K), 30.0), "growth_per_s": held_by_200}[name]

    def texts(self, stage, name):
        return ["too short"]

    def once(self, function):
        return None


def test_the_limit_is_a_method_of_the_stiffness_where_k_below_0_was_tested():
    found = stiffness_estimate(Stored(LEVELS))
    assert found.low <= 200 <= found.high
    assert found.value == found.by_method["stability_limit"].value
    assert found.by_method["joint_balance"].reason.startswith("no trial allows a balance")
    assert stiffness_estimate(Stored(-LEVELS)).by_method == {}
