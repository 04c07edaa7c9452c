"""Costs of many points, against plain sums and responses followed to their end."""

import numpy as np
import pytest

from pipeline.loop.loop import Loop
from pipeline.theory import energy, modes
from pipeline.theory.costs import bounding_box, point_costs_by_name
from pipeline.theory.poles import spectral_radius
from pipeline.theory.settling_overshoot import transient_costs

LOOPS = [
    Loop(0, 0, 0),
    Loop(0, 0, 1),
    Loop(0, 0, 4),
    Loop(0, 0, 8),
    Loop(0.01, 0.05, 2),
    Loop(1.0, 0.5, 3),
    Loop(9.8, 0.0, 1),
    Loop(0, 5.0, 3),
    Loop(3.0, 1000.0, 1),
]


def stable_points(loop, count, seed, nearest=1e-4):
    """Random points of the bounding box, and some close to its soft corner."""
    rng = np.random.default_rng(seed)
    box = bounding_box(loop)
    alpha = np.append(rng.uniform(*box[:2], count), -loop.gamma + 10 ** rng.uniform(-7, -3, count // 4))
    beta = np.append(rng.uniform(*box[2:], count), 10 ** rng.uniform(-3, -1, count // 4))
    radius = spectral_radius(loop, alpha, beta)
    chosen = (radius < 1 - nearest) & (alpha + loop.gamma > 0)
    return alpha[chosen], beta[chosen], radius[chosen]


@pytest.mark.parametrize("loop", LOOPS[:5], ids=str)
def test_energies_are_plain_sums_over_samples(loop):
    alpha, beta, _ = stable_points(loop, 120, 2, nearest=0.03)
    found = energy.energy_costs(loop, alpha, beta, "step")
    z = loop.starts(alpha, "step")
    matrix, before = loop.matrix(alpha, beta), z[:, 0]
    sums = np.zeros((3, len(alpha)))
    for k in range(1500):
        density = z[:, 0] ** 2 + (z[:, 0] - before) ** 2 / (alpha + loop.gamma)
        sums += np.array([1.0, k, k * k])[:, None] * density
        before, z = z[:, 0], np.einsum("nij,nj->ni", matrix, z)
    for w in range(3):
        np.testing.assert_allclose(found[f"energy_step_w{w}_discrete"], sums[w], rtol=1e-10)


def test_unstable_points_among_many_have_no_energy():
    loop, alpha, beta = Loop(0, 0, 1), np.repeat([0.5, 0.05], 100), np.tile(np.linspace(0.2, 0.5, 100), 2)
    found = energy.energy_costs(loop, alpha, beta)["energy_step_w1"]
    assert np.isnan(found[:100]).all()
    np.testing.assert_allclose(
        found[100:], energy.energy_costs(loop, alpha[100:], beta[100:])["energy_step_w1"], rtol=1e-10
    )


def test_overshoot_long_after_settling_is_found(monkeypatch):
    """Points where a pair slowly overtakes a real mode: overshoot of 1e-11 to 1e-2 hundreds of samples later."""
    loop = Loop(0, 0, 4)
    grid = np.meshgrid(np.linspace(0.0015, 0.009, 25), np.linspace(0.2, 0.308, 24))
    steady = spectral_radius(loop, grid[0].ravel(), grid[1].ravel()) < 0.9995
    alpha, beta = (g.ravel()[steady] for g in grid)
    found = transient_costs(loop, alpha, beta, (0.02,), longest=1 << 14, quiet=1e-13)
    monkeypatch.setattr(modes, "_STILL_REPRODUCED", -1.0)
    plain = transient_costs(loop, alpha, beta, (0.02,), longest=1 << 14, quiet=1e-13)
    late = (plain["overshoot"] > 0) & (plain["overshoot"] < 1e-3)
    assert late.sum() > 50
    for name, values in plain.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-11, atol=1e-12, err_msg=name)


def test_a_later_sample_may_exceed_the_samples_so_far():
    """The motion's largest excess comes first, 0.94355; no sample meets it, and the 93rd comes closest."""
    loop, beta = Loop(0, 0, 1), 0.2041052336331193
    alpha = 0.10468793422177697 * np.linspace(1, 0.999, 300)
    state, matrix = loop.starts(alpha, "step"), loop.matrix(alpha, np.full(300, beta))
    largest = np.zeros(300)
    for _ in range(20000):
        state = (matrix @ state[..., None])[..., 0]
        largest = np.maximum(largest, state[:, 0])
    name = "overshoot_discrete"
    found = point_costs_by_name(loop, alpha, np.full(300, beta), ["settle_2pct", name], 1 << 16)[name]
    assert largest[0] == pytest.approx(0.9432529, abs=1e-7)
    np.testing.assert_allclose(found, largest, rtol=1e-10)
