from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.device.averaging import ATTENUATION, averaged_balance


def window(n=2, rows=60, columns=2, seed=0):
    """Columns, impulse and durations, with a window that begins and ends inside."""
    random = np.random.default_rng(seed)
    inside = (np.arange(rows) >= 5) & (np.arange(rows) < rows - 4)
    weight = np.where(inside, random.uniform(0.5, 1.5, (n, rows)), 0.0)
    return (
        random.standard_normal((n, rows, columns)) * inside[:, None],
        random.standard_normal((n, rows)) * inside,
        weight,
    )


def test_means_are_weighted_by_duration_and_lie_inside_the_window():
    columns, impulse, weight = window()
    found = averaged_balance(columns, impulse, weight, np.zeros(2), 4)
    assert found.width.tolist() == [4, 4]
    assert np.flatnonzero(found.valid[0]).tolist() == list(range(5, 60 - 4 - 3))
    expected = np.average(columns[1, 20:24, 1], weights=weight[1, 20:24])
    assert found.columns[1, 20, 1] == pytest.approx(expected, rel=1e-9)
    assert found.impulse[1, 20] == pytest.approx(np.average(impulse[1, 20:24], weights=weight[1, 20:24]), rel=1e-9)


def test_the_fewest_rows_that_are_good_enough_are_chosen():
    rows = 600
    time = np.arange(rows) * 1e-3
    columns = np.stack([np.sin(20 * time), np.ones(rows)], axis=1)[None].repeat(3, axis=0)
    weight = np.full((3, rows), 1e-3)
    # velocity 0.7 rms; a reading error e makes e/(width T): shares of its square at width 1 are 0, 2 % and 8 %
    error = np.sqrt([0.0, 0.02, 0.08]) * 0.5**0.5 * 1e-3
    found = averaged_balance(columns, np.zeros((3, rows)), weight, error, None)
    assert found.width.tolist() == [1, 2, 4]
    assert (found.attenuation <= ATTENUATION * 1.05).all()
    assert found.attenuation[0] == 0
