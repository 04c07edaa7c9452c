"""A device as estimates: what its interval holds beyond its likelihood is said."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.experiment.identified_loop import IdentifiedLoop


@pytest.mark.parametrize(("bounds", "low", "warned"), [({}, 2.98, False), ({"delay_samples": 2.5}, 2.48, True)])
def test_a_delay_that_may_hold_a_lag_says_so(bounds, low, warned):
    device = IdentifiedLoop({"delay_samples": 3.0}, np.array([[0.01**2]]), 1e-3, bounds=bounds)
    estimate = device.estimate("delay_samples", "samples")
    assert (estimate.low, estimate.high) == pytest.approx((low, 3.02), abs=1e-3)
    expected = "up to 0.5 samples of it may be a lag of the drive: these logs cannot separate the two"
    assert estimate.warning == (expected if warned else None)
