"""Impossible readings: found at any size, and never where a motion is fast, grows or hardly moves."""

import numpy as np
import pytest
from not_ideal import simulate

from pipeline.measured.signal.response import find_response
from pipeline.records.readings import usable


def batch_of(K=(400.0, 2000.0, 6000.0, 60000.0), **more):
    more = {"travel": 5.0, **more}
    walls = [(k, b) for k in K for b in (2.0, 20.0)]
    return simulate([k for k, _ in walls], [b for _, b in walls], quantum=2e-6, noise=1e-6, seed=4, **more)


@pytest.mark.parametrize("size", [50.0, 1e6, 1e20, 9.97e36, -3.4e38, 1.7e308, np.inf, np.nan])
@pytest.mark.parametrize("seed", range(4))
def test_one_cell_makes_its_log_unusable_alone_and_is_named(size, seed):
    random, batch = np.random.default_rng([seed, 7]), batch_of()
    which, name = int(random.integers(6)), ("position", "command")[random.integers(2)]
    row = int(random.integers(batch.rows[which]))
    values = getattr(batch, name).copy()
    getattr(batch, name)[which, row] = size if name == "position" else 1e3 * size
    found = usable(batch)
    assert found.unusable is not None
    assert np.flatnonzero(found.unusable != "").tolist() == [which]
    assert f"{name} " in found.unusable[which]
    assert f"row {row}" in found.unusable[which]
    assert not found.position[which, : batch.rows[which]].any()
    others = np.arange(len(batch)) != which
    np.testing.assert_array_equal(getattr(found, name)[others], values[others])
    assert "unusable" in find_response(found).edge_reason[which]


def test_a_clock_that_jumps_by_years_is_impossible_and_a_pause_is_not():
    batch = batch_of()
    batch.time[0, -1] += 30.0
    batch.time[1, -1] = 1e12
    found = usable(batch)
    assert found.unusable is not None
    assert [bool(text) for text in found.unusable[:3]] == [False, True, False]


def test_no_log_that_happened_is_unusable():
    many = [
        batch_of(),
        batch_of(travel=0.05),
        batch_of(K=(0.0, 1e5, 3e5), rows=60, travel=50.0),
        batch_of(friction=1.0, limit=9.0),
        batch_of(rows=22),
        batch_of(K=(8000.0,), step=1e-3),
        batch_of(mode=(120.0, 0.01, 0.2)),
        simulate([500.0, 90000.0], [0.0, 0.0], rows=200, travel=1.0),
    ]
    for batch in many:
        assert usable(batch).unusable is None
        assert usable(batch) is batch
