from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import FALCON, LWR, simulate

from pipeline.delay import first_change
from pipeline.response import find_response

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
    assert np.mean(found == dev["delay"]) > 0.85


@pytest.mark.parametrize(("quantum", "late"), [(1e-5, (1,)), (6e-5, (1, 2))])
def test_coarse_sensor_is_late_by_the_time_to_move_one_quantum(quantum, late):
    # 8 N on 0.58 kg: 6.9 um after 1 ms, 28 um after 2 ms, 62 um after 3 ms; rounding shows half a quantum
    batch = simulate(K, B, **FALCON, quantum=quantum)
    found = first_change(batch, find_response(batch)).delay_samples
    needed = np.sqrt(2 * 0.5 * quantum * 0.58 / 8) * 1e3
    assert (found >= 4).all()
    assert (found <= 4 + max(late)).all()
    assert np.median(found) in {4 + int(np.ceil(needed)) - 1, 4 + max(late)}


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
    assert "no command edge" in found.reason[0]
    moving = simulate([3000.0], [50.0], **FALCON)
    response = find_response(moving)
    still = dataclasses.replace(moving, position=np.full_like(moving.position, 0.1))
    found = first_change(still, response)
    assert found.delay_samples.tolist() == [-1]
    assert "no position change" in found.reason[0]
