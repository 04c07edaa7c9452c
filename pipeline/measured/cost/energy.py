"""Energy cost of measured responses, with its interval by noise, quantum, mass, delay and the end of the log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.cost.costs import cost_start, delay_bounds
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.sensor import AT_REST
from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.student import NORMAL_95
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.criteria import ENERGY, members
from pipeline.records.findings import ROUNDING

WEIGHTS = tuple(sorted({c.weight for c in members(ENERGY)}))
"""Exponents w of the weighting by time."""

LEVEL_SIGMAS = 4.5
"""Standard errors of a reading above which the response stands: noise alone exceeds them in 0.3 % of 400 samples. The
bias is taken off the sum, so that it can go further down than a plain sum."""

LARGEST_LEVEL = 0.1
"""Level of the horizon relative to the final displacement, from which on the error is not small, as first order
supposes: beyond it the intervals hold fewer than 90 % of simulated trials (60 um quantum, Falcon)."""

LARGEST_HALF_WIDTH = 0.5
"""Half width of the interval, relative to the value, from which on nothing is known but the order of magnitude."""

GROWTH_ERROR, MEAN_ERROR = 0.2, 0.5
"""Relative error of a decay beyond the horizon: of a growth rate by the modes of the whole motion (95 % of noisy Falcon
logs stay within it), and of the mean decay since the peak of the energy, where there is none."""

LARGEST_TAIL = 0.25
"""Part of the cost that may lie beyond the horizon: with more it tells more of the extrapolation than of the log."""

SHORTEST_HORIZON = 40
"""Samples of the shortest horizon that tells a decay: half of them hold a swing of the fastest walls."""

LARGEST_EXPONENT = 0.5 * float(np.log(np.finfo(np.float64).max))
"""Beyond twice that exp overflows."""


@dataclass(frozen=True, eq=False)
class EnergyTerms:
    """Energies of each sample from cost index 0 to the horizon, relative to E_0 = F_0^2/(2 K).

    Parameters
    ----------
    first, stop : int64, shape (n,)
        Row of cost index 0, and first row behind the horizon; equal where a trial has no cost.
    usable : bool, shape (n,)
        Trials that can have a cost.
    index : float64, shape (n, N)
        Cost index k; 0 outside the horizon.
    error : float64, shape (n, N)
        Distance from x_0 + F_0/K [m, rad]; 0 outside the horizon.
    change : float64, shape (n, N)
        Change since the sample before [m, rad]; 0 at cost index 0 and outside the horizon.
    potential, kinetic : float64, shape (n, N)
        Potential energy [1] and kinetic energy per mass [1/kg, 1/(kg m^2)] of each sample.
    reason : tuple of str
        Why a trial cannot have a cost.
    """

    first: Integers
    stop: Integers
    usable: Booleans
    index: Floats
    error: Floats
    change: Floats
    potential: Floats
    kinetic: Floats
    reason: tuple[str, ...]

    def summed(self, mass: float) -> Floats:
        """Return the plain sums of k^w E_k/E_0 up to the horizon, shape (n, 3); NaN where a trial can have no cost."""
        energy = self.potential + mass * self.kinetic
        # 0^0 = 1 outside the horizon meets energies of 0
        sums = np.stack([(self.index**w * energy).sum(axis=1) for w in WEIGHTS], axis=1)
        return np.where(self.usable[:, None], sums, np.nan)


def energy_terms(
    batch: TrialBatch, response: Response, verdicts: Verdicts, delay_samples: int, level: Floats | None = None
) -> EnergyTerms:
    """Return the energies of each sample up to the horizon.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.
    level : float64, shape (n,), optional
        Distance from the final position above which the response stands [m, rad]; `AT_REST` sensor floors
        where it is not given.

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    E_k = K/2 (x_k - x_inf)^2 + m/2 ((x_k - x_{k-1})/T)^2 with x_{-1} = x_0. The horizon is where the response sinks
    below the level for good, since the floor times k^2 over a long log would swamp the sum; ideal logs are taken to
    their end.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    first, usable, why = cost_start(batch, response, verdicts, delay_samples)
    columns = batch.position.shape[1]
    column = np.arange(columns)[None, :]
    final = np.where(usable, response.position_final_expected, 0.0)
    stiffness = np.where(usable, batch.stiffness, 1.0)
    counted = batch.valid & (column >= first[:, None]) & usable[:, None]
    error = np.where(counted, batch.position - final[:, None], 0.0)
    level = AT_REST * response.floor if level is None else level
    above = counted & (np.abs(error) > level[:, None])
    stop = np.where(above.any(axis=1), columns - np.argmax(above[:, ::-1], axis=1), first)
    stop = np.where(response.floor > 0, stop, batch.rows)
    stop = np.where(usable, stop, first)
    counted &= column < stop[:, None]
    error = np.where(counted, error, 0.0)
    change = np.diff(batch.position, axis=1, prepend=batch.position[:, :1])
    # chi_{-1} = chi_0: the response is at rest at its index 0
    change = np.where(counted & (column > first[:, None]), change, 0.0)
    # a trial without a step is not usable, as one without a wall
    start_energy = (np.where(usable, batch.step, 1.0) ** 2 / (2 * stiffness))[:, None]
    return EnergyTerms(
        first=first,
        stop=stop.astype(np.int64),
        usable=usable,
        index=np.where(counted, column - first[:, None], 0).astype(np.float64),
        error=error,
        change=change,
        potential=0.5 * stiffness[:, None] * error**2 / start_energy,
        kinetic=0.5 * (change / batch.sampling_period_s[:, None]) ** 2 / start_energy,
        reason=why,
    )


