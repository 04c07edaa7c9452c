"""Compute free runs of a device with friction on motor and load, with exact transitions from any initial state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.loop.free_run import free_run
from pipeline.loop.state_space import state_space
from pipeline.measured.identification.drive import applied_command
from pipeline.measured.identification.kernels import exponentials
from pipeline.measured.identification.motion import GRAVITY, Pieces, PlantShape
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

SUB_STEPS = 4
"""Number of sub-steps of a piece of a sampling interval in which a side rests or reverses. A side stops at most one
sub-step too late."""


@dataclass(frozen=True, eq=False)
class Mechanics:
    """Equations of motion in the positions of motor and load, for a device of mass 1.

    Parameters
    ----------
    matrix : float64, shape (n, n)
    inputs : float64, shape (n, 1 + sides)
        Input of the command, and inputs of the forces on the sides.
    sensor : float64, shape (n,)
    masses : float64, shape (sides,)
    """

    matrix: Floats
    inputs: Floats
    sensor: Floats
    masses: Floats

    @classmethod
    def of(cls, shape: PlantShape) -> Mechanics:
        """Return the equations of motion of a shape. `state_space` uses the centre of mass as a coordinate instead."""
        system, load = state_space(shape.plant), shape.load_mass
        n, sides = system.states, 2 if load else 1
        turn = np.eye(n)
        for i in range(2 * (sides - 1)):
            turn[i, i + 2], turn[i + 2, i], turn[i + 2, i + 2] = -load / (1 - load), 1.0, 1.0
        back = np.linalg.inv(turn)
        inputs = np.zeros((n, 1 + sides))
        inputs[:, :2] = turn @ np.stack([system.command, system.force], axis=1)
        masses = np.array([1 - load, load])[:sides]
        if load:
            inputs[3, 2] = 1 / load
        return cls(turn @ system.matrix @ back, inputs, system.sensor @ back, masses)

    def transitions(self, times: Floats, sub_steps: int) -> tuple[Floats, Floats]:
        """Return transition matrices (2^sides, 2 m, n, n) and responses to a unit command and to unit forces on the
        sides (2^sides, 2 m, n, 1 + sides).

        There is one entry for each combination of resting sides, over m times and then over a sub-step of each time.
        """
        n, inputs = self.inputs.shape
        moved = []
        for rests in range(2 ** len(self.masses)):
            whole = np.zeros((1, n + inputs, n + inputs))
            whole[0, :n, :n], whole[0, :n, n:] = self.matrix, self.inputs
            for side in range(len(self.masses)):
                whole[0, 2 * side + 1] *= not rests >> side & 1
            moved.append(exponentials(whole, np.concatenate([times, times / sub_steps]))[:, 0, :n])
        both = np.stack(moved)
        return np.ascontiguousarray(both[..., :n]), np.ascontiguousarray(both[..., n:])

    @property
    def forces(self) -> tuple[Floats, Floats]:
        """Forces on the sides per unit of each state (sides, n), and per unit of command (sides,)."""
        rows = slice(1, 2 * len(self.masses), 2)
        return np.ascontiguousarray(self.matrix[rows] * self.masses[:, None]), self.inputs[rows, 0] * self.masses


def free_runs(
    segments: Segments, numbers: Mapping[str, float], forces: Sequence[tuple[float, Floats]], starts: Floats
) -> Floats:
    """Return free runs from initial states (S, V, n) of each segment, shape (rows of all segments, V).

    ``forces`` contains the gain of each segment and an array of its constant force and the friction of the sides.
    """
    shape = PlantShape.of(numbers)
    mechanics, pieces = Mechanics.of(shape), Pieces.of(segments, [shape.delay])
    spans, kind = np.unique(np.round(pieces.begin - pieces.end, 12), return_inverse=True)
    # intervals with fewer pieces than others are padded with pieces of duration zero
    rubs = any(each[1][1:].any() for each in forces)
    steps = SUB_STEPS if rubs else 1
    F, G = mechanics.transitions(np.append(spans, 0.0), steps)
    device = (mechanics.sensor, *mechanics.forces)
    command = applied_command(segments.command, numbers)[0]
    gravity = [numbers[name] for name in GRAVITY if name in numbers]
    runs = []
    for s, (first, behind, begin) in enumerate(zip(segments.first, segments.behind, segments.begin, strict=True)):
        gain, (force, *coulomb) = forces[s][0], forces[s][1].tolist()
        row = np.arange(first, behind)
        at = np.minimum(row, len(pieces.offset) - 2)
        count = pieces.offset[at + 1] - pieces.offset[at]
        number = np.arange(max(int(count.max()), 1))[:, None]
        piece = np.minimum(pieces.offset[at] + number, len(pieces.back) - 1)
        place = np.where(number < count, kind[piece], len(spans)).astype(np.int64)
        driven = gain * command[np.clip(row - pieces.back[piece], begin, behind - 1)]
        friction = np.array(coulomb[: len(mechanics.masses)])
        weight = np.array([*gravity, segments.scale, segments.origins[segments.trial[s]]] if gravity else [])
        given = device, (F, G, place), driven, (force, friction, weight)
        runs.append(np.stack([free_run(*given, start.copy(), steps) for start in starts[s]], axis=1))
    return np.concatenate(runs)
