"""Divide logs into segments.

A segment is a range of rows in motion with an unknown initial state. Its rows are numbered over all trials.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pipeline.measured.identification.kernels import ALWAYS
from pipeline.measured.identification.recordings import SHORTEST, SURE, LogUnits, Motion, Recording, median
from pipeline.records.trials import Booleans, Floats, Integers

EARLIER = 50
"""Number of rows at rest before a start that are kept. They reduce the error of the initial position to a seventh."""

EXACT = 1e-9
"""Relative numerical error of a reading, as a share of the largest displacement. Smaller residuals do not justify a
part."""

LONGEST = 1000
"""Largest number of rows of a segment. Longer logs are cut, so that a slowly changing force does not affect the motion
within a segment."""

GAP = 1.5
"""Smallest pause between two rows, in sampling periods, that counts as a missing command if the command changes
there."""

REGULAR = 0.05
"""Largest distance of a row from an even grid, in samples, that is attributed to scattered time stamps of even rows. It
is below 0.01 for real-time controllers and up to 0.3 for polling loops."""


@dataclass(frozen=True, eq=False)
class _Cut:
    """Part of a recording, given by its first row, the row after its last row, and the row of a command edge at its
    start."""

    trial: int
    first: int
    behind: int
    direction: float
    edge: int | None = None


@dataclass(frozen=True, eq=False)
class Segments:
    """S segments in the units of `LogUnits`, as ranges of the R rows of T trials.

    Parameters
    ----------
    offsets : int64, shape (T + 1,)
        Rows of trial i are ``offsets[i]`` to ``offsets[i + 1]`` of the flat arrays.
    time, command, position : float64, shape (R,)
    first, behind : int64, shape (S,)
        Rows of each segment.
    trial : int64, shape (S,)
    edge : int64, shape (S,)
        First row in which forces act. Friction keeps the device at rest before it. `ALWAYS` for a segment that does not
        start at rest.
    direction : float64, shape (S,)
        Direction of motion, or 0 if it is not needed.
    distinct, least : float64, shape (S,)
        Number of readings that contain new information, and variance of a reading due to rounding only.
    lead : int
        Number of rows before a segment whose commands affect its motion.
    even : bool
        Whether all rows of the segments, and the rows before them that affect them, are one sample apart.
    free : tuple of float
        Coefficients 1, a_1, a_2 ... of the filter that whitens the errors of free runs. In a free run, friction acts
        against the simulated motion. Empty if friction acts against the measured motion instead.
    scale : float
        Angle [rad] of a position of 1 if the device turns, otherwise 0.
    origins : float64, shape (T,)
        Angle [rad] at the position 0 of each trial.
    """

    offsets: Integers
    time: Floats
    command: Floats
    position: Floats
    first: Integers
    behind: Integers
    trial: Integers
    edge: Integers
    direction: Floats
    distinct: Floats
    least: Floats
    lead: int
    even: bool
    free: tuple[float, ...] = ()
    scale: float = 0.0
    origins: Floats = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.first)

    @property
    def trials(self) -> int:
        """Number of trials T. Some trials may have no segment."""
        return len(self.offsets) - 1

    @cached_property
    def rows(self) -> Integers:
        """Number of rows of each segment, shape (S,)."""
        return self.behind - self.first

    @cached_property
    def begin(self) -> Integers:
        """First row of the trial of each segment, shape (S,)."""
        return np.asarray(self.offsets[self.trial])

    @cached_property
    def rests(self) -> Booleans:
        """Whether each segment starts at rest, shape (S,)."""
        return np.asarray(self.edge > ALWAYS)

    @cached_property
    def places(self) -> Integers:
        """Indices of the rows of all segments in the flat arrays, in order."""
        start = np.cumsum(self.rows) - self.rows
        return np.asarray(np.arange(int(self.rows.sum())) + np.repeat(self.first - start, self.rows))

    @cached_property
    def segment(self) -> Integers:
        """Segment of each row in `places`."""
        return np.repeat(np.arange(len(self)), self.rows)

    @cached_property
    def spans(self) -> tuple[Floats, Integers]:
        """Distinct lengths of intervals [samples], and index of the interval after each row. There is one value if rows
        are even."""
        if self.even:
            return np.ones(1), np.zeros(1, np.int64)
        span = np.append(np.diff(self.time), 1.0)
        span[self.offsets[1:][self.offsets[1:] > 0] - 1] = 1.0
        _, first, kind = np.unique(np.round(span, 9), return_index=True, return_inverse=True)
        return span[first], kind.astype(np.int64)

    @cached_property
    def between(self) -> Floats:
        """Position in the middle of the interval after each row, within segments, shape (R,)."""
        result = self.position.copy()
        inner = self.places[np.append(np.diff(self.segment) == 0, [False])[: len(self.places)]]
        result[inner] = 0.5 * (self.position[inner] + self.position[inner + 1])
        return result

    @cached_property
    def angle(self) -> Floats:
        """Angle in the middle of the interval after each row, within segments, shape (R,) [rad]."""
        return np.asarray(self.scale * self.between + np.repeat(self.origins, np.diff(self.offsets)))

    @cached_property
    def white(self) -> float:
        """Variance of a reading from third differences, in which motion is negligible. Rounding is the lower bound."""
        third = np.diff(self.position[self.places], 3)[self.segment[3:] == self.segment[:-3]]
        of_noise = (median(np.abs(third)) / 0.6745) ** 2 / 20 if len(third) else 0.0
        return max(of_noise, self.usual_least, EXACT**2)

    @cached_property
    def usual_least(self) -> float:
        """Median variance of a reading due to rounding only."""
        return median(self.least)

    @cached_property
    def largest(self) -> float:
        """Largest distance of a reading from the origin."""
        return float(np.abs(self.position[self.places]).max(initial=0.0))

    def select(self, which: Integers | Booleans | slice) -> Segments:
        """Return the selected segments."""
        arrays = ("first", "behind", "trial", "edge", "direction", "distinct", "least")
        return replace(self, **{name: getattr(self, name)[which] for name in arrays})

    def subset(self, most: int) -> Segments:
        """Return at most ``most`` segments, spread evenly over all segments, with the rows of their trials only."""
        if most >= len(self):
            return self
        some = self.select(np.linspace(0, len(self) - 1, most).round().astype(np.int64))
        used = np.zeros(self.trials, dtype=bool)
        used[some.trial] = True
        rows = np.diff(self.offsets)
        kept = np.repeat(used, rows)
        offsets = np.append(0, np.cumsum(np.where(used, rows, 0)))
        shift = (offsets - self.offsets)[some.trial]
        return replace(
            some,
            offsets=offsets,
            time=self.time[kept],
            command=self.command[kept],
            position=self.position[kept],
            first=some.first + shift,
            behind=some.behind + shift,
            edge=np.where(some.rests, some.edge + shift, some.edge),
        )

    def split(self, most: int) -> Segments:
        """Split segments into parts of at most ``most`` rows. Each part has a separate initial state."""
        parts = -(-self.rows // most)
        size = np.repeat(-(-self.rows // parts), parts)
        number = np.arange(int(parts.sum())) - np.repeat(np.cumsum(parts) - parts, parts)
        whole = self.select(np.repeat(np.arange(len(self)), parts))
        first = whole.first + number * size
        cut = replace(
            whole,
            first=first,
            behind=np.minimum(first + size, whole.behind),
            edge=np.where(number == 0, whole.edge, ALWAYS),
        )
        return cut.select(cut.rows >= SHORTEST)


def segments_of(
    recordings: list[Recording],
    units: LogUnits,
    lead: int,
    moving: bool,
    free: tuple[float, ...] = (),
    *,
    whole: bool = False,
) -> Segments:
    """Divide recordings into segments.

    Parameters
    ----------
    recordings : list of Recording
    units : LogUnits
    lead : int
        Number of rows of commands needed before a reading: the delay, rounded up.
    moving : bool
        Whether only rows with a known direction of motion are used, in segments of one direction. Friction requires
        this, since the time of a reversal is uncertain by a fraction of a row. Otherwise all rows are used.
    free : tuple of float
        As in `Segments`. If it is not empty, logs are not cut, since free runs include reversals.
    whole : bool
        Whether logs longer than `LONGEST` are not cut.
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
                most = behind if free or whole else LONGEST
                cuts += _moving(trial, each, seen, (start, behind), lead) if seen else _all(trial, start, behind, most)
    return replace(_joined(recordings, even, cuts, units, lead), free=free)


