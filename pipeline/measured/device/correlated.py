"""Least squares of many trials whose residuals wander: what columns have in common, and what that does to errors."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers


def left_over(column: Floats, others: list[Floats]) -> Floats:
    """Return the part of a column that is orthogonal to others, by modified Gram-Schmidt done twice.

    Parameters
    ----------
    column : float64, shape (n, N)
        One column for each of n fits.
    others : list of float64, shape (n, N)
        Columns that take their part away; one that depends on those before it takes nothing.
    """
    basis: list[Floats] = []
    for other in others:
        basis.append(direction(other, basis))
    return without(column, basis)


def without(column: Floats, basis: list[Floats]) -> Floats:
    """Return a column, shape (n, N), without its parts along orthonormal directions."""
    rest = column
    for _ in range(2):  # once loses the digits that the first projection took away
        for unit in basis:
            rest = rest - unit * np.einsum("nk,nk->n", unit, rest)[:, None]
    return rest


def direction(column: Floats, basis: list[Floats]) -> Floats:
    """Return the direction of what a column has beside others, 0 for one that depends on them, shape (n, N)."""
    rest = without(column, basis)
    size, whole = (np.sqrt(np.einsum("nk,nk->n", part, part)) for part in (rest, column))
    # what rounding leaves of a dependent column is no direction
    factor = np.where(size > 1e-12 * whole, 1 / np.where(size > 0, size, 1.0), 0.0)
    result: Floats = rest * factor[:, None]
    return result


def score_covariance(
    scaled: Floats, residual: Floats, valid: Booleans, unknowns: Integers, width: Integers, segments: int
) -> Floats:
    """Return the covariance of the scores, columns times residuals, of n fits of q unknowns, shape (n, q, q).

    Parameters
    ----------
    scaled : float64, shape (n, N, q)
        Columns of the fits.
    residual : float64, shape (n, N)
    valid : bool, shape (n, N)
        Rows that were fitted.
    unknowns : int64, shape (n,)
        Unknowns that each fit had.
    width : int64, shape (n,)
        Rows over which neighbouring residuals share their errors.
    segments : int
        Parts whose errors count as independent.

    Notes
    -----
    Between the inverse of two standard normal equations this is the sandwich estimate of the unknowns'
    covariance. Two parts add up. Errors that die out: the scores of `segments` parts of the rows, taken as
    independent. Errors that are integrated and never die out, a random walk: each of its steps stays in all
    later residuals; its rate is read from how much farther apart residuals a segment apart lie than those
    `width` rows apart. A walk is in both parts, so that the sum is up to 40 % too careful.
    """
    n, _, q = scaled.shape
    count = valid.sum(axis=1)
    rank = np.cumsum(valid, axis=1) - 1
    # what is not valid goes to a part of its own, which is left out
    part = np.where(valid, rank * segments // np.maximum(count, 1)[:, None], segments)
    part += np.arange(n)[:, None] * (segments + 1)
    scores = np.empty((n, segments + 1, q))
    for j in range(q):
        score = np.bincount(part.ravel(), (scaled[:, :, j] * residual).ravel(), n * (segments + 1))
        scores[:, :, j] = score.reshape(n, segments + 1)
    scores = scores[:, :segments]
    meat = np.swapaxes(scores, 1, 2) @ scores
    meat *= (segments / np.maximum(segments - unknowns, 1))[:, None, None]
    near, far = width, np.maximum(count // segments, width + 1)
    rate = (_squared_distance(residual, valid, far) - _squared_distance(residual, valid, near)) / (far - near)
    # each step of the walk stays in all later residuals
    later = np.cumsum(np.where(valid[:, :, None], scaled, 0.0)[:, ::-1], axis=1)[:, ::-1]
    walk = np.swapaxes(later * valid[:, :, None], 1, 2) @ later
    result: Floats = meat + np.maximum(rate, 0.0)[:, None, None] * walk
    return result


def _squared_distance(residual: Floats, valid: Booleans, lag: Integers) -> Floats:
    """Mean squared difference of residuals ``lag`` rows apart, shape (n,); 0 where there are none."""
    result = np.zeros(len(residual))
    for rows in np.unique(lag[lag < residual.shape[1]]):
        t = np.flatnonzero(lag == rows)
        value, there = residual[t], valid[t]
        both = there[:, rows:] & there[:, : -rows or None]
        square = np.where(both, (value[:, rows:] - value[:, : -rows or None]) ** 2, 0.0)
        result[t] = square.sum(axis=1) / np.maximum(both.sum(axis=1), 1)
    return result
