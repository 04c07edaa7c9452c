"""What is said of friction: its share of the step, and what it does."""

from __future__ import annotations

import pytest

from pipeline.comparison.loops.causes import _rest_off_target
from pipeline.records.findings import Estimate


@pytest.mark.parametrize(
    ("coulomb", "step", "told"),
    [
        (0.9, -8.0, ", 11 % of the step; it affects rest positions"),
        (0.2, 8.0, ", 2 % of"),
        (0.1, 8.0, ""),
        (0.9, 0.0, ""),
    ],
)
def test_friction_of_more_than_a_settling_band_is_told_with_what_it_does(coulomb, step, told):
    assert _rest_off_target(coulomb, step).startswith(told)
    assert bool(_rest_off_target(coulomb, step)) == bool(told)


def test_an_adequate_loops_delay_is_the_fitted_one(falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    fitted = Estimate(value=4.0001, low=3.9998, high=4.0004, unit="samples", method="model")
    factor = result.estimates["delay_samples"].model_copy(update={"by_method": {"model": fitted}})
    result = result.model_copy(update={"estimates": result.estimates | {"delay_samples": factor}})
    assert result.delay == fitted
    doubtful = result.loop.model_copy(update={"adequate": False})
    assert result.model_copy(update={"loop": doubtful}).delay == factor
