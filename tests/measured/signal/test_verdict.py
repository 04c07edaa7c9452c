from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from columns import changed, verdicts
from simulated import FALCON, LWR, simulate, spectral_radius

from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.records.trials import Trial

FIRM = {**FALCON, "mass": 1.0, "b": 34.0}
FALCON_SENSOR = {"noise": 5e-7, "quantum": 2e-6}
LWR_SENSOR = {"noise": 1e-6, "quantum": 5e-6}


def limit(dev, B, low=1.0, high=40000.0):
    """Stiffness at which the loop loses stability for a damping, by bisection on the spectral radius."""
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if spectral_radius(middle, B, **dev) < 1 else (low, middle)
    return low


@pytest.mark.parametrize("dev", [FALCON, FIRM, LWR, {**LWR, "delay": 8}, {**FALCON, "delay": 0}])
def test_ideal_verdict_is_the_sign_of_the_spectral_radius(dev):
    damping = np.linspace(0, 180 if dev["mass"] > 0.5 else 60, 12)
    K, B = (a.ravel() for a in np.meshgrid(np.r_[np.arange(200, 2000, 150.0), np.arange(2000, 30000, 1400.0)], damping))
    radius = np.array([spectral_radius(k, b, **dev) for k, b in zip(K, B, strict=True)])
    found = verdicts(simulate(K, B, **dev))
    clear = abs(radius - 1) > 1e-5
    assert found.verdict[clear].tolist() == np.where(radius[clear] > 1, "unstable", "stable").tolist()
    visible = (radius > 0.95) & (radius < 1.05)
    np.testing.assert_allclose(found.growth_per_s[visible] * 1e-3, np.log(radius[visible]), atol=1e-8)


@pytest.mark.parametrize("dev", [FALCON, LWR])
def test_ideal_verdict_right_beside_the_limit(dev):
    B = np.array([4.0, 20.0, 60.0, 90.0]) if dev is FALCON else np.array([1.0, 10.0, 40.0])
    edge = np.array([limit(dev, b) for b in B])
    for shift, verdict in ((-1.0, "stable"), (1.0, "unstable")):
        assert verdicts(simulate(edge + shift, B, **dev)).verdict.tolist() == [verdict] * len(B)


@pytest.mark.parametrize(("dev", "sensor"), [(FALCON, FALCON_SENSOR), (LWR, LWR_SENSOR), (FALCON, {"quantum": 1e-5})])
def test_sensor_moves_the_boundary_by_little_and_leaves_no_stray_verdict(dev, sensor):
    B = np.linspace(4, 120, 7) if dev is FALCON else np.linspace(2, 60, 7)
    edge = np.array([limit(dev, b) for b in B])
    share = np.r_[np.linspace(0.1, 0.95, 12), np.linspace(1.05, 1.4, 6)]
    K, S = np.outer(edge, share).ravel(), np.outer(np.ones(7), share).ravel()
    found = verdicts(simulate(K, np.repeat(B, len(share)), **dev, **sensor))
    # a tenth of the stiffness off the limit: growth of the motion stands far above the sensor
    sure = (S < 0.96) | (S > 1.09)
    assert found.verdict[sure].tolist() == np.where(S[sure] > 1, "unstable", "stable").tolist()


def test_jitter_and_sensor_leave_no_stray_verdict():
    B = np.linspace(4, 90, 6)
    edge = np.array([limit(FALCON, b) for b in B])
    share = np.r_[np.linspace(0.25, 0.8, 25), np.linspace(1.4, 1.8, 6)]
    K, S = np.outer(edge, share).ravel(), np.outer(np.ones(6), share).ravel()
    found = verdicts(simulate(K, np.repeat(B, len(share)), **FALCON, **FALCON_SENSOR, jitter=(3, 4, 5), seed=5))
    assert found.verdict.tolist() == np.where(S > 1, "unstable", "stable").tolist()


def test_limit_cycle_of_quantum_size_is_stable():
    # near the upper boundary a quantum of 10 um keeps an oscillation of a few quanta alive
    trials = simulate([9000.0, 11000.0], [140.0, 120.0], **FALCON, quantum=1e-5, rows=1500)
    assert all(np.ptp(trial.position[-200:]) > 5e-6 for trial in trials)
    assert verdicts(trials).verdict.tolist() == ["stable", "stable"]


def test_log_that_ended_at_the_travel_limit_is_unstable():
    trials = simulate([18000.0, 25000.0, 4000.0], [60.0, 90.0, 0.0], **FALCON, **FALCON_SENSOR)
    assert (trials.rows < 400).all()
    assert verdicts(trials).verdict.tolist() == ["unstable"] * 3


@pytest.mark.parametrize("dev", [FALCON, FIRM, LWR, {**LWR, "delay": 8}])
def test_growth_of_the_acceleration_at_zero_stiffness(dev):
    B = -dev["b"] + np.array([-6.0, -2.0, -0.5, -0.05, 0.05, 0.5, 2.0]) * (1 if dev["mass"] > 0.5 else 0.2)
    B = B[B <= 0]
    rate = np.array([np.log(spectral_radius(0.0, b, **dev, poles_at_one=1)) for b in B]) * 1e3
    found = verdicts(simulate(np.zeros_like(B), B, **dev))
    assert found.verdict.tolist() == np.where(rate > 0, "unstable", "stable").tolist()
    # a thousandth of b/m, and of 1 N s/m over m where the device is undamped
    np.testing.assert_allclose(found.growth_per_s, rate, atol=1e-3 * max(dev["b"], 1.0) / dev["mass"])


