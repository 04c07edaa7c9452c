"""Energy cost of measured responses with its interval by noise, quantum, mass, delay and the end of the log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import TypeVar

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.wording import percent
from pipeline.measured.cost.cost_intervals import delay_bounds
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.cost.tail import extrapolate
from pipeline.measured.intervals import CONFIDENCE
from pipeline.measured.signal.horizon import WEIGHTS, EnergyTerms, energy_terms
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

Sampled = TypeVar("Sampled", EnergyTerms, ReadingError)

HORIZON_PARTS = (0.5, 0.75, 0.9, 1.0)
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
    sensor_error : float64, shape (n, 3)
        Standard error of the sum by noise and quantum [1].
    tail : float64, shape (n, 3)
        Part of ``value`` that lies beyond the horizon [1], extrapolated.
    by_horizon : float64, shape (n, 3, 4)
        The plain sum, with its bias, up to the parts `HORIZON_PARTS` of the horizon [1]; NaN where the trial has no
        cost at all.
    per_sample : float64, shape (n, 3)
        What one more sample would add at the horizon [1/sample]: the mean over the last eighth of it.
    horizon_samples : int64, shape (n,)
        Number of samples summed.
    reason : tuple of str
        Why values are missing, one text a trial, exponents named.
    """

    value: Floats
    low: Floats
    high: Floats
    bias: Floats
    sensor_error: Floats
    tail: Floats
    by_horizon: Floats
    per_sample: Floats
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
    largest_tail: float = LARGEST_TAIL,
    confidence: float = CONFIDENCE,
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
    largest_tail : float
        Part of the value that may lie beyond the horizon.
    confidence : float
        Coverage for the parts by noise and mass; the tail has its own 95 %.

    Returns
    -------
    EnergyInterval

    Raises
    ------
    ParameterError
        If the mass is not positive, its error negative, or the range of the delay does not hold the delay.

    Notes
    -----
    The cost is that of `costs.energy`, but unbiased and complete: noise adds its variance times k^w to the sum,
    and the sum ends at the horizon. The error by noise is carried on to first order, with the answer of the wall
    to each error. Independent parts (noise, mass, tail) are added as squares, each side for itself; the range
    of the delay is added to them as it is: another delay drops samples or takes some in, and moves all indices.

    There is no value where more than `largest_tail` of it may lie beyond the horizon, or its decay is not known;
    where the interval is wider than `LARGEST_HALF_WIDTH`; where noise and quantum are not small beside the final
    displacement. 95 to 100 % of the intervals of simulated Falcon trials hold the cost of the ideal loop (quantum 2
    and 10 um, noise 0 to 1 um, constant delay). With jitter 71 to 78 % hold the cost of the same trial with an
    ideal sensor: its tail depends on delays that have not come yet. What jitter does to the cost, friction and a
    wrong final position are not in the interval.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    if not (mass > 0 and mass_error >= 0):
        raise ParameterError(f"mass {mass:g} +- {mass_error:g}: expected a positive mass and an error >= 0.")
    delays = delay_bounds(delay_samples, delay_range)
    parts = [
        _interval(
            part,
            response.select(some),
            verdicts.select(some),
            error.select(some),
            delay_samples,
            delays,
            mass,
            mass_error,
            largest_tail,
            NormalDist().inv_cdf(0.5 * (1 + confidence)),
        )
        for some, part in batch.portions(CHUNK if batch.position.shape[1] <= LONGEST_ANSWER else 1)
    ]
    names = [name for name in EnergyInterval.__dataclass_fields__ if name != "reason"]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return EnergyInterval(**joined, reason=tuple(text for part in parts for text in part.reason))


