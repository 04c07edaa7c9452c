"""Energy cost of measured responses with its interval by noise, quantum, mass, delay and the end of the log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.wording import percent
from pipeline.measured.cost.cost_intervals import delay_bounds
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.cost.tail import extrapolate
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.signal.horizon import WEIGHTS, EnergyTerms, energy_terms
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

Sampled = TypeVar("Sampled", EnergyTerms, ReadingError)

HORIZON_PARTS = (0.5, 1.0)
"""Parts of the horizon up to which the sum is reported, so that its dependence on the horizon is seen."""

LEVEL_SIGMAS = 4.5
"""Standard errors of a reading above which the response stands: noise alone exceeds them in 0.3 % of 400 samples. The
bias is taken off the sum, so that it can go further down than a plain sum."""

LARGEST_LEVEL = 0.1
"""Level of the horizon relative to the final displacement, from which on the error is not small, as first order
supposes: beyond it the intervals hold fewer than 90 % of simulated trials (60 um quantum, Falcon)."""

LARGEST_TAIL = 0.25
"""Part of the cost that may be extrapolated: beyond it the cost tells more of the extrapolation than of the log."""

LARGEST_HALF_WIDTH = 0.5
"""Half width of the interval, relative to the value, from which on nothing is known but the order of magnitude."""

CHUNK = 64
"""Trials whose cost is computed at once: an array of theirs, 0.5 MB at 1,000 rows, stays in a processor's cache."""

LONGEST_ANSWER = 1 << 16
"""Rows up to which trials are computed together, in their whole length; a longer one alone, up to its horizon."""


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
    by_horizon : float64, shape (n, 3, 2)
        The plain sum, with its bias, up to the parts `HORIZON_PARTS` of the horizon [1]; NaN where the trial has no
        cost at all.
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
    by_horizon: Floats
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

    Returns
    -------
    EnergyInterval

    Raises
    ------
    ParameterError
        If the mass is not positive, its error negative, or the range of the delay does not hold the delay.

    Notes
    -----
    The cost is `EnergyTerms.summed`, but unbiased and complete: noise adds its variance times k^w to the sum, and the
    sum ends at the horizon. The error by noise is carried on to first order, with the answer of the wall
    to each error. Independent parts (noise, mass, tail) are added as squares, each side for itself; the range
    of the delay is added to them as it is: another delay drops samples or takes some in, and moves all indices. So are
    the energies of a response that rests beside its final position, which lie behind the horizon.

    There is no value where more than `LARGEST_TAIL` of it may lie beyond the horizon, or its decay is not known;
    where the interval is wider than `LARGEST_HALF_WIDTH`; where noise and quantum are not small beside the final
    displacement. 94 to 98 % of the intervals of the shipped devices hold the cost of the ideal loop, and 90 to 97 %
    with a quantum and no noise, where errors of slow readings depend on each other. What jitter does to the cost,
    friction and a wrong final position are not in the interval.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    if not (mass > 0 and mass_error >= 0):
        raise ParameterError(f"mass {mass:g} +- {mass_error:g}: expected a positive mass and an error >= 0.")
    given = _Given(delay_samples, delay_bounds(delay_samples, delay_range), mass, mass_error)
    parts = [
        _interval(part, response.select(some), verdicts.select(some), error.select(some), given)
        for some, part in batch.portions(CHUNK if batch.position.shape[1] <= LONGEST_ANSWER else 1)
    ]
    names = [name for name in EnergyInterval.__dataclass_fields__ if name != "reason"]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return EnergyInterval(**joined, reason=tuple(text for part in parts for text in part.reason))


@dataclass(frozen=True)
class _Given:
    """What holds for all trials: delay [samples] and its range, mass and its standard error [kg, kg m^2]."""

    delay_samples: int
    delays: tuple[int, int]
    mass: float
    mass_error: float


@dataclass(frozen=True, eq=False)
class _Sums:
    """What the cost of some trials is made of.

    ``spring`` and ``inertia`` (n,) are E_k/E_0 per x^2 and per squared change; ``energy`` and what noise adds to it,
    ``noise``, are of each sample to the horizon (n, N), ``deviation`` the error of a reading, and ``weight`` k^w.
    """

    terms: EnergyTerms
    error: ReadingError
    known: Booleans
    spring: Floats
    inertia: Floats
    energy: Floats
    noise: Floats
    deviation: Floats
    weight: list[Floats]

    def over(self, part: Floats) -> Floats:
        """Return sum of k^w over the samples, shape (n, 3)."""
        return np.stack([(k * part).sum(axis=1) for k in self.weight], axis=1)


