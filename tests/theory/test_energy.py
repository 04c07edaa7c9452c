"""Energy costs against fine quadrature, direct sums and Lyapunov equations of an independent loop."""

from __future__ import annotations

import math
from itertools import pairwise

import mpmath as mp
import numpy as np
import pytest
from general_loop import general_loop
from hypothesis import given, settings
from hypothesis import strategies as st
from independent import (
    DIGITS,
    continuous_energy,
    discrete_energy,
    extreme_cases,
    horizon,
    random_loops,
    simulate,
    simulate_many,
    stable_walls,
    wall_of_radius,
)
from scipy.linalg import expm

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.theory import energy
from pipeline.theory.boundary import boundary, stiffness_limit
from pipeline.theory.energy import _by_recursion, energy_costs


def energies_in_many_digits(case: tuple[float, float, float, float, float], signal: str) -> dict[str, float]:
    """The six energies of (gamma, delta, delay, alpha, beta) by linear (Lyapunov) equations in 50 digits.

    State: position and velocity, position before, and the wall forces on their way. For few states.
    """
    gamma, delta, delay, alpha, beta = case
    whole, part = math.floor(delay), delay - math.floor(delay)
    waiting = whole + (1 if part else 0)
    n = 3 + waiting
    with mp.workdps(DIGITS):
        rate = mp.matrix([[0, 1, 0], [-mp.mpf(gamma), -mp.mpf(delta), 1], [0, 0, 0]])
        wall = [-mp.mpf(alpha) - mp.mpf(beta), mp.mpf(0), mp.mpf(beta), *[mp.mpf(0)] * waiting]
        unit = [[mp.mpf(int(i == j)) for j in range(n)] for i in range(n)]
        forces = [wall, *unit[3:]]  # by age
        moving, pieces, begun = [unit[0], unit[1]], [], 0.0
        for time, age in ((part, whole + 1), (1 - part, whole)) if part else ((1.0, whole),):
            rows = [*moving, forces[age]]
            pieces.append((begun, time, np.array([[float(c) for c in row] for row in rows])))
            step = mp.expm(rate * mp.mpf(time))
            moving = [[sum(step[i, k] * rows[k][j] for k in range(3)) for j in range(n)] for i in (0, 1)]
            begun += time
        matrix = mp.matrix([*moving, unit[0], *forces[:waiting]])
        start = [-1, 0, -1, *[mp.mpf(alpha)] * waiting] if signal == "step" else [0, 1, *[0] * (n - 1)][:n]
        z = mp.matrix(start)
        twice = mp.matrix(n * n, n * n)
        for i in range(n):
            for j in range(n):
                for k in range(n):
                    for m in range(n):
                        twice[i * n + j, k * n + m] = matrix[i, k] * matrix[j, m]
        left = mp.eye(n * n) - twice
        plain = mp.lu_solve(left, mp.matrix([z[i] * z[j] for i in range(n) for j in range(n)]))
        linear = mp.lu_solve(left, twice * plain)
        square = mp.lu_solve(left, twice * (plain + 2 * linear))
        sums = [np.array([[float(s[i * n + j]) for j in range(n)] for i in range(n)]) for s in (plain, linear, square)]
        speeds = [float(c) for c in (matrix[0, j] - (1 if j == 0 else 0) for j in range(n))]
    potential, kinetic = (1.0, 1 / (alpha + gamma)) if signal == "step" else (alpha + gamma, 1.0)
    moments = np.zeros((3, n, n))
    nodes, weights = np.polynomial.legendre.leggauss(20)
    plant = np.array([[0, 1, 0], [-gamma, -delta, 1], [0, 0, 0]])
    for begun, time, moves in pieces:
        # panels that double from 2/delta on: what the plant's own damping ends is integrated where it happens
        edges = time * np.append(0.0, 2.0 ** -np.arange(math.ceil(math.log2(max(0.5 * delta * time, 2.0))), -1.0, -1.0))
        for low, high in pairwise(edges):
            for node, weight in zip(low + 0.5 * (high - low) * (nodes + 1), 0.5 * (high - low) * weights, strict=True):
                place, speed = (expm(plant * node) @ moves)[:2]
                power = weight * (potential * np.outer(place, place) + kinetic * np.outer(speed, speed))
                moments += power * np.array([1, begun + node, (begun + node) ** 2])[:, None, None]
    result = {}
    for w in (0, 1, 2):
        result[f"w{w}"] = sum(math.comb(w, i) * float((moments[i] * sums[w - i]).sum()) for i in range(w + 1))
        steps = sum(math.comb(w, i) * float(speeds @ sums[i] @ np.array(speeds)) for i in range(w + 1))
        result[f"w{w}_discrete"] = potential * float(sums[w][0, 0]) + kinetic * steps
    return result


