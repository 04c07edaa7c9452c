"""What a response still holds beyond its horizon: its slowest visible motion, carried on.

Beyond the horizon a stable response is its slowest visible mode: its energy decays by a constant factor a
sample. Factor and energy are fitted to the last half of what was summed, with their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers

WINDOW_PART = 2
"""Part of the horizon (its last half) that tells the decay: faster modes have died before it."""

BLOCKS = 6
"""Blocks of the window over which the decay is fitted: their scatter, with 4 degrees of freedom, tells its error."""

STUDENT = 2.78
"""95 % point of Student's t with 4 degrees of freedom."""

FEWEST_ROWS = 4 * BLOCKS
"""Shortest window: four samples a block, for a mean of a rotating motion."""

PASSES = 3
"""Estimates of the decay: each makes the motion of the next rounder, and the third changes nothing that matters."""

LARGEST_NOISE = 0.25
"""Noise of the square across relative to the motion at the end of the window: a block's mean still tells it."""

LARGEST_DOUBT = 0.5
"""Half width of a fitted decay relative to it from which on the mean decay tells more, once the response has
sunk; and that of a mean decay."""

LARGEST_EXPONENT = 700.0
"""Where exp overflows; with as fast a decay nothing is left at the horizon."""

GROWTH_ERROR = 0.2
"""Relative error of a growth rate from the modes of the whole motion: 95 % of noisy Falcon logs stay within it."""

NOTHING_LEFT = 1e-9
"""Part of the sum in the window below which nothing is left to extrapolate: ideal logs that have died away."""


@dataclass(frozen=True, eq=False)
class Tail:
    """Energies beyond the horizon, sum k^w E_k/E_0 for w = 0, 1, 2, shape (n, 3).

    Parameters
    ----------
    value, low, high : float64, shape (n, 3)
        Estimate and its 95 % interval; infinite (``low`` 0) where the decay is not known.
    decay : float64, shape (n,)
        Decay of the amplitude per sample; NaN where it is not known.
    decay_error : float64, shape (n,)
        Half width of its 95 % interval.
    """

    value: Floats
    low: Floats
    high: Floats
    decay: Floats
    decay_error: Floats


