"""What counts as the same number or text on another machine."""

import pytest

from pipeline.shell.verify import leaves, same_text, same_value


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [
        ("1.25", "1.26", True),
        ("1.25", "1.27", False),
        ("−0.1", "−0.2", True),
        ("0.1", "−0.1", False),
        ("12 of 13", "11 of 13", False),
        ("growth 2e-13 1/s", "growth 3e-14 1/s", True),
        ("growth 2e-3 1/s", "growth 3e-3 1/s", False),
        ("1.2 mm", "1.2 m", False),
        ("9.99", "10.00", True),
    ],
)
def test_texts_differ_by_one_in_the_last_digit_of_a_decimal_at_most(a, b, same):
    assert same_text("", a, b) is same


@pytest.mark.parametrize(
    ("name", "a", "b", "same"),
    [
        ("json/cost", 1.0, 1.0 + 9e-6, True),
        ("json/cost", 1.0, 1.0 + 1.1e-5, False),
        ("json/deviation_percent", 1e-6, -1e-6, True),
        ("json/deviation", 1e-6, -1e-6, False),
        ("json/trend/slope", 1e-13, -1e-13, True),
        ("json/trials", 3, 4, False),
        ("json/adequate", True, 1.0, False),
        ("json/cost", None, 1.0, False),
    ],
)
def test_values_differ_by_what_another_processor_explains(name, a, b, same):
    assert same_value(name, a, b) is same


def test_leaves_name_each_value_by_its_place():
    assert dict(leaves({"a": [1, {"b": None}], "c": {}}, "json")) == {"json/a/0": 1, "json/a/1/b": None}
