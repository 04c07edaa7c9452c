"""Settling time, overshoot and rise time of recorded step responses, each with what its readings leave open.

Cost index 0 is sample k0 + d: the response starts at the command edge k0, and its first d samples pass before the
command reaches the device. Each cost asks for no more than it needs; its interval holds the costs of the readings as
far as their errors may have moved them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.signal.response import SETTLED_SAMPLES, Response, reach
from pipeline.measured.signal.verdict import Verdicts
from pipeline.measured.student import CONFIDENCE, NORMAL_95
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.criteria import OVERSHOOT, RISE_LEVELS, SETTLING_BANDS


@dataclass(frozen=True, eq=False)
class Cost:
    """A cost of each trial with its 95 % interval; NaN, with a reason, where there is none.

    ``low`` and ``high`` are NaN, too, where no error of the readings was given or told.
    """

    value: Floats
    low: Floats
    high: Floats
    reason: tuple[str, ...]

    def columns(self, name: str) -> dict[str, Floats]:
        """Return the columns that store the cost under a name."""
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


def joined(*reasons: Iterable[str]) -> tuple[str, ...]:
    """Return the reasons of each trial, joined; empty where there is none."""
    return tuple("; ".join(dict.fromkeys(text for text in texts if text)) for texts in zip(*reasons, strict=True))


def cost_start(
    batch: TrialBatch, response: Response, verdicts: Verdicts, delay_samples: int
) -> tuple[Integers, Booleans, tuple[str, ...]]:
    """Return the row of cost index 0, which trials can have costs, and why the others have none.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.

    Raises
    ------
    ParameterError
        If the delay is negative.

    Source: Hulin 2017, sec. 6.1.4 (first d samples dropped).
    """
    if delay_samples < 0:
        raise ParameterError(f"delay of {delay_samples} samples: expected an integer >= 0.")
    first = np.maximum(response.edge_row, 0) + delay_samples
    reasons = []
    for i, (start, rows, k) in enumerate(zip(first, batch.rows, batch.stiffness, strict=True)):
        if verdicts.verdict[i] == "unstable":
            reasons.append("unstable: no cost")
        elif response.edge_row[i] < 0:
            reasons.append(f"no start of the response: {response.edge_reason[i]}")
        elif k <= 0:
            reasons.append(f"no final position: x_0 + F_0/K needs K > 0, found K = {k:g}")
        elif response.position_final_expected[i] == response.position_start[i]:
            reasons.append(f"no final displacement: F_0/K = {batch.step[i] / k:.3g} is below the rounding of positions")
        elif start >= rows:
            reasons.append(f"the log of {rows} rows ends before the command takes effect in row {start}")
        else:
            reasons.append("")
    return first.astype(np.int64), np.array([not text for text in reasons], dtype=np.bool_), tuple(reasons)


def delay_bounds(delay_samples: int, delay_range: tuple[int, int] | None) -> tuple[int, int]:
    """Return smallest and largest integer delay factor, the delay itself where no range is given.

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


@dataclass(frozen=True, eq=False)
class _Readings:
    """Readings from cost index 0 on, shape (n, N), and per trial whether it can have a cost and an interval (n,)."""

    first: Integers
    counted: Booleans
    offset: Floats
    deviation: Floats
    travel: Floats
    usable: Booleans
    known: Booleans
    reason: tuple[str, ...]


def _readings(
    batch: TrialBatch, response: Response, verdicts: Verdicts, delay_samples: int, error: ReadingError | None
) -> _Readings:
    first, usable, why = cost_start(batch, response, verdicts, delay_samples)
    counted = batch.valid & (np.arange(batch.position.shape[1])[None, :] >= first[:, None]) & usable[:, None]
    final = np.where(usable, response.position_final_expected, 0.0)
    untold = ("",) * len(batch) if error is None else error.reason
    known = usable & np.array([not text for text in untold], dtype=np.bool_) & (error is not None)
    deviation = np.zeros_like(batch.position) if error is None else np.nan_to_num(error.deviation)
    return _Readings(
        first=first,
        counted=counted,
        offset=np.where(counted, batch.position - final[:, None], 0.0),
        deviation=deviation,
        travel=np.where(usable, final - response.position_start, 1.0),
        usable=usable,
        known=known,
        reason=tuple(a or b for a, b in zip(why, untold, strict=True)),
    )


