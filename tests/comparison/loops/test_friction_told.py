"""What is said of friction: its share of the step, and no advice to declare what is declared."""

from __future__ import annotations

from types import SimpleNamespace

import pyarrow as pa
import pytest

from pipeline.comparison.loops.adequacy import Shown, doubts
from pipeline.comparison.loops.log_evidence import friction_words
from pipeline.measured.experiment.rest_forces import RestForces
from pipeline.records.findings import Estimate
from pipeline.records.loop_parts import Friction, LoopParts
from pipeline.rendering.labels import UNITS

RESTS = RestForces(-0.501, 35, 42, False)


@pytest.mark.parametrize(
    ("coulomb", "told"), [(0.9, "0.90 N, 11 % of the step: it rests off target, and settling times"), (0.1, "0.10 N.")]
)
def test_friction_of_more_than_a_band_is_told_with_what_it_does(coulomb, told):
    stages = SimpleNamespace(trials=pa.table({"step": [8.0, -8.0, 8.0]}))
    assert told in friction_words(coulomb, "N", stages)


def test_without_a_step_there_is_no_share():
    assert friction_words(0.9, "N", SimpleNamespace(trials=pa.table({"step": [0.0]}))).endswith("0.90 N.")


@pytest.mark.parametrize("declared", [True, False])
def test_what_the_device_file_declares_is_never_advised(falcon_outcome, declared):
    result = falcon_outcome.result.experiments[0]
    parts = LoopParts(friction=Friction(coulomb=0.9)) if declared else LoopParts()
    found = doubts(result, None, Shown([], RESTS, None, None), parts, UNITS["translation"])
    (rests,) = [doubt for doubt in found if "came to rest" in doubt.text]
    assert rests.text.startswith("35 of 42 logs that came to rest (83 %) do so elsewhere than at x_0 + F_0/K")
    assert bool(rests.help) != declared


def test_an_adequate_loops_delay_is_the_fitted_one(falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    fitted = Estimate(value=4.0001, low=3.9998, high=4.0004, unit="samples", method="model")
    factor = result.estimates["delay_samples"].model_copy(update={"by_method": {"model": fitted}})
    result = result.model_copy(update={"estimates": result.estimates | {"delay_samples": factor}})
    assert result.delay == fitted
    doubtful = result.loop.model_copy(update={"adequate": False})
    assert result.model_copy(update={"loop": doubtful}).delay == factor
