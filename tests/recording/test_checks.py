"""Single facts of the checks of a recording, on motions that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, filtfilt, lfilter

from pipeline.recording.check import check_recording
from pipeline.recording.motion import free_response
from pipeline.recording.samples import Samples
from pipeline.recording.wrapping import unwrapped

PERIOD = 1e-3


def motor(delay: float, *, late: int = 0, rows: int = 800, noise: float = 0.0, sign: float = 1.0) -> Samples:
    """Log of a mass of 2 kg without damping under steps of force, exact; the command is logged some rows late."""
    k = np.arange(rows)
    command = np.where(k < 50, 0.0, np.where((k - 50) // 150 % 2 == 0, 3.0, -2.0))
    t = np.maximum(k[:, None] - delay - np.arange(rows)[None, :], 0.0) * PERIOD
    change = np.diff(command, prepend=0.0)
    position = 0.5 * t**2 @ change / 2.0 + noise * np.random.default_rng(0).standard_normal(rows)
    logged = np.concatenate([np.zeros(late), command[: rows - late]])
    return Samples(PERIOD * k, logged, sign * position, PERIOD)


def codes(samples):
    return [finding.code for finding in check_recording(samples)]


@pytest.mark.parametrize("delay", [0.0, 0.4, 2.0, 3.7])
def test_the_delay_of_a_free_motion_is_fitted(delay):
    response = free_response(motor(delay))
    assert response.delay == pytest.approx(delay, abs=0.02)
    assert codes(motor(delay)) == []


@pytest.mark.parametrize(("delay", "late"), [(0.0, 1), (2.0, 4), (2.5, 20), (0.3, 60)])
def test_a_late_command_is_found_with_its_rows(delay, late):
    (finding,) = check_recording(motor(delay, late=late, noise=1e-8))
    assert (finding.code, finding.severity) == ("noncausal", "unsafe")
    assert f"responds {late - delay:.3g} rows before" in finding.evidence


def test_a_command_that_is_late_by_less_than_the_delay_shortens_it():
    assert free_response(motor(4.0, late=3)).delay == pytest.approx(1.0, abs=0.02)


def test_a_reversed_sign_is_found():
    assert codes(motor(2.0, sign=-1.0)) == ["wrong_sign"]


def test_a_step_from_rest_may_not_be_answered_before_it():
    x = np.concatenate([np.zeros(30), 1e-3 * np.arange(1.0, 71.0) ** 2])
    command = np.where(np.arange(100) < 40, 0.0, 5.0)
    (finding,) = check_recording(Samples(PERIOD * np.arange(100), command, x, PERIOD, 100.0, 1.0, 5.0))
    assert finding.code == "noncausal"
    assert finding.first_row in {30, 31}


def test_a_motion_that_dies_out_before_the_step_is_no_response():
    k = np.arange(300)
    still = 0.01 * np.exp(-k / 15.0)
    answer = 1e-6 * np.maximum(k - 62, 0) ** 2
    command = np.where(k < 60, 0.0, 5.0)
    assert "noncausal" not in codes(Samples(PERIOD * k, command, still + answer, PERIOD))


@pytest.mark.parametrize("factor", [0.125, 0.5, 0.9, 1.1, 2.0, 3.0])
def test_another_period_than_stated_names_both(factor):
    log = motor(2.0)
    (finding,) = check_recording(Samples(log.time, log.command, log.position, PERIOD * factor))
    assert finding.code == "sampling_period"
    assert "0.001 s apart" in finding.evidence
    assert f"{PERIOD * factor:.4g} s" in finding.evidence


def test_a_clock_that_drifts_by_a_permille_is_no_other_period():
    log = motor(2.0)
    assert codes(Samples(1.001 * log.time, log.command, log.position, PERIOD)) == []


def test_lost_rows_are_counted():
    log, kept = motor(2.0), np.ones(800, dtype=bool)
    kept[[100, 101, 400]] = False
    (finding,) = check_recording(Samples(log.time[kept], log.command[kept], log.position[kept], PERIOD))
    assert (finding.code, finding.first_row, finding.rows) == ("missing_rows", 99, 3)


@pytest.mark.parametrize("modulus", [2 * np.pi, np.pi, 25.0, 3.3])
@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_an_angle_that_starts_again_is_joined(modulus, offset):
    turned = 4 * modulus * np.sin(np.linspace(0, 7, 2000)) + 0.2
    read = np.mod(turned + offset * modulus, modulus) - offset * modulus
    joined, finding = unwrapped(read)
    assert np.ptp(joined - turned) < 1e-3 * modulus
    assert (finding.code, finding.severity) == ("wrapped_angle", "repaired")
    assert finding.rows == np.sum(np.abs(np.diff(read)) > 0.5 * modulus)


def test_a_stated_modulus_is_taken_and_false_leaves_the_angle():
    read = np.mod(np.linspace(0, 30, 200), 5.0)
    assert np.ptp(unwrapped(read, 5.0)[0] - np.linspace(0, 30, 200)) < 1e-12
    assert unwrapped(read, False) == (pytest.approx(read), None)


def test_a_growing_oscillation_is_no_wrapped_angle():
    k = np.arange(120)
    assert unwrapped(1e-6 * np.exp(k / 10.0) * np.sin(k * 1.3))[1] is None


@pytest.mark.parametrize("bounce", [0.0, 0.4])
def test_rows_behind_a_travel_stop_are_cut(bounce):
    k = np.arange(200)
    free = np.where(k < 20, 0.0, 1e-4 * (k - 20.0) ** 2)
    first = int(np.argmax(free > 1.0))
    speed = free[first] - free[first - 1]
    x = np.where(k < first, free, 1.0 - bounce * speed * np.clip(k - first, 0, 20))
    command = np.where(k < 20, 0.0, 5.0)
    (finding,) = check_recording(Samples(PERIOD * k, command, x, PERIOD))
    assert (finding.code, finding.severity) == ("travel_stop", "cut")
    assert abs(finding.first_row - first) <= 2
    units = {None: ("m (or rad)", "m/s (or rad/s)"), "translation": ("m", "m/s"), "rotation": ("rad", "rad/s")}
    for motion, (length, velocity) in units.items():
        (finding,) = check_recording(Samples(PERIOD * k, command, x, PERIOD, motion=motion))
        assert f" {length} in row" in finding.sentence
        assert f" {velocity} and stops there, which indicates a travel stop." in finding.sentence


def test_a_brake_by_the_command_is_no_travel_stop():
    log = motor(0.0)
    assert codes(Samples(log.time, np.sign(log.command) * 50, 25 * log.position, PERIOD)) == []


def test_readings_between_fewer_are_found():
    log, k = motor(2.0), np.arange(800)
    joined = np.interp(k, k[::5], log.position[::5])
    assert codes(Samples(log.time, log.command, joined, PERIOD)) == ["interpolated_rows"]


def test_a_ramp_that_was_commanded_is_no_interpolation():
    k = np.arange(900)
    command = np.interp(k, [0, 100, 200, 400, 500, 700, 899], [0, 0, 3, 3, -2, -2, 1.0])
    velocity = np.concatenate([[0.0], np.cumsum(command)[:-1]])
    position = np.concatenate([[0.0], np.cumsum(velocity + 0.5 * command)[:-1]]) * PERIOD**2 / 2
    assert codes(Samples(PERIOD * k, command, position, PERIOD)) == []


def test_a_short_log_has_that_finding_alone():
    log = motor(2.0, rows=60)
    few = Samples(log.time[:6], log.command[:6], log.position[:6], PERIOD)
    assert codes(few) == ["too_few_rows"]


@pytest.mark.parametrize(("column", "sign"), [("position", (1, -1)), ("command", (-1, 1))])
def test_a_wall_shows_which_of_its_signs_is_reversed(column, sign):
    k = np.arange(200)
    x = np.where(k < 20, 0.0, 1e-3 * (1 - np.cos((k - 20) / 9.0)))
    command = np.where(k < 20, 0.0, 5.0) - 400.0 * x - 2.0 * np.diff(x, prepend=0.0) / PERIOD
    right = Samples(PERIOD * k, command, x, PERIOD, 400.0, 2.0, 5.0)
    assert codes(right) == []
    (finding,) = check_recording(Samples(PERIOD * k, sign[0] * command, sign[1] * x, PERIOD, 400.0, 2.0, 5.0))
    assert finding.code == "wrong_sign"
    assert f"the sign of the {column} is reversed" in finding.evidence


@pytest.mark.parametrize("first", [0, 60])
def test_a_filter_of_both_directions_is_found_from_rest_and_within_a_motion(first):
    log = motor(2.0, rows=1400, noise=1e-7)
    one, both = (run(*butter(2, 0.04), log.position) for run in (lfilter, filtfilt))
    assert codes(Samples(log.time[first:], log.command[first:], both[first:], PERIOD)) == ["noncausal"]
    assert codes(Samples(log.time[first:], log.command[first:], one[first:], PERIOD)) == []


def test_ramps_of_a_grid_are_right_where_the_motion_is_theirs_and_wrong_where_it_is_that_of_steps():
    log, k = motor(2.0, noise=1e-9), np.arange(800)
    joined = np.interp(k, k[::20], log.command[::20])
    (finding,) = check_recording(Samples(log.time, joined, log.position, PERIOD))
    assert (finding.code, finding.severity) == ("interpolated_rows", "unsafe")
    velocity = np.concatenate([[0.0], np.cumsum(joined)[:-1]])
    moved = np.concatenate([[0.0], np.cumsum(velocity + 0.5 * joined)[:-1]]) * PERIOD**2 / 2
    assert codes(Samples(log.time, joined, moved, PERIOD)) == []


def test_a_jump_in_the_last_rows_is_joined_as_those_before():
    turned = np.linspace(0.0, 6 * np.pi + 0.02, 400)
    joined, finding = unwrapped(np.mod(turned, 2 * np.pi))
    assert joined == pytest.approx(turned, abs=1e-9)
    assert finding.rows == 3
    assert unwrapped(np.mod(turned[:135], 2 * np.pi))[1] is None  # a single one there may be a wrong reading


@pytest.mark.parametrize("delay", [2.0, 8.0, 8.5])
@pytest.mark.parametrize("rows", [101, 111, 150])
def test_a_free_motion_between_the_delays_that_are_tried_has_no_other_sign(delay, rows):
    # the grid of delays begins at a quarter of the rows: the true one may lie between, and is exact without noise
    k = np.arange(rows)
    x = 4e-5 * np.maximum(k - 20 - delay, 0.0) ** 2
    command = np.where(k < 20, 0.0, 15.0)
    samples = Samples(PERIOD * k, command, x, PERIOD, 0.0, 0.0, 15.0)
    assert "wrong_sign" not in codes(samples)
    assert codes(Samples(PERIOD * k, -command, x, PERIOD, 0.0, 0.0, -15.0)) == ["wrong_sign"]


@pytest.mark.parametrize("rest", [24, 63, 64, 65, 127, 128, 129, 300, 2000])
def test_a_rest_of_any_length_before_a_step_is_no_fault(rest):
    """The rest before the edge was cut out at rows that a long rest does not have."""
    k = np.arange(rest + 300)
    command = np.where(k < rest, 0.0, 5.0)
    position = 1e-3 * np.maximum(k - rest - 2, 0.0) ** 2
    samples = Samples(PERIOD * k, command, position, PERIOD)
    assert codes(samples) == []
    early = 1e-3 * np.maximum(k - rest + 20, 0.0) ** 2
    (finding,) = check_recording(Samples(PERIOD * k, command, early, PERIOD))
    assert finding.code == "noncausal"


@pytest.mark.parametrize("seed", range(4))
def test_a_command_that_changes_between_polled_rows_is_no_fault(seed):
    """Rows that are polled 5 to 8 ms apart see a motion in the row in which they first see its command."""
    time = np.cumsum(np.random.default_rng(seed).uniform(5e-3, 8e-3, 400))
    begun = np.maximum(time - time[199] - 1e-3, 0.0)  # the command changes 1 ms behind row 199
    command, position = np.sin(2 * begun), begun**2
    assert codes(Samples(time, command, position, 6.5e-3)) == []
    early = np.maximum(time - time[196], 0.0) ** 2
    (finding,) = check_recording(Samples(time, command, early, 6.5e-3))
    assert finding.code == "noncausal"
