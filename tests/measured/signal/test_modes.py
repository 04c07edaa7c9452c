from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.signal.modes import FEWEST_SAMPLES, MotionWindows

k = np.arange(300)


@pytest.mark.parametrize("rate", [-0.05, -1e-5, 1e-6, 0.02])
@pytest.mark.parametrize("angle", [0.0, 0.02, 0.5, 2.0, np.pi])
def test_growth_of_one_known_mode(rate, angle):
    found = MotionWindows(np.exp(rate * k) * np.cos(angle * k + 0.3), 0.0).fastest_growth()
    assert found.per_sample == pytest.approx(rate, abs=1e-11)
    assert found.clean


def test_a_small_growing_mode_below_a_large_decaying_one_is_found():
    signal = np.exp(-0.01 * k) * np.cos(0.1 * k) + 1e-3 * np.exp(1e-4 * k) * np.cos(0.9 * k)
    assert MotionWindows(signal, 0.0).fastest_growth().per_sample == pytest.approx(1e-4, abs=1e-9)


def test_noise_hides_neither_growth_nor_decay():
    random = np.random.default_rng(1)
    noise = 1e-3 * random.standard_normal((50, 300))
    for rate in (-2e-3, 2e-3):
        growth = [
            MotionWindows(np.exp(rate * k) * np.cos(0.2 * k) + each, 1e-3).fastest_growth().per_sample for each in noise
        ]
        # Cramer-Rao, sigma sqrt(24)/(A n^1.5) with sigma/A = 1e-3, gives 1e-6; the decay to 0.55 leaves room
        np.testing.assert_allclose(growth, rate, atol=5e-5)


def test_pure_noise_has_no_mode():
    random = np.random.default_rng(2)
    for noise in 1e-3 * random.standard_normal((20, 300)):
        assert np.isnan(MotionWindows(noise, 1e-3).fastest_growth().per_sample)


def test_a_short_motion_is_enough_and_a_too_short_one_tells_nothing():
    signal = np.exp(-0.01 * k) * np.cos(0.4 * k)
    assert MotionWindows(signal[:60], 0.0).fastest_growth().per_sample == pytest.approx(-0.01, abs=1e-9)
    assert np.isnan(MotionWindows(signal[: FEWEST_SAMPLES - 1], 0.0).fastest_growth().per_sample)
