"""Signals that are missing or constant, logs too short for any model, a coarse sensor, and a sign that is reversed."""

from __future__ import annotations

import numpy as np

from pipeline.recording.motion import ARITHMETIC, free_response
from pipeline.recording.samples import Samples, middle
from pipeline.records.findings import Finding

FEWEST_ROWS = 8
"""Rows below which no model of a device has more equations than numbers."""

COARSE = 0.05
"""Step of the sensor relative to the range of the position from which on it is coarse."""

CLEAR = 8.0
"""Standard deviations of noise, and steps of the sensor, by which a first motion is clear."""

OTHER_SIGN = 2.5
"""Residual with the sign of the log relative to that with the other one from which on the other one is right."""

DRIVEN = 3.0
"""Residual without a command relative to that with it against the motion from which on the motion is its answer."""

AS_GOOD = 1.3
"""Residual of the best likely delay against the motion relative to that of any delay, of either sign, at most."""

BASELINE = 5
"""Fewest rows at rest before a step that show noise."""


def unusable_signal(samples: Samples) -> Finding | None:
    """Return why nothing can be computed from a log: too few rows, no motion, or no command."""
    rows = len(samples)
    if rows < FEWEST_ROWS:
        return samples.finding(
            "too_few_rows",
            "unusable",
            f"The log has {rows} rows; a model needs at least {FEWEST_ROWS}.",
            "Record longer.",
        )
    if samples.range == 0:
        return samples.finding(
            "constant_position",
            "unusable",
            f"The position is {samples.position[0]:.6g} in all {rows} rows.",
            "Record larger steps, with a finer sensor, or name the column of the position in the profile.",
        )
    if samples.step != 0 and not samples.command.any():
        return samples.finding(
            "constant_command",
            "unusable",
            f"The command is 0 in all {rows} rows, and a step of {samples.step:.6g} is stated.",
            "Name the column of the command in the profile (columns.command).",
        )
    return None


def same_samples(rows: int, other: str) -> Finding:
    """Return that all samples of a log are those of another one."""
    return Finding(
        code="same_samples",
        first_row=None,
        rows=rows,
        evidence=f"Each sample is that of {other}: a copy under another name or header, or a simulation without noise.",
        remedy="Remove the one that is wrong; two copies count twice.",
        severity="note",
    )


def coarse_sensor(samples: Samples) -> Finding | None:
    """Return whether the position takes so few values that its resolution is a large part of the motion."""
    # values of a fine sensor differ; as many equal ones as steps in the range are those of a coarse one
    if samples.least_change <= COARSE * samples.range:
        return None
    values = 1 + np.count_nonzero(np.diff(np.sort(np.round(samples.position / samples.least_change * 64))))
    return samples.finding(
        "coarse_sensor",
        "note",
        f"The position takes {values} values in a range of {samples.range:.4g}, {samples.least_change:.4g} apart.",
        "Record larger steps, or with a finer sensor.",
    )


def wrong_sign(samples: Samples) -> Finding | None:
    """Return whether the position moves against its command.

    In free motion by the response to all commands at likely delays; behind a wall by its law, or by the first motion
    from rest after the step.
    """
    if samples.obeys_wall:
        return None
    remedy = "Set the other `sign` of the command or of the position in the profile."
    if samples.is_free:
        response = free_response(samples)
        if response is None or response.residual_undriven <= DRIVEN * response.residual_against:
            return None
        # a motion without noise is explained but for the rounding of its sums
        rounding = ARITHMETIC * response.motion
        if response.residual_with <= max(OTHER_SIGN * response.residual_against, rounding):
            return None
        if response.residual_against > AS_GOOD * response.residual:
            return None
        evidence = "The position moves against its command: its acceleration has the other sign in all of the log."
    elif samples.obeys_reversed_wall:
        jump = samples.jumps - samples.wall_steps
        towards = float(jump[np.abs(jump).argmax()] * samples.step)
        column = "position" if towards > 0 else "command" if towards < 0 else "command or position"
        evidence = f"The command obeys the wall with the other sign: the sign of the {column} is reversed."
        remedy = f"Set the other `sign` of the {column} in the profile."
    else:
        row = _first_motion_against(samples)
        if row is None:
            return None
        evidence = f"The position moves against its command, first in row {row} after the step."
    return samples.finding("wrong_sign", "unsafe", evidence, remedy)


def _first_motion_against(samples: Samples) -> int | None:
    """Return the row in which the position first leaves its rest, where that is against the step."""
    edge, x = samples.wall_edge, samples.position
    if edge < BASELINE:
        return None
    rest, noise = middle(x[:edge]), float(x[:edge].max() - x[:edge].min())
    moved = x[edge:] - rest
    clear = np.flatnonzero(np.abs(moved) > CLEAR * max(noise, samples.least_change))[:1]
    # behind a stiff wall a coarse sensor sees the first motion in its first steps, and later any
    first = np.flatnonzero(np.abs(moved) > max(2 * noise, 0.5 * samples.least_change))[:1]
    towards = samples.jumps[edge - 1]
    if not len(clear) or moved[clear[0]] * towards > 0 or moved[first[0]] * towards > 0:
        return None
    return edge + int(clear[0])
