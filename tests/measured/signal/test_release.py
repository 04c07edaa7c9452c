"""Trials without a step: released from a position or hit, judged by the growth of their free motion."""

from __future__ import annotations

import numpy as np
import pytest
from columns import changed, responses, verdicts
from released import RIGS, WAYS, walls


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("way", WAYS)
def test_release_or_hit_is_judged_by_its_growth(rig, way):
    trials, radius = walls(rig, way)
    found = verdicts(trials)
    assert not ((found.verdict == "stable") & (radius > 1)).any()
    assert not ((found.verdict == "unstable") & (radius < 1)).any()
    assert (found.verdict != "undecided").sum() >= len(radius) - 1, found.reason


@pytest.mark.parametrize("rig", RIGS)
def test_a_trial_without_a_step_has_no_edge_and_no_final_position(rig):
    found = responses(walls(rig, WAYS[0])[0])
    assert (found.edge_row == -1).all()
    assert np.isnan(found.position_final_expected).all()
    assert set(found.edge_reason) == {"no step was commanded (step is 0)"}


@pytest.mark.parametrize("rig", RIGS)
def test_a_trajectory_is_no_free_motion(rig):
    trials, _ = walls(rig, "hit by the controller")

    def swung(trial):
        return trial.command + trial.stiffness * abs(RIGS[rig]["size"]) * np.sin(0.3 * np.arange(trial.rows))

    found = verdicts(changed(trials, command=swung))
    assert set(found.verdict) == {"undecided"}
    assert all("no step was commanded" in text for text in found.reason)
