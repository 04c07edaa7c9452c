"""Forces that no command explains: a push, a second load, a drift, found from the balance of forces alone.

The device of an experiment obeys m a = F(t - t_d) - b v - k x, with the logged command F. Mass, damping, stiffness
and delay that fit the experiment's trials best are taken for known; what is left over in a trial acts from outside.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.groups import TrialGroups

LONGEST_DELAY = 12
"""Largest delay that is tried [samples], as many as the window of `modes` has room for."""

WIDEST_JITTER = 3
"""Largest deviation of a command's delay from the common one that is allowed for [samples]."""

SHARP_DELAY = 6.0
"""Ratio of the median errors with the next delay and the best one, where the command changes fast, from which on all
commands are late by the same time: 15 and more for constant delays, 3 and less for delays that scatter over three
samples or hide behind a coarse sensor."""

FITTED_TRIALS = 64
"""Trials that the device is fitted to: more tell three numbers no better. Those with the smallest hash of their samples
are taken: a log more seldom changes them, and so what is said of all others."""

FITTED_ROWS = 4096
"""Rows of a longer log that the device is fitted to, from the step on: its rest would outweigh the other logs."""

LEAD = 32
"""Rows before the step that a longer log keeps there: what the longest delay and twice the lag reach back."""

FIT_ROUNDS = 6
"""Rounds of reweighting towards the least absolute error, so that trials with a disturbance do not count."""

FIT_SPAN = 6
"""Lag of the second difference in the fit [samples]: short against a response, long against sensor noise."""

SPRING_GAIN = 0.05
"""Least relative fall of the error for which the device is given a stiffness of its own: else it fits noise."""

SHORTEST_SPAN, LONGEST_SPAN = 8, 40
"""Bounds of the lag for the search [samples]: a push of 20 samples must not be averaged away."""

SENSOR_FACTOR = 2.3
"""Largest second difference that the sensor feigns, in floors: two quanta and six standard deviations."""

SMALLEST_FORCE = 0.05
"""Smallest disturbance that is reported, relative to the step: what the settling band of 5 % hardly shows."""

UPPER = 75.0
"""Percentile of the trials' floors that sets the lag: the noise of a coarse sensor is now and then read as zero. And
of the changes of a command, from which on it changes fast."""

MODEL_ERROR = 0.05
"""Part of the command, and twice of the device's own forces, that may be wrong: the mass is fitted to 3 %."""

TYPICAL_FACTOR = 3.0
"""A force must exceed that of the middle trial by this: what all trials show is the device (friction), no event."""

FITS = 0.3
"""Force that is left over in the middle row of the middle trial, in units of the smallest reported one, from which on
the device fits nothing: 0.1 and less for one mass with all its sensors and pushes, 0.6 for a heater."""

FEWEST_TRIALS = 8
"""Fewest trials of which the middle one says what is typical of the device."""

