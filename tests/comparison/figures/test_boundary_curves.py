"""Curves beside the boundaries, held against the formulas that define them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from report_data import experiment

from pipeline.comparison.figures.boundary_curves import (
    FrictionFacts,
    bound_curve,
    envelope_curve,
    friction_curves,
    friction_facts,
    measured_curve,
    normalised,
    passive_curve,
    robust_curve,
)
from pipeline.comparison.figures.figure_boundaries import plane_figure
from pipeline.device_data.devices import load_device
from pipeline.records.findings import BoundaryPoint, Estimate
from pipeline.records.loop_parts import Friction, LoopParts
from pipeline.records.models import Shown
from pipeline.records.results import TheoryParameters
from pipeline.records.score_records import BandScore, BoundScore, Scores
from pipeline.theory.limits import stiffness_limit
from pipeline.theory.predictions import Theory


def theory(mass: float = 0.58, damping: float = 4.0, delay: float = 4.0, period: float = 1e-3) -> Theory:
    return Theory(
        TheoryParameters(
            mass=mass, damping=damping, stiffness=0, sampling_period_s=period, delay_samples=delay, source="test"
        )
    )


@pytest.mark.parametrize("delay", [0.0, 1.0, 4.0])
def test_outline_of_the_passive_region_needs_all_of_the_device_damping(delay: float) -> None:
    curve = passive_curve(theory(delay=delay))
    assert curve is not None
    w = np.linspace(1e-6, np.pi, 40_001)
    inner = curve.stiffness > 0
    k, b = curve.stiffness[inner] * 1e-3, curve.damping[inner]
    # (4.6): b must exceed this at every frequency; on the outline the largest of them is b itself
    need = (np.sin((delay + 0.5) * w) * k[:, None] + 2 * np.sin(w / 2) * np.cos((delay + 1) * w) * -b[:, None]) / (
        2 * np.sin(w / 2)
    )
    assert need.max(axis=1) == pytest.approx(4.0, rel=1e-6)
    assert curve.stiffness[0] == curve.stiffness[-1] == 0
    assert curve.damping.min() == -4.0


def test_walls_that_any_spring_leaves_stable_hold_the_passive_ones_and_are_drawn_where_asked_for() -> None:
    robust, passive = robust_curve(theory()), passive_curve(theory())
    assert robust is not None
    assert passive is not None
    for stiffness, damping in zip(passive.stiffness[2:-2:6], passive.damping[2:-2:6], strict=True):
        # a chord of the outline, 0.2 Ns/m long, is 0.1 % inside it at most
        assert stiffness < 1.001 * np.interp(damping, robust.damping, robust.stiffness)
    assert robust.stiffness.max() < theory().boundary.alpha_max * theory().units.stiffness
    assert robust_curve(theory(damping=0.0)) is None
    assert not Shown().has_overlay("robust")
    assert Shown(overlays=("robust",)).has_overlay("robust")
    assert Shown().has_overlay("passive")


def test_nothing_is_passive_without_damping() -> None:
    assert passive_curve(theory(damping=0.0)) is None
    assert passive_curve(theory(damping=0.1)) is None, "a dot in a drawing"


def test_measured_limits_have_the_interval_of_their_estimate_or_their_trials() -> None:
    points = (
        BoundaryPoint(damping=0, stable=100, unstable=300, censored=False),
        BoundaryPoint(damping=4, stable=500, unstable=700, censored=False, estimate=590, low=560, high=640),
        BoundaryPoint(damping=8, stable=900, unstable=None, censored=True, low=850),
    )
    curve = measured_curve(experiment("1").model_copy(update={"boundary": points}), open_ends=True)
    assert curve.low is not None
    assert curve.high is not None
    assert curve.low.tolist() == [100, 560, 900]
    assert curve.high[:2].tolist() == [300, 640]
    assert np.isnan(curve.high[2])
    assert measured_curve(experiment("1")).low is None


def test_bound_and_band_are_those_of_the_scores() -> None:
    p = theory().parameters
    bound = BoundScore(
        stiffness=38e3, stiffness_low=37e3, stiffness_high=39e3, slope=230, slope_low=220, slope_high=240,
        damping_low=90, damping_high=150, dampings=15, cut=0.1, p_value=1e-9,
    )  # fmt: skip
    band = BandScore(
        mass=(0.5, 0.6), viscous_damping=(3, 4), delay_samples=(3, 4), damping=(0, 4), low=(90, 400), high=(200, 800),
        points=2, inside=2,
    )  # fmt: skip
    scores = (
        Scores(parameters=p, basis="device file", bound=bound),
        Scores(parameters=p, basis="estimates", band=band),
    )
    result = experiment("1").model_copy(update={"scores": scores})
    line, envelope = bound_curve(result), envelope_curve(result)
    assert line is not None
    assert envelope is not None
    assert line.stiffness.tolist() == [38e3 - 230 * 90, 38e3 - 230 * 150]  # (6.5)
    assert envelope.low is not None
    assert envelope.high is not None
    assert (envelope.low.tolist(), envelope.high.tolist()) == ([90, 400], [200, 800])
    assert bound_curve(experiment("1")) is envelope_curve(experiment("1")) is None


def test_friction_of_one_newton_makes_four_samples_look_like_three() -> None:
    """Limits of 8 N steps on the Falcon, simulated: 7.5, 11.5 and 14 kN/m; an ideal loop with d = 4 has less."""
    ideal, (curve, line) = theory(), friction_curves(theory(), FrictionFacts(1.0, 8.0, 200e-6, "device file"))
    found = np.interp([20.0, 40.0, 60.0], curve.damping, curve.stiffness)
    assert found == pytest.approx([7500, 11500, 14000], rel=0.06)
    without = stiffness_limit(ideal.loop, np.array([20.0]) / ideal.units.damping)[0] * ideal.units.stiffness
    assert found[0] > 1.2 * without
    assert line.stiffness.tolist() == [1e4, 1e4]  # 2 f_c/quantum
    assert [c.label for c in friction_curves(theory(), FrictionFacts(1.0, 8.0, 10e-6, ""))] == [curve.label]


def test_friction_is_that_of_the_device_file_then_that_of_the_logs() -> None:
    falcon = load_device("falcon")
    assert friction_facts(falcon, [experiment("1")]) is None
    estimate = Estimate(value=0.5, low=0.3, high=0.7, unit="N", method="model", reason="")
    result = experiment("1").model_copy(update={"estimates": {"friction": estimate}})
    assert friction_facts(falcon, [result]) == FrictionFacts(0.5, 8.0, falcon.sensor.quantum, "estimated from the logs")
    none = {"friction": estimate.model_copy(update={"low": 0.0})}
    assert friction_facts(falcon, [result.model_copy(update={"estimates": none})]) is None, "its interval holds 0"
    stated = falcon.model_copy(update={"loop": LoopParts(friction=Friction(coulomb=0.2))})
    facts = friction_facts(stated, [result])
    assert facts is not None
    assert (facts.coulomb, facts.source) == (0.2, "device file")


def test_normalised_plane_holds_several_devices_each_with_its_theory() -> None:
    light, heavy = theory(), theory(mass=1.16, damping=8.0)  # twice all: the same loop in alpha and beta
    slow = theory(mass=0.2, damping=0.0, delay=2.0, period=2e-3)
    entries: Any = [(f"device {i}", experiment("1"), t) for i, t in enumerate((light, heavy, slow))]
    figure = plane_figure(entries)
    ((_, curves),) = figure.panels
    assert figure.kind == "plane"
    assert [c.label for c in curves if c.kind == "measured"] == [
        "device 0 (d = 4, δ = 0.0069)",
        "device 1 (d = 4, δ = 0.0069)",
        "device 2 (d = 2, δ = 0)",
    ]
    predicted = [c for c in curves if c.kind == "theory"]
    assert len(predicted) == 3, "each shares the colour of its experiment"
    assert predicted[0].stiffness == pytest.approx(predicted[1].stiffness)
    physical = measured_curve(experiment("1"))
    # alpha = K T^2/m, beta = B T/m (Table 3.1)
    assert curves[2].stiffness == pytest.approx(physical.stiffness * 4e-6 / 0.2)
    assert curves[2].damping == pytest.approx(physical.damping * 2e-3 / 0.2)
    assert normalised(physical, light).stiffness == pytest.approx(2 * normalised(physical, heavy).stiffness)
