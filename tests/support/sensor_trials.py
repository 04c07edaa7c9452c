"""Stable Falcon trials with and without a sensor, shared by the tests of intervals: truth is the ideal, long one."""

from __future__ import annotations

from functools import cache

import numpy as np
from simulated import FALCON, simulate, spectral_radius

from pipeline.measured.cost.reading_error import reading_error
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge

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
    batch = simulate(K, B, **FREE, rows=3000)
    return batch, (batch.position - batch.position[:, :1] - 8 / K[:, None])[:, EDGE + DELAY :]


@cache
def measured(quantum, noise, count=150):
    K, B = trials(count)
    batch = simulate(K, B, **FREE, quantum=quantum, noise=noise, seed=5)
    response = find_response(batch)
    return batch, response, judge(batch, response), reading_error(batch, response, DELAY)
