"""What limits a device, and why its region is smaller or larger than that of theory, by an independent loop."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from state_matrix import largest_stable

import pipeline
from pipeline.comparison.loops.loop_basis import LoopBasis
from pipeline.comparison.loops.sensitivity import region_causes, sensitivities
from pipeline.device.loop import Loop
from pipeline.device.parts import Butterworth, Friction
from pipeline.measured.experiment.identified_loop import nominal_loop
from pipeline.records.findings import BoundaryPoint, Limit
from pipeline.records.results import MeasuredExperiment

NUMBERS = {"mass": 0.58, "damping": 4.0, "sampling_period_s": 1e-3}
FILTER = Butterworth(kind="butterworth", order=1, cutoff_hz=60.0)
B = np.arange(0.0, 100.0, 10.0)


def stiffest(**parts) -> float:
    """Largest stable stiffness over all dampings, by eigenvalues of an independent loop."""
    loop = pipeline.Loop(**NUMBERS | parts)
    found = minimize_scalar(
        lambda damping: -largest_stable(loop, damping, 60_000.0, 60), bounds=(20.0, 250.0), method="bounded"
    )
    return -found.fun


def experiment(limits=None) -> MeasuredExperiment:
    """An experiment whose limits are far above those of every loop, so that no region is cut off."""
    points = tuple(
        BoundaryPoint(damping=b, stable=9e4, unstable=9.1e4, censored=False, estimate=9e4, low=9e4, high=9.1e4)
        for b in B.tolist()
    )
    return MeasuredExperiment.model_construct(boundary=points if limits is None else limits)


@pytest.mark.parametrize(
    ("parts", "code", "without"),
    [
        ({"delay_samples": 3.0}, "delay", {"delay_samples": 2.0}),
        ({"delay_samples": 3.0}, "damping", {"delay_samples": 3.0, "damping": 0.0}),
        ({"delay_samples": 2.0, "velocity": FILTER}, "velocity_filter", {"delay_samples": 2.0}),
        ({"delay_samples": 2.0, "actuator_lag_s": 1.5e-3}, "actuator_lag", {"delay_samples": 2.0}),
    ],
)
def test_a_sensitivity_is_that_of_an_independent_loop(parts, code, without):
    found = {each.code: each.percent for each in sensitivities(Loop(**NUMBERS | parts), ())}
    assert found[code] == pytest.approx(100 * (stiffest(**without) / stiffest(**parts) - 1), abs=0.5)


def test_parts_that_a_loop_lacks_have_no_sensitivity():
    loop = Loop(**NUMBERS | {"damping": 0.0, "delay_samples": 0.5})
    assert sensitivities(loop, ()) == ()


def test_friction_is_compared_by_the_limits_for_the_step():
    loop = Loop(**NUMBERS, delay_samples=3.0, friction=Friction(coulomb=0.5))
    limits = [
        Limit(damping=b, stiffness=k, low=k, high=k, stiffness_large_motion=0.8 * k)
        for b, k in ((0.0, 2000.0), (40.0, 10_000.0))
    ]
    found = {each.code: each.percent for each in sensitivities(loop, limits)}
    assert found["friction"] == pytest.approx(-20.0)
    jittering = {each.code: each.percent for each in sensitivities(Loop(**NUMBERS, delay_samples=3.0), limits)}
    assert "friction" not in jittering
    assert jittering["delay_jitter"] == pytest.approx(-20.0)


def area(**parts) -> float:
    """Area below the limits of an independent loop at the tested dampings."""
    loop = pipeline.Loop(**NUMBERS | parts)
    return float(np.trapezoid([largest_stable(loop, b, 60_000.0, 60) for b in B.tolist()], B))


def basis_of(**parts) -> LoopBasis:
    return LoopBasis(nominal_loop(Loop(**NUMBERS | parts)))


@pytest.mark.parametrize(
    ("logs", "code"),
    [
        ({"delay_samples": 4.5}, "delay"),
        ({"delay_samples": 3.0, "mass": 0.4}, "mass"),
        ({"delay_samples": 3.0, "damping": 9.0}, "damping"),
        ({"delay_samples": 3.0, "velocity": FILTER}, "velocity_filter"),
        ({"delay_samples": 3.0, "actuator_lag_s": 1e-3}, "delay"),
    ],
    ids=["delay", "mass", "damping", "filter", "lag"],
)
def test_the_only_number_that_differs_explains_the_whole_change(logs, code):
    found = region_causes(experiment(), Loop(**NUMBERS, delay_samples=3.0), basis_of(**logs), ())
    expected = 100 * (area(**logs) / area(delay_samples=3.0) - 1)
    assert [each.code for each in found.changes] == [code]
    assert found.changes[0].percent == pytest.approx(found.together_percent, abs=1e-9)
    assert found.together_percent == pytest.approx(expected, abs=0.1)


def test_logs_that_agree_with_the_file_change_nothing():
    stated = Loop(**NUMBERS, delay_samples=3.0)
    found = region_causes(experiment(), stated, basis_of(delay_samples=3.0), ())
    assert (found.changes, found.together_percent) == ((), 0.0)


def test_walls_that_were_not_tested_do_not_count():
    """A shorter delay enlarges the region only above the end of the tested range."""
    low = tuple(BoundaryPoint(damping=b, stable=500.0, unstable=None, censored=True) for b in (20.0, 40.0, 60.0))
    stated = Loop(**NUMBERS, delay_samples=3.0)
    found = region_causes(experiment(low), stated, basis_of(delay_samples=2.0), ())
    assert found.changes[0].percent == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("missing", ["file", "device", "limits"])
def test_without_a_file_a_device_or_limits_there_are_no_causes(missing):
    stated, basis = Loop(**NUMBERS, delay_samples=3.0), basis_of(delay_samples=4.0)
    if missing == "device":
        basis = LoopBasis(None, nominal_loop(stated))
    result = experiment(()) if missing == "limits" else experiment()
    assert region_causes(result, None if missing == "file" else stated, basis, ()) is None


def test_friction_changes_the_area_by_the_limits_for_the_step():
    limits = [Limit(damping=b, stiffness=1500.0, low=1, high=9, stiffness_large_motion=1000.0) for b in B.tolist()]
    friction = {"delay_samples": 3.0, "friction": Friction(coulomb=0.5)}
    found = region_causes(experiment(), Loop(**NUMBERS, delay_samples=3.0), basis_of(**friction), limits)
    assert [(each.code, each.percent) for each in found.changes] == [("friction", pytest.approx(50.0))]
    assert found.together_percent == pytest.approx(50.0)
