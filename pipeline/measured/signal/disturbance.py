"""Detect forces that the command does not explain (a push, a second load, a drift) from the force balance.

The device of an experiment obeys m a = F(t - t_d) - b v - k x, with the logged command F. Mass, damping, stiffness and
delay are fitted to the trials of the experiment. The residual force of a trial is an external disturbance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.records.criteria import SETTLING_BANDS
from pipeline.records.trials import Floats, Integers, Trial, Trials

LONGEST_DELAY = 12
"""Largest delay in the search [samples]. For larger delays, the window of `modes` would be too short."""

FITTED_TRIALS = 64
"""Largest number of trials to which the device is fitted. More trials do not improve its three parameters. The trials
with the smallest hashes of their samples are used. An additional log therefore rarely changes the selection, or the
results of other logs."""

FITTED_ROWS = 4096
"""Largest number of rows of a log to which the device is fitted, counted from the step. A long rest would outweigh the
other logs."""

SHORTEST_SPAN, LONGEST_SPAN = 8, 40
"""Smallest and largest lag of second differences [samples]: long for low sensor noise, and short for a push of 20
samples."""

SENSOR_FLOORS = 2.3
"""Threshold for second differences in sensor floors. Differences up to two quanta and six standard deviations are
attributed to the sensor."""

SMALLEST_FORCE = max(SETTLING_BANDS.values())
"""Smallest reported disturbance relative to the step, and assumed relative error of the command and the forces of the
device. Such a force is hardly visible even in the widest settling band."""

TYPICAL = 3.0
"""Smallest ratio of the force of an event to the force in the median trial, if there are at least eight trials. A force
that occurs in all trials belongs to the device (friction, jitter)."""


@dataclass(frozen=True)
class Disturbance:
    """Force that acts on the device in a trial in addition to the command.

    Parameters
    ----------
    first_row, largest_row : int
        First row at which the force balance is violated, and row at which the force is largest. Both are -1 if the
        balance is not violated or is unknown.
    force : float
        Largest disturbance with its sign, averaged over some samples [N, Nm], or 0 if there is none.
    """

    first_row: int = NO_ROW
    largest_row: int = NO_ROW
    force: float = 0.0


@dataclass(frozen=True)
class PushResponse:
    """Device (m, b, k and delay [samples]) that is fitted to an experiment to detect disturbances.

    The mass is 0 if the trials show no motion. ``span`` is the number of rows on each side of a row that determine its
    force. ``least`` is the smallest force of an event, relative to the smallest reported force. Smaller forces are
    attributed to the device.
    """

    mass: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    delay: int = 0
    span: int = 0
    least: float = 1.0


def find_disturbance(trial: Trial, response: Response, device: PushResponse) -> Disturbance:
    """Find a force that acts in addition to the command.

    Parameters
    ----------
    trial : Trial
    response : Response
    device : PushResponse
        Fit to all trials of the experiment (`fit_push_response`), which have the same device and delay. It is less
        accurate for few or disturbed trials.

    Notes
    -----
    x_{k+w} - 2 x_k + x_{k-w} is the acceleration in this interval with triangular weights, so the effect of sensor
    noise falls with w^2. If the delay jitters, the previous or the next command may have been applied. Forces below 5 %
    of the step, and forces in the first and last w samples of a log, are not detected. The device must be a single mass
    within the bandwidth of the loop.
    """
    if not (device.mass > 0 and trial.rows > 2 * device.span):
        return Disturbance()
    ratio, left = _ratio(trial, response.edge_row, response.floor, device)
    largest = int(ratio.argmax())
    if not ratio[largest] > device.least:
        return Disturbance()
    first = int(np.argmax(ratio > device.least))
    return Disturbance(first + device.span, largest + device.span, float(left[largest]))


def fit_push_response(trials: Trials, edge_row: Integers, floor: Floats) -> PushResponse:
    """Fit the device to the trials of an experiment by least absolute errors, which is robust to disturbed trials.

    Parameters
    ----------
    trials : Trials
        All trials of the experiment.
    edge_row, floor : shape (n,)
        Command edge (-1 if there is none) and sensor floor [m, rad] of each trial.
    """
    rows = trials.rows
    usable = np.flatnonzero((edge_row >= 0) & (rows > edge_row + 2 * SHORTEST_SPAN))
    if not len(usable):
        return PushResponse()
    by_hash = np.argsort(np.array(trials.digests)[usable], kind="stable")
    fitted = np.sort(usable[by_hash[:FITTED_TRIALS]])
    first = np.where(rows > FITTED_ROWS, np.maximum(edge_row - 4 * SHORTEST_SPAN, 0), 0)
    windows = [
        (trials[place].window(int(first[place]), min(int(rows[place] - first[place]), FITTED_ROWS)), edge)
        for place, edge in zip(fitted.tolist(), (edge_row - first)[fitted].tolist(), strict=True)
    ]
    device = _fit(windows)
    if not device.mass > 0:
        return PushResponse()
    sensor = SENSOR_FLOORS * np.percentile(floor[usable], 75) * device.mass
    smallest = SMALLEST_FORCE * float(np.median(np.abs(trials.step[usable])))
    span = np.ceil(np.sqrt(sensor / smallest) / float(np.median(trials.sampling_period_s)))
    device = replace(device, span=int(np.clip(span, SHORTEST_SPAN, LONGEST_SPAN)))
    if len(fitted) >= 8 and max(trial.rows for trial, _ in windows) > 2 * device.span:
        floors = floor[fitted].tolist()
        ratios = (_ratio(trial, edge, own, device)[0] for (trial, edge), own in zip(windows, floors, strict=True))
        largest = [ratio.max(initial=0.0) for ratio in ratios]
        device = replace(device, least=max(1.0, TYPICAL * float(np.median(largest))))
    return device


def _fit(trials: Sequence[tuple[Trial, int]]) -> PushResponse:
    """Fit mass, damping, stiffness and delay to trials with their edge rows."""
    span = SHORTEST_SPAN
    behind = [slice(max(edge + 1 - span, 0), None) for _, edge in trials]
    forces = [_triangle(_held(trial.command), span)[rows] for (trial, _), rows in zip(trials, behind, strict=True)]
    scales = [float(np.abs(force).max(initial=0.0)) or 1.0 for force in forces]

    def scaled(values: Callable[[Trial], Floats]) -> Floats:
        parts = zip(trials, behind, scales, strict=True)
        return np.concatenate([values(trial)[rows] / scale for (trial, _), rows, scale in parts])

    y = scaled(lambda trial: _second_difference(trial.displacement, span) / trial.sampling_period_s**2)
    v = scaled(lambda trial: _triangle(_velocity(trial), span))
    x = scaled(lambda trial: _triangle(trial.displacement, span))
    best, least = PushResponse(), np.inf
    for delay in range(min(LONGEST_DELAY, max(trial.rows for trial, _ in trials) - 1) + 1):
        u = scaled(partial(_late_force, delay=delay))
        (inertia, damping, stiffness), error = _least_absolute(np.stack([u, v, x]), y)
        if error < least and inertia > 0:
            best, least = PushResponse(1 / inertia, -damping / inertia, -stiffness / inertia, delay), error
    return best


def _late_force(trial: Trial, delay: int) -> Floats:
    return _triangle(_held(_late(trial.command, delay)), SHORTEST_SPAN)


def _ratio(trial: Trial, edge: int, floor: float, device: PushResponse) -> tuple[Floats, Floats]:
    """Return forces that no applicable command explains, relative to the smallest reported force, and in [N, Nm].

    Both arrays have the shape (rows - 2 span,) and start at row ``span``. The ratios are 0 up to the step.
    """
    span, period = device.span, trial.sampling_period_s
    weight, displacement = float(span * span), trial.displacement
    acceleration = device.mass * _second_difference(displacement, span) / (period * span) ** 2
    own = _triangle(device.damping * _velocity(trial) + device.stiffness * displacement, span) / weight
    choice = [_late(trial.command, max(device.delay + shift, 0)) for shift in (-1, 0, 1)]
    lowest, highest = (_triangle(_held(extreme.reduce(choice)), span) / weight for extreme in (np.minimum, np.maximum))
    outside = acceleration + own
    left = np.maximum(outside - highest, 0.0) + np.minimum(outside - lowest, 0.0)
    sensor = SENSOR_FLOORS * device.mass * floor / (period * span) ** 2
    model = SMALLEST_FORCE * (np.maximum(np.abs(lowest), np.abs(highest)) + 2 * np.abs(own))
    limit = max(SMALLEST_FORCE * abs(trial.step), sensor) + model
    ratio = np.divide(np.abs(left), limit, out=np.zeros_like(left), where=limit > 0)
    ratio[: max(edge + 1 - span, 0) if edge >= 0 else None] = 0.0
    return ratio, left


def _least_absolute(design: Floats, values: Floats) -> tuple[Floats, float]:
    """Return the least-absolute-error coefficients of a design (q, m), by iterative reweighting, and the error."""
    size = np.sqrt((design * design).sum(axis=1))
    size = np.where(size > 0, size, 1.0)
    scaled, weight = design / size[:, None], np.ones(len(values))
    solution: Floats = np.zeros(len(design))
    error = values
    for _ in range(6):  # the result is then sufficiently accurate
        weighted = scaled * weight
        solution = np.asarray(np.linalg.lstsq(weighted @ scaled.T, weighted @ values, rcond=None)[0], np.float64)
        error = np.abs(values - solution @ scaled)
        weight = 1 / np.maximum(error, max(float(np.median(error)), np.finfo(np.float64).tiny))
        weight = weight / weight.max(initial=np.finfo(np.float64).tiny)
    return solution / size, float(error.mean())


def _velocity(trial: Trial) -> Floats:
    x, velocity = trial.displacement, np.zeros(trial.rows)
    velocity[1:-1] = (x[2:] - x[:-2]) / (2 * trial.sampling_period_s)
    return velocity


def _late(command: Floats, delay: int) -> Floats:
    shifted = np.zeros_like(command)
    shifted[delay:] = command[: max(len(command) - delay, 0)]
    return shifted


def _held(command: Floats) -> Floats:
    """Return the mean command of the two intervals that meet at each row. Its second difference is exact for a
    zero-order hold."""
    mean = command.copy()
    mean[1:] += command[:-1]
    return 0.5 * mean


def _second_difference(values: Floats, span: int) -> Floats:
    """Return values_{k+span} - 2 values_k + values_{k-span} for each row k with span rows before and after it."""
    rows = max(len(values) - 2 * span, 0)
    return values[2 * span :][:rows] - 2 * values[span : span + rows] + values[:rows]


def _triangle(values: Floats, span: int) -> Floats:
    """Return the sum of (span - |i|) values_{k+i} for each row k with span rows before and after it."""
    twice = np.zeros(len(values) + 1)
    np.cumsum(np.cumsum(values), out=twice[1:])
    return _second_difference(twice, span)[: max(len(values) - 2 * span, 0)]
