"""Trials without a step: released from a position or hit, judged by the growth of their free motion.

The truth is the spectral radius of the loop by a matrix exponential.
"""

from __future__ import annotations

import numpy as np
import pytest
from columns import changed, responses, verdicts
from simulated import plant, spectral_radius

from pipeline.records.trials import Trial, Trials

RIGS = {
    "paddle": {"mass": 7e-4, "b": 2e-4, "delay": 1, "T": 5e-3, "size": 0.1, "quantum": 7.67e-4},
    "falcon": {"mass": 0.58, "b": 4.0, "delay": 4, "T": 1e-3, "size": 0.02, "quantum": 1e-5},
    "joint": {"mass": 0.19, "b": 0.5, "delay": 2, "T": 1e-3, "size": -0.05, "quantum": 0.0},
}
GRIDS = {
    "paddle": ([0.2, 0.5, 0.8, 1.1, 4.8, 8.0], 0.01),
    "falcon": ([200.0, 500.0, 900.0, 6000.0, 12000.0], 20.0),
    "joint": ([100.0, 300.0, 600.0, 6000.0, 12000.0], 5.0),
}
WAYS = ("released by the controller", "released by hand", "hit by the controller", "hit by hand")


def walls(rig, way, rows=300, begin=12):
    """Motions of a rig behind the walls of its grid, stepped with the matrix exponential."""
    K, damping = GRIDS[rig]
    about = RIGS[rig]
    m, T, delay, size, quantum = (about[name] for name in ("mass", "T", "delay", "size", "quantum"))
    A, g = plant(m, about["b"], T)
    K = np.array(K)
    B = np.full(len(K), damping)
    x0 = size if "released" in way else 0.0
    position, command = np.full((len(K), rows), np.nan), np.full((len(K), rows), np.nan)
    count = np.full(len(K), rows)
    for i, k in enumerate(K):
        state, sent, last = np.array([x0, 0.0]), [0.0] * delay, None
        hand = way == "released by hand"
        for row in range(rows):
            x = np.round(state[0] / quantum) * quantum if quantum else state[0]
            last = x if last is None else last
            wall = -k * x - damping * (x - last) / T
            force = wall if row >= begin or hand or "hit" in way else 0.0
            if way == "hit by the controller" and begin <= row < begin + 4:
                force += k * abs(size)
            last = x
            position[i, row], command[i, row] = x, force
            sent.append(force)
            acts = sent.pop(0)
            if row < begin and "released" in way:
                continue  # it is held
            if way == "hit by hand" and row == begin:
                state = state + np.array([0.0, size * np.sqrt(k / m)])
            state = A @ state + g * acts
            if abs(state[0]) > 20 * abs(size):
                count[i] = row + 1
                break
    trials = Trials.of(
        Trial(str(i), K[i], B[i], 0.0, T, np.arange(n) * T, command[i, :n], position[i, :n])
        for i, n in enumerate(count.tolist())
    )
    radius = [
        spectral_radius(k, b, **{n: about[n] for n in ("mass", "b", "delay", "T")}) for k, b in zip(K, B, strict=True)
    ]
    return trials, np.array(radius)


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
