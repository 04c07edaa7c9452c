"""Prediction errors: a Kalman filter for a device that a random force disturbs, over all stretches together.

The filter is linear in readings, commands, friction, constant force and start: each is a column that passes it alone,
and the prediction errors of any device with this shape of motion are a sum of columns. For even rows and a random force
that is always as strong the filter is a steady one, a recursion of two to five terms; else it goes row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pipeline.loop.state_space import state_space
from pipeline.measured.model.kalman import filter_gains, prediction_errors
from pipeline.measured.model.motion import SMALL, Pieces, PlantShape, at_times, pieces
from pipeline.measured.model.recordings import Stretches
from pipeline.records.batch import Floats, Integers

DOUBLINGS = 60
"""Most doublings of a filter's memory until it is steady: 2^40 samples are the longest that doubles tell from none."""

STEADY = 1e-14
"""Change of a filter's variance in a doubling, relative to it, that is rounding."""


FORGETS = 1e-6
"""By how much the largest eigenvalue of a filter's errors may exceed 1 by rounding: a filter forgets its start."""


@dataclass(frozen=True)
class Noise:
    """Beside that of the readings: a random force, and a delay that jitters.

    Parameters
    ----------
    force : float
        Variance of the random force over a sample, in that of a reading.
    late : float
        Variance of a force that a command of 1 makes, in that of a reading; 0 without jitter.
    jitter : float
        Standard deviation of the age of the command in force [samples].
    jitter_error : float
        Standard error of it.
    """

    force: float = 0.0
    late: float = 0.0
    jitter: float = 0.0
    jitter_error: float = 0.0


WHITE = Noise()
"""No noise but that of the readings."""


@dataclass(frozen=True, eq=False)
class Column:
    """What passes a filter alone; what is None is 0.

    Parameters
    ----------
    readings : float64, shape (N, S), optional
    command : float64, shape (lead + N, S), optional
        Force behind the delay and the lag, where it acts on the device.
    direct : float64, shape (N, S) or (S,), optional
        Force on the motor's side in an interval, where the command in force acts.
    start : float64, shape (S, n), optional
        State at the first row beside the drive's force by the commands before it; a spring is held at its position
        while the stretch still rests.
    """

    readings: Floats | None = None
    command: Floats | None = None
    direct: Floats | None = None
    start: Floats | None = None


class Passage:
    """What stretches become of in a device: transitions and gains of their intervals."""

    def __init__(self, held: Stretches, shape: PlantShape, jitter: float = 0.0) -> None:
        self.held, self.shape = held, shape
        system = state_space(shape.plant)
        self.sensor, self.states = system.sensor, len(system.sensor)
        self._inputs = np.stack([system.command, system.force], axis=1)
        self._matrix = system.matrix
        self.pieces: Pieces = pieces(held.time, held.lead, shape.delay, held.regular, jitter)
        one = np.ones((1, 1)) if held.regular else np.diff(held.time[held.lead :], axis=0)
        moved, gained = at_times(self._matrix, self._inputs, one)
        self.transition, self.disturbed = moved, gained[..., 1]

    @cached_property
    def gains(self) -> Floats:
        """What unit command and force over each piece add, (P, N or 1, S or 1, n, 2)."""
        return self.pieces.gains(self._matrix, self._inputs)

    @cached_property
    def acts(self) -> Floats:
        """Whether the command in force in each piece of an interval acts on the device, (P, N, S)."""
        return np.stack([self.held.acts[row, self._column] for row in self.pieces.row])

    @cached_property
    def commands(self) -> Floats:
        """Mean command in each interval by each age that the one in force may have, (N, S, A)."""
        pieces = self.pieces
        span = np.ones((1, 1)) if self.held.regular else np.diff(self.held.time[self.held.lead :], axis=0)
        result = np.zeros((*self.held.position.shape, len(pieces.chances)))
        for row, age, width in zip(pieces.row, pieces.age, (pieces.begins - pieces.ends) / span, strict=True):
            result[..., age] += self.held.driven[row, self._column] * width
        return result

    @cached_property
    def before(self) -> Floats:
        """What remains at the first row of the force by each command before it, and of that before all, behind a lag;
        shape (lead + 1, S)."""
        held, shape = self.held, self.shape
        since = np.maximum(held.time[held.lead] - shape.delay - held.time[: held.lead + 1], 0.0)
        left = np.exp(-since / shape.lag)
        return np.vstack([np.diff(left, axis=0), left[:1]])

    def started(self, column: Column) -> Column:
        """Return a column with the drive's force at its start, as far as its commands before it tell."""
        if column.command is None or not self.shape.lag:
            return column
        # what came before the first command is taken to be alike
        force = (self.before[:-1] * column.command[: self.held.lead]).sum(axis=0) + self.before[-1] * column.command[0]
        start = np.zeros((len(self.held), self.states), force.dtype)
        start[:, -1] = force
        return replace(column, start=start if column.start is None else start + column.start)

    def plain(self, kind: type[float] | type[complex]) -> tuple[Floats, Floats, Floats]:
        """Return transitions, what a force over a whole interval adds, and the sensor's row, as compiled loops take
        them."""
        transition, disturbed, sensor = (
            np.ascontiguousarray(each, kind) for each in (self.transition, self.disturbed, self.sensor)
        )
        return transition, disturbed, sensor

    @property
    def _column(self) -> Integers:
        return np.arange(len(self.held))[None, :]

    def forces(self, column: Column) -> list[tuple[int, int, Floats]]:
        """Return the forces of a column: piece, place of the gain, and the force in each interval (N, S)."""
        found: list[tuple[int, int, Floats]] = []
        resting = column.start is not None and self.shape.gamma != 0 and self.held.rests.any()
        for piece, (row, acts) in enumerate(zip(self.pieces.row, self.acts, strict=True)):
            if column.command is not None:
                found.append((piece, 0, column.command[row, self._column]))
            direct = 0.0 if column.direct is None else column.direct * acts
            if resting and column.start is not None:
                direct = direct + self.shape.gamma * (1 - acts) * column.start[:, 0] * self.held.rests
            if column.direct is not None or resting:
                found.append((piece, 1, np.asarray(direct)))
        return found

    def starts(self) -> list[Column]:
        """Return each unknown of the start as a column."""
        count, result = len(self.held), []
        for state in range(self.states):
            unit = np.zeros((count, self.states))
            unit[:, state] = self.before[-1] if self.shape.lag and state == self.states - 1 else 1.0
            if state:
                unit[self.held.rests] = 0.0
                if self.held.rests.all():
                    continue
            result.append(Column(start=unit))
        return result


