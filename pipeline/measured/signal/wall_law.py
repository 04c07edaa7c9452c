"""Does a logged command obey the wall law, and if not, why: seen in the log alone, before anything rests on it.

The law is u_k = F_k - K (x_k - x_0) - B (x_k - x_{k-1})/T with F_k = 0 before the edge and F_0 from it on. Of a
controller that applies it nothing but rounding is left in u + K (x - x_0) + B dx/T - F. What is left otherwise has a
shape by which its cause is known: a command that is clipped, a wall that pushes only, another step, rows that are
missing or repeated, a velocity that is filtered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.log_rows import ROUNDINGS, LogRows, stands_still
from pipeline.measured.signal.lost_rows import EQUAL, PLATEAU, STILL_FLOORS, hidden_rows, is_equal, repeated_rows
from pipeline.measured.signal.response import CHUNK, Response, external_force
from pipeline.measured.signal.velocity_filter import VelocityFilterFound, find_filter
from pipeline.measured.signal.wall_scale import fit, power_of_ten, scale_in
from pipeline.records.batch import Booleans, Floats, TrialBatch

PRINTED_IN_FULL = float(ROUNDINGS**2 * np.finfo(np.float64).eps)
"""Rounding of the law relative to its largest force where all numbers are printed in full, as `LogRows.of` has it."""

LONGEST_RAMP = 0.25
"""Part of the rows after the edge that a ramped step may take."""

LEVEL_ROWS = 5
"""Rows for which the external force must stay on a level to be a step of its own."""

MOST_LEVELS = 12
"""Levels beyond which an external force is no staircase."""

EXPLAINED = 1e-6
"""Part of the damping force that a filter may leave unexplained, beside rounding: what is found is exact or not it."""

CODES = (
    "saturation",
    "unilateral_wall",
    "constant_force",
    "step_not_a_step",
    "several_steps",
    "missing_rows",
    "repeated_rows",
    "velocity_filter",
    "other_wall",
    "other_unit",
    "unknown",
)
"""What a log can be found to be beside the wall law. ``other_wall``: other K, B or sign than the header's;
``other_unit``: K and B a power of ten off."""


@dataclass(frozen=True)
class Departure:
    """One way in which a log departs from the wall law; ``obeyed`` are K, B and step that another wall has."""

    code: str
    evidence: str
    rows: int = 0
    value: float | None = None
    filter: VelocityFilterFound | None = None
    obeyed: tuple[float, float, float] | None = None


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
    Positions and command are taken as printed. Rounding of the command is that of its last decimal, or of double
    (single) precision; positions count as rounded in print only where the command is, since the quantum of a sensor
    is on a grid of decimals, too, and is what the controller saw.

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
            log = LogRows.of(some, of, int(i), external[i])
            rounding[place.start + i] = log.rounding / size[i]
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
    odd: Booleans = np.any(np.diff(batch.time, axis=1) > 1.5 * batch.sampling_period_s[:, None], axis=1, keepdims=True)[
        :, 0
    ]
    change = np.diff(batch.position, axis=1, prepend=batch.position[:, :1])
    # most logs of a device that is read exactly never stand still after the step
    after = np.arange(change.shape[1]) >= response.edge_row[:, None]
    some = np.flatnonzero(((change == 0) & after).any(axis=1))
    span = np.fmax.reduce(batch.position[some], axis=1) - np.fmin.reduce(batch.position[some], axis=1)
    still = stands_still(change[some], after[some], (STILL_FLOORS * response.floor[some] + EQUAL * span)[:, None])
    odd[some] |= still.sum(axis=1) >= PLATEAU
    return odd


def _departures(log: LogRows) -> Iterator[Departure]:
    """Yield what departs from the law: what shows by itself first, then what explains all that is left."""
    rows = _repeated(log) or _gaps(log)
    # a wall may rest beside the first reading by the error of that
    error = abs(log.stiffness) * log.floor
    off = np.abs(log.residual - np.clip(np.median(log.residual), -error, error)) > log.rounding
    if not off.any() or (rows is not None and rows.rows >= off.sum()):
        yield from filter(None, [rows])
        return
    # each row beside a missing or repeated one looks like a step
    explanations = (each for each in _EXPLANATIONS if rows is None or each is not _other_step)
    found = next(filter(None, (explanation(log) for explanation in explanations)), ())
    if found and rows is not None and rows.code == "repeated_rows":
        rows = _repeated(log, by_law=False)  # the law that explains all has the rows as they are
    yield from filter(None, [rows, *found])
    if not found and rows is None:
        size = np.abs(log.residual).max()
        yield Departure(
            "unknown",
            f"the logged command departs from the wall law by up to {size:.3g}, in {int(off.sum())} of {len(off)} rows",
            int(off.sum()),
        )


def _gaps(log: LogRows) -> Departure | None:
    """Rows that the stamps skip."""
    gaps = np.flatnonzero(np.rint(np.diff(log.time) / log.period) > 1)
    if not len(gaps):
        return None
    lost = int((np.rint(np.diff(log.time) / log.period)[gaps] - 1).sum())
    return Departure("missing_rows", f"the stamps skip {lost} rows, first after row {gaps[0]}", len(gaps), lost)


def _hidden(log: LogRows) -> tuple[Departure, ...] | None:
    rows = hidden_rows(log)
    if not len(rows):
        return None
    return (
        Departure(
            "missing_rows",
            f"{len(rows)} single rows, first row {rows[0]}, fit the wall law only with a row missing before them",
            int(log.after.sum()),
            float(len(rows)),
        ),
    )


def _repeated(log: LogRows, *, by_law: bool = True) -> Departure | None:
    rows = repeated_rows(log, by_law=by_law)
    if not len(rows):
        return None
    both = int((log.command[rows] == log.command[rows - 1]).sum())
    what = "rows repeat the one before" if both > len(rows) / 2 else "readings of the position are held"
    # the row after a repeated one is off the law, too
    off = int((np.abs(log.residual) > log.rounding).sum())
    return Departure(
        "repeated_rows",
        f"{len(rows)} {what} while the device moves, first row {rows[0]}",
        off if off <= 2 * len(rows) else len(rows),
        float(len(rows)),
    )


def _clipped(log: LogRows) -> tuple[Departure, ...] | None:
    demand = log.step * log.after - log.wall
    low, high = float(log.command.min()), float(log.command.max())
    if is_equal(np.array([low, high]), log.step).any():
        return None  # a command that never passes the step is that of a wall that never pulls
    at = [is_equal(log.command, limit) for limit in (low, high)]
    beyond = [(demand < low - log.rounding) & at[0], (demand > high + log.rounding) & at[1]]
    count = int(beyond[0].sum() + beyond[1].sum())
    if count < PLATEAU:
        return None
    found = Departure(
        "saturation",
        f"the logged command is clipped at {high if beyond[1].any() else low:.4g} in {count} rows",
        count,
        float(max(abs(low) if beyond[0].any() else 0.0, abs(high) if beyond[1].any() else 0.0)),
    )
    free = ~(at[0] & beyond[0]) & ~(at[1] & beyond[1])
    return (found,) if not log.off(demand, free) else None


def _one_sided(log: LogRows) -> tuple[Departure, ...] | None:
    """A wall that exists on one side of its surface, or that only pushes."""
    inside = (log.position - log.position[0]) * np.sign(log.step) > 0
    pushing = np.maximum(log.wall * np.sign(log.step), 0.0) * np.sign(log.step)
    force = log.step * log.after
    for predicted, how in (
        (force - np.where(inside, log.wall, 0.0), "is there on one side of x_0 only"),
        (force - np.where(inside, pushing, 0.0), "is there on one side of x_0 and only pushes"),
        (force - pushing, "only pushes and never pulls"),
    ):
        if not log.off(predicted):
            rows = int((np.abs(log.residual) > log.rounding).sum())
            return (Departure("unilateral_wall", f"the wall {how}: {rows} rows without its force", rows),)
    return None


def _offset(log: LogRows) -> tuple[Departure, ...] | None:
    """A constant beside the law, from the first row on or from the step on."""
    value = float(np.median(log.residual[log.after]))
    if np.abs(log.residual - value).max() <= log.rounding:
        return (
            Departure(
                "constant_force",
                f"the command holds a constant {value:.4g} beside the wall law",
                len(log.residual),
                value,
            ),
        )
    if np.abs(log.residual - value * log.after).max() <= log.rounding:
        return (
            Departure(
                "step_not_a_step",
                f"the step is {log.step + value:.6g}, its header says {log.step:.6g}",
                int(log.after.sum()),
                log.step + value,
                obeyed=(log.stiffness, log.damping, log.step + value),
            ),
        )
    return None


def _other_step(log: LogRows) -> tuple[Departure, ...] | None:
    """An external force that rises over several rows, or in several steps.

    A quantum, gains and a ramp that are decimals make numbers that look printed with few of them; the force at the end
    of the log shows what its rounding is.
    """
    end = log.external[len(log.external) // 2 :]
    seen = float(np.ptp(end)) + PRINTED_IN_FULL * float(np.abs(end).max())
    return _levels(log, log.rounding) or (_levels(log, seen) if seen < log.rounding else None)


def _levels(log: LogRows, rounding: float) -> tuple[Departure, ...] | None:
    e = log.external
    turns = np.flatnonzero(np.abs(np.diff(e)) > 2 * rounding) + 1
    if not len(turns):
        return None
    starts = np.concatenate([[0], turns])
    lengths = np.diff(np.concatenate([starts, [len(e)]]))
    first, last = int(turns[0]), int(turns[-1])
    level = float(e[last])
    ramp = last - first + 1
    rising = np.diff(e[first - 1 : last + 1]) * np.sign(level) > 0
    if (
        ramp > 1
        and ramp <= max(LONGEST_RAMP * len(e), 2)
        and rising.all()
        and lengths[1:-1].max(initial=1) < LEVEL_ROWS
    ):
        return (
            Departure(
                "step_not_a_step",
                f"the step rises over {ramp} rows, from row {first} to row {last}, to {level:.4g}",
                ramp,
                float(ramp),
            ),
        )
    levels = [(int(s), float(e[s])) for s, length in zip(starts, lengths, strict=True) if length >= LEVEL_ROWS]
    if 2 < len(levels) <= MOST_LEVELS and lengths[lengths < LEVEL_ROWS].sum() <= LEVEL_ROWS * len(levels):
        text = ", ".join(f"{value:.4g} from row {row}" for row, value in levels[1:])
        return (
            Departure(
                "several_steps",
                f"the external force has {len(levels) - 1} steps: {text}",
                len(e) - log.edge,
                float(len(levels) - 1),
            ),
        )
    return None


def _other_wall(log: LogRows) -> tuple[Departure, ...] | None:
    """Another stiffness, damping, step or sign than the header's."""
    displacement = log.position - log.position[0]
    terms = np.stack([log.after.astype(np.float64), -displacement, -log.change / log.period], axis=1)
    values = fit(terms, log.command)
    if log.off(np.matmul(terms, values).astype(np.float64)):
        return None
    # what moves the command by less than its rounding is nothing
    values[np.abs(values) * np.abs(terms).max(axis=0) <= log.rounding] = 0.0
    step, stiffness, damping = map(float, values)
    evidence = (
        f"the command obeys K = {stiffness:.6g}, B = {damping:.6g} and a step of {step:.6g}; its header says "
        f"K = {log.stiffness:.6g}, B = {log.damping:.6g}, {log.step:.6g}"
    )
    return (Departure("other_wall", evidence, len(log.command), obeyed=(stiffness, damping, step)),)


