"""Lag of a logged velocity behind the derivative of the logged position: filters and old readings show here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.wording import percent
from pipeline.records.batch import Floats, TrialBatch

FEWEST_ROWS = 20
"""Gain, lag and offset with fewer rows follow the noise."""

SPAN_ROWS = 8
"""Rows over which the velocity is integrated. Over one, the rounding of both positions rules: on a servo's log errors
five times as large; over sixteen and more, those of the velocity add up and are alike for long."""

SEARCH_PERIODS = 20.0
"""Largest lag looked for, in median row distances; a filter of a drive rarely takes as long."""

COARSE_STEP = 0.5
"""Step of the search in median row distances: the cost is smooth over one row."""

ITERATIONS = 8
"""Gauss-Newton steps from the best point of the search; four settle it to rounding."""

SEGMENTS = 10
"""Parts of the log whose errors count as independent: overlapping spans are alike for a few rows only."""

LEAST_GAIN, LARGEST_GAIN = 0.5, 2.0
"""Velocity over derivative of the position: outside, the two have different units, or are different things."""

LEAST_EXPLAINED = 0.9
"""Part of the motion, beyond one at constant speed, that the velocity must share with the position."""


@dataclass(frozen=True)
class Lag:
    """Lag of a velocity behind its position.

    Parameters
    ----------
    lag_s, standard_error_s : float or None
        [s]; positive where the velocity is late. None where there is a reason.
    gain : float or None
        Velocity over derivative of the position, 1 for a velocity in the position's units.
    reason : str or None
    """

    lag_s: float | None
    standard_error_s: float | None
    gain: float | None
    reason: str | None = None


def lags_of(batch: TrialBatch) -> tuple[Lag, ...]:
    """Return the lag of the logged velocity of each trial, with a reason where it has none that can be used."""
    none = Lag(None, None, None, "no velocity was logged, or its rows are not in order")
    if batch.velocity is None:
        return (none,) * len(batch)
    found = []
    for i, rows in enumerate(batch.rows):
        columns = [values[i, :rows] for values in (batch.time, batch.position, batch.velocity)]
        usable = all(np.isfinite(column).all() for column in columns) and (np.diff(columns[0]) > 0).all()
        found.append(velocity_lag(*columns) if usable else none)
    return tuple(found)


def velocity_lag(time: Floats, position: Floats, velocity: Floats, *, largest_lag_s: float | None = None) -> Lag:
    """Return how much later than the position a logged velocity is.

    Parameters
    ----------
    time : float64, shape (n,)
        Time stamps of one log [s], increasing; they need not be regular.
    position, velocity : float64, shape (n,)
        [m, rad], [m/s, rad/s].
    largest_lag_s : float, optional
        Lags between minus and plus this are looked for [s]; by default 20 median row distances.

    Returns
    -------
    Lag

    Raises
    ------
    ParameterError
        If the columns differ in length, are not finite, or the time does not increase.

    Notes
    -----
    Integrals are matched, so that no position is differentiated: the change of the position over a few rows is
    fitted by the integral of the velocity over the same span, later by the lag, plus a constant speed. The
    velocity is taken as straight between rows, so that the lag is finer than a row. It is the velocity that is
    shifted: a position between rows would have less of its rounding than one on a row, and the fit would
    prefer lags that make it so. A low-pass filter shows as a lag of its time constant while the motion is slow
    against it; the lag is that of the motion in the log, not of all frequencies.

    Errors are those of a sandwich over ten parts of the log.
    """
    _check(time, position, velocity)
    if len(time) < FEWEST_ROWS:
        return Lag(None, None, None, f"{len(time)} rows; at least {FEWEST_ROWS} are needed")
    row = float(np.median(np.diff(time)))
    span = SEARCH_PERIODS * row if largest_lag_s is None else largest_lag_s
    inside = (time >= time[0] + span) & (time <= time[-1] - span)
    if inside.sum() < FEWEST_ROWS:
        return Lag(None, None, None, f"log of {time[-1] - time[0]:.3g} s is too short for lags up to {span:.3g} s")
    if np.ptp(position[inside]) == 0 or np.ptp(velocity[inside]) == 0:
        return Lag(None, None, None, "position or velocity is constant: nothing shows a lag")
    at, moved = time[inside], _over_spans(position[inside])
    duration = _over_spans(at)

    def fitted(lag: float) -> tuple[Floats, Floats, Floats]:
        """Columns of gain, offset and change of the lag, what the first two leave, and their coefficients."""
        integral, rate = _integral(time, velocity, at + lag)
        columns = np.stack([_over_spans(integral), duration, _over_spans(rate)], axis=1)
        found: Floats = np.linalg.lstsq(columns[:, :2], moved, rcond=None)[0].astype(np.float64)
        return columns, moved - columns[:, :2] @ found, found

    tried = np.arange(-span, span + 0.5 * COARSE_STEP * row, COARSE_STEP * row)
    costs = [float(np.sum(fitted(float(lag))[1] ** 2)) for lag in tried]
    lag = float(tried[int(np.argmin(costs))])
    for _ in range(ITERATIONS):
        columns, _, found = fitted(lag)
        columns[:, 2] *= found[0]
        step = np.linalg.lstsq(columns, moved, rcond=None)[0]
        lag = float(np.clip(lag + np.clip(step[2], -row, row), -span, span))
    columns, residual, found = fitted(lag)
    gain = float(1 / found[0]) if found[0] else np.inf
    if abs(lag) >= span - COARSE_STEP * row:
        return Lag(None, None, None, f"lag is not within {span:.3g} s")
    if not LEAST_GAIN <= gain <= LARGEST_GAIN:
        return Lag(None, None, None, f"velocity is {gain:.3g} times the derivative of the position: check its unit")
    even = duration * (moved @ duration) / (duration @ duration)
    explained = 1 - float(np.sum(residual**2) / np.sum((moved - even) ** 2))
    if not explained >= LEAST_EXPLAINED:
        return Lag(
            None,
            None,
            None,
            f"the velocity shares {percent(explained)} of the position's motion; expected "
            f"{percent(LEAST_EXPLAINED)} or more",
        )
    columns[:, 2] *= found[0]
    error = _sandwich(columns, residual)
    if not np.isfinite(error):
        return Lag(None, None, None, "the motion is too simple to tell a lag from an offset: no acceleration")
    return Lag(lag, error, gain)


def _check(time: Floats, position: Floats, velocity: Floats) -> None:
    if not time.shape == position.shape == velocity.shape or time.ndim != 1:
        raise ParameterError(
            f"time, position, velocity of shapes {time.shape}, {position.shape}, {velocity.shape}: "
            "expected columns of the same length."
        )
    for name, column in (("time", time), ("position", position), ("velocity", velocity)):
        if not np.isfinite(column).all():
            raise ParameterError(f"{name} in row {int(np.argmin(np.isfinite(column)))}: expected a finite number.")
    if (np.diff(time) <= 0).any():
        row = int(np.argmax(np.diff(time) <= 0)) + 1
        raise ParameterError(f"time in row {row}: {time[row]:g} s; expected more than the {time[row - 1]:g} s before.")


def _integral(time: Floats, velocity: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Integral of the velocity, straight between rows, from the first row to times ``at``, and the velocity there."""
    width = np.diff(time)
    whole = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * width)])
    i = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    since = at - time[i]
    rate = velocity[i] + (velocity[i + 1] - velocity[i]) * since / width[i]
    return whole[i] + 0.5 * (velocity[i] + rate) * since, rate


def _over_spans(values: Floats) -> Floats:
    """Change of values over `SPAN_ROWS` rows, from every row."""
    return values[SPAN_ROWS:] - values[:-SPAN_ROWS]


def _sandwich(columns: Floats, residual: Floats) -> float:
    """Standard error of the last coefficient with errors that are independent between parts of the log only."""
    scale = np.sqrt(np.mean(columns**2, axis=0))
    if not (scale > 0).all():
        return float("nan")
    scaled = columns / scale
    normal = scaled.T @ scaled
    if np.linalg.cond(normal) > 1e10:  # beyond, rounding decides the last of three unknowns
        return float("nan")
    parts = np.array_split(np.arange(len(residual)), SEGMENTS)
    score = np.stack([scaled[part].T @ residual[part] for part in parts])
    inverse = np.linalg.inv(normal)
    variance = inverse @ (score.T @ score) @ inverse * SEGMENTS / (SEGMENTS - columns.shape[1])
    return float(np.sqrt(variance[-1, -1]) / scale[-1])
