"""Logs as the model takes them: stretches of rows in motion, whose start is unknown, with the commands before them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from pipeline.measured.signal.sensor import position_quantum
from pipeline.records.batch import Booleans, Floats, Integers

REGULAR = 0.05
"""Largest distance of a row from an even grid, in samples, at which stamps count as scatter of the clock that wrote
them and the rows as even; the logs of real-time controllers stay below 0.01, those of polling loops reach 0.3."""

GAP = 1.5
"""Pause in sampling periods from which on a command is missing between two rows, where it differs behind them."""

LONGEST = 1000
"""Rows of a stretch: a longer log is cut, so that stretches are computed together."""

SHORTEST = 8
"""Rows of the shortest stretch that says more than its own start."""

EXACT = 1e-9
"""Error of a reading, relative to the largest way, that computing may leave: no part explains less."""

SURE = 4.0
"""Speed in its standard errors from which on its direction counts as seen; wrong in 6e-5 of the rows."""

EARLIER = 50
"""Rows at rest before a start that are kept: they give the position from which it starts to a seventh of the noise."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One log: time [s], command [N, Nm] and position [m, rad], shape (rows,); its name and sampling period [s].

    ``edge`` is the row, counted from 0, that is declared as that of a step from rest.
    """

    name: str
    time: Floats
    command: Floats
    position: Floats
    period: float
    edge: int | None = None

    @cached_property
    def motion(self) -> Motion:
        """How it moves."""
        return motion_of(self)

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a reading's error."""
        return reading_noise(self.position)

    @cached_property
    def rounding(self) -> float:
        """Standard deviation of a reading's rounding, 0 where none is seen."""
        return rounding(self.position)


@dataclass(frozen=True)
class LogUnits:
    """Units of the estimator: sampling period [s], position from its origin [m, rad] and command [N, Nm].

    The origin is where a spring is relaxed: where most logs begin, or None for the beginning of each log, as of a hand
    that takes hold of the device there. What holds the device else is a constant force.
    """

    period: float
    position: float
    command: float
    origin: float | None

    @classmethod
    def of(cls, recordings: list[Recording]) -> LogUnits:
        """Return the units in which readings and commands of recordings are near 1."""
        spread = max((float(np.ptp(each.position)) for each in recordings), default=0.0)
        force = max((float(np.abs(each.command).max()) for each in recordings), default=0.0)
        period = float(np.median([each.period for each in recordings]))
        origin = float(np.median([each.position[0] for each in recordings]))
        return cls(period, spread or 1.0, force or 1.0, origin)


