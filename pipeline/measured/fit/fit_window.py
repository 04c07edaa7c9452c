"""The part of a log that a model is fitted to, time along the first axis, in units that make all trials alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.fit.fit_noise import runs
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

ROWS_AHEAD = 100
"""Rows before the edge that are used: a command that chatters there moves the device, longer rests tell no more."""

ROWS_BEHIND = 20
"""Rows that are used after the motion has died: the resting place to a quarter of the noise."""

DIED, DIED_FLOORS = 0.01, 3.0
"""Share of the travel, and multiple of the sensor floor, below which the motion has died: what goes on there is a
limit cycle of the quantum, whose rounding errors repeat with it and tell nothing new."""

FEWEST_ROWS = 40
"""Rows from the edge on that a fit needs: twice the lags of the portmanteau test."""

DITHER = 0.4
"""Noise in quanta from which on rounding errors are white: what they keep in common is exp(-2 pi^2 0.4^2) = 4 %."""

FAST = 1.5
"""Quanta a sample from which on neighbouring rounding errors are taken as independent: at one quantum a sample
they are all the same."""

ROUNDING = 1e-10
"""Smallest error of a reading relative to the travel: rounding of an ideal log and of the model's recursion."""


@dataclass(frozen=True, eq=False)
class Window:
    """Normalised part of the logs, N rows of n trials.

    Parameters
    ----------
    first_row, last_row : int64, shape (n,)
        First and last row of the log that are used.
    edge : int64, shape (n,)
        Row of the command edge in the window.
    position : float64, shape (N, n)
        Relative to the first reading of the window, per travel; 0 outside.
    force : float64, shape (N, n)
        Command per ``force_scale``; 0 outside.
    inside : bool, shape (N, n)
    variance : float64, shape (N, n)
        Expected variance of a reading by quantum and baseline noise, per travel squared; infinite outside.
    run : float64, shape (N, n)
        Length of the run of equal readings around each one, 1 where there is no quantum.
    origin, travel, force_scale : float64, shape (n,)
        First reading of the window [m, rad], range of the readings [m, rad], largest command [N, Nm].
    quantum_share : float64, shape (n,)
        Share of the variance that the quantum makes.
    independent : bool, shape (N, n)
        Rows whose rounding errors are as good as independent: noise dithers them, or the device moves by some quanta
        a sample.
    noise_known : bool, shape (n,)
        The variance is known from a baseline or a quantum, and not only the rounding of numbers.
    """

    first_row: Integers
    last_row: Integers
    edge: Integers
    position: Floats
    force: Floats
    inside: Booleans
    variance: Floats
    run: Floats
    origin: Floats
    travel: Floats
    force_scale: Floats
    quantum_share: Floats
    independent: Booleans
    noise_known: Booleans

    def head(self, rows: int) -> Window:
        """Return the first rows of all trials."""
        names = self.__dataclass_fields__
        return Window(*(a[:rows] if a.ndim == 2 else a for a in (getattr(self, name) for name in names)))

    def shortened(self, which: Booleans, rows: int) -> Window:
        """Return the windows with some trials cut after a number of rows."""
        beyond = (np.arange(len(self.position)) >= rows)[:, None] & which
        return replace(
            self,
            last_row=np.where(which, np.minimum(self.last_row, self.first_row + rows - 1), self.last_row),
            inside=self.inside & ~beyond,
            variance=np.where(beyond, np.inf, self.variance),
            independent=self.independent & ~beyond,
        )

    def select(self, which: Booleans | Integers) -> Window:
        """Return the trials picked by a mask or by indices."""
        return Window(*(getattr(self, name)[..., which] for name in self.__dataclass_fields__))


def usable_rows(batch: TrialBatch, response: Response, edge: Integers) -> tuple[Integers, Integers]:
    """Return first and last row of each trial's window, shape (n,): from rest until the motion has died.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
    edge : int64, shape (n,)
        Row of the command edge; negative where there is none.
    """
    row = np.arange(batch.position.shape[1])[None, :]
    away = np.abs(np.where(batch.valid, batch.position, np.nan) - response.position_final_measured[:, None])
    away = np.nan_to_num(away)
    limit = np.maximum(DIED_FLOORS * response.floor, DIED * away.max(axis=1, initial=0.0))
    moving = (away > limit[:, None]) & (row >= edge[:, None])
    last_moving = np.where(moving.any(axis=1), row.shape[1] - 1 - np.argmax(moving[:, ::-1], axis=1), 0)
    first = np.maximum(edge - ROWS_AHEAD, 0)
    enough = np.maximum(last_moving, edge + FEWEST_ROWS) + ROWS_BEHIND
    return first.astype(np.int64), np.minimum(enough, batch.rows - 1).astype(np.int64)


def cut(batch: TrialBatch, response: Response, edge: Integers, first: Integers, last: Integers) -> Window:
    """Return the windows of trials that have an edge and a motion.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
    edge, first, last : int64, shape (n,)
        Command edge, first and last row of each trial's window.
    """
    N = int((last - first).max(initial=0)) + 1
    row = first[:, None] + np.arange(N)
    inside = row <= last[:, None]
    pick = np.minimum(row, last[:, None])
    position = np.take_along_axis(batch.position, pick, axis=1)
    force = np.where(inside, np.take_along_axis(batch.command, pick, axis=1), 0.0)
    origin = position[:, 0].copy()
    travel = position.max(axis=1) - position.min(axis=1)
    force_scale = np.abs(force).max(axis=1)
    travel, force_scale = (np.where(a > 0, a, 1.0) for a in (travel, force_scale))
    noise = np.nan_to_num(response.sensor_noise)
    known = (response.sensor_quantum > 0) | (noise > 0)
    floor = ROUNDING * travel
    variance = (noise**2 + response.sensor_quantum**2 / 12 + floor**2) / travel**2
    length = runs(position.T, inside.T)
    return Window(
        first_row=first,
        last_row=last,
        edge=edge - first,
        position=np.where(inside, (position - origin[:, None]) / travel[:, None], 0.0).T.copy(),
        force=(force / force_scale[:, None]).T.copy(),
        inside=inside.T.copy(),
        variance=np.where(inside, variance[:, None], np.inf).T.copy(),
        run=np.where(response.sensor_quantum > 0, length, 1.0),
        origin=origin,
        travel=travel,
        force_scale=force_scale,
        quantum_share=response.sensor_quantum**2 / 12 / (variance * travel**2),
        independent=_independent(position.T, inside.T, response.sensor_quantum, noise),
        noise_known=known,
    )


def _independent(position: Floats, inside: Booleans, quantum: Floats, noise: Floats) -> Booleans:
    """Return where rounding errors are as good as independent of their neighbours', shape (N, n)."""
    fast = np.zeros(position.shape, dtype=np.bool_)
    moved = np.abs(np.diff(position, axis=0)) > FAST * quantum
    fast[1:-1] = moved[1:] & moved[:-1]
    return inside & (fast | (noise >= DITHER * quantum))
