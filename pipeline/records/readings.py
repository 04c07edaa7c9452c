"""Readings that no device gives: a log with one is unusable as a whole, and every computation sees it at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.records.batch import NO_STEP_ROW, Floats, TrialBatch

LARGEST = 1e9
"""Largest reading and command in SI: a light second, the thrust of a rocket; fourth powers of it are still exact."""

GAP = 30.0
"""Distance from the middle of a log relative to the farthest of all nearer readings, and to its typical range, from
which on a reading is none: an unstable loop that grows tenfold a sample leaves gaps of ten."""

TYPICAL = 20
"""Part of the readings (a twentieth) at either end that the typical range leaves out: a few bad ones move it not."""

LONGEST_GAP = 1e6
"""Longest time between two rows in sampling periods: a pause of minutes at 1 kHz is no pause within one response."""


def usable(batch: TrialBatch) -> TrialBatch:
    """Return the trials with unusable logs at rest, without step and with the reason; the batch itself without any.

    Notes
    -----
    A reading is impossible that is no finite number, larger than `LARGEST`, or apart from all others by a gap that no
    motion leaves (`GAP`): a lost bit, a counter that ran over, a cell of another column. One such reading says that the
    log is not what happened. Computations of all trials together then need no guard of their own.
    """
    travel = np.abs(batch.step) / np.where(batch.stiffness > 0, batch.stiffness, np.inf)
    scales = {"command": np.abs(batch.step), "position": travel, "force": np.abs(batch.step)}
    reason = [""] * len(batch)
    for name, scale in scales.items():
        values = getattr(batch, name)
        if values is not None:
            _judge(batch, name, values, scale, reason)
    with np.errstate(over="ignore", invalid="ignore"):
        pauses = np.diff(batch.time, axis=1) > LONGEST_GAP * batch.sampling_period_s[:, None]
    for i in np.flatnonzero(pauses.any(axis=1)):
        row = int(np.argmax(pauses[i])) + 1
        reason[i] = reason[i] or f"time {batch.time[i, row]:.6g} s in row {row} follows {batch.time[i, row - 1]:.6g} s"
    bad = np.array([bool(text) for text in reason], dtype=np.bool_)
    if not bad.any():
        return batch
    wide = bad[:, None] & batch.valid
    clock = np.arange(batch.time.shape[1])[None, :] * batch.sampling_period_s[:, None]
    return replace(
        batch,
        time=np.where(wide, clock, batch.time),
        command=np.where(wide, 0.0, batch.command),
        position=np.where(wide, 0.0, batch.position),
        force=None if batch.force is None else np.where(wide, np.nan, batch.force),
        velocity=None if batch.velocity is None else np.where(wide, np.nan, batch.velocity),
        step_row=None if batch.step_row is None else np.where(bad, NO_STEP_ROW, batch.step_row),
        unusable=np.array(reason),
    )


def _judge(batch: TrialBatch, name: str, values: Floats, scale: Floats, reason: list[str]) -> None:
    """Set the reasons of the trials with an impossible reading in one column."""
    own = batch.valid if name != "force" else batch.valid & ~np.isnan(values).all(axis=1, keepdims=True)
    rows = own.sum(axis=1)
    trial = np.arange(len(batch))
    # padding, and what is no number, come last
    order = np.sort(np.where(own & np.isfinite(values), values, np.inf), axis=1)
    last = np.maximum(np.isfinite(order).sum(axis=1) - 1, 0)
    middle, low, high = (order[trial, part] for part in (last // 2, last // TYPICAL, last - last // TYPICAL))
    with np.errstate(over="ignore", invalid="ignore"):
        typical = np.maximum(high - low, scale)
        far = np.maximum(order[trial, last] - middle, middle - order[:, 0])
        suspect = (far > GAP * typical) & (typical > 0) | (far + np.abs(middle) > LARGEST) | (last + 1 < rows)
        for i in np.flatnonzero(suspect & (rows > 0)):
            distance = np.where(own[i], np.abs(values[i] - middle[i]), 0.0)
            distance[own[i] & ~np.isfinite(values[i])] = np.inf
            nearer = np.sort(distance[own[i]])
            beyond = nearer[1:] > GAP * np.maximum(nearer[:-1], typical[i])
            first = nearer[1:][beyond].min(initial=np.inf) if typical[i] > 0 else np.inf
            wrong = own[i] & ((distance >= first) | ~(np.abs(values[i]) <= LARGEST))
            if wrong.any() and not reason[i]:
                row = int(np.argmax(wrong))
                reason[i] = f"{name} {values[i, row]:.6g} in row {row}; the others lie about {middle[i]:.6g}"