@dataclass(frozen=True, eq=False)
class Stretches:
    """S stretches of at most N rows, in the units of `LogUnits`; `lead` rows of commands stand before the readings.

    ``distinct`` (S,) is the number of readings that say something of their own, ``least`` (S,) the variance that
    rounding alone leaves of a reading.

    ``time`` (lead + N + 1, S), ``command`` and ``acts`` (lead + N, S): whether the force of a row acts on the device,
    which friction holds before; ``position`` (N, S); ``rows``, ``trial``, ``direction`` of motion (0 where it is not
    asked for) and ``rests`` (starts at rest) of shape (S,).
    """

    time: Floats
    command: Floats
    acts: Floats
    position: Floats
    direction: Floats
    rows: Integers
    trial: Integers
    rests: Booleans
    distinct: Floats
    least: Floats
    lead: int
    regular: bool

    @cached_property
    def valid(self) -> Booleans:
        """Which rows are readings, shape (N, S)."""
        return np.asarray(np.arange(len(self.position))[:, None] < self.rows[None])

    @cached_property
    def driven(self) -> Floats:
        """Command where it acts on the device, shape (lead + N, S)."""
        return np.asarray(self.command * self.acts)

    @cached_property
    def white(self) -> float:
        """Variance of a reading by third differences, which motion does not have; no less than that of rounding."""
        third = np.diff(self.position, 3, axis=0)[self.valid[3:]]
        of_noise = float(np.median(np.abs(third)) / 0.6745) ** 2 / 20 if len(third) else 0.0
        return max(of_noise, float(np.median(self.least)), EXACT**2)

    def __len__(self) -> int:
        return len(self.rows)

    def shorter(self, most: int) -> Stretches:
        """Return the stretches as parts of at most so many rows, each with a start of its own."""
        n = len(self.position)
        parts = -(-n // most)
        size = -(-n // parts)

        def cut(values: Floats, more: int) -> Floats:
            whole = np.pad(values, ((0, parts * size - n), (0, 0)), mode="edge")
            return np.concatenate([whole[i * size : (i + 1) * size + more] for i in range(parts)], axis=1)

        rows = np.concatenate([np.clip(self.rows - i * size, 0, size) for i in range(parts)])
        rests = np.concatenate([self.rests & (i == 0) for i in range(parts)])
        whole = Stretches(
            cut(self.time, self.lead + 1),
            cut(self.command, self.lead),
            cut(self.acts, self.lead),
            cut(self.position, 0),
            np.tile(self.direction, parts),
            rows,
            np.tile(self.trial, parts),
            rests,
            np.tile(self.distinct, parts),
            np.tile(self.least, parts),
            self.lead,
            self.regular,
        )
        return whole.chosen(rows >= SHORTEST)

    def chosen(self, which: Integers | Booleans) -> Stretches:
        """Return some of the stretches, cut to the longest of them."""
        rows = self.rows[which]
        n = int(rows.max(initial=1))
        cut = self.lead + n
        return Stretches(
            self.time[: cut + 1, which],
            self.command[:cut, which],
            self.acts[:cut, which],
            self.position[:n, which],
            self.direction[which],
            rows,
            self.trial[which],
            self.rests[which],
            self.distinct[which],
            self.least[which],
            self.lead,
            self.regular,
        )


@dataclass(frozen=True, eq=False)
class _Cut:
    """Part of a recording: first row and the row behind its last; the row of the command that starts it from rest."""

    trial: int
    first: int
    behind: int
    direction: float
    edge: int | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """How a recording moves: velocity smoothed over ``half`` rows to each side, its error, directions seen."""

    velocity: Floats
    error: float
    half: int
    direction: Integers = field(repr=False)


def motion_of(recording: Recording) -> Motion:
    """Return the smoothed motion: a parabola over as many rows as bring the error to a thirtieth of the top speed."""
    x, rows = recording.position, len(recording.position)
    noise = recording.noise
    half, velocity, error = 1, np.gradient(x), np.inf
    while 2 * half + 1 <= max(rows // 4, 3):
        about = np.arange(half, -half - 1, -1.0)
        squares = float(about @ about)
        reflected = np.pad(x, half, mode="reflect", reflect_type="odd")
        velocity = np.convolve(reflected, about / squares, mode="valid")
        error = noise / np.sqrt(squares)
        if error * 30 <= np.abs(velocity).max(initial=0.0):
            break
        half = max(half + 1, int(half * 1.5))
    # at both ends half of the rows are reflections: their error is that of half as many rows, and counts twice
    near = np.minimum(np.arange(rows), np.arange(rows)[::-1]) < half
    seen = np.abs(velocity) > SURE * error * np.where(near, 3.0, 1.0)
    return Motion(velocity, float(error), half, np.where(seen, np.sign(velocity), 0).astype(np.int64))


def reading_noise(position: Floats) -> float:
    """Return the standard deviation of a reading's error: of third differences, or of rounding to the quantum."""
    third = np.diff(position, 3)
    noise = float(np.median(np.abs(third))) / 0.6745 / np.sqrt(20.0) if len(third) else 0.0
    return float(max(noise, rounding(position), 1e-12 * float(np.ptp(position))))


def rounding(position: Floats) -> float:
    """Return the standard deviation of a reading's rounding to the sensor's resolution, 0 where none is seen.

    A fast motion may change by several steps of the sensor in every row, a steady one by a whole number of them.
    """
    return float(position_quantum(position[None])[0]) / float(np.sqrt(12.0))


def stretches(recordings: list[Recording], units: LogUnits, lead: int, moving: bool) -> Stretches:
    """Return the stretches of recordings.

    Parameters
    ----------
    recordings : list of Recording
    units : LogUnits
    lead : int
        Rows of commands that are needed before a reading: the delay, rounded up.
    moving : bool
        Only rows at which the direction of motion is known, as friction needs, each stretch in one of them: where a
        motion turns is known to a part of a row only. Else all rows.
    """
    cuts: list[_Cut] = []
    even = [_even(each.time / units.period) for each in recordings]
    for trial, (each, grid) in enumerate(zip(recordings, even, strict=True)):
        if len(grid) < SHORTEST:
            continue
        pauses = np.flatnonzero((np.diff(grid) > GAP * each.period / units.period) & (np.diff(each.command) != 0)) + 1
        bounds = [0, *pauses.tolist(), len(grid)]
        seen = each.motion if moving else None
        for first, behind in pairwise(bounds):
            start = first if first == 0 and _starts_at_rest(each) else first + lead
            if behind - start >= SHORTEST:
                cuts += _moving(trial, each, seen, (start, behind), lead) if seen else _all(trial, start, behind)
    return _padded(recordings, even, cuts, units, lead)


def _even(time: Floats) -> Floats:
    """Return times [samples] on an even grid where they lie within `REGULAR` of one."""
    if len(time) < SHORTEST:
        return time
    index = np.arange(len(time))
    even = time[0] + index * (time[-1] - time[0]) / max(len(time) - 1, 1)
    spacing = (time[-1] - time[0]) / max(len(time) - 1, 1)
    if abs(spacing - 1) < 1e-3:
        even = time[0] + index.astype(np.float64)
        even += np.median(time - even)
    return even if np.abs(time - even).max() < REGULAR + 2e-3 * len(time) * (abs(spacing - 1) < 1e-3) else time


def _starts_at_rest(recording: Recording) -> bool:
    """Return whether position and command do not change in the first rows, so that what came before does not matter."""
    few = min(5, len(recording.position) - 1)
    noise = recording.noise
    first = recording.position[: few + 1]
    return bool(np.ptp(first) <= max(6 * noise, 1e-4 * np.ptp(recording.position))) and bool(
        np.ptp(recording.command[:few]) <= 1e-3 * np.ptp(recording.command) + 1e-12
    )


def _all(trial: int, first: int, behind: int) -> list[_Cut]:
    count = max(1, round((behind - first) / LONGEST))
    bounds = np.linspace(first, behind, count + 1).astype(int).tolist()
    return [_Cut(trial, a, b, 0.0) for a, b in pairwise(bounds)]


def _moving(trial: int, each: Recording, seen: Motion, rows: tuple[int, int], lead: int) -> list[_Cut]:
    """Return the parts of some rows in which the device moves in one direction."""
    first, behind = rows
    sign = seen.direction[first:behind]
    edges = np.flatnonzero(np.diff(sign)) + 1
    found: list[_Cut] = []
    for a, b in pairwise([0, *edges.tolist(), len(sign)]):
        # the smoothed velocity still moves as many rows behind a stop as it takes from before it
        stop = b - seen.half if b < len(sign) else b
        if not sign[a] or stop <= a:
            continue
        edge = _edge(each, seen, first, first + a, lead)
        begin = max(first, edge - EARLIER) if edge is not None else first + a + seen.half * (a > 0)
        bounds = [*range(begin, first + stop, LONGEST), first + stop]
        found += [
            _Cut(trial, i, j, float(sign[a]), edge if i == begin else None)
            for i, j in pairwise(bounds)
            if j - i >= SHORTEST
        ]
    return found


def _edge(each: Recording, seen: Motion, first: int, moves: int, lead: int) -> int | None:
    """Return the row at which a command jumps and sets the device in motion from rest, None where none does."""
    if each.edge is not None and first <= each.edge <= moves <= each.edge + lead + EARLIER:
        # behind the first turn it comes from no rest
        return None if seen.direction[each.edge : moves].any() else each.edge
    begin = max(first, moves - lead - EARLIER)
    resting = np.abs(seen.velocity[begin:moves]) <= SURE * seen.error
    if moves - begin < 3 or not resting.all():
        return None
    jumps = np.abs(np.diff(each.command[max(begin - 1, 0) : moves + 1]))
    whole = float(np.ptp(each.command[begin : moves + 1]))
    if whole == 0 or jumps.max() < 0.5 * whole:
        return None
    edge = max(begin - 1, 0) + int(np.argmax(jumps)) + 1
    return edge if edge - begin >= 2 else None


def _distinct(position: Floats, rounding: float) -> int:
    """Return the number of readings that say something of their own.

    One that repeats the one before says nothing new; nor does, of a sensor with steps, one of a motion by as many steps
    as in the row before: its rounding is the same.
    """
    changes = np.diff(position)
    bends = np.abs(np.diff(changes)) > 0.1 * np.sqrt(12.0) * rounding if rounding > 0 else np.ones(len(changes))
    return 1 + int(min(np.count_nonzero(changes), np.count_nonzero(bends) + 1))


def _padded(recordings: list[Recording], even: list[Floats], cuts: list[_Cut], units: LogUnits, lead: int) -> Stretches:
    n, count = max((cut.behind - cut.first for cut in cuts), default=1), len(cuts)
    time = np.zeros((lead + n + 1, count))
    command, acts = np.zeros((lead + n, count)), np.ones((lead + n, count))
    position, distinct = np.zeros((n, count)), np.zeros(count)
    least = [(each.rounding / units.position) ** 2 + EXACT**2 for each in recordings]
    for s, cut in enumerate(cuts):
        each, grid = recordings[cut.trial], even[cut.trial]
        rows = np.arange(cut.first - lead, cut.first + n)
        inside = np.clip(rows, 0, len(grid) - 1)
        step = each.period / units.period
        whole = np.arange(cut.first - lead, cut.first + n + 1)
        at = np.clip(whole, 0, len(grid) - 1)
        time[:, s] = grid[at] + (whole - at) * step - grid[cut.first]
        command[:, s] = each.command[inside] / units.command
        here = cut.behind - cut.first
        origin = each.position[0] if units.origin is None else units.origin
        position[:here, s] = (each.position[cut.first : cut.behind] - origin) / units.position
        distinct[s] = _distinct(each.position[cut.first : cut.behind], each.rounding)
        if cut.edge is not None:
            acts[:, s] = rows >= cut.edge
    regular = bool(count) and bool(np.abs(np.diff(time, axis=0) - 1).max() < 1e-6)
    return Stretches(
        time,
        command,
        acts,
        position,
        np.array([cut.direction for cut in cuts], dtype=np.float64),
        np.array([cut.behind - cut.first for cut in cuts], dtype=np.int64),
        np.array([cut.trial for cut in cuts], dtype=np.int64),
        np.array([cut.edge is not None for cut in cuts], dtype=bool),
        distinct,
        np.array([least[cut.trial] for cut in cuts], dtype=np.float64),
        lead,
        regular,
    )
