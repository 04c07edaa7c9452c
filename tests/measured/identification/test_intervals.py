"""Intervals of a fit against those of textbooks: a mean by Student's t, by leaving out, in groups, and at its bound."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm, t

from pipeline.measured.identification.intervals import GROUPS, Errors, OwnEstimates
from pipeline.measured.student import NORMAL_95, student_95

SAMPLE = np.random.default_rng(8).normal(5.0, 2.0, 8)


def mean_of(values, known, phases=0.0):
    """Errors of the mean of values, each of which tells it with information 1; its information says ``known``, and
    ``phases`` are what each phase adds to it."""
    deviation = values - values.mean()
    solved = SimpleNamespace(
        total=np.array([[float(len(values))]]),
        information=np.ones((len(values), 1, 1)),
        score=deviation[:, None],
    )
    device = SimpleNamespace(numbers={"mean": float(values.mean())})
    beside = {
        "few": False,
        "open": np.zeros(1),
        "optima": np.zeros((1, 1)),
        "phases": np.zeros((8, 1)) + np.reshape(phases, (-1, 1)),
    }
    return Errors.of(SimpleNamespace(device=device, solved=solved, repeats=len(values) * known**2, **beside))


def half_width(values, known=1e-6, phases=0.0):
    found = mean_of(values, known, phases).interval(lambda n: n["mean"])
    assert found.value == pytest.approx(values.mean())
    return 0.5 * (found.high - found.low)


def test_factors_are_those_of_the_distributions():
    assert pytest.approx(norm.ppf(0.975)) == NORMAL_95
    assert student_95([1, 4, 9.5, np.inf]) == pytest.approx(t.ppf(0.975, [1, 4, 9.5, 1e12]))


def test_a_scattering_mean_has_the_interval_of_student():
    expected = t.ppf(0.975, len(SAMPLE) - 1) * SAMPLE.std(ddof=1) / np.sqrt(len(SAMPLE))
    assert half_width(SAMPLE) == pytest.approx(expected)


def test_information_counts_where_it_leaves_more_open():
    assert half_width(SAMPLE, 3.0) == pytest.approx(t.ppf(0.975, len(SAMPLE) - 1) * 3.0)


def test_units_that_are_alike_in_groups_count_as_so_many():
    groups = np.random.default_rng(4).normal(5.0, 2.0, GROUPS)
    expected = t.ppf(0.975, GROUPS - 1) * groups.std(ddof=1) / np.sqrt(GROUPS)
    # leaving out a group at once moves the mean by so much to first order
    assert half_width(np.repeat(groups, 40)) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("count", [4, 8])
def test_phases_of_the_motion_that_disagree_count_as_so_many(count):
    """Four whose slow and fast halves agree count as four, else as eight."""
    phases = np.array([4.0, 5.5, 5.0, 9.0, 3.0, 8.0, 7.0, 2.0])[:count]
    expected = t.ppf(0.975, count - 1) * phases.std(ddof=1) / np.sqrt(count)
    # the mean of all is that of the phases, and each adds its share of its own deviation
    added = np.repeat((phases - phases.mean()) / 8, 8 // count)
    assert half_width(SAMPLE, 1e-6, added) == pytest.approx(expected)


@pytest.mark.parametrize("value", [0.1, 0.0, -0.1, -3.0])
def test_what_is_not_negative_ends_at_zero(value):
    errors = Errors(
        {"b": value}, np.array([[0.04]]), np.zeros((5, 1)), np.inf, np.zeros(1), np.zeros((8, 1)), np.zeros((1, 1))
    )
    found, reach = errors.interval(lambda n: n["b"], ends_at_zero=True), 0.2 * norm.ppf(0.975)
    assert (found.value, found.low) == (max(value, 0.0), 0.0)
    # the likelihood falls by as much from its largest value that is allowed as to an end of the plain interval
    fall = ((found.high - value) ** 2 - (found.value - value) ** 2) / reach**2
    assert fall == pytest.approx(1.0)


def test_what_is_far_from_its_bound_is_as_without():
    errors = Errors(
        {"b": 0.5}, np.array([[0.04]]), np.zeros((5, 1)), np.inf, np.zeros(1), np.zeros((8, 1)), np.zeros((1, 1))
    )
    assert errors.interval(lambda n: n["b"], ends_at_zero=True) == errors.interval(lambda n: n["b"])


def test_groups_that_disagree_by_more_than_chance_add_the_variance_between_them():
    along = np.ones((1, 1))
    precise = OwnEstimates(SAMPLE[:, None], np.full((8, 1, 1), 1e-6))
    assert precise.variances(along)[0] == pytest.approx(SAMPLE.var(ddof=1), rel=1e-4)
    assert OwnEstimates(SAMPLE[:, None], np.full((8, 1, 1), SAMPLE.var())).variances(along)[0] == 0
    plain = mean_of(SAMPLE, 3.0)
    wide = replace(plain, own=precise).interval(lambda n: n["mean"])
    assert wide.error**2 == pytest.approx(plain.interval(lambda n: n["mean"]).error ** 2 + SAMPLE.var(ddof=1), rel=1e-4)