def _interval(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    error: ReadingError,
    delay_samples: int,
    delays: tuple[int, int],
    mass: float,
    mass_error: float,
    largest_tail: float,
    z: float,
) -> EnergyInterval:
    """Return the cost of some trials with its interval of ``z`` standard errors, see `energy_interval`."""
    last = np.maximum(batch.rows - 1, 0)[:, None]
    level = LEVEL_SIGMAS * np.nan_to_num(np.take_along_axis(error.deviation, last, axis=1)[:, 0])
    terms = energy_terms(batch, response, verdicts, delay_samples, level)
    if batch.position.shape[1] > LONGEST_ANSWER:
        summed = int(terms.stop.max(initial=1))
        terms, error = _until(terms, summed), _until(error, summed)
    known = terms.usable & np.array([not text for text in error.reason], dtype=np.bool_)
    column = np.arange(terms.index.shape[1])[None, :]
    inside = column < terms.stop[:, None]
    inside &= (terms.index > 0) | (column == terms.first[:, None])
    inside &= known[:, None]
    period, stiffness = batch.sampling_period_s, np.where(known, batch.stiffness, 1.0)
    step = np.where(known, batch.step, 1.0)
    # E_k/E_0 per x^2 and per squared change
    spring, inertia = (stiffness / step) ** 2, stiffness * mass / (step * period) ** 2
    energy = np.where(inside, terms.potential + mass * terms.kinetic, 0.0)
    deviation, change = (np.where(inside, np.nan_to_num(part), 0.0) for part in (error.deviation, error.change))
    change = np.where(terms.index > 0, change, 0.0)  # the first sample has no change
    noise = spring[:, None] * deviation**2 + inertia[:, None] * change**2
    weight = [np.where(inside, terms.index**w, 0.0) for w in WEIGHTS]
    total, bias, kinetic = (
        np.stack([(k * part).sum(axis=1) for k in weight], axis=1) for part in (energy, noise, terms.kinetic)
    )
    tail = extrapolate(
        terms.error,
        energy,
        terms.first,
        terms.stop,
        error_variance=deviation**2,
        energy_bias=noise,
        growth=verdicts.growth_per_s * period,
        sunk=terms.stop < batch.rows,
    )
    value = total - bias + tail.value
    sensor = _sensor_error(terms, error, weight, spring, inertia)
    sensor *= error.excess[:, None]
    # what the squares of the errors add to the variance, white: it counts where little else is left
    sensor = np.sqrt(sensor**2 + 2 * np.stack([((k * noise) ** 2).sum(axis=1) for k in weight], axis=1))
    random = z**2 * (sensor**2 + (mass_error * kinetic) ** 2)
    with np.errstate(invalid="ignore"):
        high = value + np.sqrt(random + (tail.high - tail.value) ** 2)
        low = value - np.sqrt(random + (tail.value - tail.low) ** 2)
        shifts = [_shifted(value, d - delay_samples) - value for d in delays]
        low, high = np.maximum(low + shifts[1], 0.0), high + shifts[0]
        whole = np.isfinite(tail.high) & (tail.high <= largest_tail * value)
        trusted = whole & (high - low <= 2 * LARGEST_HALF_WIDTH * value)
    clear = known & (level <= LARGEST_LEVEL * np.abs(step / stiffness))
    there = clear[:, None] & trusted
    horizon = terms.stop - terms.first
    size = np.abs(step / stiffness)
    reason = tuple(
        cost or unknown or _reason(stands, level_size, move, *rest)
        for cost, unknown, stands, level_size, move, *rest in zip(
            terms.reason,
            error.reason,
            clear,
            level,
            size,
            whole,
            there,
            tail.high,
            value,
            low,
            high,
            horizon,
            strict=True,
        )
    )
    by_horizon, per_sample = _course(energy, weight, terms, horizon)
    value, low, high, bias, sensor, beyond = (
        np.where(there, part, np.nan) for part in (value, low, high, bias, sensor, tail.value)
    )
    return EnergyInterval(
        value=value,
        low=low,
        high=high,
        bias=bias,
        sensor_error=sensor,
        tail=beyond,
        by_horizon=np.where(known[:, None, None], by_horizon, np.nan),
        per_sample=np.where(known[:, None], per_sample, np.nan),
        horizon_samples=horizon,
        reason=reason,
    )


def _until(of: Sampled, columns: int) -> Sampled:
    """Return the same of the first samples alone, as arrays of their own, so that those of all take no more memory."""
    arrays = {name: value[:, :columns].copy() for name, value in vars(of).items() if np.ndim(value) == 2}
    return replace(of, **arrays)


