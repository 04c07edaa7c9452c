"""Find rows that are not readings: repeated rows, a frozen position, and interpolated positions."""

from __future__ import annotations

import numpy as np

from pipeline.recording.samples import Samples, last_digit, middle
from pipeline.records.findings import Finding
from pipeline.records.trials import Integers

MOVES = 3.0
"""Smallest position change before and after a repeated row, in sensor steps."""

CLEAR = 8.0
"""Smallest position change before and after a repeated row, in standard deviations of a reading."""

NOISY = 3.0
"""Standard deviation of the noise, in sensor steps, above which equal consecutive readings are not attributed to
chance."""

RARE = 0.15
"""Largest share of equal consecutive readings for noise of this size."""

EQUAL = 0.3
"""Probability of two equal consecutive readings, divided by the ratio of sensor step to noise standard deviation."""

MADE_UP = 1.3
"""Threshold for the ratio of the change after a repeated reading to the change before it. The threshold exceeds 1
because the change after the repetition covers two rows."""

JUMPS = 5.0
"""Threshold for the change after frozen rows, relative to the typical nearby change and to the last change before the
frozen rows."""

FEWEST = 3
"""Smallest number of repeated rows that is not attributed to a reversal of the motion."""

FROZEN = 10
"""Smallest number of constant rows for which a position counts as frozen."""

FEWEST_KNOTS = 4
"""Smallest number of kinks of a position or command from which a coarser grid of readings is inferred."""

NO_CHANCE = 7.0
"""Threshold for the logarithm of the number of possible arrangements of kinks. Above it, a grid is not attributed to
chance, because only one of the arrangements is a grid."""

STRAIGHT = 0.4
"""Threshold for the share of collinear rows among the moving rows. Above it, a position counts as interpolated."""

MOVING = 2.0
"""Change per row, in units of the smallest kink, above which the position counts as moving."""

NEARLY_STRAIGHT = 0.02
"""Second difference, relative to the change, below which rows may be collinear."""

BEND = 1e-6
"""Largest second difference, relative to the largest change, for which three rows are collinear."""

EXACT = 1e-9
"""Largest second difference, relative to the largest change, for rows that were interpolated and printed with all
digits."""


def repeated_rows(samples: Samples) -> Finding | None:
    """Return a finding with the rows that repeat the previous reading while the device moves.

    If the noise exceeds the sensor step, equal consecutive readings are copies of one reading. Otherwise, the reason is
    that a position which moves by several steps per row cannot rest for one row and catch up in the next row.
    """
    if samples.resting < FEWEST:
        return None
    size = samples.size
    single = samples.moves[:-1][samples.pauses == 1] + 1
    if len(single) < FEWEST:
        return None
    rows = single + 1
    # if the noise is much larger than a step, equal readings are rare
    noisy = len(single) < RARE * len(size) and samples.is_noisier_than(NOISY * samples.least_change)
    by_chance = EQUAL * len(size) * samples.least_change / samples.noise if noisy else np.inf
    if len(rows) < FEWEST + by_chance + 5 * np.sqrt(by_chance):
        single = single[size[single - 1] >= MOVES * samples.least_change]
        before, behind = samples.change[single - 1], samples.change[single + 1]
        single = single[(before * behind > 0) & (np.abs(behind) > MADE_UP * np.abs(before))]
        if len(single) >= FEWEST:
            single = single[size[single + 1] > CLEAR * samples.noise]
        rows = single + 1
    if len(rows) < FEWEST:
        return None
    both = int(np.sum(samples.jumps[rows - 1] == 0))
    what = "rows" if both > len(rows) / 2 else "readings of the position"
    return samples.finding(
        "repeated_rows",
        "note",
        f"{len(rows)} of {len(samples)} {what} repeat the previous one while the device moves. The first is row "
        f"{rows[0]}.",
        "Read the sensor in every sample, or log at the rate at which the sensor is read.",
        first_row=int(rows[0]),
        rows=len(rows),
    )


