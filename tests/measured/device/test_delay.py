from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import FALCON, LWR, simulate

from pipeline.base.errors import ParameterError
from pipeline.measured.device.delay import first_change
from pipeline.measured.signal.response import declare_edge, find_response

K = np.linspace(400, 12000, 40)
B = np.linspace(0, 90, 40)


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8])
def test_exact_on_ideal_logs(delay):
    batch = simulate(K, B, **{**FALCON, "delay": delay})
    assert first_change(batch, find_response(batch)).delay_samples.tolist() == [delay] * 40


def test_negative_step():
    batch = simulate(K, B, **{**FALCON, "step": -8.0})
    assert set(first_change(batch, find_response(batch)).delay_samples.tolist()) == {4}


@pytest.mark.parametrize("dev", [FALCON, LWR])
def test_a_fine_quantum_is_passed_within_one_sample(dev):
    # 8 N on 0.58 kg move 6.9 um in the first sample, 15 Nm on 0.19 kg m^2 40 urad; half a quantum is 1 and 2.5
    batch = simulate(K, B, **dev, quantum=2e-6 if dev is FALCON else 5e-6)
    assert set(first_change(batch, find_response(batch)).delay_samples.tolist()) == {dev["delay"]}


def test_noise_makes_a_fine_quantum_late():
    # 1.5 quanta and three standard deviations are 6 um, that one sample just passes
    batch = simulate(K, B, **FALCON, quantum=2e-6, noise=1e-6)
    found = first_change(batch, find_response(batch)).delay_samples
    has = found >= 0
    assert has.mean() > 0.95
    assert set(found[has].tolist()) == {4, 5}


def test_a_coarse_quantum_is_late():
    batch = simulate(K, B, **FALCON, quantum=6e-5)
    found = first_change(batch, find_response(batch)).delay_samples
    assert (found >= 4).all()
    assert (found <= 6).all()
    # two or three samples to move half a quantum: late by one or two
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
    assert found.reason[0].startswith("moving before the step, peak to peak ")
    assert "times what its sensor shows at rest; let the device come to rest" in found.reason[0]


def test_a_declared_step_row_replaces_the_baseline():
    batch = simulate([3000.0], [50.0], **FALCON, baseline=0)
    response = declare_edge(batch, find_response(batch), 0)
    assert first_change(batch, response).delay_samples.tolist() == [4]
    kept = declare_edge(batch, find_response(batch), -1)  # -1 leaves a trial as its log shows it
    assert kept.edge_reason == find_response(batch).edge_reason
    for row in (-2, 400):
        with pytest.raises(ParameterError, match="expected 0 to 399"):
            declare_edge(batch, response, row)


def test_what_the_baseline_tells_is_read_from_the_rows_before_the_declared_step():
    """A log whose command shows no step, so that nothing is known of its sensor until the step is declared."""
    batch = simulate([3000.0] * 50, [50.0] * 50, **FALCON, baseline=40, noise=5e-6, quantum=1e-7)
    found = find_response(batch)
    hidden = find_response(dataclasses.replace(batch, command=-batch.command))
    assert np.isnan(hidden.sensor_noise).all()
    declared = declare_edge(batch, hidden, found.edge_row)
    np.testing.assert_array_equal(declared.sensor_noise, found.sensor_noise)
    np.testing.assert_array_equal(declared.floor, found.floor)
    np.testing.assert_array_equal(declared.baseline_motion, found.baseline_motion)
    # fifteen rows of noise, read where the trial says and not where the command shows it
    early = declare_edge(batch, found, 15)
    assert (early.sensor_noise != found.sensor_noise).mean() > 0.9
    np.testing.assert_allclose(np.median(early.sensor_noise), 5e-6, rtol=0.15)
    assert np.isnan(declare_edge(batch, found, 0).sensor_noise).all()


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
    assert found.first_row.tolist() == [-1]
    moving = simulate([3000.0], [50.0], **FALCON)
    response = find_response(moving)
    still = dataclasses.replace(moving, position=np.full_like(moving.position, 0.1))
    found = first_change(still, response)
    assert found.delay_samples.tolist() == [-1]
    assert "no position change" in found.reason[0]


def test_a_position_that_counts_the_other_way_has_no_delay():
    """Its response would be taken for rest, and its swing back, tens of samples later, for the response."""
    batch = simulate(K, B, **FALCON, quantum=1e-5)
    mirrored = dataclasses.replace(batch, position=2 * batch.position[:, :1] - batch.position)
    response = find_response(mirrored)
    assert response.has_edge.sum() > 30
    found = first_change(mirrored, response)
    assert set(found.delay_samples.tolist()) == {-1}
    words = [text for text in found.reason if "against the step at first; check the signs of position" in text]
    assert len(words) > 30


def test_three_rows_off_by_a_quantum_are_no_response():
    """A response goes on to rise; a sensor that flickers does not, however often."""
    batch = simulate([3000.0], [50.0], **{**FALCON, "delay": 9}, quantum=2e-6)
    flickering = batch.position.copy()
    flickering[0, 23:26] += 2e-6
    plain, found = (
        first_change(one, find_response(batch)).delay_samples.tolist()
        for one in (batch, dataclasses.replace(batch, position=flickering))
    )
    assert plain == found == [9]


def test_a_response_against_the_step_gives_no_delay():
    # behind an unstable wall the motion swings back across the start
    batch = simulate([18000.0], [10.0], **FALCON, quantum=2e-6)
    mirrored = dataclasses.replace(batch, position=2 * batch.position[:, :1] - batch.position)
    response = dataclasses.replace(find_response(mirrored), edge_row=np.array([20]), edge_reason=("",))
    found = first_change(mirrored, response)
    assert found.delay_samples.tolist() == [-1]
    assert "moves against the step" in found.reason[0]
