"""Energy sums from lagged products at long and fractional delays, against independent sums over time."""

import numpy as np
import pytest
from independent import continuous_energy, discrete_energy, simulate

from pipeline.loop.loop import Loop
from pipeline.theory.cost import energy
from pipeline.theory.cost.chain import Chain, Segment
from pipeline.theory.cost.theory_map import bounding_box
from pipeline.theory.stability.stability import spectral_radius

LONG = [(0.0, 0.0, 64, 1), (1e-4, 0.01, 64, 1), (0.0, 0.0, 129, 2), (0.0, 0.0, 256, 1), (2e-5, 0.003, 511, 2)]
MIXED = [
    *(Loop(0, 0, 0.5), Loop(0.01, 0.05, 3.7), Loop(9.87, 0.3, 0.25), Loop(3.0, 1000.0, 1.5), Loop(0, 0, 13)),
    *(Loop(0.001, 0.02, 20.25), Loop(0.5, 0.02, 5)),
]


@pytest.mark.parametrize("signal", ["step", "impulse"])
@pytest.mark.parametrize("plant", LONG, ids=str)
def test_long_delays_against_the_motion_stepped_through_time(plant, signal):
    """All six energies to 1e-10: the motion is so slow that Simpson's rule on its pieces errs by less."""
    gamma, delta, p, q = plant
    loop = Loop(gamma, delta, p / q)
    # near the optimum: it decays by a decade in some seven delays
    alpha, beta = 0.21 / (1 + loop.delay) ** 2, 0.88 / (0.5 + loop.delay)
    samples = int(110 * (1 + loop.delay))
    motion = simulate(alpha, beta, delay=(p, q), samples=samples, gamma=gamma, delta=delta, signal=signal, fine=6)
    assert abs(motion.v[-100:]).max() < 1e-11 * abs(motion.v).max()
    costs = energy.energy_costs(loop, [alpha], [beta], signal)
    for w in (0, 1, 2):
        name = f"energy_{signal}_w{w}"
        exact = continuous_energy(motion, alpha + gamma, 1.0, w, signal)
        assert costs[name][0] == pytest.approx(exact, rel=1e-10), name
        exact = discrete_energy(motion, alpha + gamma, 1.0, 1.0, w, signal)
        assert costs[f"{name}_discrete"][0] == pytest.approx(exact, rel=1e-10), name


@pytest.mark.parametrize("signal", ["step", "impulse"])
@pytest.mark.parametrize("loop", MIXED, ids=str)
def test_equations_and_doubling_agree(loop, signal, monkeypatch):
    """Random points, some close to the corner alpha = -gamma; rounding of the poles alone allows 1e-11 there."""
    rng = np.random.default_rng(77)
    box = bounding_box(loop)
    alpha = np.append(rng.uniform(*box[:2], 200), -loop.gamma + 10 ** rng.uniform(-7, -3, 50))
    beta = np.append(rng.uniform(*box[2:], 200), 10 ** rng.uniform(-3, -1, 50))
    chosen = (spectral_radius(loop, alpha, beta) < 1 - 1e-4) & (alpha + loop.gamma > 0)
    alpha, beta = alpha[chosen], beta[chosen]
    sums = energy.lag_sums(loop, alpha, beta, signal)
    assert sums.trusted.mean() > 0.95
    found = energy.energy_costs(loop, alpha, beta, signal)
    for limit in ("_FEW", "_SHORT"):
        monkeypatch.setattr(energy, limit, 10**6)
    for name, expected in energy.energy_costs(loop, alpha, beta, signal).items():
        np.testing.assert_allclose(found[name], expected, rtol=2e-11, err_msg=name)


def test_points_in_any_order_and_number_have_the_same_energies():
    """A point's energies depend on its neighbours in an array by rounding alone (they choose rows for pivots)."""
    loop, rng = Loop(0, 0, 30), np.random.default_rng(5)
    alpha, beta = rng.uniform(0.1, 0.3, 3000) / 31**2, rng.uniform(0.5, 0.8, 3000) / 31
    together = energy.energy_costs(loop, alpha, beta)
    order = rng.permutation(3000)
    for name, values in energy.energy_costs(loop, alpha[order[:700]], beta[order[:700]]).items():
        np.testing.assert_allclose(values, together[name][order[:700]], rtol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 2, 5, 12, 31])
def test_a_chain_is_its_sites_one_after_another(count):
    """Inner values against a dense solution of all sites' equations at once."""
    rng = np.random.default_rng(count)
    q, sites = 2, count + 1
    through, back = 0.6 * rng.uniform(-1, 1, (2, q, q))
    forward, backward = rng.normal(size=(2, sites, q))
    ends = rng.normal(size=(2, q))
    size = q * (sites + 1)
    matrix, right = np.eye(2 * size), np.zeros(2 * size)
    right[:q], right[-q:] = ends
    for m in range(sites):  # x into site m stands at m, z into it (from its right) at size + m + 1
        x, z = slice(q * m, q * m + q), slice(size + q * (m + 1), size + q * (m + 2))
        next_x, next_z = slice(q * (m + 1), q * (m + 2)), slice(size + q * m, size + q * (m + 1))
        matrix[next_x, x], matrix[next_x, z], right[next_x] = -through, -back, forward[m]
        matrix[next_z, z], matrix[next_z, x], right[next_z] = -through, -back, backward[m]
    expected = np.linalg.solve(matrix, right)[: q * sites].reshape(sites, q)
    chain = Chain(Segment(through[..., None], back[..., None]), count)
    inputs = chain.solve(forward[..., None], backward[..., None])
    found = inputs.inside(ends[None, 0, :, None], ends[None, 1, :, None])[0, ..., 0]
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    alone = inputs.last[0, :, 0] + chain.to_last[..., 0] @ ends[0]
    same = ends[None, 0, :, None]
    np.testing.assert_allclose(alone, inputs.inside(same, same)[0, -1, :, 0], rtol=1e-10, atol=1e-12)