NONE = np.empty((1, 0, 0))
"""Forces of ages where the delay does not jitter."""


@dataclass(frozen=True, eq=False)
class Filter:
    """Gains (N or 1, S or 1, n + A) of a filter and the standard deviations (N or 1, S or 1) of its errors in those of
    a reading; a steady one has one row. Of A ages that the command in force may have ``forces`` (N, S, A) are what each
    would do, and ``ageing`` (A, A) the chances of one after another."""

    gain: Floats
    spread: Floats
    forces: Floats = field(default_factory=NONE.copy)
    ageing: Floats = field(default_factory=NONE[0].copy)

    @classmethod
    def of(cls, passage: Passage, noise: Noise) -> Filter:
        """Return the filter for some noise."""
        n = passage.states
        if noise == WHITE:
            return cls(np.zeros((1, 1, n)), np.ones((1, 1)))
        if passage.held.regular and noise.late == 0:
            return cls._steady(passage, noise.force)
        rows, count = passage.held.position.shape
        forces, ageing, chances = np.empty((rows, count, 0)), NONE[0], np.empty(0)
        if noise.late:
            forces, ageing = np.sqrt(noise.late) * passage.commands, passage.pieces.ageing
            chances = passage.pieces.chances
        # of which age is in force, less how likely it is
        spread_of_ages = np.diag(chances) - np.outer(chances, chances)
        gain, spread = filter_gains(
            *passage.plain(float), forces, ageing, spread_of_ages, noise.force, passage.held.rows
        )
        return cls(gain, spread, forces, ageing)

    @classmethod
    def _steady(cls, passage: Passage, force: float) -> Filter:
        """Return the filter that goes on for ever: its memory of the start is doubled until nothing changes.

        Gains are NaN where doubles do not reach it, as of a device that runs away faster than its readings show.
        """
        moved, pushed, sensor = passage.transition[0, 0], passage.disturbed[0, 0], passage.sensor
        a, g, h = moved.T, np.outer(sensor, sensor), force * np.outer(pushed, pushed)
        for _ in range(DOUBLINGS):
            try:
                inner = np.linalg.inv(np.eye(len(a)) + g @ h)
            except np.linalg.LinAlgError:
                h = np.full_like(h, np.nan)
                break
            a, g, more = a @ inner @ a, g + a @ inner @ g @ a.T, a.T @ h @ inner @ a
            h = h + more
            if np.abs(more).max() <= STEADY * np.abs(h).max():
                break
        variance = 1.0 + float(sensor @ h @ sensor)
        gain = h @ sensor / variance
        errors = moved @ (np.eye(len(moved)) - np.outer(gain, sensor))
        computed = variance >= 1.0 and np.isfinite(errors).all()
        if not computed or np.abs(np.linalg.eigvals(errors)).max() > 1.0 + FORGETS:
            gain, variance = np.full_like(gain, np.nan), np.nan
        return cls(gain[None, None], np.full((1, 1), np.sqrt(variance)))


def passed(passage: Passage, found: Filter, columns: Sequence[Column]) -> list[Floats]:
    """Return the whitened prediction errors of columns, each of shape (N, S)."""
    steady = passage.held.regular and len(found.gain) == 1
    errors = (_recursion if steady else _by_rows)(passage, found, [passage.started(each) for each in columns])
    for each in errors:
        each /= found.spread
        each[~passage.held.valid] = 0.0
    return errors


