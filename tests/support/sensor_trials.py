"""Stable Falcon trials with and without a sensor, shared by the tests of intervals: truth is the ideal, long one."""

from __future__ import annotations

from functools import cache

import numpy as np
from columns import stacked
from measured_logs import Logs
from simulated import FALCON, simulate, spectral_radius

from pipeline.device_data.devices import find_experiment, load_device
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate as simulate_trials
from pipeline.theory.boundary import boundary, stiffness_limit
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.poles import spectral_radius as exact_radius

SENSORS = [(2e-6, 5e-7), (2e-6, 1e-6), (1e-5, 5e-7), (1e-5, 1e-6)]
EDGE, DELAY = 20, 4
FREE = {**FALCON, "travel": 10.0}
FEWEST = 0.90
"""Least share of 95 % intervals that hold the truth: over 150 trials chance alone may cost 4 %."""


@cache
def trials(count=150):
    """Stiffness and damping of stable loops, spread over the stable region of experiment 1."""
    random = np.random.default_rng(11)
    K, B = random.uniform(300, 13000, 6 * count), random.uniform(5, 180, 6 * count)
    stable = [i for i in range(len(K)) if spectral_radius(K[i], B[i], **FREE) < 0.9995]
    return K[stable[:count]], B[stable[:count]]


@cache
def truth(count=150):
    """The same trials, ideal and long, and their displacements from the final position at cost index 0 and later."""
    K, B = trials(count)
    ideal = simulate(K, B, **FREE, rows=3000)
    return ideal, (stacked(ideal) - 8 / K[:, None])[:, EDGE + DELAY :]


@cache
def measured(quantum, noise, count=150):
    K, B = trials(count)
    return Logs(simulate(K, B, **FREE, quantum=quantum, noise=noise, seed=5), DELAY)


def shipped(name, experiment, count):
    """Trials of a shipped device without jitter, spread over its region: trials, experiment and exact energies.

    Spectral radii are at most 0.985, so that after the 380 rows of a Falcon's log 0.3 % of the motion is left.
    """
    device = load_device(name)
    e = find_experiment(device, experiment)
    setup = setup_of(device, e).with_loop(jitter_samples=())
    units, loop, random = LoopUnits.of(setup.loop), NormalisedLoop.of(setup.loop), np.random.default_rng(4001)
    beta = random.uniform(0.03, 1.0, 8 * count) * boundary(loop).beta_max
    alpha = stiffness_limit(loop, beta) * random.uniform(0.1, 0.95, 8 * count)
    inside = np.flatnonzero((alpha > 0) & (exact_radius(loop, np.maximum(alpha, 1e-9), beta) <= 0.985))[:count]
    alpha, beta = alpha[inside], beta[inside]
    assert len(alpha) == count
    # noise is drawn by the digits of a wall: those that are rounding must not matter
    K, B = (
        np.array([float(f"{wall:.9g}") for wall in walls]) for walls in (alpha * units.stiffness, beta * units.damping)
    )
    alpha, beta = K / units.stiffness, B / units.damping
    logs = simulate_trials(setup, K, B, seed=4001)
    names = [f"energy_step_w{w}_discrete" for w in range(3)]
    found = point_costs_by_name(loop, alpha, beta, names, 20000)
    return logs, e, {f"energy_step_w{w}": found[each] for w, each in enumerate(names)}
