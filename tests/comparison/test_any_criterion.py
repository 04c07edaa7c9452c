"""Settling bands and exponents that no column stores, in a whole comparison."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.base.errors import UsageError
from pipeline.comparison.scene.scene import open_scene
from pipeline.measured.cost.energy import WEIGHTS

CRITERIA = ("settle_3pct", "energy_step_w0.5")


@pytest.fixture(scope="module")
def outcome(falcon, one_process, made_once):
    folder = falcon.raw.parent
    return made_once("any-criterion", lambda _: falcon.compare(criteria=CRITERIA, report=folder / "any.html"))


@pytest.mark.slow
def test_measured_costs_are_those_of_the_samples(falcon, outcome):
    stages = falcon.stages("1")
    settle, energy = (stages.cost(name)[0] for name in CRITERIA)
    edge, delay = stages.column("response", "edge_row"), 4
    known = np.flatnonzero(np.isfinite(energy) & np.isfinite(settle))
    assert len(known) > 20
    mass = outcome.result.experiments[0].estimates["mass"].value
    checked = 0
    for i in known[:: len(known) // 30]:
        trial = stages.samples[i]
        x = trial.position[int(edge[i]) + delay :]
        error = (x - trial.position[0]) * trial.stiffness / trial.step - 1
        outside = np.flatnonzero(np.abs(error) > 0.03)
        assert settle[i] == outside[-1] + 1
        speed = np.diff(error, prepend=error[:1]) / trial.sampling_period_s
        k = np.arange(len(x), dtype=float)
        terms = k**0.5 * (error**2 + mass / trial.stiffness * speed**2)
        beyond = terms[-50:].sum() / terms.sum()  # of the sum, how much may follow after the log
        if beyond < 1e-3:
            assert energy[i] == pytest.approx(terms.sum(), rel=1e-6 + 3 * beyond)
            checked += 1
    assert checked >= 5


def test_an_ideal_log_costs_what_theory_says(outcome):
    rows = {(row.criterion, row.condition): row for row in outcome.result.tables}
    for name in CRITERIA:
        theory, measured = rows[name, "theory_discrete"], rows[name, "experiment"]
        model = measured.deviation.model
        assert theory.cost > 0
        assert abs(model) < 1.0, (name, model)  # percent
        best = outcome.result.experiments[0].optimum[name]
        assert best.cost_low <= best.cost <= best.cost_high


def test_intervals_grow_with_the_exponent(falcon):
    stages = falcon.stages("1")
    found = [stages.cost(f"energy_step_w{w:g}")[0] for w in (0, 0.5, 1)]
    both = np.all(np.isfinite(found), axis=0)
    assert both.any()
    assert (np.diff(np.array(found)[:, both], axis=0) > 0).all()
    low, high = stages.cost_interval("energy_step_w0.5")
    known = np.isfinite(found[1])
    assert (low[known] <= found[1][known]).all()
    assert (found[1][known] <= high[known]).all()
    assert WEIGHTS == (0, 1, 2)


def test_a_misspelt_criterion_is_refused_with_an_example(falcon):
    with pytest.raises(UsageError, match=r"energy_step_w0\.5"):
        open_scene("falcon", falcon.processed, None, ["energy_step_w0.50"])
