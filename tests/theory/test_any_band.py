"""Settling times for a band of any width: against the response itself, and between those of the thesis."""

from __future__ import annotations

import numpy as np
import pytest

import pipeline
from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.criteria import criterion_of, is_criterion
from pipeline.theory.optimum import optimal_point
from pipeline.theory.reachable import reachable

LOOP = pipeline.Loop(0.58, 4.0, 0.001, 4)


@pytest.mark.parametrize("percent", ["0.5", "3", "12.5"])
def test_a_band_of_any_width_is_that_of_the_response(percent):
    wall, fine = (4000.0, 70.0), 200
    (found,) = LOOP.points(*wall, (f"settle_{percent}pct", f"settle_{percent}pct_discrete")).to_dict("records")
    frame = LOOP.response(*wall, samples=200, per_sample=fine)
    off = np.abs(frame["position"].to_numpy() * wall[0] - 1)
    outside = np.flatnonzero(off > float(percent) / 100)
    assert found[f"settle_{percent}pct"] == pytest.approx(outside[-1] / fine, abs=2 / fine)
    sampled = np.flatnonzero(off[::fine] > float(percent) / 100)
    assert found[f"settle_{percent}pct_discrete"] == sampled[-1] + 1


def test_optima_lie_between_those_of_the_neighbouring_bands():
    loop = NormalisedLoop.ideal(0.0, 0.0, 2.0)
    costs = [optimal_point(loop, f"settle_{percent}pct").cost for percent in (2, 3, 5)]
    assert costs[0] > costs[1] > costs[2]
    best = optimal_point(loop, "settle_3pct")
    # a dense search around it finds nothing that settles sooner
    from pipeline.theory.costs import point_costs_by_name

    a, b = np.meshgrid(best.alpha * np.linspace(0.9, 1.1, 41), best.beta * np.linspace(0.9, 1.1, 41))
    cost = point_costs_by_name(loop, a.ravel(), b.ravel(), ("settle_3pct",), 200)["settle_3pct"]
    assert best.cost <= np.nanmin(cost) * (1 + 1e-9)
    rule = reachable("settle_3pct", 2.0)
    assert rule.cost == pytest.approx(best.cost, rel=rule.within)
    sampled = reachable("settle_3pct_discrete", 2.0)
    assert sampled.cost == pytest.approx(optimal_point(loop, "settle_3pct_discrete").cost, rel=sampled.within)


@pytest.mark.parametrize("name", ["settle_0pct", "settle_60pct", "settle_03pct", "settle_3.0pct", "settle_pct"])
def test_other_names_are_refused(name):
    assert not is_criterion(name, ("settle_2pct",))
    with pytest.raises(KeyError):
        criterion_of(name)
    with pytest.raises(ParameterError, match="settle_3pct"):
        LOOP.points(4000.0, 70.0, (name,))


def test_a_band_is_known_only_where_settling_times_are():
    assert is_criterion("settle_3pct", ("settle_2pct", "overshoot"))
    assert not is_criterion("settle_3pct", ("overshoot",))
