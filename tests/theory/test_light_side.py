"""Energies of devices whose motor side is light: against plain iteration of both masses in many digits."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest

import pipeline
from pipeline.loop.loop import Loop, Vibration
from pipeline.theory.energy import energy_costs


def iterated(
    near: float, stiffness: float, damping: float, delta: float, wall: tuple[float, float], far: bool, blow: bool
):
    """Discrete energy w = 0 of a response with one sample of delay, from the positions of both masses."""
    with mp.workdps(60):
        m, k, d = mp.mpf(near), mp.mpf(stiffness), mp.mpf(damping)
        rate = mp.matrix(5, 5)  # x1, v1, x2, v2, force on the first
        rate[0, 1] = rate[2, 3] = 1
        rate[1, 0], rate[1, 1], rate[1, 2], rate[1, 3], rate[1, 4] = -k / m, -(d + delta) / m, k / m, d / m, 1 / m
        rate[3, 0], rate[3, 1], rate[3, 2], rate[3, 3] = (v / (1 - m) for v in (k, d, -k, -d))
        step = mp.expm(rate)
        alpha, beta = (mp.mpf(v) for v in wall)
        start = 0 if blow else -1
        state = mp.matrix([start, 1 / m if blow else 0, start, 0])
        before, waiting, total = mp.mpf(start), -alpha * start, mp.mpf(0)
        for _ in range(4000):
            here = state[2 if far else 0]
            force, waiting = waiting, -alpha * here - beta * (here - before)
            state = step[:4, :4] * state + step[:4, 4] * force
            total += here**2 + (state[2 if far else 0] - here) ** 2 / alpha
            before = here
        return float(total * (alpha if blow else 1))


@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("blow", [False, True])
@pytest.mark.parametrize("near", [1e-5, 0.3])
@pytest.mark.sampled
def test_energies_of_a_light_motor_side(near, blow, far):
    reduced = near * (1 - near)
    stiffness, damping = reduced * 0.3**2, 2 * 0.9 * 0.3 * reduced
    stiffness, damping = (stiffness, damping) if near > 0.1 else (2e-2, 8e-2)
    wall, delta = (1e-3, 0.05), 0.03
    loop = Loop(0.0, delta, 1.0, mode=Vibration(1 - near, stiffness, damping, far))
    assert np.abs(np.linalg.eigvals(loop.matrix(*(np.array([v]) for v in wall)))).max() < 0.995
    signal = "impulse" if blow else "step"
    found = energy_costs(loop, *wall, signal)[f"energy_{signal}_w0_discrete"][0]
    assert found == pytest.approx(iterated(near, stiffness, damping, delta, wall, far, blow), rel=1e-9)


def test_sums_that_rounding_keeps_from_their_equations_are_none():
    # a radius of 1 - 7e-12: mpmath with 70 digits has 6.311e10, four rounds of refinement told 6.552e12
    device = pipeline.Loop(
        mass=1.0,
        damping=17.250022087330652,
        sampling_period_s=0.001,
        delay_samples=5.0,
        stiffness=0.0,
        velocity={"kind": "butterworth", "order": 3, "cutoff_hz": 243.6823222407204},
        actuator_lag_s=0.0001802570302356224,
    )
    unit = device._scale
    wall = [2.2239988459545563e-05 / unit.stiffness], [-17.250021954961706 / unit.damping]
    found = energy_costs(device._normalised, *wall, "impulse")["energy_impulse_w0"]
    assert np.isnan(found[0]) or found[0] == pytest.approx(63110474678.73257, rel=1e-9)
