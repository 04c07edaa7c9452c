"""Does a logged command obey the wall law, and if not, why: seen in the log alone, before anything rests on it.

The law is u_k = F_k - K (x_k - x_0) - B (x_k - x_{k-1})/T with F_k = 0 before the edge and F_0 from it on. Of a
controller that applies it nothing but rounding is left in u + K (x - x_0) + B dx/T - F. What is left otherwise has a
shape by which its cause is known. Candidates are held against the command in the order of what they leave free, and
one that leaves more than the digits of the log leave open in any row is none: a command of another row, one that is
clipped or whose rate is, a wall that pushes only, another step, rows that are missing or repeated, a velocity that is
filtered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.signal.log_rows import ROUNDINGS, LogRows, stands_still
from pipeline.measured.signal.lost_rows import EQUAL, PLATEAU, STILL_FLOORS, hidden_rows, is_equal, repeated_rows
from pipeline.measured.signal.response import CHUNK, Response, external_force
from pipeline.measured.signal.stamps import ODD, Stamps, read_stamps
from pipeline.measured.signal.velocity_filter import VelocityFilterFound, find_filter
from pipeline.measured.signal.wall_scale import fit, power_of_ten, scale_in
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

PRINTED_IN_FULL = float(ROUNDINGS**2 * np.finfo(np.float64).eps)
"""Rounding of the law relative to its largest force where all numbers are printed in full, as `LogRows.of` has it."""

LONGEST_RAMP = 0.25
"""Part of the rows after the edge that a ramped step may take."""

LEVEL_ROWS = 5
"""Rows for which the external force must stay on a level to be a step of its own."""

FEWEST_AT_LIMIT = 3
"""Rows whose command changes by the same that show a limit of that."""

MOST_LEVELS = 12
"""Levels beyond which an external force is no staircase."""

EXPLAINED = 1e-6
"""Part of what a filter changes that it may leave unexplained, beside rounding: what is found is exact or not it."""

CLIPPED = 1e-3
"""Part of a limit by which what a filtered wall demands may stay below it: its filter is known as well as that."""

CODES = (
    "saturation",
    "unilateral_wall",
    "constant_force",
    "step_not_a_step",
    "several_steps",
    "missing_rows",
    "repeated_rows",
    "command_shifted",
    "rate_limit",
    "sampling_period",
    "scattered_stamps",
    "velocity_filter",
    "other_wall",
    "other_unit",
    "unknown",
)
"""What a log can be found to be beside the wall law. ``other_wall``: other K, B or sign than the header's;
``other_unit``: K and B a power of ten off."""


@dataclass(frozen=True)
class Departure:
    """One way in which a log departs from the wall law: code, a sentence with its numbers, rows concerned."""

    code: str
    evidence: str
    rows: int = 0
    value: float | None = None
    filter: VelocityFilterFound | None = None


@dataclass(frozen=True, eq=False)
class WallLaw:
    """Residual of the law of each trial, shape (n,), and why it is not rounding.

    Parameters
    ----------
    residual : float64
        Largest |u + K (x - x_0) + B dx/T - F| relative to |F_0|; NaN without a command edge.
    rounding : float64
        What rounding of the printed numbers leaves of it at most.
    departures : tuple of tuple of Departure
        Why it is more, most certain first; empty where the law holds.
    """

    residual: Floats
    rounding: Floats
    departures: tuple[tuple[Departure, ...], ...]

    @property
    def holds(self) -> Booleans:
        """Where the law holds up to rounding and nothing else speaks against the rows, shape (n,)."""
        return np.array([not found for found in self.departures]) & np.isfinite(self.residual)


def wall_law(batch: TrialBatch, response: Response) -> WallLaw:
    """Hold the logged command of each trial against the wall law.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.

    Returns
    -------
    WallLaw

    Notes
    -----
    What the digits of command, position, K and B leave open in a row is no departure (`digits`). A quantum of a sensor
    is on a grid of decimals, too, and is what the controller saw: a law is tried with positions as they are first.

    Source: Hulin 2017, eqs. 3.9 and 3.10 (wall), sec. 6.1.1 (command as logged).
    """
    n = len(batch)
    residual, rounding = np.full(n, np.nan), np.full(n, np.nan)
    departures: list[tuple[Departure, ...]] = [()] * n
    for place, some in batch.portions(CHUNK):
        of, external = response.select(place), external_force(some)
        seen = of.has_edge & (some.step != 0)
        size = np.abs(np.where(seen, some.step, np.nan))
        off, least = _largest_residual(some, of, external)
        residual[place], rounding[place] = off / size, least / size
        for i in np.flatnonzero(seen & ((off > least) | _odd_rows(some, of))):
            log = LogRows.of(some, of, int(i))
            rounding[place.start + i] = log.rounding.max() / size[i]
            departures[place.start + i] = tuple(_departures(log))
    for i in np.flatnonzero(response.steps > 1):
        found = Departure("several_steps", response.edge_reason[i], int(batch.rows[i]), float(response.steps[i]))
        departures[i] = (found,)
    return WallLaw(residual, rounding, tuple(departures))


def _largest_residual(batch: TrialBatch, response: Response, external: Floats) -> tuple[Floats, Floats]:
    """Return the largest residual of each log, and what rounding leaves of it where all is printed in full [N, Nm]."""
    after = np.arange(external.shape[1]) >= response.edge_row[:, None]
    off = np.abs(external - batch.step[:, None] * after)
    return np.fmax.reduce(off, axis=1), PRINTED_IN_FULL * np.fmax.reduce(np.abs(external), axis=1)


def _odd_rows(batch: TrialBatch, response: Response) -> Booleans:
    """Return which logs skip rows by their stamps, or stand still in single rows, shape (n,)."""
    steps = np.diff(batch.time, axis=1) / batch.sampling_period_s[:, None]
    odd: Booleans = np.any(np.abs(steps - 1) > ODD, axis=1, keepdims=True)[:, 0]
    change = np.diff(batch.position, axis=1, prepend=batch.position[:, :1])
    # most logs of a device that is read exactly never stand still after the step
    after = np.arange(change.shape[1]) >= response.edge_row[:, None]
    some = np.flatnonzero(((change == 0) & after).any(axis=1))
    span = np.fmax.reduce(batch.position[some], axis=1) - np.fmin.reduce(batch.position[some], axis=1)
    still = stands_still(change[some], after[some], (STILL_FLOORS * response.floor[some] + EQUAL * span)[:, None])
    odd[some] |= still.sum(axis=1) >= PLATEAU
    return odd


def _departures(log: LogRows) -> Iterator[Departure]:
    """Yield what departs from the law: what the stamps show, then the rows and the law that explain the command."""
    stamps = read_stamps(log.time, log.period)
    yield from (told := [*_by_stamps(stamps, log)])
    log = replace(log, period=stamps.period).without(np.append(0, stamps.skipped) > 0)
    held, repeats = repeated_rows(log, by_law=False), repeated_rows(log)
    found = _explained(log)
    if found is None and len(repeats):
        held, found = repeats, _explained(log.without(_beside(repeats, len(log.command))))
    if found is None:
        held, found = repeats[:0], _hidden(replace(log, kept=np.ones_like(log.kept)))
    codes = {each.code for each in told}
    yield from (each for each in (*_repeated(log, held), *(found or ())) if each.code not in codes)
    if found is None:
        off = log.kept & (np.abs(log.residual) > log.rounding)
        text = f"the logged command departs from the wall law by up to {np.abs(log.residual[log.kept]).max():.3g}"
        yield Departure("unknown", f"{text}, in {int(off.sum())} of {len(off)} rows", int(off.sum()))


def _beside(rows: Integers, count: int) -> Booleans:
    """Return those rows and the ones behind them: a change that is too small makes the next too large."""
    result = np.zeros(count + 1, dtype=np.bool_)
    result[rows] = result[rows + 1] = True
    return result[:count]


def _explained(log: LogRows) -> tuple[Departure, ...] | None:
    """Return the first candidate that leaves nothing in any row; none where each leaves something.

    Positions on a grid may be the readings that the controller had, or rounded when they were printed.
    """
    tried = (candidate(reading) for reading in log.each_reading for candidate in _CANDIDATES)
    return next((found for found in tried if found is not None), None)


def _by_stamps(stamps: Stamps, log: LogRows) -> Iterator[Departure]:
    gaps = np.flatnonzero(stamps.skipped)
    if stamps.period != log.period:
        text = f"rows are {stamps.period:.4g} s apart by their stamps, the header says {log.period:.4g} s"
        yield Departure("sampling_period", text, len(log.time), stamps.period)
    if len(gaps):
        lost = int(stamps.skipped.sum())
        yield Departure("missing_rows", f"the stamps skip {lost} rows, first after row {gaps[0]}", len(gaps), lost)
    elif stamps.odd:
        text = f"stamps scatter by {stamps.scatter:.2g} of a period about even ones, and no row is missing"
        yield Departure("scattered_stamps", text, stamps.odd, stamps.scatter)


def _repeated(log: LogRows, rows: Integers) -> Iterator[Departure]:
    if len(rows):
        both = int((log.command[rows] == log.command[rows - 1]).sum())
        what = "rows repeat the one before" if both > len(rows) / 2 else "readings of the position are held"
        text = f"{len(rows)} {what} while the device moves, first row {rows[0]}"
        yield Departure("repeated_rows", text, len(rows), float(len(rows)))


def _plain(log: LogRows) -> tuple[Departure, ...] | None:
    """The law itself; a wall may rest beside the first reading by the error of that."""
    error = abs(log.stiffness) * log.floor
    beside = np.clip(np.median(log.residual[log.kept]), -error, error)
    return None if log.off(log.command - log.residual + beside) else ()


def _late(log: LogRows) -> tuple[Departure, ...] | None:
    """A command that stands in the row behind its position, or before it."""
    for rows, how in ((1, "late"), (-1, "early")):
        if _plain(log.moved(rows)) is not None:
            text = f"the logged command is that of the wall law, one row {how}"
            return (Departure("command_shifted", text, len(log.command), float(rows)),)
    return None


def _hidden(log: LogRows) -> tuple[Departure, ...] | None:
    rows = hidden_rows(log)
    if not len(rows):
        return None
    text = f"{len(rows)} single rows, first row {rows[0]}, fit the wall law only with a row missing before them"
    return (Departure("missing_rows", text, int(log.after.sum()), float(len(rows))),)


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
    limit = float(max(abs(low) if beyond[0].any() else 0.0, abs(high) if beyond[1].any() else 0.0))
    text = f"the logged command is clipped at {high if beyond[1].any() else low:.4g} in {count} rows"
    return (Departure("saturation", text, count, limit),)


def _slow(log: LogRows) -> tuple[Departure, ...] | None:
    """A command that changes by no more than a limit from row to row."""
    # a step that rises slowly is half of itself too late
    log = replace(log, edge=int(np.argmax(np.abs(log.command - log.command[0]) > log.rounding)))
    before = np.append(0.0, log.command[:-1])
    change = log.command - before
    limit = float(np.abs(change).max())
    at = np.abs(np.abs(change) - limit) <= log.of_command + np.append(0.0, log.of_command[:-1]) + EQUAL * limit
    if limit >= abs(log.step) * (1 - EQUAL) or at.sum() < FEWEST_AT_LIMIT:
        return None
    demand = log.step * log.after - log.wall - before
    if log.off(before + np.clip(demand, -limit, limit), ~at) or (at & (demand * change <= 0)).any():
        return None
    if (at & (np.abs(demand) < limit - 2 * log.rounding)).any():
        return None
    text = f"the logged command changes by at most {limit:.4g} from row to row, in {int(at.sum())} rows by that"
    return (Departure("rate_limit", text, int(at.sum()), limit),)


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
    value = float(np.median(log.residual[log.after]))
    if not log.off(log.command - log.residual + value):
        text = f"the command holds a constant {value:.4g} beside the wall law"
        return (Departure("constant_force", text, len(log.residual), value),)
    if not log.off(log.command - log.residual + value * log.after):
        text = f"the step is {log.step + value:.6g}, its header says {log.step:.6g}"
        return (Departure("step_not_a_step", text, int(log.after.sum()), log.step + value),)
    return None


def _other_step(log: LogRows) -> tuple[Departure, ...] | None:
    """An external force that rises over several rows, or in several steps, and rests on each level."""
    e = log.external
    turns = np.flatnonzero(np.abs(np.diff(e)) > log.rounding[1:] + log.rounding[:-1]) + 1
    starts = np.append(0, turns)
    lengths = np.diff(np.append(starts, len(e)))
    stays = lengths >= LEVEL_ROWS
    levels = [float(np.median(e[s : s + n])) for s, n in zip(starts, lengths, strict=True)]
    force = np.repeat(levels, lengths)
    if len(turns) < 2 or not stays[0] or log.off(log.command - e + force):
        return None
    first, last = int(turns[0]), int(turns[-1])
    ramp = last - first + 1
    rising = np.diff(force[first - 1 : last + 1]) * np.sign(levels[-1]) > 0
    if ramp <= max(LONGEST_RAMP * len(e), 2) and rising.all():
        text = f"the step rises over {ramp} rows, from row {first} to row {last}, to {levels[-1]:.4g}"
        return (Departure("step_not_a_step", text, ramp, float(ramp)),)
    if not stays.all() or len(levels) > MOST_LEVELS:
        return None
    told = ", ".join(f"{level:.4g} from row {row}" for level, row in zip(levels[1:], turns, strict=True))
    text = f"the external force has {len(turns)} steps: {told}"
    return (Departure("several_steps", text, len(e) - log.edge, float(len(turns))),)


def _other_wall(log: LogRows) -> tuple[Departure, ...] | None:
    """Another stiffness, damping, step or sign than the header's."""
    terms = np.stack([log.after.astype(np.float64), -log.displacement, -log.change / log.period], axis=1)
    weight = (log.kept / log.rounding)[:, None]
    values = fit(terms * weight, log.command * weight[:, 0])
    if log.off(np.matmul(terms, values).astype(np.float64)):
        return None
    # what moves the command by less than its rounding is nothing
    values[(np.abs(values * terms) <= log.rounding[:, None]).all(axis=0)] = 0.0
    step, stiffness, damping = values
    evidence = (
        f"the command obeys K = {stiffness:.6g}, B = {damping:.6g} and a step of {step:.6g}; its header says "
        f"K = {log.stiffness:.6g}, B = {log.damping:.6g}, {log.step:.6g}"
    )
    return (Departure("other_wall", evidence, len(log.command)),)


