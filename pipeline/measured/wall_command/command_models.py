"""Models of a logged command: the wall law and its variants in controllers and loggers.

Each candidate returns the departures of a log from the wall law (possibly none). It returns None if it does not explain
the log, i.e. if the command in some row differs by more than the rounding of the logged digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipeline.measured.signal.edge import BENT
from pipeline.measured.signal.response import SETTLED_SAMPLES
from pipeline.measured.student import ROUNDING
from pipeline.measured.wall_command.log_rows import GRID, PLATEAU, LogRows, hidden_rows, is_equal
from pipeline.measured.wall_command.velocity_filter import (
    LONGEST_WINDOW,
    VelocityFilterFound,
    filtered,
    find_filter,
    least_squares,
)
from pipeline.records.trials import Booleans, Floats

LONGEST_RAMP = 0.25
"""Longest ramp of a step, as a share of the rows after the edge."""

ADAPTS = 0.1
"""Smallest share of the rows of a motion that must have a filtered velocity. After a lost row, a few percent of the
rows fit some window by chance."""

FEWEST_AT_LIMIT = 3
"""Smallest number of rows with equal changes of the command for a rate limit. Two changes may be equal by rounding."""

EXPLAINED = 1e-6
"""Largest relative residual of a filter's effect, in addition to rounding. A filter is either exact or wrong."""


SCALE_TOLERANCE = 0.2
"""Relative tolerance of the conversion factor between two units, for a log with a filtered velocity or clipping."""


@dataclass(frozen=True)
class Departure:
    """Departure of a log from the wall law.

    ``obeyed`` contains K, B and step of the wall that the command obeys instead of the stated wall, if any.
    """

    code: str
    evidence: str
    rows: int = 0
    filter: VelocityFilterFound | None = None
    obeyed: tuple[float, float, float] | None = None


Departures = tuple[Departure, ...]

Law = Callable[[LogRows], Departures | None]
"""Candidate: a function that returns the departures of a log."""


def explanation(log: LogRows) -> Departures | None:
    """Return the departures of the first candidate that explains all rows, or None if no candidate does.

    Positions on a grid may be the exact readings of the controller, or may have been rounded when they were printed.
    """
    tried = (candidate(reading) for reading in log.readings for candidate in CANDIDATES)
    return next((departures for departures in tried if departures is not None), None)


def _wall_law(log: LogRows) -> Departures | None:
    """Compare with the wall law. Its rest position may differ from the first reading by the reading error."""
    error = abs(log.stiffness) * log.floor
    offsets = (0.0, np.clip(np.median(log.residual[log.kept]), -error, error))
    return None if all(log.off(log.command - log.residual + offset) for offset in offsets) else ()


def _shifted(law: Law, *shifts: int) -> Law:
    """Return a law whose command is logged some rows after its position, or before it for a negative shift."""

    def shifted(log: LogRows) -> Departures | None:
        for shift in shifts:
            if (departures := law(log.moved(shift))) is not None:
                text = f"the logged command matches the wall law one row {'late' if shift > 0 else 'early'}"
                return (Departure("command_shifted", text, len(log.command)), *departures)
        return None

    return shifted


def hidden(log: LogRows) -> Departures | None:
    """Return the departure of missing rows that only the law shows, or None if missing rows do not explain the log."""
    rows = hidden_rows(log)
    if not len(rows):
        return None
    text = f"{len(rows)} single rows, first row {rows[0]}, match the wall law only if a row is missing before them"
    return (Departure("missing_rows", text, len(rows)),)


def _clipped(log: LogRows) -> Departures | None:
    demand = log.step * log.after - log.wall
    low, high = float(log.command.min()), float(log.command.max())
    if is_equal(np.array([low, high]), log.step).any():
        return None  # if a command never exceeds the step, the wall never pulls
    below = (demand < low - log.rounding) & is_equal(log.command, low)
    above = (demand > high + log.rounding) & is_equal(log.command, high)
    count = int(below.sum() + above.sum())
    if count < PLATEAU or log.off(demand, ~below & ~above):
        return None
    text = f"the logged command is clipped at {high if above.any() else low:.4g} in {count} rows"
    return (Departure("saturation", text, count),)


