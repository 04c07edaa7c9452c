"""Simulate a trial at a wall row by row: sensor, velocity, wall law, delayed command, and exact motion with friction.

The compiled run models a controller that samples at t_k = k T:

    y[k] = round((p(t_k) + n[k])/q) q        F[k] = E[k] - K (y[k] - y[0] + s) - B v[k]

The sensor reads the position p with noise n and resolution q. E is the external force, s the depth in the wall at the
first row, and v the velocity estimated from y. F is limited and amplified, and reaches the plant after the delay. While
F is constant, the plant moves with x(t + h) = e^(A h) x(t) within its region of friction (`pipeline.loop.motion`).

The parts of a row (velocity estimator, step of motion) are separate functions. Numba inlines them into the loops that
call them. In other calls, they run as plain Python. Numba checks only the file of the loop to detect outdated machine
code. These functions and their constants must therefore be in this module.

Source: Hulin 2017, sec. 3.1 and 6.1.1.
"""

from __future__ import annotations

from math import ceil, inf, sqrt

import numpy as np

from pipeline.base.compiled import compiled, inlined
from pipeline.records.trials import Booleans, Floats, Integers

STICK, CREEP, SLIDE = 0, 1, 2
"""Regions of friction. Without a Stribeck effect there is no `SLIDE`: all motion is a `CREEP` at constant friction."""

CELLS = 32
"""Number of cells of a time grid that is searched for a change of region."""

TERMS = 17
"""Number of terms of the power series within a cell."""

MOST_EVENTS = 400
"""Largest number of region changes. After that, a motion stays in its region, which ends any chatter."""

SETTLED = 2.0**-50
"""Threshold for the Newton step relative to a cell. Below it, the step is only a rounding error."""

MOST_STEPS = 60
"""Largest number of iterations in the search for a zero. Bisection alone needs 53 for a double."""

FILTER, DIFFERENCE, WINDOW, LEVANT = 0, 1, 2, 3
"""Velocity estimators, which are a linear filter, the difference over several samples, the adaptive window, and
Levant's differentiator."""

Interval = tuple[Floats, Floats, Floats, Floats, Floats, float, bool]
"""Exact motion over a time interval, with data for a stop within it, for R regions of friction and n states.

- ``whole`` (R, n + 4, n + 3): state at the end, then guard at the start and the end, and its slope at both. Without
  friction, R is 1 and only the state is stored.
- ``grids`` (levels, R, CELLS + 1, n + 2, n + 3): state, guard and slope at the edges of cells. Each level divides one
  cell of the level above.
- ``series`` (R, n + 1, TERMS, n + 3): power series of state and guard in a cell of the finest grid.
- ``bounds`` (2, R): lower and upper bounds of the guard in each region; (2, 0) without friction.
- ``force`` (n + 3,): force on the motor without friction.
- Duration [s], and a flag. The flag is True if the motion is so slow that its end points show whether it may leave a
  region.

The arrays are multiplied by z, which consists of state, command, additional force and direction of friction.
"""

_INTERVAL = "Tuple((f8[:,:,::1],f8[:,:,:,:,::1],f8[:,:,:,::1],f8[:,::1],f8[::1],f8,b1))"


