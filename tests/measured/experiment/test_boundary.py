from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.errors import ParameterError
from pipeline.measured.experiment.boundary import measured_boundary

TRIAL = st.tuples(
    st.integers(0, 6).map(float),
    st.integers(0, 3).map(float),
    st.sampled_from(["stable", "unstable", "undecided"]),
)


def test_course_of_one_damping():
    k = np.array([200.0, 400.0, 600.0, 440.0, 480.0])
    said = ["stable", "stable", "unstable", "stable", "unstable"]
    (point,) = measured_boundary(k, np.zeros(5), said)
    assert (point.damping, point.stable, point.unstable, point.censored) == (0.0, 440.0, 480.0, False)


def test_stable_trial_above_the_unstable_one_does_not_count():
    (point,) = measured_boundary(np.array([200.0, 400.0, 600.0]), np.zeros(3), ["stable", "unstable", "stable"])
    assert (point.stable, point.unstable) == (200.0, 400.0)


def test_missing_sides():
    points = measured_boundary(
        np.array([200.0, 200.0, 0.0, 0.0]),
        np.array([0.0, 4.0, -4.0, 0.0]),
        ["unstable", "stable", "stable", "unstable"],
    )
    assert [(p.damping, p.stable, p.unstable, p.censored) for p in points] == [
        (0.0, None, 200.0, False),
        (4.0, 200.0, None, True),
    ]


def test_repeated_pair_is_unstable_if_it_was_once():
    (point,) = measured_boundary(np.array([200.0, 400.0, 400.0]), np.zeros(3), ["stable", "stable", "unstable"])
    assert (point.stable, point.unstable) == (200.0, 400.0)


@given(st.lists(TRIAL, max_size=30))
def test_equals_a_search_trial_by_trial(trials):
    points = measured_boundary(*(np.array([t[i] for t in trials], dtype=float) for i in (0, 1)), [t[2] for t in trials])
    dampings = sorted({b for k, b, _ in trials if k > 0})
    assert [p.damping for p in points] == dampings
    for point in points:
        column = [(k, said) for k, b, said in trials if b == point.damping and k > 0]
        unstable = min((k for k, said in column if said == "unstable"), default=None)
        stable = max((k for k, said in column if said == "stable" and (unstable is None or k < unstable)), default=None)
        assert (point.stable, point.unstable, point.censored) == (stable, unstable, unstable is None)


def test_lengths_must_agree():
    with pytest.raises(ParameterError, match="expected one of each for every trial"):
        measured_boundary(np.zeros(2), np.zeros(3), ["stable"] * 2)
