"""The thesis's methods against motions whose delay, mass and damping are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from columns import Columns
from scipy.stats import binom
from simulated import FALCON, LWR, simulate, spectral_radius

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.response import declare_edge, find_response
from pipeline.measured.signal.verdict import judge
from pipeline.measured.thesis import by_limit, by_momentum, estimate_delay, estimate_median, first_change

K = np.linspace(400, 12000, 40)
B = np.linspace(0, 90, 40)
FIRM = {**FALCON, "mass": 1.0, "b": 34.0}


def changes(trials):
    """First change of each trial."""
    return Columns(first_change(trial, find_response(trial)) for trial in trials)


def masses(trials, delay):
    """Mass of each trial by the momentum balance."""
    return Columns(by_momentum(trial, find_response(trial), delay) for trial in trials)


def mirrored(trial):
    return dataclasses.replace(trial, position=2 * trial.position[0] - trial.position)


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8])
def test_first_change_is_exact_on_ideal_logs(delay):
    assert changes(simulate(K, B, **{**FALCON, "delay": delay})).delay_samples.tolist() == [delay] * 40


def test_negative_step():
    assert set(changes(simulate(K, B, **{**FALCON, "step": -8.0})).delay_samples.tolist()) == {4}


@pytest.mark.parametrize("dev", [FALCON, LWR])
def test_a_fine_quantum_is_passed_within_one_sample(dev):
    # 8 N on 0.58 kg move 6.9 um in the first sample, 15 Nm on 0.19 kg m^2 40 urad; half a quantum is 1 and 2.5
    trials = simulate(K, B, **dev, quantum=2e-6 if dev is FALCON else 5e-6)
    assert set(changes(trials).delay_samples.tolist()) == {dev["delay"]}


def test_a_coarse_quantum_is_late():
    found = changes(simulate(K, B, **FALCON, quantum=6e-5)).delay_samples
    assert (found >= 4).all()
    assert (found <= 6).all()
    # two or three samples to move half a quantum: late by one or two
    assert np.mean(found > 4) > 0.9


def test_a_trial_that_moves_before_the_step_has_no_delay():
    trial = simulate([3000.0], [50.0], **FALCON, quantum=2e-6)[0]
    drifting = trial.position.copy()
    drifting[:20] += 2e-6 * np.round(4 * np.sin(np.arange(20) / 6))
    assert first_change(trial, find_response(trial)).delay_samples == 4
    moving = dataclasses.replace(trial, position=drifting)
    found = first_change(moving, dataclasses.replace(find_response(moving), edge_row=20))
    assert found.delay_samples == -1
    assert found.reason.startswith("the device moves before the step, peak to peak ")
    assert "times the sensor floor; let it come to rest" in found.reason


def test_a_declared_step_row_replaces_the_baseline():
    trial = simulate([3000.0], [50.0], **FALCON, baseline=0)[0]
    response = find_response(trial)
    assert first_change(trial, declare_edge(trial, response, 0)).delay_samples == 4
    kept = declare_edge(trial, response, -1)  # -1 leaves a trial as its log shows it
    assert kept.edge_reason == response.edge_reason
    for row in (-2, 400):
        with pytest.raises(ParameterError, match="expected 0 to 399"):
            declare_edge(trial, response, row)


def test_what_the_baseline_tells_is_read_from_the_rows_before_the_declared_step():
    """A log whose command shows no step, so that nothing is known of its sensor until the step is declared."""
    early = []
    for trial in simulate([3000.0] * 50, [50.0] * 50, **FALCON, baseline=40, noise=5e-6, quantum=1e-7):
        found = find_response(trial)
        hidden = find_response(dataclasses.replace(trial, command=-trial.command))
        assert np.isnan(hidden.sensor_noise)
        declared = declare_edge(trial, hidden, found.edge_row)
        for name in ("sensor_noise", "floor", "baseline_motion"):
            assert getattr(declared, name) == getattr(found, name)
        # fifteen rows of noise, read where the trial says and not where the command shows it
        early.append((declare_edge(trial, found, 15).sensor_noise, found.sensor_noise))
        assert np.isnan(declare_edge(trial, found, 0).sensor_noise)
    first, all_rows = np.array(early).T
    assert (first != all_rows).mean() > 0.9
    np.testing.assert_allclose(np.median(first), 5e-6, rtol=0.15)


def test_jitter_shows_as_the_factors_3_to_5():
    found = changes(simulate(np.repeat(K, 10), np.repeat(B, 10), **FALCON, jitter=(3, 4, 5), seed=3)).delay_samples
    values, counts = np.unique(found, return_counts=True)
    assert values.tolist() == [3, 4, 5]
    # the newest command holds: P(3) = 1/3, P(5) = P(first slow) P(second not fast) = 1/3 * 2/3
    np.testing.assert_allclose(counts / len(found), [1 / 3, 4 / 9, 2 / 9], atol=0.08)


def test_reasons_for_no_first_change():
    trial = simulate([3000.0], [50.0], **FALCON, baseline=0)[0]
    found = first_change(trial, find_response(trial))
    assert (found.delay_samples, found.first_row) == (-1, -1)
    assert "no baseline" in found.reason
    moving = simulate([3000.0], [50.0], **FALCON)[0]
    still = dataclasses.replace(moving, position=np.full(moving.rows, 0.1))
    found = first_change(still, find_response(moving))
    assert found.delay_samples == -1
    assert "no position change" in found.reason


def test_a_first_change_needs_two_rows_behind_it():
    trial = simulate([3000.0], [50.0], **FALCON)[0]
    row = first_change(trial, find_response(trial)).first_row
    for rows, delay in ((row + 3, 4), (row + 2, -1), (row + 1, -1)):
        cut = trial.window(0, rows)
        assert first_change(cut, find_response(cut)).delay_samples == delay


def test_a_position_that_counts_the_other_way_has_no_delay():
    """Its response would be taken for rest, and its swing back, tens of samples later, for the response."""
    trials = [mirrored(trial) for trial in simulate(K, B, **FALCON, quantum=1e-5)]
    assert sum(find_response(trial).has_edge for trial in trials) > 30
    found = changes(trials)
    assert set(found.delay_samples.tolist()) == {-1}
    words = [text for text in found.reason if "first moves against the step; check the signs of position" in text]
    assert len(words) > 30


def test_a_growing_motion_that_counts_the_other_way_has_no_delay_though_it_swings_past_its_start():
    trials = simulate(np.array([9000.0, 12000.0]), np.array([20.0, 20.0]), **FALCON, quantum=1e-5)
    assert changes(map(mirrored, trials)).delay_samples.tolist() == [-1, -1]


def test_three_rows_off_by_a_quantum_are_no_response():
    """A response goes on to rise; a sensor that flickers does not, however often."""
    trial = simulate([3000.0], [50.0], **{**FALCON, "delay": 9}, quantum=2e-6)[0]
    flickering = trial.position.copy()
    flickering[23:26] += 2e-6
    response = find_response(trial)
    for position in (trial.position, flickering):
        assert first_change(dataclasses.replace(trial, position=position), response).delay_samples == 9


def course(dev, top, spread=13):
    """Stable trials over the whole region of a device."""
    grid = np.meshgrid(np.linspace(200, top, spread), np.linspace(0, 180 if dev["mass"] > 0.5 else 55, spread))
    K, B = (a.ravel() for a in grid)
    stable = np.array([spectral_radius(k, b, **dev) < 1 for k, b in zip(K, B, strict=True)])
    return K[stable], B[stable]


def test_uncorrected_mass_has_its_analytic_bias():
    # a free mass under a constant force from t = 0 has v = F/b (1 - exp(-b t/m)); the balance gives F t/v.
    # K = B = 0 keeps the command constant; the last interval lies about t = (15 - 4 - 1/2) samples.
    trials = simulate([0.0], [0.0], **FALCON)
    t = (15 - 4 - 0.5) * 1e-3
    bias = (4 / 0.58 * t) / -np.expm1(-4 / 0.58 * t) - 1
    assert masses(trials, 4).mass_momentum[0] / 0.58 - 1 == pytest.approx(bias, rel=5e-3)


def test_mass_scales_with_force():
    light = simulate([3000.0], [50.0], **FALCON)
    changed = {name: 3 * getattr(light, name) for name in ("command", "stiffness", "damping", "step")}
    one, three = (masses(trials, 4).mass_momentum for trials in (light, dataclasses.replace(light, **changed)))
    np.testing.assert_allclose(three, 3 * one, rtol=1e-12)


def test_reasons_for_no_mass():
    trial = simulate([3000.0], [50.0], **FALCON)[0]
    response = find_response(trial)
    for changed, reason in (
        ({"baseline": 0}, "no baseline"),
        ({"rows": 34}, "ends within the window"),
        ({"quantum": 5e-5}, "noise threshold"),
    ):
        assert reason in masses(simulate([3000.0], [50.0], **FALCON, **changed), 4).reason[0]
    assert "fills the window" in by_momentum(trial, response, 40).reason
    for row, reason in ((25, "time steps in the window differ from T by 2.0 %"), (100, "")):
        time = trial.time + 2e-5 * (np.arange(trial.rows) >= row)
        assert by_momentum(dataclasses.replace(trial, time=time), response, 4).reason.startswith(reason)
    assert by_momentum(dataclasses.replace(trial, time=time), response, 4).reason == ""
    assert "no positive mass" in by_momentum(mirrored(trial), response, 4).reason


@pytest.mark.parametrize(("dev", "top"), [(FALCON, 13600.0), (FIRM, 29000.0), (LWR, 11800.0)])
def test_mass_is_the_true_one_but_for_damping_over_the_whole_region(dev, top):
    found = masses(simulate(*course(dev, top), **dev), dev["delay"])
    assert set(found.reason) == {""}
    # b takes as much off the momentum as it moves: at most b times the window
    most = dev["b"] * 0.015 / dev["mass"]
    assert (found.mass_momentum / dev["mass"] >= 1 - 1e-5).all()
    assert (found.mass_momentum / dev["mass"] <= 1 + most + 1e-5).all()


@pytest.mark.parametrize("after_s", [0.002, 0.01, 0.03])
def test_a_later_window_gives_the_mass_of_an_undamped_device(after_s):
    dev = {**FALCON, "b": 0.0}
    trials = simulate([800.0, 3000.0], [10.0, 50.0], **dev)
    for trial in trials:
        found = by_momentum(trial, find_response(trial), 4, window_s=after_s + 0.015, after_s=after_s)
        assert found.mass_momentum == pytest.approx(0.58, rel=1e-9)


def limit_course(dev, step):
    """B = 0, -step, ... until past -b, then a fifth of it, as the procedure of the experiments does."""
    coarse = -np.arange(0, dev["b"] + 1.5 * step, step)
    fine = coarse[-2] - np.arange(1, 6) * step / 5
    return np.r_[coarse, fine]


def estimate(dev, step, **sensor):
    B = limit_course(dev, step)
    trials = simulate(np.zeros_like(B), B, **dev, **sensor)
    return by_limit(trials.damping, trials.stiffness, Columns(map(judge, trials)).growth_per_s)


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
    assert "none of 2 trials" in found.reason


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
