"""Loops over units of a mixed-effects regression against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.measured.identification import mixed_loops
from pipeline.measured.identification.scatter import Moments, inverse, solve


@pytest.mark.parametrize("size", [1, 2, 5, 9])
def test_an_inverse_and_its_determinant_are_those_of_numpy(size):
    rng = np.random.default_rng(size)
    columns = rng.standard_normal((40, size)) * 10.0 ** rng.uniform(-8, 8, size)
    information, found = columns.T @ columns, np.empty((size, size))
    log = mixed_loops.invert(information, found, np.empty((4, size, size)))
    assert log == pytest.approx(np.linalg.slogdet(information)[1], abs=1e-9)
    scale = np.sqrt(np.diagonal(information))
    np.testing.assert_allclose(found * np.outer(scale, scale), inverse(information) * np.outer(scale, scale), rtol=1e-9)


def test_a_direction_without_information_gets_no_step():
    rng = np.random.default_rng(3)
    columns = rng.standard_normal((6, 30, 2))
    twice = np.concatenate([columns, columns[..., :1], rng.standard_normal((6, 30, 1))], axis=2)
    found = solve(Moments(np.linalg.qr(twice, mode="r"), np.full(6, 30.0)), np.empty(0, dtype=np.int64))
    alone = np.concatenate([columns, twice[..., -1:]], axis=2)
    known = solve(Moments(np.linalg.qr(alone, mode="r"), np.full(6, 30.0)), np.empty(0, dtype=np.int64))
    assert found.step[0] == pytest.approx(found.step[2], abs=1e-12)
    assert [2 * found.step[0], found.step[1]] == pytest.approx(known.step, abs=1e-6)
    assert found.likelihood == pytest.approx(known.likelihood, abs=1e-6)


def test_the_likeliest_noise_is_the_root_of_its_equation():
    rng = np.random.default_rng(4)
    rows = rng.integers(5, 200, 50).astype(float)
    squares = 0.3 * rows * rng.chisquare(4, 50)
    noise = mixed_loops.likeliest_noise(squares, rows, 1e-3, 0.0)
    free = mixed_loops.OWN_ROWS
    assert ((rows + free) * squares / (free * noise + squares)).sum() == pytest.approx(rows.sum(), rel=1e-6)
