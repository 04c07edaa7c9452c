"""The delay of an experiment as the stages after it take it."""

from __future__ import annotations

from math import ceil, floor

from pipeline.measured.estimates import delay_estimate
from pipeline.measured.stage_given import Experiment
from pipeline.measured.stage_groups import Given
from pipeline.records.findings import Estimate


def with_delay(of: Experiment) -> Given:
    """Return the integer delay factor of an experiment, or what its stages say where there is none."""
    value = delay_estimate(of).value
    return {"missing": "needs the delay, which is not known"} if value is None else {"delay": int(value)}


def delay_range(estimate: Estimate) -> tuple[int, int]:
    """Return the smallest and largest integer delay factor of an interval, whose upper end is one sample more (6.3)."""
    value = int(estimate.value or 0)
    low = value if estimate.low is None else min(floor(estimate.low), value)
    high = value if estimate.high is None else max(ceil(estimate.high) - 1, value)
    return low, high
