"""The methods of the thesis: delay by the first change, mass by a momentum balance, damping by the limit at K = 0.

They stand beside the estimates of the model, as `by_method`: each knows the device as a part of what it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted, percent
from pipeline.measured.law.stamps import EVEN
from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.measured.student import CONFIDENCE, SIGMAS
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.findings import Estimate

QUANTA = 1.5
"""Threshold in quanta, plus `SIGMAS` of the noise: rounding flickers by one quantum."""

QUANTA_AT_REST = 0.5
"""Threshold in quanta where the baseline is constant: there one quantum is a change."""

RISE_ROWS, RISE = 2, 3.0
"""Rows after the first change, and the multiple of the threshold passed by then: more than a flicker of one
quantum, and what constant acceleration does unless it needs more than 2.7 rows for the threshold."""

WINDOW_S = 0.015
"""Time from the command edge that is used (6.1.2): later the velocity saturates real drives."""

SMALLEST_SIGNAL = 20.0
"""Velocity change in standard errors of the sensor: at 20 the sensor alone makes an error of 5 %."""

ZERO_RATE = 1e-6
"""Growth rate, relative to the range of the rates, that is zero but for rounding."""

ZERO_RATE_AT_END = 0.01
"""As `ZERO_RATE` for the largest B tested, with noise: an error of 1 % of the tested range of B."""


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
    needs to move as far as the threshold: 8 N on 0.58 kg need 1.2 ms for 10 um, 3 ms for 60 um.

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
        delay_samples=np.where(found, first - edge - 1, NO_ROW).astype(np.int64),  # (6.2)
        first_row=np.where(found, first, NO_ROW).astype(np.int64),
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


def estimate_delay(delay_samples: Integers) -> Estimate:
    """Return the integer delay factor of an experiment: the median of its trials.

    Parameters
    ----------
    delay_samples : int64, shape (n,)
        Integer factor of each trial; negative where there is none.

    Notes
    -----
    The interval is the range that holds 95 % of the trials (jitter), its upper end one sample more by (6.3):
    a factor d stands for delays d T <= t_d < (d + 1) T. An even number of trials takes the lower median, so
    that the value is a factor that occurred.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    method = "first position change (6.2, 6.3)"
    known = np.sort(delay_samples[delay_samples >= 0])
    if not len(known):
        reason = f"no trial of {len(delay_samples)} shows a command edge and a position change after it"
        return Estimate(value=None, unit="samples", method=method, reason=reason)
    cut = 0.5 * (1 - CONFIDENCE)
    low, median, high = (float(known[int(np.floor(q * (len(known) - 1)))]) for q in (cut, 0.5, 1 - cut))
    return Estimate(value=median, low=low, high=high + 1, unit="samples", method=method, trials=len(known))


@dataclass(frozen=True, eq=False)
class Masses:
    """Mass of each trial by the momentum balance (6.4) [kg, kg m^2], shape (n,), NaN where there is a reason."""

    mass_momentum: Floats
    reason: tuple[str, ...]


def by_momentum(batch: TrialBatch, response: Response, delay_samples: int, *, window_s: float = WINDOW_S) -> Masses:
    """Return the mass of each trial from impulse over change of velocity, over a window from the command edge.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    delay_samples : int
        Integer delay factor by which the command is shifted.
    window_s : float
        Time from the command edge to t_2 [s]; t_1 is the rest before the first movement.

    Notes
    -----
    With the command held over each period, the mean velocity of an interval is v + F T/2m, so that interval means
    differ by exactly T (F_{k-1} + F_k)/2m: the trapezoid of the held command makes no error. Exact for b = 0 whatever K
    and B; else too large by b (x_2 - x_1)/(v_2 - v_1). A delay that is wrong by one sample shifts it by some 10 %.

    Source: Hulin 2017, eq. 6.4 and sec. 6.1.2.
    """
    rows, period = np.arange(len(batch)), batch.sampling_period_s
    window = np.round(window_s / period).astype(np.int64)
    last = response.edge_row + window - 1
    fits = response.has_edge & (window > delay_samples + 1) & (last + 1 < batch.rows)
    pick = np.where(fits, last, 0)
    column = np.arange(int(pick.max(initial=0)) + 2)
    arrived = column - delay_samples
    acting = np.nan_to_num(batch.command[:, np.clip(arrived, 0, batch.command.shape[1] - 1)])
    # what the controller commanded before the edge is noise on a device at rest
    acting = np.where(arrived[None, :] >= response.edge_row[:, None], acting, 0.0)
    impulse = (np.cumsum(acting, axis=1) - 0.5 * acting)[rows, pick] * period
    ends = np.minimum(pick + 1, batch.position.shape[1] - 1)
    velocity = (batch.displacement[rows, ends] - batch.displacement[rows, pick]) / period
    noise = np.hypot(np.nan_to_num(response.sensor_noise), response.sensor_quantum / np.sqrt(12))
    least = SMALLEST_SIGNAL * np.sqrt(2) * noise / period
    irregular = _irregularity(batch, response.edge_row, window)
    with np.errstate(invalid="ignore", divide="ignore"):
        mass = impulse / velocity

    def why(i: int) -> str:
        if not response.has_edge[i]:
            return f"no start of the time window: {response.edge_reason[i]}"
        if not fits[i]:
            return f"window of {window[i]} samples: the log ends earlier, or the delay of {delay_samples} fills it"
        if irregular[i] > EVEN:
            return f"time steps in the window differ from T by {percent(float(irregular[i]), 1)}"
        if not abs(velocity[i]) > least[i]:
            return f"velocity change {abs(velocity[i]):.3g} is not above the noise threshold {least[i]:.3g}"
        return "" if mass[i] > 0 else "no positive mass explains the motion with this delay"

    reason = tuple(map(why, rows.tolist()))
    return Masses(np.where([not text for text in reason], mass, np.nan), reason)


