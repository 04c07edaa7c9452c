"""Measured costs of some trials with their intervals, by family: the columns of the stage that bears its name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from pipeline.measured.cost import settling_overshoot
from pipeline.measured.cost.cost_intervals import overshoot_interval, settling_interval
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.cost.step_metrics import TOOLS, reconcile
from pipeline.measured.intervals import NORMAL_95
from pipeline.measured.signal.horizon import cost_start
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Booleans, Floats, TrialBatch
from pipeline.records.criteria import RISE_LEVELS

Columns = dict[str, Any]

Given = Mapping[str, Any]
"""Values of the whole experiment: ``delay`` [samples], and where needed also ``delay_range`` and ``mass``."""


def joined(*reasons: Iterable[str]) -> list[str | None]:
    """Return the reasons of each trial, joined; None where there is none."""
    return ["; ".join(dict.fromkeys(text for text in texts if text)) or None for texts in zip(*reasons, strict=True)]


def _overshoot(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Given) -> Columns:
    found = settling_overshoot.overshoot(batch, response, verdicts)
    interval = overshoot_interval(batch, response, error, found)
    return {
        "overshoot": found.overshoot,
        "overshoot_floor": found.floor,
        "overshoot_low": interval.low,
        "overshoot_high": interval.high,
        "overshoot_last_sample": reconcile(batch, response, verdicts, 0).overshoot["matlab_final_value"].value,
        "reason": joined(found.reason, interval.reason),
    }


def _settling(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Given) -> Columns:
    samples, delays = given["delay"], tuple(given["delay_range"])
    found = settling_overshoot.settling(batch, response, verdicts, samples)
    interval = settling_interval(batch, response, error, found, samples, delay_range=delays)
    others = reconcile(batch, response, verdicts, samples).settling
    return {
        **found.samples,
        **{f"{name}_low": low for name, low in interval.low.items()},
        **{f"{name}_high": high for name, high in interval.high.items()},
        **{f"settle_{tool}": others[tool].value for tool in TOOLS},
        "reason": joined(found.reason, interval.reason),
    }


def _rise(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Given) -> Columns:
    first, usable, why = cost_start(batch, response, verdicts, 0)
    travel = np.where(usable, response.position_final_expected - response.position_start, 1.0)[:, None]
    share = (batch.position - response.position_start[:, None]) / travel
    margin = NORMAL_95 * np.nan_to_num(error.deviation) / np.abs(travel)
    counted = batch.valid & (np.arange(share.shape[1])[None, :] >= first[:, None])
    # rows of the readings, and of the earliest and the latest that their errors leave open
    (begin, soonest_begin, latest_begin), (end, soonest_end, latest_end) = (
        [_first_reached(share + shift, counted, level) for shift in (0.0, margin, -margin)] for level in RISE_LEVELS
    )
    resolved = RISE_LEVELS[0] * np.abs(travel[:, 0]) >= response.floor
    cost = np.where(usable & resolved, end - begin, np.nan)
    known = np.isfinite(cost) & np.array([not text for text in error.reason], dtype=np.bool_)
    low = np.fmax(cost - np.hypot(end - soonest_end, latest_begin - begin), 0.0)
    high = cost + np.hypot(latest_end - end, begin - soonest_begin)
    short = usable & ~resolved, usable & resolved & np.isnan(cost), known & np.isnan(high)
    texts = (
        f"rise_time: {RISE_LEVELS[0]:.0%} of the final displacement lies below the sensor floor",
        f"rise_time: {RISE_LEVELS[1]:.0%} of the final displacement is not reached by the end of the log",
        f"rise_time: with the error of the sensor it may not reach {RISE_LEVELS[1]:.0%} by the end of the log",
    )
    return {
        "rise_time": cost,
        "rise_time_low": np.where(known, low, np.nan),
        "rise_time_high": np.where(known, high, np.nan),
        "reason": joined(why, error.reason, *(np.where(*pair, "").tolist() for pair in zip(short, texts, strict=True))),
    }


def _first_reached(share: Floats, counted: Booleans, level: float) -> Floats:
    """Row at which a share is first reached, between two readings on a straight line, shape (n,); NaN for never."""
    reached = counted & (share >= level)
    row = np.argmax(reached, axis=1)
    trial = np.arange(len(row))
    before, after = share[trial, np.maximum(row - 1, 0)], share[trial, row]
    part = np.divide(level - before, after - before, out=np.ones(len(row)), where=after > before)
    return np.where(reached[trial, row], row - 1 + np.clip(part, 0.0, 1.0), np.nan)


Measure = Callable[[TrialBatch, Response, Verdicts, ReadingError, Given], Columns]

FAMILIES: dict[str, Measure] = {
    "settling": _settling,
    "overshoot": _overshoot,
    "rise": _rise,
}
"""What computes the costs of a family, but for the energies, which need the mass: columns of `pipeline.records.tables`
by name, of shape (n,), from trials, their responses, verdicts and reading errors, and what the experiment gives."""