@dataclass(frozen=True, eq=False)
class EnergyInterval:
    """Discrete energy cost for w = 0, 1, 2 with its 95 % interval, shape (n, 3); NaN where there is no value.

    Parameters
    ----------
    value, low, high : float64, shape (n, 3)
        Sum over the horizon, less the bias by noise, plus the tail beyond the horizon, and its interval [1].
    bias : float64, shape (n, 3)
        What noise and quantum add to the sum on average [1]; it is taken off in ``value``.
    tail : float64, shape (n, 3)
        Part of ``value`` that lies beyond the horizon [1], extrapolated.
    horizon_samples : int64, shape (n,)
        Number of samples summed.
    reason : tuple of str
        Why values are missing, one text a trial, exponents named.
    """

    value: Floats
    low: Floats
    high: Floats
    bias: Floats
    tail: Floats
    horizon_samples: Integers
    reason: tuple[str, ...]


def energy_interval(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    error: ReadingError,
    delay_samples: int,
    mass: float,
    *,
    mass_error: float = 0.0,
    delay_range: tuple[int, int] | None = None,
) -> EnergyInterval:
    """Return the discrete energy cost with its interval.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts, error : Response, Verdicts, ReadingError
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.
    mass : float
        Mass or inertia that the wall feels [kg, kg m^2].
    mass_error : float
        Its standard error [kg, kg m^2].
    delay_range : tuple of int, optional
        Smallest and largest integer delay factor that the experiment leaves open.

    Raises
    ------
    ParameterError
        If the mass is not positive, its error negative, or the range of the delay does not hold the delay.

    Notes
    -----
    The cost is `EnergyTerms.summed`, but unbiased and complete: noise adds its variance times k^w to the sum, and the
    sum ends at the horizon. The error by noise is carried on to first order, with the answer of the wall to each error.
    Independent parts (noise, mass, tail) are added as squares, each side for itself; the range of the delay is added
    to them as it is: another delay drops samples or takes some in, and moves all indices. So are the energies of a
    response that rests beside its final position, which lie behind the horizon.

    There is no value where the interval is wider than `LARGEST_HALF_WIDTH`, and where noise and quantum are not small
    beside the final displacement. 94 to 97 % of the intervals of the shipped devices hold the cost of the ideal loop,
    and 90 to 97 % with a quantum and no noise, where errors of slow readings depend on each other. What jitter itself
    does to the cost, and a wrong final position, are not in the interval.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    if not (mass > 0 and mass_error >= 0):
        raise ParameterError(f"mass {mass:g} +- {mass_error:g}: expected a positive mass and an error >= 0.")
    delays = delay_bounds(delay_samples, delay_range)
    shifts = delays[0] - delay_samples, delays[1] - delay_samples
    parts = []
    for some, part in batch.portions(max((1 << 16) // max(batch.position.shape[1], 1 << 10), 1)):
        seen, told, each = response.select(some), verdicts.select(some), error.select(some)
        last = np.maximum(part.rows - 1, 0)[:, None]
        level = LEVEL_SIGMAS * np.nan_to_num(np.take_along_axis(each.deviation, last, axis=1)[:, 0])
        terms = energy_terms(part, seen, told, delay_samples, level)
        growth = told.growth_per_s * part.sampling_period_s
        parts.append(_interval(part, seen, growth, _sums(part, terms, each, mass), level, mass_error, shifts))
    names = [name for name in EnergyInterval.__dataclass_fields__ if name != "reason"]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return EnergyInterval(**joined, reason=tuple(text for part in parts for text in part.reason))


def energy(
    batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Any
) -> dict[str, Any]:
    """Return the energies of some trials with their intervals as columns, as a family of costs (`costs.Measure`)."""
    found = energy_interval(
        *(batch, response, verdicts, error, given["delay"], given["mass"]),
        mass_error=given["mass_error"],
        delay_range=tuple(given["delay_range"]),
    )
    parts = {"": found.value, "_low": found.low, "_high": found.high, "_bias": found.bias, "_tail": found.tail}
    return {
        **{f"{c.column}{part}": values[:, c.weight] for c in members(ENERGY) for part, values in parts.items()},
        "horizon_samples": np.where(found.horizon_samples > 0, found.horizon_samples, np.nan),
        "reason": found.reason,
    }


@dataclass(frozen=True, eq=False)
class _Sums:
    """What the cost of some trials is made of.

    ``spring`` and ``inertia`` (n,) are E_k/E_0 per x^2 and per squared change; ``energy`` and what noise adds to it,
    ``noise``, are of each sample to the horizon (n, N), and ``weight`` k^w.
    """

    terms: EnergyTerms
    error: ReadingError
    known: Booleans
    spring: Floats
    inertia: Floats
    energy: Floats
    noise: Floats
    weight: list[Floats]

    def over(self, part: Floats) -> Floats:
        """Return sum of k^w over the samples, shape (n, 3)."""
        return np.stack([(k * part).sum(axis=1) for k in self.weight], axis=1)


def _sums(batch: TrialBatch, terms: EnergyTerms, error: ReadingError, mass: float) -> _Sums:
    known = terms.usable & np.array([not text for text in error.reason], dtype=np.bool_)
    column = np.arange(terms.index.shape[1])[None, :]
    inside = (column >= terms.first[:, None]) & (column < terms.stop[:, None]) & known[:, None]
    stiffness, step = (np.where(known, values, 1.0) for values in (batch.stiffness, batch.step))
    spring, inertia = (stiffness / step) ** 2, stiffness * mass / (step * batch.sampling_period_s) ** 2
    deviation = np.where(inside, np.nan_to_num(error.deviation), 0.0)
    # the first sample has no change
    change = np.where(inside & (terms.index > 0), np.nan_to_num(error.change), 0.0)
    return _Sums(
        *(terms, error, known, spring, inertia),
        energy=np.where(inside, terms.potential + mass * terms.kinetic, 0.0),
        noise=spring[:, None] * deviation**2 + inertia[:, None] * change**2,
        weight=[np.where(inside, terms.index**w, 0.0) for w in WEIGHTS],
    )


def _interval(
    batch: TrialBatch,
    response: Response,
    growth: Floats,
    sums: _Sums,
    level: Floats,
    mass_error: float,
    shifts: tuple[int, int],
) -> EnergyInterval:
    """Return the cost of some trials with its interval, see `energy_interval`."""
    terms, bias = sums.terms, sums.over(sums.noise)
    tail = _tail(sums, growth, terms.stop < batch.rows)
    value = sums.over(sums.energy) - bias + tail[0]
    rest = _at_rest(batch, response, sums)
    random = NORMAL_95**2 * (_sensor_error(sums) ** 2 + (mass_error * sums.over(terms.kinetic)) ** 2)
    with np.errstate(invalid="ignore"):
        low, high = (
            value + sign * np.sqrt(random + (end - tail[0]) ** 2) for sign, end in zip((-1, 1), tail[1:], strict=True)
        )
        low = np.maximum(low + _shifted(value, shifts[1]) - value, 0.0)
        high = high + _shifted(value, shifts[0]) - value + rest
        trusted = (high - low <= 2 * LARGEST_HALF_WIDTH * value) & (tail[2] + rest <= LARGEST_TAIL * value)
    size = np.where(sums.known, np.abs(batch.step) / np.where(sums.known, batch.stiffness, 1.0), 1.0)
    clear = sums.known & (level <= LARGEST_LEVEL * size)
    there, horizon = clear[:, None] & trusted, terms.stop - terms.first
    reason = [a or b for a, b in zip(terms.reason, sums.error.reason, strict=True)]
    for i in (i for i, text in enumerate(reason) if not text):
        open_ = [
            f"w = {w}: {low[i, w]:.3g} to {high[i, w]:.3g}" if np.isfinite(high[i, w]) else f"w = {w} without an end"
            for w in WEIGHTS
            if not there[i, w]
        ]
        if not clear[i]:
            reason[i] = (
                f"noise and quantum leave {level[i]:.3g} open, too much for a final displacement of {size[i]:.3g}"
            )
        elif open_:
            beside = (
                "; it rests beside its final position" if rest[i].any() else "; record longer" if horizon[i] else ""
            )
            reason[i] = (
                f"noise, mass, delay and what follows {horizon[i]} samples leave open {', '.join(open_)}{beside}"
            )
    value, low, high, bias, beyond = (np.where(there, part, np.nan) for part in (value, low, high, bias, tail[0]))
    return EnergyInterval(value, low, high, bias, beyond, horizon, tuple(reason))


def _tail(sums: _Sums, growth: Floats, sunk: Booleans) -> tuple[Floats, Floats, Floats]:
    """Return the energies beyond the horizon, sum k^w E_k/E_0, and both ends of their interval, shape (n, 3) each.

    A stable response is its slowest mode there, whose energy falls by a constant factor a sample: by its growth rate,
    else by the halves of the last half of the horizon, else, where it has sunk into the noise, by its mean decay since
    the peak of its energy. It is carried on from the sum over that last half.
    """
    terms, net = sums.terms, sums.energy - sums.noise
    horizon = terms.stop - terms.first
    width = np.maximum(horizon // 2, 1)
    ahead = (terms.stop[:, None] - np.arange(net.shape[1])[None, :]).astype(np.float64)
    window = (ahead > 0) & (ahead <= width[:, None])
    late = window & (ahead <= 0.5 * width[:, None])
    total, after = (np.where(part, net, 0.0).sum(axis=1) for part in (window, late))
    unsure = np.sqrt(np.where(window, sums.noise**2, 0.0).sum(axis=1))
    sunk |= after <= LEVEL_SIGMAS * np.where(late, sums.noise, 0.0).sum(axis=1)
    long, above = horizon >= SHORTEST_HORIZON, after > 2 * unsure
    clear = long & above & (total - after > after)
    safe = np.where(clear, after, 1.0)
    by_halves = np.log(np.where(clear, total - after, 1.0) / safe) / width
    its_error = 4 * unsure / safe / width
    peak, at = sums.energy.max(axis=1, initial=0.0), np.argmax(sums.energy, axis=1)
    # of an ideal response that has died away rounding is left
    left = np.maximum(total + unsure, ROUNDING**2 * peak) / width
    mean = np.log(np.where(peak > left, peak, 1.0) / np.where(peak > left, left, 1.0))
    mean /= 2 * np.maximum(terms.stop - width // 2 - at, 1)
    mean = np.where(sunk | (left < ROUNDING * peak), mean, 0.0)
    told = (growth < 0) & long & (clear | ~above)
    decay = np.where(told, -growth, np.where(clear, by_halves, mean))
    # one departure tells the size of others to a factor of two
    apart = np.where(told & clear, 2 * np.abs(by_halves - decay), 0.0)
    doubt = np.where(told | clear, GROWTH_ERROR, MEAN_ERROR) * decay
    doubt = np.where(
        told & clear, np.minimum(doubt, 0.25 * doubt + apart + its_error), doubt + np.where(clear, its_error, 0.0)
    )
    slowest = (1 - GROWTH_ERROR) * np.where(clear, np.minimum(by_halves, decay), 0.0)
    doubt = np.minimum(np.maximum(doubt, apart - its_error), decay - slowest)
    # the energy of both halves swings about the decay by as much, and so does what follows, from no more than its mean
    swing = np.exp(np.minimum(np.maximum(apart - its_error, 0.0) * width, LARGEST_EXPONENT))
    most = 2 * (np.maximum(after, 0.0) + 2 * unsure) / width
    ends = []
    for rate, level, factor, bound in (
        (decay, total, 1.0, np.inf),
        (decay + doubt, total - 2 * unsure, 1 / swing, np.inf),
        (decay - doubt, total + 2 * unsure, swing, most),
    ):
        positive = np.where(rate > 0, rate, 1.0)[:, None]
        grown = np.where(window, np.exp(np.minimum(2 * positive * ahead, LARGEST_EXPONENT)), 0.0).sum(axis=1)
        beyond = np.minimum(np.maximum(level, 0.0) / np.maximum(grown, 1.0) * factor, bound)
        ends.append(np.where((rate > 0)[:, None], beyond[:, None] * _moments(horizon, positive[:, 0]), np.inf))
    value, low, high = ends
    known = np.isfinite(value) & (horizon > 0)[:, None]
    low = np.where(known & np.isfinite(low), low, 0.0)
    return np.where(known, value, 0.0), low, np.where(known, np.maximum(high, value), np.inf)


def _moments(horizon: Integers, decay: Floats) -> Floats:
    """Sum over j >= 0 of (h + j)^w exp(-2 decay j) for w = 0, 1, 2, shape (n, 3)."""
    ratio, rest = np.exp(-2 * decay), -np.expm1(-2 * decay)
    h = horizon.astype(np.float64)
    plain, once, twice = 1 / rest, ratio / rest**2, ratio * (1 + ratio) / rest**3
    return np.stack([plain, h * plain + once, h * h * plain + 2 * h * once + twice], axis=1)


def _at_rest(batch: TrialBatch, response: Response, sums: _Sums) -> Floats:
    """Return the energies behind the horizon of a response that rests beside its final position, shape (n, 3).

    Friction holds it there: the plain sum grows by them as long as the log lasts. Beside it by less than the sensor
    floor nothing is told.
    """
    column = np.arange(batch.position.shape[1])[None, :]
    behind = batch.valid & (column >= sums.terms.stop[:, None]) & sums.known[:, None]
    final = np.where(sums.known, response.position_final_expected, 0.0)
    off = np.where(behind, batch.position - final[:, None], 0.0).sum(axis=1) / np.maximum(behind.sum(axis=1), 1)
    energy = np.where(np.abs(off) > response.floor, sums.spring * off**2, 0.0)
    index = np.where(behind, column - sums.terms.first[:, None], 0).astype(np.float64)
    return np.stack([energy * np.where(behind, index**w, 0.0).sum(axis=1) for w in WEIGHTS], axis=1)


def _sensor_error(sums: _Sums) -> Floats:
    """Standard error of the sum by noise and quantum, shape (n, 3).

    The slope of the sum to each reading, correlated with the wall's answer to an error, is the slope to each error.
    """
    terms, error = sums.terms, sums.error
    columns = error.weight.shape[1]
    # a length that does not depend on other trials
    length = 1 << (2 * columns - 1).bit_length()
    weight = np.sqrt(error.gain)[:, None] * error.weight
    weight[:, :1] = 1.0
    answer = np.conj(np.fft.rfft(weight, length))
    position, speed = sums.spring[:, None] * terms.error, sums.inertia[:, None] * terms.change
    result = []
    for k in sums.weight:
        moving = k * speed
        slope = 2 * (k * position + moving)
        slope[:, :-1] -= 2 * moving[:, 1:]
        each = np.fft.irfft(np.fft.rfft(slope, length) * answer, length)[:, 1:columns]
        moved = np.where(np.arange(1, columns)[None, :] >= terms.first[:, None], each, 0.0)
        # the first reading is the reference of all others, which share what lasts of its error until the device moves;
        # the wall pulls the device towards the first reading
        resting = ((each - moved) ** 2).sum(axis=1) + each.sum(axis=1) ** 2
        square = (moved**2).sum(axis=1) + error.wandering * resting + error.lasting * moved.sum(axis=1) ** 2
        result.append(np.nan_to_num(error.sensor) ** 2 * square)
    # slopes that errors made steeper count their squares twice over: of 4 (x + e)^2 s^2 the mean is 4 x^2 s^2 + 4 s^4,
    # but (x + e)^2 has the variance 4 x^2 s^2 + 2 s^4; what the wall answers to errors that do not last depends on them
    variance = np.stack(result, axis=1)
    squares = np.stack([((k * sums.noise) ** 2).sum(axis=1) for k in sums.weight], axis=1)
    # sum of the squared covariances relative to each one's own, by Parseval's theorem
    frequency = np.linspace(0.0, np.pi, answer.shape[1])
    power = sums.spring[:, None] + sums.inertia[:, None] * (2 * np.sin(0.5 * frequency)) ** 2
    spectrum = np.abs(answer) ** 2 * power
    mean = spectrum.mean(axis=1)
    depends = np.divide((spectrum**2).mean(axis=1), mean**2, out=np.ones(len(mean)), where=mean > 0)
    squares *= 1 + ((1 - error.lasting) * (depends - 1))[:, None]
    total: Floats = np.sqrt(np.maximum(variance - 2 * squares, 0.5 * variance))
    return total


def _shifted(value: Floats, shift: int) -> Floats:
    """Sum for a delay that is larger by a shift: before the device moves, each sample has the energy E_0."""
    s0, s1, s2 = value.T
    steps = np.arange(1, abs(shift) + 1)
    moved = [s0, s1 - shift * s0, s2 - 2 * shift * s1 + shift**2 * s0]
    # samples that a larger delay drops had negative indices, those that a smaller one takes in have indices from 0
    extra = [-np.sum((-steps) ** w) if shift > 0 else np.sum((steps - 1) ** w) for w in WEIGHTS]
    return np.stack([part + more for part, more in zip(moved, extra, strict=True)], axis=1)
