"""Methods of the thesis.

The delay follows from the first change, the mass from a momentum balance, and the damping from the limit at K = 0.

Each method estimates one parameter of the device. Its result is reported next to the estimate of the model, as
`by_method`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted, percent, true_minus
from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.measured.student import CONFIDENCE, NORMAL_QUARTILE, SIGMAS
from pipeline.recording.timing import EVEN
from pipeline.records.findings import Estimate
from pipeline.records.models import MOMENTUM_WINDOW_S
from pipeline.records.trials import Floats, Integers, Trial

QUANTA = 1.5
"""Threshold for a change of the position, in quanta, because a rounded position flickers by one quantum. `SIGMAS`
standard deviations of the noise are added to it."""

QUANTA_AT_REST = 0.5
"""Threshold for a change of the position after a constant baseline, in quanta. One quantum is then a change."""

RISE_ROWS, RISE = 2, 3.0
"""Number of rows after the first change, and multiple of the threshold that the position must exceed by then. This
condition excludes a flicker of one quantum. A constant acceleration meets it if the threshold is reached within 2.7
rows."""

SMALLEST_SIGNAL = 20.0
"""Smallest change of velocity, relative to its standard error due to the sensor. At 20, the sensor causes an error of 5
%."""

ZERO_RATE = 1e-6
"""Threshold for the growth rate, relative to the range of the rates. Below it, the rate is zero except for rounding."""

ZERO_RATE_AT_END = 0.01
"""Threshold like `ZERO_RATE`, but for the largest tested B and for rates with noise. It corresponds to an error of 1 %
of the tested range of B."""


@dataclass(frozen=True)
class FirstChange:
    """Delay of a trial, determined from the first change of the position.

    Parameters
    ----------
    delay_samples : int
        Integer factor d = d_obs - 1 (6.2), or -1 if a reason is given.
    first_row : int
        Row of the first change, counted from 0, or -1 if a reason is given.
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
        Response of this trial, from `response.declare_edge` if the log has no baseline.

    Notes
    -----
    The position has changed if it differs from the position at the command edge by more than a threshold. The threshold
    is 1.5 quanta plus three standard deviations of the noise, half a quantum for a constant baseline, or 0 for an ideal
    log. d_obs is the number of rows from the command edge to the first position beyond the threshold on the side of the
    step, so that t_obs - T <= t_d < t_obs. This is exact for an ideal log. A sensor detects the first change late, by
    the time that the device needs to reach the threshold. For 8 N on 0.58 kg, this time is 1.2 ms for 10 um and 3 ms
    for 60 um.

    If a device moves before the step by more than the sensor explains (chatter at high B), a reason is returned instead
    of a delay, because the motion cannot be distinguished from the response to the step. The same is true for a device
    that first moves against the step. A sign is then wrong, and the return motion would be mistaken for the response.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    edge, motion = response.edge_row, response.baseline_motion
    if edge < 0:
        return FirstChange(reason=f"delay not identifiable: {response.edge_reason}")
    if motion > 0:
        ratio = f"{motion / response.floor:.3g} times the sensor floor" if response.floor else ""
        size = f", peak to peak {ratio}" if ratio else ""
        return FirstChange(reason=f"the device moves before the step{size}; let it come to rest before the step")
    # without a baseline of some rows, it is unknown whether the baseline is constant
    quanta = QUANTA_AT_REST if response.sensor_noise == 0 else QUANTA
    limit = quanta * response.sensor_quantum + SIGMAS * _noise(response)
    displacement = trial.displacement
    away = np.sign(trial.step) * (displacement[edge + 1 :] - displacement[edge])
    first, opposite = _first_beyond(away, limit), _first_beyond(-away, limit)
    # with a wrong sign, the response is mistaken for rest, and its return motion for the response
    if opposite < min(first, len(away)):
        text = "the position first moves against the step; check the signs of position, command and step"
        return FirstChange(reason=text)
    if first >= len(away):
        return FirstChange(reason="no position change above the sensor threshold after the command edge")
    return FirstChange(first, edge + 1 + first)  # (6.2)


