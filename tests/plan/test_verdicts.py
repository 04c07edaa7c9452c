"""Brackets are what verdicts say, whatever a model thinks."""

import numpy as np
import pytest

from pipeline.base.errors import ParameterError
from pipeline.plan.next_wall import Tried, bracket


def of(*trials: tuple[float, str]):
    stiffness, verdict = zip(*trials, strict=True)
    return bracket(np.array(stiffness), np.array(verdict))


def test_nothing_tried_is_open():
    found = bracket(np.empty(0), np.empty(0, dtype="<U9"))
    assert (found.low, found.high, found.bottom, found.top) == (None, None, 0.0, np.inf)


def test_undecided_is_no_evidence():
    assert (of((1e3, "stable"), (2e3, "undecided")).low, of((1e3, "stable"), (2e3, "undecided")).high) == (1e3, None)


def test_most_trials_of_a_wall_decide():
    found = of((1e3, "stable"), (2e3, "unstable"), (2e3, "stable"), (2e3, "stable"), (3e3, "unstable"))
    assert (found.low, found.high, found.again) == (2e3, 3e3, ())


def test_stable_above_unstable_is_asked_again_and_encloses_both():
    found = of((1e3, "stable"), (2e3, "unstable"), (3e3, "stable"), (3e3, "stable"), (4e3, "unstable"))
    assert (found.low, found.high) == (1e3, 4e3)
    assert found.again == (2e3, 3e3), "the wall of fewest trials first"
    assert not found.lasting


def test_a_lasting_contradiction_counts_the_lowest_limit():
    found = of((1e3, "stable"), *[(2e3, "unstable")] * 3, *[(3e3, "stable")] * 3, (4e3, "unstable"))
    assert (found.low, found.high, found.again, found.lasting) == (1e3, 2e3, (), True)


def test_contradictions_within_the_width_are_chance():
    walls, said = np.array([1e3, 1.1e3, 1.2e3, 1.3e3]), np.array(["stable", "unstable", "stable", "unstable"])
    found = bracket(walls, said, width=150.0)
    assert (found.low, found.high, found.again) == (1e3, 1.3e3, ())


def test_columns_must_fit():
    with pytest.raises(ParameterError, match="one value each"):
        Tried(np.ones(2), np.ones(3), np.array(["stable"] * 2), np.ones(2))
