from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from columns import changed, responses
from simulated import FALCON, LWR, simulate

from pipeline.measured.signal.response import external_force, find_response
from pipeline.records.trials import Trials

K = np.array([200.0, 3000.0, 12000.0, 0.0, 15000.0])
B = np.array([4.0, 50.0, 90.0, -4.0, 120.0])


def test_edge_start_and_final_position_of_ideal_logs():
    found = responses(simulate(K, B, **FALCON, baseline=17))
    assert found.edge_row.tolist() == [17] * 5
    assert found.floor.tolist() == [0.0] * 5
    # the simulator starts each trial so that it ends at the workspace centre (6.1)
    np.testing.assert_allclose(found.position_final_expected[[0, 1, 2, 4]], 0.12, rtol=1e-15)
    assert np.isnan(found.position_final_expected[3])
    assert "K > 0" in found.reason[3]
    assert [bool(text) for text in found.reason] == [False, False, False, True, False]


@pytest.mark.parametrize("quantum", [2e-6, 1e-5, 6e-5])
@pytest.mark.parametrize("jitter", [(), (3, 4, 5)])
def test_edge_and_quantum_with_a_coarse_sensor(quantum, jitter):
    # at B = 184 a quantum of 60 um changes the wall force by 11 N, more than the step of 8 N
    trials = simulate(
        K, np.array([4.0, 184.0, 90.0, -4.0, 120.0]), **FALCON, quantum=quantum, noise=5e-7, jitter=jitter
    )
    found = responses(trials)
    assert found.edge_row.tolist() == [20] * 5
    np.testing.assert_allclose(found.sensor_quantum, quantum, rtol=1e-6)


def test_quantum_of_a_motion_that_always_changes_by_many_quanta():
    found = responses(simulate([120.0, 200.0], [20.0, 60.0], **LWR, quantum=5e-6, noise=1e-6))
    np.testing.assert_allclose(found.sensor_quantum, 5e-6, rtol=1e-6)


@pytest.mark.parametrize("quantum", [2e-6, 1e-5, 6e-5])
@pytest.mark.parametrize("stored", [
    lambda x: x.astype(np.float32).astype(np.float64),
    lambda x: np.round(x, 7),
    lambda x: np.round(57.295779513 * x, 5) / 57.295779513,
], ids=["single precision", "seven digits", "other unit, five digits"])  # fmt: skip
def test_quantum_of_positions_that_were_rounded_when_they_were_stored(quantum, stored):
    # 1.7 quanta a count: the grid of the sensor is none of the decimal one. The trial with K = 0 runs away within
    # 90 rows and shows no readings of the same place, which would tell how coarsely they were stored
    moving = K > 0
    trials = simulate(K[moving], B[moving], **FALCON, quantum=1.7 * quantum, noise=5e-7)
    found = responses(changed(trials, position=lambda trial: stored(trial.position)))
    # a change carries up to 5 % of a quantum from the storing (2e-6, five digits), the mean over dozens 0.5 %
    np.testing.assert_allclose(found.sensor_quantum, 1.7 * quantum, rtol=5e-3)


@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-6, 1e-5])
def test_a_continuous_signal_has_no_quantum(noise):
    many = np.linspace(300, 9000, 300)
    trials = simulate(many, many / 100, **FALCON, noise=noise, rows=200)
    assert not responses(trials).sensor_quantum.any()
    # nor where it was stored in single precision, whose own grid is not even: its step changes with the value
    single = changed(trials, position=lambda trial: trial.position.astype(np.float32).astype(np.float64))
    assert (responses(single).sensor_quantum < 1.2e-7 * 0.25).all()


def test_noise_is_that_of_the_sensor():
    trials = simulate(np.full(40, 400.0), np.full(40, 4.0), **FALCON, noise=1e-6, baseline=100)
    found = responses(trials)
    assert np.median(found.sensor_noise) == pytest.approx(1e-6, rel=0.1)
    assert (found.sensor_quantum == 0).all()
    np.testing.assert_allclose(found.floor, 6 * found.sensor_noise)


def test_a_quantum_alone_is_no_noise():
    found = responses(simulate(K, B, **FALCON, quantum=1e-5))
    assert found.sensor_noise.tolist() == [0.0] * 5
    np.testing.assert_allclose(found.floor, 1e-5, rtol=1e-6)


def with_baseline(move, rows=60):
    """Trials whose baseline of ``rows`` samples carries the given motion, shape (n, rows)."""
    n = len(move)
    trials = []
    for trial, motion in zip(simulate(np.full(n, 400.0), np.full(n, 4.0), **FALCON, baseline=rows), move, strict=True):
        position = trial.position.copy()
        position[:rows] += motion
        # the controller sees the motion: command = step - wall, so that the edge stays where it is
        wall = 400.0 * (position - position[0]) + 4.0 * np.diff(position, prepend=position[0]) * 1e3
        command = np.where(np.arange(trial.rows) >= rows, 8.0, 0.0) - wall
        trials.append(dataclasses.replace(trial, position=position, command=command))
    return Trials.of(trials)


