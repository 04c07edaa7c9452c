"""Does the position respond before its command? Then no delay, and no limit of a wall, follows from the log."""

from __future__ import annotations

import numpy as np

from pipeline.recording.growth import acceleration, growth_before_edges, growth_from_rest
from pipeline.recording.motion import free_response
from pipeline.recording.samples import LAW_RESIDUAL, Samples, middle
from pipeline.records.findings import Finding, FindingCode

BASELINE = 8
"""Fewest rows at rest before an edge that show whether the position leaves its rest too early."""

LIKELIER = 6.0
"""Logarithm of the likelihood ratio of a growth from rest and a decay that is no chance of a filtered noise."""

CLEAR = (6.0, 20.0)
"""Way of a growth from rest in standard deviations of what it leaves: where it is likelier than a decay, and where it is
not, as before few rows, but convex."""

CONVEX = 4.0
"""Way at the edge relative to the largest one in the first half of the rows before it: a drift goes twice as far."""

OF_THE_ANSWER = 0.15
"""Least way of a growth in accelerations by the edge times its squared time constant: a filter of both directions
spreads half of it before the edge, and a motion that is rows ahead has gone farther. Noise goes any way."""

SURELY = 30.0
"""Logarithm of the likelihood ratio of a growth and a decay before edges within a motion."""

BETTER = 5.0
"""Sum of squares that the decay leaves before them relative to that of the growth: of more, both explain parts of the
device badly."""

SPREAD = (0.3, 1.0)
"""Way of such a growth in the same measure: a filter of both directions makes 0.5."""

EARLY = 0.75
"""Rows by which a fitted delay is negative from which on the position comes first."""

CLEARLY = (1.15, 1.6)
"""Residual of the best delay of 0 and more relative to that of the best one: where nothing but noise is left, and where
parts of the device are."""

BY_CHANCE = 20.0
"""Logarithm of the ratio of both likelihoods that is no chance."""

MOST_RESIDUAL = 0.06
"""Largest part of the motion that the best delay may leave: of more, parts of the device may look like a delay."""

CLEARLY_LATE = 5.0
"""What the law leaves with the rows as they are relative to that with the command some rows earlier."""

MOST_LATE = 128
"""Largest number of rows by which a command is looked for to be late."""

REMEDY = (
    "Shift the command column {shift} (or take the time stamps of both channels), and leave out zero-phase filters "
    "(filtfilt) and interpolation."
)


def moves_before_command(samples: Samples) -> Finding | None:
    """Return whether the position responds before its command, and by how many rows.

    From rest the position may not leave its baseline before the edge of the command, nor its way before a later one. In
    free motion the delay that explains the whole log best, a negative one included, may not be negative. A wall whose
    command is that of the position in its row acted on that very reading.
    """
    if samples.obeys_wall:
        return None
    rows = _negative_delay(samples)
    if rows is not None:
        found = (
            f"The position responds {rows:.3g} rows before the command: the delay that explains the log is negative."
        )
        return _noncausal(samples, found, f"at least {max(int(np.ceil(rows)), 1)} rows earlier", None)
    early, late = _leaves_rest(samples), _late_command(samples)
    shift = None if late is None else f"{late} rows earlier"
    if early is not None:
        edge, row = early
        found = f"The position leaves its rest in row {row}, {edge - row} rows before the command changes (row {edge})."
        return _noncausal(samples, found, shift or f"at least {edge - row} rows earlier", row)
    if shift is not None:
        found = f"The command obeys the wall with the position {late} rows before: it was logged that much late."
        return _noncausal(samples, found, shift, None, "command_shifted")
    ahead = _turns_early(samples)
    if ahead is not None:
        edges, constant = ahead
        found = (
            f"Before each of {edges} edges of the command the position already turns towards its answer, within about "
            f"{constant:.2g} rows: it was filtered in both directions."
        )
        return _noncausal(samples, found, "if it was logged late", None)
    return None


def _noncausal(
    samples: Samples, evidence: str, shift: str, row: int | None, code: FindingCode = "noncausal"
) -> Finding:
    return samples.finding(code, "unsafe", evidence, REMEDY.format(shift=shift), first_row=row)


def _leaves_rest(samples: Samples) -> tuple[int, int] | None:
    """Return the first edge, and the row in which the position leaves its rest before; None where it does not."""
    edge = _first_edge(samples)
    if edge < BASELINE or edge >= len(samples) - 2:
        return None
    if samples.is_free and samples.command[0] != 0:  # which moves the device from the first row on
        return None
    growth = growth_from_rest(samples, edge)
    if growth is None or growth.amplitude <= CLEAR[0] * growth.noise:
        return None
    x = samples.position[: edge + 1]
    away = np.abs(x - middle(x[: edge // 2]))
    is_convex = growth.amplitude > CLEAR[1] * growth.noise and away[-1] > CONVEX * away[: edge // 2].max()
    if growth.score < LIKELIER and not is_convex:
        return None
    if growth.amplitude <= max(OF_THE_ANSWER * acceleration(samples, edge) * growth.time_constant**2, 0.0):
        return None
    clear = max(0.5 * CLEAR[0] * growth.noise, 1.5 * samples.least_change)
    still = np.flatnonzero(away <= clear)
    row = int(still[-1]) + 1 if len(still) else 0
    return edge, min(row, edge - 1)


def _turns_early(samples: Samples) -> tuple[int, float] | None:
    """Return before how many edges a free motion turns towards its answer, and the time constant of that [rows]."""
    response = free_response(samples)
    if response is None or response.gain <= 0:
        return None
    growth = growth_before_edges(samples)
    if growth is None or growth.score < SURELY or growth.ratio < BETTER:
        return None
    of_answer = growth.amplitude / (response.gain * response.largest_jump * growth.time_constant**2)
    return (growth.edges, growth.time_constant) if SPREAD[0] < of_answer < SPREAD[1] else None


def _first_edge(samples: Samples) -> int:
    """Return the row in which a free command first changes, or in which that of a wall steps; 0 for none."""
    if samples.is_free:
        changes = np.flatnonzero(samples.jumps)
        return int(changes[0]) + 1 if len(changes) else 0
    return samples.wall_edge


def _negative_delay(samples: Samples) -> float | None:
    """Return by how many rows the position of a free motion comes first; None where a delay explains it as well."""
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
    """Return by how many rows the command of a wall is late to its position; None where it is not, or no law fits.

    Of a controller that applies the wall law u_k = F - K (x_k - x_0) - B (x_k - x_(k-1))/T the command of a row is that
    of its position. A filter, a clipped or other wall leaves more at any shift.
    """
    if samples.is_free or samples.obeys_wall:
        return None
    force, now = samples.wall_steps, samples.wall_residual(0)
    size = float(np.sqrt(np.mean(force * force)))
    shifts = range(1, min(MOST_LATE, len(samples) // 4) + 1)
    rest = [samples.wall_residual(shift) for shift in shifts]
    best = int(np.argmin(rest))
    return shifts[best] if rest[best] <= LAW_RESIDUAL * size and CLEARLY_LATE * rest[best] < now else None
