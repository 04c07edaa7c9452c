"""The ways to the limits that the planner is held against, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.plan.course import Wish, wanted_dampings
from pipeline.records.accuracy import Rung
from pipeline.studies.planning.best_cost import look_for_best
from pipeline.studies.planning.rig import Rig
from pipeline.studies.planning.rungs import QUANTITY, planning_rungs, saving
from pipeline.studies.planning.searches import Known, as_in_the_thesis, at_random, bisected, error_of

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
    dampings = wanted_dampings(rig.course(), Wish())[:3]
    ends = rig.truth(dampings)
    largest = float(ends[0].max())
    *_, last = bisected(rig, dampings, largest, 0.02)
    few, many = at_random(rig, dampings, largest, (6, 300))
    assert last.trials % 3 == 0
    assert error_of(last, ends) < 0.02
    assert error_of(many, ends) < error_of(few, ends)


def test_saving_names_what_others_take() -> None:
    def rung(method: str, setting: str, trials: int, error: float) -> Rung:
        name = f"{QUANTITY}, ideal device"
        return Rung(quantity=name, method=method, setting=setting, error=error, seconds=1.0, trials=trials)

    rungs = [
        rung("planner", "done", 25, 0.01),
        rung("bisection", "step 5", 60, 0.03),
        rung("bisection", "step 6", 72, 0.0),
    ]
    (text,) = saving([*rungs, rung("random walls", "step 1", 384, 0.2)])
    assert "takes 25 trials, bisection 72, random walls more than 384" in text


@pytest.mark.slow
def test_the_planner_is_done_before_all_others() -> None:
    rungs = list(planning_rungs(quick=True))
    assert {r.method for r in rungs} == {"planner", "bisection", "random walls", "thesis's procedure"}
    done = next(r for r in rungs if r.setting == "done")
    assert done.error is not None
    assert done.error <= 0.02
    assert all((r.trials or 0) > (done.trials or 0) for r in rungs if r.method != "planner" and (r.error or 1) <= 0.02)
    assert "the planner takes" in saving(rungs)[0]


@pytest.mark.slow
def test_the_best_settling_time_is_found_in_few_trials() -> None:
    found = look_for_best(Rig("ideal", 1))
    assert found.done
    assert found.trials <= 20
    assert found.above <= 0.05
