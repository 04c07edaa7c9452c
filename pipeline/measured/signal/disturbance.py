"""Forces that no command explains: a push, a second load, a drift, found from the balance of forces alone.

The device of an experiment obeys m a = F(t - t_d) - b v - k x, with the logged command F. Mass, damping, stiffness
and delay that fit the experiment's trials best are taken for known; what is left over in a trial acts from outside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch, TrialGroups
from pipeline.records.criteria import SETTLING_BANDS

LONGEST_DELAY = 12
"""Largest delay that is tried [samples], as many as the window of `modes` has room for."""

FITTED_TRIALS = 64
"""Trials that the device is fitted to: more tell three numbers no better. Those with the smallest hash of their samples
are taken: a log more seldom changes them, and so what is said of all others."""

FITTED_ROWS = 4096
"""Rows of a longer log that the device is fitted to, from the step on: its rest would outweigh the other logs."""

SHORTEST_SPAN, LONGEST_SPAN = 8, 40
"""Bounds of the lag of second differences [samples]: long against sensor noise, short against a push of 20 samples."""

SENSOR_FLOORS = 2.3
"""Largest second difference that the sensor feigns, in floors: two quanta and six standard deviations."""

SMALLEST_FORCE = max(SETTLING_BANDS.values())
"""Smallest disturbance that is reported, relative to the step, and part of command and own forces that may be wrong:
what the widest settling band hardly shows, and what the device is fitted to."""

TYPICAL = 3.0
"""A force must exceed that of the middle trial by this: what all trials show is the device (friction, jitter), no
event. It is told of eight trials and more."""


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Force beside the command in each trial, shape (n,).

    Parameters
    ----------
    first_row, largest_row : int64
        First row about which the balance is broken, and row about which that force is largest; -1 where it is not
        broken, or cannot be told.
    force : float64
        Largest such force, with its sign, averaged over some samples [N, Nm]; 0 where there is none.
    """

    first_row: Integers
    largest_row: Integers
    force: Floats


@dataclass(frozen=True)
class PushResponse:
    """Device that fits an experiment, for forces that it does not explain: m, b, k and delay [samples].

    Its mass is 0 where trials show no motion. ``span`` are the rows before and after a row that tell its force;
    ``least`` is the force, in units of the smallest reported one, from which on it is an event, and not the device.
    """

    mass: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    delay: int = 0
    span: int = 0
    least: float = 1.0


def find_disturbance(batch: TrialBatch, response: Response, device: PushResponse) -> Disturbance:
    """Find the force that acts beside the command.

    Parameters
    ----------
    batch : TrialBatch
        Trials of one experiment: they share device and delay. Few and disturbed trials are judged worse.
    response : Response
        Of the same trials.
    device : PushResponse
        What was learnt from all trials of the experiment (`fit_push_response`).

    Notes
    -----
    x_{k+w} - 2 x_k + x_{k-w} is the acceleration between, weighted by a triangle: sensor noise falls with w^2. Where
    commands are late by differing times, the one before or after may have been in force. Forces below 5 % of the step,
    and those in the first and last w samples of a log, are not seen. Valid for a device that is one mass in the range
    of the loop.
    """
    n = len(batch)
    first, largest, force = np.full(n, NO_ROW), np.full(n, NO_ROW), np.zeros(n)
    for some, part in batch.portions():
        if device.mass > 0 and part.position.shape[1] > 2 * device.span:
            ratio, left = _ratio(part, response.edge_row[some], response.floor[some], device)
            at, trial = np.argmax(ratio, axis=1), np.arange(len(part))
            broken = ratio[trial, at] > device.least
            first[some] = np.where(broken, np.argmax(ratio > device.least, axis=1) + device.span, NO_ROW)
            largest[some] = np.where(broken, at + device.span, NO_ROW)
            force[some] = np.where(broken, left[trial, at], 0.0)
    return Disturbance(first, largest, force)


def fit_push_response(
    groups: TrialGroups, edge_row: Integers, floor: Floats, rows: Integers, step: Floats, period_s: Floats
) -> PushResponse:
    """Fit the device of an experiment to some of its trials, by the least absolute error: disturbed ones hardly count.

    Parameters
    ----------
    groups : TrialGroups
        All samples of the experiment.
    edge_row, floor, rows, step, period_s : shape (n,)
        Of all trials, in its order: command edge (-1 for none), sensor floor [m, rad], number of samples, step
        [N, Nm], sampling period [s].
    """
    usable = np.flatnonzero((edge_row >= 0) & (rows > edge_row + 2 * SHORTEST_SPAN))
    if not len(usable):
        return PushResponse()
    by_hash = np.argsort(groups.of_trials("digests")[usable], kind="stable")
    some = np.sort(usable[by_hash[:FITTED_TRIALS]])
    first = np.where(rows[some] > FITTED_ROWS, np.maximum(edge_row[some] - 4 * SHORTEST_SPAN, 0), 0)
    trials, edge = groups.cut(some, first, np.minimum(rows[some] - first, FITTED_ROWS)), edge_row[some] - first
    device = _fit(trials, edge)
    if not device.mass > 0:
        return PushResponse()
    sensor = SENSOR_FLOORS * np.percentile(floor[usable], 75) * device.mass
    smallest = SMALLEST_FORCE * float(np.median(np.abs(step[usable])))
    span = np.ceil(np.sqrt(sensor / smallest) / float(np.median(period_s)))
    device = replace(device, span=int(np.clip(span, SHORTEST_SPAN, LONGEST_SPAN)))
    if len(some) >= 8 and trials.position.shape[1] > 2 * device.span:
        largest = _ratio(trials, edge, floor[some], device)[0].max(axis=1, initial=0.0)
        device = replace(device, least=max(1.0, TYPICAL * float(np.median(largest))))
    return device


