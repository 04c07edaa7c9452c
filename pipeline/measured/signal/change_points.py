"""Find jumps, rests and time gaps in a recorded column, without knowledge of its meaning."""

from __future__ import annotations

import numpy as np

from pipeline.measured.wall_command.stamps import ODD
from pipeline.records.trials import Floats, Integers

JUMP = 0.2
"""Smallest change between two rows that counts as a jump, relative to the range of the column."""

MOST_JUMPS = 12
"""Largest number of jumps that are listed for a column. For a chattering column, only the largest jumps are listed."""

STILL = 0.005
"""Largest range of a segment at rest, relative to the range of the column."""

SHORTEST_REST = 0.05
"""Smallest length of a rest, relative to the length of the column. `FEWEST_ROWS` is a further limit."""

FEWEST_ROWS = 8


def jumps(values: Floats) -> Integers:
    """Return the rows at which a column jumps, in order, as the first row of each new level.

    Parameters
    ----------
    values : float64, shape (rows,)
        A missing cell is NaN. A change across it is not a jump.
    """
    size = np.abs(np.diff(values))
    reach = _reach(values)
    if not reach > 0:
        return np.zeros(0, dtype=np.int64)
    found = np.flatnonzero(size > JUMP * reach)
    largest = found[np.argsort(-size[found], kind="stable")[:MOST_JUMPS]]
    return np.sort(largest) + 1


def rests(values: Floats) -> list[tuple[int, int]]:
    """Return the segments in which a column rests or creeps, each as its first row and the row after its last row."""
    rows, reach = len(values), _reach(values)
    least = max(FEWEST_ROWS, int(SHORTEST_REST * rows))
    if rows < least:
        return []
    window = np.lib.stride_tricks.sliding_window_view(values, least)
    quiet = np.concatenate([[False], np.ptp(window, axis=1) <= STILL * reach, [False]])
    turns = np.flatnonzero(quiet[1:] != quiet[:-1]).tolist()
    return [(first, end + least - 1) for first, end in zip(turns[::2], turns[1::2], strict=True)]


def gaps(time: Floats) -> Integers:
    """Return the rows after a gap in the time stamps. NaN is not a gap."""
    step = np.diff(time)
    usual = float(np.nanmedian(step)) if len(step) else 0.0
    return np.flatnonzero(step > (1 + ODD) * usual) + 1 if usual > 0 else np.zeros(0, dtype=np.int64)


def _reach(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0
