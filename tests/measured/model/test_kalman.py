"""The compiled filter against the joint normal distribution of all readings, and against matrices row by row."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from pipeline.measured.model.kalman import filter_gains, prediction_errors

N, S, Q = 24, 3, 0.3


def device(states, uneven, seed=1):
    """Transitions, gains of a force and sensor of some device, each row its own where rows are uneven."""
    rng = np.random.default_rng(seed)
    rows, segments = (N, S) if uneven else (1, 1)
    F = np.eye(states) + 0.3 * rng.normal(size=(rows, segments, states, states))
    return F / 1.2, rng.normal(size=(rows, segments, states)), rng.normal(size=states)


def jitter(ages, seed=2):
    """Forces of each age, chances of one after another less those after any, and covariance of the ages."""
    rng = np.random.default_rng(seed)
    if not ages:
        return np.zeros((N, S, 0)), np.zeros((0, 0)), np.zeros((0, 0))
    after = rng.dirichlet(np.ones(ages), size=ages)
    chances = np.linalg.matrix_power(after, 200)[0]
    return rng.normal(size=(N, S, ages)), after - chances, np.diag(chances) - np.outer(chances, chances)


def row(values, k, s):
    return values[min(k, len(values) - 1), min(s, values.shape[1] - 1)]


def covariance(F, G, H, c, M, C, s):
    """Covariance (N, N) of the readings of a segment: sums over the forces of all intervals before."""
    pulse = np.zeros((N, N))
    for first in range(N):
        state = row(G, first, s)
        for k in range(first + 1, N):
            pulse[k, first] = H @ state
            state = row(F, k, s) @ state
    forces = Q * np.eye(N)
    for k in range(N):
        for m in range(k, N):
            # not known at the first row, as the filter begins: the ages there are as likely as ever
            forces[k, m] += c[k, s] @ C @ np.linalg.matrix_power(M, m - k) @ c[m, s]
            forces[m, k] = forces[k, m]
    return np.eye(N) + pulse @ forces @ pulse.T


def by_matrices(y, u, x0, device, c, M, C, rows):
    """The same filter with numpy's products, for a column (N, S)."""
    F, G, H = device
    n, A = len(H), len(M)
    errors, spreads, sensor = np.zeros((N, S), y.dtype), np.ones((N, S)), np.append(H, np.zeros(A))
    for s in range(S):
        z, P = np.append(x0[s], np.zeros(A)), np.zeros((n + A, n + A))
        P[n:, n:] = C
        for k in range(rows[s]):
            spread = 1 + np.real(sensor @ P @ sensor)
            gain = P @ sensor / spread
            errors[k, s], spreads[k, s] = y[k, s] - sensor @ z, np.sqrt(spread)
            f, g = row(F, k, s), row(G, k, s)
            phi = np.block([[f, np.outer(g, c[k, s])], [np.zeros((A, n)), M.T]])
            added = np.zeros((n + A, n + A))
            added[:n, :n], added[n:, n:] = Q * np.outer(g, g), C - M.T @ C @ M
            z = phi @ (z + gain * errors[k, s]) + np.append(u[k, s], np.zeros(A))
            P = phi @ (P - np.outer(gain, gain) * spread) @ phi.T + added
    return errors, spreads


KINDS = [(2, 0, True), (4, 0, True), (2, 3, False), (3, 5, False), (5, 2, True)]


@pytest.mark.parametrize(("states", "ages", "uneven"), KINDS)
def test_errors_have_the_joint_distribution_of_the_readings(states, ages, uneven):
    F, G, H = device(states, uneven)
    c, M, C = jitter(ages)
    rows = np.full(S, N)
    gains, spread = filter_gains(F, G, H, c, M, C, Q, rows)
    y = np.random.default_rng(3).normal(size=(1, N, S))
    none = np.zeros((1, N, S, states)), np.zeros((1, S, states))
    errors = prediction_errors(y, *none, F, G, H, gains, c, M, rows)[0] / spread
    for s in range(S):
        dense = multivariate_normal(np.zeros(N), covariance(F, G, H, c, M, C, s)).logpdf(y[0, :, s])
        filtered = -0.5 * errors[:, s] @ errors[:, s] - np.log(spread[:, s]).sum() - 0.5 * N * np.log(2 * np.pi)
        assert filtered == pytest.approx(dense, rel=1e-10)


@pytest.mark.parametrize(("states", "ages", "uneven"), KINDS)
def test_columns_are_those_of_matrices_row_by_row_up_to_the_end_of_each_segment(states, ages, uneven):
    rng = np.random.default_rng(4)
    own, (c, M, C), rows = device(states, uneven), jitter(ages), np.array([N, 1, 17])
    y, u, x0 = rng.normal(size=(2, N, S)), rng.normal(size=(2, N, S, states)), rng.normal(size=(2, S, states))
    gains, spread = filter_gains(*own, c, M, C, Q, rows)
    errors = prediction_errors(y, u, x0, *own, gains, c, M, rows)
    for column in range(2):
        expected, spreads = by_matrices(y[column], u[column], x0[column], own, c, M, C, rows)
        np.testing.assert_allclose(errors[column], expected, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(spread, spreads, rtol=1e-11)
    assert (gains[1:, 1] == 0).all()


@pytest.mark.parametrize(("states", "ages", "uneven"), KINDS)
def test_imaginary_parts_are_slopes(states, ages, uneven):
    rng = np.random.default_rng(5)
    (F, G, H), (c, M, C), rows = device(states, uneven), jitter(ages), np.full(S, N)
    gains, _ = filter_gains(F, G, H, c, M, C, Q, rows)
    y, u, x0 = rng.normal(size=(1, N, S)), rng.normal(size=(1, N, S, states)), rng.normal(size=(1, S, states))
    ways = [rng.normal(size=each.shape) for each in (u, x0, F, G, H)]

    def along(step):
        moved = [each + step * way for each, way in zip((u, x0, F, G, H), ways, strict=True)]
        return prediction_errors(y + 0 * step, *moved, gains, c, M, rows)

    slope = along(1e-20j).imag / 1e-20
    difference = (along(1e-6) - along(-1e-6)) / 2e-6
    np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("step", [0.0, 1e-20j])
def test_machine_code_gives_the_numbers_of_python(step):
    rng = np.random.default_rng(6)
    (F, G, H), (c, M, C), rows = device(3, True), jitter(4), np.array([N, 9, 2])
    arguments = F, G, H, c, M, C, Q, rows
    (gains, spread), (slow_gains, slow_spread) = filter_gains(*arguments), filter_gains.__wrapped__(*arguments)
    np.testing.assert_allclose(gains, slow_gains, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(spread, slow_spread, rtol=1e-12)
    entering = rng.normal(size=(2, N, S)), rng.normal(size=(2, N, S, 3)), rng.normal(size=(2, S, 3)), F, G, H
    columns = [each + step for each in entering]
    fast = prediction_errors(*columns, gains, c, M, rows)
    slow = prediction_errors.__wrapped__(*columns, gains, c, M, rows)
    np.testing.assert_allclose(fast, slow, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(fast.imag, slow.imag, rtol=1e-10, atol=1e-30)


def test_numbers_that_are_none_stay_so_without_a_warning():
    F, G, H = device(2, False)
    c, M, C = jitter(0)
    spread = filter_gains(F * np.nan, G, H, c, M, C, Q, np.full(S, N))[1]
    assert np.isnan(spread[2:]).all()
    spread = filter_gains(1e200 * F, G, H, c, M, C, Q, np.full(S, N))[1]
    assert not np.isfinite(spread[-1]).any()
