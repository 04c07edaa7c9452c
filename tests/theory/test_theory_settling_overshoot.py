"""Settling time and overshoot against a dense simulation that brackets them, between samples and at samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
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
    simulate,
    simulate_many,
    stable_walls,
)

import pipeline.theory.settling_overshoot
from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop, Normalised, loop_of
from pipeline.records.loop_parts import Coefficients, LoopParts
from pipeline.theory.boundary import boundary
from pipeline.theory.poles import is_stable, spectral_radius
from pipeline.theory.settling_overshoot import late_deviation, transient_costs

BANDS = (0.01, 0.02, 0.05)
ROUNDING = 1e-9
"""Rounding of a crossing time: 1e-13 of the dense motion over the speed at which the band is crossed."""


@dataclass
class Seen:
    """Largest deviations: settling time outside of its bracket, width of brackets, overshoot between and at samples."""

    settling: float = 0.0
    widths: list[float] = field(default_factory=list)
    overshoot: float = 0.0
    sampled: float = 0.0


def compare(case: tuple[float, ...], decades: float = 6.0, fine: int = 12) -> float:
    """Check every cost of a case; return the width of the narrowest bracket."""
    gamma, delta, p, q, alpha, beta = case
    motion = simulate(alpha, beta, gamma=gamma, delta=delta, delay=(p, q), samples=horizon(case, decades), fine=fine)
    costs = transient_costs(Loop(gamma, delta, p / q), alpha, beta, BANDS)
    seen = Seen()
    check(case, motion, {name: float(values[0]) for name, values in costs.items()}, decades, seen)
    return min(seen.widths)


def check(case: tuple[float, ...], motion: Motion, costs: dict[str, float], decades: float, seen: Seen) -> None:
    stiffness = case[0] + case[4]
    for band in BANDS:
        name = f"settle_{100 * band:g}pct"
        low, high = settling_bracket(motion, stiffness, band)
        assert low - ROUNDING <= costs[name] <= high + ROUNDING, (name, case)
        assert costs[f"{name}_discrete"] == discrete_settling(motion, stiffness, band), (name, case)
        seen.widths.append(high - low)
        seen.settling = max(seen.settling, costs[name] - high, low - costs[name])
    e = deviation(motion, stiffness)
    peak, later = max(e.max(), 0.0), 10 ** (1 - decades)  # of what comes after the simulated horizon
    assert peak - 1e-12 <= costs["overshoot"] <= peak + between_points(motion) + later, case
    sampled = max(e[:: motion.every].max(), 0.0)
    assert costs["overshoot_discrete"] == pytest.approx(sampled, abs=later), case
    seen.overshoot = max(seen.overshoot, peak - costs["overshoot"], costs["overshoot"] - peak - between_points(motion))
    seen.sampled = max(seen.sampled, abs(costs["overshoot_discrete"] - sampled))


def compare_many(cases: list[tuple[float, ...]], decades: float, fine: int) -> Seen:
    """Check cases, the walls of one loop at once; ``decades`` of motion are stepped."""
    seen = Seen()
    for loop, group in groupby(cases, key=lambda case: case[:4]):
        walls = list(group)
        costs = transient_costs(
            Loop(loop[0], loop[1], loop[2] / loop[3]), [w[4] for w in walls], [w[5] for w in walls], BANDS
        )
        motions = simulate_many(walls, [horizon(case, decades) for case in walls], fine=fine)
        for i, (case, motion) in enumerate(zip(walls, motions, strict=True)):
            check(case, motion, {name: float(values[i]) for name, values in costs.items()}, decades, seen)
    return seen


def note(record_property, kind: str, cases: list[tuple[float, ...]], seen: Seen) -> None:
    record_property(kind, len(cases))
    record_property("median width of brackets", float(np.median(seen.widths)))
    record_property("settling outside of bracket", seen.settling)
    record_property("overshoot outside of bracket", seen.overshoot)
    record_property("overshoot at samples", seen.sampled)


@pytest.mark.slow
def test_random_points(record_property) -> None:
    cases = stable_walls(random_loops(60, seed=33), each=5, seed=35, slowest=0.8)
    seen = compare_many(cases, decades=6.0, fine=12)
    note(record_property, "random", cases, seen)
    assert len(cases) >= 300
    assert sum(case[2] % case[3] != 0 for case in cases) > 90
    assert np.median(seen.widths) < 2e-2  # the brackets are narrow, or the comparison would not say much


@pytest.mark.slow
def test_many_random_points(record_property) -> None:
    cases = stable_walls(random_loops(400, seed=34), each=1, seed=36)
    seen = compare_many(cases, decades=13.0, fine=16)
    note(record_property, "random", cases, seen)
    assert len(cases) >= 390


@pytest.mark.slow
def test_points_at_the_ends_of_the_domain(record_property) -> None:
    cases = extreme_cases()
    # a strongly damped mass starts with an acceleration of delta or so, which widens the bracket
    damped = compare_many([case for case in cases if case[1] > 5], decades=7.0, fine=384)
    seen = compare_many([case for case in cases if case[1] <= 5], decades=7.0, fine=16)
    note(record_property, "extreme", cases, seen)
    note(record_property, "of these strongly damped", [case for case in cases if case[1] > 5], damped)
    assert len(cases) >= 60
    assert np.median(seen.widths + damped.widths) < 2e-2


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
    found = transient_costs(Loop(*loop), *wall, (band,))
    assert found[name][0] == pytest.approx(true, abs=0.005)
    assert found[f"{name}_discrete"][0] == math.ceil(true)
    first = math.floor(true) - 1
    assert (
        late_deviation(Loop(*loop), *wall, first, 4000)[0]
        > band
        >= late_deviation(Loop(*loop), *wall, first + 2, 4000)[0]
    )


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
    # what 64 samples leave open is told by the modes
    slow, followed = (transient_costs(loop, 0.1444, 0.4247, (0.02,), longest=n)["settle_2pct"] for n in (64, 1 << 16))
    assert slow == pytest.approx(followed, rel=1e-9)


def test_a_slow_response_is_told_by_its_modes() -> None:
    loop, alpha, beta = Loop(0, 0.1, 3), 1e-4, 0.01
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
        transient_costs(Loop(0, 0, 0), 0.1, 0.5, bands)


@pytest.mark.parametrize(("alpha", "what"), [(0.0, r"alpha \+ gamma > 0"), (-0.1, r"> 0"), (math.nan, "finite")])
def test_points_without_a_final_position_are_refused(alpha: float, what: str) -> None:
    with pytest.raises(ParameterError, match=what):
        transient_costs(Loop(0, 0, 0), alpha, 0.5)


@pytest.mark.parametrize(
    ("loop", "alpha", "beta", "band"),
    [
        (Loop(0, 0.01, 0), 0.19794514, 1.58567338, 0.02),
        (Loop(0, 0.05, 2), 0.01963576, 0.49473666, 0.01),
        (
            loop_of(
                *(0.6299726022685423, 4.04685746699751, 0.0, 4.0, 1e-3),
                LoopParts(velocity=Coefficients(kind="coefficients", b=(0.25, 0.5, 0.25), a=(1.0, -0.8))),
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