def _noise(response: Response) -> float:
    """Return the noise of the sensor [m, rad], or 0 if unknown."""
    return response.sensor_noise if response.sensor_noise > 0 else 0.0


def _first_beyond(away: Floats, limit: float) -> int:
    """Return the index from which the position stays beyond a limit, or the number of rows if it does not stay there.

    Noise exceeds the limit occasionally, but only a response stays beyond it and continues to rise.
    """
    beyond = away > limit
    rises = beyond[:-RISE_ROWS] & beyond[1 : len(away) - RISE_ROWS + 1] & (away[RISE_ROWS:] > RISE * limit)
    return int(np.argmax(rises)) if rises.any() else len(away)


def estimate_delay(delay_samples: Integers, because: str = "") -> Estimate:
    """Return the integer delay factor of an experiment, i.e. the median of its trials.

    Parameters
    ----------
    delay_samples : int64, shape (n,)
        Integer factor of each trial. It is negative if the trial has none.
    because : str
        Addition to the reason that is reported if no trial has a factor.

    Notes
    -----
    The interval contains 95 % of the trials (jitter). Its upper end is one sample longer due to (6.3), since a factor d
    represents delays d T <= t_d < (d + 1) T. For an even number of trials, the lower median is used, so that the value
    is the factor of one of the trials.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    method = "first position change (6.2, 6.3)"
    known = np.sort(delay_samples[delay_samples >= 0])
    if not len(known):
        reason = f"none of {len(delay_samples)} trials shows a command edge and a position change after it{because}"
        return Estimate(value=None, unit="samples", method=method, reason=reason)
    cut = 0.5 * (1 - CONFIDENCE)
    low, median, high = (float(known[int(np.floor(q * (len(known) - 1)))]) for q in (cut, 0.5, 1 - cut))
    return Estimate(value=median, low=low, high=high + 1, unit="samples", method=method, trials=len(known))


@dataclass(frozen=True)
class MomentumMass:
    """Mass of a trial from the momentum balance (6.4) [kg, kg m^2], or NaN if a reason is given."""

    mass_momentum: float = np.nan
    reason: str = ""


def by_momentum(
    trial: Trial, response: Response, delay_samples: int, *, window_s: float = MOMENTUM_WINDOW_S, after_s: float = 0.0
) -> MomentumMass:
    """Return the mass of a trial as the ratio of impulse to change of velocity, in a window after the command edge.

    Parameters
    ----------
    trial : Trial
    response : Response
        Response of this trial.
    delay_samples : int
        Integer delay factor by which the command is shifted.
    window_s : float
        Time from the command edge to t_2 [s].
    after_s : float
        Time from the command edge to t_1 [s]. If the device has not moved by then, t_1 is a time at rest.

    Notes
    -----
    With a zero-order hold of the command, the mean velocity of an interval is v + F T/2m. Mean velocities of successive
    intervals differ by exactly T (F_{k-1} + F_k)/2m, so the trapezoidal rule makes no error. The mass is exact for
    b = 0, with any K and B. Otherwise, the mass is too large by b (x_2 - x_1)/(v_2 - v_1). A delay error of one sample
    changes the mass by about 10 %.

    Source: Hulin 2017, eq. 6.4 and sec. 6.1.2.
    """
    edge, T, window = response.edge_row, trial.sampling_period_s, round(window_s / trial.sampling_period_s)
    if edge < 0:
        return MomentumMass(reason=f"the time window has no start: {response.edge_reason}")
    last = edge + window - 1
    if window <= delay_samples + 1 or last + 1 >= trial.rows:
        reason = (
            f"the log ends within the window of {window} samples, or the delay of {delay_samples} samples fills the "
            "window"
        )
        return MomentumMass(reason=reason)
    irregular = float(np.abs(np.diff(trial.time[edge : last + 2]) / T - 1).max())
    if irregular > EVEN:
        return MomentumMass(reason=f"time steps in the window differ from T by {percent(irregular, 1)}")
    # the command before the edge acts on a device at rest and is treated as noise
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
        Virtual damping B [Ns/m, Nms/rad] and stiffness K of the trials. Only trials with K = 0 are used.
    growth_per_s : float64, shape (n,)
        Growth rate of the acceleration from `verdict.judge` [1/s], or NaN if unknown.
    unit : str

    Returns
    -------
    Estimate
        The value is the zero crossing of the growth rate. The interval is -B of the last stable and of the first
        unstable trial.

    Notes
    -----
    Near the limit, the rate is -(b + B)/m, which is linear in B. It is interpolated between the trials on both sides of
    zero. A rate of exactly zero is the limit.

    Source: Hulin 2017, eq. 3.25 for K = 0 and sec. 6.1.2.
    """
    used = (stiffness == 0) & np.isfinite(growth_per_s)
    levels, member, counts = np.unique(damping[used], return_inverse=True, return_counts=True)
    trials, method = int(used.sum()), "stability limit at K = 0, interpolated between its neighbours"
    limit = _limit(levels, np.bincount(member, weights=growth_per_s[used]) / counts, trials)
    if isinstance(limit, str):
        return Estimate(value=None, unit=unit, method=method, reason=limit, trials=trials)
    value, low, high = (0.0 - float(B) for B in limit)
    warning = sign_warning(low, high, unit)
    return Estimate(value=value, low=low, high=high, unit=unit, method=method, trials=trials, warning=warning)


