"""Trends of an estimate over the wall: slopes that are there are told, others are not, and one trial makes none."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.experiment.trend import FEWEST_FOR_TREND, drift_warning, find_trends
from pipeline.records.findings import Trend

K, B = (axis.ravel() for axis in np.meshgrid(np.linspace(1000, 9000, 9), np.linspace(0, 80, 5)))
SIGMA = np.full(len(K), 0.01)


def slopes(v, of=slice(None), **conditions):
    axes = conditions or {"stiffness": K, "damping": B}
    return find_trends(v[of], SIGMA[of], {name: x[of] for name, x in axes.items()}, "kg")


def test_slopes_over_both_axes_are_told_apart_with_their_intervals():
    random = np.random.default_rng(1)
    held = []
    for _ in range(200):
        found = slopes(0.6 + 2e-6 * K + 0.01 * random.standard_normal(len(K)))
        assert [each.over for each in found] == ["stiffness", "damping"]
        held.append([each.low <= true <= each.high for each, true in zip(found, (2e-6, 0.0), strict=True)])
        assert [each.unit for each in found] == ["kg/(N/m)", "kg/(Ns/m)"]
    assert (np.mean(held, axis=0) >= 0.91).all()  # of 95 %, three standard errors
    assert (np.mean(held, axis=0) <= 0.99).all()


def test_trials_that_are_far_off_pull_no_trend():
    v = 0.6 + 0.01 * np.random.default_rng(2).standard_normal(len(K))
    quiet, _ = slopes(v)
    off, _ = slopes(np.where((K == 9000) & (B == 0), v + 5, v))
    assert not off.significant
    assert abs(off.slope - quiet.slope) < 0.5 * (quiet.high - quiet.low)


def test_an_error_that_all_trials_share_and_that_grows_with_the_wall_is_no_drift():
    error = 0.002 + 4e-6 * K
    axes = {"stiffness": K, "damping": B}
    scatter = 0.001 * np.random.default_rng(3).standard_normal(len(K))
    for factor, drifts in ((1.0, False), (-1.0, False), (4.0, True)):
        alone, _ = find_trends(0.6 + factor * error + scatter, error, axes, "kg")
        found, _ = find_trends(0.6 + factor * error + scatter, error, axes, "kg", shared=error)
        assert alone.significant
        assert found.significant == drifts


@pytest.mark.parametrize(("trials", "told"), [(FEWEST_FOR_TREND - 1, 0), (FEWEST_FOR_TREND, 1)])
def test_few_trials_show_no_trend(trials, told):
    assert FEWEST_FOR_TREND == 8
    assert len(slopes(0.6 + 1e-5 * K, slice(trials), stiffness=K)) == told


def test_walls_that_were_varied_together_tell_no_trend():
    assert slopes(0.6 + 1e-5 * K, stiffness=K, damping=0.01 * K) == ()
    assert slopes(0.6 + 1e-5 * K, stiffness=np.full(len(K), 1e3)) == ()


@pytest.mark.parametrize(("value", "relative"), [(0.085, True), (0.075, False)])
def test_a_drift_is_told_in_percent_of_a_value_that_it_does_not_exceed_by_far(value, relative):
    trend = Trend(over="stiffness", slope=1e-4, low=9e-5, high=1.1e-4, unit="kg/(N/m)", significant=True, span=8000.0)
    text = drift_warning(trend, K, value, 0.01, "kg")
    assert "+0.8 kg" in text
    assert ("%) over" in text) == relative
    assert drift_warning(trend, K, value, 0.81, "kg") == ""
