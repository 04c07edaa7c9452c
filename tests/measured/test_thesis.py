"""The thesis's methods against motions whose delay, mass and damping are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import binom
from simulated import FALCON, LWR, simulate, spectral_radius

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.response import declare_edge, find_response
from pipeline.measured.signal.verdict import judge
from pipeline.measured.thesis import by_limit, by_momentum, estimate_delay, estimate_median, first_change

K = np.linspace(400, 12000, 40)
B = np.linspace(0, 90, 40)
FIRM = {**FALCON, "mass": 1.0, "b": 34.0}


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8])
def test_first_change_is_exact_on_ideal_logs(delay):
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


def test_reasons_for_no_first_change():
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


def test_a_growing_motion_that_counts_the_other_way_has_no_delay_though_it_swings_past_its_start():
    batch = simulate(np.array([9000.0, 12000.0]), np.array([20.0, 20.0]), **FALCON, quantum=1e-5)
    mirrored = dataclasses.replace(batch, position=2 * batch.position[:, :1] - batch.position)
    assert first_change(mirrored, find_response(mirrored)).delay_samples.tolist() == [-1, -1]


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


def course(dev, top, spread=13):
    """Stable trials over the whole region of a device."""
    grid = np.meshgrid(np.linspace(200, top, spread), np.linspace(0, 180 if dev["mass"] > 0.5 else 55, spread))
    K, B = (a.ravel() for a in grid)
    stable = np.array([spectral_radius(k, b, **dev) < 1 for k, b in zip(K, B, strict=True)])
    return K[stable], B[stable]


def test_uncorrected_mass_has_its_analytic_bias():
    # a free mass under a constant force from t = 0 has v = F/b (1 - exp(-b t/m)); the balance gives F t/v.
    # K = B = 0 keeps the command constant; the last interval lies about t = (15 - 4 - 1/2) samples.
    batch = simulate([0.0], [0.0], **FALCON)
    found = by_momentum(batch, find_response(batch), 4)
    t = (15 - 4 - 0.5) * 1e-3
    bias = (4 / 0.58 * t) / -np.expm1(-4 / 0.58 * t) - 1
    assert found.mass_momentum[0] / 0.58 - 1 == pytest.approx(bias, rel=5e-3)


def test_mass_scales_with_force():
    light = simulate([3000.0], [50.0], **FALCON)
    heavy = dataclasses.replace(
        light,
        command=3 * light.command,
        stiffness=3 * light.stiffness,
        damping=3 * light.damping,
        step=3 * light.step,
    )
    one, three = (by_momentum(b, find_response(b), 4).mass_momentum for b in (light, heavy))
    np.testing.assert_allclose(three, 3 * one, rtol=1e-12)


def test_reasons_for_no_mass():
    batch = simulate([3000.0], [50.0], **FALCON)
    response = find_response(batch)
    no_edge = simulate([3000.0], [50.0], **FALCON, baseline=0)
    assert "no baseline" in by_momentum(no_edge, find_response(no_edge), 4).reason[0]
    short = simulate([3000.0], [50.0], **FALCON, rows=34)
    assert "ends earlier" in by_momentum(short, find_response(short), 4).reason[0]
    assert "fills it" in by_momentum(batch, response, 40).reason[0]
    coarse = simulate([3000.0], [50.0], **FALCON, quantum=5e-5)
    assert "noise threshold" in by_momentum(coarse, find_response(coarse), 4).reason[0]
    time = batch.time.copy()
    time[0, 25:] += 2e-5
    assert "differ from T" in by_momentum(dataclasses.replace(batch, time=time), response, 4).reason[0]
    time = batch.time.copy()
    time[0, 100:] += 2e-5
    assert by_momentum(dataclasses.replace(batch, time=time), response, 4).reason == ("",)
    turned = dataclasses.replace(batch, position=2 * batch.position[:, :1] - batch.position)
    assert "no positive mass" in by_momentum(turned, response, 4).reason[0]


@pytest.mark.parametrize(("dev", "top"), [(FALCON, 13600.0), (FIRM, 29000.0), (LWR, 11800.0)])
def test_mass_is_the_true_one_but_for_damping_over_the_whole_region(dev, top):
    batch = simulate(*course(dev, top), **dev)
    found = by_momentum(batch, find_response(batch), dev["delay"])
    assert set(found.reason) == {""}
    # b takes as much off the momentum as it moves: at most b times the window
    most = dev["b"] * 0.015 / dev["mass"]
    assert (found.mass_momentum / dev["mass"] >= 1 - 1e-5).all()
    assert (found.mass_momentum / dev["mass"] <= 1 + most + 1e-5).all()


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


def test_delay_is_the_median_and_its_range():
    factors = np.r_[np.full(30, 3), np.full(45, 4), np.full(25, 5), -1, -1]
    found = estimate_delay(factors)
    assert (found.value, found.low, found.high, found.trials) == (4.0, 3.0, 6.0, 100)


def test_a_constant_delay_keeps_its_bracket_and_a_few_strays_do_not_widen_it():
    found = estimate_delay(np.r_[np.full(99, 2), 0])
    assert (found.value, found.low, found.high) == (2.0, 2.0, 3.0)


def test_delay_of_an_even_number_is_one_that_occurred():
    assert estimate_delay(np.array([3, 4])).value == 3.0


def test_no_delay():
    found = estimate_delay(np.array([-1, -1]))
    assert found.value is None
    assert "no trial of 2" in found.reason


@pytest.mark.parametrize("n", [6, 7, 12, 25, 100, 2300])
def test_interval_of_the_median_covers_95_percent(n):
    values = np.arange(n, dtype=float)
    found = estimate_median(values[::-1], "kg", "m", "none")
    rank = int(found.low) + 1
    assert found.high == n - rank
    # P(the median lies below the rank-th value) = P(fewer than `rank` of n lie below it), each with 1/2
    assert 2 * binom.cdf(rank - 1, n, 0.5) <= 0.05
    assert 2 * binom.cdf(rank, n, 0.5) > 0.05


def test_interval_covers_the_true_median_of_simulated_trials():
    random = np.random.default_rng(4)
    samples = random.exponential(size=(2000, 31))
    found = [estimate_median(s, "", "m", "none") for s in samples]
    inside = np.mean([f.low <= np.log(2) <= f.high for f in found])
    assert 0.94 < inside < 0.985  # at least 95 %, discrete ranks make it 97 %


def test_few_trials_say_that_they_are_few():
    found = estimate_median(np.array([1.0, np.nan, 3.0]), "kg", "balance", "none")
    assert (found.value, found.low, found.high, found.trials) == (2.0, 1.0, 3.0, 2)
    assert "range of 2 trials" in found.method
    assert estimate_median(np.full(2, np.nan), "kg", "balance", "no trial").reason == "no trial"
