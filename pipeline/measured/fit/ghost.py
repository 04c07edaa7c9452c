"""The ghost of a trial: the loop simulated with fitted parameters beside the log.

Other than the model under the logged command (`fit_filter.predict`), the ghost computes its own commands from its own
positions, as the wall would: where both part, the wall or the device does something that the loop of theory does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.fit.fit_motion import step_of
from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

BAND_SIGMAS = 6.0
"""Distance from the log, in errors of a reading, that the sensor alone does not make: one in 1e6 samples does."""

LONGEST_ROWS = 1 << 17
"""Rows that are simulated of a ghost that does not come to rest: two minutes at 1 kHz, some seconds of computing."""

REST_ROWS, REST = 4096, 1e-15
"""A ghost rests that moved over so many rows by no more than this part of what it may reach: by rounding alone."""


@dataclass(frozen=True, eq=False)
class Ghost:
    """Simulated response of each trial beside its log; NaN where there are no parameters.

    Parameters
    ----------
    position : float64, shape (n, N)
        Simulated position [m, rad].
    deviation : float64, shape (n,)
        Root mean square of log minus ghost from the command edge on [m, rad].
    relative : float64, shape (n,)
        The same relative to the final displacement F_0/K; NaN for K <= 0.
    leaves_row : int64, shape (n,)
        First row where the log leaves the noise band about the ghost; -1 where it never does.
    """

    position: Floats
    deviation: Floats
    relative: Floats
    leaves_row: Integers


def simulate_ghost(batch: TrialBatch, response: Response, mass: Floats, damping: Floats, delay: Floats) -> Ghost:
    """Simulate the loop of each trial with its stiffness, damping and step, and fitted parameters.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    mass, damping, delay : float64, shape (n,)
        m [kg, kg m^2], b [Ns/m, Nms/rad], delay [samples], integer or fractional.

    Notes
    -----
    Ideal sensor, constant delay, exact motion between samples. The device rests until the command edge. An unstable
    ghost grows as its log does; it is cut where it exceeds a hundred times what the log shows. A ghost that comes to
    rest stays there; one that does not is simulated for `LONGEST_ROWS` and has no position behind them.

    Source: Hulin 2017, eqs. 3.3 to 3.8 and 3.18 (fractional delay: sec. 7.2).
    """
    n, rows = batch.position.shape
    known = np.isfinite(mass) & (np.nan_to_num(mass) > 0) & np.isfinite(damping) & (np.nan_to_num(delay, nan=-1.0) >= 0)
    known &= response.has_edge
    T = batch.sampling_period_s
    m, b, d = (np.where(known, values, 1.0) for values in (mass, damping, delay))
    whole = np.floor(d).astype(np.int64)
    s = step_of(b * T / m, d - whole)
    scale = T * T / m
    reach = 100 * np.nanmax(np.abs(batch.displacement), axis=1, initial=0.0)
    # the last row stands for what was commanded before the log: nothing
    command = np.zeros((min(rows, LONGEST_ROWS) + 1, n))
    position = np.full((rows, n), np.nan)
    rests, done = ~known, 0
    x, v, before = np.zeros(n), np.zeros(n), np.zeros(n)
    trial = np.arange(n)
    for k in range(len(command) - 1):
        if k % REST_ROWS == 0 and k:
            moved = np.ptp(position[k - REST_ROWS : k], axis=0)
            rests |= (moved <= REST * reach) & (response.edge_row < k - REST_ROWS)
            if rests.all():
                break
        position[k] = x
        outer = np.where(k >= response.edge_row, batch.step, 0.0)
        command[k] = outer - batch.stiffness * x - batch.damping * (x - before) / T
        before = x
        new, old = (np.where(row >= 0, row, len(command) - 1) for row in (k - whole, k - whole - 1))
        u_old, u_new = scale * command[old, trial], scale * command[new, trial]
        x, v = (
            x + s.xv * v + s.old_x * u_old + s.new_x * u_new,
            s.vv * v + s.old_v * u_old + s.new_v * u_new,
        )
        inside = np.abs(x) <= reach
        x, v = np.where(inside, x, 0.0), np.where(inside, v, 0.0)
        x, done = np.where(rests, before, x), k + 1
    position[done:, rests] = x[rests]
    simulated = batch.position[:, :1] + np.where(known[:, None] & batch.valid, position.T, np.nan)
    return _beside(batch, response, simulated, known)


def _beside(batch: TrialBatch, response: Response, simulated: Floats, known: Booleans) -> Ghost:
    column = np.arange(batch.position.shape[1])[None, :]
    counted = batch.valid & (column >= response.edge_row[:, None]) & np.isfinite(simulated)
    error = np.where(counted, batch.position - simulated, 0.0)
    rms = np.sqrt((error**2).sum(axis=1) / np.maximum(counted.sum(axis=1), 1))
    reading = np.hypot(np.nan_to_num(response.sensor_noise), response.sensor_quantum / np.sqrt(12))
    # an ideal log has no noise band: rounding of the positions stands for it
    rounding = 1e-9 * np.nanmax(np.abs(batch.displacement), axis=1, initial=0.0)
    outside = np.abs(error) > np.maximum(BAND_SIGMAS * reading, rounding)[:, None]
    leaves = np.where(outside.any(axis=1), np.argmax(outside, axis=1), NO_ROW).astype(np.int64)
    with np.errstate(divide="ignore", invalid="ignore"):
        travel = np.where((batch.stiffness > 0) & (batch.step != 0), np.abs(batch.step / batch.stiffness), np.nan)
    return Ghost(
        position=simulated,
        deviation=np.where(known, rms, np.nan),
        relative=np.where(known, rms / travel, np.nan),
        leaves_row=np.where(known, leaves, NO_ROW),
    )
