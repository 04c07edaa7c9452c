"""Rigs that set other walls than they are asked for: what they answered is stored, compared, and followed."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial
from math import ceil, floor, inf
from pathlib import Path

import numpy as np
import pytest

from pipeline.device_data.devices import load_device
from pipeline.planning.campaign import PlanOptions, open_campaign
from pipeline.planning.loop_limits import linear_limits
from pipeline.planning.next_wall import TriedWalls
from pipeline.planning.planner import plan_of
from pipeline.planning.requests import AnsweredWall, Requests, range_of, store_requests, stored_requests

FALCON = load_device("falcon")
LIMIT = partial(linear_limits, FALCON.loop_for(FALCON.experiments[0]))
MOST, SHARE = 120, 0.9
NAMED = (60.0, 143.0)


def campaign(sets, options, folder):
    """Do what the planner asks for on a rig that sets other walls, whose limits the file states a tenth too large.

    Returns the last plan, the walls that were asked for and set, and all remarks.
    """
    campaign = open_campaign("falcon", folder / "none", "1", options)
    rows, asked, said = [], [], []
    while True:
        answer = plan_of(campaign, options)
        said += answer.remarks
        got = [row[:2] for row in rows]
        if answer.done or len(asked) >= MOST:
            return answer, asked, got, said
        walls = tuple((each.stiffness, each.damping) for each in answer.next)
        trials = tuple((K, B, count) for (K, B), count in Counter(got).items())
        requests = Requests(walls=walls, trials=trials, answers=campaign.answers)
        for wall in walls:
            asked.append(wall)
            K, B = map(float, sets(*wall))
            growth = K / SHARE - float(LIMIT(np.array([B]))[0])
            rows.append((K, B, "unstable" if growth > 0 else "stable", growth))
        tried = [np.array(column) for column in zip(*[row for row in rows if row[0] > 0], strict=True)]
        answers = requests.answered(row[:2] for row in rows)
        campaign = replace(campaign, tried=TriedWalls(*tried) if tried else campaign.tried, answers=answers)


def nearest(step):
    return lambda K, B: (step * round(K / step), B)


RIGS = {
    "K to 50": nearest(50),
    "K to 250": nearest(250),
    "K to 1000/3": nearest(1000 / 3),
    "K to 2000": nearest(2000),
    "K down to 700": lambda K, B: (700 * floor(K / 700 + 1e-9), B),
    "K up to 700": lambda K, B: (700 * ceil(K / 700 - 1e-9), B),
    "0.5 K": lambda K, B: (0.5 * K, B),
    "2 K": lambda K, B: (2.0 * K, B),
    "K at most 5000": lambda K, B: (min(K, 5000.0), B),
    "K at least 3000": lambda K, B: (max(K, 3000.0), B),
    "K to 250, at most 5000": lambda K, B: (min(250 * round(K / 250), 5000), B),
    "B to 5": lambda K, B: (K, 5 * round(B / 5)),
    "K to 250, B to 5": lambda K, B: (250 * round(K / 250), 5 * round(B / 5)),
    "K to 1000, B to 20": lambda K, B: (1000 * round(K / 1000), 20 * round(B / 20)),
}

OTHERS = {
    "K to 250 from 100": lambda K, B: (250 * round((K - 100) / 250) + 100, B),
    "1.05 K to 250": lambda K, B: (250 * round(1.05 * K / 250), B),
    "K of a list": lambda K, B: (min((500, 800, 1300, 2100, 3400, 5500, 8900, 14400), key=lambda one: abs(one - K)), B),
}
"""Rigs whose way to set walls is none of those that are known."""


@pytest.mark.parametrize("gentle", [False, True])
@pytest.mark.parametrize("dampings", [NAMED, pytest.param((), marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [*RIGS, *OTHERS])
def test_a_rig_that_rounds_is_not_asked_for_one_wall_three_times(tmp_path, name, dampings, gentle):
    sets = (RIGS | OTHERS)[name]
    answer, asked, got, said = campaign(sets, PlanOptions(dampings=dampings, gentle=gentle), tmp_path)
    assert answer.done, f"{len(asked)} trials"
    assert Counter(asked).most_common(1)[0][1] <= 2
    assert Counter(got).most_common(1)[0][1] <= (2 if name in RIGS else 3)
    for limit in answer.boundary:
        assert (limit.low or 0.0) <= SHARE * LIMIT(np.array([limit.damping]))[0] <= (limit.high or inf)
    if not np.allclose(asked, got, rtol=1e-3):
        assert any(remark.startswith("requested K = ") and "the rig set " in remark for remark in said)


def test_the_answer_of_a_rig_is_named_with_the_step_that_follows(tmp_path):
    *_, said = campaign(RIGS["K to 250"], PlanOptions(dampings=NAMED), tmp_path)
    assert any(remark.startswith("requested K = 5510 N/m, B = 60 Ns/m, the rig set K = 5500 N/m (") for remark in said)
    assert "the rig sets multiples of 250 N/m; the next walls are such multiples" in said
    *_, said = campaign(RIGS["2 K"], PlanOptions(dampings=NAMED), tmp_path)
    assert "the rig sets 2 times the requested K; next walls are divided by this factor" in said
    *_, said = campaign(RIGS["K at most 5000"], PlanOptions(dampings=NAMED), tmp_path)
    assert "the rig limits K to at most 5000 N/m" in said


def test_a_rig_that_sets_what_it_is_asked_for_has_no_answer_to_name(tmp_path):
    _, asked, got, said = campaign(lambda K, B: (K, B), PlanOptions(dampings=NAMED), tmp_path)
    assert asked == got
    assert not any("requested" in remark for remark in said)


@pytest.mark.parametrize("step", [50.0, 130.0, 1000 / 3, 0.02])
@pytest.mark.parametrize("rounding", ["nearest", "down", "up"])
def test_steps_are_found_from_answers(step, rounding):
    to = {"nearest": round, "down": floor, "up": ceil}[rounding]
    asked = step * np.random.default_rng(3).uniform(3, 60, 12)
    answers = [AnsweredWall(asked=(K, 9.0), got=(step * to(K / step), 9.0)) for K in asked.tolist()]
    assert range_of(answers).grids[-1].step == pytest.approx(step)
    assert range_of([AnsweredWall(asked=each.asked, got=each.asked) for each in answers]) is None


def test_requests_are_stored_and_each_new_trial_answers_the_nearest(tmp_path):
    asked, tried = [(2930.0, 60.0), (4110.0, 143.0)], [(500.0, 60.0), (500.0, 60.0)]
    store_requests(tmp_path, "dev", "1", asked, tried, ())
    stored = stored_requests(tmp_path, "dev", "1")
    assert stored.answered(tried) == ()
    found = stored.answered([*tried, (4000.0, 145.0), (3000.0, 60.0)])
    assert sorted((each.asked, each.got) for each in found) == [
        ((2930.0, 60.0), (3000.0, 60.0)),
        ((4110.0, 143.0), (4000.0, 145.0)),
    ]
    # more trials than were asked for: one far off is no answer
    assert len(stored.answered([*tried, (9.0, 60.0), (11.0, 60.0), (12.0, 1.0)])) == 0
    (file,) = tmp_path.rglob("asked-*.json")
    file.write_text("{", encoding="utf-8")
    assert stored_requests(tmp_path, "dev", "1") == Requests()
    assert stored_requests(Path(tmp_path / "none"), "dev", "1") == Requests()
