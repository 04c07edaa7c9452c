"""The device of the logs so far foretells limits that it was not told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kinds import kinds

from pipeline.device_data.devices import load_device
from pipeline.measured.experiment.identified_loop import nominal_loop
from pipeline.measured.identification.parts import choose_parts
from pipeline.planning.campaign import PlanOptions, forecast_of, learn, open_campaign
from pipeline.planning.loop_limits import limits_of, linear_limits
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate

DAMPINGS = np.array([20.0, 60.0, 100.0])
K, B = np.array([1500.0, 4000.0, 6000.0]), np.array([10.0, 30.0, 50.0])


def logs(kind, count=3):
    device = kinds(load_device("falcon"))[kind](2).device
    return device, simulate(setup_of(device, device.experiments[0]), K[:count], B[:count], seed=3)


def truth(device):
    return linear_limits(device.loop_for(device.experiments[0]), DAMPINGS)


@pytest.mark.parametrize(
    "kind", ["ideal", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("actuator lag", "butterworth filter"))]
)
def test_limits_of_devices_that_three_logs_show(kind):
    device, trials = logs(kind)
    found = learn(trials, 3, None, choose_parts)
    assert linear_limits(found.device.loop, DAMPINGS) == pytest.approx(truth(device), rel=0.01)
    assert (limits_of(found.device, DAMPINGS)[1] < 0.02 * truth(device).max()).all()
    assert found.looked == 3


def test_no_search_for_parts_is_waited_for_and_one_is_asked_for_when_there_are_three_times_as_many_logs():
    device, trials = logs("ideal")
    asked = []
    assert learn(trials, 3, None, lambda recordings: asked.append(len(recordings))) is None
    known = learn(trials, 3, None, choose_parts)
    for count in (4, 8, 9):
        found = learn(trials, count, known, lambda recordings: asked.append(len(recordings)))
        assert linear_limits(found.device.loop, DAMPINGS) == pytest.approx(truth(device), rel=0.01)
    assert asked == [3, 3], "at the first log and at the ninth"


def test_logs_without_motion_teach_nothing():
    _, trials = logs("ideal", 1)
    still = replace(trials, position=np.zeros_like(trials.position))
    assert learn(still, 1, None, lambda _: pytest.fail("asked")) is None


def test_friction_raises_the_limit_for_the_step_and_widens_what_is_foretold(tmp_path):
    case = kinds(load_device("falcon"))["friction strong"](2)
    campaign = open_campaign("falcon", tmp_path / "none", "1", PlanOptions())
    device = nominal_loop(case.device.loop_for(case.device.experiments[0]))
    sure = replace(campaign, found=device)
    errors = [0.2 * value * (name == "friction.coulomb") for name, value in device.values.items()]
    loose = replace(campaign, found=replace(device, covariance=np.diag(errors) ** 2))
    linear = linear_limits(device.loop, DAMPINGS)
    plain, wide = forecast_of(sure, DAMPINGS.tolist()), forecast_of(loose, DAMPINGS.tolist())
    assert (plain.limit > 1.05 * linear).all()
    assert wide.limit == pytest.approx(plain.limit)
    added = np.sqrt(wide.error**2 - plain.error**2)
    assert added == pytest.approx(0.2 * (plain.limit - linear), rel=0.02)
