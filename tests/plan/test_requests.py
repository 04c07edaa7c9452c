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

from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.plan.answer import Limit, Plan
from pipeline.plan.course import Wish
from pipeline.plan.planner import plan
from pipeline.plan.requests import Requests, read_requests, write_requests
from pipeline.records.native import NativeHeader, format_header
from pipeline.shell.commands.cli_plan import _print
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.theory.limits import limits

FALCON = load_device("falcon")
EXPERIMENT = FALCON.experiments[0]
MOST = 40
DAMPINGS = (60.0, 140.0)


def record(folder: Path, stiffness: float, damping: float, number: int) -> None:
    """Write the log of one trial."""
    setup = replace(setup_of(FALCON, EXPERIMENT), jitter_samples=())
    batch = simulate(setup, np.array([stiffness]), np.array([damping]), seed=700 + number)
    head = format_header(NativeHeader("falcon", "1", stiffness, damping, FALCON.step, FALCON.sampling_period_s))
    rows = zip(batch.command[0, : batch.rows[0]], batch.position[0, : batch.rows[0]], strict=True)
    lines = [f"{k * FALCON.sampling_period_s:.17g},{u:.17g},{x:.17g}\n" for k, (u, x) in enumerate(rows)]
    (folder / f"{number}.csv").write_text(head + "".join(lines), encoding="utf-8")


def measured(tmp_path, sets, wish):
    """Do what the planner asks for on a rig that sets other walls; return its answers and what it asked for."""
    logs, answers, asked = tmp_path / "logs", [], []
    logs.mkdir()
    while True:
        answers.append(plan("falcon", tmp_path / "processed", "1", wish))
        if answers[-1].done or len(asked) >= MOST:
            return answers, asked
        wall = answers[-1].next[0]
        asked.append((wall.stiffness, wall.damping))
        record(logs, *sets(wall.stiffness, wall.damping), len(asked))
        ingest([logs], tmp_path / "processed")


RIGS = {
    "K to 1,000": lambda K, B: (1000.0 * round(K / 1000), B),
    "K down to 700": lambda K, B: (700.0 * floor(K / 700), B),
    "B to 50": lambda K, B: (K, 50.0 * round(B / 50)),
    "K at most 5,000": lambda K, B: (min(K, 5000.0), B),
}


@pytest.mark.sampled
@pytest.mark.parametrize("name", RIGS)
def test_a_rig_that_sets_other_walls_is_told_of_and_the_search_ends(tmp_path, name):
    answers, asked = measured(tmp_path, RIGS[name], Wish(dampings=DAMPINGS))
    last = answers[-1]
    assert last.done, f"{len(asked)} trials"
    assert Counter(asked).most_common(1)[0][1] <= 3
    assert last.trials_used == len(asked), "what was measured counts"
    (said,) = [remark for remark in last.remarks if "asked and logged differ" in remark]
    logged = [RIGS[name](*wall) for wall in asked]
    differ = [wall for wall, other in zip(asked, logged, strict=True) if wall != other]
    assert f"{differ[-1][0]:g}" in said
    # what is told of limits is what was measured
    walls = set(logged)
    loop, units = stated("1")
    for limit in last.boundary:
        for end in (limit.low, limit.high):
            assert end is None or (end, limit.damping) in walls
        true = limits(loop, np.array([limit.damping]) / units.damping).alpha[0] * units.stiffness
        # verdicts of logs of 0.4 s with noise
        assert 0.98 * (limit.low or 0.0) <= true
        assert limit.high is None or true <= 1.02 * limit.high


@pytest.mark.slow
def test_the_best_wall_of_a_rig_that_rounds(tmp_path):
    answers, asked = measured(tmp_path, lambda K, B: (500.0 * round(K / 500), 5.0 * round(B / 5)), Wish(goal="optimum"))
    best = answers[-1].optimum
    assert answers[-1].done
    assert Counter(asked).most_common(1)[0][1] <= 3
    assert best.region[0] <= best.stiffness <= best.region[1]
    assert best.region[2] <= best.damping <= best.region[3]
    assert (best.stiffness % 500, best.damping % 5) == (0, 0)


@pytest.mark.parametrize("gentle", [False, True])
@pytest.mark.parametrize("experiment", [each.name for each in FALCON.experiments])
def test_without_logs_the_first_walls_are_well_inside_what_the_file_predicts(tmp_path, experiment, gentle):
    loop, units = stated(experiment)
    for wish in (Wish(count=3, gentle=gentle), Wish(goal="optimum", gentle=gentle)):
        for wall in plan("falcon", tmp_path / "none", experiment, wish).next:
            limit = limits(loop, np.array([wall.damping]) / units.damping).alpha[0] * units.stiffness
            assert 0 < wall.stiffness <= (0.31 if gentle else 0.51) * limit


def stated(experiment):
    from pipeline.loop.device_loop import loop_of, wall_units

    of = next(each for each in FALCON.experiments if each.name == experiment)
    about = of.delay_samples, FALCON.sampling_period_s, FALCON.loop_of(of)
    return loop_of(of.mass, of.damping, of.stiffness, *about), wall_units(of.mass, *about[1:])


def test_logs_that_nobody_asked_for_answer_nothing():
    asked = Requests().asking([(5000.0, 40.0)], [])
    assert asked.answered([(1000.0, 10.0), (2000.0, 10.0)]).others == ()
    assert asked.answered([(5000.0, 40.0)]).kept == 1
    assert asked.answered([(5001.0, 40.01)]).kept == 1, "as good as asked"
    assert asked.answered([(4000.0, 40.0)]).others == (((5000.0, 40.0), (4000.0, 40.0)),)


def test_requests_are_kept_and_a_damaged_file_is_nothing_asked(tmp_path):
    kept = Requests(((1.0, 2.0),), ((3.0, 4.0),), 5, (((1.0, 2.0), (3.0, 4.0)),))
    write_requests(tmp_path, kept)
    assert read_requests(tmp_path) == kept
    (tmp_path / "asked.json").write_text('{"open": 1}')
    assert read_requests(tmp_path) == Requests()


def test_a_limit_without_a_stable_wall_is_none_in_words_as_in_json(capsys):
    limit = Limit(damping=20.0, estimate=400.0, low=None, high=1000.0)
    _print(Plan(next=(), done=True, boundary=(limit,), trials_used=3, trials_expected=3), False)
    told = capsys.readouterr().out
    assert "no stable wall, unstable at 1000" in told
    assert "stable at 0" not in told


def test_a_second_planner_is_told_of_the_first(tmp_path):
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
            with subprocess.Popen(watching, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as second:
                try:
                    assert said in json.loads(second.stdout.readline())["remarks"]
                finally:
                    second.terminate()
        finally:
            first.terminate()
    assert plan("falcon", tmp_path / "processed", "1").remarks == ()


def test_limits_with_friction_are_said_to_be_those_of_the_step(tmp_path: Path) -> None:
    device = load_device("falcon-real")
    lab = make_lab(tmp_path, device, ("1",), coarsen=10, seed=3)
    (said,) = [remark for remark in plan("falcon-real", lab.processed, "1").remarks if "harder push" in remark]
    assert f"steps of {device.step:g} N" in said
