"""Loops that a device file states: from its file over simulated logs to limits, passive wall, and what is said."""

import mpmath as mp
import numpy as np
import pytest
from general_devices import ManyDigits
from labs import compare

from pipeline.device.loop import Loop
from pipeline.device_data.devices import read_device
from pipeline.intake.ingest import ingest
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.theory.boundary import stiffness_limit

FILE = """
name = "{name}"
title = "Arm"
source = "made up"
sampling_period_s = {period}
step = 3.0
duration_s = {duration}
baseline_s = {baseline}
[limits]
travel = 0.2
[sensor]
quantum = 1e-6
noise = 3e-7
[loop]
{loop}
[[experiment]]
name = "1"
mass = {mass}
damping = {damping}
delay_samples = {delay}
damping_last = {last}
damping_step = {spacing}
stiffness_step = {stiffness}
"""
DEVICES = {
    "filter": (
        'velocity = { kind = "difference", samples = 6 }',
        {"mass": 0.3, "damping": 2.0, "delay": 1.0, "last": 24.0, "spacing": 8.0, "stiffness": 700.0},
    ),
    "lag": (
        "actuator_lag_s = 0.002",
        {"mass": 0.9, "damping": 6.0, "delay": 2.0, "last": 60.0, "spacing": 20.0, "stiffness": 1500.0},
    ),
    "mode": (
        'mode = { frequency_hz = 55.0, damping_ratio = 0.08, mass = 0.2, sensor = "motor" }',
        {"mass": 0.7, "damping": 5.0, "delay": 1.5, "last": 40.0, "spacing": 20.0, "stiffness": 2500.0},
    ),
    "operator": (
        "operator = { mass = 0.4, damping = 6.0, stiffness = 500.0 }\nforce_gain = 0.8",
        {"mass": 0.6, "damping": 4.0, "delay": 3.0, "last": 40.0, "spacing": 20.0, "stiffness": 1200.0},
    ),
    "all": (
        'velocity = { kind = "butterworth", order = 1, cutoff_hz = 70.0 }\nactuator_lag_s = 0.0015\nforce_gain = 1.3\n'
        'mode = { frequency_hz = 70.0, damping_ratio = 0.06, mass = 0.15, sensor = "motor" }\n'
        "operator = { mass = 0.2, damping = 4.0, stiffness = 200.0 }",
        {"mass": 0.6, "damping": 5.0, "delay": 2.3, "last": 40.0, "spacing": 20.0, "stiffness": 800.0},
    ),
}
STOPS = {"filter": 0.5}
"""Periods [ms] other than 1."""


def text(name, loop, numbers):
    period = 1e-3 * STOPS.get(name, 1.0)
    given = {"name": name, "loop": loop, "period": period, "duration": 400 * period, "baseline": 20 * period}
    return FILE.format(**given, **numbers)


@pytest.fixture
def told(tmp_path, monkeypatch):
    """The result of a course of a device, compared with the same file or with another one."""

    def of(name, loop, numbers, other=None):
        file = tmp_path / "devices" / f"{name}.toml"
        file.parent.mkdir()
        monkeypatch.setenv("PIPELINE_DEVICES", str(file.parent))
        file.write_text(text(name, loop, numbers), encoding="utf-8")
        device = read_device(file)
        course = run_sweep(device, "1", seed=11)
        write_sweep(course, tmp_path / "raw")
        ingest([tmp_path / "raw"], tmp_path / "processed", jobs=1)
        if other is not None:
            file.write_text(text(name, other, numbers), encoding="utf-8")
        return device, compare(name, tmp_path / "processed", criteria=("energy_step_w0",)).result

    return of


def truth_of(device):
    return ManyDigits(device.loop_for(device.experiments[0]))


def holds(device, found):
    """Limits are those of another loop of the same device in many digits, and the passive wall is stable."""
    truth = truth_of(device)
    with mp.workdps(40):
        for limit in found.loop_boundary:
            assert limit.low <= limit.stiffness <= limit.high
            if limit.stiffness > 500:
                sides = [truth.stable(limit.stiffness * share, limit.damping) for share in (0.9999, 1.0001)]
                assert sides == [True, False]
        assert truth.stable(found.passive.stiffness, found.passive.damping)


