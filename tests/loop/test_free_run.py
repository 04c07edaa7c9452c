"""Free runs under logged commands: exact without friction, and near the exact motion with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.device.parts import Friction
from pipeline.loop.free_run import free_run
from pipeline.loop.motion import FrictionalMotion
from pipeline.measured.identification.free_runs import Mechanics
from pipeline.measured.identification.motion import PlantShape
from pipeline.records.trials import Floats

SHAPES = {
    "mass": PlantShape(0.004),
    "lag": PlantShape(0.004, 4e-4, lag=4.0),
    "mode": PlantShape(0.004, mode_frequency=0.19, mode_damping_ratio=0.06, load_mass_fraction=0.2),
    "load": PlantShape(0.004, mode_frequency=0.19, mode_damping_ratio=0.06, spring_damping_fraction=0.7),
}
COULOMB = 2.0
COMMAND = np.repeat([0.0, 6.0, -5.0, 0.6, 4.0], 60)


def run(
    shape: PlantShape,
    command: Floats,
    coulomb: tuple[float, float],
    steps: int,
    parts: int = 1,
    weight: tuple[float, ...] = (),
) -> Floats:
    """Free run from rest, one command a sample, in parts of each sample."""
    mechanics = Mechanics.of(shape)
    F, G = mechanics.transitions(np.array([1 / parts]), steps)
    place = np.zeros((parts, len(command)), np.int64)
    device, friction = (mechanics.sensor, *mechanics.forces), np.array(coulomb)[: len(mechanics.masses)]
    forces, commands = (0.0, friction, np.array(weight)), np.tile(command, (parts, 1))
    return free_run(device, (F, G, place), commands, forces, np.zeros(F.shape[-1]), steps)


def exact(shape: PlantShape, command: Floats, friction: Friction | None) -> Floats:
    """Positions of the exact motion."""
    motion = FrictionalMotion(shape.plant, friction)
    state, positions = motion.rest(np.zeros(1)), []
    for force in command:
        positions.append(state[motion.sensed, 0])
        state = motion.advance(state, np.array([force]), 0.0, 1.0)
    return np.array(positions)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("parts", [1, 4])
def test_without_friction_it_is_the_exact_motion(name: str, parts: int) -> None:
    wanted = exact(SHAPES[name], COMMAND, None)
    assert run(SHAPES[name], COMMAND, (0.0, 0.0), 4, parts) == pytest.approx(wanted, abs=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("name", ["mass", "mode", "load"])
@pytest.mark.parametrize("steps", [4, 16])
def test_with_friction_on_the_motor_it_is_near_the_exact_motion(name: str, steps: int) -> None:
    wanted = exact(SHAPES[name], COMMAND, Friction(coulomb=COULOMB))
    error = np.abs(run(SHAPES[name], COMMAND, (COULOMB, 0.0), steps) - wanted).max() / np.abs(wanted).max()
    assert 0 < error < 2e-4 / steps


@pytest.mark.parametrize("coulomb", [0.0, 0.05])
def test_a_pendulum_swings_as_in_an_integration(coulomb: float) -> None:
    """The position is 10 times the angle, which begins at 2.5 rad, so that gravity is far from a spring.

    A step of a sample has an error of second order, so that a quarter of the step has a sixteenth of it.
    """
    sine, cosine, scale, origin = 0.02, 0.005, 0.1, 2.5
    command = 0.02 * np.repeat([0.0, 1.0, -1.0, 0.3], 100)

    def pushed(time: float, state: Floats) -> list[float]:
        angle, rubs = origin + scale * state[0], coulomb * 0.02 * np.tanh(state[1] / 1e-4)
        force = command[min(int(time), len(command) - 1)] - sine * np.sin(angle) - cosine * np.cos(angle)
        return [state[1], force - 0.004 * state[1] - rubs]

    found, state = [], np.zeros(2)
    for row in range(len(command)):
        found.append(state[0])
        state = solve_ivp(pushed, (row, row + 1 - 1e-12), state, method="LSODA", rtol=1e-9, atol=1e-11).y[:, -1]
    assert np.ptp(found) * scale > 1.0
    weight = (sine, cosine, scale, origin)
    whole, fine = (
        np.abs(run(PlantShape(0.004), command, (coulomb * 0.02, 0.0), 4, parts, weight) - found).max() / np.ptp(found)
        for parts in (1, 4)
    )
    assert whole < 1e-3
    assert fine < max(whole / 10, 3e-5)


def test_friction_on_the_load_is_that_of_an_integration() -> None:
    shape, friction = SHAPES["mode"], (1.0, 0.6)
    plant = shape.plant
    motor, load = 1 - plant.load_mass, plant.load_mass

    def rates(time: float, state: Floats) -> list[float]:
        x1, v1, x2, v2 = state
        pull = plant.spring * (x1 - x2) + plant.spring_damping * (v1 - v2)
        force = COMMAND[min(int(time), len(COMMAND) - 1)]
        rub = [c * np.tanh(v / 2e-3) for c, v in zip(friction, (v1, v2), strict=True)]
        return [v1, (force - pull - plant.damping * v1 - rub[0]) / motor, v2, (pull - rub[1]) / load]

    rows = np.arange(len(COMMAND), dtype=float)
    wanted = solve_ivp(rates, (0, rows[-1]), np.zeros(4), "LSODA", rows, rtol=1e-7, atol=1e-7, max_step=0.2).y[0]
    found = run(shape, COMMAND, friction, 4)
    assert np.abs(found - wanted).max() < 2e-3 * np.abs(wanted).max()
    assert np.abs(run(shape, COMMAND, (1.6, 0.0), 4) - wanted).max() > 1e-2 * np.abs(wanted).max()


def test_a_device_at_rest_stays_until_the_force_exceeds_friction() -> None:
    found = run(SHAPES["mass"], np.array([0.0, 1.98, -1.98, 2.02, 0.0, 0.0]), (COULOMB, 0.0), 4)
    assert (found[:4] == 0).all()
    assert found[4] > 0


def test_plain_python_makes_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    found = run(SHAPES["mode"], COMMAND, (COULOMB, 0.4), 4)
    monkeypatch.setitem(run.__globals__, "free_run", free_run.__wrapped__)
    assert run(SHAPES["mode"], COMMAND, (COULOMB, 0.4), 4) == pytest.approx(found, rel=1e-10)
