from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.device.correlated import left_over, score_covariance


def test_left_over_is_the_residual_of_least_squares():
    random = np.random.default_rng(0)
    columns = random.standard_normal((3, 50, 3))
    columns[:, :, 2] = 2 * columns[:, :, 0] - columns[:, :, 1]  # depends on the others: takes nothing more away
    target = random.standard_normal((3, 50))
    found = left_over(target, [columns[:, :, j] for j in range(3)])
    for i in range(3):
        expected = target[i] - columns[i, :, :2] @ np.linalg.lstsq(columns[i, :, :2], target[i], rcond=None)[0]
        np.testing.assert_allclose(found[i], expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["white", "walk"])
def test_sandwich_tells_the_scatter_of_the_coefficients(kind):
    """Error of a slope over 400 simulated series against the error that each of them states."""
    random = np.random.default_rng(1)
    n, rows = 400, 300
    error = random.standard_normal((n, rows))
    if kind == "walk":
        error = np.cumsum(error, axis=1)
    columns = np.broadcast_to(np.stack([np.ones(rows), np.sin(np.arange(rows) / 25)], axis=1), (n, rows, 2))
    inverse = np.linalg.inv(columns[0].T @ columns[0])
    found = np.einsum("ij,kj,nk->ni", inverse, columns[0], error)
    residual = error - np.einsum("nkj,nj->nk", columns, found)
    whole, ones = np.ones((n, rows), bool), np.ones(n, np.int64)
    meat = score_covariance(columns, residual, whole, 2 * ones, ones, 10)
    variance = np.einsum("ij,njk,kl->nil", inverse, meat, inverse)[:, 1, 1]
    ratio = found[:, 1].std() / np.sqrt(np.median(variance))
    # white: ten parts scatter by a quarter; walk: in both parts of the sum, and the fit takes some of it away
    assert 0.6 < ratio < 1.3
