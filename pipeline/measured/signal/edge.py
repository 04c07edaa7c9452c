"""Where the external force steps in a log: from its previous level to the next, once.

The external force is recovered from the log itself: command plus wall force. It is a step, whatever delay, mass and
sensor do, because the controller computed the wall force from the very positions in the log. It begins at 0, or at the
level of an operating point; the step of a log is the change.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

NO_ROW = -1
"""Edge row of a trial without an identifiable command edge."""

EDGE_SAMPLES = 3
"""Rows for which the external force must stay above half the step: fewer would take a flicker for it."""

LEVEL = 0.02
"""Largest distance from a level, relative to the step, of rows on it: sensors and printed digits stay below."""

LEVEL_ROWS = 20
"""Rows before and behind a jump that show two levels. A velocity over N rows leaves a plateau of N rows behind each
quantum; with as many rows it is too low to be a step."""

JUMP = 0.1
"""Smallest change that is a step or a motion, relative to the step of the log; by B, quanta jump by less. Of a wall
force in another unit, or of another signal, as much is left only where command plus wall force is off its level by more
than `LEVEL`; two steps that differ by less are the same."""

UNDAMPED_JUMP = 0.04
"""The same of a jump between two levels where no B amplifies quanta."""

BENT = 1e-3
"""Departure of a command from the wall law, relative to the step, at one of its limits, by which it is bent: a log in
few digits is rounded by less."""

LISTED_STEPS = 6
"""Steps that a reason lists."""


NEVER = (
    "no command edge: command plus wall force never stays above half the step ({step:g}) for {samples} rows; check "
    "step, stiffness and damping in the log's header"
)
NO_BASELINE = (
    "no baseline, the step is already there in row 0: the command edge is not identifiable; record at least one row "
    "before the step"
)
OTHER_COMMAND = (
    "no command edge: command plus wall force reaches half the step ({step:g}) in row {row}, but the command itself "
    "has not; check the units, the step, and that it is the total command"
)
AGAINST = (
    "no command edge: command plus wall force first jumps against the step ({step:g}), in row {row}; check the sign of "
    "command, position and step"
)
"""Why a log has no edge."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Row of the command edge (-1 for none), level before it, number of steps, and why there is no edge, shape (n,)."""

    row: Integers
    level: Floats
    steps: Integers
    reason: tuple[str, ...]


def external_force(batch: TrialBatch) -> Floats:
    """Return command plus wall force, shape (n, N) [N, Nm]: the external step as the controller added it.

    The wall force is K (x_k - x_0) + B (x_k - x_{k-1})/T with x_{-1} = x_0.
    """
    change = np.diff(batch.position, axis=1, prepend=batch.position[:, :1])
    damping_per_sample = batch.damping / batch.sampling_period_s
    return batch.command + batch.stiffness[:, None] * batch.displacement + damping_per_sample[:, None] * change


def find_edges(batch: TrialBatch) -> Edges:
    """Find the one step of each trial.

    Parameters
    ----------
    batch : TrialBatch

    Notes
    -----
    The edge is the first row from which on the external force stays above half the step. Where it begins on another
    level than 0, as at an operating point, the edge is the first row in which it leaves that, by the step. Two or more
    jumps between levels are several steps, which no row tells apart.
    """
    external = external_force(batch)
    sign, half = np.sign(batch.step)[:, None], 0.5 * np.abs(batch.step)[:, None]
    towards = np.nan_to_num(external * sign)
    first, found = _first_run(towards > half)
    opposite, against = _first_run(towards < -half)
    against &= opposite < first
    moves = _moves(batch, towards, half, first + EDGE_SAMPLES)
    row = np.where(found & (first > 0) & moves & ~against, first, NO_ROW).astype(np.int64)
    level, count = np.zeros(len(batch)), np.zeros(len(batch), dtype=np.int64)
    reasons = []
    for i, step in enumerate(batch.step.tolist()):
        force, reason = external[i, : batch.rows[i]], ""
        steps = _steps(force, step, batch.damping[i]) if step else []
        count[i] = len(steps)
        if step == 0:
            reason = "no step was commanded (step is 0)"
        elif len(steps) > 1:
            row[i], reason = NO_ROW, _told(force, steps)
        elif (raised := _from_level(force, step)) is not None:
            row[i], level[i], reason = raised
        elif row[i] != NO_ROW:
            level[i] = level_before(force, int(row[i]), step)
        elif not found[i]:
            reason = NEVER.format(step=step, samples=EDGE_SAMPLES)
        else:
            why = NO_BASELINE if first[i] == 0 else OTHER_COMMAND if not moves[i] else AGAINST
            reason = why.format(step=step, row=opposite[i] if why is AGAINST else first[i])
        reasons.append(reason)
    return Edges(row, level, count, tuple(reasons))


