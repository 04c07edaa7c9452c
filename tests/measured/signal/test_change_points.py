"""Jumps, rests and gaps of columns of which nothing is known."""

import numpy as np
import pytest

from pipeline.measured.signal.change_points import MOST_JUMPS, gaps, jumps, rests

STEP = np.repeat([0.0, 8.0, 3.0], [40, 60, 100])


def test_levels_and_the_jumps_between_them_are_found():
    assert jumps(STEP).tolist() == [40, 100]
    assert rests(STEP) == [(0, 40), (40, 100), (100, 200)]


@pytest.mark.parametrize("seed", range(3))
def test_noise_below_a_rest_changes_neither(seed):
    noisy = STEP + 0.008 * np.random.default_rng(seed).uniform(-1, 1, len(STEP))
    assert jumps(noisy).tolist() == [40, 100]
    assert rests(noisy) == [(0, 40), (40, 100), (100, 200)]


def test_an_oscillation_rests_where_it_has_died_away():
    t = np.arange(600.0)
    swing = np.where(t < 50, 0.0, np.exp(-0.03 * (t - 50)) * np.sin(0.2 * (t - 50)))
    (first, last) = rests(swing)
    assert first[0] == 0
    assert first[1] == pytest.approx(51, abs=2)
    assert last[1] == 600
    assert np.ptp(swing[last[0] :]) < 0.02 * np.ptp(swing)
    assert not len(jumps(swing))


@pytest.mark.parametrize("values", [np.zeros(0), np.zeros(1), np.full(50, np.nan), np.arange(50.0)])
def test_columns_without_any_have_none(values):
    assert not len(jumps(values))
    assert rests(values) == []


def test_a_column_that_never_moves_rests():
    assert rests(np.full(30, 2.0)) == [(0, 30)]


def test_missing_cells_end_a_rest_and_are_no_jump():
    values = np.where(np.arange(200) == 70, np.nan, STEP)
    assert jumps(values).tolist() == [40, 100]
    assert rests(values) == [(0, 40), (40, 70), (71, 100), (100, 200)]


def test_of_chatter_the_largest_jumps_are_told():
    chatter = np.tile([0.0, 1.0], 100)
    chatter[150] = -5.0
    found = jumps(chatter)
    assert len(found) <= MOST_JUMPS
    assert {150, 151} <= set(found.tolist())


def test_gaps_stand_before_the_row_that_is_late():
    time = np.delete(np.arange(100) * 1e-3, [30, 31, 60])
    assert gaps(time).tolist() == [30, 58]
    assert not len(gaps(np.arange(100) * 1e-3))
    assert not len(gaps(np.zeros(1)))
