"""Energies with a weighting that is no whole number (5.13), against integrals over a motion computed otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.integrate import trapezoid
from scipy.linalg import expm

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.measured.cost.energy import _moments
from pipeline.records.criteria import criterion_of, is_criterion
from pipeline.theory.costs import CostMap, cost_maps
from pipeline.theory.energy import energy_costs
from pipeline.theory.optimum import optimal_point, scaling_factor
from pipeline.theory.reachable import reachable

LOOPS = [(0.0, 0.0, 0), (0.0, 0.0, 1), (0.004, 0.05, 2)]
WALL = 0.02, 0.22


def integral(gamma, delta, d, w, samples=900, fine=400):
    """Continuous and discrete energy of a step response: matrix exponential, trapezoids in u with tau = u^2."""
    alpha, beta = WALL
    block = np.array([[0, 1, 0], [-gamma, -delta, 1], [0, 0, 0]])
    u = np.linspace(0, 1, fine + 1)
    steps = [expm(block * t) for t in u**2]
    e, v, before, forces = -1.0, 0.0, -1.0, [alpha] * d
    stored, continuous, discrete = alpha + gamma, 0.0, 0.0
    for k in range(samples):
        forces.append(-alpha * e - beta * (e - before))
        motion = np.array([(step @ (e, v, forces[k]))[:2] for step in steps])
        energy = motion[:, 0] ** 2 + motion[:, 1] ** 2 / stored
        weight = (k + u**2) ** w * 2 * u
        continuous += trapezoid(weight * energy, u)
        discrete += k**w * (e**2 + (e - before) ** 2 / stored)
        before, (e, v) = e, motion[-1]
    return continuous, discrete


@pytest.mark.sampled
@pytest.mark.parametrize(("gamma", "delta", "d"), LOOPS[:2])
@pytest.mark.parametrize("w", [0.5, 1.7, 3.0])
def test_energies_are_integrals_of_the_motion(gamma, delta, d, w):
    found = energy_costs(NormalisedLoop.ideal(gamma, delta, d), [WALL[0]], [WALL[1]], "step", (w,))
    continuous, discrete = integral(gamma, delta, d, w)
    assert found[f"energy_step_w{w:g}"][0] == pytest.approx(continuous, rel=1e-5)
    assert found[f"energy_step_w{w:g}_discrete"][0] == pytest.approx(discrete, rel=1e-10)


@pytest.mark.parametrize(("gamma", "delta", "d"), LOOPS)
@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_energies_are_continuous_in_the_exponent(gamma, delta, d, signal):
    loop, near = NormalisedLoop.ideal(gamma, delta, d), (0.9999, 1.0001, 1.9999, 2.0001)
    whole = energy_costs(loop, [WALL[0]], [WALL[1]], signal)
    beside = energy_costs(loop, [WALL[0]], [WALL[1]], signal, near)
    sums = list(beside.values())
    for kind, suffix in enumerate(("", "_discrete")):
        for w in (1, 2):
            below, above = sums[4 * kind + 2 * w - 2 : 4 * kind + 2 * w]
            assert 0.5 * (below[0] + above[0]) == pytest.approx(whole[f"energy_{signal}_w{w}{suffix}"][0], rel=1e-6)


@pytest.mark.slow
def test_the_optimum_of_any_weighting_lies_between_those_of_its_neighbours():
    loop = NormalisedLoop.ideal(0, 0, 1)
    alpha = [optimal_point(loop, f"energy_step_w{w}").alpha for w in ("0", "0.5", "1")]
    assert alpha[0] > alpha[1] > alpha[2]
    best = optimal_point(loop, "energy_step_w0.5")
    around = np.linspace(0.9, 1.1, 9)
    grid = cost_maps(loop, around * best.alpha, around * best.beta, ["energy_step_w0.5"])
    sampled = optimal_point(loop, "energy_step_w0.5_discrete")
    assert np.nanmin(grid["energy_step_w0.5"]) >= sampled.cost


@pytest.mark.slow
def test_the_cost_that_a_delay_allows_grows_with_a_real_power():
    assert reachable("energy_step_w0.5", 3.0).cost == pytest.approx(4**1.5 * scaling_factor("energy_step_w0.5"))
    best = optimal_point(NormalisedLoop.ideal(0, 0, 3.0), "energy_step_w0.5").cost
    assert best == pytest.approx(reachable("energy_step_w0.5", 3.0).cost, rel=0.012)


@pytest.mark.parametrize("horizon", [40, 300, 5000])
@pytest.mark.parametrize("decay", [1e-5, 1e-3, 0.2, 3.0])
@pytest.mark.parametrize("w", [0.5, 2.5])
def test_a_tail_is_a_transcendent_of_lerch(horizon, decay, w):
    with mp.workdps(30):
        exact = mp.nsum(lambda j: (mpf(horizon) + j) ** w * mp.exp(-2 * mpf(decay) * j), [0, 30]) if decay > 2 else None
        exact = exact or mp.lerchphi(mp.exp(-2 * mpf(decay)), -w, horizon)
    assert _moments(horizon, decay, (w,))[0] == pytest.approx(float(exact.real), rel=1e-9)


def test_names_have_one_spelling():
    assert criterion_of("energy_step_w0.5").weight == 0.5
    for name in ("energy_step_w0.50", "energy_step_w9", "energy_step_w-1", "settle_0pct", "energy_step_w1.0"):
        assert not is_criterion(name, ("energy_step_w0", "settle_2pct"))
    with pytest.raises(ParameterError, match=r"energy_step_w0\.5"):
        CostMap(NormalisedLoop.ideal(0, 0, 1), criteria=["energy_step_w99"])
