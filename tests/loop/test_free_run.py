"""Free runs under logged commands: exact without friction, and near the exact motion with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from pipeline.device.parts import Friction
from pipeline.loop.free_run import free_run
from pipeline.loop.motion import FrictionalMotion
from pipeline.loop.state_space import Plant, state_space
from pipeline.records.trials import Floats

MASS, DAMPING, COULOMB, T = 0.5, 2.0, 1.0, 0.001
PLANTS = {
    "mass": Plant(MASS, DAMPING, 0.0),
    "lag": Plant(MASS, DAMPING, 200.0, lag=0.004),
    "mode": Plant(MASS, DAMPING, 0.0, load_mass=0.1, spring=3000.0, spring_damping=0.8, sensor_at_load=True),
}


def run(plant: Plant, command: Floats, coulomb: float, sub_steps: int, spans: tuple[float, ...] = (T,)) -> Floats:
    """Run free from rest, each command in force for all pieces of its row; forces are those of a mass of 1."""
    system = state_space(plant)
    n = system.states
    rate = np.zeros((n + 2, n + 2))
    rate[:n] = np.column_stack((system.matrix, system.command, system.force * MASS))
    moved = np.array([expm(rate * span / sub_steps) for span in spans])
    place = np.tile(np.arange(len(spans))[:, None], len(command))
    pieces = np.ascontiguousarray(moved[:, :n, :n]), np.ascontiguousarray(moved[:, :n, n:]), place
    device = system.sensor, system.matrix[1], float(system.command[1])
    return free_run(device, pieces, np.tile(command, (len(spans), 1)), (0.0, coulomb / MASS), np.zeros(n), sub_steps)


def exact(plant: Plant, command: Floats, friction: Friction | None) -> Floats:
    """Positions of the exact motion."""
    motion = FrictionalMotion(plant, friction)
    state, positions = motion.rest(np.zeros(1)), []
    for force in command:
        positions.append(state[motion.sensed, 0])
        state = motion.advance(state, np.array([force]), 0.0, T)
    return np.array(positions)


COMMAND = np.repeat([0.0, 3.0, -2.5, 0.3, 2.0], 60)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("sub_steps", [1, 4])
def test_without_friction_it_is_the_exact_motion(name: str, sub_steps: int) -> None:
    wanted = exact(PLANTS[name], COMMAND, None)
    for spans in ((T,), (0.25 * T, 0.75 * T)):
        found = run(PLANTS[name], COMMAND, 0.0, sub_steps, spans)
        assert found == pytest.approx(wanted, abs=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("sub_steps", [1, 4, 16])
def test_with_friction_each_turn_is_late_by_a_sub_step_at_most(sub_steps: int) -> None:
    wanted = exact(PLANTS["mass"], COMMAND, Friction(coulomb=COULOMB))
    found = run(PLANTS["mass"], COMMAND, COULOMB, sub_steps)
    # friction that acts in the wrong direction changes the speed by 2 c/m h, for the 60 rows until the next change
    error = 2 * (2 * COULOMB / MASS * T / sub_steps) * 60 * T
    assert 0 < np.abs(found - wanted).max() < error < 0.1 * np.abs(wanted).max()


def test_a_device_at_rest_stays_until_the_force_exceeds_friction() -> None:
    found = run(PLANTS["mass"], np.array([0.0, 0.99, -0.99, 1.01, 0.0, 0.0]), COULOMB, 4)
    assert (found[:4] == 0).all()
    assert found[4] > 0


def test_plain_python_makes_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    found = run(PLANTS["mode"], COMMAND, COULOMB, 4, (0.25 * T, 0.75 * T))
    monkeypatch.setitem(run.__globals__, "free_run", free_run.__wrapped__)
    assert run(PLANTS["mode"], COMMAND, COULOMB, 4, (0.25 * T, 0.75 * T)) == pytest.approx(found, rel=1e-10)
