"""Verdicts, limits and sizes against eigenvalues, Schur-Cohn in many digits, dense grids and the printed tables."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from independent import characteristic, random_loops, stable_by_schur_cohn
from test_extent import EXTREME, damping_range, stiffest_point

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.theory.boundary import is_inside, robust_limits, stiffness_limit
from pipeline.theory.circle import first_branch
from pipeline.theory.crossings import stretches
from pipeline.theory.poles import spectral_radius

NYQUIST = math.pi**2
ORDINARY = [(0, 0, 0), (0, 0, 1), (0.001, 0.02, 2), (0, 0, 0.5), (1e-3, 0.1, 2.75), (0, 0, 16), (0, 10, 2), (0, 0, 256)]
RESONANT = [(1.0, 0.1, 2.5), (5.0, 1.0, 1), (0.3, 0.05, 4), (9.8, 0.0, 1), (20.0, 10.0, 2), (0.0, 10.0, 0)]


def random_loop(rng: np.random.Generator) -> Loop:
    d = float(rng.choice([0, 1, 2, 7, 16, rng.uniform(0, 4), rng.uniform(0, 1)]))
    delta = float(rng.choice([0, 1e-14, 1e-6, 0.02, 10, 50, rng.uniform(0, 3)]))
    swing = delta**2 / 4
    gamma = float(
        rng.choice([0, 1e-12, 1e-3, rng.uniform(0, 9), rng.uniform(0, 2), NYQUIST * (1 - 1e-12)])
        if rng.random() < 0.8
        else rng.choice([swing + 0.9 * NYQUIST, swing * rng.uniform()])
    )
    return Loop(min(gamma, NYQUIST + swing), delta, d)


def test_verdicts_of_random_loops_against_eigenvalues() -> None:
    rng = np.random.default_rng(5)
    checked, kinds = 0, set()
    for _ in range(120):
        loop, n = random_loop(rng), 40
        scale = np.where(rng.random(n) < 0.3, 1e-2, 1.0)
        room = 0.7 / (1 + loop.delay) ** 2 * (1 + loop.delta) + loop.gamma * (rng.random(n) < 0.5)
        alpha = -loop.gamma + rng.uniform(-0.2, 1.5, n) * scale * room
        beta = rng.uniform(-1, 1.3, n) * scale / (0.5 + loop.delay) * (1 + loop.delta)
        alpha[:10], beta[:10] = rng.uniform(-1, 1, (2, 10)) * 1e-3
        radius = spectral_radius(loop, alpha, beta)
        sure = np.abs(radius - 1) > 1e-7  # eigenvalues of nearly double poles are good to the root of rounding
        got = is_inside(loop, alpha, beta)
        np.testing.assert_array_equal(got[sure], radius[sure] < 1, str(loop))
        checked += int(sure.sum())
        kinds |= {(first_branch(loop) is None, bool(value)) for value in got[sure]}
    assert checked > 4000
    assert len(kinds) == 4  # stable and unstable points, of ordinary loops and of those that need all branches


def shares_of_damping(loops: list[Loop], seed: int) -> list[float]:
    """A random damping within the stable range of each loop."""
    rng = np.random.default_rng(seed)
    result = []
    for loop in loops:
        low, high = damping_range(loop)
        result.append(low + (high - low) * float(rng.uniform(0.02, 0.98)))
    return result


@pytest.mark.slow
def test_limits_are_met_to_1e_10_by_polynomials_in_many_digits(record_property) -> None:
    random = [Loop(g, delta, p / q) for g, delta, p, q in random_loops(300, seed=14)]
    loops, checked = random + EXTREME, 0
    for loop, beta in zip(loops, shares_of_damping(loops, 15), strict=True):
        limit = float(stiffness_limit(loop, beta)[0])
        if limit == -math.inf:
            assert first_branch(loop) is None  # regions of several parts have gaps
            continue
        step = 1e-10 * (limit + loop.gamma)
        for place, stable in ((limit - step, True), (limit + step, False)):
            values = loop.gamma, loop.delta, loop.delay, place, beta
            assert stable_by_schur_cohn(characteristic(*values)) == stable, values
            assert is_inside(loop, place, beta)[0] == stable
        checked += 1
    assert checked >= len(loops) - 15
    record_property("random", len(random))
    record_property("extreme", len(EXTREME))
    record_property("deviation", 1e-10)
    assert len(EXTREME) >= 60
    assert sum(loop.delay % 1 != 0 for loop in random) >= 100


@pytest.mark.slow
def test_verdicts_against_polynomials_in_many_digits(record_property) -> None:
    rng = np.random.default_rng(16)
    random = [Loop(g, delta, p / q) for g, delta, p, q in random_loops(300, seed=17)]
    verdicts = {True: 0, False: 0}
    for loop in random + EXTREME[:66]:
        room = (1 + loop.delta) / (1 + loop.delay)
        tiny = loop in EXTREME and rng.random() < 0.5
        alpha = 1e-11 if tiny else float(rng.uniform(-0.3, 1) * room / (1 + loop.delay)) - loop.gamma * rng.integers(2)
        beta = 1e-11 if tiny else float(rng.uniform(-0.2, 1.2) * room)
        exact = stable_by_schur_cohn(characteristic(loop.gamma, loop.delta, loop.delay, alpha, beta))
        assert is_inside(loop, alpha, beta)[0] == exact, (loop, alpha, beta)
        verdicts[exact] += 1
    record_property("random", len(random))
    record_property("extreme", 66)
    assert min(verdicts.values()) > 80


@pytest.mark.parametrize("d", [0, 1, 2])
@pytest.mark.parametrize("delta", [0.0, 1e-13, 0.3])
def test_verdicts_where_the_plant_swings_half_as_fast_as_it_is_sampled(d: int, delta: float) -> None:
    gamma = NYQUIST * (1 - 1e-12)
    loop = Loop(gamma, delta, d)
    for size in (1e-11, 1e-6, 0.1):
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1), (3, -1), (-3, 1), (0.1, 0), (0, -0.1)):
            exact = stable_by_schur_cohn(characteristic(gamma, delta, d, a * size, b * size))
            assert is_inside(loop, a * size, b * size)[0] == exact, (loop, a * size, b * size)


@pytest.mark.parametrize("values", ORDINARY[:-1])
def test_verdicts_at_a_distance_of_1e_12(values: tuple[float, float, float]) -> None:
    loop = Loop(*values)
    low, high = damping_range(loop)
    for share in (0.02, 0.4, 0.9):
        beta = low + share * (high - low)
        limit = stiffness_limit(loop, beta)[0]
        step = 1e-11 * (limit + loop.gamma)
        if loop.states < 12:
            assert stable_by_schur_cohn(characteristic(*values, limit - step, beta))
            assert not stable_by_schur_cohn(characteristic(*values, limit + step, beta))
        np.testing.assert_array_equal(is_inside(loop, [limit - step, limit + step], beta), [True, False])


def exact_limit(d: int, beta: float, start: float) -> mp.mpf:
    """Boundary of gamma = delta = 0, 4 sin^2(theta/2) exp(j (d + 1/2) theta)/cos(theta/2), at a beta, in 40 digits."""
    with mp.workdps(40):

        def w(t: mp.mpf) -> mp.mpc:
            return 4 * mp.sin(t / 2) ** 2 / mp.cos(t / 2) * mp.expj((d + mp.mpf(0.5)) * t)

        theta = mp.findroot(lambda t: w(t).imag / mp.sin(t) - mp.mpf(beta), mp.mpf(start))
        return w(theta).real - mp.mpf(beta) * (1 - mp.cos(theta))


@pytest.mark.parametrize("d", [0, 1, 4, 64, 256])
def test_boundary_to_twelve_digits(d: int) -> None:
    top = damping_range(Loop(0, 0, d))[1]
    for share in (1e-12, 1e-3, 0.3, 0.6, 0.9):
        start = math.sqrt(share * top / (d + 0.5))
        start = min(start, 0.9 * np.pi / (2 * d + 1)) if share < 0.9 else 0.85 * np.pi / (2 * d + 1)
        got = stiffness_limit(Loop(0, 0, d), share * top)[0]
        assert abs(got - exact_limit(d, share * top, start)) <= 1e-12 * got, (d, share)


def test_a_point_near_the_origin() -> None:
    # beta = alpha (1/2 + d) to first order; the second is smaller by alpha
    loop = Loop(0, 0, 3)
    assert is_inside(loop, 1e-20, 3.5e-20 * (1 + 1e-9))[0]
    assert not is_inside(loop, 1e-20, 3.5e-20 * (1 - 1e-9))[0]


@pytest.mark.parametrize("values", ORDINARY + RESONANT)
def test_extremes_against_a_fine_grid_of_lines(values: tuple[float, float, float]) -> None:
    loop = Loop(*values)
    low, high = damping_range(loop)
    lines = 2001
    beta = low + (high - low) * (np.arange(lines) + 0.5) / lines
    alpha, at = stiffest_point(loop)
    found = stretches(loop, beta)
    # what is stable behind an unstable gap is an island
    best = float(found.high[(found.low <= -loop.gamma) | (found.low <= 0)].max())
    assert best <= alpha * (1 + 1e-12) + 1e-300
    assert best == pytest.approx(alpha, rel=2e-3)
    assert low <= at <= high
    outside = np.array([low, high]) + np.array([-1e-7, 1e-7]) * (high - low)
    assert not len(stretches(loop, outside).index)


def test_nothing_is_stable_outside_the_range_of_damping() -> None:
    loop = Loop(0, 0, 1)
    assert stiffness_limit(loop, [-0.1, 5.0]).tolist() == [-math.inf, -math.inf]


@pytest.mark.parametrize(("delta", "d"), [(0.02, 0), (0.02, 1), (0.5, 1.5)])
def test_robust_limits_against_many_springs(delta: float, d: float) -> None:
    beta = delta * np.array([-0.5, 0.5, 0.9, 9.0])
    limit, worst = robust_limits(delta, d, beta)
    assert limit[-1] == -math.inf
    springs = np.append(np.linspace(0, NYQUIST + delta**2 / 4, 150), worst[:-1])
    for factor in (1 - 1e-6, 1 + 1e-6):
        radius = [spectral_radius(Loop(g, delta, d), limit[:-1] * factor, beta[:-1]) for g in springs]
        np.testing.assert_array_equal(np.max(radius, axis=0) < 1, np.full(3, factor < 1))


def test_nothing_is_robust_without_damping() -> None:
    assert (robust_limits(0.0, 1, [0.0, 0.01, -0.01])[0] == -math.inf).all()
    with pytest.raises(ParameterError, match="delta"):
        robust_limits(-1.0, 1, 0.0)


@pytest.mark.parametrize("delta", [5e-324, 1e-310, 1e-280, 1e-80])
def test_a_damping_that_hardly_is_there_changes_nothing(delta):
    """Reciprocals of small numbers overflow, and products of some sooner."""
    alpha, beta = np.array([0.01, 0.1, 0.5]), np.array([0.2, 0.5, 0.8])
    np.testing.assert_array_equal(
        is_inside(Loop(0.0, delta, 1.0), alpha, beta), is_inside(Loop(0.0, 0.0, 1.0), alpha, beta)
    )