@pytest.mark.parametrize(("period", "share"), [(35, 0.01), (16, 0.05)])
def test_slow_chatter_before_the_step_is_motion_and_not_noise(period, share):
    random = np.random.default_rng(1)
    noise = 5e-7 * random.standard_normal((50, 60))
    phase = random.uniform(0, 2 * np.pi, (50, 1))
    chatter = 1e-5 * np.sin(2 * np.pi * np.arange(60) / period + phase)
    found = responses(with_baseline(noise + chatter))
    assert found.edge_row.tolist() == [60] * 50
    # variances add; 10 um of chatter would be a standard deviation of 7 um
    assert np.median(found.sensor_noise) == pytest.approx(np.hypot(5e-7, share * 1e-5), rel=0.1)
    assert (found.baseline_motion > 1.9e-5).all()
    assert (found.baseline_motion < 2.3e-5).all()
    quiet = responses(with_baseline(noise))
    assert (quiet.baseline_motion == 0).mean() > 0.95


def test_a_short_baseline_tells_no_noise():
    found = responses(simulate(K, B, **FALCON, noise=1e-6, baseline=4))
    assert np.isnan(found.sensor_noise).all()


def test_negative_step():
    trials = simulate(K, B, **{**FALCON, "step": -8.0})
    assert responses(trials).edge_row.tolist() == [20] * 5


def test_external_force_is_the_step():
    force = external_force(simulate([3000.0], [50.0], **FALCON, quantum=1e-5, jitter=(3, 4, 5))[0])
    np.testing.assert_allclose(force[:20], 0, atol=1e-9)
    np.testing.assert_allclose(force[20:], 8, atol=1e-9)


def test_step_in_row_0_has_no_edge():
    found = responses(simulate([3000.0], [50.0], **FALCON, baseline=0))
    assert found.edge_row.tolist() == [-1]
    assert "no baseline" in found.reason[0]


def test_no_step_at_all_has_no_edge():
    (trial,) = simulate([3000.0], [50.0], **FALCON)
    still = dataclasses.replace(trial, command=np.zeros(trial.rows), position=np.full(trial.rows, 0.1))
    response = find_response(still)
    assert response.edge_row == -1
    assert "no command edge" in response.reason


def test_a_short_flicker_is_no_edge():
    (trial,) = simulate([3000.0], [50.0], **FALCON)
    command = trial.command.copy()
    command[5:7] += 8.0
    assert find_response(dataclasses.replace(trial, command=command)).edge_row == 20


def test_a_command_of_another_size_sign_or_kind_has_no_edge():
    """The wall force alone crosses half the step as well, only later: an edge there would give a wrong delay."""
    trials = simulate([3000.0, 4000.0], [20.0, 30.0], **FALCON, quantum=1e-5)
    late = {
        "row (2|3|4)\\d, but the command does not": (0.0, 1e-3, 0.1),
        "first jumps against the step \\(8\\), in row 20": (-1.0,),
    }
    for words, factors in late.items():
        for factor in factors:
            found = responses(changed(trials, command=lambda trial, factor=factor: factor * trial.command))
            assert found.edge_row.tolist() == [-1, -1], factor
            for reason in found.edge_reason:
                assert re.search(words, reason), (factor, reason)


def test_chatter_larger_than_the_step_does_not_hide_the_edge():
    # unstable from noise alone: long before the step the command swings by many newtons
    trials = simulate([6000.0] * 5, [60.0] * 5, **{**LWR, "delay": 8}, noise=1e-5, baseline=90)
    found = responses(trials)
    assert any(np.abs(trial.command[:90]).max() > 15 for trial in trials)
    assert found.edge_row.tolist() == [90] * 5


def test_measured_final_position_is_the_mean_of_the_last_tenth():
    trials = simulate([3000.0, 200.0], [50.0, 0.0], **FALCON, rows=137)
    expected = [np.mean(trial.position[-13:]) for trial in trials]
    np.testing.assert_allclose(responses(trials).position_final_measured, expected, rtol=1e-14)


@pytest.mark.parametrize(("quantum", "seen"), [(1.6e-12, True), (1.25e-12, False)])
def test_a_grid_that_rounding_of_positions_hides_is_no_quantum(quantum, seen):
    """At 0.1 m doubles are 1.4e-17 apart: a hundred thousand of them, 64 units of rounding a thousandfold."""
    steps = np.cumsum(np.random.default_rng(3).integers(-3, 4, 400))
    (trial,) = simulate([3000.0], [50.0], **FALCON)
    response = find_response(dataclasses.replace(trial, position=0.1 + quantum * steps[: trial.rows]))
    assert response.sensor_quantum == (pytest.approx(quantum, rel=1e-3) if seen else 0.0)
