"""Branches of the boundary against the characteristic polynomial in 50 digits, over the whole domain of the loop."""

from __future__ import annotations

import math
from functools import cache

import mpmath as mp
import numpy as np
import pytest
from independent import DIGITS, characteristic

from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.crossings import circle_points, ends, place_of

NYQUIST = math.pi**2


def value_at(polynomial: list[mp.mpf], z: mp.mpc) -> mp.mpc:
    total = mp.mpf(0)
    for coefficient in polynomial:
        total = total * z + coefficient
    return total


@cache
def polynomials(loop: NormalisedLoop) -> tuple[list[mp.mpf], list[mp.mpf]]:
    """Characteristic polynomials for alpha = 0 and 1."""
    zero, one = (characteristic(loop.gamma, loop.delta, loop.delay, alpha, 0) for alpha in (0, 1))
    return zero, one


def exact_point(loop: NormalisedLoop, angle: float) -> tuple[mp.mpf, mp.mpf, mp.mpf]:
    """alpha, beta and a size that rounding is measured by, from the polynomial at a folded angle."""
    with mp.workdps(DIGITS):
        theta = mp.pi + mp.mpf(angle) if angle < 0 else mp.mpf(angle)
        z = mp.expj(theta)
        plant, wall = polynomials(loop)
        w = -value_at(plant, z) / value_at([x - y for x, y in zip(wall, plant, strict=True)], z)
        beta = w.imag / mp.sin(theta)
        return w.real - beta * (1 - mp.cos(theta)), beta, abs(w) / mp.sin(theta)


def loops(count: int, seed: int) -> list[NormalisedLoop]:
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
        result.append(NormalisedLoop.ideal(min(gamma, NYQUIST + critical), delta, d))
    return result


def places(angle: np.ndarray) -> np.ndarray:
    """Places of folded angles."""
    side = np.where(angle < 0, -1.0, 1.0)
    return np.asarray(side * place_of(np.abs(angle)))


def test_points_of_random_and_extreme_loops() -> None:
    angles = np.array([1e-12, 1e-5, 0.01, 0.1, 1, 2.4, -1e-12, -1e-8, -1e-3, -0.2, -0.6])
    for loop in loops(60, seed=1):
        p = circle_points(loop, places(angles))
        for i, angle in enumerate(angles):
            alpha, beta, size = exact_point(loop, float(angle))
            assert abs(p.beta[i] - beta) <= 1e-12 * size, (loop, angle)
            lever = abs(beta) * (1 - math.cos(angle) if angle > 0 else 1 + math.cos(angle))
            assert abs(p.alpha[i] - alpha) <= 1e-12 * (abs(alpha) + lever), (loop, angle)


def test_slopes_and_the_start() -> None:
    for loop in loops(25, seed=2):
        x, step = places(np.array([0.3, 1.1, 2.2, -0.3])), 1e-5
        p, low, high = (circle_points(loop, x + way) for way in (0, -step, step))
        third = 1e4 * step**2 + 1e-9  # of a difference quotient: curvature times step^2, and rounding
        size = np.abs(p.alpha) + np.abs(p.beta) * (1 + loop.delay) + np.abs(p.alpha_slope) + np.abs(p.beta_slope)
        for name in ("alpha", "beta"):
            change = (getattr(high, name) - getattr(low, name)) / (2 * step)
            error = np.abs(change - getattr(p, f"{name}_slope"))
            assert (error < third * (1 + loop.delay) ** 3 * size).all()
        start = circle_points(loop, places(np.array([1e-9])))
        assert start.alpha[0] == pytest.approx(-loop.gamma, rel=1e-6, abs=1e-9)
        assert start.beta[0] == pytest.approx(ends(loop).start, rel=1e-6, abs=1e-12)


def test_the_line_of_a_pole_at_minus_one() -> None:
    for loop in loops(60, seed=3):
        level = ends(loop).last
        plant, wall = polynomials(loop)
        with mp.workdps(DIGITS):
            bottom = value_at(wall, -1) - value_at(plant, -1)
            if loop.delta == 0 and loop.delay == int(loop.delay):
                assert level == math.inf
            else:
                exact = -value_at(plant, -1) / bottom
                # a zero of the plant that lies within 1e-10 of -1 leaves fewer digits
                assert abs(level - exact) <= 1e-5 * abs(exact), loop
