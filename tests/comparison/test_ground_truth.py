"""The truth beside simulated logs: limits against spectral radii by the simulator, and files that are not whole."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from labs import compare

from pipeline.comparison.ground_truth import true_limits, truth_of, truths
from pipeline.comparison.scene.scene import open_scene
from pipeline.records.results import Truth

DOCUMENT = {
    "plant": {"mass": 0.6, "damping": 4.0, "stiffness": 10.0},
    "delay_samples": 3.0,
    "jitter_samples": [],
    "sampling_period_s": 0.001,
    "loop": {},
    "simulation": {
        "one_sided_wall": False,
        "constant_force": 0.2,
        "gain_error": 0.0,
        "clock_error": 0.0,
        "held_samples": 0.0,
    },
}


def changed(**parts):
    return truth_of({**DOCUMENT, **parts})


def test_limits_are_those_of_the_spectral_radii_of_the_simulated_loops(falcon, falcon_outcome):
    (result,) = falcon_outcome.result.experiments
    limit = {point.damping: point.truth for point in result.boundary}
    paths = open_scene("falcon", falcon.processed, None, None).experiments[0].trials.column("source_path").to_pylist()
    document = json.loads((falcon.processed.parent.rglob("truth.json").__next__()).read_text())
    assert len(paths) == len(document["logs"])
    held = [log for log in document["logs"].values() if log["stiffness"] > 0 and log["damping"] in limit]
    assert len(held) > 100
    for log in held:
        assert (log["stiffness"] < limit[log["damping"]]) == (log["spectral_radius"] < 1), log


def test_truth_stands_beside_estimates_and_intervals_are_counted(falcon_outcome):
    (result,) = falcon_outcome.result.experiments
    assert result.estimates["mass"].truth == 0.58
    assert result.estimates["delay_samples"].truth == 4.0
    assert result.estimates["friction"].truth == 0.0
    held = result.truth_held
    of_screen = {**result.estimates, "delay_samples": result.delay.model_copy(update={"truth": 4.0})}
    told = [e for e in of_screen.values() if None not in (e.truth, e.value, e.low, e.high)]
    assert held.estimates == len(told) >= 4
    assert held.estimates_held == sum(e.low <= e.truth <= e.high for e in told)
    limits = [p for p in result.boundary if None not in (p.estimate, p.low, p.high)]
    assert held.limits == len(limits) > 10
    assert held.limits_held == sum(p.low <= p.truth <= p.high for p in limits)


def test_what_the_wall_feels_is_operator_included_per_unit_of_command():
    operator = {"mass": 0.2, "damping": 6.0, "stiffness": 300.0}
    loop = {"operator": operator, "force_gain": 0.8, "friction": {"coulomb": 0.4}}
    values = changed(loop=loop).values
    assert values["mass"] == pytest.approx(1.0, rel=1e-12)
    assert values["damping"] == pytest.approx(12.5, rel=1e-12)
    assert values["device_stiffness"] == pytest.approx(387.5, rel=1e-12)
    assert values["friction"] == pytest.approx(0.5, rel=1e-12)
    assert values["constant_force"] == pytest.approx(0.25, rel=1e-12)
    wrong = {**DOCUMENT["simulation"], "gain_error": 0.25}
    assert changed(simulation=wrong).values["mass"] == pytest.approx(0.48, rel=1e-12)
    assert changed(loop={"actuator_lag_s": 0.002}).values["delay_samples"] is None


@pytest.mark.parametrize(
    ("parts", "word"),
    [
        ({"jitter_samples": [3, 4, 5]}, "the delay jitters"),
        ({"loop": {"friction": {"coulomb": 0.1}}}, "there is friction"),
        ({"simulation": {**DOCUMENT["simulation"], "one_sided_wall": True}}, "one sided wall"),
    ],
)
def test_a_loop_that_is_not_linear_has_no_true_limit(falcon_outcome, parts, word):
    truth = changed(**parts)
    assert word in truth.limit_reason
    assert true_limits(truth, [10.0, 20.0]) == [None, None]
    assert None not in true_limits(changed(), [10.0, 20.0])
    if "jitter_samples" in parts:
        # in force is the newest command that has arrived: 3 samples old in 3 of 9 cases, 4 in 4, 5 in 2
        assert truth.values["delay_samples"] == pytest.approx(35 / 9, rel=1e-12)
        assert truth.values["jitter_samples"] == pytest.approx(np.sqrt(44) / 9, rel=1e-12)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"logs": {}}', '{"plant": 1, "logs": 3}'])
def test_a_file_that_is_no_truth_of_these_logs_counts_for_nothing(falcon, tmp_path, text):
    stages = open_scene("falcon", falcon.processed, None, None).experiments
    assert set(truths(stages, {})) == {"1"}
    path = next(falcon.processed.parent.rglob("truth.json"))
    kept = path.read_bytes()
    try:
        path.write_text(text)
        assert truths(stages, {}) == {}
        given = {"1": truth_of(json.loads(kept))}
        assert truths(stages, given) == given, "verify takes the one in the page"
    finally:
        path.write_bytes(kept)


@pytest.mark.slow
def test_a_report_is_made_anew_where_the_truth_is_gone(falcon, tmp_path):
    logs = tmp_path / "logs"
    path = next(falcon.processed.parent.rglob("truth.json"))
    shutil.copytree(path.parent, logs)
    from pipeline.intake.ingest import ingest

    ingest([logs], tmp_path / "p")
    asked = {"criteria": ["overshoot"], "report": tmp_path / "r.html"}
    assert compare("falcon", tmp_path / "p", **asked).result.experiments[0].truth == Truth.model_validate(
        truth_of(json.loads(path.read_bytes()))
    )
    (logs / "truth.json").unlink()
    again = compare("falcon", tmp_path / "p", **asked).result.experiments[0]
    assert again.truth is None
    assert again.truth_held is None
