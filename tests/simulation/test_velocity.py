"""Velocity estimators of the loop against plain recursions, and loops with them against a matrix of other states."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from pipeline import Loop
from pipeline.device.parts import AdaptiveWindow, Kalman, Levant, VelocityFilter
from pipeline.loop.closed_loop import velocity
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import estimator_of, external_force, simulate

T = 0.001


def estimated(kind: VelocityFilter, position: np.ndarray) -> np.ndarray:
    estimator, numbers, period = estimator_of(kind, T)
    result = np.empty_like(position)
    for readings, speed in zip(position.T, result.T, strict=True):
        memory = np.zeros(numbers.shape[1])
        speed[:] = [velocity(estimator, numbers, period, memory, readings, row) for row in range(len(readings))]
    return result


def path(quantum: float, rows: int = 300) -> np.ndarray:
    random, time = np.random.default_rng(4), T * np.arange(rows)[:, None]
    swing = 1e-3 * np.sin(2 * np.pi * np.array([3.0, 11.0, 40.0]) * time) * np.exp(-3 * time)
    return np.rint((swing + 1e-7 * random.standard_normal(swing.shape)) / quantum) * quantum


@pytest.mark.parametrize(("acceleration", "noise"), [(1.0, 1e-6), (300.0, 1e-6), (30.0, 1e-6)])
def test_the_kalman_filter_is_that_of_the_riccati_equation(acceleration: float, noise: float) -> None:
    # in units of T and of the noise, in which the equation is well scaled
    model, push, sees = np.array([[1.0, 1], [0, 1]]), np.array([[0.5], [1.0]]), np.array([[1.0, 0.0]])
    ahead = solve_discrete_are(model.T, sees.T, push @ push.T * (acceleration * T**2 / noise) ** 2, np.eye(1))
    gain = ahead @ sees.T / (sees @ ahead @ sees.T + 1)
    x = path(1e-9)
    state, wanted = np.vstack((x[:1], np.zeros((1, x.shape[1])))), []
    for row in x:
        state = model @ state if wanted else state
        state = state + gain * (row - state[:1])
        wanted.append(state[1] / T)
    found = estimated(Kalman(kind="kalman", acceleration=acceleration, noise=noise), x)
    assert found == pytest.approx(np.array(wanted), abs=1e-9 * np.abs(wanted).max())


def kalman_radius(rig: Loop, K: float, B: float, index: float) -> float:
    """Spectral radius of a loop with alpha-beta tracker: states of its own, no filter polynomial."""
    T, d, m, b = rig.sampling_period_s, int(rig.delay_samples), rig.mass, rig.damping
    r = (4 + index - np.sqrt(8 * index + index**2)) / 4
    alpha, beta = 1 - r * r, 2 * (1 - r) ** 2
    move = expm(np.array([[0, 1, 0], [0, -b / m, 1 / m], [0, 0, 0]]) * T)
    n = 4 + d  # device's x and v, tracker's x and v before the sample, forces of the last d samples
    A = np.zeros((n, n))
    predicted, speed = np.eye(n)[2], np.eye(n)[3]
    off = np.eye(n)[0] - predicted
    place, rate = predicted + alpha * off, speed + beta / T * off
    force = -K * np.eye(n)[0] - B * rate
    A[:2, :2] = move[:2, :2]
    A[:2] += np.outer(move[:2, 2], np.eye(n)[-1] if d else force)
    A[2], A[3] = place + T * rate, rate
    if d:
        A[4] = force
        A[np.arange(5, n), np.arange(4, n - 1)] = 1
    return float(np.abs(np.linalg.eigvals(A)).max())


@pytest.mark.parametrize("seed", range(6))
def test_limits_with_a_kalman_filter_are_those_of_a_tracker(seed: int) -> None:
    random = np.random.default_rng(seed)
    mass, d = 10 ** random.uniform(-2, 1), int(random.integers(0, 6))
    index = 10 ** random.uniform(-1.5, 1.5)
    filtered = {"kind": "kalman", "acceleration": index / T**2 * 1e-6, "noise": 1e-6}
    rig = Loop(mass, 0.02 * mass / T, T, d, velocity=filtered)
    B = np.linspace(0.2, 0.8, 3) * float(rig.boundary(32)["damping"].max())
    for damping, K in zip(B, rig.limits(B)["stiffness"], strict=True):
        inside, outside = (kalman_radius(rig, K * (1 + side * 1e-8), damping, index) for side in (-1, 1))
        assert inside < 1 < outside


def test_the_adaptive_window_is_the_longest_line() -> None:
    x, bound, longest = path(1e-5), 1.23e-5, 12
    found = estimated(AdaptiveWindow(kind="foaw", bound=bound, longest=longest), x)
    widths = set()
    for k, column in np.ndindex(x.shape):
        n = 0
        while n < min(longest, k):
            a, b = x[k - n - 1, column], x[k, column]
            if any(abs(x[k - i, column] - (b + (a - b) * i / (n + 1))) > bound for i in range(n + 2)):
                break
            n += 1
        wanted = (x[k, column] - x[k - n, column]) / (n * T) if n else 0.0
        assert found[k, column] == pytest.approx(wanted, abs=1e-12)
        widths.add(n)
    assert {1, longest} <= widths


def test_levants_differentiator_follows_a_swing() -> None:
    x = path(1e-9)[:, :2]
    found = estimated(Levant(kind="levant", acceleration=6.0), x)
    place, speed, wanted = x[0].copy(), np.zeros(2), []
    for row in x:
        off = place - row
        step = [1.5 * 6.0**0.5 * abs(o) ** 0.5 * np.sign(o) for o in off]
        place, speed = place + T * (speed - step), speed - T * 1.1 * 6.0 * np.sign(off)
        wanted.append(speed)
    assert found == pytest.approx(np.array(wanted), abs=1e-12)
    true = np.gradient(x, T, axis=0)
    assert np.abs(found - true)[50:].max() < 0.3 * np.abs(true).max()


@pytest.mark.parametrize(
    "kind",
    [
        Kalman(kind="kalman", acceleration=300.0, noise=3e-6),
        AdaptiveWindow(kind="foaw", bound=1e-5),
        Levant(kind="levant", acceleration=100.0),
    ],
)
def test_a_simulated_wall_is_damped_by_the_estimate(kind: VelocityFilter) -> None:
    loop = Loop(0.5, 4.0, T, 2.0, sensor={"quantum": 1e-5}, velocity=kind)
    setup = Setup(loop, step=8.0, rows=120, edge_row=3)
    (found,) = simulate(setup, np.array([2500.0]), np.array([12.0]))
    speed = estimated(kind, found.position[:, None])[:, 0]
    assert found.command == pytest.approx(external_force(setup) - 2500 * found.displacement - 12 * speed, abs=1e-9)
    (plain,) = simulate(setup.with_loop(velocity=None), np.array([2500.0]), np.array([12.0]))
    assert np.abs(found.position - plain.position).max() > 1e-5


def test_what_linear_theory_leaves_out_is_said() -> None:
    assert Loop(0.5, 4.0, T, 2, velocity={"kind": "foaw", "bound": 1e-5}).left_out == ("velocity",)
    assert Loop(0.5, 4.0, T, 2, velocity={"kind": "kalman", "acceleration": 1.0, "noise": 1e-6}).left_out == ()
