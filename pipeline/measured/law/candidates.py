"""What may have made a logged command: the wall law itself, and the laws that controllers and loggers make of it.

A candidate says of a log which departures it has, none of them, or that it does not explain the log: that a row is left
in which the command is another one, by more than the digits of the log leave open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.law.log_rows import GRID, PLATEAU, LogRows, hidden_rows, is_equal
from pipeline.measured.law.velocity_filter import LONGEST_WINDOW, VelocityFilterFound, find_filter
from pipeline.measured.signal.edge import BENT
from pipeline.measured.signal.response import SETTLED_SAMPLES
from pipeline.measured.student import ROUNDING
from pipeline.records.batch import Booleans, Floats

LONGEST_RAMP = 0.25
"""Part of the rows after the edge that a ramped step may take."""

ADAPTS = 0.1
"""Share of the rows of a motion from which on the velocity is not the last change: of the rows behind a lost one, a few
percent, some window fits by chance."""

FEWEST_AT_LIMIT = 3
"""Rows whose command changes by the same that show a limit of that: two may by rounding."""

EXPLAINED = 1e-6
"""Part of what a filter changes that it may leave unexplained, beside rounding: what is found is exact or not it."""


SCALE_TOLERANCE = 0.2
"""Part by which the factor between two units may be off in a log whose velocity is filtered or clipped."""


@dataclass(frozen=True)
class Departure:
    """One way in which a log departs from the wall law; ``obeyed`` are K, B and step that another wall has."""

    code: str
    evidence: str
    rows: int = 0
    filter: VelocityFilterFound | None = None
    obeyed: tuple[float, float, float] | None = None


Law = Callable[[LogRows], tuple[Departure, ...] | None]
"""What a candidate says of a log."""


def explanation(log: LogRows) -> tuple[Departure, ...] | None:
    """Return the first candidate that leaves nothing in any row; none where each leaves something.

    Positions on a grid may be the readings that the controller had, or rounded when they were printed.
    """
    tried = (candidate(reading) for reading in log.readings for candidate in CANDIDATES)
    return next((found for found in tried if found is not None), None)


def _plain(log: LogRows) -> tuple[Departure, ...] | None:
    """The law itself; a wall may rest beside the first reading by the error of that."""
    error = abs(log.stiffness) * log.floor
    beside = (0.0, np.clip(np.median(log.residual[log.kept]), -error, error))
    return None if all(log.off(log.command - log.residual + each) for each in beside) else ()


def _late(law: Law, *shifts: int) -> Law:
    """Return a law whose command stands in a row behind its position, or before it where the shift is negative."""

    def late(log: LogRows) -> tuple[Departure, ...] | None:
        for shift in shifts:
            if (found := law(log.moved(shift))) is not None:
                text = f"the logged command is that of the wall law, one row {'late' if shift > 0 else 'early'}"
                return (Departure("command_shifted", text, len(log.command)), *found)
        return None

    return late


def hidden(log: LogRows) -> tuple[Departure, ...] | None:
    """Return rows that are missing before others by the law alone, None where they do not explain the log."""
    rows = hidden_rows(log)
    if not len(rows):
        return None
    text = f"{len(rows)} single rows, first row {rows[0]}, fit the wall law only with a row missing before them"
    return (Departure("missing_rows", text, len(rows)),)


def _clipped(log: LogRows) -> tuple[Departure, ...] | None:
    demand = log.step * log.after - log.wall
    low, high = float(log.command.min()), float(log.command.max())
    if is_equal(np.array([low, high]), log.step).any():
        return None  # a command that never passes the step is that of a wall that never pulls
    at = [is_equal(log.command, limit) for limit in (low, high)]
    beyond = [(demand < low - log.rounding) & at[0], (demand > high + log.rounding) & at[1]]
    count = int(beyond[0].sum() + beyond[1].sum())
    if count < PLATEAU or log.off(demand, ~beyond[0] & ~beyond[1]):
        return None
    text = f"the logged command is clipped at {high if beyond[1].any() else low:.4g} in {count} rows"
    return (Departure("saturation", text, count),)


def _slow(log: LogRows) -> tuple[Departure, ...] | None:
    """A command that changes by no more than a limit from row to row."""
    before = np.append(0.0, log.command[:-1])
    change = log.command - before
    limit = float(np.abs(change).max())
    at = np.abs(np.abs(change) - limit) <= log.of_command + np.append(0.0, log.of_command[:-1]) + ROUNDING * limit
    if limit >= abs(log.step) * (1 - ROUNDING) or at.sum() < FEWEST_AT_LIMIT:
        return None
    # half of a step that rises slowly is late; the first row is at the limit
    log = replace(log, edge=int(np.argmax(at & (change * log.step > 0))))
    demand = log.step * log.after - log.wall - before
    of_change = log.of_command + np.append(0.0, log.of_command[:-1])
    if (np.abs(change - np.clip(demand, -limit, limit)) > log.rounding + of_change)[log.kept].any():
        return None
    at &= np.abs(demand) > limit + log.rounding
    if at.sum() < FEWEST_AT_LIMIT:
        return None
    text = f"the logged command changes by at most {limit:.4g} from row to row, in {int(at.sum())} rows by that"
    return (Departure("rate_limit", text, int(at.sum())),)


def _one_sided(log: LogRows) -> tuple[Departure, ...] | None:
    """A wall that exists on one side of its surface, or that only pushes."""
    inside = log.displacement * np.sign(log.step) > 0
    pushing = np.maximum(log.wall * np.sign(log.step), 0.0) * np.sign(log.step)
    force = log.step * log.after
    for predicted, how in (
        (force - np.where(inside, log.wall, 0.0), "is there on one side of x_0 only"),
        (force - np.where(inside, pushing, 0.0), "is there on one side of x_0 and only pushes"),
        (force - pushing, "only pushes and never pulls"),
    ):
        rows = int((np.abs(log.residual) > log.rounding).sum())
        if rows and not log.off(predicted):
            return (Departure("unilateral_wall", f"the wall {how}: {rows} rows without its force", rows),)
    return None


def _offset(log: LogRows) -> tuple[Departure, ...] | None:
    """A constant beside the law, from the first row on or from the step on."""
    value = _constant(log, log.kept)
    if value is not None:
        text = f"the command holds a constant {value:.4g} beside the wall law"
        return (Departure("constant_force", text, len(log.residual)),)
    value = _constant(log, log.kept & log.after)
    if value is not None and not log.off(log.command - log.residual, ~log.after):
        text = f"the step is {log.step + value:.6g}, its header says {log.step:.6g}"
        obeyed = (log.stiffness, log.damping, log.step + value)
        return (Departure("step_not_a_step", text, int(log.after.sum()), obeyed=obeyed),)
    return None


def _constant(log: LogRows, rows: Booleans | slice) -> float | None:
    """Return the constant that a residual is in some rows, None where it is none."""
    residual, rounding = log.residual[rows], log.rounding[rows]
    if not len(residual):
        return None
    low, high = (residual - rounding).max(initial=-np.inf), (residual + rounding).min(initial=np.inf)
    return float(low + high) / 2 if low <= high else None


def _other_step(log: LogRows) -> tuple[Departure, ...] | None:
    """An external force that rises over several rows, from level to level; several steps have no one edge (`edge`)."""
    e = log.external
    turns = np.flatnonzero(np.abs(np.diff(e)) > log.rounding[1:] + log.rounding[:-1]) + 1
    ends = np.append(turns, len(e))
    starts, lengths = np.append(0, turns), np.diff(ends, prepend=0)
    from_zero = replace(log, step=0.0)
    found = [_constant(from_zero, slice(a, b)) for a, b in zip(starts, ends, strict=True)]
    levels = [level for level in found if level is not None]
    if len(turns) < 2 or lengths[0] < SETTLED_SAMPLES or len(levels) < len(found):
        return None
    force = np.repeat(levels, lengths)
    first, last = int(turns[0]), int(turns[-1])
    ramp = last - first + 1
    rising = np.diff(force[first - 1 : last + 1]) * np.sign(levels[-1]) > 0
    if ramp <= max(LONGEST_RAMP * len(e), 2) and rising.all():
        text = f"the step rises over {ramp} rows, from row {first} to row {last}, to {levels[-1]:.4g}"
        return (Departure("step_not_a_step", text, ramp),)
    return None


def _fit(terms: Floats, command: Floats) -> Floats:
    """Return the factors of terms, shape (N, terms), whose sum is nearest to the command; 0 for a term of zeros."""
    size = np.abs(terms).max(axis=0)
    size[size == 0] = 1.0
    result: Floats = np.linalg.lstsq(terms / size, command, rcond=None)[0] / size
    return result


def _other_wall(log: LogRows) -> tuple[Departure, ...] | None:
    """Another stiffness, damping, step or sign than the header's."""
    terms = np.stack([log.after.astype(np.float64), -log.displacement, -log.change / log.period], axis=1)
    weight = (log.kept / log.rounding)[:, None]
    values = _fit(terms * weight, log.command * weight[:, 0])
    if log.off(np.matmul(terms, values).astype(np.float64)):
        return None
    # what moves the command by less than its rounding is nothing
    values[(np.abs(values * terms) <= log.rounding[:, None]).all(axis=0)] = 0.0
    step, stiffness, damping = map(float, values)
    evidence = (
        f"the command obeys K = {stiffness:.6g}, B = {damping:.6g} and a step of {step:.6g}; its header says "
        f"K = {log.stiffness:.6g}, B = {log.damping:.6g}, {log.step:.6g}"
    )
    return (Departure("other_wall", evidence, len(log.command), obeyed=(stiffness, damping, step)),)


