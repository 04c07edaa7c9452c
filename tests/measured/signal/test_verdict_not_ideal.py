"""Verdicts of devices that the model does not contain, against what the same loop does in a much longer, ideal log."""

from __future__ import annotations

import numpy as np
import pytest
from columns import responses, stacked, verdicts
from not_ideal import decays, simulate
from simulated import FALCON, spectral_radius

from pipeline.device.parts import SimulationParts
from pipeline.device_data.devices import load_device
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate as simulate_loop

DAMPING = np.array([10.0, 45.0, 85.0, 110.0])
SHARE = np.array([0.35, 0.6, 0.8, 0.92, 1.04, 1.09, 1.2, 1.4, 1.65])
SENSOR = {"noise": 5e-7, "quantum": 2e-6}


def limit(B, low=0.0, high=40000.0):
    while high - low > 1:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if spectral_radius(middle, B, **FALCON) < 1 else (low, middle)
    return low


K = np.outer([limit(B) for B in DAMPING], SHARE).ravel()
B = np.repeat(DAMPING, len(SHARE))


def judged(seed, **features):
    """Verdicts, and whether each loop truly comes to rest."""
    shift = np.random.default_rng(seed).uniform(0, 1e-3, len(K))
    found = verdicts(simulate(K, B, seed=seed, shift=shift, **features))
    return found, decays(K, B, **{**features, "rows": 400})


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("features", "most_undecided"),
    [
        ({"limit": 12.0, **SENSOR}, 1),
        ({"limit": 20.0}, 1),
        ({"limit": 20.0, "rows": 1500, **SENSOR}, 1),
        ({"one_sided": True, **SENSOR}, 3),
        ({"one_sided": True}, 3),
        ({"friction": 0.3, **SENSOR}, 4),
        ({"friction": 0.6, "limit": 20.0, **SENSOR}, 4),
        ({"quantum": 6e-5}, 6),
        ({"quantum": 2e-4}, 18),
        ({"rows": 120, "quantum": 6e-5}, 10),
        ({"mode": (40.0, 0.02, 0.2), **SENSOR}, 2),
        ({"lag": 0.003, **SENSOR}, 2),
    ],
    ids=str,
)
def test_no_verdict_is_wrong(features, most_undecided):
    found, rests = judged(7, **features)
    assert not ((found.verdict == "stable") & ~rests).any()
    assert not ((found.verdict == "unstable") & rests).any()
    assert (found.verdict == "undecided").sum() <= most_undecided
    assert all(found.reason[i] for i in np.flatnonzero(found.verdict == "undecided"))


def test_several_steps_are_judged_by_the_response_to_the_first():
    later = SimulationParts.model_validate({"later_steps": [{"time_s": 0.2, "size": -4.0}]})
    device = load_device("falcon")
    setup = setup_of(device, device.experiments[0].model_copy(update={"simulation": later, "jitter_samples": ()}))
    loop = setup.loop
    true = {**FALCON, "delay": int(loop.delay_samples), "mass": loop.mass, "b": loop.damping}
    trials = simulate_loop(setup, K, B)
    growth = np.log([spectral_radius(k, b, **true) for k, b in zip(K, B, strict=True)]) / loop.sampling_period_s
    found = verdicts(trials)
    assert (responses(trials).steps > 1).any()
    known = np.isfinite(found.growth_per_s)
    assert known.sum() > 0.7 * len(K)
    # the second step stirs the motion up again: over both, rates are off by 1 to 20 /s
    assert np.abs(found.growth_per_s - growth)[known].max() < 1 + 0.1 * np.abs(growth[known]).max()
    assert np.median(np.abs(found.growth_per_s - growth)[known]) < 0.3
    assert not ((found.verdict == "stable") & (growth > 0)).any()


def test_a_motion_that_friction_brakes_has_no_growth_rate():
    found, rests = judged(3, friction=0.4, **SENSOR)
    assert rests.sum() > len(K) / 2
    assert not (found.growth_per_s[found.verdict == "stable"] > 0).any()


@pytest.mark.parametrize("sensor", [{}, SENSOR, {"quantum": 3.5e-5}])
def test_a_vibration_that_grows_without_a_wall_is_not_stable(sensor):
    device = {"delay": 7.0, "mode": (60.0, 0.02, 0.2)}
    damping = np.array([-12.0, -6.0, 0.0, 6.0, 17.0, 40.0, 50.0])
    found = verdicts(simulate(0 * damping, damping, seed=5, **device, **sensor))
    bend = np.diff(stacked(simulate(0 * damping, damping, rows=1600, **device)), n=2, axis=1)
    early, late = (np.sqrt((bend[:, rows] ** 2).mean(axis=1)) for rows in (slice(800, 1100), slice(1300, 1600)))
    truth = np.log(late / early) / 0.5
    assert (truth[-2:] > 5).all()
    assert (found.verdict[:5] == np.where(truth[:5] > 0, "unstable", "stable")).all()
    assert (found.verdict[-2:] != "stable").all()
    if sensor != {"quantum": 3.5e-5}:
        assert (found.verdict[-2:] == "unstable").all()
        np.testing.assert_allclose(found.growth_per_s[-2:], truth[-2:], rtol=0.05)


@pytest.mark.parametrize(("B", "seed"), [(66.0, 11), (64.0, 12), (70.0, 13)])
def test_a_mode_that_rises_from_below_the_floor_is_not_stable(B, seed):
    stiffness = np.array([1600.0, 3200.0, 4800.0, 6400.0, 7200.0, 8000.0])
    device = {"mass": 0.715, "b": 4.66, "mode": (86.6, 0.0228, 0.177)}
    damping = np.full(len(stiffness), B)
    found = verdicts(simulate(stiffness, damping, seed=seed, **device, **SENSOR))
    ideal = verdicts(simulate(stiffness, damping, **device))
    # a growth of less than 1.2 /s is not seen in 0.4 s of this sensor
    grows = ideal.growth_per_s > 1.2
    assert grows.sum() >= 5
    assert (found.verdict[grows] != "stable").all()
    assert np.abs(found.growth_per_s - ideal.growth_per_s)[grows].max() < 0.2


def test_a_vibration_that_rises_beside_a_slow_motion_is_not_stable():
    stiffness, damping = np.array([250.0, 320.0, 640.0]), np.full(3, 70.0)
    device = {"mass": 0.715, "b": 4.66, "mode": (86.6, 0.0228, 0.177)}
    found = verdicts(simulate(stiffness, damping, seed=4, **device, **SENSOR))
    ideal = verdicts(simulate(stiffness, damping, **device))
    assert (ideal.growth_per_s > 2).all()
    assert (found.verdict != "stable").all()
    np.testing.assert_allclose(found.growth_per_s, ideal.growth_per_s, atol=0.2)
