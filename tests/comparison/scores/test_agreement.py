"""Distances and verdicts against numbers by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.comparison.scores.agreement import MeasuredLimits, boundary_distance, verdict_agreement

NONE = np.zeros(4, dtype=bool)


def limits(measured, damping=None, censored=NONE, open_by=0.0):
    """Measured limits at four dampings, each known to a share ``open_by`` of itself."""
    B = np.arange(4.0) if damping is None else damping
    low, high = (1 - open_by) * measured, (1 + open_by) * measured
    return MeasuredLimits(B, measured, low, high, censored, np.ones(4, dtype=bool))


def test_distance_of_a_boundary_that_is_ten_percent_too_stiff():
    B, theory = np.array([0.0, 10, 20, 30]), np.array([1000.0, 2000, 3000, 2000])
    found = boundary_distance(limits(1.1 * theory, B), theory)
    assert found is not None
    assert (found.median, found.largest) == pytest.approx((0.1, 0.1), rel=1e-12)
    assert found.rms == pytest.approx(np.sqrt((100**2 + 200**2 + 300**2 + 200**2) / 4), rel=1e-12)
    assert (found.dampings, found.near_zero, found.lower_bounds, found.open) == (4, 0, 0, 0)


def test_largest_distance_keeps_its_sign_and_damping():
    theory = np.full(4, 1000.0)
    found = boundary_distance(limits(np.array([1000.0, 1100, 600, 1300])), theory)
    assert found is not None
    assert (found.largest, found.largest_damping) == pytest.approx((-0.4, 2.0), rel=1e-12)
    assert found.median == pytest.approx(0.05, rel=1e-12)


def test_nothing_is_divided_by_a_limit_near_zero():
    theory = np.array([10.0, 1000, 1000, -np.inf])
    found = boundary_distance(limits(np.array([200.0, 1000, 1000, 100])), theory)
    assert found is not None
    assert (found.dampings, found.near_zero, found.largest) == (2, 2, 0.0)
    assert found.rms == pytest.approx(np.sqrt((190**2 + 100**2) / 4), rel=1e-12)


def test_limits_agree_that_meet_theory_by_their_intervals_or_nearly():
    theory = np.full(4, 1000.0)
    measured = np.array([1000.0, 1015, 1100, 900])
    assert boundary_distance(limits(measured), theory).agreeing == 2
    assert boundary_distance(limits(measured, open_by=0.11), theory).agreeing == 4
    # a lower bound above theory disagrees, one below it says nothing
    censored = np.array([False, False, True, True])
    assert boundary_distance(limits(measured, censored=censored), theory).agreeing == 2


def test_a_limit_without_a_lower_bound_agrees_with_nothing_and_is_not_the_farthest():
    """An interval from zero on holds any theory, and its middle may lie anywhere."""
    theory, measured = np.full(4, 1000.0), np.array([1000.0, 1300, 2000, 1300])
    open_below = MeasuredLimits(
        np.arange(4.0), measured, np.array([900.0, 1250, 0, 1250]), 1.1 * measured, NONE, np.ones(4, dtype=bool)
    )
    found = boundary_distance(open_below, theory)
    assert (found.dampings, found.bounded, found.agreeing, found.above) == (4, 3, 1, 2)
    assert (found.largest, found.largest_damping) == pytest.approx((0.3, 1.0))
    none = boundary_distance(limits(measured, open_by=1.0), theory)
    assert (none.bounded, none.agreeing, none.largest) == (0, 0, 1.0)


def test_lower_bounds_count_only_above_theory():
    theory = np.full(4, 1000.0)
    measured = np.array([1000.0, 1000, 1500, 500])
    given = limits(measured, censored=np.array([False, False, True, True]))
    found = boundary_distance(given, theory)
    assert found is not None
    assert (found.dampings, found.lower_bounds, found.open) == (3, 1, 1)
    assert (found.median, found.largest) == (0.0, 0.5)
    assert boundary_distance(given, np.zeros(4)) is None


def test_verdicts_are_counted_in_four_fields():
    said = np.array(["stable"] * 5 + ["unstable"] * 4 + ["undecided", "stable"])
    K = np.array([1.0] * 10 + [0.0])
    predicted = np.array([True] * 3 + [False] * 2 + [True] + [False] * 3 + [True, True])
    found = verdict_agreement(K, said, predicted)
    assert found is not None
    assert (found.both_stable, found.only_log_stable, found.only_theory_stable, found.both_unstable) == (3, 2, 1, 3)
    assert (found.undecided, found.without_wall) == (1, 1)
    assert found.agreement == pytest.approx(6 / 9, rel=1e-12)
    assert verdict_agreement(K, np.array(["undecided"] * 11), predicted) is None