CHUNK = 128
"""Trials searched at once: bounds the memory to 1 MB an array at 1,000 rows."""


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Force beside the command in each trial, shape (n,).

    Parameters
    ----------
    first_row : int64
        First row about which the balance is broken; -1 where it is not, or cannot be told.
    largest_row : int64
        Row about which that force is largest; -1 where there is none.
    span : int
        Rows before and after a row from which its force was told.
    force : float64
        Largest such force, with its sign, averaged over some samples [N, Nm]; 0 where there is none.
    reason : tuple of str
        Why the balance cannot be told; empty where it can.
    """

    first_row: Integers
    largest_row: Integers
    span: int
    force: Floats
    reason: tuple[str, ...]

    def select(self, some: slice) -> Disturbance:
        """Return what was found in the trials of a slice."""
        arrays = (self.first_row[some], self.largest_row[some])
        return Disturbance(*arrays, self.span, self.force[some], self.reason[some])


@dataclass(frozen=True, eq=False)
class LargestForce:
    """Largest force beside the command of each trial, shape (n,).

    Parameters
    ----------
    ratio : float64
        In units of the smallest force that would be reported there [1]; NaN where the balance cannot be told.
    row : int64
        Row about which it acts; -1 where the balance cannot be told.
    force : float64
        With its sign [N, Nm]; 0 where the balance cannot be told.
    """

    ratio: Floats
    row: Integers
    force: Floats


@dataclass(frozen=True)
class Device:
    """Device that fits an experiment: m, b, k, delay and the deviation of single commands from it [samples].

    ``span`` are the rows before and after a row from which its force is told; ``least`` is the ratio of `LargestForce`
    from which on a force is an event, and not the device itself.
    """

    mass: float
    damping: float
    stiffness: float
    delay: int
    jitter: int
    span: int = 0
    least: float = 1.0


def find_disturbance(
    batch: TrialBatch, response: Response, device: Device | None = None, largest: LargestForce | None = None
) -> Disturbance:
    """Find the force that acts beside the command.

    Parameters
    ----------
    batch : TrialBatch
        Trials of one experiment: they share device and delay. Few and disturbed trials are judged worse.
    response : Response
        Of the same trials.
    device : Device, optional
        What was learnt from all trials of the experiment (`learn_device`, `with_least`); by default from these.
    largest : LargestForce, optional
        `largest_force` of the same trials and device, where it is known already.

    Returns
    -------
    Disturbance

    Notes
    -----
    x_{k+w} - 2 x_k + x_{k-w} is the acceleration between, weighted by a triangle: sensor noise falls with w^2. Where
    commands are late by differing times, any of them may have been in force, and only what lies beyond all of
    them counts; in fast motion this hides small forces. Forces below 5 % of the step, and those in the first and
    last w samples of a log, are not seen. Valid for a device that is one mass in the range of the loop.
    """
    n = len(batch)
    first = np.full(n, NO_ROW)
    if device is None:
        device = learn_device(
            *(TrialGroups((np.arange(n),), (batch,)), response.edge_row, response.floor, batch.rows, batch.step),
            batch.sampling_period_s,
        )
        largest = largest_force(batch, response, device)
        device = with_least(device, largest.ratio)
    if not device.mass > 0:
        unknown = "no device of one mass explains the motion in the experiment's trials"
        return Disturbance(first, first, 0, np.zeros(n), (unknown,) * n)
    largest = largest or largest_force(batch, response, device)
    broken = largest.ratio > device.least
    for index, ratio, _ in _ratios(batch, response, device, np.flatnonzero(broken)):
        first[index] = np.argmax(ratio > device.least, axis=1) + device.span
    return Disturbance(
        first,
        np.where(broken, largest.row, NO_ROW),
        device.span,
        np.where(broken, largest.force, 0.0),
        tuple(
            "too few samples after the step for a balance of forces" if untold else ""
            for untold in np.isnan(largest.ratio)
        ),
    )


def largest_force(batch: TrialBatch, response: Response, device: Device) -> LargestForce:
    """Return the largest force beside the command of each trial, whatever is typical of the device."""
    n = len(batch)
    found = LargestForce(np.full(n, np.nan), np.full(n, NO_ROW), np.zeros(n))
    if device.mass > 0:
        usable = np.flatnonzero(_usable(response.edge_row, batch.rows))
        found.ratio[usable] = 0.0
        for index, ratio, left in _ratios(batch, response, device, usable):
            at, trial = np.argmax(ratio, axis=1), np.arange(len(index))
            found.ratio[index], found.force[index] = ratio[trial, at], left[trial, at]
            found.row[index] = at + device.span
    return found


def with_least(device: Device, size: Floats) -> Device:
    """Return the device with its least force, from the ratios of `largest_force` of all trials."""
    told = size[np.isfinite(size)]
    typical = float(np.median(told)) if len(told) >= FEWEST_TRIALS else 0.0
    return replace(device, least=max(1.0, TYPICAL_FACTOR * typical))


def learn_device(
    groups: TrialGroups, edge_row: Integers, floor: Floats, rows: Integers, step: Floats, period_s: Floats
) -> Device:
    """Fit the device of an experiment to some of its trials; its mass is 0 where they show no motion.

    Parameters
    ----------
    groups : TrialGroups
        All samples of the experiment.
    edge_row, floor, rows, step, period_s : shape (n,)
        Of all trials, in its order: command edge (-1 for none), sensor floor [m, rad], number of samples, step
        [N, Nm], sampling period [s].
    """
    nothing = Device(0.0, 0.0, 0.0, 0, 0)
    usable = np.flatnonzero(_usable(edge_row, rows))
    if not len(usable):
        return nothing
    by_hash = np.argsort(groups.of_trials("digests")[usable], kind="stable")
    some = np.sort(usable[by_hash[:FITTED_TRIALS]])
    first = np.where(rows[some] > FITTED_ROWS, np.maximum(edge_row[some] - LEAD, 0), 0)
    trials = groups.cut(some, first, np.minimum(rows[some] - first, FITTED_ROWS))
    device = _fit(trials, edge_row[some] - first, floor[some])
    if device is None:
        return nothing
    sensor = SENSOR_FACTOR * np.percentile(floor[usable], UPPER) * device.mass
    smallest = SMALLEST_FORCE * float(np.median(np.abs(step[usable])))
    span = np.ceil(np.sqrt(sensor / smallest) / float(np.median(period_s)))
    device = replace(device, span=int(np.clip(span, SHORTEST_SPAN, LONGEST_SPAN)))
    return device if _fits(trials, edge_row[some] - first, floor[some], device) else nothing


def _fits(trials: TrialBatch, edge: Integers, floor: Floats, device: Device) -> bool:
    """Whether the device leaves no force over in most rows of most trials."""
    if trials.position.shape[1] <= 2 * device.span:
        return True
    left, limit = _left_over(trials, device, device.span, floor)
    column = np.arange(left.shape[1])[None, :] + device.span
    inside = (column > edge[:, None]) & (column < (trials.rows - device.span)[:, None])
    middle = [
        float(np.median(ratio[rows])) for ratio, rows in zip(np.abs(left) / limit, inside, strict=True) if rows.any()
    ]
    return not middle or float(np.median(middle)) < FITS


def _usable(edge_row: Integers, rows: Integers) -> Booleans:
    usable: Booleans = (edge_row >= 0) & (rows > edge_row + 2 * SHORTEST_SPAN)
    return usable


def _ratios(
    batch: TrialBatch, response: Response, device: Device, which: Integers
) -> Iterator[tuple[Integers, Floats, Floats]]:
    """Yield indices of trials, their forces in units of the smallest reported one, and the forces, from row span on.

    Nothing where all logs are shorter than two spans.
    """
    if batch.position.shape[1] <= 2 * device.span:
        return
    for start in range(0, len(which), CHUNK):
        index = which[start : start + CHUNK]
        trials = batch.select(index)
        left, limit = _left_over(trials, device, device.span, response.floor[index])
        column = np.arange(left.shape[1])[None, :] + device.span
        inside = (column > response.edge_row[index][:, None]) & (column < (trials.rows - device.span)[:, None])
        yield index, np.where(inside, np.abs(left) / limit, 0.0), left


def _fit(trials: TrialBatch, edge: Integers, floor: Floats) -> Device | None:
    """Fit mass, damping, stiffness and delay to trials of an experiment; None without motion."""
    acceleration = _second_difference(trials.displacement, FIT_SPAN) / (trials.sampling_period_s[:, None]) ** 2
    velocity, position = _triangle(_velocity(trials), FIT_SPAN), _triangle(np.nan_to_num(trials.displacement), FIT_SPAN)
    column = np.arange(acceleration.shape[1])[None, :] + FIT_SPAN
    inside = (column > edge[:, None]) & (column < (trials.rows - FIT_SPAN)[:, None])
    command = np.nan_to_num(trials.command)
    scale = np.max(np.where(inside, np.abs(_triangle(_held(command), FIT_SPAN)), 0.0), axis=1, initial=0.0)
    scale = np.where(scale > 0, scale, 1.0)[:, None]
    y, v, x = ((values / scale)[inside] for values in (acceleration, velocity, position))
    errors, late, solutions = [], [], []
    for delay in range(min(LONGEST_DELAY, command.shape[1] - 1) + 1):
        u = (_triangle(_held(_late(command, delay)), FIT_SPAN) / scale)[inside]
        plain, error = _least_absolute(np.stack([u, v]), y)
        sprung, sprung_error = _least_absolute(np.stack([u, v, x]), y)
        solutions.append(np.append(plain, 0.0) if sprung_error > (1 - SPRING_GAIN) * error else sprung)
        errors.append(min(error, sprung_error))
        late.append(u)
    best = int(np.argmin(errors))
    inertia, damping, stiffness = solutions[best]
    if not inertia > 0:
        return None
    # where the command changes fast an error of the delay shows most
    beside = [delay for delay in (best - 1, best + 1) if 0 <= delay < len(late)]
    change = np.abs(late[beside[0]] - late[beside[-1]])
    lively = change >= np.percentile(change, UPPER)
    at, *next_to = (np.median(np.abs(y - solutions[d] @ np.stack([late[d], v, x]))[lively]) for d in (best, *beside))
    sharp = min(next_to) > SHARP_DELAY * at
    # the smallest jitter that leaves nothing over in the middle trial
    for jitter in range(0 if sharp else 1, WIDEST_JITTER + 1):
        device = Device(1 / inertia, -damping / inertia, -stiffness / inertia, best, jitter)
        left, limit = _left_over(trials, device, FIT_SPAN, floor)
        sensor = _sensor_force(trials, device, FIT_SPAN, floor)
        beyond = np.where(inside, np.maximum(np.abs(left) - sensor, 0.0) / limit, 0.0)
        if np.median(beyond.max(axis=1, initial=0.0)) < 1 / TYPICAL_FACTOR:
            break
    return device


def _left_over(trials: TrialBatch, device: Device, span: int, floor: Floats) -> tuple[Floats, Floats]:
    """Force beyond all commands that may be in force, and the smallest one to be believed, from row span on."""
    period = trials.sampling_period_s[:, None]
    weight = float(span * span)
    felt = device.mass * _second_difference(trials.displacement, span) / (period * span) ** 2
    own = device.damping * _velocity(trials) + device.stiffness * np.nan_to_num(trials.displacement)
    own = _triangle(own, span) / weight
    command = np.nan_to_num(trials.command)
    choice = [_late(command, max(device.delay + shift, 0)) for shift in range(-device.jitter, device.jitter + 1)]
    lowest, highest = (
        _triangle(_held(edge), span) / weight for edge in (np.minimum.reduce(choice), np.maximum.reduce(choice))
    )
    outside = felt + own
    left = np.maximum(outside - highest, 0.0) + np.minimum(outside - lowest, 0.0)
    sensor = _sensor_force(trials, device, span, floor)
    model = MODEL_ERROR * (np.maximum(np.abs(lowest), np.abs(highest)) + 2 * np.abs(own))
    return left, np.maximum(SMALLEST_FORCE * np.abs(trials.step)[:, None], sensor) + model


def _sensor_force(trials: TrialBatch, device: Device, span: int, floor: Floats) -> Floats:
    """Largest force that the sensor feigns, shape (n, 1) [N, Nm]."""
    result: Floats = SENSOR_FACTOR * device.mass * floor[:, None] / (trials.sampling_period_s[:, None] * span) ** 2
    return result


def _least_absolute(design: Floats, values: Floats) -> tuple[Floats, float]:
    """Coefficients of a design, shape (q, m), for the least absolute error, by reweighting, and that error."""
    size = np.sqrt((design * design).sum(axis=1))
    size = np.where(size > 0, size, 1.0)
    scaled, weight = design / size[:, None], np.ones(len(values))
    solution: Floats = np.zeros(len(design))
    error = values
    for _ in range(FIT_ROUNDS):
        weighted = scaled * weight
        solution = np.asarray(np.linalg.lstsq(weighted @ scaled.T, weighted @ values, rcond=None)[0], np.float64)
        error = np.abs(values - solution @ scaled)
        typical = float(np.median(error))
        weight = 1 / np.maximum(error, max(typical, np.finfo(np.float64).tiny))
        weight = weight / weight.max(initial=np.finfo(np.float64).tiny)
    return solution / size, float(error.mean())


def _velocity(trials: TrialBatch) -> Floats:
    x = np.nan_to_num(trials.displacement)
    velocity = np.zeros_like(x)
    velocity[:, 1:-1] = (x[:, 2:] - x[:, :-2]) / (2 * trials.sampling_period_s[:, None])
    return velocity


def _late(command: Floats, delay: int) -> Floats:
    shifted = np.zeros_like(command)
    shifted[:, delay:] = command[:, : command.shape[1] - delay]
    return shifted


def _held(command: Floats) -> Floats:
    """Mean of the command over the two intervals at each row: its second difference is exact for held commands."""
    before = np.zeros_like(command)
    before[:, 1:] = command[:, :-1]
    mean: Floats = 0.5 * (command + before)
    return mean


def _second_difference(position: Floats, span: int) -> Floats:
    x = np.nan_to_num(position)
    result: Floats = x[:, 2 * span :] - 2 * x[:, span : x.shape[1] - span] + x[:, : x.shape[1] - 2 * span]
    return result


def _triangle(values: Floats, span: int) -> Floats:
    """Sum of (span - |i|) values_{k+i}, for each row k that has span rows before and behind it."""
    twice = np.zeros((len(values), values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=1), axis=1, out=twice[:, 1:])
    return _second_difference(twice, span)[:, :-1] if values.shape[1] > 2 * span else np.zeros((len(values), 0))
