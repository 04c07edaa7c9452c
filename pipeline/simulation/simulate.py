"""Hybrid simulator of the virtual wall: sampled controller, delayed command, exact motion between samples.

Per sample k: the true position is disturbed by noise and rounded to the sensor's quantum; the wall force
``K (x_k - x_0) + B v_k`` is subtracted from the external step; the command, clipped to the force limit, reaches the
plant some samples later. Between two changes of its input the plant moves exactly. All trials of a batch advance
together; each has its own random streams, so batching changes no bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from math import floor, inf

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.device.parts import AdaptiveWindow, Difference, Levant, VelocityFilter
from pipeline.loop.many_digits import as_floats, many_digits
from pipeline.loop.motion import FrictionalMotion
from pipeline.loop.velocity_filter import filter_in_z, per_sample
from pipeline.records.batch import Floats, Integers, TrialBatch
from pipeline.simulation.setup import Chance, Setup, Streams, draw

DIGITS = 40
"""In which a filter is written in powers of 1/z: a low cut-off cancels many of them."""

MOST_DELAYS, MOST_ALIKE = 9, 8
"""Most delays of a sample apart that commands draw from, so that the age in force scatters by 1.6 samples; and how many
times as likely as the others one of them may be."""

START_MARGIN = 1.1
"""Smallest travel limit relative to the distance of the start: noise must not end a trial where it starts."""


def simulate(
    setup: Setup,
    stiffness: Floats,
    damping: Floats,
    *,
    seed: int = 0,
    stream: str = "",
    repetition: int = 0,
    disturbance: Floats | None = None,
) -> TrialBatch:
    """Simulate step responses, one per pair (K, B), from rest at ``centre - F_0/K`` (``centre`` for K <= 0).

    Parameters
    ----------
    setup : Setup
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad]; both may be negative.
    seed, stream, repetition : int, str, int
        Name the random streams together with K and B: the same five give the same trial, whatever it is
        simulated together with, and a longer trial starts with the samples of the shorter one.
    disturbance : float64, shape (rows, n), optional
        Force on the device beside the command [N, Nm], such as the push of a hand, constant from one row to the
        next. The controller knows nothing of it, and it acts without delay.

    Returns
    -------
    TrialBatch
        A trial that leaves its travel ends with the first sample outside. ``trial_id`` is the running number.

    Raises
    ------
    ParameterError
        If K or B is not finite, or the seed is negative, or the disturbance has another shape.

    Notes
    -----
    A start at or beyond the travel limit (F_0/K >= travel) widens the limit to a little more than that
    distance: the response moves inwards first, and would otherwise end before it began.

    Source: Hulin 2017, sec. 3.1 and 6.1.1, eq. 6.1.
    """
    K, B = np.asarray(stiffness, dtype=np.float64), np.asarray(damping, dtype=np.float64)
    _check(setup, K, B, seed, disturbance)
    trials, loop, motion = len(K), setup.loop, FrictionalMotion.of(setup.loop)
    start = setup.centre - setup.step * np.divide(1.0, K, out=np.zeros(trials), where=K > 0)  # eq. 6.1
    chance = draw(setup, Streams(seed, stream, K, B, repetition))
    route = _route(setup, chance.delays)
    farthest = START_MARGIN * np.abs(start - setup.centre)
    travel, stop = np.maximum(setup.travel, farthest), np.maximum(setup.stop, farthest)
    external, gain, push = external_force(setup), setup.true_gain, setup.constant_force
    sunk = _sunk(setup, K)

    position = np.full((setup.rows, trials), np.nan)
    command = np.full((setup.rows + 1, trials), np.nan)  # row 0: what the plant feels before the first arrival
    command[0] = -K * sunk
    limit = inf if loop.force_limit is None else loop.force_limit
    rendered = command if limit == inf and gain == 1 else gain * np.clip(command, -limit, limit)
    rows = np.full(trials, setup.rows, dtype=np.int64)
    inside = np.ones(trials, dtype=np.bool_)
    state = motion.rest(rendered[0])
    velocity = velocity_of(loop.velocity, loop.sampling_period_s, trials)
    everyone = np.arange(trials)
    for k in range(setup.rows):
        true = start + state[motion.sensed]
        position[k] = _measure(true if chance.noise is None else true + chance.noise[k], loop.sensor.quantum)
        if chance.held is not None:
            position[k] = np.where(chance.held[k], position[max(k - 1, 0)], position[k])
        depth = position[k] - position[0] + sunk
        wall = K * depth + B * velocity(position, k)
        if setup.hidden.one_sided_wall:
            wall = np.where(depth * setup.step > 0, wall, 0.0)
        command[k + 1] = external[k] - wall
        if rendered is not command:
            np.clip(command[k + 1], -limit, limit, out=rendered[k + 1])
            rendered[k + 1] *= gain
        left = inside & (np.abs(true - setup.centre) > travel)
        if left.any():
            rows[left] = k + 1
            inside &= ~left
            state[:, left] = 0.0  # parked at rest, so that an unstable trial cannot overflow after its end
            if not inside.any():
                break
        beside = push if disturbance is None else push + disturbance[k]
        if push or disturbance is not None:
            beside = np.where(inside, beside, 0.0)
        for time_s, slot in route(k):
            force = rendered[slot] if isinstance(slot, int) else rendered[slot, everyone]
            state = motion.advance(state, np.where(inside, force, 0.0), beside, time_s)
        if setup.stop < inf:
            reached = np.clip(state[0], setup.centre - stop - start, setup.centre + stop - start)
            state[1, state[0] != reached] = 0.0
            state[0] = reached
    if setup.hidden.clipped_command_logged:
        command = np.clip(command, -limit, limit)
    return _logged(setup, (K, B), rows, command[1:], position, chance)


def _check(setup: Setup, K: Floats, B: Floats, seed: int, disturbance: Floats | None) -> None:
    if not (np.isfinite(K).all() and np.isfinite(B).all()):
        raise ParameterError("simulated stiffness and damping must be finite.")
    if seed < 0:
        raise ParameterError(f"seed {seed}: expected 0 or a positive whole number.")
    if disturbance is not None and disturbance.shape != (expected := (setup.rows, len(K))):
        raise ParameterError(f"disturbance of shape {disturbance.shape}: expected (rows, n) = {expected}.")


def external_force(setup: Setup) -> Floats:
    """Return the external force of each row [N, Nm], shape (rows,): the step, its ramp, and later steps."""
    row = np.arange(setup.rows)
    rise = np.clip((row - setup.edge_row + 1) / setup.hidden.ramp_samples, 0.0, 1.0)
    result: Floats = setup.step * rise
    for later in setup.hidden.later_steps:
        result = result + later.size * (row >= round(later.time_s / setup.loop.sampling_period_s))
    return result


def _sunk(setup: Setup, K: Floats) -> Floats:
    """Return how deep in the wall the constant force holds the device before the step [m, rad].

    A wall without stiffness cannot hold it, nor can a one-sided wall that the force pulls away from.
    """
    constant = setup.constant_force
    holds = (K > 0) & (not setup.hidden.one_sided_wall or constant * setup.step > 0)
    return np.divide(constant / setup.true_gain, K, out=np.zeros(len(K)), where=holds)


def in_force(delays: Integers) -> Integers:
    """Return which command the plant feels in each interval when every command has its own delay.

    Commands never overtake: the newest that has arrived holds, an older one that arrives later is ignored.

    Parameters
    ----------
    delays : int64, shape (rows, n)
        Delay of the command of each row [samples].

    Returns
    -------
    int64, shape (rows, n)
        Row of the command in force in the interval that starts with each row; -1 before any arrival.
    """
    rows, trials = delays.shape
    newest = np.full((rows, trials), -1, dtype=np.int64)
    sent, trial = np.indices((rows, trials))
    arrival = sent + delays
    on_time = arrival < rows
    np.maximum.at(newest, (arrival[on_time], trial[on_time]), sent[on_time])
    return np.maximum.accumulate(newest, axis=0)


def age_in_force(delays: Sequence[int]) -> tuple[float, float]:
    """Return mean and standard deviation [samples] of the age of the command in force.

    Each command draws its delay from some whole ones that are as likely. As later commands overtake, the mean is below
    that of ``delays``: a command in force is older than j samples if none of the last j + 1 has arrived.
    """
    drawn = np.array(delays)
    older = np.cumprod([(drawn > age).mean() for age in range(int(drawn.max()) + 1)])
    likely = -np.diff(older, prepend=1.0)
    age = np.arange(len(likely))
    mean = float(likely @ age)
    return mean, float(np.sqrt(likely @ (age - mean) ** 2))


def delays_of(age: float, jitter: float) -> tuple[int, ...]:
    """Return whole delays, as likely, whose age in force comes nearest to a mean and a standard deviation [samples].

    None where one delay for all comes nearer. An error of the mean counts four times that of the deviation: limits
    follow the mean.
    """
    drawn, mean, deviation = _drawn()
    first = np.maximum(np.rint(age - mean), 0)
    off = 4 * np.abs(first + mean - age) + np.abs(deviation - jitter)
    best = int(np.argmin(off))
    return tuple(int(first[best]) + each for each in drawn[best]) if off[best] < jitter else ()


@cache
def _drawn() -> tuple[list[tuple[int, ...]], Floats, Floats]:
    """Return delays from 0 on, one of them up to `MOST_ALIKE` times as likely, with mean and deviation of their age."""
    every = [tuple(range(count)) for count in range(2, MOST_DELAYS + 1)]
    every = [(*alike, *(one,) * more) for alike in every for one in alike for more in range(MOST_ALIKE)]
    mean, deviation = np.array([age_in_force(drawn) for drawn in every]).T
    return every, mean, deviation


def _route(setup: Setup, delays: Integers | None) -> Callable[[int], Sequence[tuple[float, int | Integers]]]:
    """Return, for a row, the parts of its interval: duration [s] and slot (row + 1) of its command."""
    T = setup.true_period_s
    if delays is not None:
        slots = in_force(delays) + 1
        return lambda row: [(T, slots[row])]
    whole = floor(setup.loop.delay_samples)
    part = setup.loop.delay_samples - whole
    if part == 0:
        return lambda row: [(T, max(row - whole + 1, 0))]
    return lambda row: [(part * T, max(row - whole, 0)), ((1 - part) * T, max(row - whole + 1, 0))]


def _measure(position: Floats, quantum: float) -> Floats:
    return np.rint(position / quantum) * quantum if quantum > 0 else position


def coefficients(kind: VelocityFilter | None, sampling_period_s: float) -> tuple[Floats, Floats]:
    """Return b and a of the filter b(z)/a(z) that acts on (x_k - x_{k-1})/T, in powers of 1/z, a[0] = 1."""
    with many_digits(DIGITS):
        b, a = filter_in_z(per_sample(kind, sampling_period_s))
        return as_floats(b), as_floats(a)


def velocity_of(kind: VelocityFilter | None, period: float, trials: int) -> Callable[[Floats, int], Floats]:
    """Return what gives the velocity of many trials from the positions so far, shape (rows, n); rows in order.

    Parameters
    ----------
    kind : VelocityFilter or None
        None for the backward difference.
    period : float
        T as the controller takes it [s].
    trials : int
    """
    if isinstance(kind, AdaptiveWindow):
        return lambda position, row: (
            _adaptive_window(position[max(row - kind.longest, 0) : row + 1], kind.bound) / period
        )
    if isinstance(kind, Levant):
        return _levant(kind.acceleration, period)
    if isinstance(kind, Difference):
        count = kind.samples
        return lambda position, row: (position[row] - position[max(row - count, 0)]) / period / count
    b, a = coefficients(kind, period)
    order = max(len(a), len(b)) - 1
    b, a = np.pad(b, (0, order + 1 - len(b))), np.pad(a, (0, order + 1 - len(a)))
    memory = np.zeros((order + 1, trials))

    def filtered(position: Floats, row: int) -> Floats:
        difference: Floats = (position[row] - position[max(row - 1, 0)]) / period
        result: Floats = b[0] * difference + memory[0]
        # transposed direct form: the last row of the memory stays zero
        for i in range(order):
            memory[i] = memory[i + 1] + b[i + 1] * difference - a[i + 1] * result
        return result

    return filtered


def _adaptive_window(position: Floats, bound: float) -> Floats:
    """Return the slope [1/sample] over the longest window with all samples within a bound of its line, shape (n,)."""
    newest, found = position[-1], np.zeros(position.shape[1])
    going = np.ones(len(found), dtype=np.bool_)
    for count in range(1, len(position)):
        slope = (newest - position[-1 - count]) / count
        line = newest - slope * np.arange(1, count)[:, None]
        going = going & (np.abs(position[-2 : -1 - count : -1] - line) <= bound).all(axis=0)
        found = np.where(going, slope, found)
        if not going.any():
            break
    return found


def _levant(acceleration: float, period: float) -> Callable[[Floats, int], Floats]:
    """Return Levant's differentiator, at rest at the first position."""
    state: list[Floats] = []

    def differentiated(position: Floats, row: int) -> Floats:
        if not state:
            state[:] = position[row].copy(), np.zeros(position.shape[1])
        place, velocity = state
        off = place - position[row]
        speed = velocity - 1.5 * np.sqrt(acceleration * np.abs(off)) * np.sign(off)
        state[:] = place + period * speed, velocity - period * 1.1 * acceleration * np.sign(off)
        return state[1]

    return differentiated