@pytest.mark.slow
@pytest.mark.parametrize("name", DEVICES)
def test_statements_rest_on_the_loop_of_the_file(told, name):
    device, result = told(name, *DEVICES[name])
    (found,) = result.experiments
    loop, of_file = found.loop, device.loop_for(device.experiments[0])
    assert (loop.source, loop.adequate) == ("device file", True), loop.reason
    held, mode = of_file.operator, of_file.mode
    assert loop.mass.value == pytest.approx((of_file.mass + (held.mass if held else 0)) / of_file.force_gain)
    assert loop.delay_samples.value == of_file.delay_samples
    assert (loop.actuator_lag_s.value if loop.actuator_lag_s else 0) == of_file.actuator_lag_s
    assert (loop.mode is None) == (mode is None)
    if mode is not None:  # as the wall feels it: a hand on the motor slows it, the load is one per unit of command
        masses = [of_file.mass, of_file.mass + (held.mass if held else 0)]
        slower = np.sqrt(np.divide(*((whole - mode.mass) / whole for whole in masses)))
        assert loop.mode["frequency_hz"].value == pytest.approx(mode.frequency_hz * slower)
        assert loop.mode["mass"].value == pytest.approx(mode.mass / of_file.force_gain)
    assert (loop.operator["stiffness"].value if held else 0) == (held.stiffness if held else 0)
    assert (loop.velocity is None) == (of_file.velocity is None)
    holds(device, found)
    for limit, point in zip(found.loop_boundary, found.boundary, strict=True):
        if point.stable and limit.stiffness > 500:
            assert point.stable < limit.stiffness < (point.unstable or np.inf)
    # theory by the estimates has the parts too: its limits are the measured ones
    own = [scores for scores in found.scores if scores.basis == "estimates"]
    assert all(abs(scores.distance.median) < 0.02 for scores in own)
    assert of_file.parts_in_words() in loop.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("filter", 'velocity = { kind = "difference", samples = 3 }'),
        ("filter", ""),
        ("lag", "actuator_lag_s = 0.004"),
        # one of 90 Hz has limits within 5 %, and is as good
        ("mode", 'mode = { frequency_hz = 30.0, damping_ratio = 0.08, mass = 0.2, sensor = "motor" }'),
    ],
)
def test_a_file_of_another_loop_gives_way_to_the_found_device(told, name, other):
    device, result = told(name, *DEVICES[name], other=other)
    (found,) = result.experiments
    assert found.loop.source == "estimated"
    assert "the limits of the device file deviate by" in found.loop.reason
    if found.loop.adequate:
        truth = truth_of(device)
        with mp.workdps(40):
            assert found.passive is None or truth.stable(found.passive.stiffness, found.passive.damping)


@pytest.mark.slow
def test_a_loop_that_nothing_stabilises_is_said_so(told):
    loop = 'velocity = { kind = "coefficients", b = [1.0, -1.0], a = [1.0] }\nactuator_lag_s = 0.003'
    numbers = {"mass": 0.5, "damping": 0.0, "delay": 5.0, "last": 20.0, "spacing": 20.0, "stiffness": 500.0}
    _, result = told("nothing", loop, numbers)
    assert any("no wall is stable in" in warning for warning in result.warnings)
    (found,) = result.experiments
    assert found.theory is None
    assert found.passive is None


def test_what_the_wall_feels_is_the_same_loop():
    whole = Loop(
        mass=0.5,
        damping=3.0,
        stiffness=20.0,
        sampling_period_s=1e-3,
        delay_samples=2.4,
        actuator_lag_s=0.001,
        force_gain=0.7,
        mode={"frequency_hz": 60.0, "damping_ratio": 0.05, "mass": 0.1, "load_damping": 2.0},
        operator={"mass": 0.15, "damping": 5.0, "stiffness": 300.0},
    )
    felt = whole.apparent()
    assert (felt.mass, felt.damping, felt.stiffness) == pytest.approx((0.65 / 0.7, 8 / 0.7, 320 / 0.7))
    wall, limits = np.array([10.0, 30.0]), []
    for loop in (whole, felt):
        units = LoopUnits.of(loop)
        limits.append(stiffness_limit(NormalisedLoop.of(loop), wall / units.damping) * units.stiffness)
    np.testing.assert_allclose(limits[0], limits[1], rtol=1e-9)
