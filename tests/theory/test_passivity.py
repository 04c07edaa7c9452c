"""Passive region against condition (4.6) as printed, in many digits and by linear programming over all frequencies."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from independent import maximum_passive_stiffness, needed_damping
from scipy.optimize import linprog, minimize_scalar

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import Loop
from pipeline.theory.limits import is_inside, robust_limits
from pipeline.theory.passive_curve import (
    boundary_angle,
    passive_boundary,
)

DELAYS = [0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 100.3]


def printed_condition(d: float, k: float, b: float, w: float) -> mp.mpf:
    """Right side of (4.6) with T = 1, as printed."""
    with mp.workdps(60):
        d, w = mp.mpf(d), mp.mpf(w)
        springs = mp.cos(d * w) - mp.cos((d + 1) * w)
        dampers = mp.cos(d * w) - 2 * mp.cos((d + 1) * w) + mp.cos((d + 2) * w)
        return (springs * mp.mpf(k) + dampers * mp.mpf(b)) / (2 - 2 * mp.cos(w))


def printed_boundary(d: float, w: float) -> tuple[mp.mpf, mp.mpf]:
    """(4.8) with b = T = 1, as printed."""
    with mp.workdps(60):
        d, w = mp.mpf(d), mp.mpf(w)
        bottom = mp.sin(2 * (d + 1) * w) - 2 * (d + 1) * mp.sin(w)
        k = 2 * (d + 1) * (mp.sin((d + 2) * w) - 2 * mp.sin((d + 1) * w) + mp.sin(d * w)) / bottom
        return k, 2 * (d * mp.sin((d + 1) * w) - (d + 1) * mp.sin(d * w)) / bottom


def all_frequencies(d: float) -> np.ndarray:
    """Angles of half-plane constraints over (0, pi), denser on the first branch."""
    return np.concatenate([np.linspace(0, np.pi, 4001), np.linspace(0, np.pi / (d + 1), 4001)])


def test_the_condition_equals_the_printed_one() -> None:
    rng = np.random.default_rng(3)
    for _ in range(300):
        d, k, b = float(rng.uniform(0, 20)), float(rng.normal()), float(rng.normal())
        w = float(rng.choice([10 ** rng.uniform(-8, 0.49), rng.uniform(0, math.pi)]))
        exact = printed_condition(d, k, b, w)
        assert abs(needed_damping(d, k, b, w) - exact) < 1e-13 * (abs(k) * (1 + d) + abs(b)), (d, k, b, w)


@pytest.mark.parametrize("d", DELAYS[1:])
def test_the_boundary_equals_the_printed_one_and_touches_the_condition(d: float) -> None:
    last = boundary_angle(d)
    for w in np.concatenate([last * np.linspace(0.01, 1, 25), 0.1 / (d + 1) * np.array([1e-6, 1e-3, 0.999, 1.001])]):
        k, b = (float(value[0]) for value in passive_boundary(d, w))
        exact = printed_boundary(d, float(w))
        assert abs(k - exact[0]) < 2e-12 * max(float(abs(exact[0])), 1e-3)
        assert abs(b - exact[1]) < 2e-12
        assert needed_damping(d, k, b, w) == pytest.approx(1, abs=1e-11)
        assert float(needed_damping(d, k, b, all_frequencies(d)).max()) <= 1 + 1e-9


EXTREME_DELAYS = [1e-9, 1e-6, 1e-3, 0.01, 1 / 3, 1 - 1e-9, 7.25, 31.5, 64.0, 128.0, 255.999, 256.0]


def random_delays() -> np.ndarray:
    rng = np.random.default_rng(41)
    return np.where(rng.random(300) < 0.3, rng.integers(1, 20, 300), 10 ** rng.uniform(-2, 2, 300))


def check_boundary(d: float, share: float) -> float:
    """Boundary at one angle against (4.8) as printed, which its straight part (4.10) meets; return the deviation."""
    w = share * boundary_angle(d)
    k, b = (float(value[0]) for value in passive_boundary(d, w))
    exact = [float(value) for value in printed_boundary(d, w)]
    # (4.8) is a quotient of sines of up to pi: 1e-16 of 1 over a stiffness that falls as 1/(d + 1)
    deviation = max(abs(k - exact[0]) * (d + 1), abs(b - exact[1]))
    # almost without delay, numerator and denominator vanish together at the last angle
    assert deviation < 1e-11 + 1e-15 / (d + 1 - share), (d, share)
    lower = -1 + share * (1 + d / (2 * d + 3))  # somewhere on the straight part
    straight = (1 + mp.mpf(lower)) / (mp.mpf(d) + mp.mpf(0.5))
    # its points are those at which (4.6) is an equality for omega -> 0
    assert float(abs(printed_condition(d, float(straight), lower, 1e-9) - 1)) < 1e-12
    return deviation


@pytest.mark.slow
def test_boundary_and_limits_of_random_and_extreme_delays(record_property) -> None:
    rng = np.random.default_rng(42)
    random = [(float(d), float(rng.uniform(0.001, 0.999))) for d in random_delays()]
    extreme = [(d, share) for d in EXTREME_DELAYS for share in (1e-9, 1e-4, 0.03, 0.5, 1 - 1e-6)]
    worst = max(check_boundary(*case) for case in random + extreme)
    record_property("random", len(random))
    record_property("extreme", len(extreme))
    record_property("deviation", worst)
    assert len(extreme) >= 60


def test_largest_stiffness_by_search_along_the_printed_boundary(record_property) -> None:
    delays = [*random_delays().tolist(), *EXTREME_DELAYS, *np.geomspace(0.005, 250, 50).tolist()]
    found = np.transpose(maximum_passive_stiffness(delays))
    worst = 0.0
    for d, (k, b) in zip(delays, found, strict=True):
        best = minimize_scalar(
            lambda share, d=d: -float(printed_boundary(d, share * math.pi / (d + 1))[0]),
            bounds=(0.01, 0.99),
            method="bounded",
            options={"xatol": 1e-9},
        )
        worst = max(worst, abs(k / -best.fun - 1))
        assert k == pytest.approx(-best.fun, rel=1e-12), d
        place = printed_boundary(d, best.x * math.pi / (d + 1))[1]
        assert b == pytest.approx(float(place), abs=1e-6), d  # a flat maximum: the root of rounding
    record_property("random", 300)
    record_property("extreme", len(delays) - 300)
    record_property("deviation", worst)


@pytest.mark.parametrize("d", DELAYS)
def test_limits_and_largest_stiffness_by_linear_programming(d: float) -> None:
    w = all_frequencies(d)
    per_stiffness, per_damping = needed_damping(d, 1, 0, w), needed_damping(d, 0, 1, w)
    stiffest = linprog(
        [-1, 0], A_ub=np.stack([per_stiffness, per_damping], 1), b_ub=np.ones(len(w)), bounds=(None, None)
    )
    k, b = (float(value[0]) for value in maximum_passive_stiffness(d))
    assert stiffest.x[0] == pytest.approx(k, rel=1e-6)
    assert stiffest.x[1] == pytest.approx(b, abs=1e-3)  # flat along the boundary
    stiffness, damping = passive_boundary(d, boundary_angle(d) * np.linspace(0, 0.99, 23))
    limits = [((1 - per_damping * at)[per_stiffness > 0] / per_stiffness[per_stiffness > 0]).min() for at in damping]
    np.testing.assert_allclose(stiffness, limits, rtol=2e-5)


def test_values_and_ends() -> None:
    k, b = maximum_passive_stiffness([0, 1, 2])
    np.testing.assert_allclose(k / k[0], [1, 0.4142135, 0.2679491], rtol=1e-6)  # 4.2: 41 % and less than 27 %
    assert b[0] == 0
    for d in DELAYS[1:]:
        straight, last = passive_boundary(d, 0.0), passive_boundary(d, boundary_angle(d))
        assert straight[0][0] == pytest.approx(6 * (d + 1) / ((2 * d + 1) * (2 * d + 3)), rel=1e-12)  # 4.9
        assert straight[1][0] == pytest.approx(d / (2 * d + 3), rel=1e-12)
        assert last[0][0] == pytest.approx(0, abs=1e-12)
        assert last[1][0] == pytest.approx(1, rel=1e-12)


@pytest.mark.sampled
@pytest.mark.parametrize("d", [0.0, 0.5, 1.0, 4.0])
def test_passive_walls_are_robustly_stable(d: float) -> None:
    delta = 0.02
    stiffness, damping = passive_boundary(d, boundary_angle(d) * np.linspace(0, 0.98, 9))
    alpha, beta = delta * stiffness * (1 - 1e-9), delta * damping
    assert is_inside(Loop(1e-3, delta, d), alpha, beta).all()
    assert (alpha < robust_limits(delta, d, beta)[0]).all()


def test_out_of_range() -> None:
    with pytest.raises(ParameterError, match="omega T"):
        passive_boundary(1, 2.0)