def _irregularity(batch: TrialBatch, edge: Integers, window: Integers) -> Floats:
    """Largest relative deviation of a time step from T from the edge to the end of the window, shape (n,)."""
    step = np.diff(batch.time, axis=1)
    column = np.arange(step.shape[1])[None, :]
    inside = (column >= edge[:, None]) & (column < (edge + window)[:, None])
    deviation = np.abs(step / batch.sampling_period_s[:, None] - 1)
    result: Floats = np.max(np.where(inside, np.nan_to_num(deviation), 0.0), axis=1, initial=0.0)
    return result


def by_limit(damping: Floats, stiffness: Floats, growth_per_s: Floats, unit: str = "Ns/m") -> Estimate:
    """Return b = -B at the stability limit with K = 0.

    Parameters
    ----------
    damping, stiffness : float64, shape (n,)
        Virtual damping B [Ns/m, Nms/rad] and stiffness K of the trials; only those with K = 0 are used.
    growth_per_s : float64, shape (n,)
        Growth rate of the acceleration, as `verdict.judge` returns it [1/s]; NaN where it is not known.
    unit : str

    Returns
    -------
    Estimate
        Value where the growth rate crosses zero; its interval is -B of the last stable and of the first unstable trial.

    Notes
    -----
    Near the limit the rate is -(b + B)/m, linear in B, and is interpolated between the trials on both sides
    of the zero. A rate of exactly zero on one side is a zero found.

    Source: Hulin 2017, eq. 3.25 for K = 0 and sec. 6.1.2.
    """
    used = (stiffness == 0) & np.isfinite(growth_per_s)
    B, rate = damping[used], growth_per_s[used]

    def told(value: float | None, low: float | None, high: float | None, reason: str | None = None) -> Estimate:
        method = "stability limit at K = 0, interpolated between its neighbours"
        return Estimate(value=value, low=low, high=high, unit=unit, method=method, reason=reason, trials=len(B))

    if not len(B):
        return told(None, None, None, "no usable trial at K = 0: record some with B <= 0")
    levels, member = np.unique(B, return_inverse=True)
    mean = np.bincount(member, weights=rate) / np.bincount(member)
    size = np.abs(mean) / (np.ptp(mean) or 1.0)
    # an undamped device has its limit at B = 0, the end of the range, where noise decides the sign
    at_limit = np.flatnonzero((size <= ZERO_RATE) | ((size <= ZERO_RATE_AT_END) & (levels == levels[-1])))
    if len(at_limit) and at_limit[-1] > 0:
        at = at_limit[-1]
        return told(0.0 - float(levels[at]), 0.0 - float(levels[at]), 0.0 - float(levels[at - 1]))
    stable, unstable = levels[mean < 0], levels[mean >= 0]
    if not len(stable) or not len(unstable):
        trials, side = counted(len(B), "trial"), "stable" if len(stable) else "unstable"
        reason = f"{trials} at K = 0, on the {side} side of the limit only; it needs trials on both sides"
        return told(None, None, None, reason)
    first_unstable = unstable.max()
    above = stable[stable > first_unstable]
    if not len(above):
        return told(None, None, None, "growth rates at K = 0 do not fall with B; the limit is not a single crossing")
    last_stable = above.min()
    low, high = mean[levels == last_stable][0], mean[levels == first_unstable][0]
    crossing = last_stable + (first_unstable - last_stable) * low / (low - high)
    return told(0.0 - float(crossing), 0.0 - float(last_stable), 0.0 - float(first_unstable))


def estimate_median(values: Floats, unit: str, method: str, reason: str) -> Estimate:
    """Return the median of the trials with its distribution-free 95 % interval.

    Parameters
    ----------
    values : float64, shape (n,)
        One value per trial; NaN where there is none.
    unit, method : str
    reason : str
        What to say where no trial has a value.

    Notes
    -----
    The interval lies between the order statistics l and n + 1 - l, where l is the largest for which a
    binomial (n, 1/2) count falls below l with a chance of at most 2.5 %. Fewer than six trials cannot give
    95 %: then it is the range, and the method says so. It tells the scatter of the trials, not a bias that
    they share.
    """
    known = np.sort(values[np.isfinite(values)])
    n = len(known)
    if not n:
        return Estimate(value=None, unit=unit, method=method, reason=reason)
    rank = _median_rank(n)
    if rank == 0:
        method, rank = f"{method}; interval is the range of {n} trials", 1
    return Estimate(
        value=float(np.median(known)),
        low=float(known[rank - 1]),
        high=float(known[n - rank]),
        unit=unit,
        method=method,
        trials=n,
    )


def _median_rank(n: int) -> int:
    """Largest l with P(binomial(n, 1/2) < l) <= 2.5 %, 0 where there is none."""
    k = np.arange(n + 1)
    logarithm = np.concatenate([[0.0], np.cumsum(np.log((n - k[:-1]) / (k[:-1] + 1)))]) - n * np.log(2)
    below = np.cumsum(np.exp(logarithm))
    return int((below <= 0.5 * (1 - CONFIDENCE)).sum())
