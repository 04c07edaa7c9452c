"""How regular the time stamps of trials are."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers

GAP = 1.5
"""Step between samples, in sampling periods, from which on samples are missing: the nearest multiple is 2 or more."""


def step_flags(time: Floats, rows: Integers, period: Floats) -> list[dict[str, float | int | None]]:
    """Return how regular the samples of trials are.

    Parameters
    ----------
    time : float64, shape (m,)
        Strictly increasing time stamps [s] of trial after trial.
    rows : int64, shape (n,)
        Number of samples of each trial, at least 2.
    period : float64, shape (n,)
        Sampling period T [s] that each trial states.

    Returns
    -------
    list of dict, length n
        ``gaps``: steps longer than `GAP` periods; ``dropped``: samples missing in them, by the nearest multiple of T;
        ``dropped_fraction``: of all that should be there; ``longest_step_s``; ``mean_step_s``, ``jitter_rms_s`` and
        ``jitter_max_s``: mean of the other steps, and their deviation from T; None where all are gaps.
    """
    inside = np.ones(max(len(time) - 1, 0), dtype=np.bool_)
    inside[np.cumsum(rows)[:-1] - 1] = False
    steps = np.diff(time)[inside]
    nominal = np.repeat(period, rows - 1)
    gap = steps > GAP * nominal

    first = np.cumsum(rows - 1) - (rows - 1)

    def total(values: Floats | Booleans) -> Floats:
        return np.add.reduceat(values, first, dtype=np.float64)

    deviation = np.where(gap, 0.0, steps - nominal)
    gaps = total(gap)
    dropped = total(np.where(gap, np.rint(steps / nominal) - 1, 0.0))
    regular = np.maximum(rows - 1 - gaps, 1)
    columns = {
        "dropped_fraction": dropped / (rows + dropped),
        "longest_step_s": np.maximum.reduceat(steps, first),
        "mean_step_s": total(np.where(gap, 0.0, steps)) / regular,
        "jitter_rms_s": np.sqrt(total(deviation**2) / regular),
        "jitter_max_s": np.maximum.reduceat(np.abs(deviation), first),
    }
    flags = []
    for index, values in enumerate(zip(*(column.tolist() for column in columns.values()), strict=True)):
        entry: dict[str, float | int | None] = {"gaps": int(gaps[index]), "dropped": int(dropped[index])}
        entry |= dict(zip(columns, values, strict=True))
        if gaps[index] == rows[index] - 1:
            entry |= dict.fromkeys(("mean_step_s", "jitter_rms_s", "jitter_max_s"))
        flags.append(entry)
    return flags