def settling(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    delay_samples: int,
    error: ReadingError | None = None,
    *,
    delay_range: tuple[int, int] | None = None,
) -> dict[str, Cost]:
    """Return the discrete settling time by criterion: the smallest k from which on all samples are inside the band.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.
    error : ReadingError, optional
        Of the same trials; without it there is no interval.
    delay_range : tuple of int, optional
        Smallest and largest integer delay factor that the experiment leaves open.

    Raises
    ------
    ParameterError
        If the delay is negative, or not in its range.

    Notes
    -----
    The band lies about x_0 + F_0/K, not about the last sample; it is not judged where it is narrower than what quantum
    and noise alone cause. The ends of the interval are the settling times for a band wider and narrower by the error of
    a reading: the last sample outside decides, and it is one reading. A larger delay moves cost index 0, and so
    shortens the settling time. There is no upper end where the motion can still leave the band after the log (`reach`).

    Source: Hulin 2017, secs. 5.1.1 and 6.1.4 (discrete settling time, first d samples dropped).
    """
    delays = delay_bounds(delay_samples, delay_range)
    of = _readings(batch, response, verdicts, delay_samples, error)
    margin = NORMAL_95 * of.deviation
    late = np.take_along_axis(of.deviation, np.maximum(batch.rows - 1, 0)[:, None], axis=1)[:, 0]
    growth = verdicts.growth_per_s * batch.sampling_period_s
    final = np.where(of.usable, response.position_final_expected, 0.0)
    found = {}
    for name, band in SETTLING_BANDS.items():
        width = band * np.abs(of.travel)
        wider, entry, narrower = (
            _last(of.counted & ~(np.abs(of.offset) <= width[:, None] + shift), of.first)
            for shift in (margin, 0.0, -margin)
        )
        resolved, settled = width >= response.floor, batch.rows - entry >= SETTLED_SAMPLES
        good = of.usable & resolved & settled
        far, open_ = reach(batch, final, of.first, narrower, growth, late)
        stays = (far <= width + NORMAL_95 * open_) & (batch.rows - narrower >= SETTLED_SAMPLES)
        reason = [
            _why_unsettled(why, error is not None, *each)
            for why, *each in zip(of.reason, of.usable, resolved, settled, stays, width, response.floor, strict=True)
        ]
        told = good & of.known
        found[name] = Cost(
            np.where(good, entry - of.first, np.nan),
            np.where(told, np.maximum(wider - of.first - (delays[1] - delay_samples), 0), np.nan),
            np.where(told & stays, narrower - of.first + (delay_samples - delays[0]), np.nan),
            tuple(f"{name}: {text}" if text and not why else text for text, why in zip(reason, of.reason, strict=True)),
        )
    return found


def _why_unsettled(
    why: str, asked: bool, usable: bool, resolved: bool, settled: bool, stays: bool, *sizes: float
) -> str:
    """Return why one trial has no settling time, or no upper end of it; ``sizes`` are its band and sensor floor."""
    if why and not usable:
        return why
    if not resolved:
        return "band of {:.3g} is below the sensor floor {:.3g}".format(*sizes)
    if not settled:
        return "not settled at the end of the log"
    return why or ("" if stays or not asked else "it may leave the band again after the end of the log")


def _last(outside: Booleans, first: Integers) -> Integers:
    """Return the row behind the last one outside, the first row where none is, shape (n,)."""
    return np.where(outside.any(axis=1), outside.shape[1] - np.argmax(outside[:, ::-1], axis=1), first)