def _rate_limited(log: LogRows) -> Departures | None:
    """Explain a command by a limit of its change between rows."""
    before, of_change = np.append(0.0, log.command[:-1]), log.of_command + np.append(0.0, log.of_command[:-1])
    change = log.command - before
    limit = float(np.abs(change).max())
    at = np.abs(np.abs(change) - limit) <= of_change + ROUNDING * limit
    if limit >= abs(log.step) * (1 - ROUNDING) or at.sum() < FEWEST_AT_LIMIT:
        return None
    # a slowly rising step reaches half its size late, so the first row at the limit is used as the edge
    log = replace(log, edge=int(np.argmax(at & (change * log.step > 0))))
    demand = log.step * log.after - log.wall - before
    if (np.abs(change - np.clip(demand, -limit, limit)) > log.rounding + of_change)[log.kept].any():
        return None
    rows = int((at & (np.abs(demand) > limit + log.rounding)).sum())
    if rows < FEWEST_AT_LIMIT:
        return None
    text = f"the change of the logged command between rows is limited to {limit:.4g}, which {rows} rows reach"
    return (Departure("rate_limit", text, rows),)


def _one_sided(log: LogRows) -> Departures | None:
    """Explain a command by a wall on one side of its surface, or by a wall that only pushes."""
    rows = int((np.abs(log.residual) > log.rounding).sum())
    inside = log.displacement * np.sign(log.step) > 0
    pushing = np.maximum(log.wall * np.sign(log.step), 0.0) * np.sign(log.step)
    for wall, how in (
        (np.where(inside, log.wall, 0.0), "acts on one side of x_0 only"),
        (np.where(inside, pushing, 0.0), "acts on one side of x_0 and only pushes"),
        (pushing, "only pushes and never pulls"),
    ):
        if rows and not log.off(log.step * log.after - wall):
            return (Departure("unilateral_wall", f"the wall {how}: {rows} rows without its force", rows),)
    return None


def _offset(log: LogRows) -> Departures | None:
    """Explain a command by a constant that is added to the law, starting at the first row or at the step."""
    value = _constant(log, log.kept)
    if value is not None:
        text = f"the command includes a constant {value:.4g} in addition to the wall law"
        return (Departure("constant_force", text, len(log.residual)),)
    value = _constant(log, log.kept & log.after)
    if value is not None and not log.off(log.command - log.residual, ~log.after):
        text = f"the step is {log.step + value:.6g}, but the header states {log.step:.6g}"
        obeyed = (log.stiffness, log.damping, log.step + value)
        return (Departure("step_not_a_step", text, int(log.after.sum()), obeyed=obeyed),)
    return None


def _constant(log: LogRows, rows: Booleans | slice) -> float | None:
    """Return the constant value of a residual in some rows, or None if it is not constant."""
    residual, rounding = log.residual[rows], log.rounding[rows]
    if not len(residual):
        return None
    low, high = (residual - rounding).max(), (residual + rounding).min()
    return float(low + high) / 2 if low <= high else None


def _other_step(log: LogRows) -> Departures | None:
    """Explain a command by an external force that rises over several rows, from one level to another."""
    rows = len(log.external)
    turns = np.flatnonzero(np.abs(np.diff(log.external)) > log.rounding[1:] + log.rounding[:-1]) + 1
    if len(turns) < 2 or turns[0] < SETTLED_SAMPLES:
        return None
    from_zero, bounds, force = replace(log, step=0.0), [0, *turns.tolist(), rows], np.empty(rows)
    for start, end in pairwise(bounds):
        level = _constant(from_zero, slice(start, end))
        if level is None:
            return None
        force[start:end] = level
    first, last = bounds[1], bounds[-2]
    ramp = last - first + 1
    rising = np.diff(force[first - 1 : last + 1]) * np.sign(force[-1]) > 0
    if ramp > max(LONGEST_RAMP * rows, 2) or not rising.all():
        return None
    text = f"the step rises over {ramp} rows, from row {first} to row {last}, to {force[-1]:.4g}"
    return (Departure("step_not_a_step", text, ramp),)


