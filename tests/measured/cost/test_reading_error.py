"""Standard errors of readings against the answers of a loop of its own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from columns import Columns, stacked
from measured_logs import Logs
from sensor_trials import DELAY, EDGE, FREE, SENSORS, measured, shipped, trials, truth
from simulated import FALCON, plant, simulate

from pipeline.device.loop import Loop
from pipeline.device_data.devices import load_device
from pipeline.measured.cost.reading_error import reading_error, sensor_error
from pipeline.measured.signal.response import find_response
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import simulate as simulate_device


def injected(K, B, row, size, rows=120):
    """Readings of a trial whose sensor errs once, relative to those of the trial without."""
    A, g = plant(FALCON["mass"], FALCON["b"], 1e-3)
    readings = []
    for error in (0.0, size):
        x, v, seen, sent = 0.0, 0.0, [], []
        for k in range(rows):
            seen.append(x + (error if k == row else 0.0))
            change = seen[k] - seen[max(k - 1, 0)]
            sent.append((8.0 if k >= EDGE else 0.0) - K * (seen[k] - seen[0]) - B * change / 1e-3)
            force = sent[k - DELAY] if k >= DELAY else 0.0
            x, v = A[0, 0] * x + A[0, 1] * v + g[0] * force, A[1, 0] * x + A[1, 1] * v + g[1] * force
        readings.append(np.array(seen))
    return readings[1] - readings[0]


def test_weights_are_the_answer_of_the_loop_to_an_error():
    K, B = np.array([4000.0, 9000.0]), np.array([70.0, 110.0])
    for i, trial in enumerate(simulate(K, B, **FREE)):
        weight = reading_error(trial, find_response(trial), DELAY, sensor=1e-6).weight
        answer = injected(K[i], B[i], 30, 1e-6)
        # the loop is linear: only rounding differs, of positions of 0.1 m against errors of 1 um
        np.testing.assert_allclose(weight[:90], answer[30:] / 1e-6, atol=1e-4)
        # an error of the first reading lasts, since the wall rests on it: all later errors are relative to it
        first = injected(K[i], B[i], 0, 1e-6)[1:] / 1e-6 - 1.0
        np.testing.assert_allclose(-np.cumsum(weight)[:99], first[:99], atol=1e-3)


@pytest.mark.parametrize(("quantum", "noise"), SENSORS)
def test_standard_errors_of_readings(quantum, noise):
    logs = measured(quantum, noise)
    error, seen, ideal = Columns(logs.errors), stacked(logs.trials), stacked(truth()[0])
    off = (seen - ideal[:, : seen.shape[1]])[:, EDGE + DELAY :]
    inside = np.abs(off) < 1.96 * error.deviation[:, EDGE + DELAY :]
    assert 0.90 < inside.mean() < 0.99
    # what the wall feeds back is no small part: the sensor alone would explain fewer
    assert (np.abs(off) < 1.96 * error.sensor[:, None]).mean() < inside.mean() - 0.03


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.25, 0.5, 1.0])
def test_noise_of_a_rounded_baseline_counts_once(noise):
    """Devices at rest anywhere in a cell of the grid; a wall would hide up to 8 % more of the rounding."""
    random = np.random.default_rng(7)
    readings = np.round(random.uniform(0, 1, (2000, 1)) + noise * random.standard_normal((2000, 20)))
    scatter = np.sqrt(np.mean(np.diff(readings, n=2, axis=1) ** 2, axis=1) / 6)
    found = sensor_error(scatter, np.ones(2000), np.full(2000, 20))
    assert found == pytest.approx(np.hypot(noise, np.sqrt(1 / 12)), rel=0.08)


@pytest.mark.parametrize("of", ["falcon 1", "lwr delay-2", "lwr delay-8"])
def test_a_wall_that_pulls_the_device_off_the_edge_of_a_quantum_hides_no_noise(of):
    """Within 5.5 %: chance moves it by 2 %, and walls behind a long delay, which pull late, by 3 %."""
    sensor = load_device(of.split()[0]).sensor
    found = Columns(find_response(trial) for trial in shipped(*of.split(), 600)[0])
    error = sensor_error(found.sensor_noise, found.sensor_quantum, found.edge_row)
    assert error == pytest.approx(np.hypot(sensor.noise, sensor.quantum / np.sqrt(12)), rel=0.055)


def test_jitter_magnifies_the_errors_and_that_is_seen():
    """Against the same trials with the same jitter and an ideal sensor."""
    K, B = trials()
    loop = Loop(FALCON["mass"], FALCON["b"], 1e-3, DELAY, jitter_samples=(3, 4, 5))
    setup = Setup(loop, 8.0, 400, EDGE, 0.12, 10.0)
    ideal = simulate_device(setup, K, B, seed=2)
    logs = Logs(simulate_device(setup.with_loop(sensor={"quantum": 2e-6, "noise": 5e-7}), K, B, seed=2), DELAY)
    error = Columns(logs.errors)
    off = np.abs(stacked(logs.trials) - stacked(ideal))[:, EDGE + DELAY :]
    settled = Columns(logs.verdicts).verdict == "stable"
    inside = off < 1.96 * error.deviation[:, EDGE + DELAY :]
    assert inside[settled].mean() > 0.85
    # of what the step response alone explains far fewer would hold
    alone = Columns(Logs(ideal, DELAY, sensor=error.sensor[0], gain=1.0).errors).deviation
    assert (off < 1.96 * alone[:, EDGE + DELAY :])[settled].mean() < 0.6
    assert np.median(error.gain) > 4
    assert np.median(Columns(measured(2e-6, 5e-7).errors).gain) == 1.0


def test_a_mode_that_decays_slowly_is_no_rest():
    """LWR at d = 7: the last fifths of the stiffly damped trials shrink by 0.65 to 0.75, far above the sensor."""
    K = np.array([1000.0, 800.0, 800.0, 600.0, 600.0, 480.0, 800.0, 800.0])
    B = np.array([30.0, 31.0, 32.0, 33.0, 34.0, 35.0, 20.0, 21.0])
    loop = Loop(0.19, 0.0, 1e-3, 7.0)
    read = dataclasses.replace(loop, sensor={"quantum": 5e-6})
    logs = Logs(simulate_device(Setup(read, 15.0, 350, EDGE, travel=1.0), K, B, seed=1), 7)
    # the model of a constant delay explains the sensor's part: nothing exceeds it
    assert (Columns(logs.errors).gain == 1).all()
    # so that the last two, which end in the sensor's noise, are summed down to it: 60 samples would end at 5 %
    found = logs.energy(0.19)
    assert (found.horizon_samples[-2:] > 120).all()
    true = Logs(simulate_device(Setup(loop, 15.0, 2000, EDGE, travel=1.0), K, B, seed=1), 7).summed(0.19)
    np.testing.assert_allclose(found.value[-2:], true[-2:], rtol=0.01)
