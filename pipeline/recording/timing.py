"""Time stamps of a log against its stated sampling period, and rows that they skip."""

from __future__ import annotations

import numpy as np

from pipeline.recording.samples import LAW_RESIDUAL, Samples, middle
from pipeline.records.findings import Finding

EVEN = 0.02
"""Part of a period by which the usual distance of two rows may differ from it: clocks drift by less."""

SURE = 4.0
"""Standard errors by which that distance differs where the period is another one."""

UNEVEN, MOST_EVEN = 0.05, 0.1
"""Part of the usual distance by which one is off, and share of such ones, from which on rows are uneven."""

MISSING = 1.5
"""Distance of two rows in periods from which on rows are missing between them."""


def sampling_period(samples: Samples) -> Finding | None:
    """Return whether the rows are as far apart as stated, by their time stamps.

    Both the usual and the mean distance must differ: lost rows move the mean alone, stamps of few digits the usual one.
    Behind a wall the command shows which period the controller used; where that is the stated one, stamps are wrong.
    """
    steps, period = samples.steps, samples.period
    mean = float(samples.time[-1] - samples.time[0]) / len(steps)
    if abs(mean / period - 1) <= EVEN:
        return None
    usual = middle(steps)
    scatter = middle(np.abs(steps - usual)) / period
    off = usual / period - 1
    if abs(off) <= EVEN + SURE * scatter / np.sqrt(len(steps)) or (off > 0) != (mean > period):
        return None
    factor = usual / period if off > 0 else period / usual
    times = f"{factor:.4g} times {'longer' if off > 0 else 'shorter'}"
    evidence = f"Rows are {usual:.4g} s apart by their time stamps, the stated sampling period is {period:.4g} s: "
    uneven = float(np.mean(np.abs(steps - usual) > UNEVEN * usual)) > MOST_EVEN
    if uneven:
        return samples.finding(
            "sampling_period",
            "note",
            f"{evidence}{times}, and unevenly.",
            "Record at an even rate; a delay counts from the time stamps.",
        )
    if _shows_period(samples):
        return samples.finding(
            "sampling_period",
            "note",
            f"{evidence}{times}, and the command obeys the stated one.",
            "Correct the unit of the time stamps in the profile.",
        )
    return samples.finding(
        "sampling_period",
        "unsafe",
        f"{evidence}{times}.",
        f"State {usual:.4g} s (sampling_period_s) if the controller runs at the rate of the rows; correct the unit "
        "of the time stamps if these are wrong; record every sample if rows were left out.",
    )


def _shows_period(samples: Samples) -> bool:
    """Return whether the command is that of the stated wall, and its damping is seen, which depends on the period."""
    damper, jumps = samples.damping / samples.period * samples.bend, samples.jumps
    is_seen = float(damper @ damper) > LAW_RESIDUAL**2 * float(jumps @ jumps)
    return is_seen and samples.obeys_wall


def missing_rows(samples: Samples) -> Finding | None:
    """Return the rows that the time stamps skip."""
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
        f"{lost} of {len(samples) + lost} rows are missing by the time stamps, first after row {gaps[0]}, "
        f"{longest} of them in sequence.",
        "Record without lost rows: a faster disk, a larger buffer or a lower rate.",
        first_row=int(gaps[0]),
        rows=lost,
    )