def _other_wall(log: LogRows) -> Departures | None:
    """Explain a command by a stiffness, damping, step or sign that differs from the header."""
    terms = np.stack([log.after.astype(np.float64), -log.displacement, -log.change / log.period], axis=1)
    weight = log.kept / log.rounding
    values = least_squares(terms * weight[:, None], log.command * weight)
    if log.off(terms @ values):
        return None
    # ignore contributions to the command below its rounding
    values[(np.abs(values * terms) <= log.rounding[:, None]).all(axis=0)] = 0.0
    step, stiffness, damping = map(float, values)
    evidence = (
        f"the command obeys K = {stiffness:.6g}, B = {damping:.6g} and a step of {step:.6g}, but the header states "
        f"K = {log.stiffness:.6g}, B = {log.damping:.6g}, {log.step:.6g}"
    )
    return (Departure("other_wall", evidence, len(log.command), obeyed=(stiffness, damping, step)),)


def _other_unit(log: LogRows) -> Departures | None:
    """Explain a command by K and B that differ from the header by a power of ten, for any velocity filter."""
    terms = np.stack([log.step * log.after, -log.wall], axis=1)
    step, wall = map(float, values := least_squares(terms, log.command))
    rest = log.command - terms @ values
    # commands above 1/20 of the largest command contain 9/10 of the sum of squares, which is enough for a factor
    shown = wall and np.abs(wall * terms[:, 1]).max() > 0.05 * np.abs(log.command).max(initial=0.0)
    power = 10.0 ** np.rint(np.log10(abs(wall))) if shown else 1.0
    if power == 1.0 or abs(abs(wall) / power - 1) > SCALE_TOLERANCE or rest @ rest > 0.1 * (log.command @ log.command):
        return None
    stiffness, damping = wall * log.stiffness, wall * log.damping
    evidence = (
        f"the command obeys about K = {stiffness:.3g}, B = {damping:.3g}, but the header states "
        f"K = {log.stiffness:.6g}, B = {log.damping:.6g}"
    )
    return (Departure("other_unit", evidence, len(log.command), obeyed=(stiffness, damping, step * log.step)),)


def _velocity(log: LogRows) -> tuple[Floats, Floats]:
    """Return the velocity [m/sample, rad/sample] that the command contains, and its error."""
    output = (log.step * log.after - log.stiffness * log.displacement - log.command) * (log.period / log.damping)
    return output, log.rounding * log.period / abs(log.damping) + EXPLAINED * float(np.abs(output - log.change).max())


def _velocity_filter(log: LogRows, clipped: Booleans | None = None) -> Departures | None:
    """Explain a command by a velocity filter: a mean over N samples, or a recursive filter. Rows may be clipped."""
    if log.damping == 0:
        return None
    output, tolerance = _velocity(log)
    free = log.kept if clipped is None else log.kept & ~clipped
    velocity = find_filter(log.change, output, free, tolerance, log.period)
    if velocity is None:
        return None
    order = f"has a filter of order {len(velocity.a) - 1}"
    text = f"the velocity of the wall law {velocity.words() if velocity.difference else order}"
    return (Departure("velocity_filter", text, len(output), filter=velocity),)


def _position_filter(log: LogRows) -> VelocityFilterFound | None:
    """Return the position filter that acts on both stiffness and damping, or None.

    The filter is found from the position that the wall used in each row.
    """
    # after a lost row, the position that the wall used is unknown
    if log.stiffness <= 0 or log.damping < 0 or not log.kept.all():
        return None
    whole = log.stiffness + log.damping / log.period
    inverse = [1 / whole], [1.0, log.stiffness / whole - 1]
    seen = filtered(*inverse, log.step * log.after - log.command)
    tolerance = filtered(*inverse, log.rounding) + EXPLAINED * float(np.abs(seen - log.displacement).max())
    return find_filter(log.displacement, seen, log.kept, tolerance, log.period)


