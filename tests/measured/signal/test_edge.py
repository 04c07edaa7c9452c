"""The edge of a log is a jump from its previous level to the next; a log with several jumps has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from columns import changed, responses
from simulated import FALCON, simulate

from pipeline.measured.signal.response import NO_ROW, declare_edge, find_response
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.records.trials import Trial

ROWS, EDGE, T = 600, 100, 1e-3
MOTOR = {"mass": 1.2e-4, "b": 7e-5}


def motor(levels, rows=(EDGE,), step=None, balance=0.0, delay=2, noise=0.0, seed=0) -> Trial:
    """A motor without a wall, driven from level to level; a constant torque beside it takes ``balance`` away.

    The motion is the closed solution of J w' = u - b w over each row, no code of the package.
    """
    command = np.full(ROWS, float(levels[0]))
    for row, level in zip(rows, levels[1:], strict=True):
        command[row:] = level
    rate = MOTOR["b"] / MOTOR["mass"]
    fade = np.exp(-rate * T)
    x, w, position = 0.0, 0.0, np.zeros(ROWS)
    for k in range(ROWS):
        position[k] = x
        final = (command[max(k - delay, 0)] - balance) / MOTOR["b"]
        x += final * T + (w - final) * (1 - fade) / rate
        w = final + (w - final) * fade
    position += np.random.default_rng(seed).normal(size=ROWS) * noise
    change = levels[1] - levels[0] if step is None else step
    return Trial("motor", 0.0, 0.0, float(change), T, np.arange(ROWS) * T, command, position)


@pytest.mark.parametrize("levels", [(0.05, 0.065), (-0.1, 0.065), (0.02, 0.085), (0.065, 0.05), (-0.05, -0.065)])
def test_a_step_from_an_operating_point(levels):
    """0.05 to 0.065 was refused: 'already there in row 0'."""
    response = find_response(motor(levels, balance=levels[0]))
    assert response.edge_row == EDGE, response.edge_reason
    assert response.level == pytest.approx(levels[0])


def test_the_step_of_a_log_is_the_change():
    response = find_response(motor((0.05, 0.065), step=0.065, balance=0.05))
    assert response.edge_row == NO_ROW
    assert "from 0.05 to 0.065 in row 100, a change of 0.015, but the step is 0.065" in response.edge_reason


@pytest.mark.parametrize("level", [0.05, -0.2])
def test_command_at_an_operating_point_is_that_at_rest(level):
    """What holds the device before the step is as large as the level: the motion is that of the change."""
    from_zero = motor((0.0, 0.015), noise=1e-6)
    raised = motor((level, level + 0.015), balance=level, noise=1e-6)
    np.testing.assert_allclose(raised.position, from_zero.position, atol=1e-12)
    measured = [MeasuredTrial(trial) for trial in (from_zero, raised)]
    np.testing.assert_allclose(measured[1].trial.command, measured[0].trial.command, atol=1e-12)
    assert measured[1].logged is raised
    assert measured[1].trial.command[0] == 0


def test_a_wall_keeps_its_command():
    """A constant force beside a wall is no operating point of the wall: that is for the wall law to tell."""
    (trial,) = simulate([3000.0], [20.0], **FALCON)
    raised = MeasuredTrial(replace(trial, command=trial.command + 1.0))
    assert raised.response.edge_row == 20
    assert raised.trial is raised.logged


STAIRCASES = {
    "up": (0.0, 0.05, 0.1),
    "back": (0.0, 0.05, 0.0),
    "from a level": (0.05, 0.065, 0.08),
    "to the other side": (0.0, 0.05, -0.05),
}


@pytest.mark.parametrize("name", STAIRCASES)
@pytest.mark.parametrize("step", ["first", "last level", "whole"])
def test_a_staircase_is_no_step(name, step):
    """It was read as one step, with a delay of 501 samples where the header names the last level."""
    levels = STAIRCASES[name]
    size = {"first": levels[1] - levels[0], "last level": levels[2], "whole": levels[2] - levels[0]}[step]
    if size == 0:
        pytest.skip("a step of 0 is none")
    trial = motor(levels, rows=(EDGE, 400), step=size)
    response = find_response(trial)
    assert response.edge_row == NO_ROW
    assert response.steps == 2
    assert response.edge_reason.startswith(f"several steps: row 100 ({levels[0]:.4g} to {levels[1]:.4g}), row 400 (")
    assert declare_edge(trial, response, EDGE) == response


def test_a_staircase_of_many_small_steps():
    levels = np.linspace(0, 0.2, 16)
    response = find_response(motor(levels, rows=range(100, 550, 30), step=0.2))
    assert response.steps == 15
    assert "and 9 more" in response.edge_reason


def test_a_staircase_against_a_wall():
    (trial,) = simulate([900.0], [10.0], **FALCON, rows=900)
    # the wall acts on what the device does: the second step is commanded on top
    response = find_response(replace(trial, command=trial.command + 4.0 * (np.arange(900) >= 500)))
    assert response.edge_row == NO_ROW
    assert "row 20 (0 to 8), row 500 (8 to 12)" in response.edge_reason
    assert find_response(trial).edge_row == 20


@pytest.mark.parametrize(
    ("damping", "second", "ripple", "apart", "steps"),
    [
        (10.0, 0.09, 0.0, 480, 1),
        (10.0, 0.11, 0.0, 480, 2),
        (0.0, 0.035, 0.0, 480, 1),
        (0.0, 0.045, 0.0, 480, 2),
        (10.0, 0.5, 0.017, 480, 2),
        (10.0, 0.5, 0.023, 480, 0),
        (10.0, 0.5, 0.0, 18, 0),
        (10.0, 0.5, 0.0, 22, 2),
    ],
)
def test_a_second_step_is_larger_than_quanta_and_lies_between_levels(damping, second, ripple, apart, steps):
    """Relative to the step: 0.1 with damping, 0.04 without, levels within 0.02 for 20 rows."""
    (trial,) = simulate([300.0], [damping], **FALCON, rows=900)
    command = trial.command + 8.0 * ripple * (np.arange(900) % 2)
    command[20 + apart :] += 8.0 * second
    assert find_response(replace(trial, command=command)).steps == steps


@pytest.mark.parametrize("samples", [1, 3, 10, 30])
@pytest.mark.parametrize("quantum", [1e-5, 6e-5])
def test_a_filtered_velocity_and_a_coarse_sensor_are_no_steps(samples, quantum):
    """A velocity over N rows leaves a plateau of N rows behind each quantum."""
    stiffness = np.array([200.0, 3000.0, 9000.0, 15000.0])
    damping = np.array([4.0, 184.0, 90.0, 120.0])

    def filtered(trial):
        x = np.concatenate([np.repeat(trial.position[:1], samples), trial.position])
        velocity = (x[samples:] - x[:-samples]) / (samples * T)
        force = 8.0 * (np.arange(trial.rows) >= 20)
        return force - trial.stiffness * trial.displacement - trial.damping * velocity

    trials = simulate(stiffness, damping, **FALCON, quantum=quantum, noise=2e-6, seed=5)
    found = responses(changed(trials, command=filtered))
    assert (found.steps < 2).all()
    assert not found.level.any()


def test_clipped_and_one_sided_commands_are_no_steps():
    trials = simulate(np.linspace(2000, 26000, 12), np.linspace(5, 60, 12), **FALCON)
    for bend in (lambda trial: np.clip(trial.command, -12, 12), lambda trial: np.maximum(trial.command, 0.0)):
        found = responses(changed(trials, command=bend))
        assert not any(text.startswith("several") for text in found.edge_reason)
