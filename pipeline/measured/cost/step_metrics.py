"""Settling time and overshoot by several named definitions side by side, to reconcile numbers from other tools.

The definitions differ in the final value, in what the band is a fraction of, in where time starts, and in
whether the last crossing is interpolated. The other tools are followed in what they define, not in what they
return where they cannot tell: there the value is missing and has a reason.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.cost import settling_overshoot
from pipeline.measured.signal.horizon import cost_start
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

DEFINITIONS = {
    "thesis": (
        "Final value x_0 + F_0/K, band a fraction of F_0/K; first sample from which on all are inside, counted from "
        "the command edge plus the delay. Hulin 2017, sec. 6.1.4."
    ),
    "matlab_final_value": (
        "Final value: last sample; band a fraction of the final displacement; last crossing interpolated, counted "
        "from the command edge. SettlingTime of stepinfo(y, t, y(end), y(1)), releases after R2021a."
    ),
    "matlab_peak_error": (
        "As before, but the band is a fraction of the largest distance from the final value. SettlingTime of stepinfo "
        "up to R2021a, TransientTime later."
    ),
    "python_control": (
        "Final value: last sample; band a fraction of the final displacement; first sample from which on all are "
        "strictly inside, not interpolated, counted from the command edge. step_info of python-control 0.10 for "
        "displacements."
    ),
}
"""What each definition of the settling time says. The overshoot differs by the final value alone."""

TOOLS = tuple(name for name in DEFINITIONS if name != "thesis")

AT_REST_PART = 10
"""Part of the log (a tenth) at its end that must be inside the band: any response ends at its own last sample."""

LAST_SAMPLE_ERROR = 0.5
"""Distance of the last sample from the mean of the end, in half widths of the band, from which on it is no final value:
noise, or a motion that goes on."""


@dataclass(frozen=True, eq=False)
class Metric:
    """One metric by one definition, shape (n,); NaN where there is a reason."""

    value: Floats
    reason: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class StepMetrics:
    """Settling time [samples] and overshoot [1] by definition, the keys those of `DEFINITIONS`."""

    settling: Mapping[str, Metric]
    overshoot: Mapping[str, Metric]


def reconcile(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    delay_samples: int,
    *,
    band: float = 0.02,
) -> StepMetrics:
    """Return settling time and overshoot by all definitions.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor of the experiment; only the thesis takes it off.
    band : float
        Half width of the settling band, relative to what the definition takes it relative to.

    Returns
    -------
    StepMetrics

    Raises
    ------
    ParameterError
        If the delay is negative, or the band not between 0 and 1.

    Notes
    -----
    All tools get displacements from the first position, from the command edge on: handed raw positions they take
    the offset for a part of the step. Multiply by the sampling period for seconds. A tool's value is missing where

    * the trial is unstable, has no command edge or no final position (K = 0),
    * the final displacement, or the band, is below the sensor floor (tools divide by it, or return the last time),
    * the last sample is not a final value: the position still moves, or noise shifts it by half a band,
    * the response is not inside the band over the last tenth of the log (tools then return the end of the log).

    Source: Hulin 2017, secs. 5.1.1 and 6.1.4; documentation of MATLAB stepinfo (R2021a and later) and source of
    python-control 0.10 `step_info`.
    """
    if not 0 < band < 1:
        raise ParameterError(f"settling band {band:g}: expected a fraction between 0 and 1.")
    found = settling_overshoot.settling(batch, response, verdicts, delay_samples, bands={"thesis": band})
    over = settling_overshoot.overshoot(batch, response, verdicts)
    settling = {"thesis": Metric(found.samples["thesis"], found.reason)}
    overshoot = {"thesis": Metric(over.overshoot, over.reason)}

    first, usable, why = cost_start(batch, response, verdicts, 0)
    column = np.arange(batch.position.shape[1])[None, :]
    counted = batch.valid & (column >= first[:, None]) & usable[:, None]
    last = np.maximum(batch.rows - 1, 0)[:, None]
    final = np.take_along_axis(batch.displacement, last, axis=1)[:, 0]
    sign = np.sign(final)
    error = np.where(counted, batch.displacement - final[:, None], 0.0)
    travel, peak = np.abs(final), np.abs(error).max(axis=1, initial=0.0)
    for text in _why_no_final(batch, response, final, band):
        why = tuple(a or b for a, b in zip(why, text, strict=True))
    usable = np.array([not text for text in why], dtype=np.bool_)
    beyond = np.max(np.where(counted, error * sign[:, None], 0.0), axis=1, initial=0.0)
    relative = beyond / np.where(usable & (travel > 0), travel, 1.0)
    for name in TOOLS:
        overshoot[name] = Metric(np.where(usable, relative, np.nan), why)
        width = band * (peak if name == "matlab_peak_error" else travel)
        strict = name == "python_control"
        settling[name] = _settle(batch, response, error, counted, first, width, usable, why, strict=strict)
    return StepMetrics(settling, overshoot)


def _why_no_final(
    batch: TrialBatch, response: Response, final: Floats, band: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return for each trial why its last displacement is too small, and why it is not a final value."""
    measured = response.position_final_measured - response.position_start
    small = tuple(
        f"final displacement {value:.3g} is not above the sensor floor {floor:.3g}" if abs(value) <= floor else ""
        for value, floor in zip(final, response.floor, strict=True)
    )
    part = np.maximum(batch.rows // AT_REST_PART, 1)
    column = np.arange(batch.position.shape[1])[None, :]
    before = batch.valid & (column >= (batch.rows - 2 * part)[:, None]) & (column < (batch.rows - part)[:, None])
    earlier = np.where(before, batch.displacement, 0.0).sum(axis=1) / np.maximum(before.sum(axis=1), 1)
    limit = LAST_SAMPLE_ERROR * band * np.abs(final)
    moving = tuple(
        f"the last sample is no final value: it lies {max(off, drift):.3g} from the means of the last two tenths"
        if max(off, drift) > most
        else ""
        for off, drift, most in zip(np.abs(final - measured), np.abs(final - earlier), limit, strict=True)
    )
    return small, moving


def _settle(
    batch: TrialBatch,
    response: Response,
    error: Floats,
    counted: Booleans,
    first: Integers,
    width: Floats,
    usable: Booleans,
    why: tuple[str, ...],
    *,
    strict: bool,
) -> Metric:
    """Return the samples from the edge to the last crossing of a band: interpolated, or the first sample inside."""
    distance = np.abs(error)
    outside = counted & ((distance >= width[:, None]) if strict else (distance > width[:, None]))
    columns = error.shape[1]
    after = np.where(outside.any(axis=1), columns - np.argmax(outside[:, ::-1], axis=1), first)
    at_rest = batch.rows - after >= np.maximum(batch.rows // AT_REST_PART, settling_overshoot.SETTLED_SAMPLES)
    value = (after - first).astype(np.float64)
    if not strict:
        rows = np.stack([np.maximum(after - 1, 0), np.minimum(after, columns - 1)], axis=1)
        here, there = np.take_along_axis(error, rows, axis=1).T
        # the crossing of the edge on which the last sample outside lies
        passed = np.abs(here) - width
        step = np.abs(here - there)
        crosses = at_rest & (after > first) & (step > 0)
        value = np.where(crosses, value - 1 + passed / np.where(crosses, step, 1.0), value)
    resolved = width > response.floor
    reason = tuple(
        text
        or ("" if wide else f"band of {w:.3g} is not above the sensor floor {floor:.3g}")
        or ("" if rest else "not inside the band over the last tenth of the log: not settled, or record too short")
        for text, wide, w, floor, rest in zip(why, resolved, width, response.floor, at_rest, strict=True)
    )
    return Metric(np.where(usable & resolved & at_rest, value, np.nan), reason)
