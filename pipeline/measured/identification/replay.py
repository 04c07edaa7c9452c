"""Free runs of the identified device from the start of logs that were not used for its fit: fit in percent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.loop.free_run import free_run
from pipeline.measured.identification.kernels import exponentials
from pipeline.measured.identification.likelihood import LINEAR, Device, columns_of
from pipeline.measured.identification.motion import Pieces, matrices_of
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

PARTS = 4
"""Number of parts of an interval's piece between which friction may change direction: a reversal is accurate to an
eighth of a row."""

STILL = 3.0
"""Largest standard deviation of a position, relative to the noise of its readings, of a log without motion."""

STARTS = 3
"""Number of Newton steps for the initial state of a log, in which everything except friction is linear."""

NUDGE = 1e-4
"""Perturbation of an initial state for numerical derivatives, relative to the range of the position."""


def replay_fit(segments: Segments, device: Device) -> Floats:
    """Return the fit of free runs of a device to each segment, from the best initial state, shape (S,) [%].

    The fit is 100 (1 - |y - x| / |y - mean y|), as usual in system identification; NaN for a log without motion.
    """
    if not len(segments):
        return np.empty(0)
    left = _left_with_friction(segments, device) if device.numbers.get("coulomb") else _left_linear(segments, device)
    ends = np.cumsum(segments.rows)[:-1]
    readings = np.split(segments.position[segments.places], ends)
    error = np.array([np.linalg.norm(each) for each in np.split(left, ends)])
    size = np.array([np.linalg.norm(each - each.mean()) for each in readings])
    # a position that changes only by noise and sensor steps is predicted by any device
    moves = size > np.maximum(STILL * np.sqrt(segments.rows * segments.white), 1e-3)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moves, 100 * (1 - error / size), np.nan)


def _left_linear(segments: Segments, device: Device) -> Floats:
    """Return the residual of the free run of a device without friction, which is linear in its initial state."""
    columns = columns_of(segments, replace(device, noise=WHITE), ())
    places = np.arange(len(segments.places)) + columns.starts * segments.segment
    return np.asarray(columns.values[places, -1])


def _left_with_friction(segments: Segments, device: Device) -> Floats:
    """Return the residual of the free run of a device with friction, from the best initial state by Newton steps."""
    ends = np.cumsum(segments.rows)
    readings = np.split(segments.position[segments.places], ends[:-1])
    states = matrices_of(device.shape, ())[1].shape[1]
    start = np.zeros((len(segments), states))
    for s, (y, rests) in enumerate(zip(readings, segments.rests, strict=True)):
        few = min(len(y) - 1, 5)
        start[s, 0] = y[0]
        start[s, 1] = 0.0 if rests else (y[few] - y[0]) / max(few, 1)
    tried, least, left = start, np.full(len(start), np.inf), [y * 0.0 for y in readings]
    for _ in range(STARTS + 1):
        # the nominal run, and one with a perturbation of each state
        versions = np.concatenate([tried[:, None], tried[:, None] + NUDGE * np.eye(states)], axis=1)
        runs = np.split(_runs(segments, device, versions), ends[:-1])
        tried = start.copy()
        for s, (y, run) in enumerate(zip(readings, runs, strict=True)):
            error = y - run[:, 0]
            if float(error @ error) < least[s]:
                least[s], left[s], start[s] = float(error @ error), error, versions[s, 0]
                columns = (run[:, 1:] - run[:, :1]) / NUDGE
                tried[s] = start[s] + np.linalg.pinv(columns, rcond=1e-6) @ error
    return np.concatenate(left)


def _runs(segments: Segments, device: Device, starts: Floats) -> Floats:
    """Return free runs from several initial states (S, V, n) of each segment, (rows of all segments, V)."""
    matrices, sensors = matrices_of(device.shape, ())
    pieces, n, limit = Pieces.of(segments, [device.shape.delay]), sensors.shape[1], device.numbers.get("limit", np.inf)
    spans, kind = np.unique(np.round(pieces.begin - pieces.end, 12), return_inverse=True)
    # after the last piece of an interval with fewer pieces than others, nothing moves
    over = exponentials(matrices, np.append(spans, 0.0) / PARTS)[:, 0]
    F, G = (np.ascontiguousarray(each) for each in (over[:, :n, :n], over[:, :n, n:]))
    system = (sensors[0], np.ascontiguousarray(matrices[0, 1, :n]), float(matrices[0, 1, n]))
    command = np.clip(segments.command, -limit, limit)
    gain, coulomb, force = (device.own(name, segments.trial).tolist() for name in LINEAR)
    runs = []
    for s, (first, behind, begin) in enumerate(zip(segments.first, segments.behind, segments.begin, strict=True)):
        row = np.arange(first, behind)
        at = np.minimum(row, len(pieces.offset) - 2)
        count = pieces.offset[at + 1] - pieces.offset[at]
        number = np.arange(max(int(count.max()), 1))[:, None]
        piece = np.minimum(pieces.offset[at] + number, len(pieces.back) - 1)
        place = np.where(number < count, kind[piece], len(spans)).astype(np.int64)
        driven = gain[s] * command[np.clip(row - pieces.back[piece], begin, behind - 1)]
        forces = (force[s], coulomb[s])
        runs.append(
            np.stack(
                [free_run(system, (F, G, place), driven, forces, start.copy(), PARTS) for start in starts[s]], axis=1
            )
        )
    return np.concatenate(runs)
