"""Measured costs of some trials with their intervals, by family: the columns of the stage that bears its name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from pipeline.measured.cost import costs
from pipeline.measured.cost.cost_intervals import overshoot_interval, settling_interval
from pipeline.measured.cost.energy_intervals import HORIZON_PARTS, energy_interval
from pipeline.measured.cost.reading_error import ReadingError
from pipeline.measured.cost.step_metrics import TOOLS, reconcile
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import TrialBatch
from pipeline.records.criteria import ENERGY, members

Columns = dict[str, Any]

Given = Mapping[str, Any]
"""Values of the whole experiment: ``delay`` [samples], and where needed also ``delay_range`` and ``mass``."""


def joined(*reasons: Iterable[str]) -> list[str | None]:
    """Return the reasons of each trial, joined; None where there is none."""
    return ["; ".join(dict.fromkeys(text for text in texts if text)) or None for texts in zip(*reasons, strict=True)]


def _overshoot(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Given) -> Columns:
    found = costs.overshoot(batch, response, verdicts)
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
    found = costs.settling(batch, response, verdicts, samples)
    interval = settling_interval(batch, response, error, found, samples, delay_range=delays)
    others = reconcile(batch, response, verdicts, samples).settling
    return {
        **found.samples,
        **{f"{name}_low": low for name, low in interval.low.items()},
        **{f"{name}_high": high for name, high in interval.high.items()},
        **{f"settle_{tool}": others[tool].value for tool in TOOLS},
        "reason": joined(found.reason, interval.reason),
    }


def _energy(batch: TrialBatch, response: Response, verdicts: Verdicts, error: ReadingError, given: Given) -> Columns:
    found = energy_interval(
        *(batch, response, verdicts, error, given["delay"], given["mass"]),
        mass_error=given["mass_error"],
        delay_range=tuple(given["delay_range"]),
    )
    half, full = (found.by_horizon[:, :, HORIZON_PARTS.index(part)] for part in (0.5, 1.0))
    ends = {"": found.value, "_low": found.low, "_high": found.high}
    parts = {**ends, "_bias": found.bias, "_tail": found.tail, "_half": half, "_full": full}
    return {
        **{f"{c.column}{part}": values[:, c.weight] for c in members(ENERGY) for part, values in parts.items()},
        "horizon_samples": np.where(found.horizon_samples > 0, found.horizon_samples, np.nan),
        "reason": joined(found.reason),
    }


FAMILIES: dict[str, Callable[[TrialBatch, Response, Verdicts, ReadingError, Given], Columns]] = {
    "settling": _settling,
    "overshoot": _overshoot,
    "energy": _energy,
}
"""What computes the costs of a family: columns of `pipeline.records.tables` by name, of shape (n,), from trials, their
responses, verdicts and reading errors, and what is given of the whole experiment."""
