"""Compare the time stamps of a log with its stated sampling period, and find skipped rows."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from pipeline.recording.samples import LAW_RESIDUAL, NORMAL_QUARTILE, Samples, middle
from pipeline.records.findings import Finding
from pipeline.records.trials import Floats

EVEN = 0.01
"""Largest relative difference between the median time step and the stated period. Clocks drift by less. A change of the
period by 1 % changes the mass by 2 %."""

SURE = 4.0
"""Threshold for the difference between the median time step and the stated period, in standard errors. Above it, one of
the two is wrong. By chance, the threshold is exceeded in 6e-5 of the logs."""

MISSING = 1.5
"""Smallest time step, in periods, that indicates missing rows, because it rounds to 2 or more."""


def other_period(time: Floats, period: float) -> float | None:
    """Return the median time step if it differs from the stated sampling period [s], otherwise None.

    Both the median and the mean must differ from the period, because lost rows change only the mean, and time stamps
    with few digits change only the median.

    Parameters
    ----------
    time : float64, shape (rows,)
        Time stamps [s].
    period : float
        Stated sampling period [s].
    """
    mean = float(time[-1] - time[0]) / (len(time) - 1) / period - 1
    if abs(mean) <= EVEN:
        return None
    steps = time[1:] - time[:-1]
    usual = middle(steps)
    deviation = middle(np.abs(steps - usual)) / NORMAL_QUARTILE
    error = sqrt(0.5 * pi / len(steps)) * deviation / period  # standard error of a median
    off = usual / period - 1
    return usual if abs(off) > EVEN + SURE * error and (off > 0) == (mean > 0) else None


def sampling_period(samples: Samples) -> Finding | None:
    """Return a finding if the time stamps contradict the stated sampling period.

    With a wall, the period that the controller used follows from the command. If the controller used the stated period,
    the time stamps are wrong.
    """
    period = samples.period
    usual = other_period(samples.time, period)
    if usual is None:
        return None
    off = usual / period - 1
    factor = usual / period if off > 0 else period / usual
    times = f"{factor:.4g} times {'longer' if off > 0 else 'shorter'}"
    evidence = f"The time stamps are {usual:.4g} s apart, but the stated sampling period is {period:.4g} s: "
    if not samples.is_even:
        return samples.finding(
            "sampling_period",
            "note",
            f"{evidence}{times}, and uneven.",
            "Record at an even rate. Delays are computed from the time stamps.",
        )
    if _shows_period(samples):
        return samples.finding(
            "sampling_period",
            "note",
            f"{evidence}{times}, and the command follows the stated period.",
            "Correct the unit of the time stamps in the profile.",
        )
    return samples.finding(
        "sampling_period",
        "unsafe",
        f"{evidence}{times}.",
        f"If the controller runs at the rate of the rows, state {usual:.4g} s (sampling_period_s). If the time stamps "
        "are wrong, correct their unit. If rows were left out, record every sample.",
    )


def _shows_period(samples: Samples) -> bool:
    """Return True if the command matches the stated wall and depends on its damping, and thus on the period."""
    damper, jumps = samples.damping / samples.period * samples.bend, samples.jumps
    is_seen = float(damper @ damper) > LAW_RESIDUAL**2 * float(jumps @ jumps)
    return is_seen and samples.obeys_wall


def missing_rows(samples: Samples) -> Finding | None:
    """Return a finding with the rows that the time stamps skip."""
    steps, period = samples.steps, samples.period
    if steps.max() <= MISSING * period or middle(steps) > MISSING * period:
        return None
    gaps = np.flatnonzero(steps > MISSING * period)
    lost = int(np.sum(np.rint(steps[gaps] / period) - 1))
    if not lost:
        return None
    longest = int(np.rint(steps[gaps].max() / period)) - 1
    return samples.finding(
        "missing_rows",
        "note",
        f"According to the time stamps, {lost} of {len(samples) + lost} rows are missing. The first gap is after row "
        f"{gaps[0]}, and the longest gap has {longest} rows.",
        "Record without losing rows: use a faster disk, a larger buffer or a lower rate.",
        first_row=int(gaps[0]),
        rows=lost,
    )
