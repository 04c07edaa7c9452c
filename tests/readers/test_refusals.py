"""One function words every refusal."""

from typing import get_args

import pytest

from pipeline.base.errors import Code
from pipeline.readers.refusals import CURES, refusal


def test_a_refusal_says_what_where_expected_and_the_line_that_might_help():
    error = refusal("no-value", "a.csv, column 'x'", "a blank", "a number", row=3, line='[columns.x]\nblanks = "skip"')
    assert error.reason == (
        "a.csv, column 'x': a blank; expected a number. Fill in or drop these rows, or take another column. "
        'This might help in the profile: [columns.x]; blanks = "skip"'
    )
    assert (error.row, error.code, error.profile_line) == (3, "no-value", '[columns.x]\nblanks = "skip"')


@pytest.mark.parametrize("code", CURES)
def test_what_to_do_is_known_by_the_code(code):
    assert code in get_args(Code)
    assert refusal(code, "a.csv", "is wrong").reason == f"a.csv: is wrong. {CURES[code]}"
