"""Local planes by a compiled loop, against weighted least squares of one point after the other."""

import numpy as np
import pytest

from pipeline.comparison.scores.local_planes import NO_ERROR, ROBUST, local_planes


def smoothed(x, y, values, neighbours):
    """Smooth values by `numpy.linalg.lstsq` of each point's neighbours: the solution of least norm."""
    points = np.stack([x, y], axis=1)
    spread = points.std(axis=0)
    points = points / np.where(spread > 0, spread, 1.0)
    away = np.linalg.norm(points[:, None] - points, axis=2)
    sure = np.ones(len(x))
    for _ in range(ROBUST + 1):
        result, usual = np.empty(len(x)), np.empty(len(x))
        near_of = np.argsort(away, axis=1, kind="stable")[:, :neighbours]
        for i, near in enumerate(near_of):
            weight = (1 - (away[i, near] / (away[i, near[-1]] * (1 + 1e-9))) ** 3) ** 3 * sure[near]
            root = np.sqrt(weight)
            design = np.column_stack([np.ones(len(near)), points[near] - points[i]])
            result[i] = np.linalg.lstsq(root[:, None] * design, root * values[near], rcond=1e-6)[0][0]
        error = np.abs(values - result)
        for i, near in enumerate(near_of):
            usual[i] = max(6 * np.median(error[near]), NO_ERROR)
        sure = (1 - np.minimum(error / usual, 1.0) ** 2) ** 2
    return result


@pytest.mark.parametrize(("count", "neighbours"), [(60, 40), (61, 12), (9, 9), (25, 40)])
@pytest.mark.parametrize("on_a_line", [False, True])
def test_planes_are_weighted_least_squares_and_outliers_count_little(count, neighbours, on_a_line):
    rng = np.random.default_rng(count + on_a_line)
    x, y = rng.uniform(100, 5000, count), np.full(count, 3.0) if on_a_line else rng.uniform(0, 80, count)
    plain = 1 + 1e-4 * x - 0.01 * y
    values = plain + 0.01 * rng.standard_normal(count)
    values[::8] += 50.0
    found = local_planes(x, y, values, neighbours).of(values)
    np.testing.assert_allclose(found, smoothed(x, y, values, min(neighbours, count)), rtol=0, atol=1e-9)
    if neighbours == 40 and count > 40:
        normal = np.arange(count) % 8 > 0
        assert np.abs(found - plain)[normal].max() < 0.05


def test_points_at_one_place_have_their_robust_mean():
    values = np.array([1.0, 1.0, 1.0, 1.0, 9.0])
    found = local_planes(np.ones(5), np.ones(5), values).of(values)
    np.testing.assert_allclose(found, 1.0, atol=1e-12)
