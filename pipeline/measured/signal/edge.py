"""Detect the single step of the external force in a log, from one level to another.

The external force is reconstructed from the log as the command plus the wall force. It is a step for any delay, mass
and sensor, because the controller computed the wall force from the positions in the log. It begins at 0 or at the level
of an operating point. The step of a log is the change of the level.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.recording.samples import middle
from pipeline.records.trials import Booleans, Floats, Integers, Trial

NO_ROW = -1
"""Edge row of a trial without an identifiable command edge."""

EDGE_SAMPLES = 3
"""Smallest number of rows in which the external force must stay above half the step. Fewer rows may be a glitch."""

LEVEL = 0.02
"""Largest deviation from a level, relative to the step. Sensors and printed digits cause smaller deviations."""

LEVEL_ROWS = 20
"""Number of rows before and after a jump that are examined for two levels. With a velocity over N rows, each quantum
causes a plateau of N rows. If N is this large, the plateau is too low for a step."""

JUMP = 0.1
"""Smallest change that counts as a step or a motion, relative to the step of the log. Quanta that are amplified by B
cause smaller jumps. Two steps whose difference is smaller are treated as equal. If the command has a wrong unit or is
another signal, it exceeds this value only while command plus wall force deviates from its level by more than
`LEVEL`."""

UNDAMPED_JUMP = 0.04
"""Smallest relative jump between two levels if B = 0, so that quanta are not amplified."""

BENT = 1e-3
"""Smallest deviation of a command from the wall law, relative to the step, at which the command counts as limited.
Rounding of a log with few digits causes smaller deviations."""

LISTED_STEPS = 6
"""Largest number of steps that a reason lists."""


NEVER = (
    "no command edge: command plus wall force never stays above half the step ({step:g}) for {samples} rows; check "
    "step, stiffness and damping in the header of the log"
)
NO_BASELINE = (
    "no baseline: the step has already occurred in row 0, so the command edge is not identifiable; record at least one "
    "row before the step"
)
OTHER_COMMAND = (
    "no command edge: command plus wall force reaches half the step ({step:g}) in row {row}, but the command does not; "
    "check the units, the step, and whether the column contains the total command"
)
AGAINST = (
    "no command edge: command plus wall force first jumps against the step ({step:g}), in row {row}; check the sign of "
    "command, position and step"
)
"""Reasons why a log has no edge."""


@dataclass(frozen=True)
class Edge:
    """Row of the command edge (-1 if none), level before it [N, Nm], number of steps, and the reason if there is no
    edge."""

    row: int
    level: float
    steps: int
    reason: str


def external_force(trial: Trial) -> Floats:
    """Return command plus wall force, shape (rows,) [N, Nm], i.e. the external step that the controller added.

    The wall force is K (x_k - x_0) + B (x_k - x_{k-1})/T with x_{-1} = x_0.
    """
    damping_per_sample = trial.damping / trial.sampling_period_s
    return trial.command + trial.stiffness * trial.displacement + damping_per_sample * position_change(trial)


def position_change(trial: Trial) -> Floats:
    """Return the change of the position since the previous row, shape (rows,) [m, rad], or 0 in the first row."""
    change = np.zeros_like(trial.position)
    np.subtract(trial.position[1:], trial.position[:-1], out=change[1:])
    return change


def find_edge(trial: Trial) -> Edge:
    """Find the single step of a trial.

    Parameters
    ----------
    trial : Trial

    Notes
    -----
    The edge is the first row from which the external force stays above half the step. If the force begins at a level
    other than 0, e.g. at an operating point, the edge is the first row in which it leaves this level by the step. Two
    or more jumps between levels are several steps, which a single edge row cannot represent.
    """
    step = trial.step
    if step == 0:
        return Edge(NO_ROW, 0.0, 0, "no step was commanded (step is 0)")
    force = external_force(trial)
    steps = _steps(force, step, trial.damping)
    if len(steps) > 1:
        return Edge(NO_ROW, 0.0, len(steps), _list_steps(force, steps))
    raised = _from_level(force, step)
    if raised is not None:
        return Edge(raised[0], raised[1], len(steps), raised[2])
    towards, half = force * np.sign(step), 0.5 * abs(step)
    row = first_run(towards > half)
    opposite = first_run(towards < -half)
    reason = ""
    if row == NO_ROW:
        reason = NEVER.format(step=step, samples=EDGE_SAMPLES)
    elif row == 0:
        reason = NO_BASELINE
    elif not _moves(trial, towards, half, row + EDGE_SAMPLES):
        reason = OTHER_COMMAND.format(step=step, row=row)
    elif NO_ROW < opposite < row:
        reason = AGAINST.format(step=step, row=opposite)
    if reason:
        return Edge(NO_ROW, 0.0, len(steps), reason)
    return Edge(row, level_before(force, row, step), len(steps), "")


def _moves(trial: Trial, towards: Floats, half: float, until: int) -> bool:
    """Return whether the command contributes to the change of an external force that reaches half the step.

    If the command has a wrong unit or is another signal, the wall force alone crosses half the step, but later. Chatter
    before the step may exceed the step with either sign. With a slow ramp, the wall responds before the ramp reaches
    half the step. If the force stays at its level while the command is still large, the command is part of this force.
    """
    command = np.abs(trial.command)
    if (command[:until] > half).any():
        return True
    off = np.flatnonzero(np.abs(towards - 2 * half) > 2 * LEVEL * half)
    behind = int(off[-1]) + 1 if len(off) else 0
    return bool((command[behind:] > 2 * JUMP * half).any())


def level_before(force: Floats, row: int, step: float) -> float:
    """Return the level of a force before a row [N, Nm], or 0 if it has no level, or a level close to 0."""
    near = LEVEL * abs(step)
    level = middle(force[:row]) if row > 0 else 0.0
    return level if abs(level) > near and np.abs(force[:row] - level).max() <= near else 0.0


def _from_level(force: Floats, step: float) -> tuple[int, float, str] | None:
    """Return the edge, the level before it, and the reason for no edge, if the force jumps between two levels.

    The result is None if the force begins near 0 or does not jump.
    """
    start = level_before(force, EDGE_SAMPLES, step)
    if start == 0:
        return None
    edge = first_run(np.abs(force - start) > LEVEL * abs(step))
    reached = force[edge : edge + EDGE_SAMPLES]
    if edge == NO_ROW or np.ptp(reached) > LEVEL * abs(step):
        return None
    jump = middle(reached) - start
    if abs(jump - step) <= JUMP * abs(step):
        return edge, start, ""
    return (
        *(NO_ROW, 0.0),
        f"no command edge: command plus wall force goes from {start:.4g} to {start + jump:.4g} in row {edge}, a change "
        f"of {jump:.4g}, but the step is {step:g}; set the step of the log to this change",
    )


def first_step_alone(trial: Trial) -> Trial:
    """Return a trial with several steps, truncated before the second step."""
    return trial.window(0, _steps(external_force(trial), trial.step, trial.damping)[1])


def _steps(force: Floats, step: float, damping: float) -> list[int]:
    """Return the rows in which a force jumps from one level to another."""
    smallest = JUMP if damping else UNDAMPED_JUMP
    rows = np.flatnonzero(np.abs(force[1:] - force[:-1]) > smallest * abs(step)) + 1
    if len(rows) >= 2:
        rows = rows[_between_levels(force, rows, LEVEL * abs(step), LEVEL_ROWS, EDGE_SAMPLES)]
    return [int(row) for row in rows]


@compiled("b1[::1](f8[::1], i8[::1], f8, i8, i8)")
def _between_levels(force: Floats, rows: Integers, near: float, most: int, fewest: int) -> Booleans:
    """Return whether a force is constant before and after each of the given rows.

    Parameters
    ----------
    force : float64, shape (rows of the trial,)
    rows : int64, shape (jumps,)
        First row after each jump.
    near : float
        Largest range of a level [N, Nm].
    most, fewest : int
        Number of rows that are examined on either side, and smallest number of existing rows.
    """
    result = np.ones(len(rows), dtype=np.bool_)
    for jump in range(len(rows)):
        row = rows[jump]
        for first, end in ((max(row - most, 0), row), (row, min(row + most, len(force)))):
            low = high = force[first]
            for k in range(first, end):
                low, high = min(low, force[k]), max(high, force[k])
            if high - low > near or end - first < fewest:
                result[jump] = False
    return result


def _list_steps(force: Floats, steps: list[int]) -> str:
    ends = [*steps[1:], len(force)]
    levels = [
        middle(force[: steps[0]]),
        *(middle(force[a:b]) for a, b in zip(steps, ends, strict=True)),
    ]
    listed = [f"row {row} ({a:.4g} to {b:.4g})" for row, (a, b) in zip(steps, pairwise(levels), strict=True)]
    more = f" and {len(listed) - LISTED_STEPS} more" if len(listed) > LISTED_STEPS else ""
    return (
        f"several steps: {', '.join(listed[:LISTED_STEPS])}{more}; divide the log into parts with one step each, by "
        "[[steps]] in a profile, or record the steps separately"
    )


def lasting(rows: Booleans, samples: int) -> Booleans:
    """Return whether ``samples`` consecutive rows are true from each row on, shape (rows,)."""
    result = rows.copy()
    for ahead in range(1, samples):
        result[:-ahead] &= rows[ahead:]
        result[-ahead:] = False
    return result


def first_run(rows: Booleans) -> int:
    """Return the first row from which `EDGE_SAMPLES` consecutive rows are true, or -1 if there is none.

    >>> first_run(np.array([True, False, True, True, True, True]))
    2
    """
    stays = lasting(rows, EDGE_SAMPLES)
    first = int(stays.argmax()) if len(stays) else 0
    return first if len(stays) and stays[first] else NO_ROW