def _sensor_error(
    terms: EnergyTerms, error: ReadingError, weight: list[Floats], spring: Floats, inertia: Floats
) -> Floats:
    """Standard error of the sum by the sensor, shape (n, 3).

    The slope of the sum to each reading, correlated with the wall's answer to an error, is the slope to each error.
    """
    columns = error.weight.shape[1]
    # a length that does not depend on other trials
    length = 1 << (2 * columns - 1).bit_length()
    answer = np.conj(np.fft.rfft(error.weight, length))
    position, speed = spring[:, None] * terms.error, inertia[:, None] * terms.change
    result = []
    for k in weight:
        moving = k * speed
        slope = 2 * (k * position + moving)
        slope[:, :-1] -= 2 * moving[:, 1:]
        each = np.fft.irfft(np.fft.rfft(slope, length) * answer, length)[:, 1:columns]
        # the first reading is the reference of all others
        square = (each**2).sum(axis=1) + each.sum(axis=1) ** 2
        result.append(np.nan_to_num(error.sensor) * np.sqrt(square))
    return np.stack(result, axis=1)


def _shifted(value: Floats, shift: int) -> Floats:
    """Sum for a delay that is larger by a shift: before the device moves, each sample has the energy E_0."""
    s0, s1, s2 = value.T
    steps = np.arange(1, abs(shift) + 1)
    moved = [s0, s1 - shift * s0, s2 - 2 * shift * s1 + shift**2 * s0]
    # samples that a larger delay drops had negative indices, those that a smaller one takes in have indices from 0
    extra = [-np.sum((-steps) ** w) if shift > 0 else np.sum((steps - 1) ** w) for w in WEIGHTS]
    return np.stack([part + more for part, more in zip(moved, extra, strict=True)], axis=1)


def _course(energy: Floats, weight: list[Floats], terms: EnergyTerms, horizon: Integers) -> tuple[Floats, Floats]:
    """Plain sums up to parts of the horizon, shape (n, 3, 4), and the mean summand of its last eighth, (n, 3)."""
    column = np.arange(energy.shape[1])[None, :]
    last = column >= (terms.stop - np.maximum(horizon // 8, 1))[:, None]
    sums, ends = [], []
    for k in weight:
        summands = k * energy
        cumulative = np.concatenate([np.zeros((len(energy), 1)), np.cumsum(summands, axis=1)], axis=1)
        rows = [terms.first + np.ceil(part * horizon).astype(np.int64) for part in HORIZON_PARTS]
        at = np.minimum(np.stack(rows, axis=1), energy.shape[1])
        sums.append(np.take_along_axis(cumulative, at, axis=1))
        ends.append(np.where(last, summands, 0.0).sum(axis=1) / np.maximum(horizon // 8, 1))
    return np.stack(sums, axis=1), np.stack(ends, axis=1)


def _reason(
    stands: bool,
    level: float,
    move: float,
    whole: Booleans,
    there: Booleans,
    tail: Floats,
    value: Floats,
    low: Floats,
    high: Floats,
    horizon: int,
) -> str:
    """Say why exponents of one trial have no value."""
    if not stands:
        return f"noise and quantum leave {level:.3g} open, too much for a final displacement of {move:.3g}"
    parts = []
    lost = [w for w in WEIGHTS if not whole[w]]
    if lost and np.isfinite(tail[lost[-1]]):
        shares = ", ".join(f"w = {w}: {percent(tail[w] / value[w])}" for w in lost)
        parts.append(f"summed over {horizon} samples; beyond them may lie {shares} of the cost: record longer")
    elif lost:
        parts.append(
            f"summed over {horizon} samples; how fast the response decays beyond them is not known, so there is no "
            f"value (w = {', '.join(map(str, lost))}): record longer"
        )
    wide = [w for w in WEIGHTS if whole[w] and not there[w]]
    parts += [f"w = {w}: noise, mass and delay leave {low[w]:.3g} to {high[w]:.3g} open" for w in wide]
    return "; ".join(parts)
