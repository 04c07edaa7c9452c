"""Walls to use: rectangles against searches of all rectangles, and against trials that they were not chosen by."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.comparison.scores.overlap import MeasuredLimits, measured_limits
from pipeline.comparison.summary.advice import (
    FEWEST,
    GOOD,
    NARROW,
    NEIGHBOURS,
    WallTrials,
    best_rectangle,
    recommended,
    region_to_use,
    use_text,
)
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.findings import Optimum
from pipeline.rendering.labels import UNITS


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
    return WallTrials(k, b, cost(k, b), np.ones(len(k), dtype=bool) if stable is None else stable(k, b))


def bowl(k, b):
    return 20 + 10 * (((k - 2000) / 600) ** 2 + ((b - 25) / 10) ** 2)


FLAT = limits(np.arange(0.0, 50, 5), np.full(10, 4000.0))


def test_a_rectangle_lies_around_the_least_cost_and_no_side_can_be_moved_out():
    tested = course(bowl)
    region, reason = best_rectangle(tested, FLAT)
    assert reason == ""
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
    region, _ = best_rectangle(course(bowl), limits(FLAT.damping, FLAT.limit, low))
    assert region[1] * NARROW <= (1500 if region[2] <= 30 <= region[3] else 4000)
    fast, _ = best_rectangle(course(lambda k, b: 1e5 / k), FLAT)  # the stiffer the better
    assert fast[1] <= 4000 / NARROW


def test_no_unstable_or_undecided_trial_lies_inside():
    region, _ = best_rectangle(course(bowl, stable=lambda k, b: ~((k == 2200) & (b == 25))), FLAT)
    assert not (region[0] <= 2200 <= region[1] and region[2] <= 25 <= region[3])


def test_one_lucky_trial_is_not_where_the_walls_are():
    def lucky(k, b):
        return np.where((k == 800) & (b == 5), 4.0, bowl(k, b))

    assert best_rectangle(course(lucky), FLAT)[0] == best_rectangle(course(bowl), FLAT)[0]


def test_narrow_valleys_are_given_more_room_and_what_has_none_a_reason():
    narrow, _ = best_rectangle(course(lambda k, b: 20 + np.abs(k - 2000) / 10 + 10 * np.abs(b - 25)), FLAT)
    assert narrow is not None
    few = course(bowl, stiffness=np.array([2000.0]), damping=np.array([20.0, 25, 30]))
    assert best_rectangle(few, FLAT)[1].startswith("3 stable trials with this cost keep a margin of 1.25")
    none = MeasuredLimits(*(np.zeros(1),) * 4, np.zeros(1, dtype=bool), np.zeros(1, dtype=bool))
    assert best_rectangle(few, none) == (None, "no stability limit is known")


@pytest.mark.parametrize("seed", range(4))
def test_a_further_trial_lies_in_the_range_as_often_as_is_said(seed):
    """Scatter of single trials, drawn anew at the same walls: (n - 1)/(n + 1) of the new costs lie inside."""
    random = np.random.default_rng(900 + seed)
    held, expected = [], []
    for _ in range(60):
        tested = course(lambda k, b: bowl(k, b) * np.exp(0.15 * random.standard_normal(len(k))))
        region, _ = best_rectangle(tested, FLAT)
        at = tested.inside(region)
        seen, n = tested.cost[at], int(at.sum())
        new = bowl(tested.stiffness[at], tested.damping[at]) * np.exp(0.15 * random.standard_normal(n))
        held.append(np.mean((new >= seen.min()) & (new <= seen.max())))
        expected.append((n - 1) / (n + 1))
    # what neighbours share of each other's levels is left
    assert np.mean(held) == pytest.approx(np.mean(expected), abs=0.06)


def test_walls_of_a_course_are_stable_in_theory_and_their_costs_those_of_its_trials(falcon, falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    use = result.use
    stages = ExperimentStages.stored(falcon.processed, "falcon", "1")
    assert region_to_use(result, stages)[0] == use
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    at = (use.stiffness_low <= K) & (use.stiffness_high >= K) & (use.damping_low <= B) & (use.damping_high >= B)
    assert at.sum() == use.trials >= FEWEST
    assert set(stages.verdicts.verdict[at]) == {"stable"}
    cost = stages.sure_cost("settle_2pct")[at]
    found = use.costs["settle_2pct"]
    assert (found.median, found.low, found.high) == (np.median(cost), cost.min(), cost.max())
    # theory for d = 4, m = 0.58 has its optimum at K = 4469, B = 73 (Table D.1)
    assert use.stiffness_low <= 4469 <= use.stiffness_high
    known = measured_limits(result.boundary)
    inside = (known.damping >= use.damping_low) & (known.damping <= use.damping_high)
    assert use.margin <= known.low[inside].min() / use.stiffness_high + 1e-12
    text = use_text(result, UNITS["translation"])
    assert f"as in the {use.trials} trials there" in text
    assert text.startswith(f"Use K = {use.stiffness_low:g} to {use.stiffness_high:g} N/m")
    assert use_text(result.model_copy(update={"use": None}), UNITS["translation"]) == ""


def test_settling_time_comes_before_energy(falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    points = {c: Optimum(stiffness=1, damping=1, cost=1) for c in ("overshoot", "energy_step_w1", "settle_2pct")}
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "settle_2pct"
    del points["settle_2pct"]
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "energy_step_w1"
    assert recommended(result.model_copy(update={"optimum": {}})) is None
