"""The delay factor of an experiment: what a sensor or friction hides at first is no delay."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.experiment.known_delay import delay_estimate


class Seen:
    """Stored delays of three trials whose first change came after 9 samples."""

    rotation, sampling_period_s = False, 1e-3

    def __init__(self, onset, error):
        wall = {"stiffness": np.zeros(3), "damping": np.zeros(3)}
        factors = {"delay_samples": np.full(3, 9.0), "first_change_samples": np.full(3, 9.0)}
        self.columns = wall | factors | {"onset_samples": np.full(3, onset), "onset_error": np.full(3, error)}

    def column(self, stage, name):
        return self.columns[name]

    def texts(self, stage, name):
        return [""] * 3


@pytest.mark.parametrize(
    ("onset", "error", "earliest"),
    [(np.nan, np.nan, 0.0), (2.1, 0.9, 0.0), (5.4, 0.9, 2.0), (9.1, 0.05, 9.0)],
)
def test_a_late_first_change_is_an_upper_bound_unless_the_onset_is_sure(onset, error, earliest):
    found = delay_estimate(Seen(onset, error))
    assert (found.value, found.high) == (9.0, 10.0)
    assert found.low == pytest.approx(earliest, abs=1.0)
    assert found.low <= np.nan_to_num(onset) or found.low == 9.0
