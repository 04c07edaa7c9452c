"""Points that theory is asked for: what overflows is refused by name."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.theory.cases import LARGEST, Case, Cases, case_documents, optimum_document


def cases(*rows):
    return Cases(Path("points"), np.array(rows), tuple(range(1, len(rows) + 1)))


@pytest.mark.parametrize(("alpha", "beta", "column"), [(1e308, 0.1, "alpha"), (0.1, -1e308, "beta")])
def test_points_that_overflow_are_refused_by_name(alpha, beta, column):
    with pytest.raises(ParameterError, match=f"row 2, column {column}"):
        case_documents(cases((0.1, 0.1, 0.0, 0.0, 1.0), (alpha, beta, 0.0, 0.0, 1.0)))


def test_points_far_outside_are_unstable():
    signs = [(a, b, delta, d) for a in (-1, 1) for b in (-1, 1) for delta in (0.0, 1.0) for d in (0.0, 3.5)]
    rows = [(a * LARGEST, b * LARGEST, 0.0, delta, d) for a, b, delta, d in signs]
    assert {point["stable"] for point in case_documents(cases(*rows))} == {False}


def test_optima_say_that_islands_were_not_searched():
    # on an island at (0.2581, -0.2340) this energy is 106.1
    found = optimum_document(Case(Loop(1.98, 0.0, 6.42)), "energy_step_w1")
    assert found["cost"] > 122
    assert "not searched" in found["note"]
    assert "note" not in optimum_document(Case(Loop(0.001, 0.02, 1.0)), "energy_step_w1")
