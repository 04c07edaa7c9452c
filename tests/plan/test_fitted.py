"""The device of all logs foretells limits that it was not told."""

from __future__ import annotations

import numpy as np
import pytest
from kinds import kinds

from pipeline.device_data.devices import load_device
from pipeline.loop.device_loop import loop_of, wall_units
from pipeline.measured.ladder.device import Device
from pipeline.measured.signal.response import find_response
from pipeline.plan.evidence import Evidence
from pipeline.plan.fitted import Fitted, at_once, first_guess, learn
from pipeline.plan.forecast import Foretold, found_misfit
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.theory.limits import limits

DAMPINGS = np.array([20.0, 60.0, 100.0])
K, B = np.array([1500.0, 4000.0, 6000.0, 3000.0, 5000.0, 4500.0]), np.array([10.0, 30.0, 50.0, 70.0, 90.0, 60.0])


def truth(device):
    of, T = device.experiments[0], device.sampling_period_s
    parts = device.loop_of(of)
    loop, units = loop_of(of.mass, of.damping, of.stiffness, of.delay_samples, T, parts), wall_units(of.mass, T, parts)
    return np.nan_to_num(limits(loop, DAMPINGS / units.damping).alpha) * units.stiffness


@pytest.mark.parametrize("kind", ["ideal", "actuator lag", "butterworth filter"])
def test_limits_of_devices_that_six_logs_explain(kind):
    device = kinds(load_device("falcon"))[kind](2).device
    found = learn(simulate(setup_of(device, device.experiments[0]), K, B, seed=3), None, at_once)
    assert found.explains
    assert found.climbed == 6
    assert found.limits(DAMPINGS) == pytest.approx(truth(device), rel=0.01)
    assert found.foretold(DAMPINGS, DAMPINGS[:1]).misfit < 0.01


def test_no_search_for_parts_is_waited_for():
    device = kinds(load_device("falcon"))["ideal"](2).device
    batch = simulate(setup_of(device, device.experiments[0]), K, B, seed=3)
    asked = []
    found = learn(batch, None, lambda trials, ideal: asked.append(len(trials)))
    assert asked == [6]
    assert found.climbed == 0
    few = learn(batch.select(slice(0, 5)), found, lambda trials, ideal: asked.append(len(trials)))
    assert asked == [6], "five logs tell no parts"
    assert few.limits(DAMPINGS) == pytest.approx(truth(device), rel=0.01), "an ideal device needs none"


def test_slope_of_the_growth_rate_is_that_of_theory():
    found = Fitted(Device({"gain": np.log(1e-6 / 0.5), "delta": 0.007, "delay": 4.0}), np.zeros((3, 3)), True, 1e-3)
    limit = found.limits(DAMPINGS)
    softer = 0.99 * limit / found.units.stiffness
    rate = (
        np.log(np.abs(np.linalg.eigvals(found.loop.matrix(softer, DAMPINGS / found.units.damping))).max(axis=1)) / 1e-3
    )
    assert found.slopes(DAMPINGS, limit) == pytest.approx(-rate / (0.01 * limit), rel=0.05)


def test_first_guess_is_that_of_single_trials():
    device = kinds(load_device("falcon"))["ideal"](2).device
    batch = simulate(setup_of(device, device.experiments[0]), K[:2], B[:2], seed=3)
    found = first_guess(batch, find_response(batch))
    assert found.units.mass == pytest.approx(device.experiments[0].mass, rel=0.01)


def test_misfit_is_what_limits_show():
    level = np.full(4, 1000.0)
    by = Foretold(level, level * 0, level, np.full(4, 1e-3), 1000.0, 0.01, explains=True)
    nothing = np.full(4, np.nan)
    right = Evidence(DAMPINGS, level - 10, level + 10, nothing, nothing, nothing)
    wrong = Evidence(DAMPINGS, level + 200, level + 220, nothing, nothing, nothing)
    assert found_misfit(by, right) < 0.015
    assert found_misfit(by, wrong) > 0.1
