"""The delay of an experiment, and how later stages take it."""

from __future__ import annotations

from math import ceil, floor

import numpy as np

from pipeline.base.wording import of_most
from pipeline.measured.device.onset import SURE_ERROR
from pipeline.measured.experiment.stored import Stored, combined
from pipeline.measured.intervals import CONFIDENCE
from pipeline.measured.signal.response import NO_ROW
from pipeline.measured.stages.stage_given import Experiment
from pipeline.measured.stages.stage_groups import Given
from pipeline.records.batch import Integers
from pipeline.records.findings import Estimate

LARGEST_OFFSET = 0.05
"""Distance [samples] from a whole number beyond which a delay is none, however wide its interval: 2 % of the limit."""

LEAST_OFFSET = 0.01
"""Distance [samples] from a whole number up to which a delay is one: a fit is not known to be less biased."""


def whole_delay(estimate: Estimate, at: float | None = None) -> float:
    """Return the value of a delay, or the whole number of samples next to it where its interval holds that.

    Another number inside the interval may be given in its place.

    >>> whole_delay(Estimate(value=3.97, low=3.93, high=4.01, unit="samples", method="model"))
    4.0
    >>> whole_delay(Estimate(value=2.37, low=2.36, high=2.38, unit="samples", method="model"))
    2.37
    """
    middle = estimate.value or 0.0
    value = middle if at is None else at
    reach = max(middle - (estimate.low or middle), (estimate.high or middle) - middle)
    near = abs(value - round(value)) <= min(max(reach, LEAST_OFFSET), LARGEST_OFFSET)
    return float(round(value)) if near else value


def estimate_delay(delay_samples: Integers, *, sampling_period_s: float | None = None) -> Estimate:
    """Return the integer delay factor of an experiment: the median of its trials.

    Parameters
    ----------
    delay_samples : int64, shape (n,)
        Integer factor of each trial; negative where there is none.
    sampling_period_s : float, optional
        T [s]; with it ``by_method`` also holds the mean delay in seconds.

    Notes
    -----
    The interval is the range that holds 95 % of the trials (jitter), its upper end one sample more by (6.3):
    a factor d stands for delays d T <= t_d < (d + 1) T. An even number of trials takes the lower median, so
    that the value is a factor that occurred.

    Source: Hulin 2017, eqs. 6.2 and 6.3.
    """
    method = "first position change"
    known = np.sort(delay_samples[delay_samples >= 0])
    if not len(known):
        return Estimate(
            value=None,
            unit="samples",
            method=method,
            reason=f"no trial of {len(delay_samples)} shows a command edge and a position change after it",
        )
    cut = 0.5 * (1 - CONFIDENCE)
    low, median, high = (float(known[int(np.floor(q * (len(known) - 1)))]) for q in (cut, 0.5, 1 - cut))
    by_method = {}
    if sampling_period_s is not None:
        # (6.3) leaves the position inside the period open: its middle is the mean of all that it may be
        mean = (float(known.mean()) + 0.5) * sampling_period_s
        by_method["mean_delay"] = Estimate(
            value=mean,
            low=low * sampling_period_s,
            high=(high + 1) * sampling_period_s,
            unit="s",
            method="mean of the first position change, middle of its period",
            trials=len(known),
        )
    return Estimate(
        value=median,
        low=low,
        high=high + 1,
        unit="samples",
        method=method,
        trials=len(known),
        by_method=by_method,
    )


def delay_estimate(of: Stored) -> Estimate:
    """Return the integer delay factor of an experiment; ``by_method`` holds what is not rounded.

    Cost indices are counted from the command edge plus this factor (6.1.4), so that it is an integer; its interval is
    the range that holds 95 % of the trials. It needs no fitted model, and a scene without one has this estimate; see
    `estimates.with_model_delay`.
    """
    found = np.nan_to_num(of.column("delay", "delay_samples"), nan=NO_ROW).astype(np.int64)
    plain = np.nan_to_num(of.column("delay", "first_change_samples"), nan=NO_ROW).astype(np.int64)
    best = estimate_delay(found, sampling_period_s=of.sampling_period_s)
    if best.value is None:
        best = best.model_copy(update={"reason": f"{best.reason}{of_most(of.texts('delay', 'reason'))}"})
    onset = combined(
        of, ("delay", "onset_samples", "onset_error"), "samples", "onset of motion, by the motion that the quantum hid"
    )
    known = (onset.value, onset.low, onset.high)
    if best.low is not None and (None in known or (onset.high or 0.0) - (onset.low or 0.0) > 2 * SURE_ERROR):
        # what a sensor, or friction, hides at first makes the change that is seen late
        earliest = max(floor(onset.low or 0.0), 0)
        best = best.model_copy(update={"low": min(best.low, float(earliest))})
    thesis = estimate_delay(plain).model_copy(update={"method": "first position change (6.2, 6.3)"})
    return best.model_copy(
        update={
            "method": "onset of motion where it is sure enough, else first position change; rounded",
            "by_method": best.by_method | {"first_change": thesis, "onset": onset},
        }
    )


def with_delay(of: Experiment) -> Given:
    """Return the integer delay factor of an experiment, or what its stages say where there is none."""
    value = of.once(delay_estimate).value
    return {"missing": "needs the delay, which is not known"} if value is None else {"delay": int(value)}


def delay_range(estimate: Estimate) -> tuple[int, int]:
    """Return the smallest and largest integer delay factor of an interval, whose upper end is one sample more (6.3)."""
    value = int(estimate.value or 0)
    low = value if estimate.low is None else min(floor(estimate.low), value)
    high = value if estimate.high is None else max(ceil(estimate.high) - 1, value)
    return low, high
