"""Decisions of the planner on small cases, against limits that are known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from pipeline.base.errors import ParameterError
from pipeline.planning.next_wall import (
    Bracket,
    Forecast,
    PlanGoal,
    TriedWalls,
    best_split,
    bracket,
    chances,
    corrected,
    doubtful_ends,
    order,
    plan_state,
)

DAMPINGS = tuple(np.linspace(0, 180, 7))
NOTHING = TriedWalls(*[np.empty(0)] * 4)


def parabola(damping):
    """Limits of no loop at all: the planner must find them too."""
    return 500 + 12_000 * (1 - ((damping - 100) / 110) ** 2)


def cut_off(damping):
    return parabola(damping) if damping < 110 else 0.0


def upside_down(damping):
    return 9000 - parabola(damping) / 2


def told(limit, off=0.0):
    """A forecast that is off by a share of each limit."""
    value = np.array([limit(b) for b in DAMPINGS])
    return Forecast((1 + off) * value, 0.002 * value)


def campaign(limit, aim, by=None, first=()):
    rows = list(first)
    while True:
        columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.empty(0)] * 4
        found = plan_state(TriedWalls(*columns), aim, by)
        if found.done or len(rows) == 120:
            return found, TriedWalls(*columns)
        column = found.columns[order(found.columns)[0]]
        wall = column.wall if np.isfinite(column.wall) and column.wall > 0 else 5000.0
        rows.append((wall, column.damping, "unstable" if wall > limit(column.damping) else "stable", np.nan))


def test_of_an_unknown_limit_the_middle_of_its_bracket_is_expected():
    rows = TriedWalls(
        np.array([4000.0, 8000.0]), np.full(2, 60.0), np.array(["stable", "unstable"]), np.full(2, np.nan)
    )
    (column,) = plan_state(rows, PlanGoal((60.0,)), None).columns
    assert (column.bracket.bottom, column.estimate, column.bracket.top) == (4000.0, 6000.0, 8000.0)


@pytest.mark.parametrize("limit", [parabola, cut_off, upside_down])
@pytest.mark.parametrize("off", [None, 0.0, 0.15])
def test_limits_of_any_shape_are_found(limit, off):
    aim = PlanGoal(DAMPINGS)
    said = "stable" if limit(60.0) > 4000.0 else "unstable"
    # by verdicts alone a wall is needed to begin with
    by, first = (None, [(4000.0, 60.0, said, np.nan)]) if off is None else (told(limit, off), [])
    found, tried = campaign(limit, aim, by, first)
    assert found.done
    truth = np.array([limit(b) for b in DAMPINGS])
    estimate = np.array([column.estimate for column in found.columns])
    assert np.abs(estimate - truth).max() <= aim.accuracy * truth.max()
    for column, true in zip(found.columns, truth, strict=True):
        assert column.bracket.bottom <= true <= column.bracket.top, "the ends are verdicts, and verdicts are right"
    if off == 0.0:
        assert len(tried) <= 2 * len(DAMPINGS) + 4


def test_a_rig_is_spared_unstable_walls_where_the_device_holds():
    plain, gentle = (campaign(parabola, PlanGoal(DAMPINGS, gentle=gentle), told(parabola)) for gentle in (False, True))
    share = [np.mean(tried.verdict == "unstable") for _, tried in (plain, gentle)]
    assert share[1] <= 0.15 < 0.35 < share[0]
    # a device that says twice the limit is found out by verdicts
    wrong = campaign(parabola, PlanGoal(DAMPINGS, gentle=True), told(parabola, 1.0))
    for found, _ in (gentle, wrong):
        estimate = np.array([column.estimate for column in found.columns])
        assert np.abs(estimate - parabola(np.array(DAMPINGS))).max() < 0.02 * 12_500


@pytest.mark.parametrize(("gentle", "most"), [(False, 0.5), (True, 0.3)])
def test_first_walls_are_well_below_the_foretold_limit(gentle, most):
    walls = [column.wall for column in plan_state(NOTHING, PlanGoal(DAMPINGS, gentle=gentle), told(parabola)).columns]
    share = np.array(walls) / told(parabola).limit
    assert share.max() == pytest.approx(most)


def test_what_a_forecast_missed_is_carried_on_to_neighbours_and_makes_it_unsure():
    by, dampings = Forecast(np.full(7, 1000.0), np.full(7, 1.0)), np.array(DAMPINGS)
    ends = np.array([(0.0, np.inf)] * 7)
    assert corrected(by, ends, dampings).limit == pytest.approx(by.limit)
    ends[3] = (1190.0, 1210.0)
    found = corrected(by, ends, dampings)
    assert found.misfit == pytest.approx(0.16, abs=0.005)
    assert found.limit[3] == pytest.approx(1190.0, abs=5.0)
    # one spacing is 1.1 lengths away: 0.54 of what was missed
    assert found.limit[2] == pytest.approx(1000 + 0.54 * 190, abs=20.0)
    assert found.limit[0] == pytest.approx(1000.0, abs=5.0)
    assert found.error[3] < 10.0 < 100.0 < found.error[0]
    # a stable wall above the forecast is a miss, too
    ends[3] = (1190.0, np.inf)
    assert corrected(by, ends, dampings).misfit == pytest.approx(0.16, abs=0.005)


def test_a_correction_exceeds_no_error_so_far():
    """As a falcon with friction: +987 and -127 N/m at the last two dampings made -1,377 N/m beyond them."""
    dampings = np.array([0.0, 16, 32, 48, 64, 80, 96, 112, 128, 152, 168, 184])
    limit = np.array([1762.0, 5857, 8948, 11234, 12797, 13609, 13589, 12613, 10527, 4651, 2, 2])
    error = np.array([105.0, 40, 31, 42, 53, 68, 86, 112, 150, 38, 1, 1])
    low = np.array([800.0, 6080, 8960, 11200, 12960, 13600, 14080, 13600, 10240, 0, 0, 0])
    high = np.array([2240.0, 6400, 9280, 11360, 13120, 13760, 14240, 13760, 10400, np.inf, np.inf, np.inf])
    found = corrected(Forecast(limit, error, low=limit, scale=13609.0), np.stack([low, high], axis=1), dampings)
    missed = np.clip(limit, low, high) - limit
    assert (missed.min(), missed.max()) == (-127, 987)
    assert found.limit[9] == pytest.approx(4651 - 127)
    assert (found.limit - limit <= 987).all()


def test_no_wall_leaves_what_may_be_tried():
    aim = PlanGoal(DAMPINGS, lowest=1500.0, highest=8000.0)
    found, tried = campaign(parabola, aim, told(parabola))
    assert found.done
    assert tried.stiffness.min() >= 0.3 * 1500.0
    assert tried.stiffness.max() <= 8000.0
    columns = [np.array([3000.0, 4000.0]), np.array([60.0, 60.0]), np.array(["stable"] * 2), np.array([-20.0, -15.0])]
    found = plan_state(TriedWalls(*columns, force=np.array([9.0, 30.0])), PlanGoal((60.0,), force=20.0))
    assert found.columns[0].wall is None or found.columns[0].wall < 4000.0


def walls_at(*trials):
    stiffness, verdict, growth = (np.array(column) for column in zip(*trials, strict=True))
    return TriedWalls(stiffness, np.full(len(trials), 60.0), verdict, growth)


def test_a_contradiction_comes_first():
    tried = walls_at((1e3, "stable", 0.0), (4e3, "unstable", 0.0), (8e3, "stable", 0.0), (8e3, "stable", 0.0))
    found = plan_state(tried, PlanGoal(DAMPINGS))
    first = found.columns[order(found.columns)[0]]
    assert (first.damping, first.wall) == (60.0, 4e3)
    assert not found.done


def test_verdicts_that_stay_undecided_end_the_search_without_an_estimate():
    trials = [(1e3, "stable", -9.0), (9e3, "unstable", 9.0), *[(k, "undecided", np.nan) for k in (4e3, 5e3, 6e3)]]
    for count, ends in ((4, False), (5, True)):
        column = plan_state(walls_at(*trials[:count]), PlanGoal((60.0,))).columns[0]
        assert (column.note == "undecided") is ends
        assert (column.estimate is None) is ends
        assert (column.wall is None) is ends
    again = plan_state(walls_at(*trials[:3]), PlanGoal((60.0,))).columns[0].wall
    assert abs(again - 4e3) > 50.0, "an undecided wall is not asked for again"


def test_weak_verdicts_are_repeated_and_a_rig_is_spared_the_unstable_one():
    ends = Bracket(low=5900.0, high=6000.0)
    weak = walls_at((5900.0, "stable", -0.18), (6000.0, "unstable", 0.18))
    assert doubtful_ends(weak, ends, 0.4, gentle=False) == (5900.0, 6000.0)
    assert doubtful_ends(weak, ends, 0.4, gentle=True) == (5900.0,)
    # the amplitude changes by 9 % over the log
    sure = walls_at((5900.0, "stable", -0.22), (6000.0, "unstable", 0.22))
    assert doubtful_ends(sure, ends, 0.4, gentle=False) == ()


def test_a_bracket_is_narrow_enough_from_18_tenths_of_the_accuracy_on():
    for width, done in ((350.0, True), (370.0, False)):
        trials = walls_at((10_000.0 - width, "stable", -9.0), (10_000.0, "unstable", 9.0))
        column = plan_state(trials, PlanGoal((60.0,)), Forecast(np.array([10_000.0]), np.array([1.0]))).columns[0]
        assert (column.wall is None) is done


def test_chances_are_those_of_the_forecast_and_a_twelfth_lies_anywhere():
    edges = np.array([0.0, 4000.0, 4900.0, 5100.0, 10_000.0])
    found = chances(edges, 5000.0, 10.0)
    assert found[2] == pytest.approx(0.92 + 0.08 * 0.02, abs=1e-3)
    assert found[0] == pytest.approx(0.08 * 0.4, rel=0.01)
    assert chances(edges, np.nan, np.nan) == pytest.approx([0.4, 0.09, 0.02, 0.49])


def test_a_forecast_that_missed_nothing_is_still_unsure_of_what_verdicts_call_stable():
    by = Forecast(np.full(7, 1000.0), np.zeros(7))
    assert corrected(by, np.array([(0.0, np.inf)] * 7), np.array(DAMPINGS)).error == pytest.approx(7.0)


def test_a_spared_rig_stays_one_and_a_half_standard_errors_below_and_searches_from_below():
    own = walls_at((3000.0, "stable", -9.0))
    by = Forecast(np.array([10_000.0]), np.zeros(1))
    wall = plan_state(own, PlanGoal((60.0,), gentle=True), by).columns[0].wall
    assert (10_000.0 - wall) / 70.0 == pytest.approx(1.5, abs=0.3)
    # an unstable trial costs six stable ones: without a forecast the first of a bracket is tried at a quarter of it
    ends = walls_at((1000.0, "stable", -9.0), (9000.0, "unstable", 9.0))
    plain, gentle = (plan_state(ends, PlanGoal((60.0,), gentle=gentle)).columns[0].wall for gentle in (False, True))
    assert plain == pytest.approx(5000.0, abs=500.0)
    assert 1500.0 < gentle < 3600.0


def test_a_limit_is_looked_for_three_tenths_above_the_largest_one():
    trials = walls_at((9000.0, "stable", -9.0))
    (column,) = plan_state(trials, PlanGoal((60.0,))).columns
    assert 9000.0 < column.wall < 2 * 9000.0
    other = TriedWalls(np.array([9000.0, 9100.0]), np.full(2, 60.0), np.array(["stable", "unstable"]), np.full(2, 9.0))
    by = Forecast(np.array([9050.0, 30_000.0]), np.ones(2))
    assert plan_state(other, PlanGoal((60.0, 90.0)), by).largest == pytest.approx(1.3 * 9050.0, rel=0.01)


def test_nothing_is_tried_where_the_device_of_the_logs_has_no_stable_wall():
    by = Forecast(np.array([9000.0, 0.0]), np.ones(2))
    trials = walls_at((8900.0, "stable", -9.0), (9100.0, "unstable", 9.0))
    column = plan_state(trials, PlanGoal((60.0, 120.0)), by).columns[1]
    assert (column.estimate, column.wall, column.note) == (0.0, None, "no stable wall")
    # before any log a file may be wrong
    assert plan_state(trials.select(np.zeros(2, dtype=bool)), PlanGoal((60.0, 120.0)), by).columns[1].wall is not None


@pytest.mark.parametrize(("limit", "verdict", "tried"), [
    (1e-4, "unstable", False),  # it is 0 within the accuracy of 2 % of 9000
    (179.0, "unstable", False),
    (181.0, "unstable", True),
    (1e-4, "stable", True),  # a stable wall refutes the forecast
    (1e-4, "undecided", True),
])  # fmt: skip
def test_no_wall_far_above_a_limit_near_zero_is_tried_again(limit, verdict, tried):
    by = Forecast(np.array([9000.0, limit]), np.ones(2))
    K, B = np.array([8900.0, 9100.0, 400.0]), np.array([60.0, 60.0, 0.0])
    trials = TriedWalls(K, B, np.array(["stable", "unstable", verdict]), np.array([-9.0, 9.0, 5.0]))
    column = plan_state(trials, PlanGoal((60.0, 0.0)), by).columns[1]
    assert (column.wall is not None) == tried
    assert (column.note == "no stable wall") == (not tried)


@pytest.mark.parametrize(
    ("trials", "width", "found"),
    [
        ([], 0.0, Bracket()),
        ([(1e3, "stable"), (2e3, "undecided")], 0.0, Bracket(low=1e3, trials=2)),
        # most trials of a wall decide
        ([(1e3, "stable"), (2e3, "unstable"), (2e3, "stable"), (2e3, "stable"), (3e3, "unstable")], 0.0,
         Bracket(2e3, 3e3, trials=5)),
        # stable above unstable encloses both, and is asked again: the wall of fewest trials first
        ([(1e3, "stable"), (2e3, "unstable"), (3e3, "stable"), (3e3, "stable"), (4e3, "unstable")], 0.0,
         Bracket(1e3, 4e3, again=(2e3, 3e3), trials=5)),
        # until it lasts: the lowest limit counts
        ([(1e3, "stable"), *[(2e3, "unstable")] * 3, *[(3e3, "stable")] * 3, (4e3, "unstable")], 0.0,
         Bracket(1e3, 2e3, lasting=True, trials=8)),
        # within the width it is chance
        ([(1e3, "stable"), (1.1e3, "unstable"), (1.2e3, "stable"), (1.3e3, "unstable")], 150.0,
         Bracket(1e3, 1.3e3, trials=4)),
    ],
)  # fmt: skip
def test_brackets_are_what_verdicts_say(trials, width, found):
    walls, said = (np.array([trial[i] for trial in trials]) for i in range(2))
    assert bracket(walls, said, width) == found


def test_an_open_bracket_has_all_walls_in_it():
    assert (Bracket().bottom, Bracket().top) == (0.0, np.inf)


def test_columns_must_fit():
    with pytest.raises(ParameterError, match="one value per trial"):
        TriedWalls(np.ones(2), np.ones(3), np.array(["stable"] * 2), np.ones(2))


def exhaustive(edges, chance, width, price):
    total = np.concatenate([[0.0], np.cumsum(chance)])

    @cache
    def cost(i, j):
        if edges[j] - edges[i] <= width or j - i < 2:
            return 0.0
        return min(
            cost(i, k) + cost(k, j) + total[j] - total[k] + price * (total[k] - total[i]) for k in range(i + 1, j)
        )

    n = len(chance)
    return {k: cost(0, k) + cost(k, n) + total[n] - total[k] + price * (total[k] - total[0]) for k in range(1, n)}


@pytest.mark.parametrize("price", [1.0, 4.0])
@pytest.mark.parametrize("seed", range(5))
def test_no_other_place_is_cheaper(seed, price):
    random = np.random.default_rng(seed)
    edges, chance = np.cumsum(random.uniform(0.2, 2, 10)), random.uniform(0.01, 1, 9)
    costs = exhaustive(edges, chance, 1.5, price)
    assert costs[best_split(edges, chance, 1.5, price).place] == pytest.approx(min(costs.values()), rel=1e-12)


def test_dear_unstable_trials_are_approached_from_below():
    edges, chance = np.linspace(0, 10, 41), np.ones(40)
    plain, gentle = (best_split(edges, chance, 0.5, price) for price in (1.0, 6.0))
    assert gentle.place < plain.place
    assert gentle.unstable < plain.unstable


def test_a_narrow_range_is_done():
    assert best_split(np.array([0.0, 0.5, 1.0]), np.ones(2), 1.0) is None
