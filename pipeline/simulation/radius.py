"""Compute the spectral radius of the linear part of the simulated loop, which is the growth of a motion per sample."""

from __future__ import annotations

from dataclasses import replace
from math import floor

import numpy as np

from pipeline.loop.state_space import StateSpace, plant_of, state_space
from pipeline.records.trials import Floats
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import coefficients


def spectral_radius(setup: Setup, stiffness: Floats, damping: Floats) -> Floats:
    """Compute the spectral radius of each linear loop at its nominal, constant delay.

    Parameters
    ----------
    setup : Setup
        Conditions of the trials. The parts listed in ``setup.left_out`` are neglected.
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad].

    Returns
    -------
    float64, shape (n,)
        Spectral radius, which is below 1 if the loop is stable. Without any stiffness (K = k = 0), z = 1 is a pole
        for every B. This pole is ignored, so that the radius shows whether the velocity decays.

    Notes
    -----
    The state contains the state of the plant, past positions, past velocities and delayed commands.

    Source: Hulin 2017, eq. 3.18, in physical units and with a fractional delay.
    """
    T, trials, period = setup.true_period_s, len(stiffness), setup.loop.sampling_period_s
    plant = plant_of(replace(setup.loop, force_gain=1.0))
    linear = state_space(plant)
    whole = floor(setup.loop.delay_samples)
    part = setup.loop.delay_samples - whole
    (early, early_gain), (late, late_gain) = (_transition(linear, time) for time in (part * T, (1 - part) * T))
    b, a = coefficients(setup.loop.velocity, period)
    taps = np.convolve(b, [1.0, -1.0]) / period  # of x_k, x_{k-1}, ...
    n, past, poles = len(early), len(taps) - 1, len(a) - 1
    positions, speeds, commands = n, n + past, n + past + poles
    size = commands + whole + 1  # the last entry is the command of row k - whole - 1
    place = np.zeros(size)
    place[:n] = linear.sensor
    speed = taps[0] * place
    speed[positions:speeds], speed[speeds:commands] = taps[1:], -a[1:]
    wall = -setup.true_gain * (np.outer(stiffness, place) + np.outer(damping, speed))
    loop = np.zeros((trials, size, size))
    loop[:, :n, :n] = late @ early
    loop[:, :n, -1] += late @ early_gain
    newest = wall if whole == 0 else np.broadcast_to(np.eye(size)[-2], (trials, size))
    loop[:, :n] += late_gain[:, None] * newest[:, None, :]
    shifted = [entry for entry in range(n, size) if entry not in (positions, speeds, commands)]
    loop[:, shifted, [entry - 1 for entry in shifted]] = 1.0
    if poles:
        loop[:, speeds] = speed
    loop[:, positions] = place
    loop[:, commands] = wall
    values = np.linalg.eigvals(loop)
    free = (stiffness == 0) & (plant.stiffness == 0)
    nearest = np.argmin(np.abs(values - 1.0), axis=1)
    magnitude = np.abs(values)
    magnitude[free, nearest[free]] = 0.0
    result: Floats = magnitude.max(axis=1)
    return result


def _transition(linear: StateSpace, time_s: float) -> tuple[Floats, Floats]:
    """Return the state transition matrix over a time [s] and the response to a unit command."""
    from scipy.linalg import expm

    n = len(linear.matrix)
    rate = np.zeros((n + 1, n + 1))
    rate[:n] = np.column_stack((linear.matrix, linear.command))
    moved = expm(rate * time_s)
    return moved[:n, :n], moved[:n, n]
