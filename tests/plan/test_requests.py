"""A rig that logs other walls than it was asked for: it is said, what was measured counts, and the search ends."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from math import floor
from pathlib import Path

import numpy as np
import pytest
from labs import make_lab
from test_plan_live import record

from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.plan.course import Wish, open_course
from pipeline.plan.found_device import stated_device
from pipeline.plan.planner import Limit, Plan, asked_of, plan, plan_of
from pipeline.plan.requests import Requests, read_requests, write_requests
from pipeline.plan.verdicts import Tried
from pipeline.shell.commands.cli_plan import lines_of

FALCON = load_device("falcon")
MOST = 40
DAMPINGS = (60.0, 140.0)


def limit_of(experiment="1"):
    of = next(each for each in FALCON.experiments if each.name == experiment)
    return stated_device(FALCON, of).point.limit


def measured(tmp_path, sets, wish):
    """Do what the planner asks for on a rig that sets other walls, whose limits the file states a tenth too large."""
    course = open_course("falcon", tmp_path / "none", "1", wish)
    rows, asked, limit = [], [], limit_of()
    while True:
        answer = plan_of(course, wish)
        if answer.done or len(asked) >= MOST:
            return answer, asked
        asked.append((answer.next[0].stiffness, answer.next[0].damping))
        K, B = sets(*asked[-1])
        growth = K / 0.9 - limit(np.array([B]))[0]
        rows.append((K, B, "unstable" if growth > 0 else "stable", growth))
        requests = asked_of(course, answer).answered([row[:2] for row in rows])
        tried = Tried(*(np.array(column) for column in zip(*rows, strict=True)))
        course = replace(course, tried=tried, walls=tuple(row[:2] for row in rows), requests=requests)


RIGS = {
    "K to 1,000": lambda K, B: (1000.0 * round(K / 1000), B),
    "K down to 700": lambda K, B: (700.0 * floor(K / 700), B),
    "B to 50": lambda K, B: (K, 50.0 * round(B / 50)),
    "K at most 5,000": lambda K, B: (min(K, 5000.0), B),
}


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_that_sets_other_walls_is_told_of_and_the_search_ends(tmp_path, name):
    last, asked = measured(tmp_path, RIGS[name], Wish(dampings=DAMPINGS))
    assert last.done, f"{len(asked)} trials"
    assert Counter(asked).most_common(1)[0][1] <= 3
    assert last.trials_used == len(asked), "what was measured counts"
    (said,) = [remark for remark in last.remarks if "asked and logged differ" in remark]
    logged = [RIGS[name](*wall) for wall in asked]
    differ = [wall for wall, other in zip(asked, logged, strict=True) if wall != other]
    assert f"{differ[-1][0]:g}" in said
    # what is told of limits is what was measured
    for limit in last.boundary:
        true = 0.9 * limit_of()(np.array([limit.damping]))[0]
        for end in (limit.low, limit.high):
            assert end is None or (end, limit.damping) in set(logged)
        assert (limit.low or 0.0) <= true <= (limit.high or np.inf)


def test_a_rig_that_sets_another_damping_each_time_is_given_up(tmp_path):
    random = np.random.default_rng(1)
    last, asked = measured(tmp_path, lambda K, B: (K, float(random.uniform(0, 180))), Wish(dampings=DAMPINGS))
    assert last.done
    assert len(asked) <= 10


@pytest.mark.parametrize("experiment", [each.name for each in FALCON.experiments])
def test_without_logs_the_first_walls_are_well_inside_what_the_file_predicts(tmp_path, experiment):
    for wish in (Wish(count=3), Wish(goal="optimum"), Wish(count=3, gentle=True)):
        for wall in plan("falcon", tmp_path / "none", experiment, wish).next:
            most = 0.31 if wish.gentle else 0.51
            assert 0 < wall.stiffness <= most * limit_of(experiment)(np.array([wall.damping]))[0]


def test_logs_that_nobody_asked_for_answer_nothing():
    asked = Requests().asking([(5000.0, 40.0)], [])
    assert asked.answered([(1000.0, 10.0), (2000.0, 10.0)]).others == ()
    assert asked.answered([(5000.0, 40.0)]).kept == 1
    assert asked.answered([(5008.0, 40.06)]).kept == 1, "as good as asked, within 0.2 %"
    assert asked.answered([(5013.0, 40.0)]).kept == 0
    assert asked.answered([(4000.0, 40.0)]).others == (((5000.0, 40.0), (4000.0, 40.0)),)


def test_a_wall_beside_one_that_was_rounded_is_rounded_alike():
    rig = Requests(others=(((3500.0, 40.0), (4000.0, 40.0)),), logged=((4000.0, 40.0), (3000.0, 40.0)))
    K = np.array([3300.0, 3380.0, 3600.0, 4100.0])
    assert rig.as_set(K, np.full(4, 40.0))[0].tolist() == [3300.0, 4000.0, 4000.0, 4100.0]
    assert rig.step == 1000.0
    assert replace(rig, logged=(*rig.logged, (3900.0, 40.0))).step == 100.0, "it has set closer ones"


def test_requests_are_kept_and_a_damaged_file_is_nothing_asked(tmp_path):
    kept = Requests(((1.0, 2.0),), ((3.0, 4.0),), 5, (((1.0, 2.0), (3.0, 4.0)),))
    write_requests(tmp_path, kept)
    assert read_requests(tmp_path) == kept
    (tmp_path / "asked.json").write_text('{"open": 1}')
    assert read_requests(tmp_path) == Requests()


def test_a_limit_without_a_stable_wall_is_none_in_words_as_in_json():
    limit = Limit(damping=20.0, estimate=400.0, low=None, high=1000.0)
    told = "\n".join(lines_of(Plan(next=(), done=True, boundary=(limit,), trials_used=3, trials_expected=3)))
    assert "no stable wall, unstable at 1000" in told
    assert "stable at 0" not in told


def test_a_second_planner_is_told_of_the_first(tmp_path: Path) -> None:
    logs, place = tmp_path / "logs", ["--processed", str(tmp_path / "processed")]
    logs.mkdir()
    record(logs, 4000.0, 60.0, 1)
    ingest([logs], tmp_path / "processed")
    command = [sys.executable, "-m", "pipeline", "plan", "--device", "falcon", "--experiment", "1", "--json"]
    watching = [*command, "--watch", str(logs), *place]
    with subprocess.Popen(watching, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as first:
        try:
            assert not any("too" in remark for remark in json.loads(first.stdout.readline())["remarks"])
            (said,) = plan("falcon", tmp_path / "processed", "1").remarks
            assert f"process {first.pid}" in said
        finally:
            first.terminate()
    assert plan("falcon", tmp_path / "processed", "1").remarks == ()


@pytest.mark.slow
def test_limits_with_friction_are_said_to_be_those_of_the_step(tmp_path: Path) -> None:
    device = load_device("falcon-real")
    lab = make_lab(tmp_path, device, ("1",), coarsen=10, seed=3)
    (said,) = [remark for remark in plan("falcon-real", lab.processed, "1").remarks if "harder push" in remark]
    assert f"steps of {device.step:g} N" in said