def sign_warning(low: float, high: float, unit: str) -> str | None:
    """Return a warning if a nonnegative quantity with this 95 % interval is negative or may be 0, otherwise None."""
    if low > 0:
        return None
    interval = true_minus(f"95 % interval {low:.3g} to {high:.3g} {unit}")
    return f"significantly negative ({interval})" if high < 0 else f"not significantly different from 0 ({interval})"


def _limit(levels: Floats, rate: Floats, trials: int) -> tuple[float, float, float] | str:
    """Return the zero crossing of rates over levels of B, the last stable and the first unstable level, or a reason."""
    if not trials:
        return "no usable trial at K = 0: record trials with B <= 0"
    size = np.abs(rate) / (np.ptp(rate) or 1.0)
    # the limit of an undamped device is at B = 0, the end of the range, where the sign of the rate depends on noise
    at_limit = np.flatnonzero((size <= ZERO_RATE) | ((size <= ZERO_RATE_AT_END) & (levels == levels[-1])))
    if len(at_limit) and at_limit[-1] > 0:
        return levels[at_limit[-1]], levels[at_limit[-1]], levels[at_limit[-1] - 1]
    unstable = np.flatnonzero(rate >= 0)
    if len(unstable) in (0, len(rate)):
        side = "unstable" if len(unstable) else "stable"
        count = counted(trials, "trial")
        return f"{count} at K = 0, only on the {side} side of the limit; record trials on both sides"
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
        One value per trial, or NaN if there is none.
    unit, method : str
    reason : str
        Reason to report if no trial has a value.

    Notes
    -----
    The ends of the interval are the order statistics l and n + 1 - l. l is the largest number for which a binomial (n,
    1/2) count is below l with a probability of at most 2.5 %. Fewer than six trials cannot provide 95 %. The interval
    is then the range, and the method states this. The interval shows the scatter of the trials, without a common bias.
    The spread is that of a normal distribution with the same median absolute deviation.
    """
    known = np.sort(values[np.isfinite(values)])
    n, rank = len(known), _median_rank(len(known))
    if not n:
        return Estimate(value=None, unit=unit, method=method, reason=reason)
    if rank == 0:
        method, rank = f"{method}; interval is the range of {n} trials", 1
    value, low, high = float(np.median(known)), float(known[rank - 1]), float(known[n - rank])
    spread = float(np.median(np.abs(known - np.median(known)))) / NORMAL_QUARTILE if n > 1 else None
    return Estimate(value=value, low=low, high=high, unit=unit, method=method, trials=n, spread=spread)


def _median_rank(n: int) -> int:
    """Return the largest l with P(binomial(n, 1/2) < l) <= 2.5 %, or 0 if there is none."""
    from scipy.special import bdtr

    return int((bdtr(np.arange(n), n, 0.5) <= 0.5 * (1 - CONFIDENCE)).sum())
