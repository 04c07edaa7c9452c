"""Intervals against the costs of the same loop without a sensor, by an independent simulator."""

from __future__ import annotations

import dataclasses

import not_ideal
import numpy as np
import pytest
from sensor_trials import DELAY, EDGE, FEWEST, FREE, SENSORS, measured, shipped, trials, truth
from simulated import FALCON, plant, simulate

from pipeline.base.errors import ParameterError
from pipeline.device_data.devices import load_device
from pipeline.loop.motion import Mechanism
from pipeline.measured.cost.cost_intervals import _stays, overshoot_interval, settling_interval
from pipeline.measured.cost.energy_intervals import energy_interval
from pipeline.measured.cost.reading_error import reading_error, sensor_error
from pipeline.measured.cost.settling_overshoot import overshoot, settling
from pipeline.measured.signal.horizon import energy_terms
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.records.batch import TrialBatch
from pipeline.records.criteria import SETTLING_BANDS
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import simulate as simulate_device


def last_outside(error, width):
    outside = np.abs(error) > width[:, None]
    return np.where(outside.any(axis=1), error.shape[1] - np.argmax(outside[:, ::-1], axis=1), 0)


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
    batch = simulate(K, B, **FREE)
    error = reading_error(batch, find_response(batch), DELAY)
    for i in range(2):
        answer = injected(K[i], B[i], 30, 1e-6)
        # the loop is linear: only rounding differs, of positions of 0.1 m against errors of 1 um
        np.testing.assert_allclose(error.weight[i, :90], answer[30:] / 1e-6, atol=1e-4)
        # an error of the first reading lasts, since the wall rests on it: all later errors are relative to it
        first = injected(K[i], B[i], 0, 1e-6)[1:] / 1e-6 - 1.0
        np.testing.assert_allclose(-np.cumsum(error.weight[i])[:99], first[:99], atol=1e-3)


@pytest.mark.parametrize(("quantum", "noise"), SENSORS)
def test_standard_errors_of_readings(quantum, noise):
    batch, _, _, error = measured(quantum, noise)
    ideal, _ = truth()
    off = (batch.displacement - ideal.displacement[:, : batch.position.shape[1]])[:, EDGE + DELAY :]
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
    sensor, found = load_device(of.split()[0]).sensor, find_response(shipped(*of.split(), 600)[0])
    error = sensor_error(found.sensor_noise, found.sensor_quantum, found.edge_row)
    assert error == pytest.approx(np.hypot(sensor.noise, sensor.quantum / np.sqrt(12)), rel=0.055)


def test_jitter_magnifies_the_errors_and_that_is_seen():
    """Against the same trials with the same jitter and an ideal sensor."""
    K, B = trials()
    setup = Setup(Mechanism(FALCON["mass"], FALCON["b"]), 1e-3, 8.0, 400, EDGE, DELAY, (3, 4, 5), 0.12, 10.0)
    ideal = simulate_device(setup, K, B, seed=2)
    batch = simulate_device(dataclasses.replace(setup, quantum=2e-6, noise=5e-7), K, B, seed=2)
    error = reading_error(batch, find_response(batch), DELAY)
    off = np.abs(batch.displacement - ideal.displacement)[:, EDGE + DELAY :]
    settled = judge(batch).verdict == "stable"
    inside = off < 1.96 * error.deviation[:, EDGE + DELAY :]
    assert inside[settled].mean() > 0.85
    # of what the step response alone explains far fewer would hold
    alone = reading_error(ideal, find_response(ideal), DELAY, sensor=error.sensor[0], gain=1.0).deviation
    assert (off < 1.96 * alone[:, EDGE + DELAY :])[settled].mean() < 0.6
    assert np.median(error.gain) > 4
    assert np.median(measured(2e-6, 5e-7)[3].gain) == 1.0


