"""Time stamps of a log against its stated sampling period, and rows that they skip."""

from __future__ import annotations

import numpy as np

from pipeline.recording.samples import Samples, middle
from pipeline.records.batch import Floats
from pipeline.records.findings import Finding

EVEN = 0.02
"""Part of a period by which the usual distance of two rows may differ from it: clocks drift by less."""

SURE = 4.0
"""Standard errors by which that distance differs where the period is another one."""

UNEVEN, MOST_EVEN = 0.05, 0.1
"""Part of the usual distance by which one is off, and share of such ones, from which on rows are uneven."""

MISSING = 1.5
"""Distance of two rows in periods from which on rows are missing between them."""

LAW_LEFT = 0.02
"""Part of the command that the wall law leaves unexplained where its sampling period is the stated one."""


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
        return Finding(
            code="sampling_period",
            first_row=None,
            rows=len(samples),
            evidence=f"{evidence}{times}, and unevenly.",
            remedy="Record at an even rate; a delay counts from the time stamps.",
            severity="note",
        )
    if _obeys(samples, period):
        return Finding(
            code="sampling_period",
            first_row=None,
            rows=len(samples),
            evidence=f"{evidence}{times}, and the command obeys the stated one.",
            remedy="Correct the unit of the time stamps in the profile.",
            severity="note",
        )
    return Finding(
        code="sampling_period",
        first_row=None,
        rows=len(samples),
        evidence=f"{evidence}{times}.",
        remedy=(
            f"State {usual:.4g} s (sampling_period_s) if the controller runs at the rate of the rows; correct the unit "
            "of the time stamps if these are wrong; record every sample if rows were left out."
        ),
        severity="unsafe",
    )


def _obeys(samples: Samples, period: float) -> bool:
    """Return whether the command is that of the stated wall at a sampling period; False where its damping is unseen."""
    if samples.damping == 0 or not samples.wall_edge:
        return False
    wall = samples.stiffness * (samples.position - samples.position[0])
    damper = np.zeros(len(samples))
    damper[1:] = samples.damping * samples.change / period
    external = np.where(np.arange(len(samples)) >= samples.wall_edge, samples.step, 0.0)
    rest = samples.command + wall + damper - external
    largest = _size(samples.command)
    return _size(damper) > LAW_LEFT * largest and _size(rest) <= LAW_LEFT * largest


def _size(values: Floats) -> float:
    return float(np.sqrt(np.mean(values * values)))


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
    return Finding(
        code="missing_rows",
        first_row=int(gaps[0]),
        rows=lost,
        evidence=(
            f"{lost} of {len(samples) + lost} rows are missing by the time stamps, first after row {gaps[0]}, "
            f"{longest} of them in sequence."
        ),
        remedy="Record without lost rows: a faster disk, a larger buffer or a lower rate.",
        severity="note",
    )
