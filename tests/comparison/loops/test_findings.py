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
    found = findings.loop_findings(result, stages, None, UNITS["translation"])
    assert found.loop.adequate == (right == 1.0)
    if found.loop.adequate:
        assert found.passive is not None
    else:
        assert found.passive is None
        assert "needs an adequate loop" in found.passive_reason
