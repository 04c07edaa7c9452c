"""Detect logs in which the position responds before its command. Neither a delay nor a stability limit can be estimated
from such a log."""

from __future__ import annotations

import numpy as np

from pipeline.recording.growth import acceleration, growth_before_edges, growth_from_rest, last_at_rest
from pipeline.recording.motion import free_response
from pipeline.recording.samples import LAW_RESIDUAL, Samples, middle
from pipeline.records.findings import Finding, FindingCode

BASELINE = 8
"""Smallest number of rows at rest before an edge that is needed to detect an early departure from rest."""

LIKELIER = 6.0
"""Threshold for the log-likelihood ratio of growth to decay of a position at rest. Above it, filtered noise is excluded
as the cause."""

SURE = {False: 10.0, True: 18.0}
"""Threshold of the acceleration of a growth at an edge, in standard errors, for exponential and for oscillating growth.
The threshold is high because noise that was filtered in one direction is correlated."""

OF_THE_ANSWER = {False: 0.15, True: 0.015}
"""Threshold of the acceleration of a growth at an edge, relative to the acceleration of the response to the edge. A
zero-phase filter causes a ratio of up to 0.5, or less if a vibration mode responds later. The ratio caused by noise is
almost 0, because noise is not part of the response."""

CONVEX, CONVEX_SURE, CONVEX_PART = 4.0, 20.0, 0.1
"""Thresholds for few rows. The first threshold applies to the displacement at the edge, relative to the largest
displacement in the first half of the rows before the edge. (A drift has a ratio of 2.) Above this threshold, a growth
need not be more likely than a decay. The other two thresholds then replace `SURE` and `OF_THE_ANSWER`."""

SURELY = 30.0
"""Threshold of the log-likelihood ratio of growth to decay, for edges that occur during a motion."""

BETTER = 4.0
"""Threshold of the ratio of the residual sums of squares of decay and growth. Below it, neither of the two models the
device well."""

SPREAD = (0.1, 0.75)
"""Smallest and largest acceleration of a growth before edges that occur during a motion, relative to the acceleration
of the response."""

EARLY = 0.75
"""Smallest lead of the position (negative fitted delay) that is reported [rows]."""

CLEARLY = (1.15, 1.6)
"""Thresholds of the ratio of the residuals for the best non-negative delay and the best delay. The first threshold
applies if only noise remains, and the second if effects remain that the model does not contain."""

BY_CHANCE = 20.0
"""Log-likelihood ratio above which a difference is not attributed to chance."""

MOST_RESIDUAL = 0.06
"""Largest residual for the best delay, relative to the motion. Above it, parts of the device that are not modelled may
act like a delay."""

CLEARLY_LATE = 5.0
"""Threshold of the ratio between the residual of the wall law for the logged rows and the residual for commands shifted
to earlier rows."""

MOST_LATE = 128
"""Largest delay in the logging of a command that is searched for [rows]."""

REMEDY = (
    "Shift the command column {shift} (or use the time stamps of both channels), and do not use zero-phase filters "
    "(filtfilt) or interpolation."
)


def moves_before_command(samples: Samples) -> Finding | None:
    """Return a finding if the position responds before its command, with the number of rows.

    A position at rest must not leave its baseline before the edge of the command, and a moving position must not leave
    its path before a later edge. In free motion, the delay that fits the log best must not be negative. If the command
    of a wall matches the position in its own row, the controller used this reading, and the log is not examined
    further.
    """
    if samples.obeys_wall:
        return None
    rows = _negative_delay(samples)
    if rows is not None:
        found = (
            f"The position responds {rows:.3g} rows before the command, because the delay that explains the log is "
            "negative."
        )
        return _noncausal(samples, found, f"at least {max(int(np.ceil(rows)), 1)} rows earlier", None)
    early, late = _leaves_rest(samples), _late_command(samples)
    shift = None if late is None else f"{late} rows earlier"
    if early is not None:
        edge, row = early
        found = f"The position starts to move in row {row}, {edge - row} rows before the command changes (row {edge})."
        return _noncausal(samples, found, shift or f"at least {edge - row} rows earlier", row)
    if shift is not None:
        found = (
            f"The command follows the wall law with the position of {late} rows before, so the command was logged late."
        )
        return _noncausal(samples, found, shift, None, "command_shifted")
    ahead = _turns_early(samples)
    if ahead is not None:
        edges, constant = ahead
        found = (
            f"Before each of {edges} edges of the command, the position already turns towards its response, within "
            f"about {constant:.2g} rows, so the position was filtered in both directions."
        )
        return _noncausal(samples, found, "if the command was logged late", None)
    return None


