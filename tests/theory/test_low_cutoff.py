"""Filters of high order and a cut-off far below the sampling rate keep the digits of poles and energies."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.loop.loop import Loop
from pipeline.records.loop_parts import Butterworth
from pipeline.theory.boundary import limits, outline
from pipeline.theory.energy import energy_costs
from pipeline.theory.poles import spectral_radius
from pipeline.theory.settling_overshoot import LONGEST, transient_costs


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize(("order", "cutoff"), [(4, 0.01), (4, 0.001), (3, 0.003), (2, 0.3)])
def test_every_wall_of_a_slow_filter_has_costs(order, cutoff):
    loop = Loop(0, 1e-3, 2.0, velocity=Butterworth(kind="butterworth", order=order, cutoff_hz=cutoff))
    found, rng = outline(loop, 30), np.random.default_rng(17)
    beta = rng.uniform(found.beta[0], found.beta[-1], 35)
    alpha = limits(loop, beta).alpha * rng.uniform(0.05, 0.95, 35)
    radius = spectral_radius(loop, alpha, beta)
    found = energy_costs(loop, alpha, beta) | transient_costs(loop, alpha, beta, (0.02,))
    for name, values in found.items():
        # an overshoot that may still come after so many samples is not told
        assert (np.isfinite(values) | (found["settle_2pct"] > LONGEST) & ("overshoot" in name)).all(), name
    # the energies of a response by its own samples
    quick = np.flatnonzero(radius < 0.999)[:3]
    state, total = loop.starts(alpha[quick], "step"), np.zeros(len(quick))
    matrix = loop.matrix(alpha[quick], beta[quick])
    for _ in range(40_000):
        after = np.einsum("nij,nj->ni", matrix, state)
        total += state[:, 0] ** 2 + (after[:, 0] - state[:, 0]) ** 2 / alpha[quick]
        state = after
    np.testing.assert_allclose(energy_costs(loop, alpha, beta)["energy_step_w0_discrete"][quick], total, rtol=1e-9)
