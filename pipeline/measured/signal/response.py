"""Where the step response begins in a log, and how finely its sensor sees.

The edge is that of the external force, which is recovered from the log itself (`edge`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.edge import EDGE_SAMPLES, find_edges, level_before
from pipeline.measured.signal.edge import NO_ROW as NO_ROW
from pipeline.measured.signal.edge import external_force as external_force
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

BASELINE_SAMPLES = 5
"""Fewest baseline rows for the noise, whose own error then is 60 % (25 % for 20 rows); none would be zero."""

NOISE_GAIN = 6.0
"""Variance of the second difference of white noise relative to its own: 1 + 4 + 1."""

NOISE_FACTOR = 6.0
"""Four standard deviations (2 % chance in 400 samples) of the difference of two readings, 4 sqrt 2 and more."""

GRID_TOLERANCE = 1e-3
"""Largest distance of a position change from a multiple of the quantum, relative to the quantum."""

STORED_TOLERANCE = 0.15
"""As `GRID_TOLERANCE` for positions that were stored in single precision or with few digits: six units of the
last digit in one quantum still pass."""

STORED_GAP = 4.0
"""Ratio between neighbours of the sorted changes that parts one quantum from what the storing rounded."""

STORED_MULTIPLES = 20.0
"""Largest multiple that tests a grid in rounded positions: beyond, its own error reaches the tolerance."""

FEWEST_ON_GRID = 12
"""Changes that must lie on such a grid: those of a continuous signal all do with a chance of 0.3^12 = 5e-7."""

ROUNDING_UNITS = 64.0
"""Changes below this many units of rounding are arithmetic, not the sensor."""


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
        x_0 + F_0/K (6.1) [m, rad]; NaN where K <= 0.
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


def find_response(batch: TrialBatch, *, edge_samples: int = EDGE_SAMPLES) -> Response:
    """Find the command edge and the resolution of each trial.

    Parameters
    ----------
    batch : TrialBatch
    edge_samples : int
        Rows for which the external force must stay above half the step.

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
    edges = find_edges(batch, edge_samples)
    quantum = _quantum(batch)
    if batch.integrated is not None:
        quantum = np.where(batch.integrated, 0.0, quantum)
    with np.errstate(divide="ignore", invalid="ignore"):
        travel = np.where(batch.stiffness > 0, batch.step / batch.stiffness, np.nan)
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


def sensor_floor(quantum: Floats, noise: Floats) -> Floats:
    """Return the position amplitude that quantum and noise alone can cause [m, rad]; a noise of NaN counts as none."""
    floor: Floats = quantum + NOISE_FACTOR * np.nan_to_num(noise)
    return floor


def _no_final(stiffness: float) -> str:
    return f"no final position: x_0 + F_0/K needs K > 0, found K = {stiffness:g}"


def _quantum(batch: TrialBatch) -> Floats:
    """Step of the sensor, shape (n,): of the coarsest grid on which the positions lie; 0 where there is none.

    Single precision and printed digits put the positions on a finer grid of their own, whose step is not the
    sensor's: a grid that is coarser, and on which they lie but for that rounding, goes first.
    """
    quantum = np.zeros(len(batch))
    for some, part in batch.portions():
        # padding does not move; a fast motion never changes by one quantum a sample, but its changes differ by one
        steps = [np.abs(np.nan_to_num(np.diff(part.position, n=n, axis=1))) for n in (1, 2)]
        rounding = ROUNDING_UNITS * np.finfo(np.float64).eps * np.nanmax(np.abs(part.position), axis=1, initial=0.0)
        size = np.concatenate(steps, axis=1)
        size = np.sort(np.where(size > rounding[:, None], size, np.inf), axis=1)
        if not size.shape[1]:
            continue
        change = np.where(steps[0] > rounding[:, None], steps[0], 0.0)
        exact = _grid(change, size[:, 0], GRID_TOLERANCE, np.inf, 1)
        # beyond 1/tolerance multiples the rounding of the positions themselves hides the grid
        exact[exact <= rounding / GRID_TOLERANCE] = 0.0
        with np.errstate(invalid="ignore"):
            ratio = np.where(np.isfinite(size[:, 1:]), size[:, 1:] / size[:, :-1], 0.0)
        # without a gap the smallest change is no candidate: those of a smooth motion have common measures of their own
        gap, trial = np.argmax(ratio, axis=1), np.arange(len(part))
        above = np.where(ratio[trial, gap] > STORED_GAP, size[trial, gap + 1], np.inf)
        finite = np.where(np.isfinite(size), size, 0.0)
        stored = _grid(finite, above, STORED_TOLERANCE, STORED_MULTIPLES, FEWEST_ON_GRID)
        quantum[some] = np.where(stored > STORED_GAP * exact, stored, exact)
    return quantum


def _grid(size: Floats, smallest: Floats, tolerance: float, most: float, fewest: int) -> Floats:
    """Step of the grid on which changes of up to ``most`` steps lie, ``fewest`` at least; 0 for none."""
    result = np.zeros(len(size))
    # no single change may have been one step: then the smallest is two or three of them
    for parts in (1, 2, 3):
        open_ = np.flatnonzero(np.isfinite(smallest) & (result == 0))
        if not len(open_):
            break
        own, grid = size[open_], smallest[open_] / parts
        # the smallest change carries the rounding of two readings, the mean of all hardly any: step by step, for an
        # error of the grid is one of its multiples as many times over
        for limit in (3.0 * parts, 8.0 * parts, most) if np.isfinite(most) else ():
            multiple = np.round(own / grid[:, None])
            tested = (multiple >= 1) & (multiple <= limit)
            square = np.where(tested, multiple**2, 0.0).sum(axis=1)
            mean = np.where(tested, multiple * own, 0.0).sum(axis=1) / np.maximum(square, 1.0)
            grid = np.where(square > 0, mean, np.inf)
        multiple = np.round(own / grid[:, None])
        error = np.where(multiple <= most, np.abs(own / grid[:, None] - multiple), 0.0).max(axis=1, initial=0.0)
        number = ((multiple >= 1) & (multiple <= most)).sum(axis=1)
        found = np.isfinite(grid) & (error < tolerance) & (number >= fewest)
        result[open_] = np.where(found, grid, 0.0)
    return result


def _baseline(batch: TrialBatch, quantum: Floats, edge: Integers) -> dict[str, Any]:
    """Return what the rows before the edge tell: noise, sensor floor and motion, each of shape (n,)."""
    baseline = np.arange(batch.position.shape[1])[None, :] < edge[:, None]
    noise = _white_noise(batch.position, baseline)
    floor = sensor_floor(quantum, noise)
    return {"sensor_noise": noise, "floor": floor, "baseline_motion": _motion(batch.displacement, baseline, floor)}


def _white_noise(position: Floats, baseline: Booleans) -> Floats:
    """Standard deviation of white noise from the second differences of the baseline, shape (n,)."""
    second = np.diff(position, n=2, axis=1)
    where = baseline[:, 2:]
    count = where.sum(axis=1)
    mean_square = np.where(where, second**2, 0.0).sum(axis=1) / np.maximum(count, 1)
    enough = count >= BASELINE_SAMPLES - 2
    result: Floats = np.where(enough, np.sqrt(mean_square / NOISE_GAIN), np.nan)
    return result


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