RANDOM = stable_walls(random_loops(60, seed=21), each=5, seed=22, slowest=0.85)
EXTREME = extreme_cases()


def compare(cases: list[tuple[float, ...]], signal: str, fine: int, tolerance: float) -> None:
    """Check the six energies of points."""
    for k in range(0, len(cases), 60):  # dense motions of all cases at once would take memory
        part = cases[k : k + 60]  # 8 decades of motion are 16 of its energy
        for case, motion in zip(part, simulate_many(part, [horizon(c, 8) for c in part], signal, fine), strict=True):
            gamma, delta, p, q, alpha, beta = case
            costs = energy_costs(NormalisedLoop.ideal(gamma, delta, p / q), alpha, beta, signal)
            for w in (0, 1, 2):
                exact = {
                    "": continuous_energy(motion, alpha + gamma, 1.0, w, signal),
                    "_discrete": discrete_energy(motion, alpha + gamma, 1.0, 1.0, w, signal),
                }
                for suffix, limit in (("", tolerance), ("_discrete", 1e-10)):
                    deviation = abs(costs[f"energy_{signal}_w{w}{suffix}"][0] / exact[suffix] - 1)
                    assert deviation < limit, (w, suffix, case)


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_random_points(signal: str) -> None:
    # Simpson's rule with 12 points a piece errs by up to 7e-6, most at strong damping; a wrong term is seen at 1e-2
    compare(RANDOM, signal, 12, 1e-5)
    assert len(RANDOM) >= 300
    assert sum(case[2] % case[3] != 0 for case in RANDOM) >= 90


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_extreme_points(signal: str) -> None:
    long = [case for case in EXTREME if case[2] / case[3] > 60]
    damped = [case for case in EXTREME if case[1] > 5]
    rest = [case for case in EXTREME if case not in long and case not in damped]
    # motion at long delays is slow; else 32 points a piece, where Simpson's rule errs by less than 1e-6
    compare(long, signal, 2, 2e-6)
    compare(rest, signal, 32, 2e-6)
    for gamma, delta, p, q, alpha, beta in damped:
        costs = energy_costs(NormalisedLoop.ideal(gamma, delta, p / q), alpha, beta, signal)
        for name, truth in energies_in_many_digits((gamma, delta, p / q, alpha, beta), signal).items():
            deviation = abs(float(costs[f"energy_{signal}_{name}"][0]) / truth - 1)
            assert deviation < 1e-11, (name, gamma, delta, p, q, alpha, beta)
    assert len(EXTREME) >= 60
    assert len(damped) >= 20


@pytest.mark.slow
@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_points_close_to_the_boundary(signal: str) -> None:
    count = 0
    for gamma, delta, delay in [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1e-3, 0.02, 0.5), (0.3, 0.0, 0.25), (0.0, 2.0, 1.5)]:
        for k in range(2, 12):
            alpha, beta = wall_of_radius(gamma, delay, delta, 1 - 10.0**-k)
            exact = energies_in_many_digits((gamma, delta, delay, alpha, beta), signal)
            costs = energy_costs(NormalisedLoop.ideal(gamma, delta, delay), alpha, beta, signal)
            for name, truth in exact.items():
                deviation = abs(costs[f"energy_{signal}_{name}"][0] / truth - 1)
                assert deviation < 1e-12, (name, k, gamma, delta, delay)
                count += 1
    assert count >= 6 * 50


