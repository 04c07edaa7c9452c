"""Methods of the thesis: delay from the first change, mass from a momentum balance, damping from the limit at K = 0.

They are reported with the estimates of the model, as `by_method`: each estimates one parameter of the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted, percent
from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.measured.student import CONFIDENCE, SIGMAS
from pipeline.recording.timing import EVEN
from pipeline.records.findings import Estimate
from pipeline.records.models import MOMENTUM_WINDOW_S
from pipeline.records.trials import Floats, Integers, Trial

QUANTA = 1.5
"""Threshold in quanta, plus `SIGMAS` standard deviations of the noise: rounding flickers by one quantum."""

QUANTA_AT_REST = 0.5
"""Threshold in quanta for a constant baseline, where one quantum is a change."""

RISE_ROWS, RISE = 2, 3.0
"""Number of rows after the first change, and multiple of the threshold that must be exceeded by then: more than a
flicker of one quantum, and satisfied by constant acceleration unless it needs more than 2.7 rows for the threshold."""

SMALLEST_SIGNAL = 20.0
"""Smallest velocity change in standard errors of the sensor: at 20 the sensor alone causes an error of 5 %."""

ZERO_RATE = 1e-6
"""Growth rate, relative to the range of the rates, below which it is zero up to rounding."""

ZERO_RATE_AT_END = 0.01
"""Like `ZERO_RATE` for the largest B tested, with noise: an error of 1 % of the tested range of B."""


@dataclass(frozen=True)
class FirstChange:
    """Delay of a trial from its first position change.

    Parameters
    ----------
    delay_samples : int
        Integer factor d = d_obs - 1 (6.2); -1 if a reason is given.
    first_row : int
        Row of the first change, counted from 0; -1 if a reason is given.
    reason : str
    """

    delay_samples: int = NO_ROW
    first_row: int = NO_ROW
    reason: str = ""


def first_change(trial: Trial, response: Response) -> FirstChange:
    """Return the integer delay factor d = d_obs - 1 of a trial.

    Parameters
    ----------
    trial : Trial
    response : Response
        Response of this trial; one from `response.declare_edge` if the log has no baseline.

    Notes
    -----
    The position has changed if it differs from that at the command edge by 1.5 quanta plus three standard deviations of
    the noise, by half a quantum for a constant baseline, or by more than 0 for an ideal log. d_obs is the number of
    rows from the command edge to the first position on the side of the step beyond this threshold, so that t_obs - T <=
    t_d < t_obs. For an ideal log this is exact. A sensor detects the first change late, by the time that the device
    needs to reach the threshold: 8 N on 0.58 kg need 1.2 ms for 10 um, 3 ms for 60 um.

    For a device that moves before the step by more than the sensor explains (chatter at high B), there is no delay but
    a reason: its motion cannot be distinguished from the response to the step. The same applies to a device that first
    moves against the step: a sign is wrong, and the swing back would be mistaken for the response.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    edge, motion = response.edge_row, response.baseline_motion
    if edge < 0:
        return FirstChange(reason=f"delay not identifiable: {response.edge_reason}")
    if motion > 0:
        ratio = f"{motion / response.floor:.3g} times what its sensor shows at rest" if response.floor else ""
        size = f", peak to peak {ratio}" if ratio else ""
        return FirstChange(reason=f"moving before the step{size}; let the device come to rest before the step")
    # without a baseline of some rows it is unknown whether it is constant
    quanta = QUANTA_AT_REST if response.sensor_noise == 0 else QUANTA
    limit = quanta * response.sensor_quantum + SIGMAS * _noise(response)
    displacement = trial.displacement
    away = np.sign(trial.step) * (displacement[edge + 1 :] - displacement[edge])
    first, opposite = _first_beyond(away, limit), _first_beyond(-away, limit)
    # with a wrong sign the response is mistaken for rest, and its swing back for the response
    if opposite < min(first, len(away)):
        text = "the position moves against the step at first; check the signs of position, command and step"
        return FirstChange(reason=text)
    if first >= len(away):
        return FirstChange(reason="no position change beyond what the sensor shows at rest after the command edge")
    return FirstChange(first, edge + 1 + first)  # (6.2)


