"""Does the position respond before its command? Then no delay, and no limit of a wall, follows from the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.recording.motion import free_response, residual_with_impulses
from pipeline.recording.rows import ordinal, spacing
from pipeline.recording.samples import LAW_RESIDUAL, NOISE_GAIN, Samples, middle
from pipeline.records.findings import Finding, FindingCode

BASELINE = 8
"""Fewest rows at rest before an edge that show whether the position leaves its rest too early."""

CLEAR = 8.0
"""Standard deviations of the noise of the baseline by which the position at the edge has left its rest."""

CONVEX = 4.0
"""Way in the second half of the rows before an edge relative to that in the first: a drift is as fast in both."""

FASTER = 3.0
"""Acceleration just before an edge relative to the largest one in the first half of the rows before it."""

GOES_ON = 1.5
"""Largest way from rest behind the edge relative to that before it."""

EARLY = 0.75
"""Rows by which a fitted delay is negative from which on the position comes first."""

CLEARLY = (1.15, 1.6)
"""Residual of the best delay of 0 and more relative to that of the best one: where nothing but noise is left, and where
parts of the device are."""

BY_CHANCE = 20.0
"""Logarithm of the ratio of both likelihoods that is no chance."""

MOST_RESIDUAL = 0.06
"""Largest part of the motion that the best delay may leave: of more, parts of the device may look like a delay."""

AHEAD = 3.2
"""Residual without the commands of the future relative to that with them from which on they move the device."""

LEAST_RESIDUAL = 3e-3
"""Part of the motion below which a residual is that of the regression itself."""

OWN_STEPS = 1.25
"""Residual of a command of ramps on an even grid, relative to that of steps inside them, from which on it was steps."""

MOST_RAMPS = 40
"""Ramps of a command that are taken for steps one by one."""

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

    From rest the position may not leave its baseline before the edge of the command. In free motion the delay that
    explains the whole log best, a negative one included, may not be negative. A wall whose command is that of the
    position in its row acted on that very reading.
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
    if _follows_the_future(samples):
        found = (
            "Commands of later rows explain the motion better than those of the past alone: the position was filtered."
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
    x = samples.position
    half = edge // 2
    rest = middle(x[:half])
    away = np.abs(x[: edge + 1] - rest)
    largest = float(away[half:].max())
    if largest <= 1.5 * samples.least_change:
        return None
    first_half, second = float(away[:half].max()), samples.bend[: edge - 1]
    noise = (float(second @ second) / len(second) / NOISE_GAIN) ** 0.5
    clear = max(CLEAR * noise, 1.5 * samples.least_change)
    if largest <= clear or (largest <= CONVEX * first_half and not _speeds_up(samples, edge, noise)):
        return None
    # the response goes on behind the edge, and is larger there
    ahead = x[edge : edge + 4 * half]
    if float(np.abs(ahead - rest).max()) < GOES_ON * largest:
        return None
    still = np.flatnonzero(away[: half + int(away[half:].argmax())] <= clear)
    row = int(still[-1]) + 1 if len(still) else 0
    return (edge, row) if row < edge else None


def _speeds_up(samples: Samples, edge: int, noise: float) -> bool:
    """Return whether the acceleration grows towards an edge: what is left of an earlier motion only decays.

    A filter of both directions spreads a response over all rows before it.
    """
    width = max(edge // 8, 2)
    x = samples.position[: edge + 1]
    bend = np.abs(x[2 * width :] - 2 * x[width:-width] + x[: -2 * width])
    last = float(bend[-max(width // 2, 1) :].max())
    least = max(CLEAR * NOISE_GAIN**0.5 * noise, FASTER * samples.least_change)
    return last > least and last > FASTER * float(bend[: len(bend) // 2].max())


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


def _follows_the_future(samples: Samples) -> bool:
    """Return whether commands that were not given yet move a free device, as after a filter of both directions."""
    response = free_response(samples)
    if response is None or not response.is_driven:
        return False
    past, future = response.residual_past, max(response.residual_future, 1e-12 * response.motion)
    seen = past > max(LEAST_RESIDUAL * response.motion, response.noise)
    return seen and past >= AHEAD * future and future <= MOST_RESIDUAL * response.motion


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


def interpolated_command(samples: Samples) -> Finding | None:
    """Return whether the command lies on straight lines between fewer values, and its own steps explain the motion.

    The bends of a command that was sampled every n-th row and joined by lines lie n rows apart. A command that is meant
    to be a ramp explains the motion as it is.
    """
    if not samples.is_free:
        return None
    jumps = samples.jumps
    bend = np.abs(jumps[1:] - jumps[:-1])
    bends = np.flatnonzero(bend > 1e-3 * max(float(np.abs(jumps).max()), 1e-300)) + 1
    factor = spacing(bends)
    if factor < 2 or len(bends) < 4:
        return None
    logged = free_response(samples)
    if logged is None or logged.is_at_noise:
        return None
    if logged.residual <= OWN_STEPS * min(
        _residual_held(samples, int(bends[0]), factor), _residual_of_steps(samples, factor)
    ):
        return None
    return samples.finding(
        "interpolated_rows",
        "unsafe",
        f"The command lies on straight lines between every {ordinal(factor)} row, and steps inside them explain the "
        "motion better: it was interpolated, and begins before its steps.",
        "Export the command as it was sent (held, not interpolated), at the rate of the controller.",
    )


def _residual_held(samples: Samples, first: int, factor: int) -> float:
    """Return what is left where every n-th command is held up to the next one, at the best delay."""
    knots = np.arange(first % factor, len(samples), factor)
    place = np.clip(np.searchsorted(knots, np.arange(len(samples)), side="right") - 1, 0, len(knots) - 1)
    held = free_response(replace(samples, command=samples.command[knots][place]))
    return np.inf if held is None else held.residual


def _residual_of_steps(samples: Samples, factor: int) -> float:
    """Return what is left where each ramp of the command between two levels is a step at a free time."""
    moves = samples.jumps != 0
    starts = np.flatnonzero(moves & ~np.concatenate([[False], moves[:-1]]))
    ends = np.flatnonzero(moves & ~np.concatenate([moves[1:], [False]])) + 1
    if not 2 <= len(starts) <= MOST_RAMPS or (ends - starts != factor).any():
        return np.inf
    return residual_with_impulses(samples, starts + factor // 2)
