"""Find whether the errors of an identified device depend on direction, size of the command, place, or time."""

from __future__ import annotations

import numpy as np

from pipeline.measured.identification.final_fit import Choice
from pipeline.measured.identification.likelihood import columns_of
from pipeline.records.trials import Floats, Integers

SHARE = 0.2
"""Smallest adjusted share of the variance of errors between groups for which the grouping is reported as a cause."""

FEWEST_ROWS = 3
"""Smallest mean number of rows per group."""

SIZES, PLACES, TIMES = 6, 60, 12
"""Number of groups of command size, number of groups of places, and number of groups of times in each log."""

CAUSES = {
    "direction": "The errors depend on the direction: the drive or the friction differs between the two directions.",
    "size": "The errors depend on the size of the command: the force is not proportional to the command.",
    "place": "The errors depend on the position: a force or the friction changes along the path.",
    "time": "The errors depend on the time: a disturbance acts, or the device changes.",
}
"""Sentence of the report for each grouping."""


def departure(choice: Choice) -> str:
    """Return a sentence that names the quantity on which the errors of a device depend most. The text is empty if they
    depend on no grouping of `CAUSES`."""
    shares = shares_between_groups(choice)
    name = max(shares, key=lambda each: shares[each])
    return f"{CAUSES[name]} This explains {100 * shares[name]:.0f} % of their variance." if shares[name] > SHARE else ""


def shares_between_groups(choice: Choice) -> dict[str, float]:
    """Return the share of the variance of the prediction errors that lies between groups, for each grouping in
    `CAUSES`.

    R^2 is the share of the variance of n errors that lies between g groups. It is adjusted for chance to 1 - (1 - R^2)
    (n - 1)/(n - g), and may be slightly negative.
    """
    segments = choice.segments
    columns = columns_of(segments, choice.fit.device, (), whole=segments)
    errors = columns.values[np.arange(len(segments.places)) + columns.starts * segments.segment, -1]
    return {name: _share(errors, groups) for name, groups in _groupings(choice).items()}


def _groupings(choice: Choice) -> dict[str, Integers]:
    """Return the group of each row of the segments, for each grouping."""
    segments = choice.segments
    row, trial = segments.places, segments.trial[segments.segment]
    last = np.repeat(segments.behind - 1, segments.rows)
    way = np.sign(segments.position[np.minimum(row + 1, last)] - segments.position[np.maximum(row - 1, 0)])
    command, x = segments.command[row], segments.position[row]
    ends = segments.offsets[trial], segments.offsets[trial + 1]
    sign = (way + 1).astype(np.int64)
    place = np.minimum(PLACES * (x - x.min()) / max(np.ptp(x), 1e-300), PLACES - 1).astype(np.int64)
    time = np.minimum(TIMES * (row - ends[0]) // np.maximum(ends[1] - ends[0], 1), TIMES - 1)
    size = np.minimum(SIZES * np.abs(command), SIZES - 1).astype(np.int64)
    return {
        "direction": 3 * (np.sign(command) + 1).astype(np.int64) + sign,
        "size": 2 * size + (command > 0),
        "place": 3 * place + sign,
        "time": TIMES * trial + time,
    }


def _share(errors: Floats, groups: Integers) -> float:
    """Return the share of the variance of the errors that lies between the groups, adjusted for chance."""
    count = np.bincount(groups)
    used, n = int((count > 0).sum()), len(errors)
    if n < FEWEST_ROWS * used or not (total := float(((errors - errors.mean()) ** 2).sum())):
        return 0.0
    sums = np.bincount(groups, errors)
    between = float((sums[count > 0] ** 2 / count[count > 0]).sum()) - n * float(errors.mean()) ** 2
    return 1 - (1 - between / total) * (n - 1) / (n - used)
