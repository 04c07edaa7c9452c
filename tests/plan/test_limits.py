"""Decisions of the planner on small cases, against limits that are known."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.plan.forecast import Forecast
from pipeline.plan.limits import Aim, Expected, beyond_zero, doubtful_ends, from_below, order, region_ended, state
from pipeline.plan.model import Range
from pipeline.plan.verdicts import Bracket, Tried

DAMPINGS = tuple(np.linspace(0, 180, 7))
AROUND = Range(stiffness=9000.0, damping=190.0, sampling_period_s=1e-3)


def parabola(damping):
    """Limits of no loop at all: the planner must find them too."""
    return 500 + 12_000 * (1 - ((damping - 100) / 110) ** 2)


def cut_off(damping):
    return parabola(damping) if damping < 110 else 0.0


def upside_down(damping):
    return 9000 - parabola(damping) / 2


def course(limit, aim, *, rates=True, most=80):
    rows = []
    while True:
        columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.empty(0)] * 4
        found = state(Tried(*columns), aim, AROUND)
        if found.done or len(rows) == most:
            return found, Tried(*columns)
        column = found.columns[order(found.columns)[0]]
        off = (column.wall - limit(column.damping)) * 5e-3
        said = "unstable" if off > 0 else "stable"
        rows.append((column.wall, column.damping, said, off if rates else np.nan))


@pytest.mark.parametrize("rates", [True, False])
@pytest.mark.parametrize("limit", [parabola, cut_off, upside_down])
def test_limits_of_any_shape_are_found(limit, rates):
    aim = Aim(DAMPINGS)
    found, _ = course(limit, aim, rates=rates)
    assert found.done
    truth = np.array([limit(b) for b in DAMPINGS])
    estimate = np.array([column.estimate for column in found.columns])
    assert np.abs(estimate - truth).max() <= aim.accuracy * truth.max()
    for column, true in zip(found.columns, truth, strict=True):
        assert column.bracket.bottom <= true <= column.bracket.top, "the ends are verdicts, and verdicts are right"


def test_rates_save_trials():
    with_rates, without = (len(course(parabola, Aim(DAMPINGS), rates=rates)[1]) for rates in (True, False))
    assert with_rates < without


def test_gentle_tries_few_unstable_walls():
    plain, gentle = (course(parabola, Aim(DAMPINGS, gentle=gentle)) for gentle in (False, True))
    share = [np.mean(tried.verdict == "unstable") for _, tried in (plain, gentle)]
    # without a loop that explains the logs each damping takes one unstable wall, and no more
    assert share[1] < 0.3 < share[0]
    estimate = np.array([column.estimate for column in gentle[0].columns])
    assert np.abs(estimate - parabola(np.array(DAMPINGS))).max() < 0.02 * 12_500


def test_no_wall_leaves_what_may_be_tried():
    aim = Aim(DAMPINGS, lowest=1500.0, highest=8000.0)
    found, tried = course(parabola, aim)
    assert found.done
    assert tried.stiffness.min() >= 1500.0
    assert tried.stiffness.max() <= 8000.0


def test_a_wall_of_too_large_force_is_the_last():
    columns = [np.array([3000.0, 4000.0]), np.array([60.0, 60.0]), np.array(["stable"] * 2), np.array([-20.0, -15.0])]
    found = state(Tried(*columns, force=np.array([9.0, 30.0])), Aim((60.0,), force=20.0), AROUND)
    assert found.columns[0].wall is None or found.columns[0].wall < 4000.0


def test_a_contradiction_comes_first():
    said = np.array(["stable", "unstable", "stable", "stable"])
    tried = Tried(np.array([1e3, 4e3, 8e3, 8e3]), np.full(4, 60.0), said, np.full(4, np.nan))
    found = state(tried, Aim(DAMPINGS), AROUND)
    first = found.columns[order(found.columns)[0]]
    assert (first.damping, first.wall) == (60.0, 4e3)
    assert not found.done


def test_beyond_the_end_of_the_region_nothing_is_expected():
    dampings = np.array([0.0, 50.0, 100.0, 150.0])
    ahead = Forecast(np.array([1e3, 8e3, 10.0, 3e3]), np.array([100.0, 100.0, 50.0, 2e3]), 0.05)
    ends = np.array([[0.0, np.inf], [7e3, 9e3], [0.0, 300.0], [0.0, np.inf]])
    value, _ = beyond_zero(ahead, dampings, ends, Aim(tuple(dampings)))
    assert value[3] == 0.0
    assert value[:3].tolist() == ahead.limit[:3].tolist()


def walls_at(*trials):
    stiffness, verdict, growth = (np.array(column) for column in zip(*trials, strict=True))
    return Tried(stiffness, np.full(len(trials), 60.0), verdict, growth)


def test_verdicts_that_stay_undecided_end_the_search_without_an_estimate():
    trials = [(1e3, "stable", -9.0), (9e3, "unstable", 9.0), *[(k, "undecided", np.nan) for k in (4e3, 5e3, 6e3)]]
    for count, told in ((4, False), (5, True)):
        column = state(walls_at(*trials[:count]), Aim((60.0,)), AROUND).columns[0]
        assert (column.note == "undecided") is told
        assert (column.estimate is None) is told
        assert (column.wall is None) is told


def test_an_undecided_wall_is_not_asked_for_again():
    trials = [(1e3, "stable", np.nan), (9e3, "unstable", np.nan)]
    wall = state(walls_at(*trials), Aim((60.0,)), AROUND).columns[0].wall
    other = state(walls_at(*trials, (wall, "undecided", np.nan)), Aim((60.0,)), AROUND).columns[0].wall
    assert abs(other - wall) > 50.0


def test_a_limit_is_told_from_below_only_by_a_line_and_a_loop_that_agree():
    # the line through both rates ends at 6000
    own = walls_at((5600.0, "stable", -4.0), (5900.0, "stable", -1.0))
    ends = Bracket(low=5900.0)
    assert from_below(own, ends, 200.0, Expected(50.0, 6000.0, 20.0, adequate=True, explains=True))
    assert not from_below(own, ends, 200.0, Expected(50.0, 6000.0, 20.0, adequate=True, explains=False)), (
        "friction bends lines"
    )
    assert not from_below(own, ends, 200.0, Expected(50.0, 6300.0, 20.0, True, True)), "the loop disagrees"
    flat = walls_at((5600.0, "stable", -40.0), (5900.0, "stable", -35.0))
    assert not from_below(flat, ends, 200.0, Expected(50.0, 6000.0, 20.0, True, True)), "the line disagrees"


def test_weak_verdicts_are_repeated_and_a_rig_is_spared_the_unstable_one():
    own = walls_at((5900.0, "stable", -0.05), (6000.0, "unstable", 0.05))
    ends = Bracket(low=5900.0, high=6000.0)
    assert doubtful_ends(own, ends, 0.4, gentle=False, explains=True) == (5900.0, 6000.0)
    assert doubtful_ends(own, ends, 0.4, gentle=True, explains=True) == (5900.0,)
    sure = walls_at((5900.0, "stable", -5.0), (6000.0, "unstable", 5.0))
    assert doubtful_ends(sure, ends, 0.4, gentle=False, explains=False) == ()
    assert doubtful_ends(sure, ends, 0.4, gentle=True, explains=False) == (5900.0,)


def test_the_region_has_ended_behind_a_damping_without_stable_walls():
    ends = np.array([[0.0, np.inf], [5e3, 6e3], [0.0, 100.0], [0.0, np.inf]])
    assert region_ended(np.arange(4.0), ends).tolist() == [False, False, False, True]


def test_an_area_is_known_to_its_accuracy_and_takes_more_trials_for_a_finer_one():
    aim = Aim(DAMPINGS, accuracy=0.05, area=True)
    found, tried = course(parabola, aim)
    assert found.done
    low, high = (np.trapezoid([getattr(c.bracket, end) for c in found.columns], DAMPINGS) for end in ("bottom", "top"))
    assert high - low <= 2 * 0.05 * np.trapezoid(parabola(np.array(DAMPINGS)), DAMPINGS)
    assert len(tried) < len(course(parabola, Aim(DAMPINGS, accuracy=0.01, area=True))[1])
