"""Growth of the simulated loop from sample to sample: the spectral radius of all that is linear in it."""

from __future__ import annotations

from dataclasses import replace
from math import floor

import numpy as np

from pipeline.loop.motion import Mechanism
from pipeline.records.batch import Floats
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import coefficients


def spectral_radius(plant: Mechanism, setup: Setup, stiffness: Floats, damping: Floats) -> Floats:
    """Return the spectral radius of the linear loop (constant delay ``setup.delay_samples``), shape (n,).

    Parameters
    ----------
    plant : Mechanism
        Its friction is left out.
    setup : Setup
        Sampling period, delay, gain and velocity filter are used.
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad].

    Returns
    -------
    float64, shape (n,)
        Below 1 where the loop is stable. Without any stiffness (K = k = 0) z = 1 is a pole for every B; it
        is left out, so that the radius tells whether the velocity decays.

    Notes
    -----
    State of the simulated loop: that of the plant, last positions, last velocities, delayed commands.

    Source: Hulin 2017, eq. 3.18, in physical units and with a fractional delay.
    """
    T, trials = setup.true_period_s, len(stiffness)
    whole = floor(setup.delay_samples)
    part = setup.delay_samples - whole
    (early, early_gain), (late, late_gain) = (_transition(plant, time) for time in (part * T, (1 - part) * T))
    b, a = coefficients(setup.velocity, setup.sampling_period_s)
    taps = np.convolve(b, [1.0, -1.0]) / setup.sampling_period_s  # of x_k, x_{k-1}, ...
    n, past, poles = len(early), len(taps) - 1, len(a) - 1
    positions, speeds, commands = n, n + past, n + past + poles
    size = commands + whole + 1  # the last entry is the command of row k - whole - 1
    speed = np.zeros((trials, size))
    speed[:, plant.sensed], speed[:, positions:speeds], speed[:, speeds:commands] = taps[0], taps[1:], -a[1:]
    wall = -damping[:, None] * speed
    wall[:, plant.sensed] -= stiffness
    wall *= setup.true_gain
    loop = np.zeros((trials, size, size))
    loop[:, :n, :n] = late @ early
    loop[:, :n, -1] += late @ early_gain
    newest = wall if whole == 0 else np.broadcast_to(np.eye(size)[-2], (trials, size))
    loop[:, :n] += late_gain[:, None] * newest[:, None, :]
    shifted = [entry for entry in range(n, size) if entry not in (positions, speeds, commands)]
    loop[:, shifted, [entry - 1 for entry in shifted]] = 1.0
    if poles:
        loop[:, speeds] = speed
    loop[:, positions] = np.eye(size)[plant.sensed]
    loop[:, commands] = wall
    found = np.linalg.eigvals(loop)
    free = (stiffness == 0) & (plant.stiffness == 0)
    nearest = np.argmin(np.abs(found - 1.0), axis=1)
    magnitude = np.abs(found)
    magnitude[free, nearest[free]] = 0.0
    result: Floats = magnitude.max(axis=1)
    return result


def _transition(plant: Mechanism, time_s: float) -> tuple[Floats, Floats]:
    """Return the matrix of the state, and what a unit of command adds to it, over a time [s]; without friction."""
    n = plant.states
    start = np.eye(n, n + 1)
    moved = replace(plant, friction=None).advance(start, np.eye(n + 1)[n], 0.0, time_s) if time_s else start
    return moved[:, :n], moved[:, n]
