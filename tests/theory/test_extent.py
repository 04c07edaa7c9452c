"""Extremes of the stable region and robust limits against polynomials in many digits, random and extreme loops."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from independent import NYQUIST as STIFFEST
from independent import characteristic, random_loops, stable_by_schur_cohn

from pipeline.loop.loop import Loop
from pipeline.theory.boundary import boundary, has_islands, is_inside, robust_limits, stiffness_limit
from pipeline.theory.crossings import stretches

NYQUIST = math.pi**2
EXTREME = [
    Loop(gamma, delta, delay)
    for gamma, delta in [
        *((0.0, 0.0), (1e-16, 0.0), (1e-16, 1e-16), (0.0, 1e3), (1e-16, 1e3), (100.0, 20.0), (100 * (1 - 1e-12), 20.0)),
        *((0.25, 1 + 1e-9), (0.25, 1 - 1e-9), (STIFFEST, 0.0), (STIFFEST, 0.3)),
    ]
    for delay in (0.0, 1e-6, 0.5, 1 - 1e-9, 2.0, 16.5)
] + [Loop(gamma, delta, delay) for gamma, delta in [(0.0, 0.0), (1e-3, 0.02)] for delay in (64.0, 256.0, 255.5)]
"""Both ends of every parameter, near-critical damping, fractions next to 0 and 1, long delays."""


def companion_radius(loop: Loop, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
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


def damping_below(loop: Loop, step: float) -> float:
    """A stable damping at a stiffness that lies a step below the largest one; the tip of a region may lean."""
    alpha, at = stiffest_point(loop)
    low, high = damping_range(loop)
    share = np.concatenate([[0.0], np.geomspace(1e-12, 1.0, 600)])
    beta = at + (high - low) * np.concatenate([-share, share])
    return float(np.median(beta[is_inside(loop, alpha - step, beta)]))


def damping_range(loop: Loop) -> tuple[float, float]:
    """Infimum and supremum of stable beta."""
    border = boundary(loop, 8)
    found = [border.beta_min, border.beta_max, *border.islands[:, 0]]
    return min(found), max(found)


def stiffest_point(loop: Loop) -> tuple[float, float]:
    """Supremum of stable alpha and its beta."""
    border = boundary(loop, 8)
    return border.alpha_max, border.beta_at_alpha_max


def check_extremes(loop: Loop) -> None:
    """Largest stiffness and damping with their partners: stable just inside, nothing stable on the line beyond."""
    low, high = damping_range(loop)
    peak, at = stiffest_point(loop)
    values = loop.gamma, loop.delta, loop.delay
    width = peak + loop.gamma
    inside = damping_below(loop, 1e-9 * width)
    assert stable_by_schur_cohn(characteristic(*values, peak - 1e-9 * width, inside)), loop
    across = low + (high - low) * np.linspace(-0.1, 1.1, 160)
    across = np.append(across, at + (high - low) * np.linspace(-1e-3, 1e-3, 41))
    # flat maximum: 1e-7 beyond it, the radius exceeds 1 by about as much at the very place, and by more elsewhere
    beyond = companion_radius(loop, np.full(201, peak + 1e-7 * width), across).min()
    assert beyond > 1 + 1e-12 or has_islands(loop), loop
    alpha_at = float(stiffness_limit(loop, high - 1e-6 * (high - low))[0])
    intervals = stretches(loop, np.array([high - 1e-6 * (high - low)]))
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


def partner(loop: Loop) -> tuple[float, float, float] | None:
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
def test_largest_stiffness_and_damping_of_random_loops(record_property) -> None:
    loops = [Loop(g, delta, p / q) for g, delta, p, q in random_loops(300, seed=18)]
    for loop in loops:
        check_extremes(loop)
    record_property("random", len(loops))


@pytest.mark.slow
def test_largest_stiffness_and_damping_of_extreme_loops(record_property) -> None:
    loops = [loop for loop in EXTREME if loop.states < 30]
    for loop in loops:
        check_extremes(loop)
    record_property("extreme", len(loops))
    assert len(loops) >= 60


def check_partners(loops: list[Loop]) -> tuple[float, int]:
    """Largest relative deviation of alpha_max, and how many of the points are corners, which have no stationary one.

    Or lie on an island, of which none is the stiffest.
    """
    worst, corners = 0.0, 0
    for loop in loops:
        exact = partner(loop)
        if exact is None or has_islands(loop):
            corners += 1
            continue
        alpha, beta = stiffest_point(loop)
        assert alpha == pytest.approx(exact[0], rel=1e-11), loop
        # a flat maximum is known to the root of rounding, 1e-8, times its flatness, some 20 at strong damping; one in a
        # corner beside it, by 1e-9 of the gap to the next
        low, high = damping_range(loop)
        assert beta == pytest.approx(exact[1], rel=1e-6, abs=2e-9 * (high - low)), loop
        worst = max(worst, abs(alpha / exact[0] - 1))
    return worst, corners


@pytest.mark.slow
def test_stiffest_point_and_its_partner_in_many_digits(record_property) -> None:
    loops = [Loop(g, delta, p / q) for g, delta, p, q in random_loops(310, seed=19)]
    worst, corners = check_partners(loops)
    record_property("random", len(loops) - corners)
    record_property("deviation", worst)
    assert len(loops) - corners >= 280


@pytest.mark.slow
def test_stiffest_point_of_extreme_loops_in_many_digits(record_property) -> None:
    worst, corners = check_partners(EXTREME)
    record_property("extreme", len(EXTREME) - corners)
    record_property("corners", corners)
    record_property("deviation", worst)
    assert len(EXTREME) - corners >= 30


@pytest.mark.slow
def test_robust_limits_of_random_and_extreme_walls(record_property) -> None:
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
            loop, some = Loop(float(spring), delta, d), limit > 0
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
                companion_radius(Loop(float(g), delta, d), np.array([tiny]), np.array([value]))[0] > 1 - 1e-12
                for g in springs
            ), (delta, d, value)
    for name, count in counts.items():
        record_property(name, count)
    assert counts["random"] >= 300
    assert counts["extreme"] >= 60
