from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm
from simulated import FALCON, LWR, simulate

from pipeline.device_data.devices import load_device
from pipeline.measured.device.delay import first_change
from pipeline.measured.device.onset import motion_onset, rounded
from pipeline.measured.experiment.known_delay import estimate_delay
from pipeline.measured.signal.response import declare_edge, find_response
from pipeline.records.batch import TrialBatch
from pipeline.simulation.course import run_course
from pipeline.simulation.simulate import simulate as simulate_device

FIRM = {**FALCON, "mass": 1.0, "b": 34.0}
K = np.linspace(400, 12000, 40)
B = np.linspace(0, 90, 40)


def found_in(batch):
    response = find_response(batch)
    first = first_change(batch, response)
    return first, motion_onset(batch, response, first)


def spread(trials=1000):
    """Trials at random (K, B): each rests at another place between two steps of the sensor."""
    random = np.random.default_rng(5)
    return random.uniform(200, 6000, trials), random.uniform(0, 60, trials)


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8])
def test_exact_without_damping(delay):
    batch = simulate(K, B, **{**FALCON, "delay": delay, "b": 0.0})
    onset = found_in(batch)[1].delay_samples
    # the double integral of a held command is the exact motion; the positions carry 16 digits
    np.testing.assert_allclose(onset, delay, atol=1e-6)


def test_neglected_damping_is_inside_the_standard_error():
    onset = found_in(simulate(K, B, **FALCON))[1]
    error = onset.delay_samples - 4
    # b/m = 6.9/s, where the standard error allows 10/s
    np.testing.assert_allclose(error / onset.standard_error, -0.66, atol=0.1)


@pytest.mark.parametrize(("quantum", "noise", "late", "bias", "scatter"), [
    # (a) must be late by at least this; limits of (b): issue's 0.3 at 60 um, where 0.06 +- 0.19 is found, and
    # the standard errors that rounding and noise give at the finer ones
    (2e-6, 1e-6, 0.2, 0.05, 0.10),
    (1e-5, 1e-6, 0.4, 0.05, 0.15),
    (6e-5, 1e-6, 1.5, 0.30, 0.40),
])  # fmt: skip
def test_bias_and_scatter_over_1000_trials(quantum, noise, late, bias, scatter):
    batch = simulate(*spread(), **FALCON, rows=80, quantum=quantum, noise=noise)
    first, onset = found_in(batch)
    seen = first.delay_samples >= 0
    known = np.isfinite(onset.delay_samples)
    assert known.mean() > 0.98
    assert np.mean(first.delay_samples[seen] - 4) > late
    error = onset.delay_samples[known] - 4
    assert abs(error.mean()) < bias
    assert error.std() < scatter
    # standard errors tell what happens: not less than four fifths of it, and not three times as much
    ratio = np.sqrt(np.mean((error / onset.standard_error[known]) ** 2))
    assert 1 / 3 < ratio < 1.25


def test_a_firm_grip_costs_a_fraction_of_a_sample():
    # b/m = 34/s, beyond the 10/s that the standard error allows: early, by up to 0.3 sample at 10 um
    batch = simulate(*spread(300), **FIRM, rows=80, quantum=1e-5, noise=1e-6)
    onset = found_in(batch)[1]
    assert -0.4 < np.nanmean(onset.delay_samples - 4) < 0


def fractional(delay, fine=10, rows=60, edge=20, K=2000.0, B=20.0, mass=0.58, T=1e-3):
    """One closed-loop trial with a delay in tenths of a sample: the plant steps ten times per sample."""
    block = np.zeros((3, 3))
    block[0, 1], block[1, 2] = 1.0, 1 / mass
    moved = expm(block * T / fine)
    state, shift = np.zeros(2), round(delay * fine)
    position, command, pending = np.zeros(rows), np.zeros(rows), np.zeros(rows * fine + shift + fine)
    for k in range(rows):
        position[k] = state[0]
        change = position[k] - position[max(k - 1, 0)]
        command[k] = 8.0 * (k >= edge) - K * position[k] - B * change / T
        pending[k * fine + shift : (k + 1) * fine + shift] = command[k]
        for i in range(k * fine, (k + 1) * fine):
            state = moved[:2, :2] @ state + moved[:2, 2] * pending[i]
    one = [np.array([v]) for v in (K, B, 8.0, T)]
    return TrialBatch(("t",), *one, np.array([rows]), np.arange(rows)[None] * T, command[None], position[None])


@pytest.mark.parametrize("delay", [0.3, 2.5, 4.2, 4.8])
def test_a_fraction_is_found(delay):
    first, onset = found_in(fractional(delay))
    assert first.delay_samples.tolist() == [int(delay)]
    assert onset.delay_samples[0] == pytest.approx(delay, abs=1e-6)


def test_irregular_stamps_count():
    batch = fractional(4.0)
    # the same samples said to be twice as far apart are the motion of another mass with the same delay in samples
    slow = dataclasses.replace(batch, time=2 * batch.time, sampling_period_s=2 * batch.sampling_period_s)
    assert found_in(slow)[1].delay_samples[0] == pytest.approx(4.0, abs=1e-6)
    gap = batch.time.copy()
    gap[0, 21:] += 3e-4  # a pause behind the command edge: the delay is longer by it
    late = found_in(dataclasses.replace(batch, time=gap))[1].delay_samples[0]
    assert late == pytest.approx(4.3, abs=1e-6)


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8])
def test_rounded_takes_lateness_back(delay):
    # half of 5 um is passed within the first sample, 1.5 quanta are not: what is seen is late in many trials
    batch = simulate(K, B, **{**FALCON, "delay": delay}, quantum=5e-6, noise=1e-6)
    first, onset = found_in(batch)
    has = first.delay_samples >= 0
    assert has.mean() > 0.9
    assert np.mean(first.delay_samples[has] > delay) > 0.5
    assert np.mean(rounded(first, onset)[has] == delay) > 0.95
    assert rounded(first, onset, largest_error=0.0).tolist() == first.delay_samples.tolist()


@pytest.mark.parametrize(("dev", "quantum", "noise"), [(FALCON, 2e-6, 5e-7), (LWR, 5e-6, 1e-6)])
def test_sensor_of_the_shipped_devices(dev, quantum, noise):
    first, onset = found_in(simulate(K, B, **dev, quantum=quantum, noise=noise))
    assert np.mean(rounded(first, onset) == dev["delay"]) > 0.95


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
    found = rounded(*found_in(course.batch))
    has = found >= 0
    assert has.mean() > 0.7
    assert np.mean((found[has] < 3) | (found[has] > 5)) < 0.01
    assert np.mean(found[has] == true[has]) > 0.95
    estimate = estimate_delay(found)
    assert (estimate.value, estimate.low, estimate.high) == (4.0, 3.0, 6.0)


def test_reasons():
    batch = simulate([3000.0], [50.0], **FALCON, baseline=0)
    first, onset = found_in(batch)
    assert "no baseline" in onset.reason[0]
    assert np.isnan(onset.delay_samples[0])
    assert rounded(first, onset).tolist() == [-1]
    response = declare_edge(batch, find_response(batch), 0)
    declared = motion_onset(batch, response, first_change(batch, response))
    assert declared.delay_samples[0] == pytest.approx(4, abs=0.02)
    coarse = simulate([3000.0], [50.0], **FALCON, quantum=5e-4)
    assert "standard error" in found_in(coarse)[1].reason[0]
    short = simulate([3000.0], [50.0], **FALCON, rows=27)
    assert "no window" in found_in(short)[1].reason[0]
