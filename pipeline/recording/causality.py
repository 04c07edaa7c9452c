"""Does the position respond before its command? Then no delay, and no limit of a wall, follows from the log."""

from __future__ import annotations

import numpy as np

from pipeline.recording.growth import acceleration, growth_before_edges, growth_from_rest, last_at_rest
from pipeline.recording.motion import free_response
from pipeline.recording.samples import LAW_RESIDUAL, Samples, middle
from pipeline.records.findings import Finding, FindingCode

BASELINE = 8
"""Fewest rows at rest before an edge that show whether the position leaves its rest too early."""

LIKELIER = 6.0
"""Logarithm of the likelihood ratio of a growth from rest and a decay that is no chance of a filtered noise."""

SURE = {False: 10.0, True: 18.0}
"""Acceleration of a growth at an edge in standard errors, of a plain one and of one that turns: noise that was filtered
in one direction looks like more than white noise does."""

OF_THE_ANSWER = {False: 0.15, True: 0.015}
"""The same in accelerations of the answer to the edge. A filter of both directions makes up to 0.5 of them, less where
a mode of vibration answers later; noise, which has no share in the answer, makes next to nothing."""

CONVEX, CONVEX_SURE, CONVEX_PART = 4.0, 20.0, 0.1
"""Way at the edge relative to the largest one in the first half of the rows before it, which of a drift is 2, from
which on a growth need not be likelier than a decay, as before few rows; and the two measures above for it."""

SURELY = 30.0
"""Logarithm of the likelihood ratio of a growth and a decay before edges within a motion."""

BETTER = 4.0
"""Sum of squares that the decay leaves before them relative to that of the growth: of more, both explain parts of the
device badly."""

SPREAD = (0.1, 0.75)
"""Acceleration of such a growth in those of the answer."""

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
    answer = acceleration(samples, edge)
    x = samples.position[: last_at_rest(samples, edge) + 1]
    away = np.abs(x - middle(x[: edge // 2]))
    usual = float(away[: edge // 2].max())
    if answer <= 0 or not any(_grows(samples, edge, turning, answer, away[-1] > CONVEX * usual) for turning in SURE):
        return None
    still = np.flatnonzero(away <= max(usual, 1.5 * samples.least_change))
    return edge, min(int(still[-1]) + 1, edge - 1)


def _grows(samples: Samples, edge: int, turning: bool, answer: float, is_convex: bool) -> bool:
    """Return whether the position grows from its rest towards an edge, as a part of the answer to it."""
    growth = growth_from_rest(samples, edge, turning=turning)
    if growth is None or growth.acceleration <= OF_THE_ANSWER[turning] * answer:
        return False
    if growth.acceleration <= SURE[turning] * growth.error:
        return False
    is_clear = growth.acceleration > max(CONVEX_SURE * growth.error, CONVEX_PART * answer)
    return growth.score >= LIKELIER or (is_convex and is_clear)


def _turns_early(samples: Samples) -> tuple[int, float] | None:
    """Return before how many edges a free motion turns towards its answer, and the time constant of that [rows]."""
    response = free_response(samples)
    if response is None or response.gain <= 0:
        return None
    growth = growth_before_edges(samples)
    if growth is None or growth.score < SURELY or growth.ratio < BETTER:
        return None
    part = growth.acceleration / (response.gain * response.largest_jump)
    return (growth.edges, growth.time_constant) if SPREAD[0] < part < SPREAD[1] else None


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
    force = samples.wall_steps
    size = float(np.sqrt(np.mean(force * force)))
    most = min(MOST_LATE, len(samples) // 4)
    if samples.least_wall_residuals(most)[1:].min() > LAW_RESIDUAL * size:
        return None
    rest = samples.wall_residuals(most)
    best = int(np.argmin(rest[1:])) + 1
    return best if rest[best] <= LAW_RESIDUAL * size and CLEARLY_LATE * rest[best] < rest[0] else None
