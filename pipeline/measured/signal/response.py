"""Where the step response begins in a log, and how far its motion can still come after the end.

The edge is that of the external force, which is recovered from the log itself (`edge`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.edge import NO_ROW as NO_ROW
from pipeline.measured.signal.edge import external_force as external_force
from pipeline.measured.signal.edge import find_edges, level_before
from pipeline.measured.signal.sensor import sensor_floor, sensor_quantum, white_noise
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.criteria import RISE_LEVELS


@dataclass(frozen=True, eq=False)
class Response:
    """Edge, rest positions and resolution of each trial, shape (n,) each; NaN where there is a reason.

    Parameters
    ----------
    edge_row : int64
        Row of the command edge k0, counted from 0; -1 where there is none.
    level : float64
        External force before the step [N, Nm]; 0 but for a step at an operating point.
    steps : int64
        Jumps of the external force from level to level; a log with several has no edge, whatever its metadata say.
    position_start : float64
        First position, where the wall rests [m, rad].
    position_final_expected : float64
        x_0 + F_0/K (6.1) [m, rad]; NaN where K <= 0, and without a step.
    position_final_measured : float64
        Mean over the last tenth of the log [m, rad].
    sensor_quantum : float64
        Step of the grid on which all positions lie [m, rad]; 0 where there is none, and for integrals of a velocity.
    sensor_noise : float64
        Standard deviation of the white noise of the positions before the edge [m, rad]; NaN without a
        baseline.
    floor : float64
        Position amplitude that quantum and noise alone can cause [m, rad]; 0 for an ideal log.
    baseline_motion : float64
        Peak to peak of the positions before the step where the sensor alone cannot cause it [m, rad], else 0.
    reason : tuple of str
        Why values are missing; empty where all are there.
    edge_reason : tuple of str
        Why there is no command edge; empty where there is one.
    """

    edge_row: Integers
    level: Floats
    steps: Integers
    position_start: Floats
    position_final_expected: Floats
    position_final_measured: Floats
    sensor_quantum: Floats
    sensor_noise: Floats
    floor: Floats
    baseline_motion: Floats
    reason: tuple[str, ...]
    edge_reason: tuple[str, ...]

    @property
    def has_edge(self) -> Booleans:
        """Where a command edge was found, shape (n,)."""
        return self.edge_row >= 0

    def select(self, which: Integers | slice) -> Response:
        """Return the response of the trials at indices or in a slice."""
        arrays = {name: value[which] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        index = range(len(self.reason))[which] if isinstance(which, slice) else which
        texts = {name: tuple(getattr(self, name)[i] for i in index) for name in ("reason", "edge_reason")}
        return replace(self, **arrays, **texts)  # type: ignore[arg-type]


def find_response(batch: TrialBatch) -> Response:
    """Find the command edge and the resolution of each trial.

    Parameters
    ----------
    batch : TrialBatch

    Returns
    -------
    Response

    Notes
    -----
    Level and edge are those of `edge.find_edges`. The external force is exact for a controller that uses the plain
    difference of positions. With a velocity filter or a force limit it is wrong once the device moves, but not before,
    so that the edge stays right for any delay of at least one sample.

    A command of wrong sign or size, or another signal, has no edge: the wall force alone would cross half the step,
    too, only later. Such a log is known by a command that has not reached half the step by then
    (a chatter may be larger, of either sign), or by a force that first stays beyond half the step on the other side.

    The noise is that of the second differences of the baseline, var = 6 sigma^2 for white noise. A device that
    chatters before the step (at high B one quantum commands newtons) hardly adds to them while its period is
    long: a chatter of amplitude a and period of p samples adds a variance of (2 pi/p)^4 a^2/12, 1 % of a for
    p = 35, 5 % for p = 16. A faster chatter still counts as noise. A quantum alone leaves the baseline
    constant: then the noise is exactly 0.

    Source: Hulin 2017, sec. 6.1.1 (procedure) and eq. 6.1 (final position).
    """
    edges = find_edges(batch)
    quantum = sensor_quantum(batch)
    if batch.integrated is not None:
        quantum = np.where(batch.integrated, 0.0, quantum)
    with np.errstate(divide="ignore", invalid="ignore"):
        travel = np.where((batch.stiffness > 0) & (batch.step != 0), batch.step / batch.stiffness, np.nan)
    start = batch.position[:, :1].reshape(-1)
    reason = tuple(
        "; ".join(part for part in (text, "" if k > 0 else _no_final(k)) if part)
        for text, k in zip(edges.reason, batch.stiffness, strict=True)
    )
    return Response(
        edge_row=edges.row,
        level=edges.level,
        steps=edges.steps,
        position_start=start,
        position_final_expected=start + travel,
        position_final_measured=_last_tenth(batch),
        sensor_quantum=quantum,
        **_baseline(batch, quantum, edges.row),
        reason=reason,
        edge_reason=edges.reason,
    )


def declare_edge(batch: TrialBatch, response: Response, edge_row: int | Integers) -> Response:
    """Return the response with the command edge where the trial's metadata say that it is.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    edge_row : int or int64, shape (n,)
        Row in which the command first holds the step, counted from 0; it replaces what the log shows, and the rows
        before it are the baseline. Row 0 is legal: such a log has none, so that its noise is unknown. -1 leaves a
        trial as it is, and so do several steps.

    Returns
    -------
    Response

    Raises
    ------
    ParameterError
        If a row lies outside its log.
    """
    edge = np.broadcast_to(np.asarray(edge_row, dtype=np.int64), (len(batch),)).copy()
    kept = (edge == NO_ROW) | (response.steps > 1)
    outside = ~kept & ((edge < 0) | (edge >= batch.rows))
    if outside.any():
        i = int(np.argmax(outside))
        raise ParameterError(
            f"declared command edge of trial {batch.trial_id[i]!r}: row {edge[i]}; expected 0 to {batch.rows[i] - 1}. "
            "Correct the declared row."
        )
    final = ("" if k > 0 else _no_final(k) for k in batch.stiffness)
    edge = np.where(kept, response.edge_row, edge)
    force = external_force(batch)
    level = [level_before(f, k, step) for f, k, step in zip(force, edge.tolist(), batch.step.tolist(), strict=True)]
    return replace(
        response,
        edge_row=edge,
        level=np.where(kept, response.level, level),
        **_baseline(batch, response.sensor_quantum, edge),
        reason=tuple(old if same else new for same, old, new in zip(kept, response.reason, final, strict=True)),
        edge_reason=tuple(old if same else "" for same, old in zip(kept, response.edge_reason, strict=True)),
    )


def _no_final(stiffness: float) -> str:
    return f"no final position: x_0 + F_0/K needs K > 0, found K = {stiffness:g}"


def _baseline(batch: TrialBatch, quantum: Floats, edge: Integers) -> dict[str, Any]:
    """Return what the rows before the edge tell: noise, sensor floor and motion, each of shape (n,)."""
    baseline = np.arange(batch.position.shape[1])[None, :] < edge[:, None]
    noise = white_noise(batch.position, baseline)
    floor = sensor_floor(quantum, noise)
    return {"sensor_noise": noise, "floor": floor, "baseline_motion": _motion(batch.displacement, baseline, floor)}


def _motion(displacement: Floats, baseline: Booleans, floor: Floats) -> Floats:
    """Peak to peak of the baseline where it exceeds the sensor floor, else 0, shape (n,)."""
    # row 0 is its reference, so that 0 is one of the values
    inside = np.where(baseline, displacement, 0.0)
    spread = inside.max(axis=1, initial=0.0) - inside.min(axis=1, initial=0.0)
    result: Floats = np.where(spread > floor, spread, 0.0)
    return result


def _last_tenth(batch: TrialBatch) -> Floats:
    first = batch.rows - np.maximum(batch.rows // 10, 1)
    column = np.arange(batch.position.shape[1])[None, :]
    where = batch.valid & (column >= first[:, None])
    mean: Floats = np.where(where, batch.position, 0.0).sum(axis=1) / np.maximum(where.sum(axis=1), 1)
    return mean


SETTLED_SAMPLES = 5
"""Samples in a band at the end of a log: fewer may be a mere passage of it."""


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
    rise time tells: 2.2 time constants of a creep, 1.5 radians and more of a swing that is damped so far. Inwards it
    has a quarter of a period more to decay in. The last half radian of the log counts, as far as it is inside the band.
    A motion that does not grow is bounded by its last whole swing, too.
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
        np.argmax(inside & (column >= first[:, None]) & (share <= 1 - level), axis=1) for level in RISE_LEVELS
    )  # rows by which so much of the way is made
    result: Floats = np.where(passes.any(axis=1), longest / np.pi, (end - begin) / np.log(9.0))
    return result
