"""Passivity behind fractional delays, against sums over aliases and against energy that a wall gives in simulation."""

from __future__ import annotations

import numpy as np
import pytest
from independent import maximum_passive_stiffness
from independent import needed_damping as by_the_printed_condition

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.theory.passivity import passive_outline, required_damping, stiffest_passive


def needed_damping(delay: float, stiffness: list[float], damping: list[float]) -> np.ndarray:
    """What walls of an ideal loop need of the device, T = 1."""
    return required_damping(Loop(0.0, 0.0, delay), np.array(stiffness), np.array(damping))


def by_aliases(delay: float, stiffness: float, damping: float, aliases: int = 4000) -> float:
    """The condition by its sums as they stand, T = 1 (DEVICES: S_0, S_1, S_2)."""
    w = np.linspace(2e-3, np.pi, 1500)
    total = np.zeros((2, len(w)), dtype=complex)
    for n in range(-aliases, aliases + 1):
        wn = w + 2 * np.pi * n
        total += np.stack([1 / wn**2 + 0j, np.exp(-1j * wn * delay) / wn**2])
    y = (1 - np.exp(-1j * w)) * (stiffness + damping * (1 - np.exp(-1j * w)))
    s0, ys1 = total[0].real, y * total[1]
    return float(((ys1.real + np.sqrt(np.abs(y) ** 2 * s0**2 - ys1.imag**2)) / 2).max())


@pytest.mark.sampled
@pytest.mark.parametrize(("delay", "K", "B"), [(0.5, 1.0, 0.0), (2.3, 0.2, 0.3), (3.75, 0.3, 0.1)])
def test_need_is_that_of_the_sums_over_all_aliases(delay, K, B):
    # sums over 4,000 aliases on either side are off by 1/(2 pi^2 4000)
    assert needed_damping(delay, [K], [B])[0] == pytest.approx(by_aliases(delay, K, B), rel=5e-5)


def test_half_a_sample_needs_more_than_the_form_for_whole_ones_says():
    assert needed_damping(0.5, [1.0], [0.0])[0] == pytest.approx(1.059, abs=5e-4)
    angle = np.linspace(1e-3, np.pi, 2000)
    assert by_the_printed_condition(0.5, 1.0, 0.0, angle).max() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("delay", [0, 1, 2, 4, 8, 64])
def test_whole_delays_give_the_published_wall(delay):
    kappa, ratio = stiffest_passive(Loop(0.0, 0.0, float(delay)), 1.0)
    published, at = (float(value[0]) for value in maximum_passive_stiffness([delay]))
    assert kappa == pytest.approx(published, rel=2e-5)
    assert ratio == pytest.approx(at, abs=5e-3)  # the maximum over B is flat


def test_need_grows_in_proportion_and_delays_out_of_range_are_refused():
    one, two = needed_damping(2.4, [0.1, 0.2], [0.2, 0.4])
    assert two == pytest.approx(2 * one)
    with pytest.raises(ParameterError, match="delay"):
        needed_damping(-0.1, [1.0], [0.0])


@pytest.mark.parametrize("delay", [0.3, 0.5, 1.5, 7.5])
def test_no_wall_on_the_outline_needs_more_than_the_device_has(delay):
    """The form for whole delays is up to 8.8 % too optimistic between them, and was drawn."""
    alpha, beta = passive_outline(Loop(0.0, 0.0, delay), 1.0)
    worst = max(by_aliases(delay, float(k), float(b), 400) for k, b in zip(alpha[20::40], beta[20::40], strict=True))
    assert worst == pytest.approx(1.0, abs=1e-3)
