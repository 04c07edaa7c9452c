"""A rig that sets other walls than it was asked for: what was measured counts, and the search ends."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial
from math import floor
from pathlib import Path

import numpy as np
import pytest
from labs import make_lab

from pipeline.device_data.devices import load_device
from pipeline.planning.campaign import PlanOptions, open_campaign
from pipeline.planning.loop_limits import linear_limits
from pipeline.planning.next_wall import TriedWalls
from pipeline.planning.planner import Plan, PlannedLimit, plan, plan_of

FALCON = load_device("falcon")
MOST = 60
DAMPINGS = (60.0, 140.0)


def limit_of(experiment="1"):
    of = next(each for each in FALCON.experiments if each.name == experiment)
    return partial(linear_limits, FALCON.loop_for(of))


def measured(tmp_path, sets, options):
    """Do what the planner asks for on a rig that sets other walls, whose limits the file states a tenth too large."""
    campaign = open_campaign("falcon", tmp_path / "none", "1", options)
    rows, asked, limit = [], [], limit_of()
    while True:
        answer = plan_of(campaign, options)
        if answer.done or len(asked) >= MOST:
            return answer, asked
        asked.append((answer.next[0].stiffness, answer.next[0].damping))
        K, B = sets(*asked[-1])
        growth = K / 0.9 - limit(np.array([B]))[0]
        rows.append((K, B, "unstable" if growth > 0 else "stable", growth))
        campaign = replace(campaign, tried=TriedWalls(*(np.array(column) for column in zip(*rows, strict=True))))


RIGS = {
    "K to 1,000": (lambda K, B: (1000.0 * round(K / 1000), B), DAMPINGS),
    "K down to 700": (lambda K, B: (700.0 * floor(K / 700), B), DAMPINGS),
    "K at most 5,000": (lambda K, B: (min(K, 5000.0), B), DAMPINGS),
    "B to 5, of the file's own": (lambda K, B: (K, 5.0 * round(B / 5)), ()),
}


@pytest.mark.parametrize("name", RIGS)
def test_the_search_ends_with_what_was_measured(tmp_path, name):
    sets, dampings = RIGS[name]
    last, asked = measured(tmp_path, sets, PlanOptions(dampings=dampings))
    assert last.done, f"{len(asked)} trials"
    assert Counter(asked).most_common(1)[0][1] <= 4
    assert last.trials_used == len(asked)
    logged = {sets(*wall) for wall in asked}
    for limit in last.boundary:
        true = 0.9 * limit_of()(np.array([limit.damping]))[0]
        for end in (limit.low, limit.high):
            assert end is None or (end, limit.damping) in logged
        assert (limit.low or 0.0) <= true <= (limit.high or np.inf)
        assert ("the rig sets no wall" in limit.note) == name.startswith("K")


@pytest.mark.parametrize("experiment", [each.name for each in FALCON.experiments])
@pytest.mark.sampled
def test_without_logs_the_first_walls_are_well_inside_what_the_file_predicts(tmp_path, experiment):
    for options in (PlanOptions(count=3), PlanOptions(goal="optimum"), PlanOptions(count=3, gentle=True)):
        for wall in plan("falcon", tmp_path / "none", experiment, options).next:
            most = 0.31 if options.gentle else 0.51
            assert 0 < wall.stiffness <= most * limit_of(experiment)(np.array([wall.damping]))[0]


def test_a_limit_without_a_stable_wall_is_none_in_words_as_in_json():
    limit = PlannedLimit(damping=20.0, estimate=400.0, low=None, high=1000.0)
    told = str(Plan(next=(), done=True, boundary=(limit,), trials_used=3, trials_expected=3))
    assert "no stable wall, unstable at 1000" in told
    assert "stable at 0" not in told


@pytest.mark.slow
def test_limits_with_friction_are_said_to_be_those_of_the_step(tmp_path: Path) -> None:
    device = load_device("falcon-real")
    lab = make_lab(tmp_path, device, ("1",), coarsen=10, seed=3)
    remarks = plan("falcon-real", lab.processed, "1").remarks
    (said,) = [remark for remark in remarks if "larger steps are unstable" in remark]
    assert f"steps of {device.step:g} N" in said
