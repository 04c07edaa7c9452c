"""Branches of the boundary against the characteristic polynomial in 50 digits, over the whole domain of the loop."""

from __future__ import annotations

import math
from functools import cache

import mpmath as mp
import numpy as np
import pytest
from independent import DIGITS, characteristic

from pipeline.loop.loop import Loop
from pipeline.theory.stability.boundary import boundary
from pipeline.theory.stability.branches import FOLD, beta_above_start, curve, curve_points, folded

NYQUIST = math.pi**2


def value_at(polynomial: list[mp.mpf], z: mp.mpc) -> mp.mpc:
    total = mp.mpf(0)
    for coefficient in polynomial:
        total = total * z + coefficient
    return total


@cache
def polynomials(loop: Loop) -> tuple[list[mp.mpf], list[mp.mpf]]:
    """Characteristic polynomials for alpha = 0 and 1."""
    zero, one = (characteristic(loop.gamma, loop.delta, loop.delay, alpha, 0) for alpha in (0, 1))
    return zero, one


def exact_point(loop: Loop, angle: float) -> tuple[mp.mpf, mp.mpf, mp.mpf]:
    """alpha, beta and a size that rounding is measured by, from the polynomial at a folded angle."""
    with mp.workdps(DIGITS):
        theta = mp.pi + mp.mpf(angle) if angle < 0 else mp.mpf(angle)
        z = mp.expj(theta)
        plant, wall = polynomials(loop)
        w = -value_at(plant, z) / value_at([x - y for x, y in zip(wall, plant, strict=True)], z)
        beta = w.imag / mp.sin(theta)
        return w.real - beta * (1 - mp.cos(theta)), beta, abs(w) / mp.sin(theta)


def loops(count: int, seed: int) -> list[Loop]:
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(count):
        close = 10.0 ** -rng.uniform(1, 10)
        d = float(rng.choice([0, 1, 2, 7, 64, rng.uniform(0, 4), rng.uniform(0, 1), 1 + close, 2 - close]))
        delta = float(rng.choice([0, 1e-14, 1e-6, 0.02, 10, 50, 1000, rng.uniform(0, 3)]))
        critical = delta**2 / 4
        gamma = float(
            rng.choice(
                [
                    *(0, 1e-16, 1e-12, 1e-6, 1e-3, rng.uniform(0, 9), NYQUIST * (1 - 1e-12), critical),
                    *(critical * (1 + 1e-9), critical + 0.9 * NYQUIST, critical * rng.uniform()),
                ]
            )
        )
        result.append(Loop(min(gamma, NYQUIST + critical), delta, d))
    return result


def test_points_of_random_and_extreme_loops() -> None:
    angles = np.array([1e-12, 1e-5, 0.01, 0.1, 1, 2.4, -1e-12, -1e-8, -1e-3, -0.2, -0.6])
    for loop in loops(60, seed=1):
        p = curve_points(curve(loop), angles)
        for i, angle in enumerate(angles):
            alpha, beta, size = exact_point(loop, float(angle))
            assert abs(p.beta[i] - beta) <= 1e-12 * size, (loop, angle)
            lever = abs(beta) * (1 - math.cos(angle) if angle > 0 else 1 + math.cos(angle))
            assert abs(p.alpha[i] - alpha) <= 1e-12 * (abs(alpha) + lever), (loop, angle)


@pytest.mark.parametrize("d", [0.0, 3.0, 64.0, 256.0, 255.5])
def test_points_at_long_delays(d: float) -> None:
    for loop in (Loop(0, 0, d), Loop(1e-3, 0.02, d)):
        angles = np.pi / (d + 0.5) * np.array([0.05, 0.3, 0.45, 0.7, 0.99, 1.4])
        angles = angles[angles < np.pi]
        p = curve_points(curve(loop), folded(angles))
        for i, angle in enumerate(folded(angles)):
            alpha, beta, size = exact_point(loop, float(angle))
            assert abs(p.alpha[i] - alpha) <= 1e-12 * abs(alpha)
            assert abs(p.beta[i] - beta) <= 1e-12 * size