@inlined
def dot(a: Floats, b: Floats) -> float:
    """Return the scalar product of two vectors."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@inlined
def polynomial(series: Floats, time: float) -> float:
    """Return the value of a polynomial, lowest power first, at a time."""
    total = 0.0
    for k in range(len(series) - 1, -1, -1):
        total = total * time + series[k]
    return total


@inlined
def scaled(series: Floats, factor: float) -> Floats:
    """Return a polynomial times a factor."""
    result = np.empty(len(series))
    for k in range(len(series)):
        result[k] = factor * series[k]
    return result


@inlined
def derivative(series: Floats) -> Floats:
    """Return the derivative of a polynomial."""
    result = np.empty(len(series) - 1)
    for k in range(len(result)):
        result[k] = (k + 1) * series[k + 1]
    return result


@inlined
def last_zero(series: Floats, end: float) -> float:
    """Return the last zero of a polynomial that is nonnegative at 0 and negative at ``end``."""
    slopes, low, high = derivative(series), 0.0, end
    # the search starts from the parabola with the value and slope at 0 and the value at the end
    first, rate = series[0], series[1] * end
    bend = min(polynomial(series, end), 0.0) - first - rate
    divisor = sqrt(max(rate * rate - 4 * bend * first, 0.0)) - rate
    time = end * (2 * first / divisor) if divisor > 2 * first else end
    for _ in range(MOST_STEPS):
        height, rate = polynomial(series, time), polynomial(slopes, time)
        step = height / rate if rate < 0 else inf
        if height >= 0:
            low = time
        else:
            high = time
        if abs(step) <= SETTLED or high - low <= SETTLED:
            break
        time -= step
        if not low < time < high:
            time = 0.5 * (low + high)
    return time


@inlined
def first_exit(series: Floats, low: float, high: float, span: float) -> tuple[float, int]:
    """Return the time at which a polynomial leaves its bounds within [0, span], and the direction, down (-1) or up (1).

    If the polynomial stays within its bounds, the direction is 0 and the time is the span. If it starts on a bound, the
    sign of its slope decides whether it leaves. The polynomial may have only one extremum within the span.
    """
    start, slope, until = series[0], series[1], span
    slopes = derivative(series)
    if slope * polynomial(slopes, span) < 0:
        turn = last_zero(scaled(slopes, 1.0 if slope > 0 else -1.0), span)
        there = polynomial(series, turn)
        if there < low or there > high:
            until = turn
    end = polynomial(series, until)
    if start > high or (start == high and slope > 0):
        return 0.0, 1
    if start < low or (start == low and slope < 0):
        return 0.0, -1
    if low <= end <= high:
        return span, 0
    way = 1 if end > high else -1
    inward = scaled(series, -way)
    inward[0] += high if way > 0 else -low
    return last_zero(inward, until), way


@inlined
def extent(guard: float, later: float, slope: float, later_slope: float, span: float) -> tuple[float, float]:
    """Return the lower and upper bounds of a guard over a time span, from value and slope at both ends."""
    # between the ends, a guard with an extremum is never steeper than the sum of both end slopes
    reach = span * (abs(slope) + abs(later_slope)) if slope * later_slope < 0 else 0.0
    return min(guard, later) - reach, max(guard, later) + reach


@inlined
def region_behind(z: Floats, region: int, upwards: bool, bounds: Floats, force: Floats) -> int:
    """Return the region that a motion enters when its guard reaches a bound, and set its velocity to the bound."""
    stops = region == CREEP and not upwards
    if not stops and region != STICK:
        z[1] = bounds[1, CREEP] * z[-1]
        return SLIDE if region == CREEP else CREEP
    if stops:
        z[1] = 0.0
    driving = dot(force, z)
    z[-1] = -1.0 if driving < 0 else 1.0
    return STICK if stops and abs(driving) <= bounds[1, STICK] else CREEP


@inlined
def advance_through_regions(z: Floats, region: int, interval: Interval) -> None:
    """Advance a state over an interval in which friction may change its region."""
    _, grids, series, bounds, force, time_s, _ = interval
    n, cell = len(z) - 3, 1.0 / CELLS ** len(grids)
    state, powers, left = np.empty(n), np.empty((n + 1, TERMS)), 1.0
    for events in range(MOST_EVENTS + 1):
        low, high = (bounds[0, region], bounds[1, region]) if events < MOST_EVENTS else (-inf, inf)
        span = 1.0
        for level in range(len(grids)):
            grid = grids[level, region]
            span /= CELLS
            last = min(CELLS, max(ceil(left / span), 1) - 1)
            edge, later, later_slope = 0, z[-1] * dot(grid[0, n], z), z[-1] * dot(grid[0, n + 1], z)
            while edge < last:
                guard, slope = later, later_slope
                later, later_slope = z[-1] * dot(grid[edge + 1, n], z), z[-1] * dot(grid[edge + 1, n + 1], z)
                least, most = extent(guard, later, slope, later_slope, time_s * span)
                if least < low or most > high:
                    break
                edge += 1
            for i in range(n):
                state[i] = dot(grid[edge, i], z)
            for i in range(n):
                z[i] = state[i]
            left -= edge * span
        for i in range(n + 1):
            for k in range(TERMS):
                powers[i, k] = dot(series[region, i, k], z)
        time, way = first_exit(scaled(powers[n], z[-1]), low, high, min(left / cell, 1.0))
        for i in range(n):
            z[i] = polynomial(powers[i], time)
        if way != 0:
            region = region_behind(z, region, way > 0, bounds, force)
        left -= time * cell
        if not left > SETTLED * cell:
            break


@inlined
def advance(z: Floats, interval: Interval) -> None:
    """Advance the state in z = (state, command, additional force, direction of friction) over an interval."""
    whole, _, _, bounds, _, time_s, slow = interval
    n, region = len(z) - 3, 0
    if bounds.shape[1]:
        z[-1] = -1.0 if z[1] < 0 else 1.0
        region = CREEP if z[1] != 0 else STICK
        if bounds.shape[1] > SLIDE and abs(z[1]) >= bounds[0, SLIDE]:
            region = SLIDE
        guard, later = z[-1] * dot(whole[region, n], z), z[-1] * dot(whole[region, n + 1], z)
        slope, later_slope = z[-1] * dot(whole[region, n + 2], z), z[-1] * dot(whole[region, n + 3], z)
        least, most = extent(guard, later, slope, later_slope, time_s)
        if not slow or least < bounds[0, region] or most > bounds[1, region]:
            advance_through_regions(z, region, interval)
            return
    state = np.empty(n)
    for i in range(n):
        state[i] = dot(whole[region, i], z)
    for i in range(n):
        z[i] = state[i]


@inlined
def velocity(kind: int, numbers: Floats, period: float, memory: Floats, position: Floats, row: int) -> float:
    """Return the velocity estimated from the positions up to a row, and update the memory of the estimator.

    Parameters
    ----------
    kind : int
        `FILTER` (transposed direct form), `DIFFERENCE`, `WINDOW` or `LEVANT`.
    numbers : float64, shape (2, m)
        For a filter, b and a in powers of 1/z, with a zero appended to both. Otherwise the first row contains the
        number of samples of the difference, the bound and the longest length of the window, or the acceleration of
        Levant's differentiator.
    period : float
        T [s].
    memory : float64, shape (m,)
        Memory of the estimator, which is zero before the first row.
    position : float64, shape (rows,)
    row : int
    """
    first, result = float(numbers[0, 0]), 0.0
    if kind == DIFFERENCE:
        return float(position[row] - position[max(row - int(first), 0)]) / period / first
    if kind == WINDOW:
        # the velocity is the slope over the longest window whose samples are all within the bound of its line
        for count in range(1, min(row, int(numbers[0, 1])) + 1):
            slope = (position[row] - position[row - count]) / count
            for i in range(1, count):
                if not abs(position[row - i] - (position[row] - slope * i)) <= first:
                    return result / period
            result = slope
        return result / period
    if kind == LEVANT:
        if row == 0:
            memory[0] = position[0]
        away = memory[0] - position[row]
        side = np.sign(away)
        speed = memory[1] - 1.5 * sqrt(first * abs(away)) * side
        memory[0] += period * speed
        memory[1] -= period * 1.1 * first * side
        return float(memory[1])
    difference = float(position[row] - position[max(row - 1, 0)]) / period
    result = first * difference + float(memory[0])
    for i in range(len(memory) - 1):
        memory[i] = memory[i + 1] + numbers[0, i + 1] * difference - numbers[1, i + 1] * result
    return result


@compiled(f"void(f8[:,::1],{_INTERVAL})")
def advance_states(z: Floats, interval: Interval) -> None:
    """Advance states over an interval. Each state is a row of z (see `advance`)."""
    for i in range(len(z)):
        advance(z[i], interval)


@compiled(
    "Tuple((f8[::1],f8[::1]))(UniTuple(f8,4),Tuple((f8[::1],f8[::1],f8[::1],b1[::1],i8[:,::1])),UniTuple(f8,4),"
    f"UniTuple(f8,3),Tuple((i8,f8[:,::1],f8)),Tuple((f8[::1],i8,UniTuple({_INTERVAL},2))))"
)
def run_trial(
    wall: tuple[float, float, float, float],
    signals: tuple[Floats, Floats, Floats, Booleans, Integers],
    place: tuple[float, float, float, float],
    ranges: tuple[float, float, float],
    estimator: tuple[int, Floats, float],
    motion: tuple[Floats, int, tuple[Interval, Interval]],
) -> tuple[Floats, Floats]:
    """Return command [N, Nm] and position [m, rad] of each row of a trial, up to the first row beyond its travel.

    Parameters
    ----------
    wall : K, B, depth, side
        Stiffness [N/m, Nm/rad], damping [Ns/m, Nms/rad], depth of the first position in the wall, and sign of the depth
        at which a one-sided wall pushes. The sign is 0 for a two-sided wall.
    signals : external, push, noise, repeats, slots
        For each row: external force in the command, force on the device in addition to the command [N, Nm], noise of
        the reading [m, rad], and whether the sensor repeats its reading. ``slots`` (parts, rows) is the row of the
        applied command, counted from 1, for each part of the interval after the row; 0 is the command before the first
        row.
    place : start, centre, travel, stop
        Position at the start, middle of the range, largest distance from the middle, and distance of rigid stops [m,
        rad].
    ranges : quantum, limit, gain
        Sensor resolution [m, rad], 0 if ideal, limit of the command [N, Nm], and force per unit of command.
    estimator : kind, numbers, period
        Arguments of `velocity`.
    motion : rest, sensed, intervals
        Steady state per unit of a constant command, index of the sensed state, and both parts of an interval. The
        second part is unused if ``slots`` has only one part.
    """
    K, B, depth, side = wall
    external, push, noise, held, slots = signals
    start, centre, travel, stop = place
    quantum, limit, gain = ranges
    kind, numbers, period = estimator
    rest, sensed, (early, late) = motion
    rows, n = len(external), len(rest)
    position, command, force = np.empty(rows), np.empty(rows), np.empty(rows + 1)
    memory, z = np.zeros(numbers.shape[1]), np.zeros(n + 3)
    force[0] = gain * min(max(-K * depth, -limit), limit)
    for i in range(n):
        z[i] = rest[i] * force[0]
    for k in range(rows):
        true = start + z[sensed]
        position[k] = true + noise[k]
        if quantum > 0:
            position[k] = np.rint(position[k] / quantum) * quantum
        if held[k]:
            position[k] = position[max(k - 1, 0)]
        deep = position[k] - position[0] + depth
        command[k] = K * deep + B * velocity(kind, numbers, period, memory, position, k)
        if side != 0 and deep * side <= 0:
            command[k] = 0.0
        command[k] = external[k] - command[k]
        force[k + 1] = gain * min(max(command[k], -limit), limit)
        if abs(true - centre) > travel:
            return command[: k + 1], position[: k + 1]
        z[n + 1] = push[k]
        z[n] = force[slots[0, k]]
        advance(z, early)
        if len(slots) > 1:
            z[n] = force[slots[1, k]]
            advance(z, late)
        reached = min(max(z[0], centre - stop - start), centre + stop - start)
        if reached != z[0]:
            z[0], z[1] = reached, 0.0
    return command, position
