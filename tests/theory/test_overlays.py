"""Friction overlays against a simulation of their own: implicit friction over fine steps."""

import numpy as np
import pytest

from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.boundary import limits, quantum_limit, step_limits

DELAY, DELTA, FRICTION, FINE = 2, 0.005, 1e-3, 100
LOOP = NormalisedLoop.ideal(0.0, DELTA, float(DELAY))


def motion(alpha, beta, start, samples=900, friction=FRICTION, quantum=0.0):
    """Positions at the samples from rest at ``start``; friction sticks where it can (backward Euler)."""
    x, v, h, commands, result = start, 0.0, 1 / FINE, [], []
    before = x
    for _ in range(samples):
        seen = np.round(x / quantum) * quantum if quantum else x
        commands.append(-alpha * seen - beta * (seen - before))
        before = seen
        result.append(x)
        u = commands[-1 - DELAY] if len(commands) > DELAY else 0.0
        for _ in range(FINE):
            free = (v + h * u) / (1 + h * DELTA)
            hold = h * friction / (1 + h * DELTA)
            v = np.sign(free) * max(abs(free) - hold, 0.0)
            x += h * v
        if abs(x) > 100 * abs(start):
            break
    return np.array(result)


def test_quantum_with_friction_ends_at_rest_below_its_limit():
    quantum, alpha = 1e-3, 0.05
    friction = 1.02 * alpha * quantum / 2
    assert quantum_limit(friction, quantum) > alpha
    for start in (3.3e-3, 7.7e-3, 1.21e-2):
        x = motion(alpha, 0.2, start, samples=1200, friction=friction, quantum=quantum)
        assert np.ptp(x[-300:]) == 0


@pytest.mark.parametrize(("share", "beta"), [(0.02, 0.11), (0.1, 0.19), (0.15, 0.25)])
def test_a_step_fades_below_the_limit_of_its_own_size_only(share, beta):
    limit = step_limits(LOOP, np.array([beta]), share)[0]
    assert limit > 1.02 * limits(LOOP, np.array([beta])).alpha[0]
    for alpha in (0.9 * limit, 1.12 * limit):
        way = FRICTION / share / alpha
        x = motion(alpha, beta, way)
        assert (np.abs(x[-200:]).max() < 0.5 * way) == (alpha < limit), (alpha, limit)


def test_no_limit_is_told_where_a_step_does_not_slide_all_through():
    beta = np.array([0.1, 0.2])
    assert np.isfinite(step_limits(LOOP, beta, 0.05)).all()
    assert np.isnan(step_limits(LOOP, beta, 2.0)).all()
