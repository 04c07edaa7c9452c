"""Intervals of settling time and overshoot: what noise, quantum and the delay leave open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.cost.settling_overshoot import SETTLED_SAMPLES, Overshoot, Settling
from pipeline.measured.intervals import CONFIDENCE, NORMAL_95
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.criteria import SETTLING_BANDS

NO_OVERSHOOT = 1e-12
"""Overshoot that counts as none (footnote 4 of 5.2.2), and so the smallest upper end."""

SWING = 1.25
"""Time inside a band relative to the longest time on one side of the final position, from which on no slower swing
passes it: of a motion that passes once a quarter of a swing may be all that is seen."""

CREEP = 0.8
"""Ratio of successive changes of a creep up to which its end is told: a passage of the band has 1."""

CREEP_STAY = 6
"""Part of the time up to a band that a creep must stay in it: less is left in it by an overshoot that passes."""

LAST_PART = 5
"""Part of the response (a fifth) at its end that bounds what comes after: it holds a swing of most responses."""


@dataclass(frozen=True, eq=False)
class SettlingInterval:
    """Interval of the discrete settling time by criterion, each of shape (n,) [samples].

    ``low`` and ``high`` are NaN where the settling time itself has a reason; ``high`` alone is NaN, with a
    reason, where the response may not have settled by the end of the log.
    """

    low: Mapping[str, Floats]
    high: Mapping[str, Floats]
    reason: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class OvershootInterval:
    """Interval of the overshoot, shape (n,) [1]; NaN where there is a reason.

    ``bias`` is the most by which the largest of the readings, being the largest, is expected to exceed the truth.
    """

    low: Floats
    high: Floats
    bias: Floats
    reason: tuple[str, ...]


def delay_bounds(delay_samples: int, delay_range: tuple[int, int] | None) -> tuple[int, int]:
    """Return smallest and largest integer delay factor, checked.

    Parameters
    ----------
    delay_samples : int
        Delay factor that the cost was computed with.
    delay_range : tuple of int, optional
        Smallest and largest delay factor; none where the delay is taken as exact.

    Raises
    ------
    ParameterError
        If the range does not hold the delay, or is negative.
    """
    low, high = (delay_samples, delay_samples) if delay_range is None else delay_range
    if not 0 <= low <= delay_samples <= high:
        raise ParameterError(
            f"range of the delay {low} to {high} samples: expected 0 <= low <= {delay_samples} <= high, "
            "the delay that the cost was computed with."
        )
    return low, high


def settling_interval(
    batch: TrialBatch,
    response: Response,
    error: ReadingError,
    found: Settling,
    delay_samples: int,
    *,
    delay_range: tuple[int, int] | None = None,
) -> SettlingInterval:
    """Return the interval of the discrete settling time.

    Parameters
    ----------
    batch : TrialBatch
    response, error, found : Response, ReadingError, Settling
        Of the same trials; ``found`` by `settling_overshoot.settling` with the same delay.
    delay_samples : int
        Integer delay factor d that ``found`` was computed with.
    delay_range : tuple of int, optional
        Smallest and largest integer delay factor that the experiment leaves open.

    Returns
    -------
    SettlingInterval

    Raises
    ------
    ParameterError
        If the range of the delay does not hold the delay.

    Notes
    -----
    The ends are the settling times for a band wider and narrower by what noise and quantum leave open of one
    reading: the last sample outside decides, and it is one reading. A larger delay moves cost index 0, and so
    shortens the settling time. The settling time jumps where the response just touches the band: there the
    interval spans half a period of the response or more. There is no upper end unless the last swing lies inside the
    band, or a creep that ends there: the response may merely pass it.
    """
    low_delay, high_delay = delay_bounds(delay_samples, delay_range)
    first = np.maximum(response.edge_row, 0) + delay_samples
    column = np.arange(batch.position.shape[1])[None, :]
    counted = batch.valid & (column >= first[:, None])
    known = np.array([not text for text in error.reason], dtype=np.bool_)
    offset = np.where(counted, batch.position - response.position_final_expected[:, None], 0.0)
    distance = np.abs(offset)
    margin = NORMAL_95 * np.nan_to_num(error.deviation)
    swing = _longest_swing(offset, 2 * margin, first)
    low: dict[str, Floats] = {}
    high: dict[str, Floats] = {}
    missing: list[list[str]] = [[] for _ in range(len(batch))]
    for name, band in SETTLING_BANDS.items():
        width = band * np.abs(batch.step / np.where(batch.stiffness != 0, batch.stiffness, np.nan))
        told = np.isfinite(found.samples[name])
        ends = []
        for sign in (1, -1):
            outside = counted & ~(distance <= width[:, None] + sign * margin)
            ends.append(np.where(outside.any(axis=1), column.size - np.argmax(outside[:, ::-1], axis=1), first))
        settled = batch.rows - ends[1] >= SETTLED_SAMPLES
        settled &= _stays(offset, margin, first, ends[1], batch.rows, swing, width)
        low[name] = np.where(told & known, np.maximum(ends[0] - first - (high_delay - delay_samples), 0), np.nan)
        high[name] = np.where(told & known & settled, ends[1] - first + (delay_samples - low_delay), np.nan)
        for i in np.flatnonzero(told & known & ~settled):
            missing[i].append(
                f"{name}: it may not have settled by the end of the log, no full swing is inside the band"
            )
    reason = tuple(
        "; ".join(part for part in (cost, unknown, *parts) if part)
        for cost, unknown, parts in zip(found.reason, error.reason, missing, strict=True)
    )
    return SettlingInterval(low, high, reason)


def _longest_swing(offset: Floats, margin: Floats, first: Integers) -> Floats:
    """Return the longest time on one side of the final position [samples], shape (n,); inf where it is not passed."""
    column = np.arange(offset.shape[1])[None, :]
    side = np.where(np.abs(offset) > margin, np.sign(offset), 0.0)
    # the side of the last reading that surely lies on one: four standard errors away
    since = np.maximum.accumulate(np.where(side != 0, column, 0), axis=1)
    side = np.take_along_axis(side, since, axis=1)
    passes = side[:, 1:] * side[:, :-1] < 0
    passed = np.maximum.accumulate(np.where(passes, column[:, 1:], -1), axis=1)
    before = np.concatenate([np.full((len(offset), 1), -1), passed[:, :-1]], axis=1)
    gap = column[:, 1:] - np.where(before >= 0, before, first[:, None])
    longest = np.max(np.where(passes, gap, 0.0), axis=1, initial=0.0)
    result: Floats = np.where(longest > 0, longest, np.inf)
    return result


def _stays(
    offset: Floats, margin: Floats, first: Integers, entry: Integers, rows: Integers, swing: Floats, width: Floats
) -> Booleans:
    """Whether a response that is in a band from a row on will stay there, shape (n,).

    The stay is longer than its swings (`SWING`), and the motion does not grow in it; or it creeps to a place inside.
    """
    column = np.arange(offset.shape[1])[None, :]
    stay = rows - entry
    noise = np.take_along_axis(margin, np.maximum(rows - 1, 0)[:, None], axis=1)[:, 0]
    part = (column - entry[:, None]) * 6 // np.maximum(stay, 1)[:, None]
    part = np.where((part >= 0) & (column < rows[:, None]), part, -1)
    early, late = (
        np.max(np.where(half, np.abs(offset), 0.0), axis=1, initial=0.0)
        for half in ((part >= 0) & (part < 3), part >= 3)
    )
    swings = (stay >= SWING * swing) & (late <= early + 2 * noise)
    thirds = [part // 2 == number for number in range(3)]
    count = np.maximum(np.stack([third.sum(axis=1) for third in thirds]), 1)
    mean = np.stack([np.where(third, offset, 0.0).sum(axis=1) for third in thirds]) / count
    before, after = np.diff(mean, axis=0)
    known = NORMAL_95 * noise / np.sqrt(count.min(axis=0))
    slows = np.abs(after) <= np.maximum(CREEP * np.abs(before), 2 * known)
    ratio = np.divide(after, before, out=np.zeros(len(offset)), where=np.abs(before) > known)
    ratio = np.clip(ratio, 0.0, CREEP)
    end = mean[2] + after * ratio / (1 - ratio)
    creeps = (CREEP_STAY * stay >= entry - first) & slows & (np.abs(end) <= width)
    result: Booleans = swings | creeps
    return result


def overshoot_interval(
    batch: TrialBatch,
    response: Response,
    error: ReadingError,
    found: Overshoot,
) -> OvershootInterval:
    """Return the interval of the overshoot.

    Parameters
    ----------
    batch : TrialBatch
    response, error, found : Response, ReadingError, Overshoot
        Of the same trials; ``found`` by `settling_overshoot.overshoot`.

    Returns
    -------
    OvershootInterval

    Notes
    -----
    The largest of many noisy readings lies above the largest true position. Its own error bounds the truth from
    above: truth <= largest reading - its error. From below the truth is bounded by the largest reading less the
    largest error of all readings that can have become the largest: those within twice that error of it. What
    comes after the end of the log is bounded by the distance from the final position in its last fifth, since a
    stable response decays. An interval that begins at 0 says that there may be no overshoot.
    """
    column = np.arange(batch.position.shape[1])[None, :]
    counted = batch.valid & (column >= np.maximum(response.edge_row, 0)[:, None])
    known = np.isfinite(found.overshoot) & np.array([not text for text in error.reason], dtype=np.bool_)
    travel = np.where(known, response.position_final_expected - response.position_start, 1.0)
    relative = (batch.position - np.where(known, response.position_final_expected, 0.0)[:, None]) / travel[:, None]
    relative = np.where(counted, relative, -np.inf)
    peak = np.argmax(relative, axis=1)[:, None]
    largest = np.take_along_axis(relative, peak, axis=1)[:, 0]
    spread = np.take_along_axis(np.nan_to_num(error.deviation), peak, axis=1)[:, 0] / np.abs(travel)
    tail = 0.5 * (1 - CONFIDENCE)
    everywhere = _quantile(tail / np.maximum(counted.sum(axis=1), 1))
    rivals = np.maximum((relative >= (largest - 2 * everywhere * spread)[:, None]).sum(axis=1), 1)
    low = np.maximum(largest - _quantile(tail / rivals) * spread, 0.0)
    late = counted & (column >= (batch.rows - (batch.rows - response.edge_row) // LAST_PART)[:, None])
    # the largest distance in the last part is the largest of many readings, too
    beyond = np.max(np.where(late, np.abs(relative), 0.0), axis=1, initial=0.0) - everywhere * spread
    one_reading = NORMAL_95 * spread
    high = np.maximum(np.maximum(largest, beyond) + one_reading, NO_OVERSHOOT)
    # median of the largest of as many independent errors
    bias = np.maximum(_quantile(1 - 0.5 ** (1 / rivals)), 0.0) * spread
    reason = tuple(cost or unknown for cost, unknown in zip(found.reason, error.reason, strict=True))
    low, high, bias = (np.where(known, value, np.nan) for value in (low, high, bias))
    return OvershootInterval(low, high, bias, reason)


def _quantile(chance: Floats) -> Floats:
    """Standard normal deviate that is exceeded with a chance, of the shape of the chances."""
    values, where = np.unique(chance, return_inverse=True)
    table = np.array([-NormalDist().inv_cdf(float(value)) for value in values])
    result: Floats = table[where].reshape(chance.shape)
    return result
