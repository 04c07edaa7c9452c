"""Stamps count rows: rows that are missing are found, scatter and other periods are not taken for them."""

import numpy as np
import pytest

from pipeline.measured.wall_command.stamps import read_stamps

T, ROWS = 1e-3, 600


def stamps(seed, *, scatter=0.0, lost=0.0, clock=0.0, bursts=0):
    random = np.random.default_rng(seed)
    time = np.arange(ROWS) * T * (1 + clock)
    keep = random.random(ROWS) >= lost
    keep[:10] = keep[-1] = True
    time = time[keep]
    for row in random.integers(50, len(time) - 50, bursts):
        time[row : row + 6] = time[row + 6] - 1e-6 * np.arange(6, 0, -1)  # written late, all at once
    return time + scatter * T * random.standard_normal(len(time)), int((~keep).sum())


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("how", [{"scatter": 0.15}, {"scatter": 0.05}, {"clock": 0.01}, {"bursts": 4}, {}])
def test_no_row_is_missing_where_stamps_come_back(how, seed):
    time, _ = stamps(seed, **how)
    assert read_stamps(time, T).skipped.sum() == 0


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("lost", [0.01, 0.05, 0.1])
def test_rows_that_are_missing_are_counted(lost, seed):
    time, count = stamps(seed, lost=lost)
    assert read_stamps(time, T).skipped.sum() == count


@pytest.mark.parametrize("seed", range(20))
def test_rows_that_are_missing_are_counted_among_stamps_that_scatter(seed):
    time, count = stamps(seed, lost=0.03, scatter=0.15)
    found = read_stamps(time, T)
    assert abs(int(found.skipped.sum()) - count) <= 1
    assert found.scatters


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 1.5, 0.97, 1.03])
def test_another_period_is_named_and_no_row_is_missing(factor):
    time, _ = stamps(1)
    found = read_stamps(time, factor * T)
    assert found.period == pytest.approx(T)
    assert found.skipped.sum() == 0


@pytest.mark.parametrize(("lost", "scatter"), [(0.0, 0.15), (0.05, 0.0), (0.05, 0.15)])
@pytest.mark.parametrize("seed", range(20))
def test_lost_rows_and_scatter_are_no_other_period(seed, lost, scatter):
    time, _ = stamps(seed, lost=lost, scatter=scatter)
    assert read_stamps(time, T).period == T


def test_stamps_of_few_digits_are_no_other_period():
    assert read_stamps(np.round(np.arange(ROWS) * 1.6, 0) * T, 1.6 * T).period == 1.6 * T


def test_control_that_is_uneven_is_no_scatter_of_stamps():
    steps = 1 + 0.2 * np.random.default_rng(3).standard_normal(ROWS)
    assert not read_stamps(np.cumsum(np.maximum(steps, 0.3)) * T, T).scatters
