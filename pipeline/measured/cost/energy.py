"""Compute the energy cost of measured responses, with an interval for noise, quantum, mass, delay and truncation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.base.errors import ParameterError
from pipeline.measured.cost.costs import CostInputs, cost_start, delay_bounds
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.sensor import AT_REST
from pipeline.measured.signal.verdict import Verdict
from pipeline.measured.student import NORMAL_95
from pipeline.records.criteria import ENERGY, Criterion, members
from pipeline.records.findings import ROUNDING
from pipeline.records.stage_records import EnergyRow, OtherCostRow
from pipeline.records.trials import Floats, Trial

WEIGHTS = tuple(sorted({c.weight for c in members(ENERGY)}))
"""Exponents w of the time weight k^w."""

LEVEL_SIGMAS = 4.5
"""Threshold for the distance from the final position, in standard errors of a reading. Above it, the response is not at
rest. Noise alone exceeds it in 0.3 % of logs with 400 samples. The bias of the sum is corrected, so the level can be
lower than for a plain sum."""

LARGEST_LEVEL = 0.1
"""Largest level of the horizon, relative to the final displacement, for which first-order error propagation is valid.
Above it, the intervals cover fewer than 90 % of simulated trials (60 um quantum, Falcon)."""

LARGEST_HALF_WIDTH = 0.5
"""Threshold for the half-width of the interval, relative to the value. Above it, the cost is not reported."""

GROWTH_ERROR, MEAN_ERROR = 0.2, 0.5
"""Relative errors of the decay beyond the horizon. The first is for a growth rate from the modes of the motion (95 % of
noisy Falcon logs are within it), the second for the mean decay since the peak of the energy."""

LARGEST_TAIL = 0.25
"""Largest share of the cost beyond the horizon. Above it, the cost depends too much on the extrapolation."""

SHORTEST_HORIZON = 40
"""Smallest number of samples of a horizon that shows a decay. Half of them contain an oscillation of the fastest
walls."""

FIRST_TERMS = 4096
"""Number of terms that are summed individually for a non-integer exponent. Later terms are smooth."""

LARGEST_EXPONENT = 0.5 * float(np.log(np.finfo(np.float64).max))
"""Half of the largest exponent for which exp does not overflow."""


@dataclass(frozen=True, eq=False)
class EnergyTerms:
    """Distances and changes of the samples from cost index 0 to the horizon, for their energies E_k/E_0.

    E_0 = F_0^2/(2 K) is the energy that the step stores in the wall.

    Parameters
    ----------
    first, stop : int
        Row of cost index 0, and first row after the horizon. They are equal if there is no cost.
    error : float64, shape (stop - first,)
        Distance from x_0 + F_0/K [m, rad].
    change : float64, shape (stop - first,)
        Change since the previous sample [m, rad]; 0 at cost index 0.
    spring, inertia : float
        Normalised potential energy per squared distance [1/m^2, 1/rad^2], and normalised kinetic energy per squared
        change in a sample and per mass.
    reason : str
        Reason why there is no cost.
    """

    first: int
    stop: int
    error: Floats
    change: Floats
    spring: float = np.nan
    inertia: float = np.nan
    reason: str = ""

    def summed(self, mass: float, weights: tuple[float, ...] = WEIGHTS) -> Floats:
        """Return the plain sums of k^w E_k/E_0 up to the horizon for each w, or NaN if there is no cost."""
        if self.reason:
            return np.full(len(weights), np.nan)
        energy = self.spring * self.error**2 + mass * self.inertia * self.change**2
        return np.array([np.arange(len(energy), dtype=np.float64) ** w @ energy for w in weights])


def energy_terms(
    trial: Trial, response: Response, verdict: Verdict, delay_samples: int, level: float | None = None
) -> EnergyTerms:
    """Return the energy terms of each sample up to the horizon.

    Parameters
    ----------
    trial : Trial
    response, verdict : Response, Verdict
        Response and verdict of this trial.
    delay_samples : int
        Integer delay factor d of the experiment.
    level : float, optional
        Distance from the final position above which the response is not at rest [m, rad]. The default is `AT_REST`
        sensor floors.

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    E_k = K/2 (x_k - x_inf)^2 + m/2 ((x_k - x_{k-1})/T)^2 with x_{-1} = x_0. The horizon is the row in which the
    response finally falls below the level. Without a horizon, the sensor floor times k^2 would dominate the sum over a
    long log. Ideal logs are used up to their end.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    first, reason = cost_start(trial, response, verdict, delay_samples)
    if reason:
        nothing = np.empty(0)
        return EnergyTerms(first, first, nothing, nothing, reason=reason)
    error = trial.position[first:] - response.position_final_expected
    if response.floor > 0:
        above = np.flatnonzero(np.abs(error) > (AT_REST * response.floor if level is None else level))
        error = error[: above[-1] + 1] if len(above) else error[:0]
    # x_{-1} = x_0: the response is at rest at cost index 0
    position = trial.position[first : first + len(error)]
    change = np.diff(position, prepend=position[:1])
    per_step = trial.stiffness / trial.step
    spring, inertia = per_step * per_step, per_step / trial.step / trial.sampling_period_s**2
    return EnergyTerms(first, first + len(error), error, change, spring, inertia)


