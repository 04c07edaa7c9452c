"""Where the errors of an identified device are: by direction, size of the command, place, or time."""

from __future__ import annotations

import numpy as np

from pipeline.measured.identification.likelihood import columns_of
from pipeline.measured.identification.parts import Choice
from pipeline.records.trials import Floats, Integers

SHARE = 0.2
"""Smallest share of the variance of errors by groups, less that by chance, that names a cause."""

FEWEST_ROWS = 3
"""Smallest number of rows of a group, on average."""

SIZES, PLACES, TIMES = 6, 60, 12
"""Numbers of groups of the size of the command, of the place, and of the time in each log."""

CAUSES = {
    "direction": "The errors differ by direction: the drive or the friction is not the same both ways.",
    "size": "The errors differ by the size of the command: the force is not proportional to it.",
    "place": "The errors differ by place: a force or the friction changes along the way.",
    "time": "The errors differ by time: a disturbance acts, or the device changes.",
}
"""Sentence by grouping."""


def departure(choice: Choice) -> str:
    """Return a sentence that names where the errors of a device are, with their share; empty if they are nowhere.

    The share of the variance between g groups of n rows is adjusted by that of chance, 1 - (1 - R^2) (n - 1)/(n - g).
    """
    segments = choice.segments
    columns = columns_of(segments, choice.fit.device, (), whole=segments)
    errors = columns.values[np.arange(len(segments.places)) + columns.starts * segments.segment, -1]
    shares = {name: _share(errors, groups) for name, groups in _groupings(choice).items()}
    name = max(shares, key=lambda each: shares[each])
    return f"{CAUSES[name]} This is {100 * shares[name]:.0f} % of their variance." if shares[name] > SHARE else ""


def _groupings(choice: Choice) -> dict[str, Integers]:
    """Return the group of each row of segments by grouping."""
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
    """Return the adjusted share of the variance of errors between groups."""
    count = np.bincount(groups)
    used, n = int((count > 0).sum()), len(errors)
    if n < FEWEST_ROWS * used or not (total := float(((errors - errors.mean()) ** 2).sum())):
        return 0.0
    sums = np.bincount(groups, errors)
    between = float((sums[count > 0] ** 2 / count[count > 0]).sum()) - n * float(errors.mean()) ** 2
    return 1 - (1 - between / total) * (n - 1) / (n - used)