def _sums(batch: TrialBatch, terms: EnergyTerms, error: ReadingError, mass: float) -> _Sums:
    known = terms.usable & np.array([not text for text in error.reason], dtype=np.bool_)
    column = np.arange(terms.index.shape[1])[None, :]
    inside = column < terms.stop[:, None]
    inside &= (terms.index > 0) | (column == terms.first[:, None])
    inside &= known[:, None]
    stiffness, step = (np.where(known, values, 1.0) for values in (batch.stiffness, batch.step))
    spring, inertia = (stiffness / step) ** 2, stiffness * mass / (step * batch.sampling_period_s) ** 2
    deviation, change = (np.where(inside, np.nan_to_num(part), 0.0) for part in (error.deviation, error.change))
    change = np.where(terms.index > 0, change, 0.0)  # the first sample has no change
    return _Sums(
        terms=terms,
        error=error,
        known=known,
        spring=spring,
        inertia=inertia,
        energy=np.where(inside, terms.potential + mass * terms.kinetic, 0.0),
        noise=spring[:, None] * deviation**2 + inertia[:, None] * change**2,
        deviation=deviation,
        weight=[np.where(inside, terms.index**w, 0.0) for w in WEIGHTS],
    )


def _interval(
    batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: _Given
) -> EnergyInterval:
    """Return the cost of some trials with its interval, see `energy_interval`."""
    last = np.maximum(batch.rows - 1, 0)[:, None]
    level = LEVEL_SIGMAS * np.nan_to_num(np.take_along_axis(error.deviation, last, axis=1)[:, 0])
    terms = energy_terms(batch, response, verdicts, given.delay_samples, level)
    if batch.position.shape[1] > LONGEST_ANSWER:
        summed = int(terms.stop.max(initial=1))
        terms, error = _until(terms, summed), _until(error, summed)
    sums = _sums(batch, terms, error, given.mass)
    bias, by_horizon = sums.over(sums.noise), _by_horizon(sums)
    tail = extrapolate(
        terms.error,
        sums.energy,
        terms.first,
        terms.stop,
        error_variance=sums.deviation**2,
        energy_bias=sums.noise,
        growth=verdicts.growth_per_s * batch.sampling_period_s,
        sunk=terms.stop < batch.rows,
    )
    value = sums.over(sums.energy) - bias + tail.value
    rest = _at_rest(batch, response, terms, sums)
    random = NORMAL_95**2 * (_sensor_error(sums) ** 2 + (given.mass_error * sums.over(terms.kinetic)) ** 2)
    with np.errstate(invalid="ignore"):
        high = value + np.sqrt(random + (tail.high - tail.value) ** 2)
        low = value - np.sqrt(random + (tail.value - tail.low) ** 2)
        shifts = [_shifted(value, d - given.delay_samples) - value for d in given.delays]
        low, high = np.maximum(low + shifts[1], 0.0), high + shifts[0] + rest
        whole = np.isfinite(tail.high) & (tail.high + rest <= LARGEST_TAIL * value)
        trusted = whole & (high - low <= 2 * LARGEST_HALF_WIDTH * value)
    size = np.where(sums.known, np.abs(batch.step) / np.where(sums.known, batch.stiffness, 1.0), 1.0)
    clear = sums.known & (level <= LARGEST_LEVEL * size)
    there = clear[:, None] & trusted
    horizon = terms.stop - terms.first
    reason = [a or b for a, b in zip(terms.reason, error.reason, strict=True)]
    for i in (i for i, text in enumerate(reason) if not text):
        reason[i] = (
            _reason(whole[i], there[i], tail.high[i], rest[i], value[i], (low[i], high[i]), int(horizon[i]))
            if clear[i]
            else f"noise and quantum leave {level[i]:.3g} open, too much for a final displacement of {size[i]:.3g}"
        )
    value, low, high, bias, beyond = (np.where(there, part, np.nan) for part in (value, low, high, bias, tail.value))
    by_horizon = np.where(sums.known[:, None, None], by_horizon, np.nan)
    return EnergyInterval(value, low, high, bias, beyond, by_horizon, horizon, tuple(reason))


def _at_rest(batch: TrialBatch, response: Response, terms: EnergyTerms, sums: _Sums) -> Floats:
    """Return the energies behind the horizon of a response that rests beside its final position, shape (n, 3).

    Friction holds it there: the plain sum grows by them as long as the log lasts. Beside it by less than the sensor
    floor nothing is told.
    """
    column = np.arange(batch.position.shape[1])[None, :]
    behind = batch.valid & (column >= terms.stop[:, None]) & sums.known[:, None]
    number = np.maximum(behind.sum(axis=1), 1)
    final = np.where(sums.known, response.position_final_expected, 0.0)
    off = np.where(behind, batch.position - final[:, None], 0.0).sum(axis=1) / number
    energy = np.where(np.abs(off) > response.floor, sums.spring * off**2, 0.0)
    index = np.where(behind, column - terms.first[:, None], 0).astype(np.float64)
    return np.stack([energy * np.where(behind, index**w, 0.0).sum(axis=1) for w in WEIGHTS], axis=1)