def test_exactly_at_the_limit_of_zero_stiffness_is_undecided():
    found = verdicts(simulate([0.0, 0.0], [0.0, -4.0], **{**FALCON, "b": 0.0}))
    assert found.verdict.tolist() == ["undecided", "unstable"]
    assert "at the limit" in found.reason[0]
    assert verdicts(simulate([0.0], [-4.0], **FALCON)).verdict.tolist() == ["undecided"]


def test_growth_at_zero_stiffness_with_sensor_and_jitter():
    B = np.array([-12.0, -8.0, -6.0, -2.0, 0.0])
    found = verdicts(simulate(np.zeros(5), B, **FALCON, **FALCON_SENSOR, jitter=(3, 4, 5)))
    rate = np.array([np.log(spectral_radius(0.0, b, **FALCON, poles_at_one=1)) for b in B]) * 1e3
    # 1 um of noise on 50 mm of cubic motion, and half a sample of delay, leave some percent of b/m = 7 1/s
    np.testing.assert_allclose(found.growth_per_s, rate, atol=0.5)
    assert found.verdict.tolist() == ["unstable"] * 3 + ["stable"] * 2


def test_nothing_to_judge_is_undecided_with_a_reason():
    short = simulate([3000.0, 0.0], [50.0, 0.0], **FALCON, rows=28)
    found = verdicts(short)
    assert found.verdict.tolist() == ["undecided"] * 2
    assert all("motion" in text for text in found.reason)
    still = simulate([3000.0, 0.0], [50.0, 0.0], **{**FALCON, "step": 1e-30})
    assert verdicts(still).verdict.tolist() == ["undecided"] * 2


def test_open_loop_log_of_a_foreign_device_without_baseline():
    t = np.arange(800) * 5e-3
    swing = 0.3 * (1 - np.exp(-0.4 * t) * np.cos(5 * t))
    foreign = Trial("p", 0.0, 0.0, 0.9, 5e-3, t, np.full(800, 0.9), swing)
    assert judge(foreign).verdict in {"stable", "undecided"}


@pytest.mark.parametrize(("rows", "verdict"), [(60, "undecided"), (119, "undecided"), (300, "stable")])
def test_a_log_that_ends_in_its_first_swing_tells_nothing(rows, verdict):
    """A soft wall without damping of its own: until the motion turns it speeds up, as behind an unstable one."""
    device = FALCON | {"mass": 0.3, "b": 2.0, "delay": 3, "step": 5.0, "travel": 1.0}
    log = simulate(np.array([100.0]), np.zeros(1), **device, rows=rows, **FALCON_SENSOR)
    found = verdicts(log)
    assert found.verdict.tolist() == [verdict]
    assert ("before the motion reverses" in found.reason[0]) == (verdict == "undecided")


def moved(rest):
    """A trial of the Falcon whose free motion after the first delay is another one [m], as its sensor shows it."""
    (trial,) = simulate([2000.0], [20.0], **FALCON, quantum=2e-6)
    position = trial.position.copy()
    position[24:] = position[0] + 8 / 2000 + rest(np.arange(trial.rows - 24))
    return dataclasses.replace(trial, position=np.round(position / 2e-6) * 2e-6)


@pytest.mark.parametrize("change", [0.5, 0.7, 1.3])
@pytest.mark.parametrize("seed", range(4))
def test_a_motion_without_modes_decides_nothing_unless_it_changes_threefold(change, seed):
    chance = np.random.default_rng(seed)
    trial = moved(lambda k: 2e-3 * chance.normal(size=len(k)) * change ** (k / len(k)))
    assert judge(trial).verdict == "undecided"


@pytest.mark.parametrize("quanta", [3, 5, 7])
def test_an_oscillation_of_some_quanta_that_is_left_of_a_far_larger_motion_is_stable(quanta):
    trial = moved(lambda k: 4e-4 * np.exp(-k / 12) * np.cos(0.5 * k) + quanta * 2e-6 * np.sin(0.9 * k))
    assert judge(trial).verdict == "stable"


def test_chance_decides_nothing_at_the_limit_of_zero_stiffness():
    # three standard errors: 0.3 of 100 trials are decided by chance
    found = verdicts(simulate(np.zeros(100), np.full(100, -FALCON["b"]), **FALCON, quantum=2e-6, noise=1e-6, seed=3))
    assert (found.verdict == "undecided").sum() >= 97


def test_errors_of_a_sensor_are_no_vibration_of_a_device_without_a_wall():
    """White errors that the baseline does not show, as of a sensor that is moved: their largest power is no tone."""
    trials = simulate(np.zeros(60), np.zeros(60), **FALCON, quantum=2e-6, noise=5e-7, seed=4)
    random = np.random.default_rng(5)

    def shaken(trial):
        return trial.position + 2e-5 * random.normal(size=trial.rows) * (np.arange(trial.rows) >= 21)

    assert set(verdicts(changed(trials, position=shaken)).verdict) == {"stable"}


def test_a_motion_that_falls_tenfold_to_a_flicker_of_the_sensor_is_stable():
    # a mode of a third of it would be left where it had not decayed
    trial = moved(lambda k: 2e-6 * (10 * np.exp(-k / 40) * np.cos(0.3 * k) + np.sin(0.9 * k)))
    position = np.where(np.arange(400) < 24, trial.position[30], trial.position)
    alone = dataclasses.replace(trial, position=position)
    assert judge(alone, find_response(trial)).verdict == "stable"
