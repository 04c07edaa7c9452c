"""Closed-loop delay as an integer factor, by the first position change after the command edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.response import Response

NO_DELAY = -1
"""Stands where no delay factor could be had."""

QUANTA, SIGMAS = 1.5, 3.0
"""Threshold in quanta plus standard deviations: rounding flickers by one quantum, noise by three sigma."""

QUANTA_AT_REST = 0.5
"""Threshold in quanta where the baseline is constant: there one quantum is a change."""

RISE_ROWS, RISE = 2, 3.0
"""Rows after the first change, and the multiple of the threshold passed by then: more than a flicker of one
quantum, and what constant acceleration does unless it needs more than 2.7 rows for the threshold."""

LARGEST_LAG = 2
"""Rows behind the first change from which the onset is extrapolated: later ones see the second wall force."""

ONSET_ERROR = 0.35
"""Largest standard error of the extrapolated onset [samples]: beyond it rounding to whole ones is a guess."""


@dataclass(frozen=True, eq=False)
class Delays:
    """Integer delay factor of each trial, shape (n,), -1 where there is a reason."""

    delay_samples: Integers
    reason: tuple[str, ...]


def first_change(batch: TrialBatch, response: Response, *, threshold: Floats | None = None) -> Delays:
    """Return the integer delay factor d = d_obs - 1 of each trial.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    threshold : float64, shape (n,), optional
        Distance from the position at the command edge [m, rad] beyond which the position has changed. By
        default 1.5 quanta plus three standard deviations of the noise, half a quantum where the baseline is
        constant, 0 for an ideal log.

    Returns
    -------
    Delays

    Notes
    -----
    d_obs is the number of rows from the command edge to the first position on the side of the step beyond the
    threshold, so that t_obs - T <= t_d < t_obs. On an ideal log that is exact.

    A sensor sees the first change late, by the time that the device needs to move as far as the threshold: 8 N
    on 0.58 kg need 1.2 ms for 10 um, 3 ms for 60 um. With the default threshold this lateness is taken back:
    until the wall answers, the device moves by a (t - t_d)^2/2, so that two readings behind the first change
    give its onset, which is rounded to whole samples (a delay of d + 0.5 or more then counts as d + 1). Where
    quantum and noise leave the onset more uncertain than `ONSET_ERROR`, and with a threshold that is given,
    the first change stands as it was seen, late.

    A device that moves before the step by more than the sensor explains (chatter at high B) gives no delay but
    a reason: its motion cannot be told from the answer to the step.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    edge = response.edge_row
    column = np.arange(batch.position.shape[1])[None, :]
    at_edge = np.take_along_axis(batch.displacement, np.maximum(edge, 0)[:, None], axis=1)
    away = np.nan_to_num(np.sign(batch.step)[:, None] * (batch.displacement - at_edge))
    noise = np.nan_to_num(response.sensor_noise)
    quanta = np.where(noise > 0, QUANTA, QUANTA_AT_REST)
    limit = quanta * response.sensor_quantum + SIGMAS * noise if threshold is None else threshold
    moved = (away > limit[:, None]) & (column > edge[:, None])
    # noise passes the threshold now and then, but only a response stays beyond it and goes on to rise
    moved[:, :-1] &= away[:, 1:] > limit[:, None]
    moved[:, :-RISE_ROWS] &= away[:, RISE_ROWS:] > RISE * limit[:, None]
    seen = moved.any(axis=1) & response.has_edge
    found = seen & (response.baseline_motion == 0)
    first = np.where(seen, np.argmax(moved, axis=1), edge + 1)
    delay = first - edge - 1  # (6.2), (6.3)
    if threshold is None:
        onset, known = _onset(away, first, delay, response, batch.rows)
        delay = np.where(known, np.maximum(np.round(onset - edge), 0), delay).astype(np.int64)
    reason = tuple(
        _reason(*trial)
        for trial in zip(
            response.has_edge, response.edge_reason, seen, response.baseline_motion, response.floor, limit, strict=True
        )
    )
    return Delays(np.where(found, delay, NO_DELAY).astype(np.int64), reason)


def _onset(
    away: Floats, first: Integers, delay: Integers, response: Response, rows: Integers
) -> tuple[Floats, Booleans]:
    """Row (with a fraction) from which constant acceleration leads to two later readings; where it is known.

    The wall answers d + 1 rows after the onset, so that small delays leave fewer rows.
    """
    trial = np.arange(len(away))
    early = first + np.clip(delay - 1, 1, LARGEST_LAG)
    inside = early + 1 < rows
    early = np.where(inside, early, 0)
    low, high = away[trial, early], away[trial, np.minimum(early + 1, away.shape[1] - 1)]
    rising = inside & (low > 0) & (high > low) & (response.floor > 0)
    # distances grow with the square of time: their roots are a straight line
    root, next_root = np.sqrt(np.where(rising, low, 1.0)), np.sqrt(np.where(rising, high, 4.0))
    slope = next_root - root
    # a reading is uncertain by its noise and by its rounding, uniform over one quantum
    reading = np.hypot(np.nan_to_num(response.sensor_noise), response.sensor_quantum / np.sqrt(12))
    error = reading / (2 * slope**2) * np.hypot(next_root / root, root / next_root)
    onset: Floats = early - root / slope
    return onset, rising & (error <= ONSET_ERROR)


def _reason(has_edge: bool, edge_reason: str, seen: bool, motion: float, floor: float, limit: float) -> str:
    if not has_edge:
        return f"delay not identifiable: {edge_reason}"
    if motion > 0:
        return (
            f"moving before the step: {motion:.3g} peak to peak, above the sensor floor of {floor:.3g}; "
            "let the device come to rest before the step"
        )
    return "" if seen else f"no position change above {limit:.3g} after the command edge"
