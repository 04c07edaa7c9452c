from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.lag import lags_of, velocity_lag
from pipeline.records.batch import TrialBatch


def swing(lag, *, n=400, seed=0, quantum=0.0, speed_quantum=0.0, jitter=0.2, gain=1.0, offset=0.0):
    """A log of two sines at about 4.4 ms, its velocity known in closed form and late by ``lag``."""
    random = np.random.default_rng(seed)
    time = np.cumsum(4.4e-3 * (1 + jitter * random.uniform(-1, 1, n)))
    w = random.uniform(3, 9)
    position = 0.5 * np.sin(w * time) + 0.1 * np.sin(2.3 * w * time + 1)
    late = time - lag
    velocity = gain * (0.5 * w * np.cos(w * late) + 0.23 * w * np.cos(2.3 * w * late + 1)) + offset
    if quantum:
        position = np.round(position / quantum) * quantum
    if speed_quantum:
        velocity = np.round(velocity / speed_quantum) * speed_quantum
    return time, position, velocity


@pytest.mark.parametrize("lag", [-0.010, 0.0, 0.0031, 0.018, 0.040])
def test_lag_of_a_smooth_motion(lag):
    found = velocity_lag(*swing(lag))
    # velocities are taken as straight between rows: (w T)^2/12 of the motion, 1e-4 of a row
    assert found.lag_s == pytest.approx(lag, abs=2e-6)
    assert found.gain == pytest.approx(1.0, rel=1e-3)


def test_gain_and_offset_of_the_velocity_do_not_matter():
    found = velocity_lag(*swing(0.018, gain=1.3, offset=0.2))
    assert found.lag_s == pytest.approx(0.018, abs=2e-6)
    assert found.gain == pytest.approx(1.3, rel=1e-3)


def test_a_low_pass_shows_as_its_time_constant():
    time = np.arange(2000) * 1e-3
    position = np.sin(5 * time)
    constant = 0.012
    # steady response of a first-order filter to 5 cos(5 t): smaller by 1/sqrt(1 + 0.06^2), later by atan(0.06)/5
    velocity = 5 / np.hypot(1, 5 * constant) * np.cos(5 * time - np.arctan(5 * constant))
    found = velocity_lag(time, position, velocity)
    assert found.lag_s == pytest.approx(np.arctan(5 * constant) / 5, rel=1e-3)
    assert found.lag_s == pytest.approx(constant, rel=2e-3)


def test_standard_errors_hold_with_coarse_sensors():
    lags = np.random.default_rng(1).uniform(-0.01, 0.03, 100)
    found = [velocity_lag(*swing(lag, seed=i, quantum=1.5e-3, speed_quantum=0.077)) for i, lag in enumerate(lags)]
    error = np.array([f.lag_s for f in found]) - lags
    assert abs(error.mean()) < 5e-5
    assert error.std() < 2e-4  # 5 % of a row
    z = error / [f.standard_error_s for f in found]
    # ten parts for three unknowns: Student's t with seven degrees of freedom has 1.18, 100 trials tell it to 7 %
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.5


def test_reasons():
    time, position, velocity = swing(0.01)
    assert "at least" in velocity_lag(time[:10], position[:10], velocity[:10]).reason
    assert "too short" in velocity_lag(time[:40], position[:40], velocity[:40]).reason
    assert "constant" in velocity_lag(time, position, np.zeros_like(time)).reason
    assert "unit" in velocity_lag(time, position, 57.3 * velocity).reason
    assert "not within" in velocity_lag(time, position, velocity, largest_lag_s=0.005).reason
    random = np.random.default_rng(0)
    assert velocity_lag(time, position, random.standard_normal(len(time))).lag_s is None
    steady = velocity_lag(
        time, 2 * time + 1e-9 * random.standard_normal(len(time)), 2 + 1e-3 * random.standard_normal(400)
    )
    assert steady.lag_s is None


def test_errors():
    time, position, velocity = swing(0.01)
    with pytest.raises(ParameterError, match="same length"):
        velocity_lag(time, position[1:], velocity)
    with pytest.raises(ParameterError, match="row 3"):
        velocity_lag(time, np.where(np.arange(400) == 3, np.nan, position), velocity)
    with pytest.raises(ParameterError, match="time in row 1"):
        velocity_lag(time[::-1], position, velocity)


def test_trials_without_a_velocity_in_order_have_no_lag():
    time, position, velocity = swing(0.018)
    one = np.ones(2)
    both = [np.stack([values, values]) for values in (time, position, velocity)]
    both[2][1] = np.nan
    rows = np.array([400, 400])
    batch = TrialBatch(("a", "b"), one, one, one, 4e-3 * one, rows, both[0], both[1], both[1], velocity=both[2])
    first, second = lags_of(batch)
    assert first.lag_s == pytest.approx(0.018, abs=2e-6)
    assert second.lag_s is None
    assert lags_of(replace(batch, velocity=None))[0].lag_s is None
