from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.signal.modes import FEWEST_SAMPLES, fastest_growth

k = np.arange(300)


def of(signal, noise=0.0, length=None):
    signal = np.atleast_2d(signal)
    n = len(signal)
    length = np.full(n, signal.shape[1] if length is None else length)
    return fastest_growth(signal, length, np.full(n, noise))


@pytest.mark.parametrize("rate", [-0.05, -1e-5, 1e-6, 0.02])
@pytest.mark.parametrize("angle", [0.0, 0.02, 0.5, 2.0, np.pi])
def test_growth_of_one_known_mode(rate, angle):
    found = of(np.exp(rate * k) * np.cos(angle * k + 0.3))
    assert found.per_sample[0] == pytest.approx(rate, abs=1e-11)
    assert found.clean[0]


def test_a_small_growing_mode_below_a_large_decaying_one_is_found():
    signal = np.exp(-0.01 * k) * np.cos(0.1 * k) + 1e-3 * np.exp(1e-4 * k) * np.cos(0.9 * k)
    assert of(signal).per_sample[0] == pytest.approx(1e-4, abs=1e-9)


def test_noise_hides_neither_growth_nor_decay():
    random = np.random.default_rng(1)
    noise = 1e-3 * random.standard_normal((50, 300))
    for rate in (-2e-3, 2e-3):
        found = of(np.exp(rate * k) * np.cos(0.2 * k) + noise, 1e-3)
        # Cramer-Rao, sigma sqrt(24)/(A n^1.5) with sigma/A = 1e-3, gives 1e-6; the decay to 0.55 leaves room
        np.testing.assert_allclose(found.per_sample, rate, atol=5e-5)


def test_pure_noise_has_no_mode():
    random = np.random.default_rng(2)
    assert np.isnan(of(1e-3 * random.standard_normal((20, 300)), 1e-3).per_sample).all()


def test_padding_is_not_read_and_too_short_is_nan():
    signal = np.exp(-0.01 * k) * np.cos(0.4 * k)
    signal[60:] = 1e9
    assert of(signal, length=60).per_sample[0] == pytest.approx(-0.01, abs=1e-9)
    assert np.isnan(of(signal, length=FEWEST_SAMPLES - 1).per_sample[0])
