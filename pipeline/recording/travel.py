"""Travel stops: the position is stopped at an extreme that it reached at speed, or bounces off it."""

from __future__ import annotations

import numpy as np

from pipeline.recording.samples import Samples
from pipeline.records.findings import Finding

AT_EXTREME = 0.02
"""Distance from the largest or smallest position, relative to the range, within which rows are at it."""

IMPACT = 3.0
"""Change of the velocity at a stop relative to the largest one behind it; before it to twice that."""

BEFORE, BEHIND = 10, 5
"""Rows before and behind an impact in which the device moves freely."""

SLOWER = 1.5
"""Speed before a stop relative to that behind it: a free motion turns as fast as it came."""

FAST = 0.05
"""Speed at a stop relative to the largest one."""

STEPS = 8.0
"""Change of the velocity at a stop in steps of the sensor a row."""

ANSWERED = 40
"""Rows behind a jump of the command in which a change of the velocity may be the answer to it."""


def travel_stop(samples: Samples) -> Finding | None:
    """Return from which row on a travel stop moves the device.

    At a stop the velocity changes within two rows by several times as much as in the rows before, at the largest or
    smallest position of the log, and the device leaves it more slowly than it came.
    """
    x, change = samples.position, samples.change
    if len(x) < 2 * BEFORE:
        return None
    size, low, high = samples.size, float(x.min()), float(x.max())
    near = AT_EXTREME * (high - low)
    rows = np.flatnonzero((x[BEFORE:-2] >= high - near) | (x[BEFORE:-2] <= low + near)) + BEFORE
    least = max(STEPS * samples.least_change, FAST * samples.fastest)
    rows = rows[(size[rows - 2] > least) & (size[rows - 2] > SLOWER * size[rows + 1])]
    for row in rows.tolist():
        hit = abs(change[row + 1] - change[row - 2])
        brake = np.abs(samples.bend[row - BEFORE : row - 2])
        free = np.abs(samples.bend[row + 1 : row + BEHIND])
        outwards = (x[row] - 0.5 * (high + low)) * change[row - 2] > 0
        is_blow = hit > 2 * IMPACT * float(brake.max()) and hit > IMPACT * float(free.max(initial=0.0))
        if not outwards or not is_blow or _is_answer(samples, row, float(hit)):
            continue
        return samples.finding(
            "travel_stop",
            "cut",
            f"The position is stopped at {x[row]:.5g} in row {row}, which it reached at a speed of "
            f"{abs(change[row - 2]) / samples.period:.3g} per second: a travel stop.",
            "Rows from there on are left out. Record smaller or shorter steps, away from the stop.",
            first_row=row,
            rows=len(x) - row,
        )
    return None


def _is_answer(samples: Samples, row: int, hit: float) -> bool:
    """Return whether a command jumped shortly before, which may brake as much as another jump of it did elsewhere."""
    edges = samples.edges
    if not samples.is_free or not ((edges <= row) & (edges > row - ANSWERED)).any():
        return False
    over_three = np.abs(samples.change[3:] - samples.change[:-3])
    elsewhere = np.concatenate([over_three[: max(row - BEFORE, 0)], over_three[row + BEFORE :]])
    return hit <= IMPACT * float(elsewhere.max(initial=0.0))
