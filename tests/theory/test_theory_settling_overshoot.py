"""Settling time and overshoot against a dense simulation that brackets them, between samples and at samples."""

from __future__ import annotations

import math
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from independent import (
    Motion,
    between_points,
    deviation,
    discrete_settling,
    extreme_cases,
    horizon,
    random_loops,
    settling_bracket,
    simulate_many,
    stable_walls,
)

import pipeline.theory.settling_overshoot
from pipeline.base.errors import ParameterError
from pipeline.device.loop import Loop
from pipeline.device.parts import Coefficients
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.boundary import boundary
from pipeline.theory.poles import is_stable, spectral_radius
from pipeline.theory.settling_overshoot import late_deviation, transient_costs

BANDS = (0.01, 0.02, 0.05)
ROUNDING = 1e-9
"""Rounding of a crossing time: 1e-13 of the dense motion over the speed at which the band is crossed."""


def check(case: tuple[float, ...], motion: Motion, costs: dict[str, float], decades: float) -> list[float]:
    """Check every cost of a case of which so many decades of motion are stepped; return the widths of the brackets."""
    stiffness, widths = case[0] + case[4], []
    for band in BANDS:
        name = f"settle_{100 * band:g}pct"
        low, high = settling_bracket(motion, stiffness, band)
        assert low - ROUNDING <= costs[name] <= high + ROUNDING, (name, case)
        assert costs[f"{name}_discrete"] == discrete_settling(motion, stiffness, band), (name, case)
        widths.append(high - low)
    e = deviation(motion, stiffness)
    peak, later = max(e.max(), 0.0), 10 ** (1 - decades)  # of what comes after the simulated horizon
    assert peak - 1e-12 <= costs["overshoot"] <= peak + between_points(motion) + later, case
    sampled = max(e[:: motion.every].max(), 0.0)
    assert costs["overshoot_discrete"] == pytest.approx(sampled, abs=later), case
    return widths


def compare(cases: list[tuple[float, ...]], decades: float, fine: int) -> list[float]:
    """Check cases, the walls of one loop at once; return the widths of all brackets."""
    widths = []
    for (gamma, delta, p, q), group in groupby(cases, key=lambda case: case[:4]):
        walls = list(group)
        costs = transient_costs(NormalisedLoop.ideal(gamma, delta, p / q), *np.array(walls)[:, 4:].T, BANDS)
        motions = simulate_many(walls, [horizon(case, decades) for case in walls], fine=fine)
        for i, (case, motion) in enumerate(zip(walls, motions, strict=True)):
            widths += check(case, motion, {name: float(values[i]) for name, values in costs.items()}, decades)
    return widths


@pytest.mark.slow
def test_random_points() -> None:
    cases = stable_walls(random_loops(60, seed=33), each=5, seed=35, slowest=0.8)
    widths = compare(cases, decades=6.0, fine=12)
    assert len(cases) >= 300
    assert sum(case[2] % case[3] != 0 for case in cases) > 90
    assert np.median(widths) < 2e-2  # the brackets are narrow, or the comparison would not say much


@pytest.mark.slow
def test_points_at_the_ends_of_the_domain() -> None:
    cases = extreme_cases()
    # a strongly damped mass starts with an acceleration of delta or so, which widens the bracket
    damped = compare([case for case in cases if case[1] > 5], decades=7.0, fine=384)
    others = compare([case for case in cases if case[1] <= 5], decades=7.0, fine=16)
    assert len(cases) >= 60
    assert np.median(others + damped) < 2e-2


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
    assert is_stable(NormalisedLoop.ideal(case[0], case[1], case[2] / case[3]), case[4], case[5])[0]
    compare([case], decades=6.0, fine=32)


def test_close_to_the_boundary() -> None:
    loop = NormalisedLoop.ideal(0, 0, 1)
    border = boundary(loop)
    case = (0.0, 0.0, 1, 1, border.alpha_max * 0.98, border.beta_at_alpha_max)
    compare([case], decades=6.0, fine=32)
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
    loop = NormalisedLoop.ideal(*values)
    border = boundary(loop)
    rng = np.random.default_rng(8)
    alpha = -loop.gamma + (border.alpha_max + loop.gamma) * rng.random(300) ** 1.5
    beta = border.beta_max * rng.random(300)
    keep = spectral_radius(loop, alpha, beta) < 1 - 0.08 / (1 + loop.delay)
    alpha, beta = alpha[keep], beta[keep]
    assert len(alpha) > 20
    early = transient_costs(loop, alpha, beta)
    monkeypatch.setattr(pipeline.theory.settling_overshoot, "_SETTLED", 1e-6)
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
    loop = NormalisedLoop.ideal(*plant, d)
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


