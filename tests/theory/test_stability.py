"""Spectral radius against polynomial roots in 50 digits; boundary against Schur-Cohn verdicts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from independent import characteristic, extreme_cases, random_loops, stable_by_schur_cohn, stable_walls, wall_of_radius

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Booleans, Floats
from pipeline.theory.boundary import Boundary, boundary
from pipeline.theory.poles import is_stable, spectral_radius

ORDINARY = [(0, 0, 0), (0, 0, 1), (0.001, 0.02, 2), (0, 0, 0.5), (1e-3, 0.1, 2.75), (0, 0, 16), (0, 10, 2), (0, 0, 64)]
RESONANT = [(1.0, 0.1, 2.5), (5.0, 1.0, 1), (0.3, 0.05, 4), (9.8, 0.0, 1), (20.0, 10.0, 2), (1.0, 0.1, 16)]
UNDELAYED = [(0.0, 10.0, 0), (20.0, 10.0, 0), (9.8, 0.0, 0), (0.0, 6.0, 0.25)]
"""Beyond about 2 m/T of damping, the region of an undelayed loop ends at a real pole z = -1."""


def random_points(count: int, seed: int, largest: float) -> list[tuple[float, float, float, float, float]]:
    rng = np.random.default_rng(seed)
    points = []
    for _ in range(count):
        d = float(rng.choice([0, 1, 2, 3, rng.uniform(0, largest)]))
        gamma = float(rng.choice([0, 1e-14, 1e-3, rng.uniform(0, 9)]))
        delta = float(rng.choice([0, 1e-14, 0.02, 10, rng.uniform(0, 3)]))
        alpha = -gamma + float(rng.uniform(-0.2, 1.5)) * (0.5 / (1 + d) ** 2 + gamma)
        points.append((gamma, delta, d, alpha, float(rng.uniform(-0.3, 1.3)) / (0.5 + d)))
    return points


def check_radius(point: tuple[float, float, float, float, float], tolerance: float) -> None:
    """All roots lie inside a circle that is a little larger, and not all inside one that is a little smaller."""
    gamma, delta, d, alpha, beta = point
    found, polynomial = (
        float(spectral_radius(NormalisedLoop.ideal(gamma, delta, d), alpha, beta)[0]),
        characteristic(*point),
    )
    assert stable_by_schur_cohn(polynomial, found * (1 + tolerance)), (point, found)
    assert not stable_by_schur_cohn(polynomial, found * (1 - tolerance)), (point, found)


@pytest.mark.slow
def test_spectral_radius_of_random_points() -> None:
    points = random_points(300, seed=2, largest=4)
    for point in points:
        # 1e-7: on alpha = -gamma with gamma = delta = 0 a double pole at z = 1 splits by the root of rounding
        check_radius(point, 1e-7)
    for gamma, delta, p, q, alpha, beta in stable_walls(random_loops(60, seed=3), each=2, seed=4):
        check_radius((gamma, delta, p / q, alpha, beta), 1e-9)


def test_spectral_radius_of_extreme_points() -> None:
    cases = [(g, delta, p / q, a, b) for g, delta, p, q, a, b in extreme_cases() if p / q < 100]
    for case in cases:
        check_radius(case, 1e-7)  # walls of 1e-11 leave the plant's poles as close together as they are
    count = len(cases)
    for gamma, delta, delay in [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1e-3, 0.02, 0.5), (0.0, 2.0, 1.5)]:
        for k in range(1, 13):
            wall = wall_of_radius(gamma, delay, delta, 1 - 10.0**-k)
            radius = spectral_radius(NormalisedLoop.ideal(gamma, delta, delay), *wall)[0]
            assert radius == pytest.approx(1 - 10.0**-k, abs=2e-14), (gamma, delta, delay, k)
            count += 1
    assert count >= 60


@pytest.mark.parametrize("d", [16.0, 64.0, 64.5])
def test_verdicts_at_long_delays(d: float) -> None:
    # rounding a polynomial in z loses these; the margins are far above that of the state space
    border = boundary(NormalisedLoop.ideal(0.0, 0.0, d))
    for factor in (1 - 1e-6, 1 + 1e-6):
        point = border.alpha_max * factor, border.beta_at_alpha_max
        exact = stable_by_schur_cohn(characteristic(0, 0, d, *point))
        assert exact == (factor < 1)
        assert is_stable(NormalisedLoop.ideal(0.0, 0.0, d), *point)[0] == exact


@pytest.mark.parametrize(
    "loop",
    [
        NormalisedLoop.ideal(0, 0, 2),
        NormalisedLoop.ideal(0.001, 0.02, 1),
        NormalisedLoop.ideal(9.8, 0, 0),
        NormalisedLoop.ideal(0, 10, 2.5),
    ],
)
def test_the_line_without_stiffness_is_not_stable(loop: NormalisedLoop) -> None:
    beta = np.linspace(0.01, 0.4, 50)  # an eigenvalue alone says 1 - 2e-16 at some of them
    assert not is_stable(loop, -loop.gamma, beta).any()


def beside_islands(border: Boundary, alpha: Floats, beta: Floats, steps: tuple[float, float]) -> Booleans:
    """Whether each point is farther from all islands than the steps of a grid in alpha and beta."""
    if not len(border.islands):
        return np.ones(alpha.shape, dtype=bool)
    island, low, high = border.islands[np.argsort(border.islands[:, 0])].T
    near = np.abs(beta.ravel()[:, None] - island) <= steps[1]
    inside = (low - steps[0] <= alpha.ravel()[:, None]) & (alpha.ravel()[:, None] <= high + steps[0])
    place = np.clip(np.searchsorted(island, beta), 1, max(len(island) - 1, 1))
    # rows of one island are closer than two islands
    between = (island[0] <= beta) & (beta <= island[-1]) & (np.append(np.diff(island), np.inf)[place - 1] < 1.0)
    between &= np.interp(beta, island, low) - steps[0] <= alpha
    between &= alpha <= np.interp(beta, island, high) + steps[0]
    return np.asarray(~((near & inside).any(axis=1).reshape(alpha.shape) | between))


@pytest.mark.sampled
@pytest.mark.parametrize("values", [*ORDINARY, *RESONANT, *UNDELAYED])
def test_extremes_against_a_dense_grid_of_verdicts(values: tuple[float, float, float]) -> None:
    loop = NormalisedLoop.ideal(*values)
    border = boundary(loop)
    lowest = float(np.nanmin(border.beta))
    width, height = border.alpha_max + loop.gamma, border.beta_max - lowest
    size = 80 if loop.states < 30 else 24
    # the grid reaches beyond the region on all sides, so that a part that was missed would be seen
    alpha, beta = np.meshgrid(
        -loop.gamma + width * np.linspace(1e-3, 1.5, size), lowest + height * np.linspace(-0.5, 1.5, size)
    )
    steps = float(alpha[0, 1] - alpha[0, 0]), float(beta[1, 0] - beta[0, 0])
    stable = is_stable(loop, alpha.ravel(), beta.ravel()).reshape(alpha.shape) & beside_islands(
        border, alpha, beta, steps
    )
    assert stable.any()
    assert alpha[stable].max() <= border.alpha_max * (1 + 1e-8)
    assert beta[stable].max() <= border.beta_max + 1e-6 * height
    assert beta[stable].min() >= min(lowest, -loop.delta) - 1e-2 * height
    near = -loop.gamma + width * (1 - 1e-6)
    assert is_stable(loop, near, border.beta_at_alpha_max + height * np.linspace(-1e-5, 1e-5, 201)).any()
    others = lowest + height * np.linspace(-0.5, 1.5, 401 if size > 30 else 41)
    beyond = np.full(len(others), -loop.gamma + width * (1 + 1e-6))
    assert not (is_stable(loop, beyond, others) & beside_islands(border, beyond, others, steps)).any()


@pytest.mark.parametrize("values", [*ORDINARY, *RESONANT, *UNDELAYED])
def test_every_point_of_the_boundary_has_a_pole_on_the_circle_and_none_outside(
    values: tuple[float, float, float],
) -> None:
    loop = NormalisedLoop.ideal(*values)
    border = boundary(loop, 60)
    some = slice(2, -1, 1 if loop.states < 30 else 20)
    radius = spectral_radius(loop, border.alpha[some], border.beta[some])
    np.testing.assert_allclose(radius, 1, rtol=0, atol=3e-8)  # 3e-8: pole pairs close to z = 1 or -1 are nearly double


def test_closed_values_without_delay_and_with_one_sample() -> None:
    # d = 0: alpha_max = 12 - 8 sqrt 2; d = 1: beta_max = 2 (sqrt 2 - 1)
    assert boundary(NormalisedLoop.ideal(0, 0, 0)).alpha_max == pytest.approx(12 - 8 * math.sqrt(2), rel=1e-13)
    assert boundary(NormalisedLoop.ideal(0, 0, 0)).beta_at_alpha_max == pytest.approx(2 * (math.sqrt(2) - 1), rel=1e-6)
    assert boundary(NormalisedLoop.ideal(0, 0, 1)).beta_max == pytest.approx(2 * (math.sqrt(2) - 1), rel=1e-13)


def test_the_boundary_moves_steadily_with_the_delay() -> None:
    alpha = [boundary(NormalisedLoop.ideal(0, 0, d)).alpha_max for d in np.linspace(0, 3, 25)]
    assert (np.diff(alpha) < 0).all()


def test_too_few_points_are_refused() -> None:
    with pytest.raises(ParameterError, match="at least 8"):
        boundary(NormalisedLoop.ideal(0, 0, 0), 7)
