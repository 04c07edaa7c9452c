"""Limits of a device with friction: for the step that was used, and the linear ones beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fine_loop import Body, run

from pipeline.device.loop import Loop
from pipeline.device.parts import Friction
from pipeline.measured.experiment.identified_loop import IdentifiedLoop
from pipeline.planning.loop_limits import StepTrial, limits_of, linear_limits, step_limits

MASS, DAMPING, T, DELAY, COULOMB = 0.456, 4.6, 0.001, 4, 0.9
B = np.array([40.0, 100.0])
DEVICE = Loop(MASS, DAMPING, T, DELAY, friction=Friction(coulomb=COULOMB))
LINEAR = linear_limits(DEVICE, B)


def of_step(step, device=DEVICE, **more):
    return step_limits(device, B, StepTrial(step, 400, **more), np.full(2, 200.0))[0]


def test_a_harder_push_is_unstable_from_softer_walls_on_down_to_the_linear_limit():
    limits = np.array([of_step(step) for step in (8.0, 16.0, 80.0, 800.0)])
    # verdicts tell a limit to some 0.3 %
    assert (np.diff(limits, axis=0) < np.array([[0.0], [0.0], [0.005]]) * limits[1:]).all()
    assert (limits >= LINEAR).all()
    assert (limits[0] > 1.1 * LINEAR).all()
    assert limits[-1] == pytest.approx(LINEAR, rel=0.02)


def test_the_limit_for_a_step_depends_on_the_share_of_friction_alone():
    half = DEVICE.replace({"friction.coulomb": COULOMB / 2})
    assert of_step(4.0, half) == pytest.approx(of_step(8.0), rel=2e-3)


def test_a_linear_device_has_its_linear_limit_for_every_step_and_jitter_moves_it():
    plain = replace(DEVICE, friction=None)
    assert of_step(8.0, plain) == pytest.approx(LINEAR, rel=0.01)
    # a command in force whose age scatters about the same mean moves it by little, a mean of a tenth less by more
    jitters, early = of_step(8.0, plain, jitter=0.5), linear_limits(replace(plain, delay_samples=0.9 * DELAY), B)
    assert ((jitters != linear_limits(plain, B)) & (abs(jitters / LINEAR - 1) < 0.04) & (early > 1.04 * LINEAR)).all()


def test_the_last_digit_of_a_device_moves_no_limit_of_a_jittering_step():
    """What chance draws in a simulated log follows from its wall, whose last digits are rounding."""
    limits = [of_step(8.0, DEVICE.replace({"mass": MASS * f}), jitter=0.7) for f in (1.0, 1 + 1e-15, 1 - 2e-15)]
    assert limits[1] == pytest.approx(limits[0], rel=1e-12)
    assert limits[2] == pytest.approx(limits[0], rel=1e-12)


def test_a_second_simulator_says_the_same_of_walls_beside_the_limit():
    (limit, _), late = of_step(8.0), slice(-60, None)
    for share, grows in ((0.94, False), (1.06, True)):
        position, _ = run(
            Body(MASS, DAMPING, coulomb=COULOMB, stiction=COULOMB),
            K=share * limit,
            B=B[0],
            T=T,
            external=np.full(300, 8.0),
            delay=(DELAY, 1),
            b=np.ones(1),
            a=np.ones(1),
        )
        swing, before = np.ptp(position[late]), np.ptp(position[60:120])
        assert (swing > before) == grows


@pytest.mark.slow
def test_a_course_with_friction_tells_both_limits(sticky_outcome):
    (result,) = sticky_outcome.result.experiments
    limits = {each.damping: each for each in result.loop_boundary}
    assert limits
    for point in result.boundary:
        if (each := limits.get(point.damping)) is not None:
            assert each.stiffness_large_motion == point.stiffness_large_motion
            assert each.low <= each.stiffness <= each.high
    known = [p for p in result.boundary if p.estimate and p.low and p.damping in limits]
    off = [limits[p.damping].stiffness / p.estimate - 1 for p in known]
    linear = [p.stiffness_large_motion / p.estimate - 1 for p in known]
    assert np.median(np.abs(off)) < 0.1 < np.median(np.abs(linear))
    held = [limits[p.damping].low <= p.high and p.low <= limits[p.damping].high for p in known]
    assert np.mean(held) > 0.9


@pytest.mark.slow
def test_a_coarse_sensor_alone_moves_no_limit_and_undecided_walls_leave_it_open():
    values = {"mass": MASS, "damping": DAMPING, "delay_samples": DELAY, "stiffness": 0.0}
    plain = IdentifiedLoop(values, np.zeros((4, 4)), T)
    limit, reach = limits_of(plain, B, StepTrial(8.0, 400, quantum=1e-4))
    assert limit == pytest.approx(LINEAR, rel=1e-12)
    assert (reach == 0).all()
    rubs = IdentifiedLoop(values | {"friction.coulomb": COULOMB}, np.zeros((5, 5)), T, parts=("friction",))
    (short, open_), (long, closed) = (limits_of(rubs, B, StepTrial(8.0, rows)) for rows in (150, 2000))
    assert (np.abs(short - long) <= open_ + closed).all()
    assert (open_ > 2 * closed).all()
