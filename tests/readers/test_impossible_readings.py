"""Impossible readings: found at any size, and never where a motion is fast, grows or hardly moves."""

import numpy as np
import pytest
from not_ideal import simulate

from pipeline.readers.log import stray


def logs(K=(400.0, 2000.0, 6000.0, 60000.0), **more):
    walls = [(k, b) for k in K for b in (2.0, 20.0)]
    more = {"travel": 5.0, "quantum": 2e-6, "noise": 1e-6, "seed": 4, **more}
    return simulate([k for k, _ in walls], [b for _, b in walls], **more)


def strays(trials):
    return [
        stray(trial.position, float(abs(trial.step) / trial.stiffness) if trial.stiffness else 0.0) for trial in trials
    ]


@pytest.mark.parametrize("size", [50.0, -700.0, 9e4])
@pytest.mark.parametrize("seed", range(4))
def test_one_cell_is_found_in_its_row(size, seed):
    random, trials = np.random.default_rng([seed, 7]), logs()
    which = int(random.integers(6))
    row = int(random.integers(trials.rows[which]))
    trials[which].position[row] = size
    assert strays(trials) == [row if i == which else None for i in range(len(trials))]


def test_no_log_that_happened_is_refused():
    many = [
        logs(),
        logs(travel=0.05),
        logs(K=(0.0, 1e5, 3e5), rows=60, travel=50.0),
        logs(friction=1.0, limit=9.0),
        logs(rows=22),
        logs(K=(8000.0,), step=1e-3),
        logs(mode=(120.0, 0.01, 0.2)),
        simulate([500.0, 90000.0], [0.0, 0.0], rows=200, travel=1.0),
    ]
    for trials in many:
        assert not any(row is not None for row in strays(trials))
