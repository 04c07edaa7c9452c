"""Rise times of stiff, heavily damped devices against exact motion between samples by scipy's matrix exponential."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.boundary import boundary
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.poles import spectral_radius

TIMES = np.concatenate(([0.0], np.geomspace(1e-7, 1.0, 400)))
LEVELS = (0.1, 0.9)


def rise_time(loop, alpha, beta):
    """Time between the first passages of both levels, sample by sample, each in two parts for a fractional delay."""
    rates = np.array([[0, 1, 0], [-loop.gamma, -loop.delta, 1], [0, 0, 0]])
    whole, late = int(loop.delay), loop.delay - int(loop.delay)
    parts = [(size, lag) for size, lag in ((late, whole + 1), (1 - late, whole)) if size > 0]
    rows = [np.array([expm(rates * size * t)[0] for t in TIMES]) for size, _ in parts]
    state, before, commands, passed, now = np.array([-1.0, 0.0]), -1.0, [], [], 0.0
    for sample in range(500):
        commands.append(-alpha * state[0] - beta * (state[0] - before))
        before = state[0]
        for (size, lag), row in zip(parts, rows, strict=True):
            z = np.array([*state, commands[sample - lag] if sample >= lag else alpha])
            for level in LEVELS[len(passed) :]:
                above = np.flatnonzero(1 + row @ z >= level)
                if not len(above):
                    break
                ends = size * TIMES[above[0] - 1], size * TIMES[above[0]]
                share = lambda t, z=z, level=level: 1 + expm(rates * t)[0] @ z - level  # noqa: E731
                passed.append(now + (brentq(share, *ends, xtol=1e-15) if above[0] else 0.0))
            if len(passed) == 2:
                return passed[1] - passed[0]
            state, now = (expm(rates * size) @ z)[:2], now + size
    return np.nan


@pytest.mark.sampled
@pytest.mark.parametrize("seed", range(4))
def test_rise_times_of_stiff_devices(seed):
    random = np.random.default_rng(seed)
    delta = random.uniform(60, 500)
    gamma = min(10 ** random.uniform(3, 5), delta**2 / 4 + 9)
    loop = NormalisedLoop.ideal(
        gamma, delta, float(random.uniform(1, 64)) if seed % 2 else float(random.integers(1, 65))
    )
    border = boundary(loop)
    alpha = np.concatenate((random.uniform(-gamma, border.alpha_max, 40), 10 ** random.uniform(-4, 0, 40)))
    beta = random.uniform(np.nanmin(border.beta), border.beta_max, 80)
    told = np.flatnonzero((spectral_radius(loop, alpha, beta) < 0.995) & (alpha + gamma > 0))[:3]
    assert len(told)
    found = point_costs_by_name(loop, alpha[told], beta[told], ("rise_time",), 3000)["rise_time"]
    expected = [rise_time(loop, a, b) for a, b in zip(alpha[told], beta[told], strict=True)]
    assert found == pytest.approx(expected, rel=1e-8)


def test_the_rise_time_that_was_doubted():
    """Told 0.0143 and said to be 0.1777: the spring brings such a device there within a fiftieth of a sample."""
    loop = NormalisedLoop.ideal(55004.46417657257, 469.06061090820066, 49.00974266867465)
    wall = 0.03187373888722966, -398.5826812399944
    (found,) = point_costs_by_name(loop, *(np.array([each]) for each in wall), ("rise_time",), 3000)["rise_time"]
    assert found == pytest.approx(rise_time(loop, *wall), rel=1e-8)
