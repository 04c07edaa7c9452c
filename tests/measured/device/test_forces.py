"""The joint balance against devices simulated by fine sub-steps, with friction that sticks exactly."""

from __future__ import annotations

import numpy as np
import pytest
from moving import HAPTIC, MOTOR, record

from pipeline.measured.device.forces import balance_sums, identify
from pipeline.measured.signal.response import find_response

TORQUE, FRICTION = 0.01, 0.01 * 2 / 3
LEVELS = TORQUE * np.array([1, 1, 1, 1.5, 1.5, 1.5])
STEP = 8.0


def sums_of(batch, delay):
    return balance_sums(batch, find_response(batch), delay)


def told(batch, delay):
    return identify(sums_of(batch, delay), float(batch.sampling_period_s[0]))


def motor(step=TORQUE, **options):
    return told(
        record(np.zeros(6), 0, step=step, delay=2, fine=20, **{"noise": 5e-5, "c": FRICTION, **MOTOR, **options}), 2
    )


def walls(count, seed, **options):
    random = np.random.default_rng(seed)
    K, B = random.uniform(200, 3000, count), random.uniform(4, 30, count)
    return record(K, B, step=STEP, fine=20, rows=400, **{"delay": 3, "seed": seed, **HAPTIC, **options})


def holds(found, **truth):
    return {name: abs(found.value[name] - value) <= found.half_width[name] for name, value in truth.items()}


@pytest.mark.parametrize("constant", [0.0, -0.001, 0.001])
def test_one_way_under_one_torque_gives_upper_bounds(constant):
    found = motor(constant=min(constant, 0.0))
    assert found.value == {}
    assert MOTOR["mass"] < found.bound["mass"] < 10 * MOTOR["mass"]
    assert MOTOR["b"] < found.bound["damping"] < 10 * MOTOR["b"]


@pytest.mark.parametrize("constant", [0.0, -0.001])
def test_one_way_under_two_torques_tells_mass_and_damping_and_the_sum_of_friction_and_constant_force(constant):
    found = motor(LEVELS, constant=constant)
    assert found.one_way
    assert "constant_force" not in found.value
    assert all(holds(found, mass=MOTOR["mass"], damping=MOTOR["b"], friction=FRICTION - constant).values())
    assert found.value["mass"] == pytest.approx(MOTOR["mass"], rel=0.01)
    assert found.value["damping"] == pytest.approx(MOTOR["b"], rel=0.02)


@pytest.mark.parametrize("constant", [0.0, -0.001, 0.0005])
def test_a_reversal_tells_everything(constant):
    found = motor(constant=constant, reverse=300, noise=0.0)
    assert not found.one_way
    assert found.value["mass"] == pytest.approx(MOTOR["mass"], rel=0.01)
    assert found.value["damping"] == pytest.approx(MOTOR["b"], rel=0.05)
    assert found.value["friction"] == pytest.approx(FRICTION, rel=0.01)
    assert found.value["constant_force"] == pytest.approx(constant, abs=0.01 * TORQUE)


def test_a_reversal_that_noise_hides_is_told_with_its_interval_or_not_at_all():
    for reverse in (250, 300, 350):
        found = motor(reverse=reverse)
        truth = {"mass": MOTOR["mass"], "damping": MOTOR["b"], "friction": FRICTION}
        assert found.bound == {}
        assert all(holds(found, **{name: value for name, value in truth.items() if name in found.value}).values())


def test_steps_of_both_signs_and_two_sizes_tell_friction_from_a_constant_force():
    found = motor(LEVELS * np.array([1, -1, 1, -1, 1, -1]), constant=-0.001)
    assert all(holds(found, mass=MOTOR["mass"], friction=FRICTION, constant_force=-0.001).values())
    assert found.value["friction"] == pytest.approx(FRICTION, rel=0.01)


def test_steps_of_both_signs_and_one_size_do_not_tell_friction():
    found = motor(TORQUE * np.array([1, -1, 1, -1, 1, -1]), constant=-0.001)
    assert found.value == {}


def test_a_held_device_has_a_spring_and_its_own_damping():
    found = told(walls(6, 31, k=300.0, b=7.0), 3)
    assert found.asked_for == {"stiffness"}
    assert found.value["stiffness"] == pytest.approx(300, rel=0.01)
    assert found.value["damping"] == pytest.approx(7, rel=0.01)
    assert found.value["mass"] == pytest.approx(0.6, rel=0.01)


def test_walls_tell_friction_and_a_constant_force():
    found = told(walls(8, 32, c=1.5, constant=1.0), 3)
    assert {"friction", "constant_force"} <= found.asked_for
    assert found.value["friction"] == pytest.approx(1.5, rel=0.03)
    assert found.value["constant_force"] == pytest.approx(1.0, rel=0.03)
    assert found.value["mass"] == pytest.approx(0.6, rel=0.02)


def test_nothing_is_asked_for_where_nothing_acts():
    for seed, options in ((33, {"delay": 2.4}), (34, {"noise": 2e-6}), (35, {"lag": 0.001}), (36, {"quantum": 2e-5})):
        found = told(walls(6, seed, **options), 3)
        assert not found.asked_for, (options, found)
        assert found.value["mass"] == pytest.approx(0.6, rel=0.01)


@pytest.mark.parametrize(
    "options",
    [{}, {"c": 0.5}, {"c": 0.5, "k": 200.0}, {"delay": 3.4, "k": 200.0}],
    ids=["ideal", "friction", "both", "spring"],
)
def test_intervals_of_forty_courses_hold_the_truth(options):
    courses, trials = 40, 6
    sums = sums_of(walls(courses * trials, 41, noise=1e-6, **options), 3)
    truth = {"mass": 0.6, "damping": 5.0, "friction": options.get("c", 0.0), "stiffness": options.get("k", 0.0)}
    found = [identify(sums[i : i + trials], 1e-3) for i in range(0, courses * trials, trials)]
    for name, value in truth.items():
        held = [abs(f.value[name] - value) <= f.half_width[name] for f in found if name in f.value]
        assert len(held) >= 0.9 * courses
        assert np.mean(held) >= 0.9, name


def test_trials_that_say_nothing_are_left_out():
    sums = sums_of(walls(4, 51), 3)
    nothing = np.full((2, sums.shape[1]), np.nan)
    assert identify(nothing, 1e-3) is None
    assert identify(np.vstack([sums, nothing]), 1e-3).value == identify(sums, 1e-3).value
