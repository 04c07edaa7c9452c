"""Verdicts, limits and extremes of the stable region against eigenvalues, polynomials in many digits, and lines."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from independent import NYQUIST as STIFFEST
from independent import characteristic, random_loops, stable_by_schur_cohn

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.boundary import boundary, has_islands, is_inside, robust_limits, stiffness_limit
from pipeline.theory.crossings import first_branch, stable_intervals
from pipeline.theory.poles import spectral_radius

NYQUIST = math.pi**2
EXTREME = [
    NormalisedLoop.ideal(gamma, delta, delay)
    for gamma, delta in [
        *((0.0, 0.0), (1e-16, 0.0), (1e-16, 1e-16), (0.0, 1e3), (1e-16, 1e3), (100.0, 20.0), (100 * (1 - 1e-12), 20.0)),
        *((0.25, 1 + 1e-9), (0.25, 1 - 1e-9), (STIFFEST, 0.0), (STIFFEST, 0.3)),
    ]
    for delay in (0.0, 1e-6, 0.5, 1 - 1e-9, 2.0, 16.5)
] + [
    NormalisedLoop.ideal(gamma, delta, delay)
    for gamma, delta in [(0.0, 0.0), (1e-3, 0.02)]
    for delay in (64.0, 256.0, 255.5)
]
"""Both ends of every parameter, near-critical damping, fractions next to 0 and 1, long delays."""


def companion_radius(loop: NormalisedLoop, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Largest root of the characteristic polynomial of each point, by companion matrices in doubles."""
    zero, one, two = (
        np.array([float(c) for c in characteristic(loop.gamma, loop.delta, loop.delay, *wall)])
        for wall in ((0, 0), (1, 0), (0, 1))
    )
    polynomial = zero + alpha[:, None] * (one - zero) + beta[:, None] * (two - zero)
    size = polynomial.shape[1] - 1
    matrix = np.zeros((len(alpha), size, size))
    matrix[:, np.arange(1, size), np.arange(size - 1)] = 1.0
    matrix[:, 0] = -polynomial[:, 1:]
    return np.abs(np.linalg.eigvals(matrix)).max(axis=1)


def damping_below(loop: NormalisedLoop, step: float) -> float:
    """A stable damping at a stiffness that lies a step below the largest one; the tip of a region may lean."""
    alpha, at = stiffest_point(loop)
    low, high = damping_range(loop)
    share = np.concatenate([[0.0], np.geomspace(1e-12, 1.0, 600)])
    beta = at + (high - low) * np.concatenate([-share, share])
    return float(np.median(beta[is_inside(loop, alpha - step, beta)]))


def damping_range(loop: NormalisedLoop) -> tuple[float, float]:
    """Infimum and supremum of stable beta."""
    border = boundary(loop, 8)
    found = [border.beta_min, border.beta_max, *border.islands[:, 0]]
    return min(found), max(found)


def stiffest_point(loop: NormalisedLoop) -> tuple[float, float]:
    """Supremum of stable alpha and its beta."""
    border = boundary(loop, 8)
    return border.alpha_max, border.beta_at_alpha_max


def check_extremes(loop: NormalisedLoop) -> None:
    """Largest stiffness and damping with their partners: stable just inside, nothing stable on the line beyond."""
    low, high = damping_range(loop)
    peak, at = stiffest_point(loop)
    values = loop.gamma, loop.delta, loop.delay
    width = peak + loop.gamma
    # at gamma = pi^2, the stable walls below the largest stiffness are 1e-11 high: stay among them
    below = stable_intervals(loop, np.array([at]))
    step = min([1e-9 * width, *(0.25 * (below.high - below.low))])
    inside = damping_below(loop, step)
    assert stable_by_schur_cohn(characteristic(*values, peak - step, inside)), loop
    across = low + (high - low) * np.linspace(-0.1, 1.1, 160)
    across = np.append(across, at + (high - low) * np.linspace(-1e-3, 1e-3, 41))
    # flat maximum: 1e-7 beyond it, the radius exceeds 1 by about as much at the very place, and by more elsewhere
    beyond = companion_radius(loop, np.full(201, peak + 1e-7 * width), across).min()
    assert beyond > 1 + 1e-12 or has_islands(loop), loop
    alpha_at = float(stiffness_limit(loop, high - 1e-6 * (high - low))[0])
    intervals = stable_intervals(loop, np.array([high - 1e-6 * (high - low)]))
    middle = float(0.5 * (intervals.low[0] + intervals.high[0]))
    assert stable_by_schur_cohn(characteristic(*values, middle, high - 1e-6 * (high - low))), loop
    along = -loop.gamma + width * np.append(np.linspace(0, 1.2, 160)[1:], np.logspace(-9, -1, 40))
    near = alpha_at + width * np.linspace(-1e-3, 1e-3, 41)
    along = np.append(along, near[near > -loop.gamma])
    for beta in (high + 1e-6 * (high - low), low - 1e-6 * (high - low)):
        assert companion_radius(loop, along, np.full(len(along), beta)).min() > 1 - 1e-9, (loop, beta)


