"""A momentum balance averaged over neighbouring rows: still exact, and without the rounding of the velocity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.batch import Booleans, Floats, Integers
from pipeline.correlated import left_over

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
    count = (weight > 0).sum(axis=1)
    chosen = np.zeros(len(columns), dtype=np.int64)
    attenuation = np.full(len(columns), np.inf)
    best_columns, best_impulse = np.zeros_like(columns), np.zeros_like(impulse)
    best_valid = np.zeros(impulse.shape, dtype=bool)
    for width in widths:
        open_trials = (attenuation > ATTENUATION) & ((width * FEWEST_WIDTHS <= count) | (chosen == 0))
        if not open_trials.any():
            break
        t = np.flatnonzero(open_trials)
        total = _running_sum(weight[t], width)
        valid = _running_sum((weight[t] > 0).astype(np.float64), width) > width - 0.5
        divisor = np.where(valid, total, 1.0)
        mean = _running_sum(columns[t] * weight[t][:, :, None], width) / divisor[:, :, None]
        mean = np.where(valid[:, :, None], mean, 0.0)
        pushed = np.where(valid, _running_sum(impulse[t] * weight[t], width) / divisor, 0.0)
        number = np.maximum(valid.sum(axis=1), 1)
        left = left_over(mean[:, :, 0], [mean[:, :, j] for j in range(1, mean.shape[2])])
        error = np.where(valid, (velocity_error[t][:, None] / divisor) ** 2, 0.0).sum(axis=1) / number
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.nan_to_num(error / ((left**2).sum(axis=1) / number), nan=0.0, posinf=1.0)
        span = mean.shape[1]
        best_columns[t], best_impulse[t], best_valid[t] = 0.0, 0.0, False
        best_columns[t, :span], best_impulse[t, :span], best_valid[t, :span] = mean, pushed, valid
        attenuation[t], chosen[t] = np.minimum(share, 1.0), width
    return AveragedBalance(best_columns, best_impulse, best_valid, attenuation, chosen)


def _running_sum(values: Floats, width: int) -> Floats:
    """Sum over ``width`` neighbours along axis 1, as many fewer entries."""
    if values.shape[1] < width:
        return np.zeros((values.shape[0], 0, *values.shape[2:]))
    total = np.cumsum(values, axis=1)
    before = np.concatenate([np.zeros_like(total[:, :1]), total[:, :-width]], axis=1)
    result: Floats = total[:, width - 1 :] - before
    return result