def _other_unit(log: LogRows) -> tuple[Departure, ...] | None:
    """Stiffness and damping that are a power of ten times the header's, however the velocity is filtered."""
    terms = np.stack([log.step * log.after, -log.wall], axis=1)
    values = _fit(terms, log.command)
    step, wall = map(float, values)
    left = log.command - np.matmul(terms, values)
    # a twentieth of the largest command, and nine tenths of its square, tell a factor
    told = np.abs(wall * terms[:, 1]).max() > 0.05 * np.abs(log.command).max(initial=0.0)
    power = 10.0 ** np.rint(np.log10(abs(wall))) if told and wall else 1.0
    if power == 1.0 or abs(abs(wall) / power - 1) > SCALE_TOLERANCE or left @ left > 0.1 * (log.command @ log.command):
        return None
    evidence = (
        f"the command obeys about K = {wall * log.stiffness:.3g}, B = {wall * log.damping:.3g}; its header says "
        f"K = {log.stiffness:.6g}, B = {log.damping:.6g}"
    )
    obeyed = (wall * log.stiffness, wall * log.damping, step * log.step)
    return (Departure("other_unit", evidence, len(log.command), obeyed=obeyed),)


def _velocity(log: LogRows) -> tuple[Floats, Floats]:
    """Return the velocity [m, rad a sample] that the command holds, and what is open of it."""
    output = (log.step * log.after - log.stiffness * log.displacement - log.command) * (log.period / log.damping)
    return output, log.rounding * log.period / abs(log.damping) + EXPLAINED * float(np.abs(output - log.change).max())