def _even(time: Floats) -> Floats:
    """Return times [samples] on an even grid if they deviate by less than `REGULAR` from it, otherwise unchanged."""
    if len(time) < SHORTEST:
        return time
    index = np.arange(len(time))
    even = time[0] + index * (time[-1] - time[0]) / max(len(time) - 1, 1)
    spacing = (time[-1] - time[0]) / max(len(time) - 1, 1)
    if abs(spacing - 1) < 1e-3:
        even = time[0] + index.astype(np.float64)
        even += median(time - even)
    return even if np.abs(time - even).max() < REGULAR + 2e-3 * len(time) * (abs(spacing - 1) < 1e-3) else time


def _starts_at_rest(recording: Recording) -> bool:
    """Return whether position and command are constant in the first rows, so that earlier commands have no effect."""
    few = min(5, len(recording.position) - 1)
    first = recording.position[: few + 1]
    if np.ptp(recording.command[:few]) > 1e-3 * np.ptp(recording.command) + 1e-12:
        return False
    return bool(np.ptp(first) <= max(6 * recording.noise, 1e-4 * np.ptp(recording.position)))


def _all(trial: int, first: int, behind: int, most: int) -> list[_Cut]:
    count = max(1, round((behind - first) / most))
    bounds = np.linspace(first, behind, count + 1).astype(int).tolist()
    return [_Cut(trial, a, b, 0.0) for a, b in pairwise(bounds)]


