"""Rules of thumb against continuous-time poles, the critical oscillation and printed scaling factors."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from independent import characteristic, random_loops, stable_by_schur_cohn

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.optimum import marked_point, scaling_factor


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("criterion", "printed"),
    [("pole_radius", 6.84), ("energy_step_w1", 4.4), ("settle_5pct", 3.77), ("settle_1pct", 5.81)],
)
def test_scaling_factors(criterion: str, printed: float) -> None:
    assert scaling_factor(criterion) == pytest.approx(printed, abs=0.0101)  # 5.4.2, printed with "about"


@pytest.mark.parametrize(("delay", "period"), [(0, 4), (1, 8), (2, 12), (0.5, None), (5, 24)])
@pytest.mark.parametrize("plant", [(0.0, 0.0), (0.001, 0.02)])
def test_ziegler_nichols_from_the_critical_oscillation(delay: float, period: float, plant: tuple[float, float]) -> None:
    loop = NormalisedLoop.ideal(*plant, delay)
    point, top = marked_point(loop, "ziegler_nichols"), marked_point(loop, "beta_max")
    assert point.beta == pytest.approx(0.45 * top.beta, rel=1e-12)
    found = 0.54 * top.beta / point.alpha
    if period and plant == (0.0, 0.0):
        assert found == pytest.approx(period, rel=1e-6)
    # at the critical gain the characteristic polynomial has a root on the unit circle at the angle of that period
    polynomial = [float(c) for c in characteristic(*plant, delay, top.alpha, top.beta)]
    roots = np.roots(polynomial)
    assert np.abs(roots - np.exp(2j * np.pi / found)).min() < 1e-6


@pytest.mark.slow
def test_ziegler_nichols_of_random_and_extreme_loops() -> None:
    random = random_loops(300, seed=31)
    extreme = [
        (gamma, delta, p, q)
        for gamma, delta in [(0.0, 0.0), (1e-16, 0.0), (1e-16, 1e-16), (1e-6, 2e-3), (1e-6, 2e-3 * (1 + 1e-12))]
        for p, q in [
            *((0, 1), (1, 8), (1, 2), (999, 1000), (1, 1), (1001, 1000)),
            *((3, 1), (7, 2), (8, 1), (12, 1), (33, 2), (32, 1)),
        ]
    ]
    for gamma, delta, p, q in random + extreme:
        loop = NormalisedLoop.ideal(gamma, delta, p / q)
        point, top = marked_point(loop, "ziegler_nichols"), marked_point(loop, "beta_max")
        assert point.beta == pytest.approx(0.45 * top.beta, rel=1e-13)
        angle = 2 * math.pi * point.alpha / (0.54 * top.beta)
        polynomial = characteristic(gamma, delta, p / q, top.alpha, top.beta)
        # the wall of largest damping oscillates with that period: a root on the unit circle next to that angle
        with mp.workdps(50):
            z, slope, value = mp.expj(angle), mp.mpf(0), mp.mpf(0)
            for coefficient in polynomial:
                slope, value = slope * z + value, value * z + coefficient
            away = float(abs(value / slope))
        # without delay it lies at z = -1, which the closed form stops 1e-7 short of
        assert away < (1e-10 if p / q >= 0.5 else 1e-6), (gamma, delta, p, q)
        # and no other root has left the circle
        assert stable_by_schur_cohn(polynomial, 1 + 1e-6), (gamma, delta, p, q)
    assert len(extreme) >= 60


def test_points_of_table_c2() -> None:
    for name, alpha, beta in (
        ("alpha_max", 0.1445, 0.4247),
        ("beta_max", 0.0, 0.8284),
        ("ziegler_nichols", 0.056, 0.373),
    ):
        found = marked_point(NormalisedLoop.ideal(0, 0, 1), name)
        assert (found.alpha, found.beta) == pytest.approx((alpha, beta), abs=5e-4 if name[0] == "z" else 5e-5)


def test_wrong_use_is_refused() -> None:
    loop = NormalisedLoop.ideal(0.1, 0, 1)
    with pytest.raises(ParameterError, match="expected one of"):
        marked_point(loop, "gamma_max")
    for criterion in ("damping", "overshoot", "overshoot_discrete"):
        with pytest.raises(ParameterError, match="does not depend on delay"):
            scaling_factor(criterion, 1.0, 0.1)
