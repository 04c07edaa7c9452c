"""Areas that stable regions share: triangles and rectangles by hand, and properties that hold for any region."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.errors import ParameterError
from pipeline.comparison.scores.agreement import Stretches, measured_limits, overlap
from pipeline.records.findings import BoundaryPoint

EXACT = 1e-12  # areas of order one or relative: a few sums in doubles


def up_to(*limits: float) -> Stretches:
    return Stretches.up_to(np.array(limits))


def test_triangle_inside_a_rectangle():
    # rectangle of 4 x 10, triangle with its top of 10 in the middle: half of it
    found = overlap(np.array([0.0, 2.0, 4.0]), up_to(0, 10, 0), up_to(10, 10, 10))
    assert (found.first, found.second, found.shared) == pytest.approx((20, 40, 20), rel=EXACT)
    assert found.union == pytest.approx(40, rel=EXACT)


def test_triangles_that_cross_between_two_dampings():
    # K = 6 B/3 and K = 6 - 6 B/3 on [0, 3]: each 9, they cross at B = 1.5 with K = 3 and share 4.5
    found = overlap(np.array([0.0, 3.0]), up_to(0, 6), up_to(6, 0))
    assert (found.first, found.second, found.shared) == pytest.approx((9, 9, 4.5), rel=EXACT)


def test_shifted_triangles():
    # tops of 2 at B = 1 and B = 2, feet one damping away on either side: they share a triangle of base 1 and height 1
    found = overlap(np.arange(4.0), up_to(0, 2, 0, 0), up_to(0, 0, 2, 0))
    assert (found.first, found.second, found.shared) == pytest.approx((2, 2, 0.5), rel=EXACT)


def test_region_with_a_gap_in_stiffness():
    # stable from 0 to 1 and from 3 to 5 at all dampings, against stable up to 4
    layers = Stretches(np.array([[0.0, 0.0], [3.0, 3.0]]), np.array([[1.0, 1.0], [5.0, 5.0]]))
    found = overlap(np.array([0.0, 2.0]), up_to(4, 4), layers)
    assert (found.first, found.second, found.shared) == pytest.approx((8, 6, 4), rel=EXACT)


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


limits = st.lists(st.floats(0, 1e5, allow_subnormal=False), min_size=6, max_size=6)
steps = st.lists(st.floats(0.1, 50), min_size=6, max_size=6)


@given(limits, limits, steps)
def test_overlap_is_symmetric_and_between_zero_and_one(a, b, step):
    B = np.cumsum(step)
    one, other = overlap(B, up_to(*a), up_to(*b)), overlap(B, up_to(*b), up_to(*a))
    scale = max(one.union, 1e-300)
    assert one.shared == pytest.approx(other.shared, abs=EXACT * scale)
    assert one.union == pytest.approx(other.union, abs=EXACT * scale)
    assert -EXACT * scale <= one.shared <= one.union * (1 + EXACT)
    assert (one.first, one.second) == (other.second, other.first)


@given(limits, limits, steps)
def test_area_ratio_is_inverted_by_a_swap(a, b, step):
    a, b = [x + 1 for x in a], [x + 1 for x in b]
    B = np.cumsum(step)
    one, other = overlap(B, up_to(*a), up_to(*b)), overlap(B, up_to(*b), up_to(*a))
    assert (one.first / one.second) * (other.first / other.second) == pytest.approx(1, rel=EXACT)


@given(limits, limits, steps)
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
