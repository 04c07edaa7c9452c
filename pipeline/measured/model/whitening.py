"""Prediction errors: a Kalman filter for a device that a random force disturbs, over all stretches together.

The filter is linear in readings, commands, friction, constant force and start: each is a column that passes it alone,
and the prediction errors of any device with this shape of motion are a sum of columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.measured.model.motion import Physics, Pieces, at_times, pieces
from pipeline.measured.model.recordings import Stretches
from pipeline.records.batch import Floats

STEADY = 1e-10
"""Change of the filter's gain in a sample, relative to it, below which it stays as it is."""


class Passage:
    """What stretches become of in a device: transitions and gains of their intervals."""

    def __init__(self, held: Stretches, shape: Physics) -> None:
        self.held, self.shape = held, shape
        matrix, push, blow, sensor = shape.system
        self.sensor, self.states = sensor, len(push)
        self._inputs = np.stack([push, blow], axis=1)
        self._matrix = matrix
        self.pieces: Pieces = pieces(held.time, held.lead, shape.delay, held.regular)
        one = np.ones((1, 1)) if held.regular else np.diff(held.time[held.lead :], axis=0)
        moved, gained = at_times(matrix, self._inputs, one)
        self.transition, self.disturbed = moved, gained[..., 1]

    @cached_property
    def gains(self) -> Floats:
        """What unit command and force over each piece add, (P, N or 1, S or 1, n, 2)."""
        return self.pieces.gains(self._matrix, self._inputs)

    def added(self, command: Floats | None, direct: Floats | None) -> Floats:
        """Return what forces add to the state in each interval, shape (N, S, n).

        Parameters
        ----------
        command : float64, shape (lead + N, S), optional
            Force behind the delay and the lag.
        direct : float64, shape (N, S), optional
            Force on the motor's side in an interval, where the command in force acts.
        """
        column = np.arange(len(self.held))[None, :]
        total = np.zeros((*self.held.position.shape, self.states))
        for row, gain in zip(self.pieces.row, self.gains, strict=True):
            acts = self.held.acts[row, column]
            if command is not None:
                total += (command[row, column] * acts)[..., None] * gain[..., 0]
            if direct is not None:
                total += (direct * acts)[..., None] * gain[..., 1]
        return total

    def holding(self) -> Floats:
        """Return what holds a spring at unit position while the stretch still rests, shape (N, S, n)."""
        column = np.arange(len(self.held))[None, :]
        total = np.zeros((*self.held.position.shape, self.states))
        for row, gain in zip(self.pieces.row, self.gains, strict=True):
            total += (self.shape.gamma * (1 - self.held.acts[row, column]))[..., None] * gain[..., 1]
        return total

    def starts(self) -> list[tuple[Floats, Floats | None]]:
        """Return each unknown of the start as state (S, n), and what it adds (N, S, n) where it does."""
        count, result = len(self.held), []
        free = np.flatnonzero(~self.held.rests)
        for state in range(self.states):
            unit = np.zeros((count, self.states))
            unit[:, state] = 1.0
            if state:
                unit[self.held.rests] = 0.0
                if not len(free):
                    continue
            result.append((unit, self.holding() if state == 0 and self.held.rests.any() else None))
        return result


@dataclass(frozen=True, eq=False)
class Filter:
    """Gains (N, S or 1, n) of a filter, and the standard deviations (N, S or 1) of its errors in those of a reading."""

    gain: Floats
    spread: Floats

    @classmethod
    def of(cls, passage: Passage, disturbance: float) -> Filter:
        """Return the filter for a random force whose variance over a sample is ``disturbance`` [readings' variance]."""
        rows = passage.held.position.shape[0]
        groups = passage.transition.shape[1]
        n, sensor = passage.states, passage.sensor
        transition = np.broadcast_to(passage.transition, (rows, groups, n, n))
        noise = passage.disturbed
        added = np.broadcast_to(disturbance * noise[..., :, None] * noise[..., None, :], (rows, groups, n, n))
        gain, spread = np.zeros((rows, groups, n)), np.ones((rows, groups))
        if disturbance == 0:
            return cls(gain, spread)
        known = np.zeros((groups, n, n))
        for k in range(rows):
            seen = known @ sensor
            variance = 1.0 + seen @ sensor
            gain[k] = seen / variance[:, None]
            spread[k] = np.sqrt(variance)
            if passage.held.regular and k > 8 and np.abs(gain[k] - gain[k - 1]).max() < STEADY * np.abs(gain[k]).max():
                gain[k:], spread[k:] = gain[k], spread[k]
                break
            known = known - gain[k][:, :, None] * seen[:, None, :]
            known = transition[k] @ known @ transition[k].transpose(0, 2, 1) + added[k]
        return cls(gain, spread)


def passed(passage: Passage, found: Filter, readings: Floats | None, start: Floats, added: Floats | None) -> Floats:
    """Return whitened prediction errors of columns, shape (N, S, C).

    Parameters
    ----------
    passage : Passage
    found : Filter
    readings : float64, shape (N, S, C), optional
        None where they are 0.
    start : float64, shape (S, C, n)
    added : float64, shape (N, S, C, n), optional
    """
    rows, count = passage.held.position.shape
    columns, n = start.shape[1:]
    turned = passage.transition.swapaxes(-1, -2)
    shared = passage.transition.shape[:2] == (1, 1)
    state = start.reshape(count * columns, n) if shared else start
    errors = np.empty((rows, *state.shape[:-1]))
    sensor = passage.sensor
    filters = bool(found.gain.any())
    # a matrix of one for all takes all columns as rows of one product
    whole = turned[0, 0] if shared else None
    given = None if readings is None else readings.reshape(rows, *state.shape[:-1])
    pushed = None if added is None else added.reshape(rows, *state.shape)
    for k in range(rows):
        error = -(state @ sensor) if given is None else given[k] - state @ sensor
        errors[k] = error
        if filters:
            gain = found.gain[k]
            state = state + error[..., None] * (gain[0] if shared else gain[:, None, :])
        state = state @ (whole if whole is not None else turned[min(k, len(turned) - 1)])
        if pushed is not None:
            state = state + pushed[k]
    result = errors.reshape(rows, count, columns) / found.spread[:, :, None]
    result[~passage.held.valid] = 0.0
    return result