def _fit(trials: TrialBatch, edge: Integers) -> PushResponse:
    """Fit mass, damping, stiffness and delay to trials of an experiment."""
    span, command = SHORTEST_SPAN, np.nan_to_num(trials.command)
    acceleration = _second_difference(trials.displacement, span) / trials.sampling_period_s[:, None] ** 2
    inside = _inside(trials, edge, span)
    scale = np.max(np.where(inside, np.abs(_triangle(_held(command), span)), 0.0), axis=1, initial=0.0)
    scale = np.where(scale > 0, scale, 1.0)[:, None]
    own = (_triangle(values, span) for values in (_velocity(trials), np.nan_to_num(trials.displacement)))
    y, v, x = ((values / scale)[inside] for values in (acceleration, *own))
    best, least = PushResponse(), np.inf
    for delay in range(min(LONGEST_DELAY, command.shape[1] - 1) + 1):
        u = (_triangle(_held(_late(command, delay)), span) / scale)[inside]
        (inertia, damping, stiffness), error = _least_absolute(np.stack([u, v, x]), y)
        if error < least and inertia > 0:
            best, least = PushResponse(1 / inertia, -damping / inertia, -stiffness / inertia, delay), error
    return best


def _inside(trials: TrialBatch, edge: Integers, span: int) -> Booleans:
    """Return the rows from ``span`` on, about which a force is told: behind the step, with as many rows behind them."""
    column = np.arange(max(trials.position.shape[1] - 2 * span, 0))[None, :] + span
    inside: Booleans = (edge >= 0)[:, None] & (column > edge[:, None]) & (column < (trials.rows - span)[:, None])
    return inside


def _ratio(trials: TrialBatch, edge: Integers, floor: Floats, device: PushResponse) -> tuple[Floats, Floats]:
    """Return forces beyond all commands that may be in force, in units of the smallest to be believed, and as such.

    From row span on [1], [N, Nm].
    """
    span, period = device.span, trials.sampling_period_s[:, None]
    weight = float(span * span)
    acceleration = device.mass * _second_difference(trials.displacement, span) / (period * span) ** 2
    own = device.damping * _velocity(trials) + device.stiffness * np.nan_to_num(trials.displacement)
    own = _triangle(own, span) / weight
    command = np.nan_to_num(trials.command)
    choice = [_late(command, max(device.delay + shift, 0)) for shift in (-1, 0, 1)]
    lowest, highest = (
        _triangle(_held(edge_of), span) / weight for edge_of in (np.minimum.reduce(choice), np.maximum.reduce(choice))
    )
    outside = acceleration + own
    left = np.maximum(outside - highest, 0.0) + np.minimum(outside - lowest, 0.0)
    sensor = SENSOR_FLOORS * device.mass * floor[:, None] / (period * span) ** 2
    model = SMALLEST_FORCE * (np.maximum(np.abs(lowest), np.abs(highest)) + 2 * np.abs(own))
    limit = np.maximum(SMALLEST_FORCE * np.abs(trials.step)[:, None], sensor) + model
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(_inside(trials, edge, span), np.nan_to_num(np.abs(left) / limit), 0.0), left


def _least_absolute(design: Floats, values: Floats) -> tuple[Floats, float]:
    """Coefficients of a design, shape (q, m), for the least absolute error, by reweighting, and that error."""
    size = np.sqrt((design * design).sum(axis=1))
    size = np.where(size > 0, size, 1.0)
    scaled, weight = design / size[:, None], np.ones(len(values))
    solution: Floats = np.zeros(len(design))
    error = values
    for _ in range(6):  # the sixth changes nothing that matters
        weighted = scaled * weight
        solution = np.asarray(np.linalg.lstsq(weighted @ scaled.T, weighted @ values, rcond=None)[0], np.float64)
        error = np.abs(values - solution @ scaled)
        weight = 1 / np.maximum(error, max(float(np.median(error)), np.finfo(np.float64).tiny))
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
