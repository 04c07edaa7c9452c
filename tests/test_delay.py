from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import FALCON, LWR, simulate

from pipeline.aggregate import estimate_delay
from pipeline.course import run_course
from pipeline.delay import first_change
from pipeline.devices import load_device
from pipeline.response import find_response
from pipeline.simulate import simulate as simulate_device

K = np.linspace(400, 12000, 40)
B = np.linspace(0, 90, 40)


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8])
def test_exact_on_ideal_logs(delay):
    batch = simulate(K, B, **{**FALCON, "delay": delay})
    assert first_change(batch, find_response(batch)).delay_samples.tolist() == [delay] * 40


def test_negative_step():
    batch = simulate(K, B, **{**FALCON, "step": -8.0})
    assert set(first_change(batch, find_response(batch)).delay_samples.tolist()) == {4}


@pytest.mark.parametrize(("dev", "quantum", "noise"), [(FALCON, 2e-6, 5e-7), (LWR, 5e-6, 1e-6)])
def test_sensor_leaves_the_median_right(dev, quantum, noise):
    batch = simulate(K, B, **dev, quantum=quantum, noise=noise)
    found = first_change(batch, find_response(batch)).delay_samples
    assert np.median(found) == dev["delay"]
    assert np.mean(found == dev["delay"]) > 0.95


@pytest.mark.parametrize(("quantum", "late"), [(1e-5, (1,)), (6e-5, (1, 2))])
def test_a_threshold_is_late_by_the_time_to_move_as_far(quantum, late):
    # 8 N on 0.58 kg: 6.9 um after 1 ms, 28 um after 2 ms, 62 um after 3 ms; rounding shows half a quantum
    batch = simulate(K, B, **FALCON, quantum=quantum)
    threshold = np.full(len(K), 0.5 * quantum)
    found = first_change(batch, find_response(batch), threshold=threshold).delay_samples
    needed = np.sqrt(2 * 0.5 * quantum * 0.58 / 8) * 1e3
    assert (found >= 4).all()
    assert (found <= 4 + max(late)).all()
    assert np.median(found) in {4 + int(np.ceil(needed)) - 1, 4 + max(late)}


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8])
def test_lateness_is_taken_back_where_readings_allow(delay):
    # half of 5 um is passed within the first sample, 1.5 quanta are not: what is seen is late in many trials
    batch = simulate(K, B, **{**FALCON, "delay": delay}, quantum=5e-6, noise=1e-6)
    response = find_response(batch)
    found = first_change(batch, response)
    late = first_change(batch, response, threshold=1.5 * response.sensor_quantum + 3 * response.sensor_noise)
    has = found.delay_samples >= 0
    assert has.mean() > 0.9
    assert np.mean(found.delay_samples[has] == delay) > 0.9
    assert np.mean(late.delay_samples[has] > delay) > 0.5


def test_a_quantum_too_coarse_to_extrapolate_stays_late():
    batch = simulate(K, B, **FALCON, quantum=6e-5)
    found = first_change(batch, find_response(batch)).delay_samples
    assert (found >= 4).all()
    assert (found <= 6).all()
    # two or three samples to move half a quantum: late by one or two, and not corrected by a guess
    assert np.mean(found > 4) > 0.9


def test_a_trial_that_moves_before_the_step_has_no_delay():
    batch = simulate([3000.0], [50.0], **FALCON, quantum=2e-6)
    drifting = batch.position.copy()
    drifting[0, :20] += 2e-6 * np.round(4 * np.sin(np.arange(20) / 6))
    found = first_change(batch, find_response(batch))
    assert found.delay_samples.tolist() == [4]
    moving = dataclasses.replace(batch, position=drifting)
    response = dataclasses.replace(find_response(moving), edge_row=np.array([20]))
    found = first_change(moving, response)
    assert found.delay_samples.tolist() == [-1]
    assert found.reason[0].startswith("moving before the step: 8e-06 peak to peak")


def test_true_jitter_of_a_course_with_sensor():
    """Delay of each trial against the one that it had: the first interval in which a command of the step acts."""
    device = load_device("falcon")
    course = run_course(device, "1", seed=1, coarsen=2)
    K, B = course.batch.stiffness, course.batch.damping
    quiet = dataclasses.replace(course.setup, noise=0.0, quantum=0.0)
    ideal = simulate_device(quiet, K, B, seed=1, stream="falcon/1")
    moved = ideal.position != ideal.position[:, :1]
    true = np.argmax(moved, axis=1) - course.setup.edge_row - 1
    assert np.unique(true).tolist() == [3, 4, 5]
    found = first_change(course.batch, find_response(course.batch)).delay_samples
    has = found >= 0
    assert has.mean() > 0.7
    assert np.mean((found[has] < 3) | (found[has] > 5)) < 0.01
    assert np.mean(found[has] == true[has]) > 0.95
    estimate = estimate_delay(found)
    assert (estimate.value, estimate.low, estimate.high) == (4.0, 3.0, 6.0)


def test_jitter_shows_as_the_factors_3_to_5():
    batch = simulate(np.repeat(K, 10), np.repeat(B, 10), **FALCON, jitter=(3, 4, 5), seed=3)
    found = first_change(batch, find_response(batch)).delay_samples
    values, counts = np.unique(found, return_counts=True)
    assert values.tolist() == [3, 4, 5]
    # the newest command holds: P(3) = 1/3, P(5) = P(first slow) P(second not fast) = 1/3 * 2/3
    np.testing.assert_allclose(counts / len(found), [1 / 3, 4 / 9, 2 / 9], atol=0.08)


def test_reasons():
    batch = simulate([3000.0], [50.0], **FALCON, baseline=0)
    found = first_change(batch, find_response(batch))
    assert found.delay_samples.tolist() == [-1]
    assert "no baseline" in found.reason[0]
    moving = simulate([3000.0], [50.0], **FALCON)
    response = find_response(moving)
    still = dataclasses.replace(moving, position=np.full_like(moving.position, 0.1))
    found = first_change(still, response)
    assert found.delay_samples.tolist() == [-1]
    assert "no position change" in found.reason[0]
