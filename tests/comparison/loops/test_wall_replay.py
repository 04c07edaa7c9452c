"""The found device behind walls that it was not fitted to."""

from __future__ import annotations

import pytest

from pipeline.records.results import WallReplay


def test_an_ideal_loop_is_right_behind_walls_it_was_not_fitted_to(falcon_outcome):
    result = falcon_outcome.result
    replay = result.experiments[0].replay
    assert replay.is_right
    assert replay.verdicts_same >= 0.95
    assert replay.limits_off_percent < 2
    assert replay.fit_percent > 95
    (told,) = [each for each in result.answer.estimates if each.name == "replay"]
    assert told.limits_off_percent == replay.limits_off_percent


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