def _filtered(log: LogRows, clipped: Booleans | None = None) -> tuple[Departure, ...] | None:
    """A filter of the velocity: over N samples, else recursive, of the lowest order; some rows may be clipped."""
    if log.damping == 0:
        return None
    output, tolerance = _velocity(log)
    free = log.kept if clipped is None else log.kept & ~clipped
    found = find_filter(log.change, output, free, tolerance, log.period)
    if found is None:
        return None
    mean = f"is the mean over {found.difference} samples"
    how = mean if found.difference else f"has a filter of order {len(found.a) - 1}"
    return (Departure("velocity_filter", f"the velocity of the wall law {how}", len(output), filter=found),)


def _position_filter(log: LogRows) -> VelocityFilterFound | None:
    """Return the filter of the position that all of the wall acts on, by where it must have seen it in each row."""
    from scipy.signal import lfilter

    # behind a lost row where the wall saw it is not known
    if log.stiffness <= 0 or log.damping < 0 or not log.kept.all():
        return None
    whole = log.stiffness + log.damping / log.period
    own = [1.0, log.stiffness / whole - 1]
    seen = lfilter([1 / whole], own, log.step * log.after - log.command)
    tolerance = lfilter([1 / whole], own, log.rounding) + EXPLAINED * float(np.abs(seen - log.displacement).max())
    return find_filter(log.displacement, seen, log.kept, tolerance, log.period)