def _noncausal(
    samples: Samples, evidence: str, shift: str, row: int | None, code: FindingCode = "noncausal"
) -> Finding:
    return samples.finding(code, "unsafe", evidence, REMEDY.format(shift=shift), first_row=row)


def _leaves_rest(samples: Samples) -> tuple[int, int] | None:
    """Return the first edge and an earlier row in which the position leaves rest, or None if it does not leave rest
    early."""
    edge = _first_edge(samples)
    if edge < BASELINE or edge >= len(samples) - 2:
        return None
    if samples.is_free and samples.command[0] != 0:  # the command moves the device from the first row on
        return None
    answer = acceleration(samples, edge)
    x = samples.position[: last_at_rest(samples, edge) + 1]
    away = np.abs(x - middle(x[: edge // 2]))
    usual = float(away[: edge // 2].max())
    if answer <= 0 or not any(_grows(samples, edge, turning, answer, away[-1] > CONVEX * usual) for turning in SURE):
        return None
    still = np.flatnonzero(away <= max(usual, 1.5 * samples.least_change))
    return edge, min(int(still[-1]) + 1, edge - 1)


def _grows(samples: Samples, edge: int, turning: bool, answer: float, is_convex: bool) -> bool:
    """Return True if the position grows from rest towards an edge as if it were part of the response to the edge."""
    growth = growth_from_rest(samples, edge, turning=turning)
    if growth is None or growth.acceleration <= OF_THE_ANSWER[turning] * answer:
        return False
    if growth.acceleration <= SURE[turning] * growth.error:
        return False
    is_clear = growth.acceleration > max(CONVEX_SURE * growth.error, CONVEX_PART * answer)
    return growth.score >= LIKELIER or (is_convex and is_clear)


def _turns_early(samples: Samples) -> tuple[int, float] | None:
    """Return the number of edges before which a free motion turns early, and the time constant [rows]."""
    response = free_response(samples)
    if response is None or response.gain <= 0:
        return None
    growth = growth_before_edges(samples)
    if growth is None or growth.score < SURELY or growth.ratio < BETTER:
        return None
    part = growth.acceleration / (response.gain * response.largest_jump)
    return (growth.edges, growth.time_constant) if SPREAD[0] < part < SPREAD[1] else None


def _first_edge(samples: Samples) -> int:
    """Return the row in which the command first changes (log without a wall) or steps (log with a wall), or 0 if there
    is no such row."""
    if samples.is_free:
        changes = np.flatnonzero(samples.jumps)
        return int(changes[0]) + 1 if len(changes) else 0
    return samples.wall_edge


def _negative_delay(samples: Samples) -> float | None:
    """Return the lead of the position in free motion [rows], or None if a non-negative delay fits equally well."""
    response = free_response(samples)
    if response is None or not response.is_driven or response.gain <= 0 or response.delay > -EARLY:
        return None
    ratio = response.residual_causal / max(response.residual, 1e-12 * response.motion)
    if response.rows * np.log(ratio) < BY_CHANCE:
        return None
    if response.is_at_noise:
        return -response.delay if ratio >= CLEARLY[0] else None
    return -response.delay if ratio >= CLEARLY[1] and response.residual <= MOST_RESIDUAL * response.motion else None


def _late_command(samples: Samples) -> int | None:
    """Return the number of rows by which the command of a wall lags its position, or None if it does not lag or no wall
    law fits.

    If the controller applies the wall law u_k = F - K (x_k - x_0) - B (x_k - x_(k-1))/T, the command of a row belongs
    to the position of that row. With a filter, clipping or a different wall, the residual is larger for every shift.
    """
    if samples.is_free or samples.obeys_wall:
        return None
    force = samples.wall_steps
    size = float(np.sqrt(np.mean(force * force)))
    most = min(MOST_LATE, len(samples) // 4)
    if samples.least_wall_residuals(most)[1:].min() > LAW_RESIDUAL * size:
        return None
    rest = samples.wall_residuals(most)
    best = int(np.argmin(rest[1:])) + 1
    return best if rest[best] <= LAW_RESIDUAL * size and CLEARLY_LATE * rest[best] < rest[0] else None
