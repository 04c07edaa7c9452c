"""Margins against the loop itself at the limit, a textbook formula, and frequency responses of the state space."""

from dataclasses import replace

import numpy as np
import pytest
from general_loop import general_loop, vibration

import pipeline
from pipeline.base.errors import ParameterError
from pipeline.theory.poles import margins, spectral_radius

T = 1e-3
LOOPS = {
    "ideal": pipeline.Loop(0.58, 4.0, T, 4),
    "spring and fraction": pipeline.Loop(1.0, 10.0, T, 1.5, stiffness=2000.0),
    "filter and lag": pipeline.Loop(
        0.58, 4.0, T, 2, velocity={"kind": "butterworth", "order": 2, "cutoff_hz": 80.0}, actuator_lag_s=1e-3
    ),
    "mode": pipeline.Loop(1.0, 5.0, T, 1, mode={"frequency_hz": 60.0, "damping_ratio": 0.02, "mass": 0.3}),
}


def wall(loop, share=0.3):
    border = loop.boundary(60)
    return share * border.attrs["stiffness_max"], 0.8 * border.attrs["damping_at_stiffness_max"]


def answer(system, angle):
    """Frequency response of a state space."""
    z = np.exp(1j * angle)[:, None, None]
    return (system.C @ np.linalg.solve(z * np.eye(len(system.A)) - system.A, system.B + 0j))[:, 0, 0]


def radius(loop, K, B):
    return float(loop.points(K, B)["spectral_radius"].iloc[0])


@pytest.mark.parametrize("name", LOOPS)
def test_factors_lead_to_the_limit_and_no_smaller_one_does(name):
    loop = LOOPS[name]
    K, B = wall(loop)
    found = loop.margins(K, B)
    assert radius(loop, K * found.gain, B * found.gain) == pytest.approx(1, abs=1e-9)
    lowest = found.gain_down or 0.01
    for factor in np.linspace(lowest, found.gain, 40)[1:-1]:
        assert radius(loop, K * factor, B * factor) < 1
    if found.gain_down:
        assert radius(loop, K * found.gain_down, B * found.gain_down) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.sampled
def test_added_delay_leads_to_the_limit_and_no_smaller_one_does(name):
    loop = LOOPS[name]
    K, B = wall(loop)
    found = loop.margins(K, B).delay
    for share in np.linspace(0, 1, 15)[:-1]:
        assert radius(replace(loop, delay_samples=loop.delay_samples + share * found), K, B) < 1
    assert radius(replace(loop, delay_samples=loop.delay_samples + found), K, B) == pytest.approx(1, abs=1e-8)


@pytest.mark.parametrize("name", LOOPS)
def test_phase_and_bandwidth_are_those_of_the_state_space(name):
    loop = LOOPS[name]
    K, B = wall(loop)
    found = loop.margins(K, B)
    angle = np.linspace(1e-4, np.pi - 1e-4, 20_001)
    shut = answer(loop.to_state_space(K, B), angle)
    at_rest = np.abs(answer(loop.to_state_space(K, B), np.array([1e-7]))[0])
    assert angle[np.argmax(np.abs(shut) < at_rest * np.sqrt(0.5))] == pytest.approx(found.bandwidth, abs=2e-4)
    # G_shut = G/(1 + L): L from both systems
    response = answer(loop.to_state_space(), angle) / shut - 1
    outside = np.abs(response) > 1
    unit = np.flatnonzero(outside[1:] != outside[:-1])
    assert np.abs(np.angle(-response[unit])).min() == pytest.approx(found.phase, abs=5e-3)


def test_phase_margin_of_the_textbook():
    # a mass behind a short delay with damping alone is an integrator: its phase margin is 90 degrees less the delay
    loop = pipeline.Loop(1.0, 0.0, T, 3)
    found = loop.margins(1e-6, 10.0)
    angle = 10.0 * T  # rad/sample at which B/(m omega) is 1
    # hold half a sample, velocity by difference half a sample, delay 3
    assert found.phase == pytest.approx(np.pi / 2 - angle * (3 + 0.5 + 0.5), rel=1e-3)


def test_of_several_softer_limits_the_nearest_counts():
    """Of a device on a spring, pushed by its wall, that ends at 0.104 and at 0.460 of it."""
    load = vibration(0.805316082113893, 2.864042531515844, 0.0007722338164229767, True)
    loop, alpha, beta = general_loop(2.0, 1e-4, 0.0, **load), -1.4551131007612188, 0.03388790148624756
    down = margins(loop, alpha, beta).gain_down
    assert down == pytest.approx(0.4604, abs=1e-3)
    inside = np.linspace(down, 1, 30)[1:]
    assert (spectral_radius(loop, alpha * inside, beta * inside) < 1).all()
    assert spectral_radius(loop, alpha * 0.99 * down, beta * 0.99 * down)[0] > 1


def test_unstable_walls_have_no_margins():
    with pytest.raises(ParameterError, match="unstable"):
        LOOPS["ideal"].margins(1e6, 1.0)


def test_a_document_of_margins_has_all_of_them():
    loop = pipeline.Loop(0.58, 4.0, 1e-3, 4)
    found = loop.margins(3000.0, 20.0)
    assert found.to_json() == {
        "gain": found.gain,
        "gain_down": found.gain_down,
        "phase": found.phase,
        "delay": found.delay,
        "bandwidth": found.bandwidth,
        "left_out": [],
    }
