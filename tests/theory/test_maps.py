from __future__ import annotations

import numpy as np
import pytest

from pipeline.loop.loop import Loop, Normalised
from pipeline.records.criteria import REPORTED
from pipeline.theory.boundary import boundary
from pipeline.theory.costs import cost_maps
from pipeline.theory.energy import energy_costs
from pipeline.theory.poles import is_stable, spectral_radius
from pipeline.theory.settling_overshoot import transient_costs

LOOP = Normalised(0.58, 1e-3).loop(0.0, 4.0, 4)


@pytest.fixture(scope="module")
def grid():
    border = boundary(LOOP)
    return np.linspace(0, 1.05 * border.alpha_max, 14), np.linspace(-0.02, 1.05 * border.beta_max, 15)


@pytest.fixture(scope="module")
def maps(grid):
    return cost_maps(LOOP, *grid, REPORTED)


def point_wise(grid):
    """Every grid point on its own, with the settings of the functions for single points."""
    alpha, beta = grid
    costs = {c: np.full((len(beta), len(alpha)), np.nan) for c in REPORTED}
    for j, b in enumerate(beta):
        for i, a in enumerate(alpha):
            if a <= 0 or not is_stable(LOOP, [a], [b])[0]:
                continue
            found = energy_costs(LOOP, [a], [b]) | transient_costs(LOOP, [a], [b], continuous=False)
            for c in REPORTED:
                costs[c][j, i] = found[f"{c}_discrete"][0]
    return costs


@pytest.fixture(scope="module")
def expected(grid):
    return point_wise(grid)


@pytest.fixture(scope="module")
def fast(grid):
    """Points whose motion is over within the samples of a map: 0.99^1000 = 4e-5."""
    alpha, beta = np.meshgrid(*grid)
    return (spectral_radius(LOOP, alpha.ravel(), beta.ravel()) < 0.99).reshape(alpha.shape)


def test_maps_equal_the_costs_of_single_points(maps, expected, fast):
    for criterion in REPORTED:
        found, single = maps[criterion], expected[criterion]
        assert found.shape == (15, 14)
        assert np.isfinite(found).sum() > 60
        if criterion.startswith("settle"):
            known = np.isfinite(found)
            np.testing.assert_array_equal(found[known], single[known])
            np.testing.assert_array_equal(known[fast], np.isfinite(single[fast]))
        else:
            np.testing.assert_allclose(found[fast], single[fast], rtol=1e-9, atol=2e-9)
            # elsewhere a beat may add to an overshoot after the end of a map, less than a contour line shows
            np.testing.assert_allclose(found, single, rtol=1e-9, atol=2e-3)


def test_a_slow_overshoot_does_not_empty_the_map_of_settling(grid, maps):
    alone = cost_maps(LOOP, *grid, ["settle_5pct"])["settle_5pct"]
    together = cost_maps(LOOP, *grid, ["settle_5pct", "overshoot"])["settle_5pct"]
    np.testing.assert_array_equal(together, alone)
    assert np.isfinite(alone).sum() >= np.isfinite(maps["settle_5pct"]).sum()


def test_maps_are_empty_outside_the_stable_region(grid, maps):
    alpha, beta = np.meshgrid(*grid)
    outside = ~is_stable(LOOP, alpha.ravel(), beta.ravel()).reshape(alpha.shape) | (alpha == 0)
    assert outside.any()
    assert not outside.all()
    for criterion in REPORTED:
        assert np.isnan(maps[criterion][outside]).all()
        if not criterion.startswith("settle"):
            assert np.isfinite(maps[criterion][~outside]).all()


def test_only_what_is_asked_for_is_returned(grid):
    assert set(cost_maps(LOOP, *grid, ["overshoot"])) == {"overshoot"}
    assert set(cost_maps(LOOP, *grid, ["energy_step_w2"])) == {"energy_step_w2"}


def test_a_spring_of_the_device_moves_the_edge_of_the_map():
    loop = Loop(0.004, 0.007, 2.0)
    alpha = np.array([-0.005, -0.004, -0.002, 0.0])
    found = cost_maps(loop, alpha, np.array([0.05]), ["energy_step_w0"])["energy_step_w0"][0]
    assert np.isnan(found[:2]).all()
    assert np.isfinite(found[2:]).all()


def test_a_grid_without_any_stable_point_is_empty():
    found = cost_maps(LOOP, np.array([1.0, 2.0]), np.array([0.1]), REPORTED)
    assert all(np.isnan(values).all() for values in found.values())