def _other_unit(log: LogRows) -> tuple[Departure, ...] | None:
    """Stiffness and damping that are a power of ten times the header's, however the velocity is filtered."""
    scale = scale_in(log)
    if scale is None or not power_of_ten(scale.wall):
        return None
    stiffness, damping = scale.wall * log.stiffness, scale.wall * log.damping
    evidence = (
        f"the command obeys about K = {stiffness:.3g}, B = {damping:.3g}; its header says K = {log.stiffness:.6g}, "
        f"B = {log.damping:.6g}"
    )
    return (Departure("other_unit", evidence, len(log.command), scale.wall),)


def _filtered(log: LogRows, clipped: Booleans | None = None) -> tuple[Departure, ...] | None:
    """A filter of the velocity: over N samples, else recursive, of the lowest order; some rows may be clipped."""
    if log.damping == 0:
        return None
    force = log.step * log.after - log.stiffness * log.displacement
    output = (force - log.command) * (log.period / log.damping)
    tolerance = log.rounding * log.period / abs(log.damping) + EXPLAINED * float(np.abs(output - log.change).max())
    free = log.kept if clipped is None else log.kept & ~clipped
    found = find_filter(log.change, output, free, tolerance, log.period)
    if found is None:
        return None
    mean = f"is the mean over {found.difference} samples"
    how = mean if found.difference else f"has a filter of order {len(found.a) - 1}"
    return (Departure("velocity_filter", f"the velocity of the wall law {how}", len(output), filter=found),)


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
    if (demand / log.command < 1 - CLIPPED)[clipped].any():
        return None
    text = f"the logged command is clipped at {limit:.4g} in {rows} rows"
    return (Departure("saturation", text, rows, limit), *found)


def _filtered_and_late(log: LogRows) -> tuple[Departure, ...] | None:
    """A filter of the velocity in a command that stands in the row behind its position."""
    found = _filtered(log.moved(1))
    return found and (Departure("command_shifted", "the logged command is late by a row", len(log.command), 1.0), *found)


_CANDIDATES: tuple[Callable[[LogRows], tuple[Departure, ...] | None], ...] = (
    _plain,
    _late,
    _offset,
    _clipped,
    _one_sided,
    _other_unit,
    _other_step,
    _slow,
    _other_wall,
    _filtered,
    _filtered_and_clipped,
    _filtered_and_late,
)
"""In the order of the numbers that they leave free: none, a limit or a constant, three, those of a filter, a row each."""
