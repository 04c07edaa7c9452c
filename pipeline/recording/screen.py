"""A screen in machine code: most logs behind a wall obey its law, and one pass over their rows shows that all is well.

What it lets through no check has a finding for; each condition is one that a finding of a check needs (`check`).
"""

from __future__ import annotations

from itertools import count

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.recording import rows, signals, timing, travel, wrapping
from pipeline.recording.samples import LAW_RESIDUAL, SMALLEST_STEP, THIRD_MEDIAN, Samples
from pipeline.records.trials import Floats

MANY = 100
"""Logs of a process from which on loading machine code takes less time than it saves."""

NOTHING, REPEATED_ROWS, TRAVEL_STOP, ANYTHING = 0, 1, 2, 4
"""What a check may find: the sum of both in the middle, or anything."""

_checked = count()
"""Numbers of the logs that a process checks."""

_LIMITS = np.array(
    [
        *(signals.FEWEST_ROWS, signals.COARSE, wrapping.JUMP, timing.EVEN, timing.MISSING, LAW_RESIDUAL, SMALLEST_STEP),
        *(rows.FEWEST, rows.FROZEN, rows.RARE, rows.NOISY * THIRD_MEDIAN, rows.MOVES, rows.MADE_UP),
        *(travel.AT_EXTREME, travel.FAST, travel.STEPS, travel.SLOWER, travel.IMPACT, travel.HARDER),
        *(travel.STILL[0], travel.STILL[1] / THIRD_MEDIAN, travel.STILL[2], ANYTHING),
    ]
)
"""Limits of the checks, in the order in which `_screen` takes them: machine code would keep those of a module."""


def may_be_wrong(samples: Samples) -> int:
    """Return what a check may find: nothing, repeated rows or a travel stop alone, or anything (`NOTHING`, ...).

    The first logs of a process are not screened.

    Parameters
    ----------
    samples : Samples
    """
    if samples.is_free or len(samples) < 2 * travel.BEFORE or next(_checked) < MANY:
        return ANYTHING
    columns = np.concatenate((samples.time, samples.command, samples.position))
    numbers = _LIMITS.copy()
    period = samples.period
    _screen(columns, numbers, period, samples.stiffness, samples.damping / period, samples.step)
    return int(numbers[-1])


@compiled("void(f8[::1],f8[::1],f8,f8,f8,f8)")
def _screen(
    columns: Floats, numbers: Floats, period: float, stiffness: float, damping_per_row: float, step: float
) -> None:
    """Set the last number to what a check of time, command and position, one behind the other, may find."""
    fewest_rows, coarse, jump, even, missing, law, smallest = numbers[:7]
    fewest, frozen, rare, noisy, moving, made_up = numbers[7:13]
    at_extreme, fast, steps_at_stop, slower, impact, harder, still, deviations, ways = numbers[13:22]
    size = len(columns) // 3
    time, command, x = columns[:size], columns[size : 2 * size], columns[2 * size :]
    may_repeat, may_stop = 1.0, 2.0

    low = high = x[0]
    longest = fastest = force_power = rest_power = largest = total_third = 0.0
    is_commanded = command[0] != 0
    pause, longest_pause, singles, resting, first_moved = 0, 0, 0, 0, False
    before = third_before = 0.0
    for row in range(size - 1):
        low, high = min(low, x[row + 1]), max(high, x[row + 1])
        longest = max(longest, time[row + 1] - time[row])
        is_commanded = is_commanded or command[row + 1] != 0
        change = x[row + 1] - x[row]
        fastest = max(fastest, abs(change))
        if change == 0:
            resting += 1
            pause += 1
        else:
            if first_moved:
                longest_pause = max(longest_pause, pause)
                singles += pause == 1
            pause, first_moved = 0, True
        force = (stiffness + damping_per_row) * change - damping_per_row * before
        rest = command[row + 1] - command[row] + force
        force_power += force * force
        rest_power += rest * rest
        largest = max(largest, abs(rest))
        bend = change - before
        if row > 1:
            total_third += abs(bend - third_before)
        before, third_before = change, bend
    reach = high - low
    mean = (time[size - 1] - time[0]) / (size - 1)
    law_power = law * law * force_power
    if (
        size < fewest_rows
        or reach == 0
        or (step != 0 and not is_commanded)
        or abs(mean / period - 1) > even
        or longest > missing * period
        or fastest > jump * reach
        or longest_pause >= frozen
        or not rest_power - largest * largest <= law_power * (1 - 1e-9)
    ):
        return

    least = fastest
    for row in range(size - 1):
        change = abs(x[row + 1] - x[row])
        if change > smallest * reach:
            least = min(least, change)
    if least > coarse * reach:
        return

    found = 0.0
    # repeated rows
    if resting >= fewest and singles >= fewest:
        above = repeats = 0
        for row in range(size - 3):
            ahead, between, behind = x[row + 1] - x[row], x[row + 2] - x[row + 1], x[row + 3] - x[row + 2]
            above += abs((behind - between) - (between - ahead)) > noisy * least
            if between == 0:
                goes_on = ahead * behind > 0 and abs(ahead) >= moving * least
                repeats += goes_on and abs(behind) > made_up * abs(ahead)
        is_noisy = singles < rare * (size - 1) and above >= (size - 3) - (size - 3) // 2
        found += may_repeat if is_noisy or repeats >= fewest else 0.0

    # travel stop
    near, speed = at_extreme * reach, max(steps_at_stop * least, fast * fastest)
    noise = 2 * total_third / max(size - 3, 1)  # no median is larger
    hardest = -1.0
    for row in range(10, size - 2):
        if x[row] < high - near and x[row] > low + near:
            continue
        came, leaves = x[row - 1] - x[row - 2], x[row + 2] - x[row + 1]
        if abs(came) <= speed or abs(came) <= slower * abs(leaves) or (x[row] - 0.5 * (high + low)) * came <= 0:
            continue
        hit = abs(leaves - came)
        brake = free = away = 0.0
        for place in range(row - 10, row - 2):
            brake = max(brake, abs((x[place + 2] - x[place + 1]) - (x[place + 1] - x[place])))
        for place in range(row + 1, min(row + 5, size - 2)):
            free = max(free, abs((x[place + 2] - x[place + 1]) - (x[place + 1] - x[place])))
        for place in range(row + 1, min(row + 13, size)):
            away = max(away, abs(x[place] - x[row + 1]))
        stays = away <= max(still * least, ways * abs(came), deviations * noise)
        if not stays and (hit <= impact * brake or hit <= 2 * impact * free):
            continue
        if hardest < 0:
            hardest = 0.0
            for place in range(size - 4):
                inside = True
                for other in range(place, min(place + 5, size)):
                    inside = inside and x[other] < high - near and x[other] > low + near
                if inside:
                    over = abs((x[place + 4] - x[place + 3]) - (x[place + 1] - x[place]))
                    hardest = max(hardest, over)
        if hit > harder * hardest:
            found += may_stop
            break
    numbers[-1] = found