def _until(of: Sampled, columns: int) -> Sampled:
    """Return the same of the first samples alone, as arrays of their own, so that those of all take no more memory."""
    arrays = {name: value[:, :columns].copy() for name, value in vars(of).items() if np.ndim(value) == 2}
    return replace(of, **arrays)


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
        # the first reading is the reference of all others, which share what lasts of its error until the device moves
        free, bound = ((part**2).sum(axis=1) + part.sum(axis=1) ** 2 for part in (each, moved))
        square = (1 - error.lasting) * free + error.lasting * bound
        result.append(np.nan_to_num(error.sensor) ** 2 * square)
    # slopes that errors made steeper count their squares twice over: of 4 (x + e)^2 s^2 the mean is 4 x^2 s^2 + 4 s^4,
    # but (x + e)^2 has the variance 4 x^2 s^2 + 2 s^4; what the wall answers to errors that do not last depends on them
    variance = np.stack(result, axis=1)
    squares = np.stack([((k * sums.noise) ** 2).sum(axis=1) for k in sums.weight], axis=1)
    squares *= 1 + ((1 - error.lasting) * (_dependence(answer, sums) - 1))[:, None]
    total: Floats = np.sqrt(np.maximum(variance - 2 * squares, 0.5 * variance))
    return total


def _dependence(answer: np.ndarray[tuple[int, ...], np.dtype[np.complex128]], sums: _Sums) -> Floats:
    """Sum of the squared covariances of the energies of all errors, relative to that of each one's own, shape (n,).

    Their spectrum is that of the wall's answer, of springs and inertias; Parseval's theorem makes sums of it.
    """
    frequency = np.linspace(0.0, np.pi, answer.shape[1])
    power = sums.spring[:, None] + sums.inertia[:, None] * (2 * np.sin(0.5 * frequency)) ** 2
    spectrum = np.abs(answer) ** 2 * power
    mean = spectrum.mean(axis=1)
    result: Floats = np.divide((spectrum**2).mean(axis=1), mean**2, out=np.ones(len(mean)), where=mean > 0)
    return result


def _shifted(value: Floats, shift: int) -> Floats:
    """Sum for a delay that is larger by a shift: before the device moves, each sample has the energy E_0."""
    s0, s1, s2 = value.T
    steps = np.arange(1, abs(shift) + 1)
    moved = [s0, s1 - shift * s0, s2 - 2 * shift * s1 + shift**2 * s0]
    # samples that a larger delay drops had negative indices, those that a smaller one takes in have indices from 0
    extra = [-np.sum((-steps) ** w) if shift > 0 else np.sum((steps - 1) ** w) for w in WEIGHTS]
    return np.stack([part + more for part, more in zip(moved, extra, strict=True)], axis=1)


def _by_horizon(sums: _Sums) -> Floats:
    """Plain sums up to parts of the horizon, shape (n, 3, 2)."""
    energy, first, horizon = sums.energy, sums.terms.first, sums.terms.stop - sums.terms.first
    rows = [first + np.ceil(part * horizon).astype(np.int64) for part in HORIZON_PARTS]
    at = np.minimum(np.stack(rows, axis=1), energy.shape[1])
    cumulative = (np.cumsum(np.pad(k * energy, ((0, 0), (1, 0))), axis=1) for k in sums.weight)
    return np.stack([np.take_along_axis(each, at, axis=1) for each in cumulative], axis=1)


def _reason(
    whole: Booleans,
    there: Booleans,
    tail: Floats,
    rest: Floats,
    value: Floats,
    ends: tuple[Floats, Floats],
    horizon: int,
) -> str:
    """Say why exponents of one trial have no value."""
    parts = []
    lost = [w for w in WEIGHTS if not whole[w]]
    if lost and rest[lost[-1]] > 0:
        shares = ", ".join(f"w = {w}: {percent(rest[w] / value[w])}" for w in lost)
        parts.append(
            f"summed over {horizon} samples; it rests beside its final position, which adds {shares} of the cost by "
            "the end of the log, and more in a longer one"
        )
    elif lost and np.isfinite(tail[lost[-1]]):
        shares = ", ".join(f"w = {w}: {percent(tail[w] / value[w])}" for w in lost)
        parts.append(f"summed over {horizon} samples; beyond them may lie {shares} of the cost: record longer")
    elif lost:
        parts.append(
            f"summed over {horizon} samples; how fast the response decays beyond them is not known, so there is no "
            f"value (w = {', '.join(map(str, lost))}): record longer"
        )
    wide = [w for w in WEIGHTS if whole[w] and not there[w]]
    parts += [f"w = {w}: noise, mass and delay leave {ends[0][w]:.3g} to {ends[1][w]:.3g} open" for w in wide]
    return "; ".join(parts)
