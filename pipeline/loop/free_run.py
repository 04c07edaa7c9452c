"""Free run of a device with Coulomb friction under logged commands: one segment, row by row."""

from __future__ import annotations

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.records.trials import Floats, Integers


@compiled(
    "f8[::1](Tuple((f8[::1],f8[::1],f8)),Tuple((f8[:,:,::1],f8[:,:,::1],i8[:,::1])),f8[:,::1],UniTuple(f8,2),f8[::1],i8)"
)
def free_run(
    device: tuple[Floats, Floats, float],
    pieces: tuple[Floats, Floats, Integers],
    commands: Floats,
    forces: tuple[float, float],
    start: Floats,
    sub_steps: int,
) -> Floats:
    """Return the sensor positions of a device in a free run, shape (N,).

    In each sub-step of each piece of an interval, in which the command u is constant,

        x <- F x + G_1 u + G_2 (f - c s)

    with the direction s of friction: that of the velocity or, at rest, that of the force a = A_2 x + b_2 u + f. A
    device at rest stays at rest if |a| <= c. If the velocity changes sign, the device stops if |a| <= c at the start of
    the sub-step, late by at most one sub-step. Without friction the run is linear, and one sub-step is enough.

    Parameters
    ----------
    device : C, A_2, b_2
        Output rows of sensor and acceleration, shape (n,), and the acceleration per unit command, for a device of mass
        1 whose first states are position and velocity (`pipeline.loop.state_space`).
    pieces : F, G, place
        Transitions (m, n, n) over a sub-step, input gains of unit command and force (m, n, 2), and the index (of these
        m) for each piece of the interval after each row (P, N).
    commands : float64, shape (P, N)
        Applied command u in each piece, times the gain.
    forces : f, c
        Constant force and Coulomb friction.
    start : float64, shape (n,)
        State at the first row.
    sub_steps : int
        Number of sub-steps of each piece.

    Examples
    --------
    A mass of 1 slides to rest under a friction of 2: v^2/(2 c) = 1/4, after half a unit of time.

    >>> F, G = np.array([[[1.0, 0.125], [0.0, 1.0]]]), np.array([[[0.0078125, 0.0078125], [0.125, 0.125]]])
    >>> device, pieces = (np.array([1.0, 0.0]), np.zeros(2), 1.0), (F, G, np.zeros((1, 4), np.int64))
    >>> free_run(device, pieces, np.zeros((1, 4)), (0.0, 2.0), np.array([0.0, 1.0]), 2).tolist()
    [0.0, 0.1875, 0.25, 0.25]
    """
    C, acceleration, push = device
    F, G, place = pieces
    force, coulomb = forces
    n = len(start)
    x, moved = start.copy(), np.empty(n)
    positions = np.empty(place.shape[1])
    for k in range(len(positions)):
        total = 0.0
        for i in range(n):
            total += C[i] * x[i]
        positions[k] = total
        for piece in range(len(place)):
            transition, gain, u = F[place[piece, k]], G[place[piece, k]], commands[piece, k]
            for _ in range(sub_steps):
                free = push * u + force
                for i in range(n):
                    free += acceleration[i] * x[i]
                rests, within = x[1] == 0, abs(free) <= coulomb
                way = np.sign(free if rests else x[1])
                for i in range(n):
                    moved[i] = gain[i, 0] * u + gain[i, 1] * (force - way * coulomb)
                    for j in range(n):
                        moved[i] += transition[i, j] * x[j]
                if coulomb > 0 and within:
                    if rests:
                        moved[0], moved[1] = x[0], x[1]
                    elif moved[1] * way < 0:
                        moved[1] = 0.0
                for i in range(n):
                    x[i] = moved[i]
    return positions
