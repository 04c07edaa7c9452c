"""The log that a lab keeps of simulated trials: time stamps, command and position, with rows repeated or missing."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Floats, Integers, TrialBatch
from pipeline.simulation.chance import Chance
from pipeline.simulation.setup import Setup


def logged(
    setup: Setup, walls: tuple[Floats, Floats], rows: Integers, command: Floats, position: Floats, chance: Chance
) -> TrialBatch:
    """Return trials at walls (K, B) of so many rows each; command and position have the shape (rows, n)."""
    trials, T = len(rows), setup.sampling_period_s
    longest = int(rows.max(initial=0))
    if chance.repeated is not None:
        before = np.vstack((position[:1], position[:-1]))
        position = np.where(chance.repeated, before, position)
    padding = np.arange(longest)[None, :] >= rows[:, None]
    time = np.where(padding, np.nan, T * np.arange(longest))
    both = [np.where(padding, np.nan, values[:longest].T) for values in (command, position)]
    if chance.lost is not None:
        kept = ~(chance.lost[:longest].T | padding)
        rows = kept.sum(axis=1)
        longest = int(rows.max(initial=0))
        order = np.argsort(~kept, axis=1, kind="stable")[:, :longest]
        gone = np.arange(longest)[None, :] >= rows[:, None]
        stamps = np.broadcast_to(T * np.arange(longest), gone.shape)
        stamps = stamps if setup.hidden.lost_rows_hidden else np.take_along_axis(time, order, axis=1)
        time, *both = (
            np.where(gone, np.nan, values)
            for values in (stamps, *(np.take_along_axis(values, order, axis=1) for values in both))
        )
    return TrialBatch(
        trial_id=tuple(str(i) for i in range(trials)),
        stiffness=walls[0],
        damping=walls[1],
        step=np.full(trials, setup.step),
        sampling_period_s=np.full(trials, T),
        rows=rows,
        time=time,
        command=both[0],
        position=both[1],
    )
