"""Stored intervals of randomly drawn experiments (`support/interval_draws.py` makes them): how many miss the truth."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from interval_draws import intervals
from places import ROOT

DRAWS = pd.read_csv(
    ROOT / "tests" / "data" / "interval_draws.csv", names=["seed", "name", "truth", "low", "high"], header=None
)


def misses(rows: pd.DataFrame) -> float:
    """Share of intervals that do not contain the truth, but for the rounding of a simulator of fine steps."""
    near = 1e-6 * rows["truth"].abs()
    return float(((rows["truth"] < rows["low"] - near) | (rows["truth"] > rows["high"] + near)).mean())


def test_intervals_miss_the_truth_in_at_most_eight_percent_of_the_draws():
    assert len(DRAWS) >= 2000
    assert misses(DRAWS) <= 0.08


def test_intervals_without_width_would_miss():
    half = DRAWS.assign(low=DRAWS["low"] + 0.499 * (DRAWS["high"] - DRAWS["low"]), high=DRAWS["low"])
    assert misses(half) > 0.5


@pytest.mark.parametrize("seed", [3, 8])
def test_the_stored_draws_are_those_of_the_code(seed):
    stored = DRAWS[DRAWS["seed"] == seed].set_index("name")
    again = {name: (low, high) for _, name, _, low, high in intervals(seed)}
    assert set(again) == set(stored.index)
    scale = np.maximum(stored["truth"].abs(), 1e-3)
    for name, ends in again.items():
        assert ends == pytest.approx((stored.loc[name, "low"], stored.loc[name, "high"]), abs=0.02 * scale[name])