def _logged(
    setup: Setup, walls: tuple[Floats, Floats], rows: Integers, command: Floats, position: Floats, chance: Chance
) -> TrialBatch:
    """Return the log that a lab keeps of trials at walls (K, B), from command and position of shape (rows, n)."""
    trials, T = len(rows), setup.loop.sampling_period_s
    longest = int(rows.max(initial=0))
    if chance.repeated is not None:
        before = np.vstack((position[:1], position[:-1]))
        position = np.where(chance.repeated, before, position)
    padding = np.arange(longest)[None, :] >= rows[:, None]
    time = np.where(padding, np.nan, T * np.arange(longest))
    both = [np.where(padding, np.nan, values[:longest].T) for values in (command, position)]
    if chance.lost is not None:
        kept = ~(chance.lost[:longest].T | padding)
        rows = kept.sum(axis=1)
        longest = int(rows.max(initial=0))
        order = np.argsort(~kept, axis=1, kind="stable")[:, :longest]
        gone = np.arange(longest)[None, :] >= rows[:, None]
        stamps = np.broadcast_to(T * np.arange(longest), gone.shape)
        stamps = stamps if setup.hidden.lost_rows_hidden else np.take_along_axis(time, order, axis=1)
        time, *both = (
            np.where(gone, np.nan, values)
            for values in (stamps, *(np.take_along_axis(values, order, axis=1) for values in both))
        )
    return TrialBatch(
        trial_id=tuple(str(i) for i in range(trials)),
        stiffness=walls[0],
        damping=walls[1],
        step=np.full(trials, setup.step),
        sampling_period_s=np.full(trials, T),
        rows=rows,
        time=time,
        command=both[0],
        position=both[1],
    )