def value_at(polynomial: list[mp.mpf], z: mp.mpc) -> mp.mpc:
    total = mp.mpf(0)
    for coefficient in polynomial:
        total = total * z + coefficient
    return total


def partner(loop: NormalisedLoop) -> tuple[float, float, float] | None:
    """alpha, beta and angle where alpha is stationary along the boundary, in 50 digits, next to the stiffest point."""
    values = loop.gamma, loop.delta, loop.delay
    peak, at = stiffest_point(loop)
    zero, one = (characteristic(*values, wall, 0) for wall in (0, 1))
    z = np.roots([float(c) for c in characteristic(*values, peak, at)])
    on_circle = z[(np.abs(np.abs(z) - 1) < 1e-6) & (z.imag > 1e-9)]
    if len(on_circle) != 1:
        return None  # a corner, where two pairs meet the circle
    with mp.workdps(50):

        def point(theta: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
            z = mp.expj(theta)
            w = -value_at(zero, z) / value_at([x - y for x, y in zip(one, zero, strict=True)], z)
            beta = w.imag / mp.sin(theta)
            return w.real - beta * (1 - mp.cos(theta)), beta

        theta = mp.findroot(lambda t: mp.diff(lambda s: point(s)[0], t), mp.mpf(float(np.angle(on_circle[0]))))
        alpha, beta = point(theta)
        return float(alpha), float(beta), float(theta)


@pytest.mark.slow
def test_largest_stiffness_and_damping_of_random_loops() -> None:
    loops = [NormalisedLoop.ideal(g, delta, p / q) for g, delta, p, q in random_loops(300, seed=18)]
    for loop in loops:
        check_extremes(loop)


@pytest.mark.slow
def test_largest_stiffness_and_damping_of_extreme_loops() -> None:
    loops = [loop for loop in EXTREME if loop.states < 30]
    assert len(loops) >= 60
    for loop in loops:
        check_extremes(loop)


def check_partners(loops: list[NormalisedLoop]) -> int:
    """How many of the points are no corners, which have no stationary one, nor lie on an island, never the stiffest."""
    checked = 0
    for loop in loops:
        exact = partner(loop)
        if exact is None or has_islands(loop):
            continue
        alpha, beta = stiffest_point(loop)
        assert alpha == pytest.approx(exact[0], rel=1e-11), loop
        # a flat maximum is known to the root of rounding, 1e-8, times its flatness, some 20 at strong damping; one in a
        # corner beside it, by 1e-9 of the gap to the next
        low, high = damping_range(loop)
        assert beta == pytest.approx(exact[1], rel=1e-6, abs=2e-9 * (high - low)), loop
        checked += 1
    return checked


@pytest.mark.slow
def test_stiffest_point_of_extreme_loops_in_many_digits() -> None:
    assert (
        check_partners([NormalisedLoop.ideal(g, delta, p / q) for g, delta, p, q in random_loops(310, seed=19)]) >= 280
    )
    assert check_partners(EXTREME) >= 30


@pytest.mark.slow
def test_robust_limits_of_random_and_extreme_walls() -> None:
    rng = np.random.default_rng(20)
    loops = [(float(10 ** rng.uniform(-3, 0)), float(rng.choice([0, 1, rng.uniform(0, 3)]))) for _ in range(20)]
    extreme = [(1e-6, 0.0), (1e-6, 0.5), (3.0, 0.25), (10.0, 1.0), (0.02, 16.0), (0.1, 7.75)]
    counts = {"random": 0, "extreme": 0}
    for number, (delta, d) in enumerate(loops + extreme):
        beta = delta * (rng.uniform(-0.95, 0.95, 15) if number < len(loops) else np.linspace(-0.95, 0.95, 12))
        limit, worst = robust_limits(delta, d, beta)
        largest = NYQUIST + delta**2 / 4
        springs = 0.5 * largest * (1 - np.cos(np.pi * np.linspace(0, 1, 120)))[:-1]
        for i in np.flatnonzero(limit > 0):
            step = 1e-6 * float(limit[i])
            # at the worst spring exactly, at many others by companion matrices
            values = float(worst[i]), delta, d
            assert not stable_by_schur_cohn(characteristic(*values, float(limit[i]) + step, float(beta[i]))), values
        for spring in np.append(springs, np.unique(worst[limit > 0])):
            loop, some = NormalisedLoop.ideal(float(spring), delta, d), limit > 0
            alpha, damping = limit[some] * (1 - 1e-6), beta[some]
            radius = companion_radius(loop, alpha, damping)
            # doubles lose half of their digits where a plant swings half as fast as it is sampled: many digits there
            for i in np.flatnonzero(radius > 1 - 1e-7):
                values = loop.gamma, delta, d, float(alpha[i]), float(damping[i])
                assert stable_by_schur_cohn(characteristic(*values)), values
        counts["random" if number < len(loops) else "extreme"] += len(beta)
        # where there is no limit, some spring is unstable with almost no wall
        for value in beta[limit == -math.inf]:
            tiny = 1e-9 * delta
            assert any(
                companion_radius(NormalisedLoop.ideal(float(g), delta, d), np.array([tiny]), np.array([value]))[0]
                > 1 - 1e-12
                for g in springs
            ), (delta, d, value)
    assert counts["random"] >= 300
    assert counts["extreme"] >= 60


ORDINARY = [(0, 0, 0), (0, 0, 1), (0.001, 0.02, 2), (0, 0, 0.5), (1e-3, 0.1, 2.75), (0, 0, 16), (0, 10, 2), (0, 0, 256)]
RESONANT = [(1.0, 0.1, 2.5), (5.0, 1.0, 1), (0.3, 0.05, 4), (9.8, 0.0, 1), (20.0, 10.0, 2), (0.0, 10.0, 0)]


def random_loop(rng: np.random.Generator) -> NormalisedLoop:
    d = float(rng.choice([0, 1, 2, 7, 16, rng.uniform(0, 4), rng.uniform(0, 1)]))
    delta = float(rng.choice([0, 1e-14, 1e-6, 0.02, 10, 50, rng.uniform(0, 3)]))
    swing = delta**2 / 4
    gamma = float(
        rng.choice([0, 1e-12, 1e-3, rng.uniform(0, 9), rng.uniform(0, 2), NYQUIST * (1 - 1e-12)])
        if rng.random() < 0.8
        else rng.choice([swing + 0.9 * NYQUIST, swing * rng.uniform()])
    )
    return NormalisedLoop.ideal(min(gamma, NYQUIST + swing), delta, d)


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


def shares_of_damping(loops: list[NormalisedLoop], seed: int) -> list[float]:
    """A random damping within the stable range of each loop."""
    rng = np.random.default_rng(seed)
    result = []
    for loop in loops:
        low, high = damping_range(loop)
        result.append(low + (high - low) * float(rng.uniform(0.02, 0.98)))
    return result


@pytest.mark.slow
def test_limits_are_met_to_1e_10_by_polynomials_in_many_digits() -> None:
    random = [NormalisedLoop.ideal(g, delta, p / q) for g, delta, p, q in random_loops(300, seed=14)]
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
    assert len(EXTREME) >= 60
    assert sum(loop.delay % 1 != 0 for loop in random) >= 100


@pytest.mark.slow
def test_verdicts_against_polynomials_in_many_digits() -> None:
    rng = np.random.default_rng(16)
    random = [NormalisedLoop.ideal(g, delta, p / q) for g, delta, p, q in random_loops(300, seed=17)]
    verdicts = {True: 0, False: 0}
    for loop in random + EXTREME[:66]:
        room = (1 + loop.delta) / (1 + loop.delay)
        tiny = loop in EXTREME and rng.random() < 0.5
        alpha = 1e-11 if tiny else float(rng.uniform(-0.3, 1) * room / (1 + loop.delay)) - loop.gamma * rng.integers(2)
        beta = 1e-11 if tiny else float(rng.uniform(-0.2, 1.2) * room)
        exact = stable_by_schur_cohn(characteristic(loop.gamma, loop.delta, loop.delay, alpha, beta))
        assert is_inside(loop, alpha, beta)[0] == exact, (loop, alpha, beta)
        verdicts[exact] += 1
    assert min(verdicts.values()) > 80


@pytest.mark.parametrize("d", [0, 1, 2])
@pytest.mark.parametrize("delta", [0.0, 1e-13, 0.3])
def test_verdicts_where_the_plant_swings_half_as_fast_as_it_is_sampled(d: int, delta: float) -> None:
    gamma = NYQUIST * (1 - 1e-12)
    loop = NormalisedLoop.ideal(gamma, delta, d)
    for size in (1e-11, 1e-6, 0.1):
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1), (3, -1), (-3, 1), (0.1, 0), (0, -0.1)):
            exact = stable_by_schur_cohn(characteristic(gamma, delta, d, a * size, b * size))
            assert is_inside(loop, a * size, b * size)[0] == exact, (loop, a * size, b * size)


