"""The found device, run free from the start of logs that it was not fitted to: its fit in percent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.loop.state_space import StateSpace, state_space
from pipeline.measured.model.likelihood import Device, errors_of, force_of
from pipeline.measured.model.motion import at_times
from pipeline.measured.model.recordings import Stretches
from pipeline.measured.model.whitening import WHITE, Filter, Passage
from pipeline.records.batch import Floats

PARTS = 4
"""Pieces of an interval between which friction may change direction: a turn is off by an eighth of a row."""

STILL = 3.0
"""Standard deviation of a position, in that of its readings' noise, up to which a log does not move."""

STARTS = 3
"""Newton's steps to the start of a log, in which all but friction is linear."""

NUDGE = 1e-4
"""Change of a start for the slope of the response, in units of the position's range."""


@dataclass(frozen=True, eq=False)
class Replay:
    """Free runs beside logs, (N, S) in units of `LogUnits`, with the logs; ``fit`` (S,) in percent."""

    held: Stretches
    position: Floats
    fit: Floats


def replayed(held: Stretches, device: Device) -> Replay:
    """Return the free run of a device beside each stretch, from the start that fits it best.

    The fit is 100 (1 - |y - found| / |y - mean y|), that of system identification; NaN where a log does not move.
    """
    if not len(held):
        return Replay(held, held.position, np.empty(0))
    found = _sliding(held, device) if device.numbers.get("coulomb") else _linear(held, device)
    mean = (held.position * held.valid).sum(axis=0) / held.rows
    error = np.sqrt(((held.position - found) ** 2 * held.valid).sum(axis=0))
    size = np.sqrt(((held.position - mean) ** 2 * held.valid).sum(axis=0))
    # a position that noise and the sensor's steps alone change is predicted by any device
    moves = size > np.maximum(STILL * np.sqrt(held.rows * held.white), 1e-3)
    with np.errstate(divide="ignore", invalid="ignore"):
        fit = np.where(moves, 100 * (1 - error / size), np.nan)
    return Replay(held, found, fit)


def _linear(held: Stretches, device: Device) -> Floats:
    """Return the free run of a device without friction, in whose start it is linear."""
    passage = device.passage(held)
    errors, starts = errors_of(held, device, passage, Filter.of(passage, WHITE), [force_of(held, device)])
    left = starts.without(errors[0].T[..., None])[:, : len(held.position), 0]
    return np.asarray(held.position - left.T)


def _sliding(held: Stretches, device: Device) -> Floats:
    """Return the free run of a device with friction, from the start that fits best by Newton's steps."""
    count, states = len(held), len(state_space(device.shape.plant).sensor)
    start = np.zeros((count, states))
    start[:, 0] = held.position[0]
    few = np.minimum(held.rows - 1, 5)
    start[:, 1] = (held.position[few, np.arange(count)] - held.position[0]) / np.maximum(few, 1)
    start[held.rests, 1] = 0.0
    tried, found, least = start, held.position, np.full(count, np.inf)
    for _ in range(STARTS + 1):
        # the run itself, and one beside it for each state
        runs = _runs(held, device, np.stack([tried, *(tried + NUDGE * unit for unit in np.eye(states))]))
        left = (held.position - runs[:, 0]) * held.valid
        better = (left**2).sum(axis=0) < least
        least = np.where(better, (left**2).sum(axis=0), least)
        start, found = np.where(better[:, None], tried, start), np.where(better[None], runs[:, 0], found)
        columns = ((runs[:, 1:] - runs[:, :1]) / NUDGE * held.valid[:, None]).transpose(2, 0, 1)
        step = np.einsum("scn,sn->sc", np.linalg.pinv(columns, rcond=1e-6), left.T)
        tried = start + np.where(better[:, None], step, 0.0)
    return found


def _runs(held: Stretches, device: Device, starts: Floats) -> Floats:
    """Return the free runs (N, V, S) from several starts (V, S, n) of each stretch."""
    versions, count, states = starts.shape
    wide = held.chosen(np.tile(np.arange(count), versions))
    return free_run(wide, device, starts.reshape(-1, states)).reshape(-1, versions, count)


def free_run(held: Stretches, device: Device, start: Floats) -> Floats:
    """Return positions (N, S) of a device with friction under the logged commands, from starts (S, n)."""
    shape, numbers = device.shape, device.numbers
    system = state_space(shape.plant)
    inputs = np.stack([system.command, system.force], axis=1)
    passage = Passage(held, shape)
    rows, count = held.position.shape
    coulomb, force = (device.own(name, held.trial) for name in ("coulomb", "force"))
    gain = device.own("gain", held.trial)
    spans = (passage.pieces.begins - passage.pieces.ends) / (PARTS if numbers.get("coulomb") else 1)
    moved, gained = at_times(system.matrix, inputs, spans)
    row_of, column = np.broadcast_to(passage.pieces.row, (len(moved), rows, count)), np.arange(count)
    state, result = start.copy(), np.empty((rows, count))
    for k in range(rows):
        result[k] = state @ system.sensor
        for piece in range(len(moved)):
            at = min(k, moved.shape[1] - 1)
            transition, added = moved[piece, at], gained[piece, at]
            command = gain * held.driven[row_of[piece, k], column]
            for _ in range(PARTS if numbers.get("coulomb") else 1):
                state = _onward(state, transition, added, (command, force), coulomb, system)
    return result


def _onward(
    state: Floats,
    transition: Floats,
    added: Floats,
    forces: tuple[Floats, Floats],
    coulomb: Floats,
    system: StateSpace,
) -> Floats:
    """Return states (S, n) after a short time under command and constant force, (S,) each; friction may hold them."""
    command, force = forces
    moved: Floats = np.einsum("sij,sj->si", transition, state) if len(transition) > 1 else state @ transition[0].T
    driven = added[:, :, 0] * command[:, None]
    if not coulomb.any():
        return np.asarray(moved + driven + added[:, :, 1] * force[:, None])
    free = state @ system.matrix[1] + system.command[1] * command + force
    rests = state[:, 1] == 0
    way = np.where(rests, np.sign(free), np.sign(state[:, 1]))
    after = moved + driven + added[:, :, 1] * (force - way * coulomb)[:, None]
    stuck = rests & (np.abs(free) <= coulomb)
    after[stuck, :2] = state[stuck, :2]
    turned = ~stuck & (after[:, 1] * way < 0)
    # a device that turns either stays, or goes on back within the next part
    after[turned & ~rests, 1] = np.where(np.abs(free) <= coulomb, 0.0, after[:, 1])[turned & ~rests]
    return after
