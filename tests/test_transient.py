"""Settling time and overshoot against a dense simulation that brackets them, between samples and at samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from independent import (
    between_points,
    deviation,
    discrete_settling,
    horizon,
    settling_bracket,
    simulate,
    stable_cases,
)

import pipeline.transient
from pipeline.errors import ParameterError
from pipeline.loop import Loop, Normalised
from pipeline.stability import boundary, is_stable, spectral_radius
from pipeline.transient import transient_costs

BANDS = (0.01, 0.02, 0.05)
ROUNDING = 1e-9
"""Rounding of a crossing time: 1e-13 of the dense motion over the speed at which the band is crossed."""


def compare(case: tuple[float, ...], decades: float = 6.0, fine: int = 12) -> float:
    """Check every cost of a case; return the width of the narrowest bracket."""
    gamma, delta, p, q, alpha, beta = case
    motion = simulate(alpha, beta, gamma=gamma, delta=delta, delay=(p, q), samples=horizon(case, decades), fine=fine)
    costs = transient_costs(Loop(gamma, delta, p / q), alpha, beta, BANDS)
    stiffness, widths = alpha + gamma, []
    for band in BANDS:
        name = f"settle_{100 * band:g}pct"
        low, high = settling_bracket(motion, stiffness, band)
        assert low - ROUNDING <= costs[name][0] <= high + ROUNDING, (name, case)
        assert costs[f"{name}_discrete"][0] == discrete_settling(motion, stiffness, band), (name, case)
        widths.append(high - low)
    e = deviation(motion, stiffness)
    peak, later = max(e.max(), 0.0), 10 ** (1 - decades)  # of what comes after the simulated horizon
    assert peak - 1e-12 <= costs["overshoot"][0] <= peak + between_points(motion) + later, case
    assert costs["overshoot_discrete"][0] == pytest.approx(max(e[:: motion.every].max(), 0.0), abs=later), case
    return min(widths)


def test_random_points() -> None:
    cases = stable_cases(40, seed=33, slowest=0.8)
    assert sum(case[3] > 1 for case in cases) > 12
    widths = [compare(case) for case in cases]
    assert np.median(widths) < 2e-2  # the brackets are narrow, or the comparison would not say much


@pytest.mark.slow
def test_many_random_points() -> None:
    for case in stable_cases(400, seed=34):
        compare(case, decades=13.0, fine=16)


@pytest.mark.parametrize(
    "case",
    [
        (0.0, 0.0, 0, 1, 0.18, 0.57),
        (0.0, 0.0, 16, 1, 0.00062, 0.037),
        (0.0, 0.0, 64, 1, 4.4e-5, 0.0097),
        (0.0, 0.0, 129, 2, 4.4e-5, 0.0097),
        (1e-15, 1e-15, 1, 1, 0.045, 0.3),
        (0.0, 10.0, 2, 1, 1.0, 1.0),
        (0.0, 10.0, 1, 3, 12.0, 4.0),
        (9.0, 0.5, 0, 1, -0.5, 0.6),
        (25.0, 10.0, 0, 1, 3.0, 1.0),
        (0.0, 0.0, 1, 3, 1e-2, 1.0),
    ],
)
def test_extreme_points(case: tuple[float, ...]) -> None:
    assert is_stable(Loop(case[0], case[1], case[2] / case[3]), case[4], case[5])[0]
    compare(case, fine=32)


def test_close_to_the_boundary() -> None:
    loop = Loop(0, 0, 1)
    border = boundary(loop)
    case = (0.0, 0.0, 1, 1, border.alpha_max * 0.98, border.beta_at_alpha_max)
    compare(case, fine=32)
    # nearer still, the envelope r^k alone says how long it takes
    alpha = border.alpha_max * (1 - 4e-3)
    costs = transient_costs(loop, alpha, border.beta_at_alpha_max, (0.01, 0.05), overshoot=False)
    radius = spectral_radius(loop, alpha, border.beta_at_alpha_max)[0]
    between = costs["settle_1pct"][0] - costs["settle_5pct"][0]
    assert between == pytest.approx(math.log(5) / -math.log(radius), rel=1e-3)


@pytest.mark.parametrize("values", [(0, 0, 0), (0, 0, 2), (0.001, 0.02, 3.5), (0.05, 0, 5), (0.3, 0.3, 8), (0, 0, 14)])
def test_ending_a_response_early_changes_nothing(
    values: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Loop(*values)
    border = boundary(loop)
    rng = np.random.default_rng(8)
    alpha = -loop.gamma + (border.alpha_max + loop.gamma) * rng.random(300) ** 1.5
    beta = border.beta_max * rng.random(300)
    keep = spectral_radius(loop, alpha, beta) < 1 - 0.08 / (1 + loop.delay)
    alpha, beta = alpha[keep], beta[keep]
    assert len(alpha) > 20
    early = transient_costs(loop, alpha, beta)
    monkeypatch.setattr(pipeline.transient, "_SETTLED", 1e-6)
    late = transient_costs(loop, alpha, beta, quiet=1e-15)
    for name, values_ in early.items():
        np.testing.assert_allclose(values_, late[name], rtol=1e-12, atol=1e-12, err_msg=name)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.sampled_from([0.0, 0.25, 1.0, 1.5, 2.0, 4.0]),
    st.sampled_from([(0.0, 0.0), (0.001, 0.02), (0.2, 0.1), (0.0, 10.0)]),
    st.floats(0.05, 1.0),
    st.floats(0.0, 1.0),
    st.floats(0.005, 0.5),
)
def test_samples_never_settle_later_or_overshoot_more_than_the_motion(
    d: float, plant: tuple[float, float], across: float, along: float, band: float
) -> None:
    loop = Loop(*plant, d)
    border = boundary(loop, 50)
    alpha = -loop.gamma + across * (border.alpha_max + loop.gamma)
    beta = border.beta.min() + along * (border.beta_max - border.beta.min())
    if alpha + loop.gamma <= 1e-6 or spectral_radius(loop, alpha, beta)[0] > 0.995:
        return
    costs = transient_costs(loop, alpha, beta, (band,))
    name = f"settle_{100 * band:g}pct"
    assert costs[f"{name}_discrete"][0] <= math.ceil(costs[name][0])  # (5.11)
    assert costs["overshoot_discrete"][0] <= costs["overshoot"][0]
    assert costs["overshoot"][0] >= 0


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.floats(1e-3, 1e3), st.floats(1e-5, 1.0), st.sampled_from([(0, 1), (1, 1), (3, 2)]))
def test_physical_responses_scale_with_mass_and_period(mass: float, period: float, delay: tuple[int, int]) -> None:
    d = delay[0] / delay[1]
    unit = Normalised(mass, period)
    stiffness, damping = 0.25 / (1 + d) ** 2 * mass / period**2, 0.7 / (1 + d) * mass / period
    motion = simulate(stiffness, damping, delay=delay, samples=150, mass=mass, period=period, fine=32)
    costs = transient_costs(Loop(0, 0, d), stiffness / unit.stiffness, damping / unit.damping, (0.02,))
    low, high = settling_bracket(motion, stiffness, 0.02)
    assert low - ROUNDING <= costs["settle_2pct"][0] <= high + ROUNDING
    assert costs["overshoot"][0] == pytest.approx(
        max(deviation(motion, stiffness).max(), 0), abs=between_points(motion)
    )


def test_many_points_at_once_are_the_single_points() -> None:
    loop = Loop(0.001, 0.02, 1.5)
    rng = np.random.default_rng(4)
    alpha, beta = rng.uniform(0.01, 0.06, 40), rng.uniform(0.15, 0.4, 40)
    keep = is_stable(loop, alpha, beta)
    together = transient_costs(loop, alpha[keep], beta[keep])
    for i, (a, b) in enumerate(zip(alpha[keep], beta[keep], strict=True)):
        for name, value in transient_costs(loop, a, b).items():
            assert value[0] == pytest.approx(together[name][i], rel=1e-13, abs=1e-14), name


def test_a_search_may_ask_for_less() -> None:
    loop = Loop(0, 0, 1)
    alpha, beta = np.array([0.0449, 0.10, 0.13]), np.array([0.3037, 0.40, 0.42])
    full = transient_costs(loop, alpha, beta)
    assert not {"overshoot", "overshoot_discrete"} & set(transient_costs(loop, alpha, beta, overshoot=False))
    assert set(transient_costs(loop, alpha, beta, (0.02,), overshoot=False, continuous=False)) == {
        "settle_2pct_discrete"
    }
    cut = transient_costs(loop, alpha, beta, (0.02,), overshoot=False, cutoff=15)
    late = full["settle_2pct"] > 17
    assert late.any()
    assert not late.all()
    np.testing.assert_array_equal(cut["settle_2pct"][~late], full["settle_2pct"][~late])
    assert np.isnan(cut["settle_2pct"][late]).all()
    unfinished = transient_costs(loop, 0.1444, 0.4247, (0.02,), longest=50)
    assert np.isnan(unfinished["settle_2pct"]).all()
    assert np.isnan(unfinished["overshoot"]).all()


@pytest.mark.parametrize("bands", [(0.0,), (1.0,), (-0.02,), (2.0,), (0.02, math.nan)])
def test_bands_must_be_fractions(bands: tuple[float, ...]) -> None:
    with pytest.raises(ParameterError, match="between 0 and 1"):
        transient_costs(Loop(0, 0, 0), 0.1, 0.5, bands)


@pytest.mark.parametrize(("alpha", "what"), [(0.0, r"alpha \+ gamma > 0"), (-0.1, r"> 0"), (math.nan, "finite")])
def test_points_without_a_final_position_are_refused(alpha: float, what: str) -> None:
    with pytest.raises(ParameterError, match=what):
        transient_costs(Loop(0, 0, 0), alpha, 0.5)
