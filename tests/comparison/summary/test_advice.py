"""Walls to use: stable, calm trials far from the limit, also where no cost tells the best."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.comparison.scores.agreement import measured_limits
from pipeline.comparison.summary.advice import CALM, FAR, FEWEST, recommended, region_to_use, room_at
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.findings import Optimum
from pipeline.records.results import STIFFEST


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
    assert 0.9 * use.stiffness_low <= 4469 <= use.stiffness_high
    known = measured_limits(result.boundary)
    inside = (known.damping >= use.damping_low) & (known.damping <= use.damping_high)
    assert use.margin <= known.low[inside].min() / use.stiffness_high + 1e-12
    assert np.nanmax(stages.sure_cost("overshoot")[at]) <= CALM
    point = use.point
    chosen = list(stages.texts("response", "trial_id")).index(point.trial_id)
    assert at[chosen]
    assert (point.stiffness, point.damping) == (K[chosen], B[chosen])
    assert point.costs["settle_2pct"] == stages.sure_cost("settle_2pct")[chosen]


def test_a_limit_that_nothing_bounds_from_below_is_no_margin(falcon, falcon_outcome):
    """The stiffest stable trial there says little: those beside it do not either, if their intervals are wide."""
    result = falcon_outcome.result.experiments[0]
    stages = ExperimentStages.stored(falcon.processed, "falcon", "1")
    half = [p.model_copy(update={"low": p.low and 0.5 * p.low}) for p in result.boundary]
    open_ = [p.model_copy(update={"estimate": None, "low": 0.0}) if i % 2 else p for i, p in enumerate(half)]
    use, _ = region_to_use(result.model_copy(update={"boundary": tuple(open_)}), stages)
    bounded = measured_limits([p for p in open_ if p.low])
    assert use.point.margin <= room_at(bounded, np.array([use.point.damping]))[0] / use.point.stiffness + 1e-12


def hidden(stages, monkeypatch, cost):
    """The stages with another settling time."""
    own = stages.sure_cost
    monkeypatch.setattr(stages, "sure_cost", lambda name: cost if name == "settle_2pct" else own(name))
    return stages


def test_where_no_cost_tells_the_stiffest_walls_far_from_the_limit_are_named(falcon, falcon_outcome, monkeypatch):
    """As with friction: most trials rest elsewhere, so that few have a settling time."""
    result = falcon_outcome.result.experiments[0]
    stages = ExperimentStages.stored(falcon.processed, "falcon", "1")
    cost = np.full(len(stages.sure_cost("settle_2pct")), np.nan)
    use, why = region_to_use(result, hidden(stages, monkeypatch, cost))
    assert "0 of " in why
    assert "settling time" in why
    assert use.criterion == STIFFEST
    assert use.margin >= FAR
    assert use.trials >= FEWEST
    assert use.point.margin >= FAR
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    limits = measured_limits(result.boundary)
    far = (stages.verdicts.verdict == "stable") & (room_at(limits, B) >= FAR * K) & (K > 0)
    far &= ~(stages.sure_cost("overshoot") > CALM)
    assert use.stiffness_high >= K[far].max() / 2
    assert "settle_2pct" not in use.costs


@pytest.mark.parametrize("spoilt", ["disturbed", "without costs"])
def test_the_wall_to_set_has_a_clean_trial_with_costs(falcon, falcon_outcome, monkeypatch, spoilt):
    """Where settling times are missing, the stiffest walls are named: not one whose own trial was bumped."""
    result = falcon_outcome.result.experiments[0]
    stages = ExperimentStages.stored(falcon.processed, "falcon", "1")
    hidden(stages, monkeypatch, np.full(len(stages.sure_cost("settle_2pct")), np.nan))
    ids, chosen = stages.texts("response", "trial_id"), []
    own, texts = stages.sure_cost, stages.texts
    for _ in range(3):
        chosen.append(region_to_use(result, stages)[0].point.trial_id)
        off = np.isin(ids, chosen)
        if spoilt == "disturbed":
            ended = np.where(off, "disturbed", texts("outcome", "outcome")).tolist()
            monkeypatch.setattr(stages, "texts", lambda s, n, e=ended: e if n == "outcome" else texts(s, n))
        else:
            monkeypatch.setattr(stages, "sure_cost", lambda name, off=off: np.where(off, np.nan, own(name)))
    assert len(set(chosen)) == 3


@pytest.mark.slow
def test_a_log_that_rests_where_friction_holds_it_is_no_disturbed_one(sticky, sticky_outcome, monkeypatch):
    """Half of the logs rest elsewhere than at x_0 + F_0/K: friction of 0.9 N and stiction of 1.65 N hold them there."""
    (result,) = sticky_outcome.result.experiments
    assert result.outcomes["disturbed"] > 0.3 * result.trials
    stages = sticky.stages("1")
    ids, texts, K = stages.texts("response", "trial_id"), stages.texts, stages.column("response", "stiffness")
    at = ids.index(result.use.point.trial_id)
    apart = stages.column("response", "position_final_measured") - stages.column("response", "position_final_expected")
    assert abs(apart[at] * K[at]) < 1.65
    assert result.use.point.costs
    # without friction the same rest is that of another force
    estimates = result.estimates | {"friction": result.estimates["friction"].model_copy(update={"low": -0.1})}
    use, _ = region_to_use(result.model_copy(update={"estimates": estimates}), stages)
    assert use is None or texts("outcome", "outcome")[ids.index(use.point.trial_id)] == "settled"
    # nor is a log that has not come to rest, or was pushed, ever the wall to set
    for ended in ("moving", "limit_cycle", "saturated"):
        given = np.where(np.arange(len(ids)) == at, ended, texts("outcome", "outcome")).tolist()
        monkeypatch.setattr(stages, "texts", lambda s, n, e=given: e if n == "outcome" else texts(s, n))
        use, _ = region_to_use(result, stages)
        assert use is None or use.point.trial_id != ids[at]


def test_walls_that_overshoot_far_are_not_named(falcon, falcon_outcome, monkeypatch):
    result = falcon_outcome.result.experiments[0]
    stages = ExperimentStages.stored(falcon.processed, "falcon", "1")
    over = np.full(len(stages.sure_cost("overshoot")), 2 * CALM)
    monkeypatch.setattr(stages, "sure_cost", lambda name: over)
    use, why = region_to_use(result, stages)
    assert use is None
    assert f"fewer than {FEWEST} stable neighbours" in why


def test_no_wall_above_an_undecided_one_is_set(falcon, falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    stages = ExperimentStages.stored(falcon.processed, "falcon", "1")
    first = region_to_use(result, stages)[0].point
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    below = (first.damping == B) & (first.stiffness > K) & (K > 0)
    assert below.any()
    stages.verdicts.verdict[np.flatnonzero(below)[0]] = "undecided"
    second = region_to_use(result, stages)[0].point
    assert (second.damping, second.stiffness) != (first.damping, first.stiffness)
    assert not (second.damping == first.damping and second.stiffness > K[np.flatnonzero(below)[0]])


def test_settling_time_comes_before_energy(falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    points = {c: Optimum(stiffness=1, damping=1, cost=1) for c in ("overshoot", "energy_step_w1", "settle_2pct")}
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "settle_2pct"
    del points["settle_2pct"]
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "energy_step_w1"
    assert recommended(result.model_copy(update={"optimum": {}})) is None