@pytest.mark.parametrize("signal", ["step", "impulse"])
@pytest.mark.parametrize(
    ("loop", "alpha", "beta"),
    [
        # the last bit of alpha counts 1e-10
        (NormalisedLoop.ideal(math.pi**2 * (1 - 1e-12), 0.3, 0.25), 14.075368111468283, -6.5126222476157105),
        (NormalisedLoop.ideal(9.8, 0.0, 0.5), 24.783594789896792, -9.15593733058758),
        (NormalisedLoop.ideal(3.0, 1000.0, 1.1), 500.0, 300.0),
        (NormalisedLoop.ideal(1e-3, 0.02, 2.0), 1e-4 - 1e-3, 0.1),
    ],
)
def test_slow_responses_in_many_digits(loop: NormalisedLoop, alpha: float, beta: float, signal: str) -> None:
    """The same on every processor: twice the digits where a sum over 1e4 samples and skew modes take twelve of them."""
    costs = energy_costs(loop, alpha, beta, signal)
    exact = energies_in_many_digits((loop.gamma, loop.delta, loop.delay, alpha, beta), signal)
    for name, truth in exact.items():
        assert costs[f"energy_{signal}_{name}"][0] == pytest.approx(truth, rel=1e-12, abs=0), name


@pytest.mark.parametrize(("p", "q"), [(16, 1), (64, 1), (129, 2)])
def test_long_delays(p: int, q: int) -> None:
    d = p / q
    alpha, beta = 0.27 / (d + 1) ** 2, 0.85 / (d + 1.2)
    case = (0.0, 0.0, p, q, alpha, beta)
    motion = simulate(alpha, beta, delay=(p, q), samples=horizon(case), fine=2)
    costs = energy_costs(NormalisedLoop.ideal(0, 0, d), alpha, beta)
    for w in (0, 1, 2):
        truth = continuous_energy(motion, alpha, 1.0, w, "step")
        assert costs[f"energy_step_w{w}"][0] == pytest.approx(truth, rel=1e-6), w
        truth = discrete_energy(motion, alpha, 1.0, 1.0, w, "step")
        assert costs[f"energy_step_w{w}_discrete"][0] == pytest.approx(truth, rel=1e-8), w


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.floats(1e-3, 1e3), st.floats(1e-5, 1.0), st.sampled_from([(0, 1), (1, 1), (3, 2)]), st.floats(0.2, 0.45))
def test_physical_energies_scale_with_mass_and_period(
    mass: float, period: float, delay: tuple[int, int], share: float
) -> None:
    d = delay[0] / delay[1]
    stiffness, damping = share / (1 + d) ** 2 * mass / period**2, 0.8 / (1 + d) * mass / period
    motion = simulate(stiffness, damping, delay=delay, samples=800, mass=mass, period=period, fine=8)
    unit = LoopUnits(mass, period)
    costs = energy_costs(NormalisedLoop.ideal(0, 0, d), stiffness / unit.stiffness, damping / unit.damping)
    for w in (0, 1, 2):
        # by 5.14 the integral over time in samples is that in seconds divided by T^(w+1)
        truth = continuous_energy(motion, stiffness, mass, w, "step")
        assert costs[f"energy_step_w{w}"][0] == pytest.approx(truth, rel=3e-5)
        truth = discrete_energy(motion, stiffness, mass, period, w, "step")
        assert costs[f"energy_step_w{w}_discrete"][0] == pytest.approx(truth, rel=1e-6)


