"""Statements rest on the replay: of a found device that predicts half of the verdicts nothing is promised."""

from __future__ import annotations

import pytest

from pipeline.comparison.loops import findings
from pipeline.comparison.scene.scene import open_scene
from pipeline.rendering.labels import UNITS


@pytest.mark.parametrize("right", [1.0, 0.5])
def test_a_passive_wall_is_named_of_an_adequate_loop_alone(falcon, falcon_outcome, monkeypatch, right):
    replayed = findings.wall_replay

    def wall_replay(*given):
        return replayed(*given).model_copy(update={"verdicts_same": right})

    monkeypatch.setattr(findings, "wall_replay", wall_replay)
    (stages,) = open_scene("falcon", falcon.processed, None, None).experiments
    (result,) = falcon_outcome.result.experiments
    found = findings.examine_loop(result, stages, None, UNITS["translation"])
    assert found.loop.adequate == (right == 1.0)
    if found.loop.adequate:
        assert found.passive is not None
    else:
        assert found.passive is None
        assert "an adequate loop is required" in found.passive_reason


@pytest.fixture
def course_1(falcon, falcon_outcome):
    """Result and stages of the ideal course; the latter may be changed."""
    return falcon_outcome.result.experiments[0], falcon.stages("1")


def test_without_a_device_nothing_is_identified(course_1, monkeypatch):
    result, stages = course_1
    monkeypatch.setattr(findings, "identified_device", lambda _: None)
    judged = findings.judge_loop(result, stages, None, findings.usual_trial(result, stages))
    assert judged == findings.NotIdentified()
    found = findings.examine_loop(result, stages, None, UNITS["translation"])
    assert (found.loop.adequate, found.loop.mass, found.replay, found.loop_boundary) == (False, None, None, None)
    assert found.loop.reason == found.passive_reason == judged.reason


def test_logs_without_time_show_no_loop(course_1, monkeypatch):
    result, stages = course_1
    monkeypatch.setattr(findings, "untimed", lambda _: "no row has its time")
    monkeypatch.setattr(findings, "judge_loop", None)
    found = findings.examine_loop(result, stages, None, UNITS["translation"])
    assert found.loop.reason == found.passive_reason == "no row has its time"
    assert (found.loop.adequate, found.loop_boundary, found.passive) == (False, None, None)
    assert found.implied_delay.whole.reason
    assert found.optimum == result.optimum
