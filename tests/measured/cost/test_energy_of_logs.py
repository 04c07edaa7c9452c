"""Energy with its interval against the energy of the same loop without a sensor, over a long log."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from columns import stacked
from measured_logs import Logs
from sensor_trials import DELAY, EDGE, FEWEST, FREE, SENSORS, measured, shipped, trials, truth
from simulated import FALCON, simulate

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.response import find_response

MASS = FALCON["mass"]


def energies(logs, K, delay=DELAY, mass=MASS):
    """Costs for w = 0, 1, 2 by their definition, and what of them lies in the last 100 samples."""
    x = stacked(logs)[:, EDGE + delay :]
    k = np.arange(x.shape[1])
    speed = np.diff(x, axis=1, prepend=x[:, :1]) / 1e-3
    stored = (K[:, None] / 2 * (x - 8 / K[:, None]) ** 2 + mass / 2 * speed**2) / (32 / K[:, None])
    return tuple(np.stack([(k**w * stored)[:, part].sum(axis=1) for w in range(3)], axis=1) for part in (
        slice(None), slice(-100, None)
    ))  # fmt: skip


def known_truth(count=150):
    """Energies of the ideal trials; NaN where 3,000 samples do not hold them."""
    total, rest = energies(truth(count)[0], trials(count)[0])
    return np.where(rest < 1e-4 * total, total, np.nan)


def interval(logs, mass=MASS, **more):
    return Logs(logs, DELAY).energy(mass, **more)


def held(found, true):
    told = np.isfinite(found.value) & np.isfinite(true)
    return [
        ((found.low[:, w] <= true[:, w]) & (true[:, w] <= found.high[:, w]))[told[:, w]].mean() for w in range(3)
    ]  # fmt: skip


@pytest.mark.parametrize(("quantum", "noise"), SENSORS)
def test_intervals_hold_the_truth(quantum, noise):
    logs = measured(quantum, noise)
    found = logs.energy(MASS)
    true = known_truth()
    assert min(held(found, true)) >= FEWEST
    assert (np.isnan(found.value).any(axis=1) == [bool(text) for text in found.reason]).all()
    # they say something: half are narrower than 4 % (w = 0) and 15 % (w = 2) of the value on each side
    width = 0.5 * (found.high - found.low) / found.value
    assert (np.nanmedian(width, axis=0) < [0.04, 0.1, 0.15]).all()
    # their values are better than those of the plain sum
    sums = logs.summed(MASS)
    both = np.isfinite(sums) & np.isfinite(found.value) & np.isfinite(true)
    for w in (1, 2):
        ours, theirs = (np.median(np.abs(part / true - 1)[:, w][both[:, w]]) for part in (found.value, sums))
        assert ours < theirs


@pytest.mark.slow
@pytest.mark.parametrize(("quantum", "noise"), [*SENSORS, (2e-6, 0.0), (1e-5, 0.0)])
def test_intervals_hold_the_truth_of_500_trials(quantum, noise):
    # without any noise the errors of slow readings depend on each other, which is not told
    assert min(held(measured(quantum, noise, 500).energy(MASS), known_truth(500))) >= (0.92 if noise else 0.90)


SHIPPED = [
    *(pytest.param(each, marks=pytest.mark.slow) for each in ("falcon 4", "falcon 6", "lwr delay-2", "lwr delay-6")),
    "falcon 1",
    "lwr delay-8",
]


@pytest.mark.slow
@pytest.mark.parametrize("of", SHIPPED)
def test_95_of_100_intervals_of_shipped_devices_hold_the_exact_cost(of):
    """93 to 97 %, 4,000 trials each: chance moves a share by 0.35 % (standard error)."""
    logs, experiment, costs = shipped(*of.split(), 4000)
    found = Logs(logs, round(experiment.delay_samples)).energy(experiment.mass)
    shares = held(found, np.stack(list(costs.values()), axis=1))
    assert 0.93 <= min(shares) <= max(shares) <= 0.97


def test_a_coarse_sensor_is_refused_rather_than_guessed():
    found = measured(6e-5, 1e-6).energy(MASS)
    assert np.isfinite(found.value).mean(axis=0)[2] < 0.1
    assert (np.isnan(found.value).any(axis=1) == [bool(text) for text in found.reason]).all()
    assert any("too large for a final displacement" in text for text in found.reason)
    assert any("too uncertain for" in text for text in found.reason)


def test_the_tail_is_carried_on():
    """A log that ends while the response swings, against one that is ten times as long."""
    K, B = np.array([12000.0]), np.array([90.0])
    total, rest = energies(simulate(K, B, **FREE, rows=6000), K)
    assert (rest < 1e-12 * total).all()
    found = interval(simulate(K, B, **FREE, rows=420))
    lost = total - (found.value - found.tail)
    # without the tail the sum for w = 2 lacks 4 to 5 %
    assert (lost > [1e-3, 1e-2, 4e-2] * total).all()
    # the tail restores nine tenths of that at least: its swing is averaged
    assert (np.abs(found.value - total) < 0.1 * lost).all()
    noisy = interval(simulate(K, B, **FREE, rows=420, quantum=2e-6, noise=5e-7))
    for one in (found, noisy):
        assert (one.low <= total).all()
        assert (total <= one.high).all()
    # by its sum alone a noisy log would be outside
    assert (noisy.high - noisy.tail < total)[0, 2]


def test_ideal_logs():
    found, true = interval(simulate(*trials(), **FREE)), known_truth()
    assert (found.bias[np.isfinite(found.bias)] == 0).all()
    # a relative 1e-9 for rounding, where the response has died away and the interval is empty
    rounded = SimpleNamespace(value=found.value, low=found.low * (1 - 1e-9), high=found.high * (1 + 1e-9))
    assert min(held(rounded, true)) >= 0.95
    long = interval(truth()[0])
    done = np.isfinite(true) & np.isfinite(long.value)
    # the tail of a log of 3,000 samples is what the truth lacks, less than 1e-4 of it in its last 100 samples
    np.testing.assert_allclose(long.value[done], true[done], rtol=2e-3)


def test_another_delay_moves_the_sums():
    K, B = np.array([4469.0, 4000.0]), np.array([73.05, 72.0])
    logs = simulate(K, B, **FREE, rows=1500)
    exact, loose = interval(logs), interval(logs, delay_range=(3, 6))
    earlier, later = energies(logs, K, 3)[0], energies(logs, K, 6)[0]
    # the samples that a smaller delay takes in are at rest in an ideal log: exact
    np.testing.assert_allclose(loose.high - exact.high, earlier - exact.value, rtol=1e-6)
    # of those that a larger one drops the second has moved a little: 1 % of their energy
    np.testing.assert_allclose(loose.low - exact.low, later - exact.value, rtol=0.01)


def test_an_uncertain_mass_widens_the_interval():
    logs = measured(2e-6, 5e-7)
    kinetic = logs.summed(1.0)[:, 0] - logs.summed(0.0)[:, 0]
    sharp, wide = (logs.energy(MASS, mass_error=error) for error in (0.0, 0.06))
    np.testing.assert_array_equal(sharp.bias[np.isfinite(wide.value)], wide.bias[np.isfinite(wide.value)])
    up = np.sqrt((wide.high - wide.value) ** 2 - (sharp.high - sharp.value) ** 2)[:, 0]
    told = np.isfinite(up) & np.isfinite(kinetic)
    # the plain sum ends a little earlier
    np.testing.assert_allclose(up[told], 1.96 * 0.06 * kinetic[told], rtol=0.02)


def test_a_motion_that_lasts_has_no_value():
    logs = Logs(simulate([4000.0], [80.0], **FALCON, quantum=2e-6, noise=5e-7))
    row = np.arange(400)
    swing = 0.2 * 8 / 4000 * np.sin(2 * np.pi * (row - 20) / 25) * (row >= 20)
    moved = replace(logs.trials, position=logs.trials.position + swing)
    found = Logs(moved, DELAY, given_responses=logs.responses, given_verdicts=logs.verdicts).energy(MASS)
    assert np.isnan(found.value).all()
    assert "record longer" in found.reason[0]


def test_reasons_and_wrong_arguments():
    logs = simulate([4000.0, 0.0, 20000.0], [70.0, 0.0, 60.0], **FALCON, quantum=2e-6, noise=5e-7)
    found = interval(logs)
    assert [text.split(":")[0].split(" ")[0] for text in found.reason] == ["", "no", "unstable"]
    assert np.isnan(found.value).tolist() == [[False] * 3, [True] * 3, [True] * 3]
    brief = interval(simulate([4000.0], [70.0], **FALCON, quantum=2e-6, noise=5e-7, rows=40))
    assert np.isnan(brief.value).all()
    assert brief.reason[0]
    for wrong in ({"mass": 0.0}, {"mass": 1.0, "mass_error": -1.0}, {"mass": 1.0, "delay_range": (5, 6)}):
        with pytest.raises(ParameterError):
            interval(logs, **wrong)


def test_a_response_that_rests_beside_its_final_position_has_what_the_log_adds():
    """Readings moved for the rest of the log stand for friction, which holds the device there."""
    K, B = np.array([3000.0, 6000.0]), np.array([70.0, 90.0])
    logs = simulate(K, B, **FREE, quantum=2e-6, noise=5e-7)
    late = np.tile(np.arange(400) > 120, 2)
    off, far = (replace(logs, position=logs.position + late * size) for size in (8e-6, 1e-4))
    near, beside, away = map(interval, (logs, off, far))
    assert all(find_response(trial).floor < 8e-6 for trial in logs)
    whole = energies(off, K)[0]
    # of the plain sum noise is a part, too
    assert (beside.high[:, 1] >= 0.97 * whole[:, 1]).all()
    assert ((beside.high - beside.value)[:, 1] > 3 * (near.high - near.value)[:, 1]).all()
    assert np.isnan(away.value[:, 2]).all()
