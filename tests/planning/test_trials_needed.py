"""The ways to the limits that the planner is held against, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest
from rigs import Known, Rig, as_in_the_thesis, at_random, bisected, error_of, look_for_best, planned

from pipeline.planning.campaign import PlanOptions, wanted_dampings

LOW, HIGH = np.array([1000.0, 8000.0, 0.0]), np.array([1100.0, 8100.0, 100.0])


def test_errors_count_from_the_ends_of_the_truth() -> None:
    def off(*limit: float) -> float:
        return error_of(Known(1, np.array(limit)), (LOW, HIGH))

    assert off(1050, 8050, 50) == 0
    assert off(1050, 8260, 50) == pytest.approx(0.02)
    assert off(1050, np.nan, 50) == 0, "what is not told is not wrong"
    assert np.isnan(off(np.nan, np.nan, np.nan))


def test_the_thesis_takes_all_walls_up_to_the_limit() -> None:
    own, coarse = as_in_the_thesis(LOW, HIGH, (1, 8))
    assert own.trials >= 8000 / 200
    assert coarse.trials < own.trials / 3
    assert error_of(own, (LOW, HIGH)) == 0.0, "its fine steps are 40 N/m"
    assert 0.0 < error_of(coarse, (LOW, HIGH)) <= 0.04, "and 320 N/m, eight times as long"


def test_bisection_and_random_walls_reach_the_limits_of_a_rig() -> None:
    rig = Rig("ideal", 0)
    dampings = wanted_dampings(rig.campaign(), PlanOptions())[:3]
    ends = rig.truth(dampings)
    largest = float(ends[0].max())
    *_, last = bisected(rig, dampings, largest, 0.02)
    few, many = at_random(rig, dampings, largest, (6, 300))
    assert last.trials % 3 == 0
    assert error_of(last, ends) < 0.02
    assert error_of(many, ends) < error_of(few, ends)


@pytest.mark.slow
def test_the_planner_is_done_before_all_others() -> None:
    rig = Rig("ideal", 0)
    dampings = wanted_dampings(rig.campaign(), PlanOptions())
    ends = rig.truth(dampings)
    largest = float(ends[0].max())
    *_, own = planned(rig, PlanOptions())
    assert own.done
    assert error_of(own, ends) <= PlanOptions().accuracy
    others = [
        *bisected(rig, dampings, largest, 0.01),
        *at_random(rig, dampings, largest, (12, 24, 48, 96, 192, 384)),
        *as_in_the_thesis(*ends, (8, 4, 2, 1)),
    ]
    good = [other for other in others if error_of(other, ends) <= PlanOptions().accuracy]
    assert good
    assert all(other.trials > own.trials for other in good)


@pytest.mark.slow
def test_the_best_settling_time_is_found_in_few_trials() -> None:
    found = look_for_best(Rig("ideal", 1))
    assert found.done
    assert found.trials <= 20
    assert found.above <= 0.05