def test_a_mode_that_decays_slowly_is_no_rest():
    """LWR at d = 7: the last fifths of the stiffly damped trials shrink by 0.65 to 0.75, far above the sensor."""
    K = np.array([1000.0, 800.0, 800.0, 600.0, 600.0, 480.0, 800.0, 800.0])
    B = np.array([30.0, 31.0, 32.0, 33.0, 34.0, 35.0, 20.0, 21.0])
    plant_ = Mechanism(0.19, 0.0)
    batch = simulate_device(Setup(plant_, 1e-3, 15.0, 350, EDGE, 7.0, (), 0.0, 1.0, quantum=5e-6), K, B, seed=1)
    error = reading_error(batch, find_response(batch), 7)
    # the model of a constant delay explains the sensor's part: nothing exceeds it
    assert (error.gain == 1).all()
    # so that the last two, which end in the sensor's noise, are summed down to it: 60 samples would end at 5 %
    verdicts = judge(batch)
    found = energy_interval(batch, find_response(batch), verdicts, error, 7, 0.19)
    assert (found.horizon_samples[-2:] > 120).all()
    ideal = simulate_device(Setup(plant_, 1e-3, 15.0, 2000, EDGE, 7.0, (), 0.0, 1.0), K, B, seed=1)
    true = energy_terms(ideal, find_response(ideal), judge(ideal), 7).summed(0.19)
    np.testing.assert_allclose(found.value[-2:], true[-2:], rtol=0.01)


@pytest.mark.parametrize(("quantum", "noise"), SENSORS)
def test_intervals_hold_the_truth(quantum, noise):
    batch, response, verdicts, error = measured(quantum, noise)
    K, _ = trials()
    _, off = truth()
    found = settling(batch, response, verdicts, DELAY)
    interval = settling_interval(batch, response, error, found, DELAY)
    for name, band in SETTLING_BANDS.items():
        true = last_outside(off, band * 8 / K)
        low, high, value = interval.low[name], interval.high[name], found.samples[name]
        told = np.isfinite(high)
        assert told.mean() > 0.2
        assert ((low <= true) & (true <= high))[told].mean() >= FEWEST
        assert ((low <= value) & (value <= high))[told].all()
        assert (np.isnan(low) == np.isnan(value)).all()
    # and they say something: half of the 5 % intervals are no wider than 10 samples
    width = interval.high["settle_5pct"] - interval.low["settle_5pct"]
    assert np.nanmedian(width) <= 10

    over = overshoot(batch, response, verdicts)
    bounds = overshoot_interval(batch, response, error, over)
    true = np.maximum(off.max(axis=1) / (8 / K), 0.0)
    assert ((bounds.low <= true) & (true <= bounds.high)).mean() >= FEWEST
    assert (bounds.low <= over.overshoot).all()
    assert (over.overshoot <= bounds.high).all()
    # the largest of many readings is too large, and by no more than what is told
    overshooting = true > 0.05
    too_large = (over.overshoot - true)[overshooting]
    assert -0.5 * np.mean(bounds.bias[overshooting]) < np.mean(too_large) < np.mean(bounds.bias[overshooting])


@pytest.mark.slow
@pytest.mark.parametrize(("quantum", "noise"), [*SENSORS, (2e-6, 0.0), (1e-5, 0.0)])
def test_intervals_hold_the_truth_of_500_trials(quantum, noise):
    batch, response, verdicts, error = measured(quantum, noise, 500)
    K, _ = trials(500)
    _, off = truth(500)
    found = settling(batch, response, verdicts, DELAY)
    interval = settling_interval(batch, response, error, found, DELAY)
    for name, band in SETTLING_BANDS.items():
        true = last_outside(off, band * 8 / K)
        told = np.isfinite(interval.high[name])
        assert ((interval.low[name] <= true) & (true <= interval.high[name]))[told].mean() >= 0.95
    bounds = overshoot_interval(batch, response, error, overshoot(batch, response, verdicts))
    true = np.maximum(off.max(axis=1) / (8 / K), 0.0)
    assert ((bounds.low <= true) & (true <= bounds.high)).mean() >= 0.95


