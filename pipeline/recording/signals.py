"""Find missing or constant signals, logs that are too short for any model, a coarse sensor, and a reversed sign."""

from __future__ import annotations

import numpy as np

from pipeline.recording.motion import ARITHMETIC, free_response
from pipeline.recording.samples import Samples, middle
from pipeline.records.findings import Finding

FEWEST_ROWS = 8
"""Smallest number of rows at which a device model has more equations than parameters."""

COARSE = 0.05
"""Sensor step, relative to the range of the position, above which the sensor is called coarse."""

CLEAR = 8.0
"""Smallest displacement of a clear first motion, in noise standard deviations and in sensor steps."""

OTHER_SIGN = 2.5
"""Threshold for the ratio of the residuals with the logged and with the opposite sign. Above it, the opposite sign is
correct."""

DRIVEN = 3.0
"""Threshold for the ratio of the residuals without a command and with a reversed command. Above it, the motion is a
response to the command."""

AS_GOOD = 1.3
"""Largest ratio of the residual for the best plausible delay with a reversed sign to the residual for the best of all
delays."""

BASELINE = 5
"""Smallest number of rows at rest before a step for an estimate of the noise."""


def unusable_signal(samples: Samples) -> Finding | None:
    """Return a finding if a log is unusable because it has too few rows, no motion, or no command."""
    rows = len(samples)
    if rows < FEWEST_ROWS:
        return samples.finding(
            "too_few_rows",
            "unusable",
            f"The log has {rows} rows, but a model requires at least {FEWEST_ROWS}.",
            "Record longer logs.",
        )
    if samples.range == 0:
        return samples.finding(
            "constant_position",
            "unusable",
            f"The position is {samples.position[0]:.6g} in all {rows} rows.",
            "Record larger steps, use a finer sensor, or set the column of the position in the profile.",
        )
    if samples.step != 0 and not samples.command.any():
        return samples.finding(
            "constant_command",
            "unusable",
            f"The command is 0 in all {rows} rows, but a step of {samples.step:.6g} is stated.",
            "Set the column of the command in the profile (columns.command).",
        )
    return None


def same_samples(rows: int, other: str) -> Finding:
    """Return the finding that all samples of a log equal those of another log."""
    return Finding(
        code="same_samples",
        first_row=None,
        rows=rows,
        evidence=(
            f"All samples equal those of {other}, so one is a copy with a different name or header, or both are "
            "simulations without noise."
        ),
        remedy="Remove the wrong log, because two copies count twice.",
        severity="note",
    )


def coarse_sensor(samples: Samples) -> Finding | None:
    """Return a finding if the resolution of the sensor is a large share of the motion, so that few values are
    distinct."""
    # The readings of a coarse sensor repeat, because the range of the position has few steps.
    if samples.least_change <= COARSE * samples.range:
        return None
    values = 1 + np.count_nonzero(np.diff(np.sort(np.round(samples.position / samples.least_change * 64))))
    return samples.finding(
        "coarse_sensor",
        "note",
        f"The position has only {values} distinct values in a range of {samples.range:.4g}, at a distance of "
        f"{samples.least_change:.4g}.",
        "Record larger steps, or use a finer sensor.",
    )


def wrong_sign(samples: Samples) -> Finding | None:
    """Return a finding if the position moves against its command.

    A free motion is tested by its response to all commands at likely delays. A trial with a wall is tested by the wall
    law, or by the first motion from rest after the step.
    """
    if samples.obeys_wall:
        return None
    remedy = "Change the `sign` of the command or of the position in the profile."
    if samples.is_free:
        response = free_response(samples)
        if response is None or response.residual_undriven <= DRIVEN * response.residual_against:
            return None
        # for a motion without noise, the residual consists only of rounding errors of the sums
        rounding = ARITHMETIC * response.motion
        if response.residual_with <= max(OTHER_SIGN * response.residual_against, rounding):
            return None
        if response.residual_against > AS_GOOD * response.residual:
            return None
        evidence = (
            "The position moves against its command, because its acceleration has the opposite sign in the whole log."
        )
    elif samples.obeys_reversed_wall:
        jump = samples.jumps - samples.wall_steps
        towards = float(jump[np.abs(jump).argmax()] * samples.step)
        column = "position" if towards > 0 else "command" if towards < 0 else "command or position"
        evidence = f"The command follows the wall with the opposite sign, so the sign of the {column} is reversed."
        remedy = f"Change the `sign` of the {column} in the profile."
    else:
        row = _first_motion_against(samples)
        if row is None:
            return None
        evidence = f"The position moves against its command, first in row {row} after the step."
    return samples.finding("wrong_sign", "unsafe", evidence, remedy)


def _first_motion_against(samples: Samples) -> int | None:
    """Return the row in which the position first leaves rest if it then moves against the step, otherwise None."""
    edge, x = samples.wall_edge, samples.position
    if edge < BASELINE:
        return None
    rest, noise = middle(x[:edge]), float(x[:edge].max() - x[:edge].min())
    moved = x[edge:] - rest
    clear = np.flatnonzero(np.abs(moved) > CLEAR * max(noise, samples.least_change))[:1]
    # at a stiff wall, only the first steps of a coarse sensor show the initial direction
    first = np.flatnonzero(np.abs(moved) > max(2 * noise, 0.5 * samples.least_change))[:1]
    towards = samples.jumps[edge - 1]
    if not len(clear) or moved[clear[0]] * towards > 0 or moved[first[0]] * towards > 0:
        return None
    return edge + int(clear[0])