def _moves(batch: TrialBatch, towards: Floats, half: Floats, until: Integers) -> Booleans:
    """Return whether the command itself takes part in a force that reaches half the step, shape (n,).

    Where it has a wrong unit or is another signal, the wall force alone crosses half the step, only later; a chatter
    before the step may be larger than it, of either sign. Of a slow ramp the wall takes before it reaches half the
    step; what stays on its level while the command still moves is no wall force either.
    """
    column, command = np.arange(towards.shape[1])[None, :], np.nan_to_num(np.abs(batch.command))
    early = column < until[:, None]
    off = batch.valid & ~(np.abs(towards - 2 * half) <= 2 * LEVEL * half)
    behind = batch.valid & (column > np.max(np.where(off, column, -1), axis=1, initial=-1)[:, None])
    moves = ((command > half) & early) | ((command > 2 * JUMP * half) & behind)
    return np.asarray(np.any(moves, axis=1, keepdims=True)[:, 0])


def level_before(force: Floats, row: int, step: float) -> float:
    """Return the level of a force in the rows before one [N, Nm]; 0 where it is on none, or on one near to 0."""
    near = LEVEL * abs(step)
    level = float(np.median(force[:row])) if row > 0 else 0.0
    return level if abs(level) > near and np.abs(force[:row] - level).max() <= near else 0.0


def _from_level(force: Floats, step: float) -> tuple[int, float, str] | None:
    """Return edge, level before it, and why there is no edge, for a force that begins on a level and jumps to another.

    None where it begins near 0, or does not jump.
    """
    start = level_before(force, EDGE_SAMPLES, step)
    if start == 0:
        return None
    away, leaves = _first_run((np.abs(force - start) > LEVEL * abs(step))[None, :])
    edge = int(away[0])
    reached = force[edge : edge + EDGE_SAMPLES]
    if not leaves[0] or np.ptp(reached) > LEVEL * abs(step):
        return None
    jump = float(np.median(reached)) - start
    if abs(jump - step) <= JUMP * abs(step):
        return edge, start, ""
    return (
        *(NO_ROW, 0.0),
        f"no command edge: command plus wall force goes from {start:.4g} to {start + jump:.4g} in row {edge}, a change "
        f"of {jump:.4g}, but the step is {step:g}; the step of a log is the change",
    )


def first_step_alone(batch: TrialBatch) -> TrialBatch:
    """Return a trial with several steps up to its second one."""
    force = external_force(batch)[0, : batch.rows[0]]
    return batch.window(0, _steps(force, float(batch.step[0]), batch.damping[0])[1])


def _steps(force: Floats, step: float, damping: float) -> list[int]:
    """Return the rows in which a force jumps from a level to another one."""
    smallest = JUMP if damping else UNDAMPED_JUMP
    near = LEVEL * abs(step)
    rows = np.flatnonzero(np.abs(np.diff(force)) > smallest * abs(step)) + 1
    if len(rows) < 2:
        return [int(row) for row in rows]
    before = (force[max(row - LEVEL_ROWS, 0) : row] for row in rows)
    behind = (force[row : row + LEVEL_ROWS] for row in rows)
    return [
        int(row)
        for row, a, b in zip(rows, before, behind, strict=True)
        if np.ptp(a) <= near and np.ptp(b) <= near and min(len(a), len(b)) >= EDGE_SAMPLES
    ]


def _told(force: Floats, steps: list[int]) -> str:
    ends = [*steps[1:], len(force)]
    levels = [
        float(np.median(force[: steps[0]])),
        *(float(np.median(force[a:b])) for a, b in zip(steps, ends, strict=True)),
    ]
    told = [f"row {row} ({a:.4g} to {b:.4g})" for row, (a, b) in zip(steps, pairwise(levels), strict=True)]
    more = f" and {len(told) - LISTED_STEPS} more" if len(told) > LISTED_STEPS else ""
    return (
        f"several steps: {', '.join(told[:LISTED_STEPS])}{more}; cut the log into one step each, by [[steps]] of a "
        "profile or by recording them apart"
    )


def lasting(rows: Booleans, samples: int) -> Booleans:
    """Return the rows from which on so many are true, shape (n, N)."""
    padded = np.pad(rows, ((0, 0), (0, samples)))
    runs = np.lib.stride_tricks.sliding_window_view(padded, samples, axis=1)[:, :-1]
    return np.asarray(runs.all(axis=2))


def _first_run(rows: Booleans) -> tuple[Integers, Booleans]:
    """Return the first row from which on `EDGE_SAMPLES` rows are true, shape (n,), and whether there is one."""
    stays = lasting(rows, EDGE_SAMPLES)
    first = np.argmax(stays, axis=1) if stays.shape[1] else np.zeros(len(stays))
    found: Booleans = np.any(stays, axis=1, keepdims=True)[:, 0]
    return first.astype(np.int64), found