def _either_filtered(log: LogRows) -> tuple[Departure, ...] | None:
    """A filter of velocity or position: each is one of the other of a higher order, and what has less free counts."""
    velocity = _filtered(log)
    free = np.inf if velocity is None or velocity[0].filter is None else velocity[0].filter.free
    position = _position_filter(log) if free > 1 else None
    if position is None or position.free >= free:
        return velocity
    text = f"the position that the wall acts on {position.words()}"
    return (Departure("position_filter", text, len(log.command)),)


def _adaptive(log: LogRows) -> tuple[Departure, ...] | None:
    """A velocity over a window that another length has from row to row (Janabi-Sharifi, Hayward and Chen 2000)."""
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
    text = f"the velocity of the wall law is taken over 1 to {longest} samples, over others from row to row"
    return (Departure("adaptive_velocity", text, len(output)),)


def _decimated(log: LogRows) -> tuple[Departure, ...] | None:
    """A velocity since a reading between two rows: with that of the row it lies on the grid of the sensor."""
    counts = np.rint(log.change / log.quantum) if log.quantum > 0 else np.zeros(1)
    if log.damping == 0 or not counts.any():
        return None
    quantum = float(log.change @ counts / (counts @ counts))
    output, tolerance = (part[log.kept] for part in _velocity(log))
    steps = np.rint(output / quantum)
    near = 2 * GRID * quantum  # of a difference of two readings
    if (tolerance > near).any() or (np.abs(output - steps * quantum) > tolerance + near).any():
        return None
    every = int(np.gcd.reduce(steps.astype(np.int64)))
    if every < 2 or len(np.unique(steps)) < SETTLED_SAMPLES:
        return None
    text = f"the velocity of the wall law is taken over 1/{every} of the {log.period:.4g} s from row to row"
    return (Departure("decimated_rows", text, len(output)),)


def _filtered_and_clipped(log: LogRows) -> tuple[Departure, ...] | None:
    """A filter of the velocity in the rows in which the command stands at no limit."""
    # a command that never passes the step is not clipped there
    clipped = is_equal(log.command, log.command.min()) | is_equal(log.command, log.command.max())
    clipped &= ~is_equal(log.command, log.step)
    limit, rows = float(np.abs(log.command).max()), int(clipped.sum())
    found = _filtered(log, clipped) if rows >= PLATEAU else None
    if found is None or found[0].filter is None:
        return None
    from scipy.signal import lfilter

    velocity = lfilter(found[0].filter.b, found[0].filter.a, log.change) / log.period
    demand = log.step * log.after - log.stiffness * log.displacement - log.damping * velocity
    if (demand * np.sign(log.command) < (1 - BENT) * np.abs(log.command))[clipped].any():
        return None
    text = f"the logged command is clipped at {limit:.4g} in {rows} rows"
    return (Departure("saturation", text, rows), *found)


CANDIDATES: tuple[Law, ...] = (
    _plain,
    _late(_plain, 1, -1),
    _offset,
    _clipped,
    _one_sided,
    _other_unit,
    _other_step,
    _slow,
    _other_wall,
    _decimated,
    _either_filtered,
    _adaptive,
    _filtered_and_clipped,
    _late(_filtered, 1),
)
"""In the order of the numbers that they leave free: none, a limit or a constant, three, those of a filter."""
