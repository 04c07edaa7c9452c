"""From logged commands to the position: the device of a loop, open, in the exact motion of `loop.device_loop`.

The command is known, so that neither wall nor velocity filter matter here: what is left between a command held over
each sample and the position is delay, lag, mass, damper, spring and perhaps a mode, which is linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands of n trials over N rows, each held over a sample, in the form that responses are made from.

    ``spectrum`` is of the commands and, in the last place, of a constant 1 from the first row on; padded to ``size``.
    """

    spectrum: np.ndarray
    rows: int
    size: int

    @classmethod
    def of(cls, force: Floats) -> Commands:
        """Return the commands [N, Nm] of trials, shape (n, N)."""
        from scipy.fft import next_fast_len, rfft  # takes 0.2 s to load, for all that only reads stages, too

        rows = force.shape[1]
        size = next_fast_len(2 * rows, real=True)
        both = np.concatenate([force, np.ones((1, rows))])
        return cls(rfft(both, size, axis=1), rows, size)

    def response(self, loop: Loop) -> Floats:
        """Return the sensed position of a device of unit mass that rests before the first row, shape (n + 1, N).

        Unit: that of the command times T^2, per mass. The last row is the answer to a constant force of 1.
        """
        from scipy.fft import irfft, rfft

        answer = rfft(pulse_response(loop, self.rows), self.size)
        return np.asarray(irfft(self.spectrum * answer, self.size, axis=1)[:, : self.rows])


def pulse_response(loop: Loop, rows: int) -> Floats:
    """Return the sensed position at samples 0, 1, ... after a unit command over sample 0, shape (rows,).

    Parameters
    ----------
    loop : Loop
        Whose filter does not matter here.
    rows : int

    Notes
    -----
    A command that is late by d acts on [d, 1 + d): on the last part of one interval and on the first of the next.

    Source: Hulin 2017, eqs. 3.3 to 3.8; fractional delay as in the modified z-transform (sec. 7.2).
    """
    matrix, push, sensor = loop.device
    n, newest = len(push), loop.segments[-1]
    late, late_gain = moved(matrix, push, newest.duration)
    state, place = late_gain, newest.age + 1
    result = np.zeros(rows)
    if place >= rows:
        return result
    result[place] = sensor @ state
    whole = late
    if len(loop.segments) > 1:
        early, early_gain = moved(matrix, push, loop.segments[0].duration)
        whole = late @ early
        state = whole @ state + late @ early_gain
    else:
        state = whole @ state
    # doubling: the states of the next 1, 2, 4, ... samples follow from those before
    states, power = state[:, None], whole
    while states.shape[1] < rows - place - 1:
        states = np.concatenate([states, power @ states], axis=1)
        power = power @ power
    result[place + 1 :] = (sensor @ states.reshape(n, -1))[: rows - place - 1]
    return result


def moved(matrix: Floats, push: Floats, duration: float) -> tuple[Floats, Floats]:
    """Return transition (S, S) and input gain (S,) of a device over a time [T] with constant input."""
    from scipy.linalg import expm

    n = len(push)
    both = np.zeros((n + 1, n + 1))
    both[:n, :n], both[:n, n] = matrix, push
    moved = expm(both * duration)
    return moved[:n, :n], moved[:n, n]