def overshoot_floor(batch: TrialBatch, response: Response) -> Floats:
    """Return the overshoot that quantum, noise and a motion before the step can feign, shape (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = (response.floor + response.baseline_motion) / np.abs(batch.step / batch.stiffness)
    return np.where(batch.stiffness > 0, np.nan_to_num(floor, posinf=0.0), 0.0)


def overshoot(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError | None = None) -> Cost:
    """Return the overshoot over the whole response, max(0, max (x - x_inf)/(x_inf - x_0)).

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    error : ReadingError, optional
        Of the same trials; without it there is no interval.

    Notes
    -----
    Neither delay nor mass is needed. The largest of many noisy readings lies above the largest true position. Its own
    error bounds the truth from above; from below the largest error of all readings that can have become the largest
    does: those within twice that error of it. What comes after the end of the log is bounded by `reach`. An interval
    that begins at 0 says that there may be no overshoot.

    Source: Hulin 2017, sec. 5.1.1; footnote 4 of 5.2.2 for the tolerance 1e-12 of "no overshoot".
    """
    of = _readings(batch, response, verdicts, 0, error)
    relative = np.where(of.counted, of.offset / of.travel[:, None], -np.inf)
    peak = np.argmax(relative, axis=1)[:, None]
    largest = np.take_along_axis(relative, peak, axis=1)[:, 0]
    size = np.abs(of.travel)
    spread = np.take_along_axis(of.deviation, peak, axis=1)[:, 0] / size
    tail = 0.5 * (1 - CONFIDENCE)
    everywhere = _quantile(tail / np.maximum(of.counted.sum(axis=1), 1))
    rivals = np.maximum((relative >= (largest - 2 * everywhere * spread)[:, None]).sum(axis=1), 1)
    late = np.take_along_axis(of.deviation, np.maximum(batch.rows - 1, 0)[:, None], axis=1)[:, 0]
    final = np.where(of.usable, response.position_final_expected, 0.0)
    last = np.maximum(batch.rows - SETTLED_SAMPLES, of.first)
    far, open_ = reach(batch, final, of.first, last, verdicts.growth_per_s * batch.sampling_period_s, late)
    beyond = (far - everywhere * open_) / size
    ends = (
        np.maximum(largest - _quantile(tail / rivals) * spread, 0.0),
        np.maximum(np.maximum(largest, beyond) + NORMAL_95 * spread, OVERSHOOT.none),
    )
    value = np.where(of.usable, np.maximum(largest, 0.0), np.nan)
    low, high = (np.where(of.known, end, np.nan) for end in ends)
    return Cost(value, low, high, of.reason)


def _quantile(chance: Floats) -> Floats:
    """Standard normal deviate that is exceeded with a chance, of the shape of the chances."""
    values, where = np.unique(chance, return_inverse=True)
    table = np.array([-NormalDist().inv_cdf(float(value)) for value in values])
    result: Floats = table[where].reshape(chance.shape)
    return result


def rise_time(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError | None = None) -> Cost:
    """Return the time from 10 to 90 % of the final displacement, between two readings on a straight line [samples]."""
    of = _readings(batch, response, verdicts, 0, error)
    share = 1 + of.offset / of.travel[:, None]
    margin = NORMAL_95 * of.deviation / np.abs(of.travel)[:, None]
    # rows of the readings, and of the earliest and the latest that their errors leave open
    (begin, soonest_begin, latest_begin), (end, soonest_end, latest_end) = (
        [_first_reached(share + shift, of.counted, level) for shift in (0.0, margin, -margin)] for level in RISE_LEVELS
    )
    resolved = RISE_LEVELS[0] * np.abs(of.travel) >= response.floor
    value = np.where(of.usable & resolved, end - begin, np.nan)
    known = of.known & np.isfinite(value)
    low = np.fmax(value - np.hypot(end - soonest_end, latest_begin - begin), 0.0)
    high = value + np.hypot(latest_end - end, begin - soonest_begin)
    short = of.usable & ~resolved, of.usable & resolved & np.isnan(value), known & np.isnan(high)
    texts = (
        f"rise_time: {RISE_LEVELS[0]:.0%} of the final displacement lies below the sensor floor",
        f"rise_time: {RISE_LEVELS[1]:.0%} of the final displacement is not reached by the end of the log",
        f"rise_time: with the error of the sensor it may not reach {RISE_LEVELS[1]:.0%} by the end of the log",
    )
    reason = joined(of.reason, *(np.where(*pair, "").tolist() for pair in zip(short, texts, strict=True)))
    return Cost(value, np.where(known, low, np.nan), np.where(known, high, np.nan), reason)


def _first_reached(share: Floats, counted: Booleans, level: float) -> Floats:
    """Row at which a share is first reached, between two readings on a straight line, shape (n,); NaN for never."""
    reached = counted & (share >= level)
    row = np.argmax(reached, axis=1)
    trial = np.arange(len(row))
    before, after = share[trial, np.maximum(row - 1, 0)], share[trial, row]
    part = np.divide(level - before, after - before, out=np.ones(len(row)), where=after > before)
    return np.where(reached[trial, row], row - 1 + np.clip(part, 0.0, 1.0), np.nan)


Columns = dict[str, Any]

Measure = Callable[[TrialBatch, Response, Verdicts, ReadingError, Mapping[str, Any]], Columns]
"""Columns of `pipeline.records.tables` by name, of shape (n,), from trials, their responses, verdicts and reading
errors, and what the experiment gives: ``delay`` [samples], and where needed also ``delay_range`` and ``mass``."""


def _settling(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Any) -> Columns:
    found = settling(batch, response, verdicts, given["delay"], error, delay_range=tuple(given["delay_range"]))
    columns: Columns = {"reason": joined(*(cost.reason for cost in found.values()))}
    return columns | {part: values for name, cost in found.items() for part, values in cost.columns(name).items()}


def _overshoot(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, _: Any) -> Columns:
    found = overshoot(batch, response, verdicts, error)
    floor = overshoot_floor(batch, response)
    return {**found.columns("overshoot"), "overshoot_floor": floor, "reason": found.reason}


def _rise(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, _: Any) -> Columns:
    found = rise_time(batch, response, verdicts, error)
    return {**found.columns("rise_time"), "reason": found.reason}


BY_FAMILY: dict[str, Measure] = {"settling": _settling, "overshoot": _overshoot, "rise": _rise}
"""What computes the costs of a family, but for the energies, which need the mass."""