def frozen_position(samples: Samples) -> Finding | None:
    """Return a finding if the position is constant and then jumps further than any force could move the device."""
    if samples.resting < FROZEN or samples.pauses.max(initial=0) < FROZEN:
        return None
    size, least = samples.size, MOVES * samples.least_change
    for place in np.flatnonzero(samples.pauses >= FROZEN).tolist():
        first, behind = int(samples.moves[place]) + 1, int(samples.moves[place + 1])
        if behind + 2 >= len(size) or size[behind] <= least:
            continue
        jump, usual = size[behind], middle(size[behind + 1 : behind + 1 + FROZEN])
        if jump > max(JUMPS * usual, CLEAR * samples.noise) and jump > JUMPS * size[first - 1] + CLEAR * samples.noise:
            return samples.finding(
                "frozen_position",
                "unsafe",
                f"The position is frozen in rows {first + 1} to {behind} while the device moves, and then "
                f"jumps by {jump:.4g}.",
                "Check the sensor and its cable, and record again.",
                first_row=first + 1,
                rows=behind - first,
            )
    return None


def interpolated_position(samples: Samples) -> Finding | None:
    """Return a finding if most positions are interpolated linearly between fewer readings, because the sensor rate is
    lower.

    All kinks of the position are then on a grid of every n-th row. The probability of this by chance is n^-(kinks - 1).
    """
    if samples.obeys_wall or len(samples.size) < 4 * FEWEST_KNOTS:
        return None
    exact = EXACT * samples.fastest + 8 * np.finfo(np.float64).eps * float(np.abs(samples.position).max())
    lines = _lines(samples, exact)
    if lines is None and _may_be_printed(samples):
        # rounding of printed readings bends a line by at most two digits
        lines = _lines(samples, max(BEND * samples.fastest, 2.1 * last_digit(samples.position)))
    if lines is None:
        return None
    factor, rows = lines
    return samples.finding(
        "interpolated_rows",
        "unsafe",
        f"The positions are on straight lines between every {ordinal(factor)} row, so the positions between these rows "
        "are interpolated, and move before their commands.",
        "Export the position without interpolation, or at the rate at which the sensor was read.",
        rows=rows,
    )


def _lines(samples: Samples, level: float) -> tuple[int, int] | None:
    """Return the row distance of the interpolated readings and the number of collinear rows, or None without a grid."""
    bent = np.abs(samples.bend) > level
    if (bent[1:] & bent[:-1]).any():
        return None
    bends = np.flatnonzero(bent)
    factor = spacing(bends)
    if factor < 2 or len(bends) < FEWEST_KNOTS or (len(bends) - 1) * np.log(factor) < NO_CHANCE:
        return None
    moving = (samples.size[1:] > MOVING * level) & (samples.size[:-1] > MOVING * level)
    on_line = int(np.count_nonzero(moving & ~bent))
    return (factor, on_line) if on_line >= max(STRAIGHT * int(np.count_nonzero(moving)), 1) else None


def _may_be_printed(samples: Samples) -> bool:
    """Return True if the number of nearly collinear rows is consistent with interpolated positions that were
    rounded."""
    size = samples.size
    moves = int(np.count_nonzero(size > MOVING * BEND * samples.fastest))
    straight = int(np.count_nonzero(np.abs(samples.bend) <= NEARLY_STRAIGHT * size[1:]))
    return straight - (len(size) - moves) >= 0.5 * STRAIGHT * moves


def spacing(rows: Integers) -> int:
    """Return the greatest common divisor of the distances between rows, or 0 for fewer than two rows."""
    return int(np.gcd.reduce(np.diff(rows))) if len(rows) > 1 else 0


def ordinal(number: int) -> str:
    """Return a number as an ordinal, e.g. ``2nd``."""
    return {2: "2nd", 3: "3rd"}.get(number, f"{number}th")