@dataclass(frozen=True, eq=False)
class EnergyInterval:
    """Discrete energy cost with its 95 % interval for each exponent w, or NaN if there is no value.

    Parameters
    ----------
    value, low, high : float64, shape (w,)
        Sum over the horizon, minus the bias due to noise, plus the tail beyond the horizon, and its interval [1].
    bias : float64, shape (w,)
        Mean contribution of noise and quantum to the sum [1]; it is subtracted in ``value``.
    tail : float64, shape (w,)
        Extrapolated part of ``value`` beyond the horizon [1].
    horizon_samples : int
        Number of samples summed.
    reason : str
        Reasons for missing values, with the exponents concerned.
    """

    value: Floats
    low: Floats
    high: Floats
    bias: Floats
    tail: Floats
    horizon_samples: int
    reason: str


def energy_interval(
    trial: Trial,
    response: Response,
    verdict: Verdict,
    error: ReadingError,
    inputs: CostInputs,
    weights: tuple[float, ...] = WEIGHTS,
) -> EnergyInterval:
    """Return the discrete energy cost with its 95 % interval.

    Parameters
    ----------
    trial : Trial
    response, verdict, error : Response, Verdict, ReadingError
        Response, verdict and reading errors of this trial.
    inputs : CostInputs
    weights : tuple of float
        Exponents w.

    Raises
    ------
    ParameterError
        If the mass is not positive, its error is negative, or the range of the delay does not contain the delay.

    Notes
    -----
    The cost is `EnergyTerms.summed`, corrected for bias and truncation: noise adds its variance times k^w to the sum,
    and the sum ends at the horizon. The error due to noise is propagated to first order, including the response of the
    wall to each reading error. Independent parts (noise, mass, tail) are added in quadrature, separately for each side.
    The range of the delay is added linearly, since a different delay removes or adds samples and shifts all indices. If
    a response does not rest at its final position, its energy after the horizon is also added linearly.

    There is no value if the interval is wider than `LARGEST_HALF_WIDTH`, or if noise and quantum are not small compared
    with the final displacement. For the shipped devices, 94 to 97 % of the intervals contain the cost of the ideal
    loop. With a quantum and no noise, errors of slow readings are correlated, and 90 to 97 % of the intervals contain
    this cost. The interval does not include the effect of jitter on the cost, or a wrong final position.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    mass, mass_error, delay = inputs.mass, inputs.mass_error, inputs.readings.delay
    if not (mass > 0 and mass_error >= 0):
        raise ParameterError(f"mass {mass:g} +- {mass_error:g}: expected a positive mass and an error >= 0.")
    shortest, longest = delay_bounds(delay, inputs.delay_range)
    level = 0.0 if error.reason else LEVEL_SIGMAS * float(error.deviation[-1])
    terms = energy_terms(trial, response, verdict, delay, level)
    nothing, horizon = np.full(len(weights), np.nan), terms.stop - terms.first
    if reason := terms.reason or error.reason:
        return EnergyInterval(nothing, nothing, nothing, nothing, nothing, horizon, reason)
    inside, inertia = slice(terms.first, terms.stop), mass * terms.inertia
    deviations = error.deviation[inside], error.change[inside]
    slopes, sums, at_end = _sums(terms.error, terms.change, *deviations, np.array([terms.spring, inertia, *weights]))
    growth = verdict.growth_per_s * trial.sampling_period_s
    tail, tail_low, tail_high = _tail(at_end, (horizon, weights), growth, sunk=terms.stop < trial.rows)
    bias = sums[1]
    value, rest = sums[0] - bias + tail, _at_rest(trial, response, terms, weights)
    of_sensor = _sensor_variance(terms, error, inertia, slopes, sums[3])
    random = NORMAL_95**2 * (of_sensor + (mass_error * terms.inertia * sums[2]) ** 2)
    low = value - np.sqrt(random + (tail_low - tail) ** 2)
    high = value + np.sqrt(random + (tail_high - tail) ** 2)
    if weights == WEIGHTS:
        later, sooner = (_shifted(value, end - delay) - value for end in (longest, shortest))
    else:
        others = [energy_terms(trial, response, verdict, end, level) for end in (longest, shortest)]
        later, sooner = (other.summed(mass, weights) - terms.summed(mass, weights) for other in others)
    low = np.maximum(low + later, 0.0)
    high = high + sooner + rest
    trusted = (high - low <= 2 * LARGEST_HALF_WIDTH * value) & (tail_high + rest <= LARGEST_TAIL * value)
    size, reason = abs(trial.step) / trial.stiffness, ""
    if level > LARGEST_LEVEL * size:
        trusted[:] = False
        reason = f"noise and quantum of {level:.3g} are too large for a final displacement of {size:.3g}"
    elif not trusted.all():
        between = zip(low, high, strict=True)
        ends = [f": {a:.3g} to {b:.3g}" if np.isfinite(b) else " without upper end" for a, b in between]
        both = zip(weights, ends, trusted.tolist(), strict=True)
        open_ = ", ".join(f"w = {w:g}{end}" for w, end, known in both if not known)
        away = "; the device does not rest at the final position"
        remedy = away if rest.any() else "; record longer logs" if horizon else ""
        reason = f"noise, mass, delay and the motion after {horizon} samples are too uncertain for {open_}{remedy}"
    value, low, high, bias, tail = (np.where(trusted, part, np.nan) for part in (value, low, high, bias, tail))
    return EnergyInterval(value, low, high, bias, tail, horizon, reason)


def energy_row(
    trial: Trial, response: Response, verdict: Verdict, error: ReadingError, inputs: CostInputs
) -> EnergyRow:
    """Return the energy costs of a trial with their intervals in stored form."""
    cost = energy_interval(trial, response, verdict, error, inputs)
    parts = {"": cost.value, "_low": cost.low, "_high": cost.high, "_bias": cost.bias, "_tail": cost.tail}
    return EnergyRow(
        **{
            f"{c.column}{part}": float(values[int(c.weight)]) for c in members(ENERGY) for part, values in parts.items()
        },
        horizon_samples=cost.horizon_samples or np.nan,
        reason=cost.reason,
    )


def other_energy(
    trial: Trial,
    response: Response,
    verdict: Verdict,
    error: ReadingError,
    inputs: CostInputs,
    *,
    criterion: Criterion,
) -> OtherCostRow:
    """Return the energy cost of a trial for an exponent without a stored column."""
    cost = energy_interval(trial, response, verdict, error, inputs, (criterion.weight,))
    return OtherCostRow(float(cost.value[0]), float(cost.low[0]), float(cost.high[0]), cost.reason)


@compiled("Tuple((f8[:, ::1], f8[:, ::1], f8[:, ::1]))(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
def _sums(x: Floats, v: Floats, s: Floats, z: Floats, given: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the gradient of sum k^w E_k, shape (w, h), sums over k, shape (4, w), and values at the end, (2, 3).

    E_k = a x_k^2 + c v_k^2, where v_k = x_k - x_{k-1} and v_0 = 0. Standard errors s_k of x_k and z_k of v_k add
    n_k = a s_k^2 + c z_k^2 to E_k on average. The rows of the sums are k^w E_k, k^w n_k, k^w v_k^2 and (k^w n_k)^2. The
    first row at the end contains the sums of E_k - n_k in both quarters of the last half and of n_k in the last
    quarter. The second row contains the sum of n_k^2 in the last half, the largest E_k, and its k.

    Parameters
    ----------
    x, v, s, z : float64, shape (h,)
        Positions, changes and their standard errors [m, rad].
    given : float64, shape (2 + w,)
        The factors a and c [1/m^2, 1/rad^2], and the exponents.
    """
    h, a, c, w = len(x), given[0], given[1], given[2:]
    slopes, sums, half = np.zeros((len(w), h)), np.zeros((4, len(w))), max(h // 2, 1)
    end = np.zeros((2, 3))
    for k in range(h):
        energy, noise = a * x[k] ** 2 + c * v[k] ** 2, a * s[k] ** 2
        if k > 0:  # the first sample has no change
            noise += c * z[k] ** 2
        for i in range(len(w)):
            weight = float(k) ** w[i]
            sums[0, i] += weight * energy
            sums[1, i] += weight * noise
            sums[2, i] += weight * v[k] ** 2
            sums[3, i] += (weight * noise) ** 2
            slopes[i, k] += 2 * weight * (a * x[k] + c * v[k])
            if k > 0:
                slopes[i, k - 1] -= 2 * weight * c * v[k]
        if k >= h - half // 2:
            end[0, 1] += energy - noise
            end[0, 2] += noise
        elif k >= h - half:
            end[0, 0] += energy - noise
        if k >= h - half:
            end[1, 0] += noise**2
        if energy > end[1, 1]:
            end[1, 1], end[1, 2] = energy, k
    return slopes, sums, end


def _tail(
    at_end: Floats, beyond: tuple[int, tuple[float, ...]], growth: float, *, sunk: bool
) -> tuple[Floats, Floats, Floats]:
    """Return the energies beyond the horizon, sum k^w E_k/E_0, and the ends of their interval, shape (w,) each.

    ``at_end`` is a result of `_sums`, and ``beyond`` contains the horizon and the exponents.

    Beyond the horizon, a stable response consists of its slowest mode, whose energy falls by a constant factor in each
    sample. The factor is given by the growth rate. If the growth rate is unknown, the factor is given by the decay
    within the last half of the horizon, or, below the noise, by the mean decay since the peak of the energy. The energy
    is extrapolated from the sum over the last half.
    """
    horizon, weights = beyond
    nothing, endless = np.zeros(len(weights)), np.full(len(weights), np.inf)
    (before, after, late_noise), (squares, peak, at) = at_end.tolist()
    width = max(horizon // 2, 1)
    total, unsure = before + after, math.sqrt(squares)
    sunk |= after <= LEVEL_SIGMAS * late_noise
    long, above = horizon >= SHORTEST_HORIZON, after > 2 * unsure
    by_halves = its_error = departure = 0.0
    if clear := long and above and before > after:
        by_halves, its_error = math.log(before / after) / width, 4 * unsure / after / width
    if by_growth := growth < 0 and long and (clear or not above):
        decay = -growth
    else:
        # an ideal response that has decayed contains only rounding errors
        rest = max(total + unsure, ROUNDING**2 * peak) / width
        since = 2 * max(horizon - width // 2 - int(at), 1)
        mean = math.log(peak / rest) / since if peak > rest and (sunk or rest < ROUNDING * peak) else 0.0
        decay = by_halves if clear else mean
    doubt = (GROWTH_ERROR if by_growth or clear else MEAN_ERROR) * decay
    if by_growth and clear:
        # one deviation indicates the size of other deviations within a factor of two
        departure = 2 * abs(by_halves - decay)
        doubt = min(doubt, 0.25 * doubt + departure + its_error)
    else:
        doubt += its_error
    doubt = min(max(doubt, departure - its_error), decay - (1 - GROWTH_ERROR) * min(by_halves, decay))
    # the energy of both parts oscillates about the decay by this factor, and so does the tail, from at most the mean of
    # the last quarter
    swing = math.exp(min(max(departure - its_error, 0.0) * width, LARGEST_EXPONENT))
    most = 2 * (max(after, 0.0) + 2 * unsure) / width
    ends = []
    for rate, level, factor, bound in (
        (decay, total, 1.0, np.inf),
        (decay + doubt, total - 2 * unsure, 1 / swing, np.inf),
        (decay - doubt, total + 2 * unsure, swing, most),
    ):
        if rate > 0:
            # sum of exp(2 rate j) for j = 1 to the width
            grown = math.expm1(min(2 * rate * width, LARGEST_EXPONENT)) / -math.expm1(-2 * rate)
            ends.append(min(max(level, 0.0) / max(grown, 1.0) * factor, bound) * _moments(horizon, rate, weights))
        else:
            ends.append(endless)
    value, low, high = ends
    if not decay > 0:
        return nothing, nothing, endless
    return value, np.where(np.isfinite(low), low, 0.0), np.maximum(high, value)


def _moments(horizon: int, decay: float, weights: tuple[float, ...] = WEIGHTS) -> Floats:
    """Return the sum over j >= 0 of (h + j)^w exp(-2 decay j) for each w."""
    if weights != WEIGHTS:
        return np.array([_moment(horizon, 2 * decay, w) for w in weights])
    h, ratio, rest = float(horizon), math.exp(-2 * decay), -math.expm1(-2 * decay)
    plain, once, twice = 1 / rest, ratio / rest**2, ratio * (1 + ratio) / rest**3
    return np.array([plain, h * plain + once, h * h * plain + 2 * h * once + twice])


def _moment(horizon: int, rate: float, w: float) -> float:
    """Return the sum over j >= 0 of (h + j)^w exp(-rate j): first terms, then the Euler-Maclaurin formula."""
    from scipy.special import gamma, gammaincc

    j = np.arange(FIRST_TERMS + 1, dtype=np.float64)
    terms = (horizon + j) ** w * np.exp(-rate * j)
    start, last = rate * (horizon + FIRST_TERMS), float(terms[-1])
    if start > LARGEST_EXPONENT:  # the first powers approximate (1 + u/start)^w
        integral = last / rate * (1 + w / start + w * (w - 1) / start**2 + w * (w - 1) * (w - 2) / start**3)
    else:
        integral = math.exp(rate * horizon) * float(gammaincc(w + 1, start) * gamma(w + 1)) / rate ** (w + 1)
    slope = last * (w / (horizon + FIRST_TERMS) - rate)
    return float(terms[:-1].sum()) + integral + last / 2 - slope / 12


def _at_rest(trial: Trial, response: Response, terms: EnergyTerms, weights: tuple[float, ...]) -> Floats:
    """Return the energies after the horizon of a response that does not rest at its final position, shape (w,).

    Friction keeps the device there, and the plain sum grows with the length of the log. An offset below the sensor
    floor is ignored.
    """
    first, stop = terms.first, terms.stop
    offset = float((trial.position[stop:] - response.position_final_expected).sum()) / max(trial.rows - stop, 1)
    if abs(offset) <= response.floor:
        return np.zeros(len(weights))
    index = np.arange(stop - first, trial.rows - first, dtype=np.float64)
    return terms.spring * offset**2 * np.array([(index**w).sum() for w in weights])


def _sensor_variance(
    terms: EnergyTerms, error: ReadingError, inertia: float, slopes: Floats, noise_squares: Floats
) -> Floats:
    """Return the variance of the sum due to noise and quantum, shape (w,).

    The gradient along each error is the gradient along each reading, correlated with the response of the wall to an
    error.
    """
    rows, first = len(error.weight), terms.first
    length = 1 << (2 * rows - 1).bit_length()
    weight = math.sqrt(error.gain) * error.weight
    weight[:1] = 1.0
    answer = np.fft.rfft(weight, length).conj()
    along = np.empty((len(slopes), rows))
    for reading, slope in zip(along, slopes, strict=True):  # one by one, so that a long log needs less memory
        padded = np.zeros(length)
        padded[first : terms.stop] = slope
        reading[:] = np.fft.irfft(np.fft.rfft(padded) * answer, length)[:rows]
    start = max(first, 1)
    resting, moved = along[:, 1:start], along[:, start:]
    at_rest, in_motion = resting.sum(axis=1), moved.sum(axis=1)
    # the first reading is the reference of all others, which share its persistent error until the device moves;
    # the wall pulls the device towards the first reading
    alone = _squares(resting) + (at_rest + in_motion) ** 2
    variance = error.sensor**2 * (_squares(moved) + error.wandering * alone + error.lasting * in_motion**2)
    # errors enter their own slopes: the mean of 4 (x + e)^2 s^2 is 4 x^2 s^2 + 4 s^4, and the variance of (x + e)^2 is
    # 4 x^2 s^2 + 2 s^4; the responses of the wall to errors that are not persistent depend on each other
    spectrum = (answer.real**2 + answer.imag**2) * (terms.spring + inertia * _difference_gain(len(answer)))
    # sum of the squared covariances relative to the sum for single samples, by Parseval's theorem
    depends = len(answer) * (spectrum @ spectrum) / spectrum.sum() ** 2
    twice = noise_squares * (1 + (1 - error.lasting) * (depends - 1))
    result: Floats = np.maximum(variance - 2 * twice, 0.5 * variance)
    return result


def _squares(values: Floats) -> Floats:
    """Return the sum of squares of each row."""
    result: Floats = np.einsum("ij,ij->i", values, values)
    return result


@cache
def _difference_gain(frequencies: int) -> Floats:
    """Return the squared gain of a first difference, from frequency 0 to half the sampling frequency."""
    result: Floats = (2 * np.sin(np.linspace(0.0, 0.5 * np.pi, frequencies))) ** 2
    return result


def _shifted(value: Floats, shift: int) -> Floats:
    """Return the sum for a delay that is longer by a shift. Each sample before the motion has the energy E_0."""
    s0, s1, s2 = value.tolist()
    steps = range(1, abs(shift) + 1)
    # A longer delay removes samples with negative indices. A shorter delay adds samples from index 0.
    e0, e1, e2 = (-sum((-k) ** w for k in steps) if shift > 0 else sum((k - 1) ** w for k in steps) for w in WEIGHTS)
    return np.array([s0 + e0, s1 - shift * s0 + e1, s2 - 2 * shift * s1 + shift**2 * s0 + e2])