def test_small_parameters_change_nothing() -> None:
    exact = energy_costs(NormalisedLoop.ideal(0, 0, 1.5), 0.04, 0.3)
    near = energy_costs(NormalisedLoop.ideal(1e-13, 1e-13, 1.5), 0.04, 0.3)
    for name, value in exact.items():
        assert near[name] == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("factor", [1.0001, 1.5, 100.0])
def test_unstable_points_have_no_energy_and_end_nothing(factor: float) -> None:
    border = boundary(NormalisedLoop.ideal(0, 0, 1))
    found = energy_costs(
        NormalisedLoop.ideal(0, 0, 1), [0.07, border.alpha_max * factor], [0.4, border.beta_at_alpha_max]
    )
    alone = energy_costs(NormalisedLoop.ideal(0, 0, 1), [0.07], [0.4])
    for name, values in found.items():
        assert np.isnan(values[1])
        assert values[0] == pytest.approx(alone[name][0], rel=1e-12)


@pytest.mark.parametrize(
    ("alpha", "beta", "signal", "what"),
    [
        (0.0, 0.3, "step", r"alpha \+ gamma > 0"),
        (-0.1, 0.3, "step", r"alpha \+ gamma > 0"),
        (math.nan, 0.3, "step", "finite"),
        (0.07, 0.4, "ramp", "expected 'step' or 'impulse'"),
    ],
)
def test_wrong_arguments_are_named(alpha: float, beta: float, signal: str, what: str) -> None:
    with pytest.raises(ParameterError, match=what):
        energy_costs(NormalisedLoop.ideal(0, 0, 1), alpha, beta, signal)


@pytest.mark.parametrize(
    "loop",
    [NormalisedLoop.ideal(0, 0, 4), NormalisedLoop.ideal(0.3, 0.2, 2.5), general_loop(0, 0.01, 1, lag=0.7)],
    ids=str,
)
@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_sums_that_rounding_has_a_share_in_are_not_taken(loop: NormalisedLoop, signal: str) -> None:
    beta = np.full(40, 0.1)
    limit = stiffness_limit(loop, beta[:1])
    alpha = limit * (1 - np.logspace(-12, -0.5, 40)) - loop.gamma * np.logspace(-12, -0.5, 40)
    truth, all_good = _by_recursion(loop, alpha, beta, signal, np.object_)
    assert all_good.all()
    with np.errstate(all="ignore"):
        found, good = _by_recursion(loop, alpha, beta, signal, np.float64)
    rows, columns = np.triu_indices(len(loop.device.sensor) + len(loop.segments))
    own = truth[:, rows == columns]
    off = np.abs((found - truth) / np.sqrt(own[:, rows] * own[:, columns])).max(axis=(0, 1))
    assert 5 < good.sum() < 35
    assert off[good].max() < 1e-12 < 1e-6 < off.max()


@pytest.mark.parametrize("delay", [64.0, 64.5, 100.0])
def test_long_delays_keep_their_digits_in_z(delay: float) -> None:
    loop = NormalisedLoop.ideal(1e-5, 0.02, delay)
    beta = np.array([0.3, 0.5]) * boundary(loop, 60).beta_max
    alpha = stiffness_limit(loop, beta) * np.array([0.3, 0.9])
    truth, good = _by_recursion(loop, alpha, beta, "step", np.object_)
    assert good.all()
    with np.errstate(all="ignore"):
        found, good = _by_recursion(loop, alpha, beta, "step", np.longdouble)
    rows, columns = np.triu_indices(len(loop.device.sensor) + len(loop.segments))
    own = truth[:, rows == columns]
    off = np.abs((found - truth) / np.sqrt(own[:, rows] * own[:, columns])).max(axis=(0, 1))
    assert (off[good] < 1e-10).all()
    # the two recursions, of polynomials in w and in z, on both sides of the delay that parts them
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(energy, "_LONG", 1e9 if delay > 64 else 0)
        energy._transforms.cache_clear()
        other, _ = _by_recursion(loop, alpha, beta, "step", np.object_)
    energy._transforms.cache_clear()
    assert other == pytest.approx(truth, rel=1e-12)