@pytest.mark.parametrize(
    ("loop", "wall", "band", "true"),
    [
        ((185.4110375532084, 26.652630181637893, 66.0), (0.1221341147932547, 36.553834416624824), 0.01, 203.07),
        ((35.55639058268725, 11.9245440669869, 36.0), (9.307370449038903e-4, -11.652910030716145), 0.02, 151.16),
    ],
)
def test_bursts_behind_a_long_delay_are_met(loop, wall, band, true) -> None:
    """One sample in d + 1 moves: a look at every 16th once missed it, alone (68.3) and among others (136.2, 76.5)."""
    name = f"settle_{100 * band:g}pct"
    found = transient_costs(NormalisedLoop.ideal(*loop), *wall, (band,))
    assert found[name][0] == pytest.approx(true, abs=0.005)
    assert found[f"{name}_discrete"][0] == math.ceil(true)
    first = math.floor(true) - 1
    assert (
        late_deviation(NormalisedLoop.ideal(*loop), *wall, first, 4000)[0]
        > band
        >= late_deviation(NormalisedLoop.ideal(*loop), *wall, first + 2, 4000)[0]
    )


def test_a_search_may_ask_for_less() -> None:
    loop = NormalisedLoop.ideal(0, 0, 1)
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
    # what 64 samples leave open is told by the modes
    slow, followed = (transient_costs(loop, 0.1444, 0.4247, (0.02,), longest=n)["settle_2pct"] for n in (64, 1 << 16))
    assert slow == pytest.approx(followed, rel=1e-9)


def test_a_slow_response_is_told_by_its_modes() -> None:
    loop, alpha, beta = NormalisedLoop.ideal(0, 0.1, 3), 1e-4, 0.01
    # one slow pole carries the response: the closed form of its decay, to the samples that the fast poles last
    slow = -1 / math.log(spectral_radius(loop, alpha, beta)[0])
    found = transient_costs(loop, alpha, beta, (0.02,), longest=8000)
    assert found["settle_2pct"][0] == pytest.approx(slow * math.log(50), abs=15)
    assert found["settle_2pct_discrete"][0] == math.ceil(found["settle_2pct"][0])
    assert found["overshoot"][0] == 0  # to follow that would take ln(1e13)/ln(50) = 7.7 times as long
    sooner = transient_costs(loop, alpha, beta, (0.02,), longest=4000)
    assert sooner["settle_2pct"][0] == pytest.approx(found["settle_2pct"][0], rel=1e-12)


@pytest.mark.parametrize("bands", [(0.0,), (1.0,), (-0.02,), (2.0,), (0.02, math.nan)])
def test_bands_must_be_fractions(bands: tuple[float, ...]) -> None:
    with pytest.raises(ParameterError, match="between 0 and 1"):
        transient_costs(NormalisedLoop.ideal(0, 0, 0), 0.1, 0.5, bands)


@pytest.mark.parametrize(("alpha", "what"), [(0.0, r"alpha \+ gamma > 0"), (-0.1, r"> 0"), (math.nan, "finite")])
def test_points_without_a_final_position_are_refused(alpha: float, what: str) -> None:
    with pytest.raises(ParameterError, match=what):
        transient_costs(NormalisedLoop.ideal(0, 0, 0), alpha, 0.5)


@pytest.mark.parametrize(
    ("loop", "alpha", "beta", "band"),
    [
        (NormalisedLoop.ideal(0, 0.01, 0), 0.19794514, 1.58567338, 0.02),
        (NormalisedLoop.ideal(0, 0.05, 2), 0.01963576, 0.49473666, 0.01),
        (
            NormalisedLoop.of(
                Loop(
                    *(0.6299726022685423, 4.04685746699751, 1e-3, 4.0),
                    velocity=Coefficients(kind="coefficients", b=(0.25, 0.5, 0.25), a=(1.0, -0.8)),
                )
            ),
            *(0.0026778986868248684, 0.013788126921134135),
            0.02,
        ),
    ],
)
def test_a_moment_of_rest_between_two_motions_is_not_the_end(loop, alpha, beta, band):
    """Position and velocity pass zero together where the samples are checked; what is delayed moves them again."""
    wall = (np.array([alpha]), np.array([beta]))
    name = f"settle_{100 * band:g}pct_discrete"
    quick = transient_costs(loop, *wall, (band,), overshoot=False, continuous=False)[name]
    assert quick == transient_costs(loop, *wall, (band,))[name]
    assert (
        late_deviation(loop, *wall, int(quick[0]), 1000) <= band < late_deviation(loop, *wall, int(quick[0]) - 1, 1000)
    )
