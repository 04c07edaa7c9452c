"""The ghost beside the log: equal to the simulator for true parameters, telling where they are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.loop.motion import Mechanism
from pipeline.measured.fit.ghost import simulate_ghost
from pipeline.measured.signal.response import find_response
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import simulate

K = np.array([1000.0, 3000.0, 6000.0, 9000.0, 0.0])
B = np.array([20.0, 60.0, 90.0, 110.0, -2.0])


def logs(delay, **sensor):
    setup = Setup(Mechanism(0.58, 4.0), 1e-3, 8.0, rows=300, edge_row=20, delay_samples=delay, **sensor)
    return simulate(setup, K, B, seed=3)


def ghost_of(batch, mass=0.58, damping=4.0, delay=4.0):
    n = len(batch)
    return simulate_ghost(batch, find_response(batch), np.full(n, mass), np.full(n, damping), np.full(n, delay))


@pytest.mark.parametrize("delay", [0, 1, 4, 2.37, 0.5, 7.99])
def test_ghost_of_an_ideal_log_is_the_log(delay):
    """The simulator is a second implementation: exact flow in physical units, command by command."""
    batch = logs(delay)
    ghost = ghost_of(batch, delay=float(delay))
    bounded = np.nanmax(np.abs(batch.displacement), axis=1) < 1.0
    assert bounded.sum() >= 3
    np.testing.assert_allclose(ghost.position[bounded], batch.position[bounded], rtol=0, atol=1e-12)
    assert (ghost.leaves_row[bounded] == -1).all()
    assert (ghost.deviation[bounded] < 1e-12).all()


def test_a_wrong_parameter_leaves_the_band_soon_after_the_response_begins():
    batch = logs(4, quantum=2e-6, noise=0.5e-6)
    right, wrong = ghost_of(batch), ghost_of(batch, mass=0.64)
    settled = K > 0
    assert (right.deviation[settled] < 0.3 * wrong.deviation[settled]).all()
    assert (wrong.leaves_row[settled] > 20).all()
    assert (wrong.leaves_row[settled] < 60).all()
    np.testing.assert_allclose(wrong.relative[settled], wrong.deviation[settled] * K[settled] / 8.0)
    assert np.isnan(wrong.relative[~settled]).all()


def test_trials_without_parameters_have_no_ghost():
    batch = logs(4)
    mass = np.array([0.58, np.nan, -1.0, 0.58, 0.58])
    delay = np.array([4.0, 4.0, 4.0, np.nan, -0.1])
    ghost = simulate_ghost(batch, find_response(batch), mass, np.full(5, 4.0), delay)
    assert np.isfinite(ghost.deviation).tolist() == [True, False, False, False, False]
    assert np.isnan(ghost.position[1:]).all()
    assert ghost.leaves_row[1:].tolist() == [-1] * 4


def test_an_unstable_ghost_stays_finite():
    batch = logs(4)
    ghost = ghost_of(batch, delay=30.0)
    assert np.isfinite(ghost.position[:4]).all()
