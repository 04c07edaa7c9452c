"""Apparent mass by the balance of linear momentum over the first milliseconds of the response, as the thesis had it.

It knows the device as a mass alone; `friction.fit_balance` corrects for damping, friction, offset and gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import commonest, percent
from pipeline.measured.device.momentum import acting_force, balance
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
    smallest_signal: float = SMALLEST_SIGNAL,
    force: Floats | None = None,
    held: bool = True,
    logged_times: bool = False,
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
    smallest_signal : float
        Least velocity change, in standard errors of a velocity measured with this sensor.
    force, held, logged_times
        As in `momentum.balance`: another force than the command, whether it is held, and whether to integrate
        with the logged times. Without those, rows that are not T apart give no mass.

    Returns
    -------
    Masses

    Raises
    ------
    ParameterError
        If the delay is negative, or the force has another shape than the command.

    Notes
    -----
    Exact for b = 0 whatever K and B; else too large by b (x_2 - x_1)/(v_2 - v_1), see `correct`. A delay that
    is wrong by one sample shifts the result by some 10 %. Friction and offsets of a real drive must be taken
    out of the command before.

    Source: Hulin 2017, eq. 6.4 and sec. 6.1.2.
    """
    rows = np.arange(len(batch))
    window = np.round(window_s / batch.sampling_period_s).astype(np.int64)
    if logged_times:
        start = batch.time[rows, np.maximum(response.edge_row, 0)]
        # a row less than a thousandth of T behind the end is the one that the window was meant to end with
        limit = start + window_s + 1e-3 * batch.sampling_period_s
        window = (np.nan_to_num(batch.time, nan=np.inf) <= limit[:, None]).sum(axis=1) - 1 - response.edge_row
    last = response.edge_row + window - 1
    fits = response.has_edge & (window > delay_samples + 1) & (last + 1 < batch.rows)
    pick = np.where(fits, last, 0)
    # what lies behind the last interval, and the two that its mean position needs, is not read
    columns = min(int(pick.max(initial=0)) + 4, batch.position.shape[1])
    force = acting_force(batch, force)[:, :columns]
    batch = replace(batch, **{name: getattr(batch, name)[:, :columns] for name in ("time", "command", "position")})
    momentum = balance(batch, response.edge_row, delay_samples, force=force, held=held, logged_times=logged_times)
    velocity = momentum.velocity[rows, pick]
    impulse, moved = momentum.impulse[rows, pick], momentum.displacement[rows, pick]
    noise = np.hypot(np.nan_to_num(response.sensor_noise), response.sensor_quantum / np.sqrt(12))
    least = smallest_signal * np.sqrt(2) * noise / batch.sampling_period_s
    irregular = np.zeros(len(batch)) if logged_times else _irregularity(batch, response.edge_row, window)
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


@dataclass(frozen=True, eq=False)
class WindowScan:
    """Mass by (6.4) for several windows: n trials, w windows.

    Parameters
    ----------
    window_s : float64, shape (w,)
        Time from the command edge to t_2 [s].
    mass : float64, shape (n, w)
        [kg, kg m^2]; NaN where a trial has none with that window.
    median, scatter : float64, shape (w,)
        Median of the trials and their scatter, the interquartile range over 1.349 (the standard deviation of a
        normal distribution) [kg, kg m^2]; NaN where fewer than two trials have a mass.
    trials : int64, shape (w,)
        Trials with a mass.
    reason : tuple of str, length w
        Why most trials without a mass have none; empty where all have one.
    """

    window_s: Floats
    mass: Floats
    median: Floats
    scatter: Floats
    trials: Integers
    reason: tuple[str, ...]


def scan_of(windows_s: Floats, masses: Floats, reasons: Sequence[Sequence[str]]) -> WindowScan:
    """Return what the masses of all trials show, shape (n, w); ``reasons`` say for each window why trials have none."""
    trials = np.isfinite(masses).sum(axis=0)
    median, scatter = np.full((2, len(windows_s)), np.nan)
    for i in np.flatnonzero(trials > 1):
        low, median[i], high = np.nanquantile(masses[:, i], (0.25, 0.5, 0.75))
        scatter[i] = (high - low) / 1.349
    most = tuple(commonest(why) for why in reasons)
    return WindowScan(np.asarray(windows_s, dtype=np.float64), masses, median, scatter, trials, most)


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
