"""Motion with Coulomb friction: against the simulator's, which finds each stop on the exact motion."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.loop.device_loop import loop_of
from pipeline.measured.ladder.open_loop import Commands
from pipeline.measured.ladder.sliding import sliding
from pipeline.records.loop_parts import Friction, LoopParts, Mode
from pipeline.simulation.mechanism import Mechanism

T, MASS, DAMPING, STIFFNESS = 1e-3, 0.5, 4.0, 200.0


def commands(seed: int) -> np.ndarray:
    """A growing and a dying oscillation, and a step, of some N."""
    time, random = np.arange(400) * T, np.random.default_rng(seed)
    turns = [random.uniform(6, 14) * np.exp(g * time) * np.cos(2 * np.pi * 18 * time) for g in (2.0, -12.0)]
    return np.array([*turns, np.where(time > 0.02, 5.0, 0.0)])


def simulated(mechanism: Mechanism, command: np.ndarray, delay: float) -> np.ndarray:
    whole, part = int(delay), delay % 1
    state, found = mechanism.rest(np.zeros(len(command))), []
    sent = np.concatenate([np.zeros((len(command), whole + 1)), command], axis=1)
    for k in range(command.shape[1]):
        found.append(state[mechanism.sensed].copy())
        if part:
            state = mechanism.advance(state, sent[:, k], 0.0, part * T)
        state = mechanism.advance(state, sent[:, k + 1], 0.0, (1 - part) * T)
    return np.array(found).T


@pytest.mark.parametrize(
    ("lag", "mode", "delay", "off"),
    [
        (0.0, None, 3.0, 1e-6),
        (0.0, None, 2.4, 1e-6),
        # between two samples a lag may let go of what sticks; the stop is placed as if drive and mode were straight
        (0.002, None, 3.0, 6e-4),
        (0.0, Mode(frequency_hz=60.0, damping_ratio=0.03, mass=0.1), 3.0, 2e-2),
    ],
)
def test_motion_is_that_of_the_simulator(lag, mode, delay, off):
    near = MASS - (mode.mass if mode else 0.0)
    spring = damper = 0.0
    if mode:
        reduced, turn = mode.mass * near / MASS, 2 * np.pi * mode.frequency_hz
        spring, damper = reduced * turn**2, 2 * mode.damping_ratio * turn * reduced
    coulomb = np.array([0.4, 0.9])
    loop = loop_of(MASS, DAMPING, STIFFNESS, delay, T, LoopParts(actuator_lag_s=lag, mode=mode))
    for seed in (1, 2):
        command = commands(seed)
        found = T**2 / MASS * sliding([loop, loop], coulomb, np.stack([command, command]), np.zeros(2))
        for c, motion in zip(coulomb, found, strict=True):
            body = Mechanism(
                near, DAMPING, STIFFNESS, mode.mass if mode else 0.0, spring, damper, lag, Friction(coulomb=float(c))
            )
            expected = simulated(body, command, delay)
            assert motion == pytest.approx(expected, abs=off * np.abs(expected).max())


def test_without_friction_it_is_the_linear_motion():
    loop = loop_of(MASS, DAMPING, 0.0, 2.3, T, LoopParts())
    command = commands(3)
    linear = Commands.of(command).response(loop)[:-1]
    (found,) = sliding([loop], np.zeros(1), command[None], np.zeros(1))
    assert found == pytest.approx(linear, abs=1e-7 * np.abs(linear).max())


def test_a_force_below_friction_moves_nothing():
    loop = loop_of(MASS, DAMPING, 0.0, 2.0, T, LoopParts(actuator_lag_s=0.002))
    found = sliding([loop], np.ones(1), np.full((1, 1, 50), 0.99), np.zeros(1))
    assert not found.any()
