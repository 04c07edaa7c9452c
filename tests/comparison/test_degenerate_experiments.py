"""Experiments that lack something end in a report: a part that cannot be computed is null, with a reason."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labs import compare
from small_experiments import compared, compared_trials, trials, write_logs

from pipeline.comparison.against import against_experiments
from pipeline.intake.ingest import ingest
from pipeline.records.trials import Trials

FREE = np.zeros(6), np.array([0.0, 0.0, 2.0, 2.0, -1.0, -1.0])


def without_reasons(result):
    """Names of the estimates that have neither a value nor a reason."""
    return [
        name
        for of in result.experiments
        for name, one in of.estimates.items()
        for each in (one, *one.by_method.values())
        if each.value is None and not each.reason
    ]


@pytest.fixture(scope="module")
def course():
    """A course with limits at three dampings, on a device with friction; as many steps either way."""
    K = np.tile([300.0, 800.0, 1500.0, 5000.0, 20000.0], 3)
    B = np.repeat([5.0, 10.0, 20.0], 5)
    return trials(K, B, coulomb=0.3, steps=np.where(np.arange(15) % 2, 4.0, -4.0), rows=260)


# no wall limit with friction or jitter


@pytest.mark.sampled
@pytest.mark.parametrize("walls", [FREE, (np.array([-80.0, -50.0, 0.0, 0.0, 0.0, 0.0]), FREE[1])])
@pytest.mark.parametrize("device", [{"coulomb": 0.3}, {"jitter_samples": (1, 2, 3)}])
def test_no_wall_limit_with_friction_or_jitter(walls, device, tmp_path):
    steps = np.array([0.8, -0.8, 1.2, -1.2, 2.0, -2.0])
    result = compared_trials(tmp_path, trials(*walls, steps=steps, **device))
    (of,) = result.experiments
    assert of.boundary == ()
    assert of.estimates["mass"].value == pytest.approx(0.5, rel=0.05)
    assert of.use_reason == "no wall was tried: record trials with K > 0"
    assert "no wall was tried" in of.loop.reason
    assert result.answer.wall is None


@pytest.mark.slow
def test_an_experiment_without_a_wall_leaves_the_others_their_report(course, tmp_path):
    write_logs(tmp_path / "raw", course, experiment="walls")
    free = trials(*FREE, coulomb=0.3, steps=[1, -1, 2, -2, 1, -1])
    write_logs(tmp_path / "raw", free, experiment="free", prefix="f")
    result = compared(tmp_path / "raw", tmp_path / "processed")
    found = {of.experiment: of for of in result.experiments}
    assert found["free"].boundary == ()
    assert found["walls"].stiffest is not None
    page = against_experiments(tmp_path / "processed", ("dev", "walls"), ("dev", "free"))
    assert page.result.pairs[0].boundary_reason == "the second boundary has no limits: no wall was tried (K > 0)"


# logs of two or three rows, steps at the first and last rows


@pytest.mark.sampled
@pytest.mark.parametrize("rows", [2, 3, 4])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("edge", ["first", "last"])
def test_groups_of_very_short_logs(rows, count, edge, tmp_path):
    logs = trials(300.0 + 100.0 * np.arange(count), 5.0, rows=rows, edge_row=0 if edge == "first" else rows - 1)
    result = compared_trials(tmp_path, logs)
    assert result.experiments[0].verdicts == {"undecided": count}
    assert without_reasons(result) == []
    assert ".." not in result.answer.estimates_reason.replace("...", "")
    assert any("no trial is decided, so there is no limit" in text for text in result.warnings)


@pytest.mark.sampled
@pytest.mark.parametrize("rows", [[2, 200], [3, 200, 200], [2, 3, 150]])
def test_short_logs_among_long_ones_cost_themselves_alone(rows, tmp_path):
    parts = [trials([k], 15.0, rows=r, edge_row=1) for k, r in zip((500.0, 900.0, 1500.0), rows, strict=False)]
    result = compared_trials(tmp_path, Trials.of(trial for part in parts for trial in part))
    assert result.experiments[0].verdicts == {
        "stable": sum(r >= 150 for r in rows),
        "undecided": sum(r < 150 for r in rows),
    }


@pytest.mark.sampled
@pytest.mark.parametrize("edge_row", [0, 195, 198, 199])
def test_a_step_in_the_first_or_the_last_rows(edge_row, tmp_path):
    result = compared_trials(tmp_path, trials([500.0, 1500.0, 300.0], 10.0, edge_row=edge_row))
    assert without_reasons(result) == []
    verdicts = result.experiments[0].verdicts
    assert "unstable" not in verdicts
    assert edge_row == 0 or verdicts == {"undecided": 3}


def test_the_example_log_of_the_readme(tmp_path):
    readme = (Path(__file__).parents[2] / "README.md").read_text("utf-8")
    block = re.search(r"(?:    #.*\n)+    time_s,command,position\n(?:    [\d.,]+\n)+", readme)
    assert block is not None
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "log.csv").write_text(re.sub(r"(?m)^    ", "", block.group()), encoding="utf-8")
    result = compared(tmp_path / "raw", tmp_path / "processed", device="falcon", report=tmp_path / "r.html")
    assert result.experiments[0].verdicts == {"undecided": 1}


# steps of both signs


@pytest.mark.slow
def test_as_many_negative_as_positive_steps(course, tmp_path):
    sides = {"both": course}
    mirrored = [
        trials([k], [b], coulomb=0.3, steps=4.0, rows=260)
        for k, b in zip(course.stiffness, course.damping, strict=True)
    ]
    sides["one"] = Trials.of(trial for part in mirrored for trial in part)
    found = {name: compared_trials(tmp_path / name, logs).experiments[0] for name, logs in sides.items()}
    assert sorted(set(course.step)) == [-4.0, 4.0]
    for of in found.values():
        assert of.loop.adequate
        assert "coulomb_friction" in {cause.code for cause in of.causes}
        assert of.estimates["friction"].value == pytest.approx(0.3, rel=0.05)
    limits = [np.array([limit.stiffness for limit in of.loop_boundary]) for of in found.values()]
    np.testing.assert_allclose(*limits, rtol=0.05)


@pytest.mark.sampled
@pytest.mark.parametrize("sizes", [(4.0, -4.0), (2.0, -2.0, 6.0, -6.0), (-3.0,), (1.5, -4.5)])
def test_replay_of_steps_of_several_sizes(sizes, tmp_path):
    K, B = np.tile([300.0, 900.0, 1500.0, 20000.0], 2), np.repeat([10.0, 20.0], 4)
    result = compared_trials(tmp_path, trials(K, B, steps=np.resize(sizes, 8), rows=260))
    replay = result.experiments[0].replay
    assert replay.verdicts_same == 1.0
    assert replay.fit_percent > 90


# contradicting and undecided trials


@pytest.mark.sampled
@pytest.mark.parametrize("walls", [(1000.0,), (1000.0, 4000.0)])
def test_contradicting_verdicts_widen_the_bracket_and_are_named(walls, tmp_path):
    """The same walls once on the device, and once on another one that they make unstable."""
    on_device, on_other = trials(walls, 15.0), trials(walls, 15.0, delay_samples=30.0)
    result = compared_trials(tmp_path, [on_device, on_other])
    (point,) = result.experiments[0].boundary
    assert result.experiments[0].verdicts == {"stable": len(walls), "unstable": len(walls)}
    assert point.stable is None
    assert point.low == 0
    assert point.high is None
    text = next(text for text in result.warnings if "contradict" in text)
    assert "B = 15" in text
    assert all(f"{wall:.0f}" in text for wall in walls)


@pytest.mark.sampled
@pytest.mark.parametrize("stiffness", [300.0, 1500.0, 4000.0])
def test_one_undecided_trial_gives_no_limit(stiffness, tmp_path):
    result = compared_trials(tmp_path, trials([stiffness], 15.0, rows=24))
    (point,) = result.experiments[0].boundary
    assert (point.estimate, point.stable, point.unstable) == (None, None, None)
    assert not any("tested stiffness range ended" in text for text in result.warnings)
    assert "longer logs" in result.answer.wall_reason


# bounds without meaning


@pytest.mark.sampled
@pytest.mark.parametrize("step", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("B", [[0.0, -1.0, -3.0], [-10.0, 0.0, 5.0]])
def test_no_bound_of_friction_exceeds_the_step(step, B, tmp_path):
    result = compared_trials(tmp_path, trials(np.zeros(3), B, steps=step, rows=200))
    friction = result.experiments[0].estimates["friction"]
    if friction.high is None:
        assert friction.reason.startswith("not identifiable")
        assert "ecord" in friction.reason
        (shown,) = [each for each in result.answer.estimates if each.name == "friction"] or [None]
        assert shown is None or shown.reason == friction.reason
    else:
        assert friction.high <= step


def test_intervals_stay_in_the_range_of_their_parameter(tmp_path):
    result = compared_trials(tmp_path, trials([1000.0, 4000.0] * 2, 15.0, steps=[4, -4, 2, -2], rows=80))
    for name in ("mass", "damping", "friction", "delay_samples", "jitter_samples"):
        estimate = result.experiments[0].estimates[name]
        assert estimate.low is None or estimate.low >= 0
        assert estimate.low is None or estimate.high is None or estimate.low <= estimate.high


# reasons


def test_a_position_that_never_changes(tmp_path):
    logs = trials([500.0, 800.0, 0.0], 5.0)
    still = replace(logs, position=np.zeros_like(logs.position))
    result = compared_trials(tmp_path, still)
    assert without_reasons(result) == []
    text = result.answer.estimates_reason
    assert text.startswith("The position is 0 in all 200 rows. Record larger steps")
    assert not text.endswith("..")
    assert not any(each.name == "replay" for each in result.answer.estimates)
    assert not any(".)" in warning for warning in result.warnings)


def test_whatever_is_missing_is_null_in_the_document(tmp_path):
    compared_trials(tmp_path, trials([500.0, 600.0], 5.0, rows=5, edge_row=1))
    document = json.loads((tmp_path / "report.json").read_text("utf-8"))
    mass = document["experiments"][0]["estimates"]["mass"]
    assert mass["value"] is None
    assert mass["reason"]


# names in any script


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["机器人", "تجربة", "🤖", "e\u0301x\u0336", "हिन्दी", "ก\u0e33"])
def test_names_in_any_script_give_no_warning_and_stay_text(name, tmp_path):
    write_logs(tmp_path / "raw", trials([300.0, 20000.0] * 2, [10.0, 10.0, 20.0, 20.0]), experiment=name)
    report = tmp_path / "report.html"
    compared(
        tmp_path / "raw", tmp_path / "processed", report=report, figures=tmp_path / "figures", criteria=["rise_time"]
    )
    assert name in report.read_text("utf-8")
    assert list((tmp_path / "figures").glob("*.pdf"))


# a hand on the device


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("grip", ["comfortable", "firm"])
def test_no_passive_wall_by_logs_with_a_hand_alone(grip, tmp_path):
    """The mass and damping of the hand are in the logs; what the device has without it is not known."""
    K = np.tile([300.0, 900.0, 1600.0, 2400.0, 9000.0], 3)
    B = np.repeat([1.0, 4.0, 8.0], 5)
    logs = trials(K, B, damping=12.0, mass=0.6, rows=260)
    free = compared_trials(tmp_path / "none", logs).experiments[0]
    held = compared_trials(tmp_path / grip, logs, grip=grip).experiments[0]
    assert free.passive is not None
    assert free.loop.adequate
    assert held.loop.adequate
    assert held.passive is None
    assert grip in held.passive_reason
    assert "operator" in held.passive_reason


# two devices


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("coulomb", [0.0, 0.3])
def test_two_devices_without_files_are_compared_by_their_masses(coulomb, tmp_path):
    K = np.tile([300.0, 900.0, 1500.0, 5000.0, 20000.0], 3)
    for name, B, more in (("A", [5.0, 10.0, 20.0], {"coulomb": coulomb}), ("C", [10.0, 20.0, 40.0], {"mass": 0.8})):
        steps = np.where(np.arange(15) % 2, 4.0, -4.0)
        logs = trials(K, np.repeat(B, 5), steps=steps, rows=260, **more)
        write_logs(tmp_path / "raw", logs, device=name, prefix=name)
    compared(tmp_path / "raw", tmp_path / "processed", device="A")
    page = against_experiments(tmp_path / "processed", ("A", "1"), ("C", "1"))
    (pair,) = page.result.pairs
    assert pair.plane == "normalised"
    assert pair.boundary is not None
    (area,) = [each for each in pair.estimates if each.name == "boundary_area"]
    assert area.unit == "1"
    assert area.first is None or area.first < 1


def test_a_comparison_of_devices_names_the_true_reason(tmp_path):
    for name, rows in (("A", 200), ("C", 4)):
        write_logs(tmp_path / "raw", trials([300.0, 900.0], 10.0, rows=rows, edge_row=1), device=name, prefix=name)
    compared(tmp_path / "raw", tmp_path / "processed", device="A")
    with pytest.raises(Exception, match=r"device 'C'.*The log has 4 rows, but a model requires at least 8"):
        against_experiments(tmp_path / "processed", ("A", "1"), ("C", "1"))


# periods and positions beyond all bounds


@pytest.mark.sampled
@pytest.mark.parametrize("period", [1e-300, 1e-9, 10.0, 1e300])
def test_periods_beyond_all_bounds(period, tmp_path):
    logs = trials([300.0, 900.0], 10.0)
    time = np.concatenate([np.arange(rows) * period for rows in logs.rows])
    write_logs(tmp_path / "raw", replace(logs, time=time, sampling_period_s=np.full(2, period)))
    report = ingest([tmp_path / "raw"], tmp_path / "processed")
    assert report.ingested + len(report.quarantined) == 2
    assert all(one.reason for one in report.quarantined)
    if report.ingested:
        assert compare("dev", tmp_path / "processed", report=tmp_path / "r.html").result is not None


@pytest.mark.sampled
@pytest.mark.parametrize(("step", "position"), [(1e-300, 1.0), (4.0, 1e300), (1e300, 1e-300)])
def test_steps_and_positions_beyond_all_bounds(step, position, tmp_path):
    logs = trials([300.0, 900.0], 10.0)
    values = {"position": logs.position * position, "step": np.full(2, step)}
    write_logs(tmp_path / "raw", replace(logs, **values))
    report = ingest([tmp_path / "raw"], tmp_path / "processed")
    assert report.ingested + len(report.quarantined) == 2
    if report.ingested:
        assert compare("dev", tmp_path / "processed", report=tmp_path / "r.html").result is not None