def _moving(trial: int, each: Recording, seen: Motion, rows: tuple[int, int], lead: int) -> list[_Cut]:
    """Return the parts of a range of rows in which the device moves in one direction."""
    first, behind = rows
    sign = seen.direction[first:behind]
    edges = np.flatnonzero(np.diff(sign)) + 1
    found: list[_Cut] = []
    for a, b in pairwise([0, *edges.tolist(), len(sign)]):
        # smoothing extends the velocity beyond a stop by half of its window
        stop = b - seen.half if b < len(sign) else b
        if not sign[a] or stop <= a:
            continue
        edge = _edge(each, seen, first, first + a, lead)
        if edge is not None and first + stop <= edge + 1:  # nothing follows the edge because all rows are at rest
            continue
        begin = max(first, edge - EARLIER) if edge is not None else first + a + seen.half * (a > 0)
        bounds = [*range(begin, first + stop, LONGEST), first + stop]
        found += [
            _Cut(trial, i, j, float(sign[a]), edge if i == begin else None)
            for i, j in pairwise(bounds)
            if j - i >= SHORTEST
        ]
    return found


def _edge(each: Recording, seen: Motion, first: int, moves: int, lead: int) -> int | None:
    """Return the row of a command edge that sets the device in motion from rest, or None if there is none."""
    if each.edge is not None and first <= each.edge <= moves <= each.edge + lead + EARLIER:
        # after a reversal, the device does not start from rest
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
    """Return the number of readings that contain new information.

    A reading that equals the previous reading contains no new information. With visible sensor steps, the same is true
    of a reading that changes by as many steps as the previous reading, because its rounding error is equal.
    """
    changes = np.diff(position)
    bends = np.abs(np.diff(changes)) > 0.1 * np.sqrt(12.0) * rounding if rounding > 0 else np.ones(len(changes))
    return 1 + int(min(np.count_nonzero(changes), np.count_nonzero(bends) + 1))


def _joined(recordings: list[Recording], even: list[Floats], cuts: list[_Cut], units: LogUnits, lead: int) -> Segments:
    """Return the segments with the rows of all recordings, in the given units."""
    offsets = np.concatenate([[0], np.cumsum([len(each.time) for each in recordings])]).astype(np.int64)
    origins = [each.position[0] if units.origin is None else units.origin for each in recordings]
    trial = np.array([cut.trial for cut in cuts], dtype=np.int64)
    begin = offsets[trial]
    least = np.array([(each.rounding / units.position) ** 2 + EXACT**2 for each in recordings])
    inside = [(cut, recordings[cut.trial]) for cut in cuts]
    whole = Segments(
        offsets,
        np.concatenate(even),
        np.concatenate([each.command for each in recordings]) / units.command,
        np.concatenate([each.position - x for each, x in zip(recordings, origins, strict=True)]) / units.position,
        begin + np.array([cut.first for cut in cuts], dtype=np.int64),
        begin + np.array([cut.behind for cut in cuts], dtype=np.int64),
        trial,
        np.array([ALWAYS if cut.edge is None else cut.edge + offsets[cut.trial] for cut in cuts], dtype=np.int64),
        np.array([cut.direction for cut in cuts], dtype=np.float64),
        np.array([_distinct(each.position[cut.first : cut.behind], each.rounding) for cut, each in inside], np.float64),
        least[trial],
        lead,
        even=False,
        scale=units.position if all(each.turns for each in recordings) else 0.0,
        origins=np.array(origins, dtype=np.float64),
    )
    return replace(whole, even=bool(len(cuts)) and _is_even(whole))


def _is_even(segments: Segments) -> bool:
    """Return whether the rows of the segments and the commands before them are one sample apart."""
    uneven = np.concatenate([[0], np.cumsum(np.abs(np.diff(segments.time) - 1) > 1e-6)])
    first = np.maximum(segments.first - segments.lead, segments.begin)
    return bool((uneven[segments.behind - 1] == uneven[first]).all())