def test_slopes_and_the_start() -> None:
    for loop in loops(25, seed=2):
        c = curve(loop)
        x, step = np.array([0.3, 1.1, 2.2, -0.3]), 1e-5
        p, low, high = curve_points(c, x), curve_points(c, x - step), curve_points(c, x + step)
        third = 1e4 * step**2 + 1e-9  # of a difference quotient: curvature times step^2, and rounding
        size = np.abs(p.alpha) + np.abs(p.beta) * (1 + loop.delay) + np.abs(p.alpha_slope) + np.abs(p.beta_slope)
        assert (np.abs((high.beta - low.beta) / (2 * step) - p.beta_slope) < third * (1 + loop.delay) ** 3 * size).all()
        assert (
            np.abs((high.alpha - low.alpha) / (2 * step) - p.alpha_slope) < third * (1 + loop.delay) ** 3 * size
        ).all()
        start = curve_points(c, np.array([0.0, 1e-9]))
        assert start.alpha[0] == pytest.approx(-loop.gamma, rel=1e-13, abs=1e-300)
        assert start.beta[0] == pytest.approx(c.start, rel=1e-11, abs=1e-300)
        assert start.beta[1] == pytest.approx(c.start, rel=1e-6, abs=1e-12)


def test_the_line_of_a_pole_at_minus_one() -> None:
    for loop in loops(60, seed=3):
        level = curve(loop).level
        plant, wall = polynomials(loop)
        with mp.workdps(DIGITS):
            bottom = value_at(wall, -1) - value_at(plant, -1)
            if loop.delta == 0 and loop.delay == int(loop.delay):
                assert level == math.inf
            else:
                exact = -value_at(plant, -1) / bottom
                # a zero of the plant that lies within 1e-10 of -1 leaves fewer digits
                assert abs(level - exact) <= 1e-5 * abs(exact), loop


def test_folding_angles() -> None:
    theta = np.array([0.0, 1.0, FOLD, FOLD + 1e-9, 3.0, math.pi - 1e-9])
    assert (folded(theta)[3:] < 0).all()
    np.testing.assert_allclose(np.mod(folded(theta), math.pi), theta, rtol=0, atol=1e-15)


@pytest.mark.parametrize("values", [(0, 10, 2.5), (0, 10, 2), (0, 0.3, 4), (0, 100, 1.5), (0, 1000, 0), (0, 2, 256)])
def test_damping_above_the_start_keeps_its_digits(values):
    """Against the curve itself where that is large, and against its leading term theta^2 where it is small."""
    c = curve(Loop(*values))
    angle = np.array([0.3, 0.9, 1.4]) / (1 + values[2])
    np.testing.assert_allclose(
        beta_above_start(c, angle), curve_points(c, angle).beta - c.start, rtol=1e-10, atol=1e-14 * values[1]
    )
    small = np.array([1e-3, 1e-4, 1e-5, 1e-6]) / (1 + values[2])
    share = beta_above_start(c, small) / small**2
    np.testing.assert_allclose(share, share[-1], rtol=1e-4)
    np.testing.assert_allclose(share[2:], share[-1], rtol=1e-9)


@pytest.mark.parametrize(
    "loop",
    [
        Loop(0.11088747614118255, 0.007415654839155998, 5),
        Loop(0.06212016989352451, 0.39703419797576445, 28.282591748854514),
        Loop(0.12617174685976956, 1.1303816323042108, 4.605959410859267),
    ],
    ids=str,
)
def test_the_boundary_of_several_branches_is_one_line_around_what_is_stable(loop):
    """It begins and ends on alpha = -gamma; once it began in the corner at the least damping."""
    border = boundary(loop, 200)
    height, width = border.alpha_max + loop.gamma, border.beta_max - border.beta.min()
    steps = np.hypot(np.diff(border.alpha) / height, np.diff(border.beta) / width)
    assert steps.max() < 0.05
    assert border.alpha[[0, -1]] == pytest.approx(-loop.gamma, abs=1e-9 * height)
    assert border.beta[0] < border.beta[-1]
