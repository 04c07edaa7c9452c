"""Numbers in sentences: plurals, percent, minus signs and spaces that do not break."""

from __future__ import annotations

import pytest

from pipeline.base.wording import counted, listed, percent, shared_notes, true_minus, unbroken

NBSP = "\N{NO-BREAK SPACE}"


@pytest.mark.parametrize(("number", "text"), [(0, "0 trials"), (1, "1 trial"), (2, "2 trials")])
def test_plurals(number: int, text: str) -> None:
    assert counted(number, "trial") == text


def test_names_are_listed_as_in_a_sentence() -> None:
    assert [listed(names) for names in ([], ["1"], ["1", "2"], ["1", "2", "3"])] == ["", "1", "1 and 2", "1, 2 and 3"]


def test_percent_has_a_space_and_a_true_minus() -> None:
    assert percent(-0.0561, 1) == "−5.6 %"
    assert percent(0.2) == "20 %"


def test_minus_is_changed_in_numbers_only() -> None:
    text = "by -0.5 (-14 %), 1.5e-06 to -.3: delay-2, 2017-05-01, d-3, a/-1, --x"
    assert true_minus(text) == "by −0.5 (−14 %), 1.5e−06 to −.3: delay-2, 2017-05-01, d-3, a/-1, --x"


def test_lines_break_neither_before_a_unit_nor_inside_an_equation() -> None:
    text = unbroken("<p>K = 3800 N/m, B ≤ −2.5 Ns/m, 5 % of 0.19 kg m² in Fig. 6.3, K +4.0 %; 4 samples in 3 steps</p>")
    assert text.replace(NBSP, "~") == (
        "<p>K~=~3800~N/m, B~≤~−2.5~Ns/m, 5~% of 0.19~kg~m² in Fig.~6.3, K~+4.0~%; 4~samples in 3 steps</p>"
    )


def test_normalised_quantities_stay_together() -> None:
    text = unbroken("<p>in α = K T²/m and δ = b T/m, or</p>")
    assert text.replace(NBSP, "~") == "<p>in α~=~K~T²/m and δ~=~b~T/m, or</p>"


def test_only_prose_is_changed() -> None:
    page = '<td data-row="K = 3 N/m"><code>x = 3 kg</code><svg><text>5 %</text></svg><script>a = 5 % 3</script></td>'
    assert unbroken(page) == page


def test_notes_that_differ_in_numbers_share_their_range() -> None:
    first, second, third = "cuts off 0.4 % (chance 1)", "cuts off 0.2 % (chance 2e−12)", "no boundary"
    shared = shared_notes([first, second, third, first])
    assert shared == {
        first: "cuts off 0.2 to 0.4 % (chance 2e−12 to 1)",
        second: "cuts off 0.2 to 0.4 % (chance 2e−12 to 1)",
        third: third,
    }
    ranges = ["K from 1 to 2 N/m", "K from 1 to 3 N/m"]
    assert shared_notes(ranges) == dict(zip(ranges, ranges, strict=True)), "a range of ranges cannot be read"
