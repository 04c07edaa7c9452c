"""How far a motion can still come after the end of its log: what settles, what passes its final position later."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

SETTLED_SAMPLES = 5
"""Samples in a band at the end of a log: fewer may be a mere passage of it."""

RISE = (0.1, 0.9)
"""Parts of its way between which the time of a motion is taken that never passes its final position: 2.2 time
constants of a creep, 1.5 radians and more of a swing that is damped so far."""


def reach(
    batch: TrialBatch, final: Floats, first: Integers, entry: Integers, growth: Floats, noise: Floats
) -> tuple[Floats, Floats]:
    """Return how far from its final position a motion can still come [m, rad], and the error of that, shape (n,) each.

    Parameters
    ----------
    batch : TrialBatch
    final : float64, shape (n,)
        Position about which the response swings [m, rad].
    first, entry : int64, shape (n,)
        Row in which it begins, and row from which on it is inside the band that is asked for.
    growth : float64, shape (n,)
        Growth rate of its slowest mode per sample, NaN where none is told.
    noise : float64, shape (n,)
        Standard error of a late reading [m, rad].

    Notes
    -----
    A swing of angular frequency w that is at e and moves at v comes as far as hypot(e, v/w) at most. The slowest one
    shows in the longest time on one side of the final position, half a period; of a motion that never passed it the
    rise time tells. Inwards it has a quarter of a period more to decay in. The last half radian of the log counts, as
    far as it is inside the band. A motion that does not grow is bounded by its last whole swing, too.
    """
    column = np.arange(batch.position.shape[1])[None, :]
    first = np.minimum(first, np.maximum(batch.rows - 1, 0))
    inside = batch.valid & (column >= first[:, None])
    error = np.where(inside, batch.position - final[:, None], 0.0)
    radian = _radian(error, inside, first, noise)
    # a swing that decays is slower than it would be without damping, which is what bounds it
    radian = np.maximum(radian / np.hypot(1.0, radian * np.minimum(np.nan_to_num(growth), 0.0)), 1.0)
    span = np.clip(np.rint(radian / 2), 1, np.maximum(batch.rows - first - 1, 1)).astype(np.int64)
    before = np.take_along_axis(error, np.maximum(column - span[:, None], first[:, None]), axis=1)
    way = (error - before) * (radian / span)[:, None]
    swing = np.hypot(error, way)
    decay = np.exp(np.minimum(np.nan_to_num(growth), 0.0) * 0.5 * np.pi * radian)
    swing = np.where(way * error < 0, np.maximum(np.abs(error), decay[:, None] * swing), swing)
    last = batch.valid & (column >= np.maximum(batch.rows - span, entry)[:, None])
    far: Floats = np.max(np.where(last, swing, 0.0), axis=1, initial=0.0)
    whole = batch.rows - np.ceil(2 * np.pi * radian)
    widest = np.max(np.where(inside & (column >= whole[:, None]), np.abs(error), 0.0), axis=1, initial=0.0)
    far = np.where((whole >= first) & ~(growth > 0), np.minimum(far, widest), far)
    return np.where(last.any(axis=1), far, np.inf), noise * np.hypot(1.0, np.sqrt(2) * radian / span)


def _radian(error: Floats, inside: Booleans, first: Integers, noise: Floats) -> Floats:
    """Return the time of one radian of the slowest swing [samples], shape (n,)."""
    column = np.arange(error.shape[1])[None, :]
    # the side of the last reading that surely lies on one
    side = np.where(inside & (np.abs(error) > 4 * noise[:, None]), np.sign(error), 0.0)
    side = np.take_along_axis(side, np.maximum.accumulate(np.where(side != 0, column, 0), axis=1), axis=1)
    passes = np.zeros_like(inside)
    passes[:, 1:] = inside[:, 1:] & (side[:, 1:] * side[:, :-1] < 0)
    last = np.maximum.accumulate(np.where(passes, column, first[:, None]), axis=1)
    gaps = np.where(passes, column - np.roll(last, 1, axis=1), 0).max(axis=1, initial=0)
    # of the swing that has not ended, a quarter is seen up to its farthest reading
    since_pass = np.where(inside & (column >= last[:, -1:]), np.abs(error), 0.0)
    quarter = np.argmax(since_pass, axis=1) - last[:, -1]
    longest = np.maximum(gaps, 2 * quarter)
    share = np.abs(error) / np.maximum(np.abs(error).max(axis=1, initial=0.0), np.finfo(np.float64).tiny)[:, None]
    begin, end = (
        np.argmax(inside & (column >= first[:, None]) & (share <= 1 - level), axis=1) for level in RISE
    )  # rows by which so much of the way is made
    result: Floats = np.where(passes.any(axis=1), longest / np.pi, (end - begin) / np.log(9.0))
    return result
