"""Compute the modes of a closed loop for a march, from polynomials for its poles or from eigenvectors."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.base.constants import Constants
from pipeline.loop.many_digits import as_exact, as_floats, many_digits, resolvent, unit
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Floats
from pipeline.theory.motion import DEGREE, interval_motion, own_basis

Complexes = NDArray[np.complex128]

_LONGEST = 8
"""Largest number of states without delayed forces for which polynomials are accurate."""

STILL_REPRODUCED = 1e-11
"""Largest difference between a state and its modes, relative to its motion. It may grow by this amount in every
`march.ROUNDED_SAMPLES`."""


def by_eigenvectors(loop: NormalisedLoop, alpha: Floats, beta: Floats) -> tuple[Complexes, Complexes]:
    """Return poles, shape (n, modes), and the modal components of the state at sample 0 of a step response.

    The parts have the shape (n, modes, states). States are those of a march, followed by the wall forces of the last
    samples, newest first. Values are nan if the eigenvectors do not span the states.
    """
    pole, vectors = (part.astype(np.complex128) for part in np.linalg.eig(loop.matrix(alpha, beta)))
    apart = np.isfinite(np.linalg.slogdet(vectors)[1])
    vectors[~apart] = np.eye(loop.states)
    amplitude = np.linalg.solve(vectors, loop.starts(alpha, "step")[:, :, None])[:, :, 0]
    amplitude[~apart] = np.nan
    state, basis = (vectors * amplitude[:, None, :]).transpose(0, 2, 1), own_basis(loop)[0]
    state[..., : len(basis)] = state[..., : len(basis)] @ basis.T
    return pole, np.ascontiguousarray(state)


@lru_cache(maxsize=64)
def not_given(loop: NormalisedLoop) -> Constants:
    """Return first poles and empty arrays in place of `by_eigenvectors`. A march computes modes from polynomials."""
    n = loop.states
    return Constants((first_poles(loop), np.empty((0, n), np.complex128), np.empty((0, n, n), np.complex128)))


@lru_cache(maxsize=64)
def modal(loop: NormalisedLoop) -> Constants:
    """Return `polynomials` and `hull`."""
    return Constants((*polynomials(loop), hull(loop)))


@lru_cache(maxsize=64)
def first_poles(loop: NormalisedLoop) -> Complexes:
    """Return the poles minus 1 of the wall alpha = beta = 1, shape (states,), as starting values for the first wall."""
    one = np.ones(1)
    return np.asarray(np.linalg.eigvals(loop.matrix(one, one))[0] - 1.0, np.complex128)


@lru_cache(maxsize=64)
def polynomials(loop: NormalisedLoop) -> tuple[Floats, ...]:
    """Return determinant D and adjugate of z - A without delayed forces, as polynomials in zeta, lowest power first.

    Returns
    -------
    determinant : float64, shape (own + 1,)
        Empty for a long filter, since its polynomials lose digits.
    walls : float64, shape (2, own + 1)
        Products of position and velocity with the columns. The poles solve z^delay D + alpha walls_0 + beta walls_1 =
        0.
    rows : float64, shape (2, own, own)
        Products of the rows of position and velocity with the adjugate. The last two axes are powers and states.
    columns : float64, shape (own + 1, own)
        Product of the adjugate and the gains of the forces, with those of the newer force multiplied by z. The axes are
        powers and states.
    gains : float64, shape (2, own)
        Gains of the oldest force and of the next one.
    """
    steps, n = loop.own, len(loop.own.free)
    if n > _LONGEST:
        return np.zeros(0), np.zeros((1, 1)), np.zeros((2, n, n)), *(np.zeros((1, 1)) for _ in range(2))
    with many_digits(loop.digits):
        none = as_exact(np.zeros((1, n)))
        determinant, inverse = resolvent(steps.free - unit(n))
        older, newer = (steps.gains[0], steps.gains[1] if len(steps.gains) > 1 else none[0])
        columns = np.concatenate([inverse @ (older + newer), none]) + np.concatenate([none, inverse @ newer])
        outputs = np.array([steps.position, steps.velocity])
        rows, gains, walls = np.swapaxes(outputs @ inverse, 0, 1), np.array([older, newer]), outputs @ columns.T
    basis, turned = own_basis(loop)
    parts = as_floats(rows) @ turned, as_floats(columns) @ basis.T, as_floats(gains) @ basis.T
    return tuple(map(np.ascontiguousarray, (as_floats(determinant), as_floats(walls), *parts)))


@lru_cache(maxsize=64)
def hull(loop: NormalisedLoop) -> Floats:
    """Return the Bernstein coefficients of the position over all pieces, shape (coefficients, own + 2).

    They map own states and two forces (`interval_motion`). The position is between the smallest and the largest
    coefficient.
    """
    curves = interval_motion(loop, True)[2]
    return np.ascontiguousarray((_bernstein(curves.shape[1]) @ curves).reshape(-1, curves.shape[2]))


@lru_cache(maxsize=DEGREE + 1)
def _bernstein(powers: int) -> Floats:
    """Return the matrix that converts coefficients, lowest power first, to a Bernstein basis of about twice the degree.

    A raised degree moves the coefficients closer to the curve.
    """
    degree = min(2 * powers, DEGREE)
    return np.array([[math.comb(j, i) / math.comb(degree, i) for i in range(powers)] for j in range(degree + 1)])
