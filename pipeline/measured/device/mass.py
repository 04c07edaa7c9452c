"""Apparent mass by the balance of linear momentum over the first milliseconds of the response, as the thesis had it.

It knows the device as a mass alone; `friction.fit_balance` corrects for damping, friction, offset and gravity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import percent
from pipeline.measured.device.momentum import balance
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Floats, Integers, TrialBatch

WINDOW_S = 0.015
"""Time from the command edge that is used (6.1.2): later the velocity saturates real drives."""

SMALLEST_SIGNAL = 20.0
"""Velocity change in standard errors of the sensor: at 20 the sensor alone makes an error of 5 %."""

IRREGULARITY = 0.01
"""Largest deviation of a time step from T in the window: it enters the velocity, and so the mass, in full."""


@dataclass(frozen=True, eq=False)
class Masses:
    """Mass of each trial by the momentum balance, shape (n,), NaN where there is a reason.

    Parameters
    ----------
    mass_momentum : float64
        By (6.4), as the thesis used it; too large by ``b * damping_share`` [kg, kg m^2].
    damping_share : float64
        (x_2 - x_1)/(v_2 - v_1) [s].
    reason : tuple of str
    """

    mass_momentum: Floats
    damping_share: Floats
    reason: tuple[str, ...]


def by_momentum(
    batch: TrialBatch,
    response: Response,
    delay_samples: int,
    *,
    window_s: float = WINDOW_S,
) -> Masses:
    """Return the mass of each trial from impulse over change of velocity.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    delay_samples : int
        Integer delay factor by which the command is shifted.
    window_s : float
        Time from the command edge to t_2 [s]; t_1 is the rest before the first movement.

    Returns
    -------
    Masses

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    Exact for b = 0 whatever K and B; else too large by b (x_2 - x_1)/(v_2 - v_1), see `correct`. A delay that
    is wrong by one sample shifts the result by some 10 %. Friction and offsets of a real drive must be taken
    out of the command before.

    Source: Hulin 2017, eq. 6.4 and sec. 6.1.2.
    """
    rows = np.arange(len(batch))
    window = np.round(window_s / batch.sampling_period_s).astype(np.int64)
    last = response.edge_row + window - 1
    fits = response.has_edge & (window > delay_samples + 1) & (last + 1 < batch.rows)
    pick = np.where(fits, last, 0)
    # what lies behind the last interval, and the two that its mean position needs, is not read
    columns = min(int(pick.max(initial=0)) + 4, batch.position.shape[1])
    batch = replace(batch, **{name: getattr(batch, name)[:, :columns] for name in ("time", "command", "position")})
    momentum = balance(batch, response.edge_row, delay_samples)
    velocity = momentum.velocity[rows, pick]
    impulse, moved = momentum.impulse[rows, pick], momentum.displacement[rows, pick]
    noise = np.hypot(np.nan_to_num(response.sensor_noise), response.sensor_quantum / np.sqrt(12))
    least = SMALLEST_SIGNAL * np.sqrt(2) * noise / batch.sampling_period_s
    irregular = _irregularity(batch, response.edge_row, window)
    with np.errstate(invalid="ignore", divide="ignore"):
        visible = np.abs(velocity) > least
        mass = impulse / velocity
        share = moved / velocity
    positive = np.nan_to_num(mass) > 0
    good = fits & visible & positive & (irregular <= IRREGULARITY)
    reasons = []
    for i in rows:
        if good[i]:
            reasons.append("")
        elif not response.has_edge[i]:
            reasons.append(f"no start of the time window: {response.edge_reason[i]}")
        elif not fits[i]:
            reasons.append(
                f"window of {window[i]} samples from the edge: the log ends earlier, or the delay of "
                f"{delay_samples} fills it"
            )
        elif irregular[i] > IRREGULARITY:
            reasons.append(
                f"time steps in the window differ from T by {percent(irregular[i], 1)}; allowed are "
                f"{percent(IRREGULARITY)}"
            )
        elif not visible[i]:
            reasons.append(f"velocity change {abs(velocity[i]):.3g} is not above the noise threshold {least[i]:.3g}")
        else:
            reasons.append(
                "impulse and velocity change have opposite signs: no mass explains the motion with this delay"
            )
    return Masses(np.where(good, mass, np.nan), np.where(good, share, np.nan), tuple(reasons))


def correct(masses: Masses, viscous_damping: float | Floats) -> Floats:
    """Return the mass corrected for viscous damping, m = m_momentum - b (x_2 - x_1)/(v_2 - v_1) [kg, kg m^2].

    Parameters
    ----------
    masses : Masses
    viscous_damping : float or float64, shape (n,)
        b [Ns/m, Nms/rad].
    """
    corrected: Floats = masses.mass_momentum - viscous_damping * masses.damping_share
    return corrected


def _irregularity(batch: TrialBatch, edge: Integers, window: Integers) -> Floats:
    """Largest relative deviation of a time step from T from the edge to the end of the window, shape (n,)."""
    step = np.diff(batch.time, axis=1)
    column = np.arange(step.shape[1])[None, :]
    inside = (column >= edge[:, None]) & (column < (edge + window)[:, None])
    deviation = np.abs(step / batch.sampling_period_s[:, None] - 1)
    result: Floats = np.max(np.where(inside, np.nan_to_num(deviation), 0.0), axis=1, initial=0.0)
    return result
