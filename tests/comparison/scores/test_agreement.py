"""Distances, verdicts and shared areas against numbers by hand, and properties that hold for any region."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.errors import ParameterError
from pipeline.comparison.limits import MeasuredLimits, Stretches, measured_limits, overlap
from pipeline.comparison.scores.agreement import boundary_distance, deviating_span, verdict_agreement
from pipeline.records.findings import BoundaryPoint

NONE = np.zeros(4, dtype=bool)


def limits(measured, damping=None, censored=NONE, open_by=0.0):
    """Measured limits at four dampings, each known to a share ``open_by`` of itself."""
    B = np.arange(4.0) if damping is None else damping
    low, high = (1 - open_by) * measured, (1 + open_by) * measured
    return MeasuredLimits(B, measured, low, high, censored, np.ones(4, dtype=bool))


def test_distance_of_a_boundary_that_is_ten_percent_too_stiff():
    B, theory = np.array([0.0, 10, 20, 30]), np.array([1000.0, 2000, 3000, 2000])
    found = boundary_distance(limits(1.1 * theory, B), theory)
    assert (found.median, found.largest) == pytest.approx((0.1, 0.1), rel=1e-12)
    assert found.rms == pytest.approx(np.sqrt((100**2 + 200**2 + 300**2 + 200**2) / 4), rel=1e-12)
    assert (found.dampings, found.near_zero, found.lower_bounds, found.open) == (4, 0, 0, 0)


def test_largest_distance_keeps_its_sign_and_damping():
    theory = np.full(4, 1000.0)
    found = boundary_distance(limits(np.array([1000.0, 1100, 600, 1300])), theory)
    assert (found.largest, found.largest_damping) == pytest.approx((-0.4, 2.0), rel=1e-12)
    assert found.median == pytest.approx(0.05, rel=1e-12)


def test_nothing_is_divided_by_a_limit_near_zero():
    theory = np.array([10.0, 1000, 1000, -np.inf])
    found = boundary_distance(limits(np.array([200.0, 1000, 1000, 100])), theory)
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
    assert (found.dampings, found.lower_bounds, found.open) == (3, 1, 1)
    assert (found.median, found.largest) == (0.0, 0.5)
    assert boundary_distance(given, np.zeros(4)) is None


def test_verdicts_are_counted_in_four_fields():
    said = np.array(["stable"] * 5 + ["unstable"] * 4 + ["undecided", "stable"])
    K = np.array([1.0] * 10 + [0.0])
    predicted = np.array([True] * 3 + [False] * 2 + [True] + [False] * 3 + [True, True])
    found = verdict_agreement(K, said, predicted)
    assert (found.both_stable, found.only_log_stable, found.only_theory_stable, found.both_unstable) == (3, 2, 1, 3)
    assert (found.undecided, found.without_wall) == (1, 1)
    assert found.agreement == pytest.approx(6 / 9, rel=1e-12)
    assert verdict_agreement(K, np.array(["undecided"] * 11), predicted) is None


EXACT = 1e-12  # areas of order one or relative: a few sums in doubles


def up_to(*limits: float) -> Stretches:
    return Stretches.up_to(np.array(limits))


@pytest.mark.parametrize(
    ("damping", "first", "second", "areas"),
    [
        # a triangle with its top of 10 in the middle of a rectangle of 4 x 10: half of it
        ([0.0, 2, 4], up_to(0, 10, 0), up_to(10, 10, 10), (20, 40, 20)),
        # K = 6 B/3 and K = 6 - 6 B/3 on [0, 3]: each 9, they cross at B = 1.5 with K = 3 and share 4.5
        ([0.0, 3], up_to(0, 6), up_to(6, 0), (9, 9, 4.5)),
        # tops of 2 at B = 1 and 2, feet one damping away on either side: they share a triangle of base 1 and height 1
        ([0.0, 1, 2, 3], up_to(0, 2, 0, 0), up_to(0, 0, 2, 0), (2, 2, 0.5)),
        # stable up to 4, against stable from 0 to 1 and from 3 to 5 at all dampings
        ([0.0, 2], up_to(4, 4), Stretches(np.array([[0.0, 0], [3, 3]]), np.array([[1.0, 1], [5, 5]])), (8, 6, 4)),
    ],
)
def test_areas_of_triangles_rectangles_and_a_region_with_a_gap(damping, first, second, areas):
    found = overlap(np.array(damping), first, second)
    assert (found.first, found.second, found.shared) == pytest.approx(areas, rel=EXACT)
    assert found.union == pytest.approx(areas[0] + areas[1] - areas[2], rel=EXACT)


def test_nothing_counts_above_the_top_of_the_window():
    top = np.array([2.0, 2.0, np.inf])
    found = overlap(np.array([0.0, 1.0, 2.0]), up_to(2, 2, 5), up_to(4, 4, 4), top)
    # up to B = 1 the window ends at 2; beyond, it rises to 5 at B = 2, past theory at B = 1 + 2/3
    assert found.first == pytest.approx(2 + 3.5, rel=EXACT)
    assert found.second == pytest.approx(2 + 3 * 2 / 3 + 4 / 3, rel=EXACT)
    assert found.shared == pytest.approx(found.second, rel=EXACT)


@pytest.mark.parametrize("damping", [[1.0], [0.0, 0.0], [1.0, 0.0]])
def test_dampings_must_increase(damping):
    with pytest.raises(ParameterError, match="increasing"):
        overlap(np.array(damping), up_to(*damping), up_to(*damping))


HEIGHTS = st.lists(st.floats(0, 1e5, allow_subnormal=False), min_size=6, max_size=6)
STEPS = st.lists(st.floats(0.1, 50), min_size=6, max_size=6)


@given(HEIGHTS, HEIGHTS, STEPS)
def test_overlap_is_symmetric_and_between_zero_and_one(a, b, step):
    B = np.cumsum(step)
    one, other = overlap(B, up_to(*a), up_to(*b)), overlap(B, up_to(*b), up_to(*a))
    scale = max(one.union, 1e-300)
    assert one.shared == pytest.approx(other.shared, abs=EXACT * scale)
    assert one.union == pytest.approx(other.union, abs=EXACT * scale)
    assert -EXACT * scale <= one.shared <= one.union * (1 + EXACT)
    # so that the ratio of areas is inverted by a swap
    assert (one.first, one.second) == (other.second, other.first)


@given(HEIGHTS, HEIGHTS, STEPS)
def test_shared_area_is_that_of_a_fine_grid(a, b, step):
    B = np.cumsum(step)
    fine = np.linspace(B[0], B[-1], 20_001)
    lower = np.minimum(np.interp(fine, B, a), np.interp(fine, B, b))
    found = overlap(B, up_to(*a), up_to(*b))
    # kinks at dampings and crossings: one cell of the grid each, of at most the largest limit
    tolerance = 12 * max(*a, *b, 1.0) * (fine[1] - fine[0])
    assert found.shared == pytest.approx(float(np.trapezoid(lower, fine)), abs=tolerance)


def test_limits_of_verdicts_alone_are_the_middle_of_their_bracket():
    points = (
        BoundaryPoint(damping=0, stable=None, unstable=200, censored=False),
        BoundaryPoint(damping=4, stable=1000, unstable=1200, censored=False),
        BoundaryPoint(damping=8, stable=2000, unstable=None, censored=True),
        BoundaryPoint(damping=12, stable=None, unstable=None, censored=True),
    )
    found = measured_limits(points)
    # without a stable trial there is an upper bound, and no limit
    assert found.limit.tolist() == [0, 1100, 2000, 0]
    assert found.low.tolist() == [0, 1000, 2000, 0]
    assert found.high.tolist() == [200, 1200, 2000, 0]
    assert found.censored.tolist() == [False, False, True, True]
    assert found.known.tolist() == [False, True, True, False]


def test_limits_by_growth_rates_come_first():
    point = BoundaryPoint(damping=4, stable=1000, unstable=1200, censored=False, estimate=1010, low=990, high=1030)
    found = measured_limits((point,))
    assert (found.limit[0], found.low[0], found.high[0]) == (1010, 990, 1030)


def flags(text):
    return np.array([mark == "x" for mark in text])


@pytest.mark.parametrize(
    ("text", "span"),
    [
        ("...xxxx", (3.0, None)),
        ("xxxx...", (None, 3.0)),
        ("..xxxx..", (2.0, 5.0)),
        ("..xxx.x", (2.0, None)),
        ("xxxxx", (None, None)),
        ("x..x..x", None),
        (".....xx", None),
        ("xxx....xxx", None),
        (".......", None),
        ("", None),
    ],
)
def test_limits_that_part_from_theory_are_a_range_of_damping_if_they_are_neighbours(text, span):
    found = deviating_span(np.arange(float(len(text))), flags(text))
    assert (None if found is None else (found.low, found.high)) == span


def test_the_range_contains_most_deviating_limits_and_few_others():
    """By a search of all ranges: the surplus of deviating limits is the largest."""
    random = np.random.default_rng(3)
    shares = []
    for _ in range(300):
        deviates = random.random(12) < random.choice([0.1, 0.9], 12, p=[0.5, 0.5])
        deviates = np.sort(deviates) ^ (random.random(12) < 0.1)
        found = deviating_span(np.arange(12.0), deviates)
        surplus = {(i, j): 2 * int(deviates[i : j + 1].sum()) - (j + 1 - i) for i in range(12) for j in range(i, 12)}
        shares.append(found is not None)
        if found is not None:
            first, last = int(found.low or 0), int(11 if found.high is None else found.high)
            assert surplus[first, last] == max(surplus.values())
            assert deviates[first : last + 1].sum() >= 0.8 * deviates.sum()
            assert deviates[first : last + 1].mean() >= 0.8
    assert 0.2 < np.mean(shares) < 0.95, "both cases occur"


def test_a_distance_names_the_dampings_at_which_limits_part():
    damping = np.arange(8.0)
    theory = np.full(8, 1000.0)
    limit = np.where(damping >= 4, 1300.0, 1000.0)
    no = np.zeros(8, dtype=bool)
    limits = MeasuredLimits(damping, limit, limit - 20, limit + 20, no, ~no)
    found = boundary_distance(limits, theory)
    assert (found.above, found.apart.low, found.apart.high) == (4, 4.0, None)
    agreeing = MeasuredLimits(damping, theory, theory - 20, theory + 20, no, ~no)
    assert boundary_distance(agreeing, theory).apart is None
