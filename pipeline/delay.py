"""Closed-loop delay as an integer factor, by the first position change after the command edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.batch import Floats, Integers, TrialBatch
from pipeline.response import Response

NO_DELAY = -1
"""Stands where no delay factor could be had."""

BASELINE_LAG = 5
"""Rows over which the drift of the baseline is looked at: the delays to be told are of this size."""

REFERENCE_ROWS = 3
"""Rows up to the edge whose mean is the rest position: few, since a chattering device drifts before the
step."""


RISE_ROWS, RISE = 2, 2.0
"""Rows after the first change, and the multiple of the threshold reached by then: constant acceleration does
so unless it needs more than five rows for the first threshold."""


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
        Distance from the rest position [m, rad] beyond which the position has changed. By default
        half a quantum more than the largest drift of the baseline over a few rows, 0 for an ideal log.

    Returns
    -------
    Delays

    Notes
    -----
    d_obs is the number of rows from the command edge to the first position on the side of the step beyond the
    threshold, so that t_obs - T <= t_d < t_obs. With a coarse sensor the change is seen late, by the time
    that the device needs to move one quantum: 8 N on 0.58 kg need 1.2 ms for 10 um, 3 ms for 60 um.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    edge = response.edge_row
    column = np.arange(batch.position.shape[1])[None, :]
    recent = (column <= edge[:, None]) & (column > (edge - REFERENCE_ROWS)[:, None])
    resting = np.where(recent, batch.displacement, 0.0).sum(axis=1) / np.maximum(recent.sum(axis=1), 1)
    sign = np.sign(batch.step)
    if threshold is None:
        threshold = _drift(batch, edge, sign) + 0.5 * response.sensor_quantum
    away = np.nan_to_num(sign[:, None] * (batch.displacement - resting[:, None]))
    moved = away > threshold[:, None]
    moved &= column > edge[:, None]
    # a chattering device passes the threshold now and then, but only a response goes on to rise
    moved[:, :-RISE_ROWS] &= away[:, RISE_ROWS:] > RISE * threshold[:, None]
    found = moved.any(axis=1) & response.has_edge
    observed = np.argmax(moved, axis=1) - edge
    reason = tuple(
        ""
        if ok
        else (
            f"no position change above {limit:.3g} after the command edge"
            if has
            else "no command edge: the delay cannot be counted from it"
        )
        for ok, has, limit in zip(found, response.has_edge, threshold, strict=True)
    )
    return Delays(np.where(found, observed - 1, NO_DELAY).astype(np.int64), reason)  # (6.2), (6.3)


def _drift(batch: TrialBatch, edge: Integers, sign: Floats) -> Floats:
    """Largest change of the baseline in the direction of the step over `BASELINE_LAG` rows, shape (n,)."""
    change = sign[:, None] * (batch.position[:, BASELINE_LAG:] - batch.position[:, :-BASELINE_LAG])
    before = np.arange(BASELINE_LAG, batch.position.shape[1])[None, :] <= edge[:, None]
    drift: Floats = np.max(np.where(before, np.nan_to_num(change), 0.0), axis=1, initial=0.0)
    return drift
