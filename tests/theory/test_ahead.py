"""Costs told ahead from modes: as those of responses followed to their end, sample by sample."""

import numpy as np
import pytest
from general_devices import EXTREMES, random_device
from general_loop import general_loop

from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory import modes
from pipeline.theory.boundary import limits, outline
from pipeline.theory.settling_overshoot import transient_costs

SLOWEST = 0.995
"""Pole radius of points that are also followed to their end."""


def points(rng, kind):
    """A random device and walls that settle within some thousand samples, one without damping among them."""
    while True:
        loop = NormalisedLoop.of(random_device(rng, kind))
        found = outline(loop, 8)
        if not len(found.beta):
            continue
        beta = rng.uniform(found.beta[0], found.beta[-1], 60)
        beta[0] = max(0.0, found.beta[0])
        limit = limits(loop, beta, exact=False).alpha
        alpha = limit * rng.uniform(0.01, 0.99, 60)
        use = np.flatnonzero(alpha + loop.gamma > 0)
        use = use[np.abs(np.linalg.eigvals(loop.matrix(alpha[use], beta[use]))).max(axis=1) < SLOWEST]
        if len(use) > 10:
            return loop, alpha[use], beta[use]


def followed(monkeypatch, *arguments, **options):
    """Return the costs of `transient_costs` with no mode believed."""
    with monkeypatch.context() as patch:
        patch.setattr(modes, "STILL_REPRODUCED", -1.0)
        return transient_costs(*arguments, **options)


@pytest.mark.sampled
@pytest.mark.parametrize("kind", ["", *EXTREMES])
def test_costs_are_those_of_responses_followed_to_their_end(kind, monkeypatch):
    loop, alpha, beta = points(np.random.default_rng(41), kind)
    plain = followed(monkeypatch, loop, alpha, beta, (0.02, 0.05), quiet=1e-13)
    found = transient_costs(loop, alpha, beta, (0.02, 0.05), quiet=1e-13)
    for name, values in plain.items():
        if name.endswith("pct_discrete"):
            np.testing.assert_array_equal(found[name], values, err_msg=name)
        else:  # a state that is moved by 1,000 samples is off by their rounding
            np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("options", [{"overshoot": False}, {"continuous": False}, {"bands": ()}])
def test_so_are_parts_of_them(options, monkeypatch):
    loop, alpha, beta = points(np.random.default_rng(5), "")
    plain, found = followed(monkeypatch, loop, alpha, beta, **options), transient_costs(loop, alpha, beta, **options)
    assert plain.keys() == found.keys()
    for name, values in plain.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-12, err_msg=name)


def test_a_wall_next_to_its_limit_settles_when_its_slowest_pole_says():
    loop = general_loop(0.0, 0.01, 2.0, lag=1.0)
    beta = np.array([0.15])
    alpha = limits(loop, beta).alpha * (1 - 1e-7)
    pole = np.abs(np.linalg.eigvals(loop.matrix(alpha, beta))[0]).max()
    found = transient_costs(loop, alpha, beta, (0.02, 0.05), longest=2000)
    # the envelope of one pair falls from one band to the other; the last peak lies up to half a turn before
    time = np.log(0.05 / 0.02) / -np.log(pole)
    assert time > 1e6
    assert found["settle_2pct"] - found["settle_5pct"] == pytest.approx(time, abs=40)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [8, *(pytest.param(n, marks=pytest.mark.slow) for n in (9, 10))])
def test_walls_next_to_the_limit_end(seed):
    """The envelope may lie so far above the slow motion that the window before its end is too long to follow."""
    loop = NormalisedLoop.of(random_device(np.random.default_rng(seed), ""))
    beta = np.linspace(*outline(loop, 8).beta[[0, -1]], 7)[1:-1]
    alpha = limits(loop, beta, exact=True).alpha
    near = np.concatenate([alpha * (1 - 1e-9), alpha * 0.3])
    found = transient_costs(loop, near, np.tile(beta, 2), (0.02,), longest=1 << 14)
    assert not (found["settle_2pct"][:5] < 1e6).any()
    assert np.isfinite(found["settle_2pct"][5:]).all()
