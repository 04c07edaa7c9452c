"""The best damping for a stiffness that a scene gives, and walls that are stable with every spring, as commands."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

import pipeline
from pipeline.base.errors import ParameterError, UsageError
from pipeline.device_data.devices import load_device
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.shell.cli import application
from pipeline.theory.cases import Case, best_damping_for, case_of, robust_boundary
from pipeline.theory.costs import point_costs_by_name


def answer(*words):
    result = CliRunner().invoke(application(), ["theory", *words, "--json"], catch_exceptions=False)
    return json.loads(result.output)


@pytest.mark.parametrize("criterion", ["energy_step_w1", "settle_2pct_discrete"])
def test_the_best_damping_is_that_of_a_dense_search(criterion):
    loop, alpha = NormalisedLoop.ideal(0.0005, 0.01, 1.0), 0.05
    best = best_damping_for(Case(loop), criterion, alpha)
    beta = np.linspace(0.0, 0.8, 4001)
    cost = point_costs_by_name(loop, np.full_like(beta, alpha), beta, (criterion,), 400)[criterion]
    assert best.cost <= np.nanmin(cost) * (1 + 1e-9)
    assert best.cost == pytest.approx(np.nanmin(cost), rel=1e-4)
    assert best.low - 3e-4 <= beta[np.nanargmin(cost)] <= best.high + 3e-4


def test_the_rules_for_continuous_time_are_those_of_the_thesis():
    loop, alpha = NormalisedLoop.ideal(0.0005, 0.01, 1.0), 0.05
    best = best_damping_for(Case(loop), "energy_step_w1", alpha)
    # (5.17): beta + delta = 2 sqrt(alpha + gamma), and sqrt(2 (alpha + gamma))
    assert best.critical + 0.01 == pytest.approx(2 * math.sqrt(0.0505), rel=1e-12)
    assert best.amplitude + 0.01 == pytest.approx(math.sqrt(0.101), rel=1e-12)


def test_a_device_takes_the_unit_of_its_motion_and_gives_si():
    by_unit = answer("optimum", "--criterion", "settle_2pct", "--device", "falcon", "--stiffness", "3 N/mm")
    alone = answer("optimum", "--criterion", "settle_2pct", "--device", "falcon", "--stiffness", "3000")
    assert by_unit == alone
    assert by_unit["stiffness"] == 3000
    falcon = load_device("falcon")
    loop = pipeline.Loop.of(falcon.loop_for(falcon.experiments[0]))
    assert by_unit["damping"] == pytest.approx(loop.best_damping(3000.0, "settle_2pct")["damping"][0], rel=1e-9)
    # m and b of the thesis, ch. 6: 0.58 kg, 4 Ns/m
    assert by_unit["critical_damping"] == pytest.approx(2 * math.sqrt(0.58 * 3000) - 4, rel=1e-9)


def test_a_stiffness_that_no_damping_stabilises_has_a_reason_with_the_largest_one():
    found = answer("optimum", "--criterion", "settle_2pct", "--device", "falcon", "--stiffness", "30 N/mm")
    assert (found["damping"], found["cost"]) == (None, None)
    assert "13629.3" in found["reason"]


@pytest.mark.parametrize(
    "words", [("--device", "falcon", "--stiffness", "3 s"), ("--delay", "1", "--stiffness", "3 N/m"),
              ("--delay", "1", "--stiffness", "abc"), ("--device", "lwr", "--stiffness", "1 N/m")]
)  # fmt: skip
def test_another_unit_is_refused(words):
    result = CliRunner().invoke(application(), ["theory", "optimum", "--criterion", "settle_2pct", *words])
    assert isinstance(result.exception, UsageError)


def test_an_optimum_says_what_the_delay_alone_allows():
    found = answer("optimum", "--criterion", "settle_2pct", "--delay", "4")
    assert found["reachable"]["cost"] == pytest.approx(found["cost"], rel=found["reachable"]["within"])
    assert "reachable" not in answer("optimum", "--criterion", "overshoot", "--delay", "1")


def test_the_robust_boundary_of_a_command_is_that_of_python():
    falcon = load_device("falcon")
    loop = pipeline.Loop.of(falcon.loop_for(falcon.experiments[0]))
    found = answer("boundary", "--device", "falcon", "--robust")
    np.testing.assert_allclose(found["stiffness"], loop.robust()["stiffness"], rtol=1e-12)
    assert found["stiffness_max"] == pytest.approx(loop.robust().attrs["stiffness_max"], rel=1e-12)
    assert found["stiffness_max"] < answer("boundary", "--device", "falcon")["stiffness_max"] / 5


def test_no_robust_boundary_without_damping_or_with_further_parts():
    with pytest.raises(ParameterError, match="the device has no damping"):
        robust_boundary(Case(NormalisedLoop.ideal(0.0, 0.0, 1.0)))
    falcon = load_device("falcon")
    lagged = falcon.model_copy(update={"loop": falcon.loop.model_copy(update={"actuator_lag_s": 0.003})})
    with pytest.raises(ParameterError, match="more parts"):
        robust_boundary(case_of(lagged, lagged.experiments[0]))
