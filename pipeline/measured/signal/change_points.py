"""What the eye looks for in a recorded column before anything is known of it: jumps, rests, and gaps of the time."""

from __future__ import annotations

import numpy as np

from pipeline.measured.wall_command.stamps import ODD
from pipeline.records.trials import Floats, Integers

JUMP = 0.2
"""Change from one row to the next, relative to the range of the column, that is a jump."""

MOST_JUMPS = 12
"""Most jumps of a column that are listed; one with more chatters, and its largest are listed."""

STILL = 0.005
"""Range of a stretch, relative to that of the column, within which it rests."""

SHORTEST_REST = 0.05
"""Length of a rest, relative to that of the column, and at least `FEWEST_ROWS`."""

FEWEST_ROWS = 8


def jumps(values: Floats) -> Integers:
    """Return the rows at which a column jumps, in order: the first row of each new level.

    Parameters
    ----------
    values : float64, shape (rows,)
        NaN where a cell is missing; a change across it is no jump.
    """
    size = np.abs(np.diff(values))
    reach = _reach(values)
    if not reach > 0:
        return np.zeros(0, dtype=np.int64)
    found = np.flatnonzero(size > JUMP * reach)
    largest = found[np.argsort(-size[found], kind="stable")[:MOST_JUMPS]]
    return np.sort(largest) + 1


def rests(values: Floats) -> list[tuple[int, int]]:
    """Return the stretches in which a column rests, or creeps: first row, and the one behind the last."""
    rows, reach = len(values), _reach(values)
    least = max(FEWEST_ROWS, int(SHORTEST_REST * rows))
    if rows < least:
        return []
    window = np.lib.stride_tricks.sliding_window_view(values, least)
    quiet = np.concatenate([[False], np.ptp(window, axis=1) <= STILL * reach, [False]])
    turns = np.flatnonzero(quiet[1:] != quiet[:-1]).tolist()
    return [(first, end + least - 1) for first, end in zip(turns[::2], turns[1::2], strict=True)]


def gaps(time: Floats) -> Integers:
    """Return the rows before which rows are missing, by the stamps; NaN is no gap."""
    step = np.diff(time)
    usual = float(np.nanmedian(step)) if len(step) else 0.0
    return np.flatnonzero(step > (1 + ODD) * usual) + 1 if usual > 0 else np.zeros(0, dtype=np.int64)


def _reach(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0