def test_ideal_logs_leave_nothing_open():
    K, B = np.array([4469.0, 600.0, 4000.0]), np.array([73.05, 24.0, 72.0])
    batch = simulate(K, B, **FREE)
    response = find_response(batch)
    error, verdicts = reading_error(batch, response, DELAY), judge(batch, response)
    assert (error.sensor == 0).all()
    found, over = (
        settling(batch, response, verdicts, DELAY),
        overshoot(batch, response, verdicts),
    )
    interval = settling_interval(batch, response, error, found, DELAY)
    for name, value in found.samples.items():
        assert (interval.low[name] == value).all()
        assert (interval.high[name] == value).all()
    bounds = overshoot_interval(batch, response, error, over)
    np.testing.assert_array_equal(bounds.low, over.overshoot)
    assert (bounds.high <= np.maximum(over.overshoot, 1e-12)).all()


def test_the_delay_moves_the_start():
    batch, response, verdicts, error = measured(2e-6, 5e-7)
    found = settling(batch, response, verdicts, DELAY)
    exact = settling_interval(batch, response, error, found, DELAY)
    loose = settling_interval(batch, response, error, found, DELAY, delay_range=(3, 6))
    for name in SETTLING_BANDS:
        told = np.isfinite(exact.high[name])
        assert (loose.high[name][told] == exact.high[name][told] + 1).all()
        assert (loose.low[name][told] == np.maximum(exact.low[name][told] - 2, 0)).all()
    for wrong in ((5, 6), (-1, 4), (4, 3)):
        with pytest.raises(ParameterError, match="range of the delay"):
            settling_interval(batch, response, error, found, DELAY, delay_range=wrong)


def test_an_overshoot_after_the_end_of_the_log_is_not_excluded():
    """A creeping response that passes its final position only after the log."""
    batch = simulate([920.0], [184.0], **FREE, quantum=2e-6, noise=5e-7)
    ideal = simulate([920.0], [184.0], **FREE, rows=8000)
    true = (ideal.displacement[0].max() - 8 / 920) / (8 / 920)
    response = find_response(batch)
    over = overshoot(batch, response, judge(batch, response))
    bounds = overshoot_interval(batch, response, reading_error(batch, response), over)
    assert over.overshoot[0] == 0
    assert true > 1e-3
    assert bounds.low[0] == 0
    assert bounds.high[0] > true


def test_a_late_reading_at_the_edge_leaves_the_upper_end_open():
    batch, response, verdicts, error = measured(1e-5, 1e-6)
    found = settling(batch, response, verdicts, DELAY)
    interval = settling_interval(batch, response, error, found, DELAY)
    open_ends = [i for i in range(len(batch)) if any(np.isnan(interval.high[n][i]) for n in SETTLING_BANDS)]
    assert open_ends
    assert all(interval.reason[i] for i in open_ends)
    assert any("may not have settled" in text for text in interval.reason)


def test_a_mirrored_log_has_the_same_intervals():
    batch, response, verdicts, error = measured(2e-6, 5e-7)
    mirror = dataclasses.replace(batch, step=-batch.step, position=-batch.position, command=-batch.command)
    turned = find_response(mirror)
    other = reading_error(mirror, turned, DELAY)
    np.testing.assert_allclose(other.deviation, error.deviation, rtol=1e-9)
    pairs = []
    for one, seen, errors in ((batch, response, error), (mirror, turned, other)):
        over = overshoot_interval(one, seen, errors, overshoot(one, seen, verdicts))
        settle = settling_interval(one, seen, errors, settling(one, seen, verdicts, DELAY), DELAY)
        pairs.append((over.low, over.high, settle.low["settle_2pct"], settle.high["settle_2pct"]))
    for here, there in zip(*pairs, strict=True):
        np.testing.assert_allclose(here, there, rtol=1e-9, atol=1e-12)


def test_no_trials():
    batch, *_ = measured(2e-6, 5e-7)
    nobody = batch.select(np.array([], dtype=np.int64))
    response = find_response(nobody)
    error, verdicts = reading_error(nobody, response, DELAY), judge(nobody, response)
    assert error.reason == ()
    assert overshoot_interval(nobody, response, error, overshoot(nobody, response, verdicts)).low.shape == (0,)
    energy = energy_interval(nobody, response, verdicts, error, DELAY, 0.58)
    assert energy.value.shape == (0, 3)


