"""A momentum balance averaged over neighbouring rows: still exact, and without the rounding of the velocity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.device.correlated import left_over
from pipeline.records.batch import Booleans, Floats, Integers

ATTENUATION = 0.005
"""Share of the velocity's variance that the sensor may make: least squares loses as much of the mass."""

WIDTHS = (1, 2, 4, 8, 16, 32, 64)
"""Rows over which the balance may be averaged to get there."""

FEWEST_WIDTHS = 8
"""Averages, laid end to end, that a window must hold: fewer would smooth the motion itself away."""


@dataclass(frozen=True, eq=False)
class AveragedBalance:
    """Balance of n trials averaged over neighbouring rows.

    Parameters
    ----------
    columns : float64, shape (n, N, q)
    impulse : float64, shape (n, N)
        Means over ``width`` neighbours, weighted by their durations; 0 where there are not as many.
    valid : bool, shape (n, N)
        Where there are as many.
    attenuation : float64, shape (n,)
        Share of the velocity's variance, beside that of all other terms, that the sensor makes.
    width : int64, shape (n,)
        Rows averaged over.
    """

    columns: Floats
    impulse: Floats
    valid: Booleans
    attenuation: Floats
    width: Integers


def averaged_balance(
    columns: Floats, impulse: Floats, weight: Floats, velocity_error: Floats, width_rows: int | None
) -> AveragedBalance:
    """Return the balance of each trial averaged over so many rows that its velocity is good.

    Parameters
    ----------
    columns : float64, shape (n, N, q)
        Terms of the balance, the velocity first; 0 outside the window.
    impulse : float64, shape (n, N)
    weight : float64, shape (n, N)
        Durations of the intervals [s]; 0 outside the window.
    velocity_error : float64, shape (n,)
        Standard error of a velocity times its duration [m, rad].
    width_rows : int or None
        Rows to average over; None chooses the fewest of `WIDTHS` that leave at most `ATTENUATION`.

    Returns
    -------
    AveragedBalance
    """
    widths = WIDTHS if width_rows is None else (width_rows,)
    n, rows, terms = columns.shape
    count = (weight > 0).sum(axis=1)
    chosen = np.zeros(n, dtype=np.int64)
    attenuation = np.full(n, np.inf)
    # time last in memory: neighbours in time are neighbours there
    best, best_valid = np.zeros((n, terms + 1, rows)), np.zeros((n, rows), dtype=bool)
    # integrals from the first row on of all terms, the impulse and the duration, shared by all widths
    integrals = np.zeros((n, terms + 2, rows + 1))
    for j in range(terms):
        np.cumsum(columns[:, :, j] * weight, axis=1, out=integrals[:, j, 1:])
    np.cumsum(impulse * weight, axis=1, out=integrals[:, terms, 1:])
    np.cumsum(weight, axis=1, out=integrals[:, terms + 1, 1:])
    inside = np.zeros((n, rows + 1), dtype=np.int64)
    np.cumsum(weight > 0, axis=1, out=inside[:, 1:])
    for width in widths:
        open_trials = (attenuation > ATTENUATION) & ((width * FEWEST_WIDTHS <= count) | (chosen == 0))
        if not open_trials.any():
            break
        t = slice(None) if open_trials.all() else np.flatnonzero(open_trials)
        whole, several = integrals[t], inside[t]
        sums = whole[:, :, width:] - whole[:, :, : rows + 1 - width]
        valid = several[:, width:] - several[:, : rows + 1 - width] == width
        divisor = np.where(valid, sums[:, -1], 1.0)
        means = np.where(valid, 1 / divisor, 0.0)[:, None, :] * sums[:, :-1]
        number = np.maximum(valid.sum(axis=1), 1)
        left = left_over(means[:, 0], [means[:, j] for j in range(1, terms)])
        error = np.where(valid, (velocity_error[t, None] / divisor) ** 2, 0.0).sum(axis=1) / number
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.nan_to_num(error / (np.einsum("nk,nk->n", left, left) / number), nan=0.0, posinf=1.0)
        span = valid.shape[1]
        best[t, :, :span], best[t, :, span:] = means, 0.0
        best_valid[t, :span], best_valid[t, span:] = valid, False
        attenuation[t], chosen[t] = np.minimum(share, 1.0), width
    return AveragedBalance(np.moveaxis(best[:, :-1], 1, 2), best[:, -1], best_valid, attenuation, chosen)