def extrapolate(
    error: Floats,
    energy: Floats,
    first: Integers,
    stop: Integers,
    *,
    error_variance: Floats,
    energy_bias: Floats,
    growth: Floats,
    sunk: Booleans,
) -> Tail:
    """Return the energies beyond the horizon.

    Parameters
    ----------
    error : float64, shape (n, N)
        Distance from the final position [m, rad].
    energy : float64, shape (n, N)
        Energy E_k/E_0 of each sample.
    first, stop : int64, shape (n,)
        Row of cost index 0 and first row behind the horizon.
    error_variance : float64, shape (n, N)
        Variance of ``error`` by the sensor [m^2, rad^2].
    energy_bias : float64, shape (n, N)
        What that adds to ``energy`` on average.
    growth : float64, shape (n,)
        Growth rate of the slowest visible mode per sample (negative where it decays), NaN where it is not known.
    sunk : bool, shape (n,)
        Where the response has sunk into the noise before the end of the log.

    Notes
    -----
    The motion is made round, so that its square decays smoothly: u^2 = d^2 + (v + lambda d)^2/omega^2 with v the
    central difference of d; of d = exp(-lambda k) cos(omega k + phi) that is exp(-2 lambda k), and of a mode that
    does not swing 2 d^2. The logarithms of its means over `BLOCKS` blocks give the decay lambda with its standard
    error. The growth rate by the modes of the whole motion takes its place where the two agree within their errors,
    and widens the interval where they do not. The energies are carried on from their sum over the window. Their
    remaining swing goes into the interval as the scatter of the blocks' energies.

    A response that sinks into the noise before the end of the log leaves little behind its horizon. Where the window
    is too short or too noisy for a fit, or holds several modes, the mean decay since the peak of its energy stands for
    the fitted one, known to half of itself. A slower mode that the noise hides is not told. A response that lasts to
    the end of the log has a tail only with a fitted decay.
    """
    horizon = stop - first
    width = np.maximum(horizon // WINDOW_PART, 1)
    # of the whole array, not of these trials: where a row stands decides how its sums are rounded
    longest = max(error.shape[1] // WINDOW_PART, 1)
    # column 0 lies `longest` samples before the last but one of the horizon: the last has no sample after it
    lag = np.arange(longest, 0, -1)[None, :]
    inside = (lag <= width[:, None]) & (lag < horizon[:, None])
    fits = (horizon >= FEWEST_ROWS * WINDOW_PART)[:, None]
    row = np.maximum(stop[:, None] - 1 - lag, 0)
    ahead, here, behind = (_take(error, row + shift) for shift in (1, 0, -1))
    variance = np.where(inside, _take(error_variance, row), 0.0)
    here = np.where(inside, here, 0.0)
    speed = np.where(inside, 0.5 * (ahead - behind), 0.0)
    block = np.where(inside & fits, (width[:, None] - lag) * BLOCKS // width[:, None], -1)
    members = [block == number for number in range(BLOCKS)]
    count = np.stack([part.sum(axis=1) for part in members], axis=1)
    # samples from the middle of each block to the horizon
    distance = np.stack([np.where(part, lag + 1, 0).sum(axis=1) for part in members], axis=1) / np.maximum(count, 1)
    decay, half_width, fitted = _fit(here, speed, variance, growth, members, count, distance)
    clean = np.where(inside, _take(energy, row) - _take(energy_bias, row), 0.0)
    doubt = np.where(inside, _take(energy_bias, row), 0.0)
    means = _block_means(clean, members, count)
    # the swing of the energies about their decay, from the blocks that stand above their noise
    clear = fitted[:, None] & (means > 2 * _block_means(doubt, members, count))
    scatter = np.log(np.where(clear, means, 1.0)) - 2 * np.where(fitted, decay, 0.0)[:, None] * distance
    number = np.maximum(clear.sum(axis=1), 1)
    centre = np.where(clear, scatter, 0.0).sum(axis=1) / number
    spread = np.where(clear, scatter - centre[:, None], 0.0)
    # of one block, not of their mean: what lies beyond the horizon swings as well
    relative = STUDENT * np.sqrt((spread**2).sum(axis=1) / np.maximum(number - 1, 1))
    total, unsure = clean.sum(axis=1), np.sqrt((doubt**2).sum(axis=1))
    # a response that noise hides in part of the window: its mean decay since the peak of its energy
    hidden = ~(fitted & (half_width <= LARGEST_DOUBT * decay)) & sunk & (horizon > 0)
    decay = np.where(hidden, _mean_decay(energy, total, unsure, stop, width), decay)
    half_width = np.where(hidden, LARGEST_DOUBT * decay, half_width)
    known = (fitted | hidden) & (decay > 0)
    ends = []
    for rate, level in (
        (decay, total),
        (decay + half_width, total - 2 * unsure),
        (decay - half_width, total + 2 * unsure),
    ):
        usable = known & (rate > 0)
        safe = np.where(usable, rate, 1.0)[:, None]
        grown = np.where(inside, np.exp(np.minimum(2 * safe * (lag + 1), LARGEST_EXPONENT)), 0.0).sum(axis=1)
        at_horizon = np.maximum(level, 0.0) / _positive(grown)
        ends.append(np.where(usable[:, None], at_horizon[:, None] * _moments(horizon, safe[:, 0]), np.inf))
    value, low, high = ends
    low = np.where(np.isfinite(low), low * np.exp(-relative)[:, None], 0.0)
    high = high * np.exp(relative)[:, None]
    nothing = np.where(inside, _take(energy, row), 0.0).sum(axis=1) <= NOTHING_LEFT * energy.sum(axis=1)
    value, low, high = (np.where(nothing[:, None], 0.0, part) for part in (value, low, high))
    return Tail(value, low, high, np.where(known, decay, np.nan), np.where(known, half_width, np.nan))


def _fit(
    here: Floats,
    speed: Floats,
    variance: Floats,
    growth: Floats,
    members: list[Booleans],
    count: Integers,
    distance: Floats,
) -> tuple[Floats, Floats, Booleans]:
    """Decay per sample by the blocks and the growth rate, half width of its interval, and where there is a fit."""
    decay = np.maximum(-np.nan_to_num(growth), 0.0)
    noise = variance.sum(axis=1) / np.maximum(count.sum(axis=1), 1)
    at_end = np.maximum(_block_means(here**2 - variance, members, count)[:, -1], 0.0)
    for _ in range(PASSES):
        across = speed + decay[:, None] * here
        gain = 0.5 + decay**2
        across_variance = gain[:, None] * variance
        power = np.maximum((here**2 - variance).sum(axis=1), 0.0)
        turning = np.maximum((across**2 - across_variance).sum(axis=1), 0.0)
        # the square across is small, and noise, where the motion does not swing: it may not drown the other
        quiet = np.where(noise > 0, LARGEST_NOISE * at_end / _positive(noise * gain), np.inf)
        scale = np.minimum(np.where(turning > 0, power / _positive(turning), 0.0), quiet)[:, None]
        round_square = here**2 - variance + scale * (across**2 - across_variance)
        slope, slope_error = _line(_block_means(round_square, members, count), distance)
        decay = np.where(np.isfinite(slope), 0.5 * slope, decay)
    half_width = np.nan_to_num(STUDENT * 0.5 * slope_error)
    told = -growth
    apart = np.abs(told - decay)
    # false where the growth rate, or the fit, is not known
    agrees = (apart <= np.maximum(half_width, GROWTH_ERROR * told)) & np.isfinite(slope)
    certain = np.minimum(np.maximum(half_width, apart), GROWTH_ERROR * told)
    half_width = np.where(agrees, certain, np.fmax(half_width, apart))
    decay = np.where(agrees, told, decay)
    return decay, half_width, np.isfinite(slope) & (decay > 0)


def _mean_decay(energy: Floats, total: Floats, unsure: Floats, stop: Integers, width: Integers) -> Floats:
    """Mean decay of the amplitude per sample from the largest energy to the window, 0 where there is none."""
    peak, at = energy.max(axis=1, initial=0.0), np.argmax(energy, axis=1)
    left = np.maximum(total + unsure, 0.0) / width
    elapsed = np.maximum(stop - width // 2 - at, 1)
    falls = (left > 0) & (left < peak)
    result: Floats = np.where(falls, 0.5 * np.log(_positive(peak) / np.where(falls, left, 1.0)) / elapsed, 0.0)
    return result


def _positive(values: Floats) -> Floats:
    """Values, with 1 in place of those that are not positive, to divide by."""
    return np.where(values > 0, values, 1.0)


def _take(values: Floats, row: Integers) -> Floats:
    return np.take_along_axis(values, np.clip(row, 0, values.shape[1] - 1), axis=1)


def _block_means(values: Floats, members: list[Booleans], count: Integers) -> Floats:
    sums = np.stack([np.where(part, values, 0.0).sum(axis=1) for part in members], axis=1)
    result: Floats = sums / np.maximum(count, 1)
    return result


def _line(means: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """Slope of ln(mean) against the distance to the horizon and its standard error, NaN where a mean is <= 0."""
    good = (means > 0).all(axis=1) & (np.ptp(distance, axis=1) > 0)
    y = np.log(np.where(good[:, None], means, 1.0))
    x = distance - distance.mean(axis=1, keepdims=True)
    square = np.where(good, (x * x).sum(axis=1), 1.0)
    slope = (x * y).sum(axis=1) / square
    rest = y - y.mean(axis=1, keepdims=True) - slope[:, None] * x
    error = np.sqrt((rest * rest).sum(axis=1) / (BLOCKS - 2) / square)
    return np.where(good, slope, np.nan), np.where(good, error, np.nan)


def _moments(horizon: Integers, decay: Floats) -> Floats:
    """Sum over j >= 0 of (h + j)^w exp(-2 decay j) for w = 0, 1, 2, shape (n, 3)."""
    ratio, rest = np.exp(-2 * decay), -np.expm1(-2 * decay)
    h = horizon.astype(np.float64)
    plain, once, twice = 1 / rest, ratio / rest**2, ratio * (1 + ratio) / rest**3
    return np.stack([plain, h * plain + once, h * h * plain + 2 * h * once + twice], axis=1)
