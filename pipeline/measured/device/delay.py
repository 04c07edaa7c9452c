"""Closed-loop delay as an integer factor, by the first position change after the command edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

NO_DELAY = -1
"""Stands where no delay factor could be had."""

QUANTA, SIGMAS = 1.5, 3.0
"""Threshold in quanta plus standard deviations: rounding flickers by one quantum, noise by three sigma."""

QUANTA_AT_REST = 0.5
"""Threshold in quanta where the baseline is constant: there one quantum is a change."""

RISE_ROWS, RISE = 2, 3.0
"""Rows after the first change, and the multiple of the threshold passed by then: more than a flicker of one
quantum, and what constant acceleration does unless it needs more than 2.7 rows for the threshold."""


@dataclass(frozen=True, eq=False)
class Delays:
    """Delay of each trial by its first position change, shape (n,).

    Parameters
    ----------
    delay_samples : int64
        Integer factor d = d_obs - 1 (6.2); -1 where there is a reason.
    first_row : int64
        Row of the first change, counted from 0; -1 where there is a reason.
    reason : tuple of str
    """

    delay_samples: Integers
    first_row: Integers
    reason: tuple[str, ...]


def first_change(batch: TrialBatch, response: Response) -> Delays:
    """Return the integer delay factor d = d_obs - 1 of each trial.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials; one from `response.declare_edge` where the log has no baseline.

    Returns
    -------
    Delays

    Notes
    -----
    The position has changed where it lies 1.5 quanta plus three standard deviations of the noise from that at the
    command edge, half a quantum where the baseline is constant, 0 for an ideal log. d_obs is the number of rows
    from the command edge to the first position on the side of the step beyond this threshold, so that t_obs - T <=
    t_d < t_obs. On an ideal log that is exact. A sensor sees the first change late, by the time that the device
    needs to move as far as the threshold: 8 N on 0.58 kg need 1.2 ms for 10 um, 3 ms for 60 um. That stands as it
    was seen; `onset.motion_onset` takes it back.

    A device that moves before the step by more than the sensor explains (chatter at high B) gives no delay but
    a reason: its motion cannot be told from the answer to the step. So does one that first moves against the step: a
    sign is wrong, and its swing back would be taken for the answer.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    edge = response.edge_row
    column = np.arange(batch.position.shape[1])[None, :]
    at_edge = np.take_along_axis(batch.displacement, np.maximum(edge, 0)[:, None], axis=1)
    away = np.nan_to_num(np.sign(batch.step)[:, None] * (batch.displacement - at_edge))
    noise = np.nan_to_num(response.sensor_noise)
    # without a baseline of some rows nothing says that it is constant
    quanta = np.where(response.sensor_noise == 0, QUANTA_AT_REST, QUANTA)
    limit = quanta * response.sensor_quantum + SIGMAS * noise
    after = column > edge[:, None]
    moved, opposite = _response(away, limit) & after, _response(-away, limit) & after
    seen = moved.any(axis=1) & response.has_edge
    # with a sign that is wrong the response is taken for rest, and its swing back for the response
    against = opposite.any(axis=1) & response.has_edge
    against &= ~seen | (np.argmax(opposite, axis=1) < np.argmax(moved, axis=1))
    found = seen & ~against & (response.baseline_motion == 0)
    first = np.where(found, np.argmax(moved, axis=1), np.maximum(edge, 0) + 1)
    reason = tuple(
        _reason(*trial)
        for trial in zip(
            response.has_edge,
            response.edge_reason,
            seen,
            against,
            response.baseline_motion,
            response.floor,
            strict=True,
        )
    )
    return Delays(
        delay_samples=np.where(found, first - edge - 1, NO_DELAY).astype(np.int64),  # (6.2)
        first_row=np.where(found, first, NO_DELAY).astype(np.int64),
        reason=reason,
    )


def _response(away: Floats, limit: Floats) -> Booleans:
    """Return the rows from which on the position stays beyond a limit, shape (n, N).

    Noise passes it now and then, but only a response stays beyond it and goes on to rise.
    """
    moved = away > limit[:, None]
    moved[:, :-1] &= away[:, 1:] > limit[:, None]
    moved[:, :-RISE_ROWS] &= away[:, RISE_ROWS:] > RISE * limit[:, None]
    return moved


def _reason(has_edge: bool, edge_reason: str, seen: bool, against: bool, motion: float, floor: float) -> str:
    if not has_edge:
        return f"delay not identifiable: {edge_reason}"
    if motion > 0:
        much = f", peak to peak {motion / floor:.3g} times what its sensor shows at rest" if floor > 0 else ""
        return f"moving before the step{much}; let the device come to rest before the step"
    if against:
        return "the position moves against the step at first; check the signs of position, command and step"
    return "" if seen else "no position change beyond what the sensor shows at rest after the command edge"
