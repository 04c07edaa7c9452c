from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student
from simulated import FALCON, LWR, simulate, spectral_radius

from pipeline.base.errors import ParameterError
from pipeline.measured.device.damping import by_decay, by_limit, from_trials
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge

FIRM = {**FALCON, "mass": 1.0, "b": 34.0}


def limit_course(dev, step):
    """B = 0, -step, ... until past -b, then a fifth of it, as the procedure of the experiments does."""
    coarse = -np.arange(0, dev["b"] + 1.5 * step, step)
    fine = coarse[-2] - np.arange(1, 6) * step / 5
    return np.r_[coarse, fine]


def estimate(dev, step, **sensor):
    B = limit_course(dev, step)
    batch = simulate(np.zeros_like(B), B, **dev, **sensor)
    return by_limit(batch.damping, batch.stiffness, judge(batch).growth_per_s)


@pytest.mark.parametrize(("dev", "step"), [(FALCON, 4.0), (FIRM, 10.0), ({**FALCON, "b": 2.0}, 4.0)])
def test_limit_on_ideal_logs(dev, step):
    found = estimate(dev, step)
    assert found.value == pytest.approx(dev["b"], rel=5e-3)
    assert found.low <= found.value <= found.high
    assert found.high - found.low <= step / 5 * 1.001


def test_limit_of_an_undamped_device_is_zero():
    found = estimate(LWR, 1.0)
    assert found.value == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("dev", "step", "sensor", "error"), [
    (FALCON, 4.0, {"quantum": 2e-6, "noise": 5e-7, "jitter": (3, 4, 5)}, 0.3),
    (FIRM, 10.0, {"quantum": 2e-6, "noise": 5e-7, "jitter": (3, 4, 5)}, 1.0),
    (LWR, 1.0, {"quantum": 5e-6, "noise": 1e-6}, 0.02),
])  # fmt: skip
def test_limit_with_sensor_and_jitter(dev, step, sensor, error):
    assert estimate(dev, step, **sensor).value == pytest.approx(dev["b"], abs=error)


def test_limit_needs_both_sides():
    zero = np.zeros(3)
    stable = by_limit(np.array([0.0, -1.0, -2.0]), zero, np.array([-4.0, -3.0, -2.0]))
    assert stable.value is None
    assert "both sides" in stable.reason
    unstable = by_limit(np.array([-5.0, -6.0]), zero[:2], np.array([1.0, 2.0]))
    assert unstable.value is None
    assert "unstable" in unstable.reason
    assert "no usable trial" in by_limit(np.array([4.0]), np.array([200.0]), np.array([-1.0])).reason
    assert by_limit(zero[:1], zero[:1], np.array([np.nan])).trials == 0
    folded = by_limit(np.array([0.0, -1.0, -2.0]), zero, np.array([1.0, 2.0, -1.0]))
    assert "single crossing" in folded.reason


def test_trials_with_stiffness_are_left_out():
    B, K, rate = np.array([0.0, -8.0, 0.0]), np.array([0.0, 0.0, 200.0]), np.array([-4.0, 4.0, 99.0])
    assert by_limit(B, K, rate).value == pytest.approx(4.0)


@pytest.mark.parametrize(("dev", "top"), [(FALCON, 13600.0), (FIRM, 29000.0), (LWR, 11800.0)])
def test_from_trials_on_ideal_logs(dev, top):
    grid = np.meshgrid(np.linspace(200, top, 11), np.linspace(0, 150 if dev["mass"] > 0.5 else 50, 9))
    K, B = (a.ravel() for a in grid)
    moderate = np.array([spectral_radius(k, b, **dev) < 1.02 for k, b in zip(K, B, strict=True)])
    batch = simulate(K[moderate], B[moderate], **dev)
    found = from_trials(batch, find_response(batch), dev["delay"])
    assert set(found.reason) == {""}
    np.testing.assert_allclose(found.viscous_damping, dev["b"], atol=max(0.005 * dev["b"], 0.02))
    np.testing.assert_allclose(found.mass, dev["mass"], rtol=1e-3)


def test_from_trials_with_a_sensor_leaves_the_median():
    K, B = np.repeat(np.linspace(400, 6000, 20), 3), np.tile([20.0, 40.0, 60.0], 20)
    batch = simulate(K, B, **FALCON, quantum=2e-6, noise=5e-7)
    found = from_trials(batch, find_response(batch), 4)
    assert np.nanmedian(found.viscous_damping) == pytest.approx(4.0, abs=0.1)


def test_from_trials_gives_reasons():
    no_edge = simulate([3000.0], [50.0], **FALCON, baseline=0)
    assert "no baseline" in from_trials(no_edge, find_response(no_edge), 4).reason[0]
    short = simulate([3000.0], [50.0], **FALCON, rows=35)
    assert "samples after the edge" in from_trials(short, find_response(short), 4).reason[0]


def decay(dev, B, **sensor):
    batch = simulate(np.zeros_like(B), B, **dev, **sensor)
    growth = judge(batch).growth_per_s
    return by_decay(
        batch.damping, batch.stiffness, growth, dev["mass"], delay_samples=dev["delay"], sampling_period_s=1e-3
    )


@pytest.mark.parametrize("dev", [FALCON, FIRM, {**FALCON, "b": 2.0, "delay": 0}])
@pytest.mark.parametrize("B", [0.0, -1.5, 4.0])
def test_decay_of_the_velocity_on_ideal_logs(dev, B):
    found = decay(dev, np.full(3, B))
    # at B = 0 exact but for the fit of the rate; else (s T)^2/12 of B, at s = 38/s 1e-4
    assert found.value == pytest.approx(dev["b"], rel=1e-3)
    assert found.significant


def test_decay_with_a_sensor_holds_the_truth_in_its_interval():
    found = decay(FALCON, np.repeat([0.0, -1.0, -2.0], 5), quantum=2e-6, noise=5e-7)
    assert found.low < 4.0 < found.high
    assert found.high - found.low < 0.05
    assert found.trials == 15


def test_no_damping_is_not_significant_and_negative_damping_is_said():
    # other B from trial to trial: ten alike would share the rounding of one and the same motion
    zero = decay(LWR, np.linspace(-0.1, 0.1, 12), quantum=5e-6, noise=1e-6)
    assert zero.significant is False
    assert zero.low <= 0 <= zero.high
    assert zero.reason == "not significantly different from 0"
    driven = by_decay(np.zeros(3), np.zeros(3), np.array([1.0, 1.1, 0.9]), 2.0, delay_samples=2, sampling_period_s=1e-3)
    assert driven.value == pytest.approx(-2.0)
    assert driven.significant
    # Student's t with two degrees of freedom on a standard error of 0.2/sqrt 3
    assert driven.high == pytest.approx(-2.0 + student.ppf(0.975, 2) * 0.2 / np.sqrt(3), rel=1e-6)


def test_decay_reasons():
    options = {"delay_samples": 4, "sampling_period_s": 1e-3}
    one = by_decay(np.zeros(2), np.array([0.0, 200.0]), np.array([-7.0, -9.0]), 0.58, **options)
    assert (one.value, one.low, one.trials) == (pytest.approx(4.06), None, 1)
    assert "no interval" in one.reason
    assert "no usable trial" in by_decay(np.zeros(1), np.ones(1), np.zeros(1), 0.58, **options).reason
    with pytest.raises(ParameterError, match="mass"):
        by_decay(np.zeros(1), np.zeros(1), np.zeros(1), 0.0, **options)
