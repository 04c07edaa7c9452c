"""Impossible readings: found at any size, and never where a motion is fast, grows or hardly moves."""

import numpy as np
import pytest
from not_ideal import simulate

from pipeline.readers.log import stray


def batch_of(K=(400.0, 2000.0, 6000.0, 60000.0), **more):
    walls = [(k, b) for k in K for b in (2.0, 20.0)]
    more = {"travel": 5.0, "quantum": 2e-6, "noise": 1e-6, "seed": 4, **more}
    return simulate([k for k, _ in walls], [b for _, b in walls], **more)


def strays(batch):
    scale = np.abs(batch.step) / np.maximum(batch.stiffness, 1e-9)
    return [
        stray(batch.position[i, : batch.rows[i]], float(scale[i]) if batch.stiffness[i] else 0.0)
        for i in range(len(batch))
    ]


@pytest.mark.parametrize("size", [50.0, -700.0, 9e4])
@pytest.mark.parametrize("seed", range(4))
def test_one_cell_is_found_in_its_row(size, seed):
    random, batch = np.random.default_rng([seed, 7]), batch_of()
    which = int(random.integers(6))
    row = int(random.integers(batch.rows[which]))
    batch.position[which, row] = size
    assert strays(batch) == [row if i == which else None for i in range(len(batch))]


def test_no_log_that_happened_is_refused():
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
        assert not any(row is not None for row in strays(batch))
