"""Momentum of the commanded force and of the device, sampled so that the balance is exact.

With the command held over each period, the mean velocity of an interval is v + F T/2m, so that for b = 0
interval means differ by exactly T (F_{k-1} + F_k)/2m: trapezoid of the held command, no differentiation
error. Viscous damping adds b times the mean position of the interval.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch


@dataclass(frozen=True, eq=False)
class Momentum:
    """Balance per interval [k, k+1] of a log, shape (n, N - 1), NaN beyond its end.

    Parameters
    ----------
    impulse : float64
        Integral of the delayed force from the edge to (the mean over) the interval [Ns, Nms].
    velocity : float64
        Mean velocity of the interval [m/s, rad/s].
    displacement : float64
        Mean position of the interval relative to the first one [m, rad].
    inside : bool
        From the command edge to the end of the log.
    """

    impulse: Floats
    velocity: Floats
    displacement: Floats
    inside: Booleans


def balance(
    batch: TrialBatch,
    edge: Integers,
    delay_samples: int,
    *,
    force: Floats | None = None,
    held: bool = True,
    logged_times: bool = False,
) -> Momentum:
    """Return impulse, velocity and displacement of each interval, with the command shifted by a delay.

    Parameters
    ----------
    batch : TrialBatch
    edge : int64, shape (n,)
        Row of the command edge; a trial without one (-1) has nothing inside.
    delay_samples : int
        Integer delay factor d: the force of row k acts from row k + d on.
    force : float64, shape (n, N), optional
        Force or torque in place of the command, as from a sensor [N, Nm].
    held : bool
        Whether the force is held from its row to the next, as a command is. A measured force is a reading of
        something continuous: there the trapezoid between two readings is right.
    logged_times : bool
        Integrate with the logged time stamps, for logs whose rows are not T apart, in place of T.

    Raises
    ------
    ParameterError
        If the delay is negative, or the force has another shape than the command.

    Source: Hulin 2017, eq. 6.4.
    """
    if delay_samples < 0:
        raise ParameterError(f"delay of {delay_samples} samples: expected an integer >= 0.")
    if force is not None and force.shape != batch.command.shape:
        raise ParameterError(f"force of shape {force.shape}: expected that of the command, {batch.command.shape}.")
    force = batch.command if force is None else force
    period = np.broadcast_to(batch.sampling_period_s[:, None], (len(batch), batch.command.shape[1] - 1))
    if logged_times:
        period = np.where(batch.valid[:, 1:], np.diff(batch.time, axis=1), 1.0)
    columns = batch.command.shape[1]
    interval = np.arange(columns - 1)[None, :]
    inside = (interval >= edge[:, None]) & (interval < (batch.rows - 1)[:, None]) & (edge[:, None] >= 0)
    arrived = np.arange(columns) - delay_samples
    acting = np.nan_to_num(force[:, np.maximum(arrived, 0)])
    # what the controller commanded before the edge is noise on a device at rest
    acting = np.where(arrived[None, :] >= edge[:, None], acting, 0.0)
    acting = acting[:, :-1] if held else 0.5 * (acting[:, :-1] + acting[:, 1:])
    impulse = np.cumsum(acting * period, axis=1) - 0.5 * acting * period
    x = batch.displacement
    change = np.diff(x, axis=1)
    # mean of the interval: trapezoid corrected for the change of slope, needed from 0.2 rad a sample on
    bend = np.zeros_like(change)
    bend[:, 1:-1] = (change[:, 2:] - change[:, :-2]) / 24
    mean = 0.5 * (x[:, 1:] + x[:, :-1]) - np.nan_to_num(bend)
    return Momentum(
        impulse=np.where(inside, impulse, np.nan),
        velocity=np.where(inside, change / period, np.nan),
        displacement=np.where(inside, mean, np.nan),
        inside=inside,
    )
