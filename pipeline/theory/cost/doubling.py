"""Sums over all samples of what a stable loop's states do, by doubling the number of samples again and again."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Floats
from pipeline.theory.cost.refinement import Sums

_DOUBLINGS = 60
"""2^60 samples: the sum of any response with a spectral radius below 1 - 1e-16 has ended long before."""

_CONVERGED = 1e-18
"""Relative size of a last addend that no longer changes a double."""


def weighted_sums(matrix: Floats, initial: Floats) -> Sums:
    """Return X_w = sum_k k^w z_k z_k' for w = 0, 1, 2 of z_{k+1} = A z_k, each of shape (n, states, states).

    Parameters
    ----------
    matrix : float64, shape (n, states, states)
        Stable matrices A.
    initial : float64, shape (states,) or (n, states)
        z_0, the same for all or one each.

    Notes
    -----
    From the sums over N samples, those over 2 N follow as X_w + A^N [sum_i binomial(w, i) N^(w-i) X_i] A^N', so m
    doublings sum 2^m samples. All addends are positive semidefinite: nothing cancels.
    """
    first = np.broadcast_to(initial[..., :, None] * initial[..., None, :], matrix.shape)
    return doubled(matrix, (first, np.zeros_like(matrix), np.zeros_like(matrix)))


def doubled(matrix: Floats, addends: Sums) -> Sums:
    """Solutions of X_0 = R_0 + A X_0 A', X_1 = R_1 + A (X_1 + X_0) A', X_2 = R_2 + A (X_2 + 2 X_1 + X_0) A'.

    NaN where they do not converge: of a matrix that is not stable, or is not to the digits of a double.
    """
    x0, x1, x2 = addends
    power, count = matrix, 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            turned = np.swapaxes(power, 1, 2)
            add2 = power @ (x2 + 2 * count * x1 + count * count * x0) @ turned
            add1 = power @ (x1 + count * x0) @ turned
            add0 = power @ x0 @ turned
            x0, x1, x2 = x0 + add0, x1 + add1, x2 + add2
            total = size(x2)
            ended = (size(add2) <= _CONVERGED * total) & (size(add0) <= _CONVERGED * size(x0))
            if np.all(ended | ~np.isfinite(total)):
                break
            power = power @ power
            count *= 2
    for sums in (x0, x1, x2):
        sums[~ended] = np.nan
    return x0, x1, x2


def size(matrices: Floats) -> Floats:
    """Sum of the sizes along the diagonal, where sums of squares have their largest entries."""
    return np.asarray(np.abs(np.diagonal(matrices, axis1=1, axis2=2)).sum(axis=1))
