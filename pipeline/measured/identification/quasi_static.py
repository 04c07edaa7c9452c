"""Estimate the damping of a device whose sampling period exceeds its time constant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.measured.identification.intervals import Interval
from pipeline.measured.identification.recordings import Recording
from pipeline.measured.student import student_95
from pipeline.records.trials import Booleans, Floats

WINDOW = 8
"""Number of rows of a window. The transient after a change of the command ends within a window, and the position
changes visibly."""

BLOCKS = 16
"""Number of blocks of windows for a jackknife."""

KNOWN = (0.1, 0.05)
"""Two limits for the change of the command between rows of a window, relative to the range of the command. The
difference between the results for both limits is the error of the trapezoidal rule, because the command between rows is
unknown."""

EXPLAINS = 0.97
"""Smallest share of the sum of squares of the displacements that the command explains. It explains less if an inertia
is visible."""

FASTEST = 2.0
"""Threshold for the sum of delay and time constant [rows]. Above it, the inertia is visible in the rows."""


def damping_without_inertia(recordings: Sequence[Recording]) -> Interval | None:
    """Return the damping [Ns/m, Nms/rad per unit of command] of a device without visible inertia, or None if its
    inertia is visible.

    The displacement over a window is x_1 - x_0 = (U - t_a (u_1 - u_0) - c S)/b + v_0 t. U is the trapezoidal integral
    of the command, t_a is the sum of delay and time constant, and c is Coulomb friction. S is the duration of forward
    motion minus that of backward motion. Least squares determine 1/b and the other coefficients. The interval is from a
    jackknife over blocks.
    """
    fast, slow = (_estimate(recordings, known) for known in KNOWN)
    if fast is None or slow is None:
        return None
    value, spread = slow
    error = float(np.hypot(spread, fast[0] - value))
    reach = float(student_95(BLOCKS - 1.0)) * error
    return Interval(value, max(value - reach, 0.0), value + reach, error)


def _estimate(recordings: Sequence[Recording], known: float) -> tuple[float, float] | None:
    """Return the damping and its standard error from windows with a slowly changing command, or None if not
    available."""
    rows = [_windows(each, known) for each in recordings if len(each.time) >= 4 * WINDOW]
    if not rows:
        return None
    columns, moved = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    size = np.sqrt((columns**2).sum(axis=0))
    used = size > 1e-12 * size.max(initial=0.0)
    columns, size = columns[:, used], size[used]
    if not used[0] or len(moved) < 2 * BLOCKS or np.linalg.matrix_rank(columns / size) < len(size):
        return None

    def fitted(inside: Booleans) -> Floats:
        return np.asarray(np.linalg.lstsq(columns[inside] / size, moved[inside], rcond=None)[0] / size)

    found = fitted(np.ones(len(moved), dtype=bool))
    left = float(((moved - columns @ found) ** 2).sum())
    period = float(np.median([each.period for each in recordings]))
    if found[0] <= 0 or left > (1 - EXPLAINS) * float((moved**2).sum()):
        return None
    if used[1] and abs(found[1]) > FASTEST * period * found[0]:
        return None
    block = np.arange(len(moved)) * BLOCKS // len(moved)
    without = np.array([fitted(block != number)[0] for number in range(BLOCKS)])
    spread = float(np.sqrt((BLOCKS - 1) / BLOCKS * ((without - without.mean()) ** 2).sum()))
    return 1 / float(found[0]), spread / float(found[0]) ** 2


def _windows(each: Recording, known: float) -> tuple[Floats, Floats]:
    """Return the columns (W, 4) and the displacements (W,) of the windows of a log."""
    first = np.arange(0, len(each.time) - WINDOW, WINDOW)
    last, step = first + WINDOW, np.diff(each.time)
    force = np.concatenate([[0.0], np.cumsum(0.5 * (each.command[1:] + each.command[:-1]) * step)])
    way = np.concatenate([[0.0], np.cumsum(np.sign(np.diff(each.position)) * step)])
    columns = [whole[last] - whole[first] for whole in (force, each.command, each.time, way)]
    change = np.abs(np.diff(each.command))
    largest = np.array([change[a:b].max() for a, b in zip(first.tolist(), last.tolist(), strict=True)])
    slow = largest <= known * float(np.ptp(each.command))
    return np.stack(columns, axis=1)[slow], (each.position[last] - each.position[first])[slow]
