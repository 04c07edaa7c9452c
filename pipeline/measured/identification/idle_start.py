"""Find a time at the start of logs in which the command does not act, because the drive is still switched off or the
device is blocked.

The device is identified without these rows. It must then predict that the command would have moved it in these rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.state_space import state_space
from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.identification.free_runs import free_runs
from pipeline.measured.identification.identified import Identification, identified
from pipeline.measured.identification.motion import PlantShape
from pipeline.measured.identification.recordings import Recording
from pipeline.measured.identification.replay import follows
from pipeline.measured.identification.segments import segments_of

FEWEST_IDLE = 60
"""Smallest number of rows between the first command and the first motion. It exceeds the longest delay in the search,
48 rows."""

LONGEST_DELAY = 48
"""Number of rows before the first motion whose commands may cause it."""

VISIBLE = 6.0
"""Smallest displacement that counts as a motion, in standard deviations of a reading."""

LASTING = 5
"""Number of rows for which a displacement must last to count as a motion."""

SMALL_COMMAND = 0.05
"""Largest command that counts as no command, relative to the largest command of the log."""

SUDDEN = 50.0
"""Smallest displacement after the first motion, within a time as long as the time before it, relative to a visible
displacement. A force that is constant from the start would cause a ninth of it, because the displacement grows with the
square of the time."""

COMPARABLE = 0.3
"""Smallest command without effect, relative to the command that sets the device in motion."""

STATIC_FRICTION = {0.98: 2.0, COMPARABLE: 5.0}
"""Static friction, relative to Coulomb friction, that must be too small to explain the rest. The keys are the smallest
commands without effect, relative to the command that sets the device in motion. For small commands, the static friction
is larger, because an increase of the command may have overcome it."""

PREDICTED = 10.0
"""Smallest predicted displacement of a device whose command does not act, relative to a visible displacement."""


@dataclass(frozen=True)
class IdleStart:
    """Rows at the start of a log that are left out because the command does not act, and their duration."""

    log: str
    rows: int
    duration_s: float


def identified_while_driven(recordings: list[Recording]) -> tuple[Identification, list[IdleStart]]:
    """Identify a device without the rows at the start of logs in which the command does not act.

    Raises
    ------
    ParameterError
        As `identified`.
    """
    rows = [suspected_rows(each) for each in recordings]
    if not any(rows):
        return identified(recordings), []
    try:
        found = identified([_behind(each, first) for each, first in zip(recordings, rows, strict=True)])
    except ParameterError:
        return identified(recordings), []
    if not follows(found.fit_percent, found.naive_percent):
        return identified(recordings), []
    sure = [
        first if first and _would_move(each, first, found) else 0 for each, first in zip(recordings, rows, strict=True)
    ]
    if sure != rows:
        found = identified([_behind(each, first) for each, first in zip(recordings, sure, strict=True)])
    idle = [
        IdleStart(each.name, first, float(each.time[first] - each.time[0]))
        for each, first in zip(recordings, sure, strict=True)
        if first
    ]
    return found, idle


def suspected_rows(each: Recording) -> int:
    """Return the row of the first motion of a log if the command may not have acted before this row, otherwise 0.

    Logs of walls are not suspected, since their command depends on the motion.
    """
    if any(each.wall) or len(each.time) < 2 * FEWEST_IDLE:
        return 0
    away, size = np.abs(each.position - each.position[0]), np.abs(each.command)
    visible = VISIBLE * each.noise
    lasting = np.convolve(away > visible, np.ones(LASTING), mode="valid") >= LASTING
    driven = size > SMALL_COMMAND * size.max()
    if not lasting.any() or not driven.any():
        return 0
    first, begin = int(np.argmax(lasting)), int(np.argmax(driven))
    idle = first - begin
    if idle < FEWEST_IDLE or away[first : first + idle].max() < SUDDEN * visible:
        return 0
    return first if _ratio(each, first) >= COMPARABLE else 0


def _ratio(each: Recording, first: int) -> float:
    """Return the largest command before a row, relative to the command that sets the device in motion at this row."""
    size, start = np.abs(each.command), first - LONGEST_DELAY
    cause = float(size[start : first + 1].max())
    return float(size[:start].max()) / cause if cause > 0 else np.inf


def _behind(each: Recording, first: int) -> Recording:
    """Return a recording without its first rows."""
    if not first:
        return each
    inside = slice(first, None)
    return replace(
        each, time=each.time[inside], command=each.command[inside], position=each.position[inside], edge=None
    )


def _would_move(each: Recording, first: int, found: Identification) -> bool:
    """Return whether the identified device would have moved before a row, even with a larger static friction."""
    choice, units = found.choice, found.units
    idle = replace(
        each, time=each.time[:first], command=each.command[:first], position=each.position[:first], edge=None
    )
    segments = segments_of([idle], units, choice.segments.lead, False, whole=True)
    numbers = choice.fit.device.numbers
    friction = max(_friction(found) / units.command * numbers["gain"], numbers.get("coulomb", 0.0))
    rubs = np.array([numbers.get("force", 0.0), friction, numbers.get("load_coulomb", 0.0)])
    ratio = _ratio(each, first)
    rubs[1:] *= next(factor for least, factor in STATIC_FRICTION.items() if ratio >= least)
    shape = PlantShape.of(numbers)
    starts = np.zeros((len(segments), 1, state_space(shape.plant).states))
    starts[:, 0, [0, 2] if shape.load_mass else [0]] = segments.position[segments.first][:, None]
    runs = free_runs(segments, numbers, [(numbers["gain"], rubs)] * len(segments), starts) if len(segments) else starts
    return bool(np.ptp(runs) * units.position >= PREDICTED * VISIBLE * each.noise)


def _friction(found: Identification) -> float:
    """Return the largest Coulomb friction [N, Nm] that the logs do not exclude."""
    name = "friction.coulomb"
    if ESTIMATED[name].number in found.choice.fit.device.numbers:
        return max(found.parameters[name].high, 0.0)
    return found.choice.bounds.get(name, 0.0)