def _noise(response: Response) -> float:
    """Return the noise of the sensor [m, rad]; 0 if it is unknown."""
    return response.sensor_noise if response.sensor_noise > 0 else 0.0


def _first_beyond(away: Floats, limit: float) -> int:
    """Return the index from which on the position stays beyond a limit, or the number of rows if it does not.

    Noise exceeds it occasionally, but only a response stays beyond it and continues to rise.
    """
    beyond = away > limit
    rises = beyond[:-RISE_ROWS] & beyond[1 : len(away) - RISE_ROWS + 1] & (away[RISE_ROWS:] > RISE * limit)
    return int(np.argmax(rises)) if rises.any() else len(away)


def estimate_delay(delay_samples: Integers) -> Estimate:
    """Return the integer delay factor of an experiment: the median of its trials.

    Parameters
    ----------
    delay_samples : int64, shape (n,)
        Integer factor of each trial; negative if there is none.

    Notes
    -----
    The interval is the range of 95 % of the trials (jitter), its upper end one sample more by (6.3): a factor d
    represents delays d T <= t_d < (d + 1) T. An even number of trials takes the lower median, so that the value is a
    factor that occurred.

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


@dataclass(frozen=True)
class MomentumMass:
    """Mass of a trial from the momentum balance (6.4) [kg, kg m^2], NaN if a reason is given."""

    mass_momentum: float = np.nan
    reason: str = ""


def by_momentum(
    trial: Trial, response: Response, delay_samples: int, *, window_s: float = MOMENTUM_WINDOW_S, after_s: float = 0.0
) -> MomentumMass:
    """Return the mass of a trial from impulse over change of velocity, over a window after the command edge.

    Parameters
    ----------
    trial : Trial
    response : Response
        Of this trial.
    delay_samples : int
        Integer delay factor by which the command is shifted.
    window_s : float
        Time from the command edge to t_2 [s].
    after_s : float
        Time from the command edge to t_1 [s]; if the device has not moved by then, t_1 is a time at rest.

    Notes
    -----
    With a zero-order hold of the command, the mean velocity of an interval is v + F T/2m, so that interval means differ
    by exactly T (F_{k-1} + F_k)/2m: the trapezoid of the command, a zero-order hold, makes no error. Exact for b = 0
    whatever K and B; else too large by b (x_2 - x_1)/(v_2 - v_1). A delay error of one sample shifts it by about 10 %.

    Source: Hulin 2017, eq. 6.4 and sec. 6.1.2.
    """
    edge, T, window = response.edge_row, trial.sampling_period_s, round(window_s / trial.sampling_period_s)
    if edge < 0:
        return MomentumMass(reason=f"no start of the time window: {response.edge_reason}")
    last = edge + window - 1
    if window <= delay_samples + 1 or last + 1 >= trial.rows:
        reason = f"window of {window} samples: the log ends earlier, or the delay of {delay_samples} fills it"
        return MomentumMass(reason=reason)
    irregular = float(np.abs(np.diff(trial.time[edge : last + 2]) / T - 1).max())
    if irregular > EVEN:
        return MomentumMass(reason=f"time steps in the window differ from T by {percent(irregular, 1)}")
    # the command before the edge is noise on a device at rest
    first = edge + round(after_s / T)
    moving = after_s > 0 and first >= edge + delay_samples
    acting = trial.command[first - delay_samples if moving else edge : last + 1 - delay_samples]
    impulse = float(acting.sum() - 0.5 * acting[-1] - (0.5 * acting[0] if moving else 0.0)) * T
    steps = np.diff(trial.displacement[[first, first + 1, last, last + 1]])[::2] / T
    velocity = float(steps[1] - (steps[0] if moving else 0.0))
    noise = math.hypot(_noise(response), response.sensor_quantum / math.sqrt(12))
    least = SMALLEST_SIGNAL * math.sqrt(2 + 2 * moving) * noise / T
    if not abs(velocity) > least:
        reason = f"velocity change {abs(velocity):.3g} is not above the noise threshold {least:.3g}"
        return MomentumMass(reason=reason)
    if not impulse / velocity > 0:
        return MomentumMass(reason="no positive mass explains the motion with this delay")
    return MomentumMass(impulse / velocity)


def by_limit(damping: Floats, stiffness: Floats, growth_per_s: Floats, unit: str = "Ns/m") -> Estimate:
    """Return b = -B at the stability limit with K = 0.

    Parameters
    ----------
    damping, stiffness : float64, shape (n,)
        Virtual damping B [Ns/m, Nms/rad] and stiffness K of the trials; only those with K = 0 are used.
    growth_per_s : float64, shape (n,)
        Growth rate of the acceleration, as returned by `verdict.judge` [1/s]; NaN if it is unknown.
    unit : str

    Returns
    -------
    Estimate
        Value at the zero crossing of the growth rate; its interval is -B of the last stable and of the first unstable
        trial.

    Notes
    -----
    Near the limit the rate is -(b + B)/m, linear in B, and is interpolated between the trials on both sides
    of the zero. A rate of exactly zero on one side is the limit.

    Source: Hulin 2017, eq. 3.25 for K = 0 and sec. 6.1.2.
    """
    used = (stiffness == 0) & np.isfinite(growth_per_s)
    levels, member, counts = np.unique(damping[used], return_inverse=True, return_counts=True)
    trials, method = int(used.sum()), "stability limit at K = 0, interpolated between its neighbours"
    limit = _limit(levels, np.bincount(member, weights=growth_per_s[used]) / counts, trials)
    if isinstance(limit, str):
        return Estimate(value=None, unit=unit, method=method, reason=limit, trials=trials)
    value, low, high = (0.0 - float(B) for B in limit)
    return Estimate(value=value, low=low, high=high, unit=unit, method=method, trials=trials)


def _limit(levels: Floats, rate: Floats, trials: int) -> tuple[float, float, float] | str:
    """Return the zero crossing of rates over levels of B, the last stable and the first unstable level; else a
    reason."""
    if not trials:
        return "no usable trial at K = 0: record some with B <= 0"
    size = np.abs(rate) / (np.ptp(rate) or 1.0)
    # an undamped device has its limit at B = 0, the end of the range, where noise decides the sign
    at_limit = np.flatnonzero((size <= ZERO_RATE) | ((size <= ZERO_RATE_AT_END) & (levels == levels[-1])))
    if len(at_limit) and at_limit[-1] > 0:
        return levels[at_limit[-1]], levels[at_limit[-1]], levels[at_limit[-1] - 1]
    unstable = np.flatnonzero(rate >= 0)
    if len(unstable) in (0, len(rate)):
        side = "unstable" if len(unstable) else "stable"
        count = counted(trials, "trial")
        return f"{count} at K = 0, on the {side} side of the limit only; it needs trials on both sides"
    first = unstable[-1]
    if first == len(rate) - 1:
        return "growth rates at K = 0 do not fall with B; the limit is not a single crossing"
    part = rate[first + 1] / (rate[first + 1] - rate[first])
    return levels[first + 1] + (levels[first] - levels[first + 1]) * part, levels[first + 1], levels[first]


def estimate_median(values: Floats, unit: str, method: str, reason: str) -> Estimate:
    """Return the median of the trials with its distribution-free 95 % interval.

    Parameters
    ----------
    values : float64, shape (n,)
        One value per trial; NaN if there is none.
    unit, method : str
    reason : str
        Reason to report if no trial has a value.

    Notes
    -----
    The interval lies between the order statistics l and n + 1 - l, where l is the largest for which a binomial (n, 1/2)
    count falls below l with a probability of at most 2.5 %. Fewer than six trials cannot give 95 %: then it is the
    range, and the method states this. It is the scatter of the trials, without a bias that they share.
    """
    known = np.sort(values[np.isfinite(values)])
    n, rank = len(known), _median_rank(len(known))
    if not n:
        return Estimate(value=None, unit=unit, method=method, reason=reason)
    if rank == 0:
        method, rank = f"{method}; interval is the range of {n} trials", 1
    value, low, high = float(np.median(known)), float(known[rank - 1]), float(known[n - rank])
    return Estimate(value=value, low=low, high=high, unit=unit, method=method, trials=n)


def _median_rank(n: int) -> int:
    """Return the largest l with P(binomial(n, 1/2) < l) <= 2.5 %, 0 if there is none."""
    from scipy.special import bdtr

    return int((bdtr(np.arange(n), n, 0.5) <= 0.5 * (1 - CONFIDENCE)).sum())
