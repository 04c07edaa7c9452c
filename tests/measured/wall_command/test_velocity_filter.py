"""Filters of logged velocities against those of scipy.signal."""

import numpy as np
import pytest
from scipy import signal

from pipeline.measured.wall_command.velocity_filter import VelocityFilterFound, butterworth, filtered

SIGNAL = np.random.default_rng(2).standard_normal(300)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("cutoff", [1e-3, 0.02, 0.3, 0.9])
def test_a_butterworth_filter_has_the_coefficients_of_scipy(order, cutoff):
    for ours, theirs in zip(butterworth(order, cutoff), signal.butter(order, cutoff), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)


@pytest.mark.parametrize(("b", "a"), [([0.25] * 4, [1.0]), ([0.5], [1.0, -0.5]), signal.butter(3, 0.1), ([2.0], [1.0])])
def test_a_signal_is_filtered_as_by_scipy(b, a):
    np.testing.assert_allclose(filtered(b, a, SIGNAL), signal.lfilter(b, a, SIGNAL), rtol=1e-12, atol=1e-14)


def test_the_gain_of_a_filter_is_that_by_scipy():
    b, a = signal.butter(2, 0.1)
    angles = np.linspace(0, 3, 40)
    gain = VelocityFilterFound(tuple(b), tuple(a)).gain(angles)
    np.testing.assert_allclose(gain, signal.freqz(b, a, angles)[1], rtol=1e-9, atol=1e-14)
