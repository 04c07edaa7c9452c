"""Screen many logs in machine code.

A single pass over the rows identifies the logs whose command follows their wall and that have no fault. A log that
passes this screen has no findings. Each condition is necessary for a finding of some check (`check`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.base.compiled import compiled, part
from pipeline.recording import rows, signals, timing, travel, wrapping
from pipeline.recording.samples import LAW_RESIDUAL, SMALLEST_STEP, THIRD_MEDIAN, Samples
from pipeline.records.trials import Floats, Integers

NOTHING, REPEATED_ROWS, TRAVEL_STOP, ANYTHING = 0, 1, 2, 4
"""Codes of the possible findings of a log: no finding, repeated rows, a travel stop (or the sum of the last two), or
any finding.
"""

_LIMITS = np.array(
    [
        *(signals.FEWEST_ROWS, signals.COARSE, wrapping.JUMP, timing.EVEN, timing.MISSING, LAW_RESIDUAL, SMALLEST_STEP),
        *(rows.FEWEST, rows.FROZEN, rows.RARE, rows.NOISY * THIRD_MEDIAN, rows.MOVES, rows.MADE_UP),
        *(travel.AT_EXTREME, travel.FAST, travel.STEPS, travel.SLOWER, travel.IMPACT, travel.BRAKE),
        *(travel.HARDER, travel.STILL[0], travel.STILL[1] / THIRD_MEDIAN, travel.STILL[2]),
    ]
)
"""Limits of the checks, in the order in which `_found_in` reads them. They are passed as arguments, because compiled
code would contain fixed copies of constants."""


def screened(logs: Sequence[Samples]) -> list[int]:
    """Return the code of the possible findings of each log: none, only repeated rows or a travel stop, or any finding.

    Parameters
    ----------
    logs : sequence of Samples

    Returns
    -------
    list of int
        `NOTHING`, `REPEATED_ROWS`, `TRAVEL_STOP` or the sum of these two, or `ANYTHING` (also for all free motions).
    """
    result = np.full(len(logs), ANYTHING, dtype=np.int64)
    walls = [place for place, log in enumerate(logs) if not log.is_free and len(log) >= 2 * travel.BEFORE]
    if walls:
        chosen = [logs[place] for place in walls]
        time, command = np.concatenate([log.time for log in chosen]), np.concatenate([log.command for log in chosen])
        position = np.concatenate([log.position for log in chosen])
        ends = np.cumsum([0, *map(len, chosen)])
        conditions = np.array([(log.period, log.stiffness, log.damping / log.period, log.step) for log in chosen])
        found = np.empty(len(chosen), dtype=np.int64)
        _screen((time, command, position), ends, conditions, _LIMITS, found)
        result[walls] = found
    return list(map(int, result))


@compiled("void(UniTuple(f8[::1],3),i8[::1],f8[:,::1],f8[::1],i8[::1])")
def _screen(
    rows: tuple[Floats, Floats, Floats], ends: Integers, conditions: Floats, limits: Floats, found: Integers
) -> None:
    """Compute the possible findings of each log from the time, command and position of all rows."""
    time, command, position = rows
    for log in range(len(found)):
        first, behind = ends[log], ends[log + 1]
        found[log] = _found_in(
            time[first:behind], command[first:behind], position[first:behind], conditions[log], limits
        )


@part
def _found_in(time: Floats, command: Floats, x: Floats, conditions: Floats, limits: Floats) -> int:
    """Return the possible findings of one log."""
    fewest_rows, coarse, jump, even, missing, law, smallest = limits[:7]
    fewest, frozen, rare, noisy, moving, made_up = limits[7:13]
    at_extreme, fast, steps_at_stop, slower, impact, strong, harder, still, deviations, ways = limits[13:23]
    period, stiffness, damping_per_row, step = conditions
    may_repeat, may_stop, anything = 1, 2, 4
    size = len(x)

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
        return anything

    least = fastest
    for row in range(size - 1):
        change = abs(x[row + 1] - x[row])
        if change > smallest * reach:
            least = min(least, change)
    if least > coarse * reach:
        return anything

    found = 0
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
        found += may_repeat if is_noisy or repeats >= fewest else 0

    # travel stop
    near, speed = at_extreme * reach, max(steps_at_stop * least, fast * fastest)
    noise = 2 * total_third / max(size - 3, 1)  # upper bound of the median
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
        if hit > strong * brake and hit > impact * free:
            found += may_stop
            break
        if not stays and (hit <= impact * brake or hit <= strong * free):
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
    return found
