"""Simulate the free run of a device with Coulomb friction on motor and load, for logged commands, row by row."""

from __future__ import annotations

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.records.trials import Floats, Integers


@compiled(
    "f8[::1](Tuple((f8[::1],f8[:,::1],f8[::1])),Tuple((f8[:,:,:,::1],f8[:,:,:,::1],i8[:,::1])),f8[:,::1],"
    "Tuple((f8,f8[::1],f8[::1])),f8[::1],i8)"
)
def free_run(
    device: tuple[Floats, Floats, Floats],
    pieces: tuple[Floats, Floats, Integers],
    commands: Floats,
    forces: tuple[float, Floats, Floats],
    start: Floats,
    sub_steps: int,
) -> Floats:
    """Return the sensor positions of a device in a free run, shape (N,).

    Side i (0 for the motor, 1 for the load of a mode) has position and velocity as states 2 i and 2 i + 1, and friction
    c_i opposite to its direction s_i. In each piece of an interval, the command u is constant:

        x <- F x + G_1 u + G_2 (f - c_1 s_1) - G_3 c_2 s_2

    A step covers a whole piece if no side is at rest and no velocity changes its sign. Otherwise, the piece is divided
    into sub-steps. A side at rest stays at rest if the other forces on it, a = A x + b u + f, do not exceed c_i in
    magnitude. A side whose velocity changes sign in a sub-step stops there if |a| <= c_i. Otherwise, its friction is
    reversed after the crossing, which is found by interpolation. Without friction and gravity, the run is exact.
    Gravity acts on the motor with -(a sin q + b cos q), at its angle q in the middle of a step.

    Parameters
    ----------
    device : C, A, b
        Output row of the sensor (n,), and forces on the sides per unit of the states (sides, n) and of the command
        (sides,), for a device of mass 1.
    pieces : F, G, place
        Transitions, shape (2^sides, 2 m, n, n), and gains of a unit command and of forces on the sides, shape
        (2^sides, 2 m, n, 1 + sides). The bits of the first index mark the sides at rest. The second index runs over
        m kinds of pieces, and then over a sub-step of each kind. ``place``, shape (P, N), is the kind of each piece of
        the interval after each row.
    commands : float64, shape (P, N)
        Applied command u in each piece, times the gain.
    forces : f, c, w
        Constant force on the motor, and friction of the sides (sides,), per mass of the device. ``w`` is empty without
        gravity. Otherwise, it contains a, b, the angle of a position of 1, and the angle at the position 0 [rad].
    start : float64, shape (n,)
        State at the first row.
    sub_steps : int
        Number of sub-steps of each piece.

    Examples
    --------
    A mass of 1 slides until it rests under a friction of 2, after v^2/(2 c) = 1/4 and half a unit of time.

    >>> F, G = np.zeros((2, 2, 2, 2)), np.zeros((2, 2, 2, 2))
    >>> F[0], F[1] = [[[1.0, 0.25], [0.0, 1.0]], [[1.0, 0.125], [0.0, 1.0]]], np.eye(2)
    >>> G[0] = [[[0.03125, 0.03125], [0.25, 0.25]], [[0.0078125, 0.0078125], [0.125, 0.125]]]
    >>> device, pieces = (np.array([1.0, 0.0]), np.zeros((1, 2)), np.ones(1)), (F, G, np.zeros((1, 4), np.int64))
    >>> forces, start = (0.0, np.array([2.0]), np.empty(0)), np.array([0.0, 1.0])
    >>> free_run(device, pieces, np.zeros((1, 4)), forces, start, 2).tolist()
    [0.0, 0.1875, 0.25, 0.25]
    """
    C, A, b = device
    F, G, place = pieces
    constant, coulomb, weight = forces
    n, sides, kinds = len(start), len(A), F.shape[1] // 2
    x, moved = start.copy(), np.empty(n)
    free, way, pushed = np.zeros(sides), np.zeros(sides), np.zeros(sides)
    positions = np.empty(place.shape[1])
    for k in range(len(positions)):
        total = 0.0
        for i in range(n):
            total += C[i] * x[i]
        positions[k] = total
        for piece in range(len(place)):
            at, u = place[piece, k], commands[piece, k]
            whole, done = True, 0
            while done < sub_steps:
                rests, force = 0, constant
                if len(weight):
                    step = at if whole else kinds + at
                    angle = weight[3] + weight[2] * (x[0] + 0.5 * F[0, step, 0, 1] * x[1])
                    force -= weight[0] * np.sin(angle) + weight[1] * np.cos(angle)
                for side in range(sides):
                    pushed[side] = force if side == 0 else 0.0
                    if coulomb[side] > 0:
                        free[side] = pushed[side] + b[side] * u
                        for i in range(n):
                            free[side] += A[side, i] * x[i]
                        v = x[2 * side + 1]
                        way[side] = np.sign(free[side] if v == 0 else v)
                        pushed[side] -= coulomb[side] * way[side]
                        if v == 0 and abs(free[side]) <= coulomb[side]:
                            rests |= 1 << side
                if rests and n == 2:
                    break
                whole = whole and rests == 0
                step = at if whole else kinds + at
                for i in range(n):
                    moved[i] = G[rests, step, i, 0] * u
                    for side in range(sides):
                        moved[i] += G[rests, step, i, 1 + side] * pushed[side]
                    for j in range(n):
                        moved[i] += F[rests, step, i, j] * x[j]
                if whole:
                    for side in range(sides):
                        if coulomb[side] > 0 and x[2 * side + 1] * moved[2 * side + 1] < 0:
                            whole = False
                    if not whole:
                        continue
                for side in range(sides):
                    before, behind = x[2 * side + 1], moved[2 * side + 1]
                    if whole or coulomb[side] <= 0 or before * behind >= 0:
                        continue
                    if abs(free[side]) <= coulomb[side]:
                        moved[2 * side + 1] = 0.0
                        continue
                    left = behind / (behind - before)
                    for i in range(n):
                        turned = 2 * coulomb[side] * way[side] * G[rests, step, i, 1 + side]
                        moved[i] += turned * (left if i % 2 else left * left)
                for i in range(n):
                    x[i] = moved[i]
                done += sub_steps if whole else 1
    return positions