def _other_unit(log: LogRows) -> tuple[Departure, ...] | None:
    """Stiffness and damping that are a power of ten times the header's, however the velocity is filtered."""
    if (scale := scale_in(log)) is None or not power_of_ten(scale.wall):
        return None
    stiffness, damping = scale.wall * log.stiffness, scale.wall * log.damping
    evidence = (
        f"the command obeys about K = {stiffness:.3g}, B = {damping:.3g}; its header says K = {log.stiffness:.6g}, "
        f"B = {log.damping:.6g}"
    )
    found = (stiffness, damping, scale.step * log.step)
    return (Departure("other_unit", evidence, len(log.command), scale.wall, obeyed=found),)


def _filtered(log: LogRows, clipped: Booleans | None = None) -> tuple[Departure, ...] | None:
    """A filter of the velocity: over N samples, else recursive, of the lowest order; some rows may be clipped."""
    if log.damping == 0:
        return None
    force = log.step * log.after - log.stiffness * (log.position - log.position[0])
    output = (force - log.command) * (log.period / log.damping)
    tolerance = log.rounding * log.period / abs(log.damping) + EXPLAINED * float(np.abs(log.change).max())
    free = np.ones_like(log.after) if clipped is None else ~clipped
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
    if found is None:
        return None
    return (
        Departure("saturation", f"the logged command is clipped at {limit:.4g} in {rows} rows", rows, limit),
        *found,
    )


_EXPLANATIONS: tuple[Callable[[LogRows], tuple[Departure, ...] | None], ...] = (
    _clipped,
    _one_sided,
    _offset,
    _other_unit,
    _other_wall,
    _filtered,
    _hidden,
    _other_step,
    _filtered_and_clipped,
)
"""In order: what leaves nothing in any row before what explains single ones, which a slow device and a coarse sensor
make look like missing rows or steps."""