def _velocity_or_position_filter(log: LogRows) -> Departures | None:
    """Explain a command by a velocity filter or a position filter, whichever has fewer parameters."""
    velocity = _velocity_filter(log)
    free = np.inf if velocity is None or velocity[0].filter is None else velocity[0].filter.free
    position = _position_filter(log) if free > 1 else None
    if position is None or position.free >= free:
        return velocity
    text = f"the position that the wall acts on {position.words()}"
    return (Departure("position_filter", text, len(log.command)),)


def _adaptive(log: LogRows) -> Departures | None:
    """Explain a command by a velocity window of variable length (Janabi-Sharifi, Hayward and Chen 2000)."""
    if log.damping == 0:
        return None
    output, tolerance = _velocity(log)
    lengths = np.arange(1, LONGEST_WINDOW + 1)[:, None]
    rows = np.maximum(np.arange(len(output)) - lengths, 0)
    fits = np.abs(output * lengths - (log.position - log.position[rows])) <= lengths * tolerance
    moves = log.kept & (np.abs(output) > tolerance)
    if not fits.any(axis=0)[log.kept].all() or (~fits[0, moves]).sum() <= ADAPTS * moves.sum():
        return None
    longest = int(np.argmax(fits[:, log.kept], axis=0).max(initial=0)) + 1
    text = f"the window of the velocity in the wall law varies between 1 and {longest} samples"
    return (Departure("adaptive_velocity", text, len(output)),)


def _decimated(log: LogRows) -> Departures | None:
    """Explain a command by a velocity that is based on a reading between two rows, on the grid of the sensor."""
    counts = np.rint(log.change / log.quantum) if log.quantum > 0 else np.zeros(1)
    if log.damping == 0 or not counts.any():
        return None
    quantum = float(log.change @ counts / (counts @ counts))
    output, tolerance = (part[log.kept] for part in _velocity(log))
    steps = np.rint(output / quantum)
    near = 2 * GRID * quantum  # for a difference of two readings
    if (tolerance > near).any() or (np.abs(output - steps * quantum) > tolerance + near).any():
        return None
    every = int(np.gcd.reduce(steps.astype(np.int64)))
    if every < 2 or len(np.unique(steps)) < SETTLED_SAMPLES:
        return None
    text = f"the velocity of the wall law is computed over 1/{every} of the {log.period:.4g} s between rows"
    return (Departure("decimated_rows", text, len(output)),)


def _filtered_and_clipped(log: LogRows) -> Departures | None:
    """Explain a clipped command by a velocity filter, in the rows that are not clipped."""
    # a command that equals the step is not clipped
    clipped = is_equal(log.command, log.command.min()) | is_equal(log.command, log.command.max())
    clipped &= ~is_equal(log.command, log.step)
    limit, rows = float(np.abs(log.command).max()), int(clipped.sum())
    departures = _velocity_filter(log, clipped) if rows >= PLATEAU else None
    if departures is None or departures[0].filter is None:
        return None
    velocity = filtered(departures[0].filter.b, departures[0].filter.a, log.change) / log.period
    demand = log.step * log.after - log.stiffness * log.displacement - log.damping * velocity
    if (demand * np.sign(log.command) < (1 - BENT) * np.abs(log.command))[clipped].any():
        return None
    text = f"the logged command is clipped at {limit:.4g} in {rows} rows"
    return (Departure("saturation", text, rows), *departures)


CANDIDATES: tuple[Law, ...] = (
    _wall_law,
    _shifted(_wall_law, 1, -1),
    _offset,
    _clipped,
    _one_sided,
    _other_unit,
    _other_step,
    _rate_limited,
    _other_wall,
    _decimated,
    _velocity_or_position_filter,
    _adaptive,
    _filtered_and_clipped,
    _shifted(_velocity_filter, 1),
)
"""Candidates in the order of the number of their free parameters.

The first candidates have no free parameter, the next have one (a limit or a constant) or three, and the last have the
parameters of a filter.
"""
