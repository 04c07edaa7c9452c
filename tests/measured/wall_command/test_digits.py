"""What printed digits leave open: never less than what printing took away, and little more."""

import numpy as np
import pytest
from logged import FORMATS

from pipeline.measured.wall_command.log_rows import FULL_DIGITS, printed, stated_resolution

RANDOM = np.random.default_rng(4)
COLUMNS = {
    "a motion": 0.12 + 0.01 * np.cumsum(RANDOM.standard_normal(300)) / 17,
    "small numbers": 1e-4 * RANDOM.standard_normal(300),
    "counts of a turn": 2 * np.pi / 655360 * np.rint(1e3 * RANDOM.standard_normal(300)),
    "a command that grows": 8 * np.exp(np.linspace(-9, 5, 300)) * np.sin(np.arange(300)),
}


@pytest.mark.parametrize("column", COLUMNS)
@pytest.mark.parametrize("text", FORMATS)
def test_the_digits_found_hold_what_printing_took_away(column, text):
    values = COLUMNS[column]
    shown = FORMATS[text](values)
    half = printed(shown).half
    lost = np.abs(shown - values)
    assert (lost <= half * (1 + 1e-9) + 3e-16 * np.abs(values)).all()
    # half a unit of the last digit, not ten
    assert half.sum() <= 30 * lost.sum() + 1e-14 * np.abs(values).sum()


@pytest.mark.parametrize("text", ["%.17g", "%.15g"])
def test_a_column_in_full_leaves_rounding_open(text):
    found = printed(FORMATS[text](COLUMNS["a motion"]))
    assert (found.digits, found.in_full) == (FULL_DIGITS, True)


def test_a_column_of_two_numbers_shows_no_digits():
    assert printed(np.repeat([0.0, 8.0], 50)).in_full


def test_a_chosen_number_of_a_header_is_exact_and_one_that_was_cut_off_is_not():
    assert stated_resolution(np.array([0.0, 2000.0, 3200.0, 30.5])).tolist() == [0.0] * 4
    assert stated_resolution(np.array([3685.67, 18.0])) == pytest.approx([0.005, 0.00005])
