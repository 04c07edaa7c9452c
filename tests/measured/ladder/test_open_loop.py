"""Positions from commands: against a fine integration of the device as two masses, a lag and a delay."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.loop.loop import Loop, Vibration
from pipeline.measured.ladder.open_loop import Commands, pulse_response

FAR, SPRING, DAMPER = 0.3, 0.02, 0.004


def motion(command: np.ndarray, loop: Loop, rows: int) -> np.ndarray:
    """Motor and load of unit mass together, each moved by its own forces; time in samples."""
    near = 1.0 - FAR if loop.mode else 1.0

    def rate(t: float, z: np.ndarray) -> list[float]:
        sent = int(np.floor(t - loop.delay + 1e-12))
        u = command[sent] if 0 <= sent < len(command) else 0.0
        force = z[4] if loop.lag else u
        between = SPRING * (z[0] - z[2]) + DAMPER * (z[1] - z[3]) if loop.mode else 0.0
        pull = force - loop.gamma * z[0] - loop.delta * z[1] - between
        return [z[1], pull / near, z[3], between / FAR, (u - z[4]) / loop.lag if loop.lag else 0.0]

    side = 2 if loop.mode and loop.mode.sensor_far else 0
    part = loop.delay % 1
    result, z = [0.0], np.zeros(5)
    for k in range(rows - 1):
        for start, end in ((k, k + part), (k + part, k + 1)):
            if end > start:
                # inside each piece the command is constant: the right-hand side is smooth
                span = (start + 1e-9, end - 1e-9)
                z = solve_ivp(rate, span, z, rtol=1e-11, atol=1e-14).y[:, -1]
        result.append(z[side])
    return np.array(result)


@pytest.mark.parametrize("delay", [0.0, 2.0, 1.37])
@pytest.mark.parametrize("lag", [0.0, 1.8])
@pytest.mark.parametrize("sensor_far", [None, False, True])
def test_positions_are_those_of_a_fine_integration(delay, lag, sensor_far):
    mode = None if sensor_far is None else Vibration(FAR, SPRING, DAMPER, sensor_far)
    loop = Loop(0.003, 0.01, delay, lag, mode)
    command = np.random.default_rng(1).normal(size=(2, 25))
    found = Commands.of(command).response(loop)
    for row, u in zip(found, [*command, np.ones(25)], strict=True):
        expected = motion(u, loop, 25)
        # the pieces leave 2e-9 of each sample out
        assert row == pytest.approx(expected, abs=3e-7 * np.abs(expected).max())


def test_a_command_that_comes_after_the_log_moves_nothing():
    assert not pulse_response(Loop(0.0, 0.01, 30.0), 20).any()
