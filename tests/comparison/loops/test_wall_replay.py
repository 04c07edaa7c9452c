"""The found device behind walls that it was not fitted to."""

from __future__ import annotations

import numpy as np
import pytest

import pipeline
from pipeline.records.results import WallReplay
from pipeline.rendering.figures.overview import replay_figure


def test_an_ideal_loop_is_right_behind_walls_it_was_not_fitted_to(falcon_outcome):
    result = falcon_outcome.result
    replay = result.experiments[0].replay
    assert replay.is_right
    assert replay.verdicts_same >= 0.95
    assert replay.limits_off_percent < 2
    assert replay.fit_percent > 95
    (told,) = [each for each in result.answer.estimates if each.name == "replay"]
    assert told.limits_off_percent == replay.limits_off_percent


def test_residuals_are_those_of_the_single_stable_walls(falcon, falcon_outcome):
    result = falcon_outcome.result
    replay = result.experiments[0].replay
    residuals = replay.residuals
    assert np.median(residuals.percent) == pytest.approx(100 - replay.fit_percent, abs=0.01)
    stored = pipeline.trials(falcon.processed, "falcon", "1").set_index(["stiffness", "damping"])
    walls = list(zip(residuals.stiffness, residuals.damping, strict=True))
    assert len(set(walls)) == len(walls) > 50
    assert set(stored.loc[walls, "verdict"]) == {"stable"}
    # logs without noise: what is left is rounding, also of the true device by the exact solution of theory
    worst = int(np.argmax(residuals.percent))
    truth = pipeline.Loop(mass=0.58, damping=4.0, sampling_period_s=1e-3, delay_samples=4)
    log = pipeline.samples(falcon.processed, stored.loc[walls[worst], "trial_id"])
    edge = int((log["command"] > 0.5 * log.attrs["step"]).to_numpy().argmax())
    y = (log["position"] - log["position"].iloc[0]).to_numpy()[edge + 4 :]
    motion = truth.response(*walls[worst], samples=len(y), per_sample=1)["position"].to_numpy() * log.attrs["step"]
    assert np.linalg.norm(y - motion[: len(y)]) < 1e-6 * np.linalg.norm(y)
    assert max(residuals.percent) < 1e-4


def test_every_replayed_wall_is_in_the_figure(falcon_outcome):
    result = falcon_outcome.result
    (figure,) = replay_figure(result)
    residuals = result.experiments[0].replay.residuals
    for panel, walls in zip(figure.panels, (residuals.stiffness, residuals.damping), strict=True):
        (series,) = panel.series
        assert series.x.tolist() == list(walls)
        assert series.y.tolist() == list(residuals.percent)
        assert panel.limits[0][0] < min(walls) <= max(walls) < panel.limits[0][1]
        assert panel.limits[1][1] > max(residuals.percent)
    median = f"{100 - result.experiments[0].replay.fit_percent:.2g}".replace("-", "−")
    assert f"median {median} %" in figure.panels[0].words
    alone = [e.model_copy(update={"replay": None}) for e in result.experiments]
    assert replay_figure(result.model_copy(update={"experiments": tuple(alone)})) == []
    assert falcon_outcome.report.read_text(encoding="utf-8").count('<figure id="replay"') == 1


@pytest.mark.slow
def test_with_friction_the_replay_is_told_with_its_limits_whether_it_is_right_or_not(sticky_outcome):
    (found,) = sticky_outcome.result.experiments
    assert found.loop_boundary
    assert found.replay.trials > 50
    assert found.replay.limits_off_percent < 10
    assert found.loop.adequate <= found.replay.is_right
    # linear theory leaves friction out
    assert found.theory is None or found.theory.source != "estimated from the logs"


@pytest.mark.parametrize(
    ("verdicts", "limits", "trials", "right"),
    [
        (0.95, 5.0, 100, True),
        (0.94, 5.0, 100, False),
        (1.0, 5.1, 100, False),
        (0.9, None, 10, True),
        (None, 1.0, 9, False),
    ],
)
def test_right_is_95_percent_of_the_verdicts_and_limits_within_5_percent(verdicts, limits, trials, right):
    replay = WallReplay(
        fit_percent=None,
        verdicts_same=verdicts,
        limits_off_percent=limits,
        costs_off_percent=None,
        trials=trials,
    )
    assert replay.is_right == right
    # where tested walls are far apart a limit between them agrees with all that is known
    coarse = replay.model_copy(update={"limits_off_percent": 30.0, "limits_known_percent": 31.0, "verdicts_same": 1.0})
    assert coarse.is_right
    assert coarse.limits_open
    assert not replay.limits_open
    assert not coarse.model_copy(update={"limits_off_percent": 37.0}).is_right
