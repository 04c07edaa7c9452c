"""Find travel stops, at which the position reaches an extreme at speed and stops there or rebounds."""

from __future__ import annotations

import numpy as np

from pipeline.recording.samples import Samples
from pipeline.records.findings import Finding
from pipeline.records.trials import Booleans

AT_EXTREME = 0.02
"""Largest distance from the largest or smallest position, relative to the range, at which rows count as being at the
extreme."""

IMPACT, BRAKE = 3.0, 6.0
"""Smallest ratios of the velocity change at a stop to the largest velocity change per row before it and after it. One
of the two sides must reach the larger ratio."""

BEFORE, BEHIND = 10, 5
"""Number of rows before and after an impact in which the device moves freely."""

OVER = 3
"""Number of rows over which an impact changes the velocity."""

STAYS = 12
"""Smallest number of rows for which a position stays at an extreme."""

HARDER = 1.4
"""Smallest velocity change at a stop, relative to the largest velocity change over the same number of rows away from
the extremes. Commands and friction may also stop a device, but no more abruptly than they move it elsewhere."""

SLOWER = 1.5
"""Smallest ratio of the speeds before and after a stop. A free motion reverses with equal speeds before and after."""

FAST = 0.05
"""Smallest speed at a stop, relative to the largest speed."""

STEPS = 8.0
"""Smallest change of the velocity at a stop, in sensor steps per row."""

STILL = (1.2, 4.0, 0.02)
"""Largest distance from a stop at which the position counts as resting at the stop: in sensor steps, in standard
deviations of the noise, and in rows at the speed before the stop."""


def travel_stop(samples: Samples) -> Finding | None:
    """Return a finding with the row from which a travel stop affects the motion.

    At a travel stop, the velocity changes within two rows by more than command and friction change it elsewhere. This
    happens at the largest or the smallest position of the log. Afterwards, the device stays at this position, or leaves
    it more slowly than it arrived.
    """
    x, change = samples.position, samples.change
    if len(x) < 2 * BEFORE:
        return None
    size, low, high = samples.size, float(x.min()), float(x.max())
    near = AT_EXTREME * (high - low)
    at_extreme = (x >= high - near) | (x <= low + near)
    least = max(STEPS * samples.least_change, FAST * samples.fastest)
    rows = (at_extreme[BEFORE:-2] & (size[BEFORE - 2 : -3] > least)).nonzero()[0] + BEFORE
    rows = rows[size[rows - 2] > SLOWER * size[rows + 1]]
    rows = rows[(x[rows] - 0.5 * (high + low)) * change[rows - 2] > 0]
    elsewhere = None
    for row in rows.tolist():
        hit = float(abs(change[row + 1] - change[row + 1 - OVER]))
        brake, free = _around(samples, row)
        # with a wall, the command does not jump after its step
        is_seen = not samples.is_free and hit > BRAKE * brake and hit > IMPACT * free
        if not is_seen:
            if not (hit > IMPACT * brake and hit > BRAKE * free) and not _stays(samples, row):
                continue
            elsewhere = _hardest(samples, at_extreme) if elsewhere is None else elsewhere
            if hit <= HARDER * elsewhere:
                continue
        return samples.finding(
            "travel_stop",
            "cut",
            f"The position reaches {x[row]:.5g} {samples.unit('length')} in row {row} at "
            f"{size[row - 2] / samples.period:.3g} {samples.unit('velocity')} and stops there, which indicates a "
            "travel stop.",
            "The rows from this row on are left out. Record smaller or shorter steps, away from the stop.",
            first_row=row,
            rows=len(x) - row,
        )
    return None


def _hardest(samples: Samples, at_extreme: Booleans) -> float:
    """Return the largest velocity change over three rows, away from the extremes."""
    change = samples.change
    over = np.abs(change[OVER:] - change[:-OVER])
    # velocity changes that include a row at an extreme may be due to a stop
    beyond = np.concatenate([[0], np.cumsum(at_extreme)])
    last = np.minimum(np.arange(len(over)) + OVER + 2, len(at_extreme))
    return float(over[beyond[last] == beyond[: len(over)]].max(initial=0.0))


def _around(samples: Samples, row: int) -> tuple[float, float]:
    """Return the largest velocity change per row before an impact, and after it."""
    before, behind = samples.bend[row - BEFORE : row - 2], samples.bend[row + 1 : row + BEHIND]
    return float(np.abs(before).max()), float(np.abs(behind).max(initial=0.0))


def _stays(samples: Samples, row: int) -> bool:
    """Return True if the position stays at the place of the stop."""
    x = samples.position[row + 1 : row + 1 + STAYS]
    if len(x) < STAYS:
        return False
    steps, deviations, ways = STILL
    away = float(np.abs(x - x[0]).max())
    still = max(steps * samples.least_change, ways * float(samples.size[row - 2]))
    return away <= still or samples.is_noisier_than(away / deviations)
