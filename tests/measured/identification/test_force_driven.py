"""Device and drive apart, from a force that is measured between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from force_rigs import DAMPING, MASS, ForceRig, T

from pipeline.measured.identification.force_driven import CUBIC, TRAPEZOIDAL, driven_by_force, identified_by_force
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.measured_drive import identified_drive
from pipeline.measured.identification.recordings import Recording


def contains(interval, truth):
    return interval.low <= truth <= interval.high


@pytest.fixture(scope="module")
def logs():
    return ForceRig().logs()


@pytest.fixture(scope="module")
def apart(logs):
    return identified_by_force(logs)


@pytest.mark.slow
def test_drive_and_device_of_a_rig_with_gain_and_lag_are_identified_apart(apart):
    device, drive = apart.device.parameters, apart.drive
    assert contains(drive.gain, 0.8)
    assert contains(drive.lag_samples, 3.0)
    assert contains(drive.delay_samples, 1.4)
    assert drive.limit is None
    assert contains(device["mass"], MASS)
    assert contains(device["damping"], DAMPING)
    assert contains(device["delay_samples"], 1.4)
    assert device["mass"].high - device["mass"].low < 0.01 * MASS
    assert apart.device.unidentifiable == set()


@pytest.mark.slow
def test_per_unit_of_command_the_device_is_that_of_the_command_alone(logs, apart):
    alone = identified([replace(each, force=None) for each in logs]).parameters
    by_command = apart.by_command.parameters
    for name in ("mass", "damping"):
        assert by_command[name].value == pytest.approx(alone[name].value, rel=5e-3)
    assert contains(by_command["mass"], MASS / 0.8)


def test_parts_of_the_drive_are_not_searched_in_the_device(apart):
    assert not {"saturation", "lag", "gain by direction"} & apart.device.choice.tried.keys()
    assert "mode" in apart.device.choice.tried


def test_without_a_lag_the_delay_is_known_to_a_sample():
    drive = identified_drive(ForceRig(lag=0.0).logs())
    assert drive.lag_samples.value == 0
    assert contains(drive.delay_samples, 1.4)
    assert 0.9 < drive.delay_samples.high - drive.delay_samples.low < 1.5


def test_a_limit_of_the_command_is_found_where_there_is_one():
    drive = identified_drive(ForceRig(limit=2.5).logs())
    assert contains(drive.limit, 2.5)
    assert contains(drive.gain, 0.8)
    assert contains(drive.lag_samples, 3.0)


@pytest.mark.slow
def test_noise_of_the_force_widens_the_intervals(apart):
    noisy = identified_by_force(ForceRig(force_noise=0.2).logs())
    width, other = (each.device.parameters["mass"].high - each.device.parameters["mass"].low for each in (apart, noisy))
    assert other > 5 * width
    assert contains(noisy.device.parameters["mass"], MASS)
    assert contains(noisy.drive.gain, 0.8)


def test_a_force_that_does_not_follow_the_command_identifies_no_drive(logs):
    random = np.random.default_rng(1)
    strange = [replace(each, force=each.force + 20 * random.standard_normal(len(each.force))) for each in logs]
    drive = identified_drive(strange)
    assert drive.reason.startswith("The measured force does not follow the command")
    opposite = identified_drive([replace(each, force=-each.force) for each in logs])
    assert "sign is opposite" in opposite.reason


def test_without_a_drive_nothing_is_known_per_unit_of_the_command(logs):
    uneven = np.random.default_rng(1).uniform(-0.3, 0.3, ForceRig().rows) * T
    found = identified_by_force([replace(each, time=each.time + uneven) for each in logs])
    assert "not evenly spaced" in found.drive.reason
    assert {"mass", "delay_samples"} <= found.by_command.unidentifiable
    assert "mass" not in found.device.unidentifiable


@pytest.mark.parametrize("weights", [TRAPEZOIDAL, CUBIC])
def test_the_force_between_rows_is_its_mean_one_row_ahead(weights):
    time = T * np.arange(40)
    log = Recording("a", time, np.zeros(40), np.zeros(40), T, force=3 * (time / T) + 2)
    ahead = driven_by_force(log, weights)
    assert ahead.command[5] == pytest.approx(3 * (5 + 1.5) + 2)
    assert len(ahead.command) == len(ahead.position) == 38


def test_intervals_of_drives_contain_the_truth():
    random, missed = np.random.default_rng(7), 0
    for seed in range(24):
        gain, delay, lag = random.uniform(0.3, 2.0), random.uniform(0.2, 5.0), random.choice([0.0, 1.5, 6.0])
        noise = 10 ** random.uniform(-3, -0.7)
        drive = identified_drive([ForceRig(gain, delay, lag, force_noise=noise, rows=400).log(seed)])
        assert not drive.reason
        truths = (drive.gain, gain), (drive.delay_samples, delay), (drive.lag_samples, lag)
        missed += sum(not contains(interval, truth) for interval, truth in truths)
    assert missed <= 6