@pytest.mark.parametrize("values", ORDINARY[:-1])
def test_verdicts_at_a_distance_of_1e_12(values: tuple[float, float, float]) -> None:
    loop = NormalisedLoop.ideal(*values)
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
    top = damping_range(NormalisedLoop.ideal(0, 0, d))[1]
    for share in (1e-12, 1e-3, 0.3, 0.6, 0.9):
        start = math.sqrt(share * top / (d + 0.5))
        start = min(start, 0.9 * np.pi / (2 * d + 1)) if share < 0.9 else 0.85 * np.pi / (2 * d + 1)
        got = stiffness_limit(NormalisedLoop.ideal(0, 0, d), share * top)[0]
        assert abs(got - exact_limit(d, share * top, start)) <= 1e-12 * got, (d, share)


def test_a_point_near_the_origin() -> None:
    # beta = alpha (1/2 + d) to first order; the second is smaller by alpha
    loop = NormalisedLoop.ideal(0, 0, 3)
    assert is_inside(loop, 1e-20, 3.5e-20 * (1 + 1e-9))[0]
    assert not is_inside(loop, 1e-20, 3.5e-20 * (1 - 1e-9))[0]


def test_nothing_is_stable_outside_the_range_of_damping() -> None:
    loop = NormalisedLoop.ideal(0, 0, 1)
    assert stiffness_limit(loop, [-0.1, 5.0]).tolist() == [-math.inf, -math.inf]


@pytest.mark.sampled
@pytest.mark.parametrize(("delta", "d"), [(0.02, 0), (0.02, 1), (0.5, 1.5)])
def test_robust_limits_against_many_springs(delta: float, d: float) -> None:
    beta = delta * np.array([-0.5, 0.5, 0.9, 9.0])
    limit, worst = robust_limits(delta, d, beta)
    assert limit[-1] == -math.inf
    springs = np.append(np.linspace(0, NYQUIST + delta**2 / 4, 150), worst[:-1])
    for factor in (1 - 1e-6, 1 + 1e-6):
        radius = [spectral_radius(NormalisedLoop.ideal(g, delta, d), limit[:-1] * factor, beta[:-1]) for g in springs]
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
        is_inside(NormalisedLoop.ideal(0.0, delta, 1.0), alpha, beta),
        is_inside(NormalisedLoop.ideal(0.0, 0.0, 1.0), alpha, beta),
    )