def slopes(passage: Passage, found: Filter, column: Column, along: Sequence[Passage]) -> list[Floats]:
    """Return the slopes of a column's whitened predictions along numbers, each of shape (N, S); the filter stays.

    ``along`` are passages of devices `PlantShape.along` each number. Differences would drown in rounding, of which the
    recursion of a slow mode leaves a million times that of a number.
    """
    if passage.held.regular and len(found.gain) == 1:
        from scipy.signal import lfilter

        recursion, readings = Recursion.of(passage, found), column.readings
        (error,) = _recursion(passage, found, [passage.started(column)])
        foretold = -error if readings is None else readings - error
        result = []
        for each in along:
            other = Recursion.of(each, found)
            entering = other.entering(each.started(column))
            # of D y = x for polynomials D: D y' = x' - D' y
            change = np.imag(entering) - _delayed(np.imag(other.poles[1:]), foretold)
            result.append(lfilter([1.0], recursion.poles, change / SMALL, axis=0))
    else:
        result = [-np.imag(_by_rows(each, found, [each.started(column)])[0]) / SMALL for each in along]
    for slope in result:
        slope /= found.spread
        slope[~passage.held.valid] = 0.0
    return result


@dataclass(frozen=True, eq=False)
class Recursion:
    """A steady filter as recursions by its characteristic polynomial.

    ``poles`` (n + 1,) is that polynomial; ``weights`` (n, n) what a state that enters once adds to the readings of the
    next rows, as the numerator over the poles.
    """

    passage: Passage
    found: Filter
    poles: Floats
    weights: Floats

    @classmethod
    def of(cls, passage: Passage, found: Filter) -> Recursion:
        """Return the recursion of a device with a filter."""
        gain, n = found.gain[0, 0], passage.states
        matrix = passage.transition[0, 0] @ (np.eye(n) - np.outer(gain, passage.sensor))
        # Faddeev and LeVerrier, exact to rounding for few states
        poles, power, rows = [1.0], np.zeros_like(matrix), [passage.sensor]
        for k in range(1, n + 1):
            power = matrix @ power + poles[-1] * np.eye(n)
            poles.append(-np.trace(matrix @ power) / k)
            rows.append(rows[-1] @ matrix)
        weights = [sum(poles[i] * rows[k - i] for i in range(k + 1)) for k in range(n)]
        return cls(passage, found, np.array(poles), np.array(weights))

    def entering(self, column: Column) -> Floats:
        """Return what of a column drives the recursion of its predictions, (N, S)."""
        passage, gain = self.passage, self.found.gain[0, 0]
        total = np.zeros(passage.held.position.shape, passage.shape.kind)
        for piece, place, force in passage.forces(column):
            total += _delayed(self.weights @ passage.gains[piece, 0, 0, :, place], force)
        if column.readings is not None and gain.any():
            total += _delayed(self.weights @ (passage.transition[0, 0] @ gain), column.readings)
        if column.start is not None:
            first = self.weights @ column.start.T
            total[: len(first)] += first[: len(total)]
        return total


def _delayed(weights: Floats, values: Floats) -> Floats:
    """Return the sum of values (N, S) of earlier rows, by weights of one row before, two rows before ..."""
    total = np.zeros(values.shape, np.result_type(weights, values))
    for rows, weight in enumerate(weights.tolist(), 1):
        if weight:
            total[rows:] += weight * values[:-rows]
    return total


def _recursion(passage: Passage, found: Filter, columns: Sequence[Column]) -> list[Floats]:
    """Return the errors of a steady filter."""
    from scipy.signal import lfilter  # 1 s that a comparison of stored stages need not wait for

    recursion, result = Recursion.of(passage, found), []
    for column in columns:
        error = -lfilter([1.0], recursion.poles, recursion.entering(column), axis=0)
        result.append(error if column.readings is None else error + column.readings)
    return result


def _by_rows(passage: Passage, found: Filter, columns: Sequence[Column]) -> list[Floats]:
    """Return the errors of a filter whose gain, or whose rows, change."""
    (rows, count), n, kind = passage.held.position.shape, passage.states, passage.shape.kind
    readings, start = np.zeros((len(columns), rows, count), kind), np.zeros((len(columns), count, n), kind)
    entering = np.zeros((len(columns), rows, count, n), kind)
    for place, column in enumerate(columns):
        if column.readings is not None:
            readings[place] = column.readings
        if column.start is not None:
            start[place] = column.start
        for piece, of, force in passage.forces(column):
            entering[place] += force[..., None] * passage.gains[piece, :, :, :, of]
    device = passage.plain(kind)
    return list(
        prediction_errors(readings, entering, start, *device, found.gain, found.forces, found.ageing, passage.held.rows)
    )
