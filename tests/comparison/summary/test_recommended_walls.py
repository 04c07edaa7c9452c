"""Walls to use: stable, calm trials far from the limit; rectangles against searches of all, and other trials."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.comparison.limits import MeasuredLimits, measured_limits
from pipeline.comparison.summary.recommended_walls import (
    CALM,
    FAR,
    FEWEST,
    GOOD,
    NEIGHBOURS,
    WallTrials,
    best_rectangle,
    levels,
    recommended,
    region_to_use,
    room_at,
)
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.findings import NARROW, Optimum
from pipeline.records.results import STIFFEST


@pytest.fixture
def course_1(falcon, falcon_outcome):
    """Result and stages of the ideal course; the latter may be changed."""
    return falcon_outcome.result.experiments[0], ExperimentStages.stored(falcon.processed, "falcon", "1")


def test_walls_of_a_course_are_stable_in_theory_and_their_costs_those_of_its_trials(course_1):
    result, stages = course_1
    use = result.use
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


def test_a_limit_that_nothing_bounds_from_below_is_no_margin(course_1):
    """The stiffest stable trial there says little: those beside it do not either, if their intervals are wide."""
    result, stages = course_1
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


def test_where_no_cost_tells_the_stiffest_walls_far_from_the_limit_are_named(course_1, monkeypatch):
    """As with friction: most trials rest elsewhere, so that few have a settling time."""
    result, stages = course_1
    cost = np.full(len(stages.sure_cost("settle_2pct")), np.nan)
    use, why = region_to_use(result, hidden(stages, monkeypatch, cost))
    assert why.startswith("stiffness: only 0 of ")
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
def test_the_wall_to_set_has_a_clean_trial_with_costs(course_1, monkeypatch, spoilt):
    """Where settling times are missing, the stiffest walls are named: not one whose own trial was bumped."""
    result, stages = course_1
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


def test_a_single_undisturbed_wall_is_recommended_alone_if_its_neighbours_are_stable(course_1, monkeypatch):
    """As with much friction: one log comes to rest at its target, all others are disturbed."""
    result, stages = course_1
    at = stages.texts("response", "trial_id").index(region_to_use(result, stages)[0].point.trial_id)
    alone = np.arange(len(stages.verdicts.verdict)) == at
    hidden(stages, monkeypatch, np.where(alone, 40.0, np.nan))
    texts = stages.texts
    ended = np.where(alone, "settled", "disturbed").tolist()
    monkeypatch.setattr(stages, "texts", lambda s, n: ended if n == "outcome" else texts(s, n))
    use, why = region_to_use(result, stages)
    assert (use.trials, use.point.trial_id, use.point.costs["settle_2pct"]) == (
        1,
        texts("response", "trial_id")[at],
        40,
    )
    assert why.startswith("the cost of its trial alone: only 1 of ")
    assert use.point.margin >= NARROW
    # a harder push needs the same margin
    linear = dict.fromkeys(stages.column("response", "damping").tolist(), 0.99 * NARROW * use.point.stiffness)
    assert region_to_use(result, stages, linear)[0] is None
    linear = {damping: 1.02 * limit for damping, limit in linear.items()}
    assert region_to_use(result, stages, linear)[0].point.margin_large_motion == pytest.approx(1.0098 * NARROW)
    # stable walls around it are what makes it more than luck
    stages.verdicts.verdict[~alone] = "undecided"
    assert region_to_use(result, stages)[0] is None


def test_the_trial_of_the_least_cost_is_named_with_the_reason_against_it(course_1, monkeypatch):
    result, stages = course_1
    use = region_to_use(result, stages)[0]
    cost, ids = stages.sure_cost("settle_2pct").copy(), stages.texts("response", "trial_id")
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    room = room_at(measured_limits(result.boundary), B) / np.where(K > 0, K, np.inf)
    inside = (use.stiffness_low <= K) & (use.stiffness_high >= K) & (use.damping_low <= B) & (use.damping_high >= B)
    far = (stages.verdicts.verdict == "stable") & (K > 0) & ~inside & ~(stages.sure_cost("overshoot") > CALM)
    for at, why in (
        (np.flatnonzero(far & (room > 2) & (0.5 * use.stiffness_low > K))[0], "its neighbours cost more"),
        (np.flatnonzero(far & (room < NARROW))[0], "its limit may be at "),
    ):
        lucky = np.where(np.arange(len(K)) == at, 1.0, cost)
        best = Optimum(stiffness=K[at], damping=B[at], cost=1.0, trial_id=ids[at])
        of = result.model_copy(update={"optimum": result.optimum | {"settle_2pct": best}})
        with monkeypatch.context() as patch:
            better = region_to_use(of, hidden(stages, patch, lucky))[0].point.better
        assert better.startswith(f"1 samples at K = {K[at]:.0f}, B = {B[at]:g}: ")
        assert why in better


@pytest.mark.slow
def test_a_log_that_rests_where_friction_holds_it_is_no_disturbed_one(sticky, sticky_outcome, monkeypatch):
    """Half of the logs rest elsewhere than at x_0 + F_0/K: friction of 0.9 N and stiction of 1.65 N hold them there.

    They make a region, but none of them is the wall to set.
    """
    (result,) = sticky_outcome.result.experiments
    assert result.outcomes["disturbed"] > 0.3 * result.trials
    stages = sticky.stages("1")
    ids, texts = stages.texts("response", "trial_id"), stages.texts
    at = ids.index(result.use.point.trial_id)
    assert texts("outcome", "outcome")[at] == "settled"
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


def test_walls_that_overshoot_far_are_not_named(course_1, monkeypatch):
    result, stages = course_1
    over = np.full(len(stages.sure_cost("overshoot")), 2 * CALM)
    monkeypatch.setattr(stages, "sure_cost", lambda name: over)
    use, why = region_to_use(result, stages)
    assert use is None
    assert (
        f"a wall needs {FEWEST} stable trials around it, at half the limit or below; there is none. Record K = " in why
    )
    assert why.startswith("no 5 neighbours have a low settling time")


def test_no_wall_above_an_undecided_one_is_set(course_1):
    result, stages = course_1
    first = region_to_use(result, stages)[0].point
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    below = (first.damping == B) & (first.stiffness > K) & (K > 0)
    assert below.any()
    stages.verdicts.verdict[np.flatnonzero(below)[0]] = "undecided"
    second = region_to_use(result, stages)[0].point
    assert (second.damping, second.stiffness) != (first.damping, first.stiffness)
    assert not (second.damping == first.damping and second.stiffness > K[np.flatnonzero(below)[0]])


def test_settling_time_comes_before_energy(course_1):
    result, _ = course_1
    points = {c: Optimum(stiffness=1, damping=1, cost=1) for c in ("overshoot", "energy_step_w1", "settle_2pct")}
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "settle_2pct"
    del points["settle_2pct"]
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "energy_step_w1"
    assert recommended(result.model_copy(update={"optimum": {}})) is None


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
    usable = np.ones(len(k), dtype=bool) if stable is None else stable(k, b)
    return WallTrials(k, b, cost(k, b), levels(k, b, cost(k, b), usable), usable, usable)


def bowl(k, b):
    return 20 + 10 * (((k - 2000) / 600) ** 2 + ((b - 25) / 10) ** 2)


FLAT = limits(np.arange(0.0, 50, 5), np.full(10, 4000.0))


def test_a_rectangle_lies_around_the_least_cost_and_no_side_can_be_moved_out():
    tested = course(bowl)
    region = best_rectangle(tested, FLAT, NARROW)
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
    region = best_rectangle(course(bowl), limits(FLAT.damping, FLAT.limit, low), NARROW)
    assert region[1] * NARROW <= (1500 if region[2] <= 30 <= region[3] else 4000)
    fast = best_rectangle(course(lambda k, b: 1e5 / k), FLAT, NARROW)  # the stiffer the better
    assert fast[1] <= 4000 / NARROW


def test_no_unstable_or_undecided_trial_lies_inside():
    region = best_rectangle(course(bowl, stable=lambda k, b: ~((k == 2200) & (b == 25))), FLAT, NARROW)
    assert not (region[0] <= 2200 <= region[1] and region[2] <= 25 <= region[3])


def test_one_lucky_trial_is_not_where_the_walls_are():
    def lucky(k, b):
        return np.where((k == 800) & (b == 5), 4.0, bowl(k, b))

    assert best_rectangle(course(lucky), FLAT, NARROW) == best_rectangle(course(bowl), FLAT, NARROW)


def test_narrow_valleys_are_given_more_room_and_few_trials_are_none():
    narrow = best_rectangle(course(lambda k, b: 20 + np.abs(k - 2000) / 10 + 10 * np.abs(b - 25)), FLAT, NARROW)
    assert narrow is not None
    few = course(bowl, stiffness=np.array([2000.0]), damping=np.array([20.0, 25, 30]))
    assert best_rectangle(few, FLAT, NARROW) is None
    none = MeasuredLimits(*(np.zeros(1),) * 4, np.zeros(1, dtype=bool), np.zeros(1, dtype=bool))
    assert best_rectangle(few, none, NARROW) is None
    assert room_at(none, np.array([1.0, 2.0])).tolist() == [0, 0]


def test_a_valley_along_the_damping_is_followed_where_the_steps_of_stiffness_are_coarse():
    """As lwr with 5 samples of delay: a first step along the stiffness, as good at first, ends in four trials."""

    def valley(k, b):
        return 50 + 40 * np.abs(np.log2(k / 1200)) + np.where(k == 1200, 0.5, 4.0) * np.abs(b - 20)

    tested = course(valley, stiffness=np.array([400.0, 800, 1200, 1600, 2000]), damping=np.arange(10.0, 34, 2))
    flat = limits(np.arange(0.0, 50, 5), np.full(10, 2200.0))
    region = best_rectangle(tested, flat, NARROW)
    assert tested.inside(region).sum() >= FEWEST
    assert region[0] <= 1200 <= region[1]
    assert region[3] - region[2] >= 6


def test_the_wall_to_set_is_neither_the_lucky_trial_nor_beside_good_ones_only():
    cost = np.array([10.0, 50, 30, 31, 40])
    level = np.array([45.0, 20, 32, 31, 41])
    tested = WallTrials(np.full(5, 1000.0), np.arange(5.0), cost, level, *[np.ones(5, dtype=bool)] * 2)
    room = np.full(5, 4000.0)
    calm = np.zeros(5)
    assert tested.favoured((1000, 1000, 0, 4), room, calm) == 3
    alike = WallTrials(tested.stiffness, tested.damping, np.ones(5), np.ones(5), tested.usable, tested.usable)
    assert alike.favoured((1000, 1000, 0, 4), np.array([2000.0, 3000, 9000, 4000, 1]), calm) == 2


def test_the_wall_to_set_is_neither_at_an_end_of_its_region_nor_one_that_overshoots_most():
    """As lwr with 8 samples of delay: the wall of least damping overshot by 24 %, and its neighbour cost less."""
    k, b = np.full(5, 400.0), np.arange(10.0, 20, 2)
    cost, over = np.array([50.0, 60, 70, 80, 90]), np.array([0.24, 0.1, 0.05, 0.0, 0.0])
    tested = WallTrials(k, b, cost, cost, *[np.ones(5, dtype=bool)] * 2)
    assert tested.favoured((400, 400, 10, 18), np.full(5, 900.0), over) == 2
    # without a wall between others, overshoot and cost decide
    assert tested.favoured((400, 400, 10, 12), np.full(5, 900.0), over) == 1
    # a criterion without overshoot decides by its cost
    assert tested.favoured((400, 400, 10, 18), np.full(5, 900.0), np.full(5, np.nan)) == 1


def test_an_unknown_overshoot_is_not_taken_for_none():
    k, b = np.full(5, 400.0), np.arange(10.0, 20, 2)
    cost = np.array([50.0, 60, 70, 80, 90])
    tested = WallTrials(k, b, cost, cost, *[np.ones(5, dtype=bool)] * 2)
    over = np.array([0.0, np.nan, 0.0, 0.02, 0.01])
    assert tested.favoured((400, 400, 10, 18), np.full(5, 900.0), over) == 2


def test_a_member_of_the_region_is_never_named_as_a_wall_against_it(course_1, monkeypatch):
    result, stages = course_1
    use = region_to_use(result, stages)[0]
    cost, ids = stages.sure_cost("settle_2pct").copy(), stages.texts("response", "trial_id")
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    (at, *_) = np.flatnonzero((use.stiffness_low == K) & (use.damping_low == B))
    cost[at] = 1.0
    best = Optimum(stiffness=K[at], damping=B[at], cost=1.0, trial_id=ids[at])
    of = result.model_copy(update={"optimum": result.optimum | {"settle_2pct": best}})
    found = region_to_use(of, hidden(stages, monkeypatch, cost))[0]
    assert (found.stiffness_low, found.damping_low) <= (K[at], B[at])
    assert (found.point.stiffness, found.point.damping) != (K[at], B[at])
    assert found.point.better == ""


@pytest.mark.parametrize("seed", range(4))
def test_a_further_trial_lies_in_the_range_as_often_as_is_said(seed):
    """Scatter of single trials, drawn anew at the same walls: (n - 1)/(n + 1) of the new costs lie inside."""
    random = np.random.default_rng(900 + seed)
    held, expected = [], []
    for _ in range(60):
        tested = course(lambda k, b: bowl(k, b) * np.exp(0.15 * random.standard_normal(len(k))))
        region = best_rectangle(tested, FLAT, NARROW)
        at = tested.inside(region)
        seen, n = tested.cost[at], int(at.sum())
        new = bowl(tested.stiffness[at], tested.damping[at]) * np.exp(0.15 * random.standard_normal(n))
        held.append(np.mean((new >= seen.min()) & (new <= seen.max())))
        expected.append((n - 1) / (n + 1))
    # what neighbours share of each other's levels is left
    assert np.mean(held) == pytest.approx(np.mean(expected), abs=0.06)
