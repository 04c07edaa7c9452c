"""Delays and lines that measured boundaries stand for, on boundaries by eigenvalues of an independent loop."""

from __future__ import annotations

import numpy as np
import pytest
import simulated

from pipeline.comparison.loops.boundary_shape import implied_delay, straight_bound
from pipeline.comparison.loops.loop_basis import LoopBasis
from pipeline.device.loop import Loop
from pipeline.measured.experiment.identified_loop import nominal_loop
from pipeline.planning.loop_limits import linear_limits
from pipeline.records.findings import BoundaryPoint
from pipeline.records.results import MeasuredExperiment

MASS, DAMPING, T = 0.58, 4.0, 1e-3


def basis_of(**more) -> LoopBasis:
    loop = Loop(mass=MASS, damping=DAMPING, sampling_period_s=T, delay_samples=0.0).replace(more)
    return LoopBasis(None, nominal_loop(loop))


def result_of(damping, limits, error) -> MeasuredExperiment:
    reach = 1.96 * error
    points = tuple(
        BoundaryPoint(
            damping=float(b),
            stable=float(k - r),
            unstable=float(k + r),
            censored=False,
            estimate=float(k),
            low=float(k - r),
            high=float(k + r),
        )
        for b, k, r in zip(damping, limits, np.broadcast_to(reach, np.shape(limits)), strict=True)
    )
    return MeasuredExperiment.model_construct(boundary=points)


def limit_by_eigenvalues(damping: float, delay: int) -> float:
    low, high = 0.0, 40_000.0
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        radius = simulated.spectral_radius(middle, damping, mass=MASS, b=DAMPING, delay=delay, T=T)
        low, high = (middle, high) if radius < 1 else (low, middle)
    return low


@pytest.mark.parametrize("delay", [2, 4, 7])
def test_a_boundary_stands_for_the_delay_that_it_was_made_with(delay):
    damping = np.linspace(2.0, 0.6 * MASS / T / (delay + 1), 14)
    limits = np.array([limit_by_eigenvalues(b, delay) for b in damping])
    found = implied_delay(result_of(damping, limits, 1e-4 * limits), basis_of())
    assert found.origin.value == pytest.approx(delay, abs=1e-3)
    assert found.whole.value == pytest.approx(delay, abs=1e-3)
    assert found.whole.low < delay < found.whole.high


@pytest.mark.slow
def test_intervals_hold_the_delay_in_95_of_100_noisy_boundaries():
    damping = np.linspace(5.0, 150.0, 10)
    true = linear_limits(Loop(mass=MASS, damping=DAMPING, sampling_period_s=T, delay_samples=3.4), damping)
    error, rng, basis = 0.02 * true, np.random.default_rng(5), basis_of()
    held = []
    for _ in range(80):
        found = implied_delay(result_of(damping, true + error * rng.standard_normal(10), error), basis)
        held.append([q.low <= 3.4 <= q.high for q in (found.origin, found.whole)])
    assert (np.mean(held, axis=0) > 0.89).all()
    assert (np.mean(held, axis=0) < 1.0).all()


def test_a_lag_stands_for_a_longer_delay():
    damping = np.linspace(5.0, 100.0, 12)
    lagging = Loop(mass=MASS, damping=DAMPING, sampling_period_s=T, delay_samples=2.0, actuator_lag_s=1.5 * T)
    limits = linear_limits(lagging, damping)
    found = implied_delay(result_of(damping, limits, 0.01 * limits), basis_of(actuator_lag_s=1.5 * T))
    assert 3.3 < found.origin.value < 3.7


def test_few_limits_tell_no_delay_and_no_line():
    found = implied_delay(result_of([5.0, 10.0], [900.0, 1900.0], 10.0), basis_of())
    assert found.whole.value is None
    assert "2 such limits" in found.whole.reason
    assert straight_bound(result_of([5.0, 10.0], [900.0, 1900.0], 10.0), basis_of()) is None
    assert implied_delay(result_of([], [], 1.0), None).origin.reason


def test_a_straight_upper_part_is_found_and_excludes_the_curvature_of_theory():
    damping = np.linspace(40.0, 155.0, 24)
    theory = linear_limits(Loop(mass=MASS, damping=DAMPING, sampling_period_s=T, delay_samples=3.0), damping)
    limits = np.minimum(theory, 38_000 - 230 * damping)
    noisy = limits + 60 * np.random.default_rng(3).standard_normal(24)
    found = straight_bound(result_of(damping, noisy, 60.0), basis_of(delay_samples=3.0))
    assert found.slope_low < -230 < found.slope_high
    assert found.stiffness == pytest.approx(38_000, rel=0.02)
    assert found.excludes_theory
    curved = straight_bound(result_of(damping, theory, 60.0), basis_of(delay_samples=3.0))
    assert not curved.excludes_theory
    assert curved.curvature == pytest.approx(curved.curvature_theory, rel=1e-6)


def test_a_few_precise_limits_of_a_curve_do_not_lead_its_line_past_the_others():
    damping = np.linspace(90.0, 160.0, 15)
    limits = 15_000 - 3.0 * (damping - 90) ** 2
    error = np.where(damping < 110, 5.0, 200.0)
    found = straight_bound(result_of(damping, limits, error), None)
    slope, stiffness = np.polyfit(damping, limits, 1)
    assert found.slope == pytest.approx(slope, rel=0.02)
    assert found.stiffness == pytest.approx(stiffness, rel=0.02)
    assert found.slope_low < slope < found.slope_high


def test_curvatures_are_compared_where_theory_has_a_stable_wall():
    """Numpy's own fit at the common dampings is the second method. The limits go on where those of theory end."""
    damping = np.linspace(130.0, 205.0, 6)
    shorter = Loop(mass=MASS, damping=DAMPING, sampling_period_s=T, delay_samples=3.0)
    theory = linear_limits(shorter.replace({"delay_samples": 4.0}), damping)
    stable = theory > 0
    assert 4 <= stable.sum() < 6
    limits = linear_limits(shorter, damping)
    assert limits.argmax() == 0
    found = straight_bound(result_of(damping, limits, 1.0), basis_of(delay_samples=4.0))
    assert found.curvature_last == damping[stable].max() < found.damping_last
    for measured, name in ((limits, "curvature"), (theory, "curvature_theory")):
        fit = np.polynomial.Polynomial.fit(damping[stable], measured[stable], 2).convert()
        assert getattr(found, name) == pytest.approx(fit.coef[2], rel=1e-6)


def test_without_four_limits_of_theory_only_the_measured_curvature_is_known():
    damping = np.linspace(140.0, 300.0, 6)
    found = straight_bound(result_of(damping, 40_000 - 100 * damping, 50.0), basis_of(delay_samples=4.0))
    assert found.is_straight
    assert (found.curvature_theory, found.excludes_theory) == (None, None)