def test_reasons():
    batch = simulate([4000.0, 0.0, 20000.0], [70.0, 0.0, 60.0], **FALCON, quantum=2e-6, noise=5e-7)
    response, error = find_response(batch), reading_error(batch, find_response(batch), DELAY)
    verdicts = judge(batch, response)
    over = overshoot_interval(batch, response, error, overshoot(batch, response, verdicts))
    settle = settling_interval(batch, response, error, settling(batch, response, verdicts, DELAY), DELAY)
    for found in (over, settle):
        assert found.reason[0] == ""
        assert found.reason[1].startswith(("no final position", "unstable"))
        assert found.reason[2].startswith("unstable")
    assert np.isnan(over.high).tolist() == [False, True, True]
    short = simulate([4000.0], [70.0], **FALCON, quantum=2e-6, noise=5e-7, baseline=3)
    assert "noise of the sensor not known" in reading_error(short, find_response(short)).reason[0]
    assert isinstance(short, TrialBatch)
    with pytest.raises(ParameterError, match="delay"):
        reading_error(short, find_response(short), -1)


@pytest.mark.parametrize("seed", range(300, 306))
def test_a_slow_swing_that_passes_a_band_has_no_upper_end(seed):
    """Walls so soft that logs end within a swing or two, by a simulator of its own; some with a fast mode on top."""
    random = np.random.default_rng(seed)
    rows = int(random.choice([300, 500]))
    w = 2 * np.pi / (10 ** random.uniform(-0.5, 0.5, 20) * rows * 1e-3)
    ratio, mode = 10 ** random.uniform(-1.5, 0.2, 20), ((40.0, 0.05, 0.1) if seed % 2 else None)
    K, B = 0.58 * w**2, 2 * ratio * 0.58 * w
    device = {"b": 0.2, "delay": 3.0, "seed": seed, "mode": mode}
    batch = not_ideal.simulate(K, B, rows=rows, quantum=1e-4 * np.median(8 / K), **device)
    _, exact = not_ideal.simulate(K, B, rows=8 * rows, truth=True, **device)
    response, error = find_response(batch), reading_error(batch, find_response(batch), 3)
    found = settling(batch, response, judge(batch, response), 3)
    interval = settling_interval(batch, response, error, found, 3)
    for name, band in SETTLING_BANDS.items():
        true = last_outside((exact - 8 / K[:, None])[:, EDGE + 3 :], band * 8 / K)
        told = np.isfinite(interval.high[name])
        assert (true[told] <= interval.high[name][told] + 10).all()
        assert (true[told] <= rows).all()


def stays(stay, swing, ratio):
    """Whether a motion that entered its band of 1 after 600 rows stays in it: its thirds change by a ratio."""
    third = np.arange(stay) * 3 / stay
    offset = np.concatenate([np.full(600, 5.0), 0.9 * ratio**third])[None, :]
    rows, one = np.array([offset.shape[1]]), np.ones(1)
    first, entry = np.zeros(1, np.int64), np.array([600])
    return bool(_stays(offset, 1e-9 * np.ones_like(offset), first, entry, rows, swing * one, one)[0])


@pytest.mark.parametrize(
    ("stay", "swing", "ratio", "settled"),
    [
        # as long as its slowest swing and an eighth, and as that and three eighths
        (90, 80.0, 0.99, False),
        (110, 80.0, 0.99, True),
        # a creep for a seventh, and more than a sixth, of the time up to the band
        (90, np.inf, 0.5, False),
        (110, np.inf, 0.5, True),
        # a creep that hardly slows may go on beyond the band
        (300, np.inf, 0.9, False),
        (300, np.inf, 0.75, True),
    ],
)
def test_a_response_has_settled_after_a_swing_or_a_creep_in_its_band(stay, swing, ratio, settled):
    """Either side of each threshold, nearer than 30 % to it."""
    assert stays(stay, swing, ratio) is settled
