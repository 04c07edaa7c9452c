"""Numbers are printed with the digits that they have, and what is beyond all comparison in words."""

from __future__ import annotations

import pytest

from pipeline.records.findings import Estimate
from pipeline.rendering.labels import at_least, damping_text, estimate_texts, percent_text, stiffness_text


@pytest.mark.parametrize(
    ("show", "texts"),
    [
        (
            stiffness_text,
            {7.5: "7.5", 0.0431: "0.0431", 99.96: "99.96", 6800.4: "6800", 250.4: "250", -7.5: "−7.5"},
        ),
        (damping_text, {7e-5: "7.00e−05", 6.98e-4: "0.000698", 18.256: "18.26"}),
        # a lower bound is never rounded up
        (at_least, {1.6563: "1.6", 2.1: "2.1", 3.0: "3", 12.99: "12", 0.999: "0.99"}),
        (percent_text, {537261.9: "over +1000", -2.26: "−2.3", 0.04: "0.0"}),
    ],
)
def test_numbers_have_the_digits_that_they_are_known_to(show, texts):
    assert {value: show(value) for value in texts} == texts


@pytest.mark.parametrize(
    ("value", "low", "high", "texts"),
    [
        (0.19000076, 0.19000013, 0.19000139, ("0.19000076", "0.19000013", "0.19000139")),
        (3.8799, 3.87, 3.89, ("3.880", "3.870", "3.890")),
        (30123.0, 29700.0, 30500.0, ("30120", "29700", "30500")),
        (12.3, 11.9, 99.0, ("12.3", "11.9", "99.0")),
        (0.0, 0.0, 0.114, ("0", "0", "0.114")),
        (5.0, 4.9, None, ("5.00", "4.90", "")),
    ],
)
def test_an_estimate_has_two_digits_of_its_half_width(value, low, high, texts):
    assert estimate_texts(Estimate(value=value, low=low, high=high, unit="", method="")) == texts
