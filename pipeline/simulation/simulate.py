"""Simulate the virtual wall as a hybrid system with a sampled controller, a delayed command and exact motion between
samples.

In each sample k, noise is added to the true position, and the sum is rounded to the quantum of the sensor. The wall
force ``K (x_k - x_0) + B v_k`` is subtracted from the external step. The command is clipped to the force limit and
reaches the plant some samples later. The motion of the plant is exact between two changes of its input. Each trial has
separate random streams, and is simulated by `pipeline.loop.closed_loop`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import floor, inf

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.device.parts import AdaptiveWindow, Difference, Levant, VelocityFilter
from pipeline.loop.closed_loop import DIFFERENCE, FILTER, LEVANT, WINDOW, Interval, run_trial
from pipeline.loop.many_digits import as_floats, many_digits
from pipeline.loop.motion import FrictionalMotion
from pipeline.loop.velocity_filter import filter_in_z, per_sample
from pipeline.records.trials import Floats, Integers, Trial, Trials
from pipeline.simulation.setup import RandomStream, Setup, TrialDraws, draw

DIGITS = 40
"""Number of decimal digits for filter coefficients in powers of 1/z. A low cut-off causes large cancellation."""

MOST_DELAYS, MOST_ALIKE = 9, 8
"""Largest number of consecutive delays from which the delay of a command is drawn, and largest multiplicity of a delay.
The standard deviation of the applied delay is then 1.6 samples."""

START_MARGIN = 1.1
"""Smallest travel limit, relative to the distance of the starting position from the centre, so that noise does not end
a trial immediately."""


def simulate(
    setup: Setup,
    stiffness: Floats,
    damping: Floats,
    *,
    seed: int = 0,
    stream: str = "",
    repetition: int = 0,
    disturbance: Floats | None = None,
) -> Trials:
    """Simulate a step response for each pair (K, B), from rest at ``centre - F_0/K``, or at ``centre`` for K <= 0.

    Parameters
    ----------
    setup : Setup
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad]; both may be negative.
    seed, stream, repetition : int, str, int
        Seed, name and repetition that together with K and B determine the random streams. Equal values give the same
        trial, independent of other trials. A longer trial begins with the samples of a shorter trial.
    disturbance : float64, shape (rows, n), optional
        Force on the device in addition to the command [N, Nm], such as the push of a hand. It is constant between
        two rows, is unknown to the controller and acts without delay.

    Returns
    -------
    Trials
        Simulated trials. A trial that leaves its travel ends with the first sample outside. ``trial_id`` is a running
        number.

    Raises
    ------
    ParameterError
        If K or B is not finite, if the seed is negative, or if the disturbance has a wrong shape.

    Notes
    -----
    If the start is at or beyond the travel limit (F_0/K >= travel), the limit is set slightly farther than the start.
    Otherwise the trial would end at its start, although the response first moves inwards.

    Source: Hulin 2017, sec. 3.1 and 6.1.1, eq. 6.1.
    """
    K, B = np.asarray(stiffness, dtype=np.float64), np.asarray(damping, dtype=np.float64)
    _check(setup, K, B, seed, disturbance)
    shared, trials = _shared(setup), []
    for place, wall in enumerate(zip(K.tolist(), B.tolist(), strict=True)):
        draws = draw(setup, RandomStream(seed, stream, *wall, repetition))
        push = np.zeros(setup.rows) if disturbance is None else disturbance[:, place]
        log = _logged(setup, draws, *_run(setup, shared, wall, draws, setup.constant_force + push))
        trials.append(Trial(str(place), *wall, setup.step, setup.loop.sampling_period_s, *log))
    return Trials.of(trials)


Shared = tuple[Floats, tuple[int, Floats, float], tuple[Floats, int, tuple[Interval, Interval]]]
"""External force, velocity estimator and motion, in the form that `run_trial` requires."""


def _shared(setup: Setup) -> Shared:
    """Return the inputs that are common to all trials of a call."""
    T, motion = setup.true_period_s, FrictionalMotion.of(setup.loop)
    part = setup.loop.delay_samples % 1
    spans = (T, T) if setup.loop.jitter_samples or part == 0 else (part * T, (1 - part) * T)
    early, late = (motion.interval(span) for span in spans)
    estimator = estimator_of(setup.loop.velocity, setup.loop.sampling_period_s)
    return external_force(setup), estimator, (motion.rest(np.ones(1))[:, 0], motion.sensed, (early, late))


def _run(
    setup: Setup, shared: Shared, wall: tuple[float, float], draws: TrialDraws, push: Floats
) -> tuple[Floats, Floats]:
    """Return the command and the position of a trial."""
    (K, _), loop, hidden, (external, estimator, motion) = wall, setup.loop, setup.hidden, shared
    start = setup.centre - (setup.step * (1.0 / K) if K > 0 else 0.0)  # eq. 6.1
    farthest = START_MARGIN * abs(start - setup.centre)
    noise = np.zeros(setup.rows) if draws.noise is None else draws.noise
    held = np.zeros(setup.rows, np.bool_) if draws.held is None else draws.held
    side = float(np.sign(setup.step)) if hidden.one_sided_wall else 0.0
    limit = inf if loop.force_limit is None else loop.force_limit
    command, position = run_trial(
        (*wall, _rest_depth(setup, K), side),
        (external, push, noise, held, _slots(setup, draws.delays)),
        (start, setup.centre, max(setup.travel, farthest), max(setup.stop, farthest)),
        (loop.sensor.quantum, limit, setup.true_gain),
        estimator,
        motion,
    )
    return np.clip(command, -limit, limit) if hidden.clipped_command_logged else command, position


def _check(setup: Setup, K: Floats, B: Floats, seed: int, disturbance: Floats | None) -> None:
    if not (np.isfinite(K).all() and np.isfinite(B).all()):
        raise ParameterError("simulated stiffness and damping must be finite.")
    if seed < 0:
        raise ParameterError(f"seed {seed}: expected 0 or a positive integer.")
    if disturbance is not None and disturbance.shape != (expected := (setup.rows, len(K))):
        raise ParameterError(f"disturbance of shape {disturbance.shape}: expected (rows, n) = {expected}.")


def external_force(setup: Setup) -> Floats:
    """Compute the external force of each row [N, Nm], shape (rows,), from the step, its ramp and later steps."""
    row = np.arange(setup.rows)
    rise = np.clip((row - setup.edge_row + 1) / setup.hidden.ramp_samples, 0.0, 1.0)
    result: Floats = setup.step * rise
    for later in setup.hidden.later_steps:
        result = result + later.size * (row >= round(later.time_s / setup.loop.sampling_period_s))
    return result


def _rest_depth(setup: Setup, K: float) -> float:
    """Compute the penetration depth at which the wall balances the constant force before the step [m, rad].

    The depth is 0 if the wall has no stiffness, or if it is one-sided and the force pulls the device away from it.
    """
    constant = setup.constant_force
    holds = K > 0 and (not setup.hidden.one_sided_wall or constant * setup.step > 0)
    return constant / setup.true_gain / K if holds else 0.0


def applied_delays(delays: Integers) -> Integers:
    """Find the command that is applied to the plant in each interval if the delay differs from command to command.

    The newest command that has arrived is applied. An older command that arrives later is ignored.

    Parameters
    ----------
    delays : int64, shape (rows,)
        Delay of the command of each row [samples].

    Returns
    -------
    int64, shape (rows,)
        Row of the command that is applied in the interval after each row; -1 before the first arrival.

    Examples
    --------
    >>> applied_delays(np.array([2, 1, 1, 0])).tolist()
    [-1, -1, 1, 3]
    """
    newest, sent = np.full(len(delays), -1, dtype=np.int64), np.arange(len(delays))
    arrival = sent + delays
    on_time = arrival < len(delays)
    np.maximum.at(newest, arrival[on_time], sent[on_time])
    result: Integers = np.maximum.accumulate(newest)
    return result


def applied_delay_moments(delays: Sequence[int]) -> tuple[float, float]:
    """Compute the mean and the standard deviation of the delay of the applied command [samples].

    The delay of each command is drawn from the given integers with equal probability. The mean is below the mean of
    ``delays`` because later commands overtake earlier ones. The applied command is older than j samples if none of the
    last j + 1 commands has arrived.
    """
    drawn = np.array(delays)
    older = np.cumprod([(drawn > age).mean() for age in range(int(drawn.max()) + 1)])
    likely = -np.diff(older, prepend=1.0)
    age = np.arange(len(likely))
    mean = float(likely @ age)
    return mean, float(np.sqrt(likely @ (age - mean) ** 2))


def delays_of(age: float, jitter: float) -> tuple[int, ...]:
    """Find integer delays whose applied delay has a given mean and standard deviation [samples].

    All delays have equal probability. The result is empty if a constant delay fits better. An error of the mean has
    four times the weight of an error of the deviation because the stability limits depend on the mean.
    """
    drawn, mean, deviation = _drawn()
    first = np.maximum(np.rint(age - mean), 0)
    off = 4 * np.abs(first + mean - age) + np.abs(deviation - jitter)
    best = int(np.argmin(off))
    return tuple(int(first[best]) + each for each in drawn[best]) if off[best] < jitter else ()


@cache
def _drawn() -> tuple[list[tuple[int, ...]], Floats, Floats]:
    """List candidate sets of delays starting at 0, with the mean and standard deviation of the delay of each set.

    One delay of a set may occur up to `MOST_ALIKE` times.
    """
    every = [tuple(range(count)) for count in range(2, MOST_DELAYS + 1)]
    every = [(*alike, *(one,) * more) for alike in every for one in alike for more in range(MOST_ALIKE)]
    mean, deviation = np.array([applied_delay_moments(drawn) for drawn in every]).T
    return every, mean, deviation


def _slots(setup: Setup, delays: Integers | None) -> Integers:
    """Return the row (from 1) of the command applied in each part of each sampling interval, shape (parts, rows)."""
    if delays is not None:
        slots = applied_delays(delays) + 1
        return slots[None]
    whole = floor(setup.loop.delay_samples)
    first = [[-whole], [1 - whole]] if setup.loop.delay_samples > whole else [[1 - whole]]
    result: Integers = np.maximum(np.arange(setup.rows) + np.array(first), 0)
    return result


def coefficients(kind: VelocityFilter | None, sampling_period_s: float) -> tuple[Floats, Floats]:
    """Return b and a of the filter b(z)/a(z) of (x_k - x_{k-1})/T, in powers of 1/z with a[0] = 1."""
    with many_digits(DIGITS):
        b, a = filter_in_z(per_sample(kind, sampling_period_s))
        return as_floats(b), as_floats(a)


def estimator_of(kind: VelocityFilter | None, sampling_period_s: float) -> tuple[int, Floats, float]:
    """Return the velocity estimator of a controller as an input of `pipeline.loop.closed_loop.velocity`.

    Parameters
    ----------
    kind : VelocityFilter or None
        Velocity filter, or None for the backward difference.
    sampling_period_s : float
        Sampling period T that the controller uses [s].
    """
    if isinstance(kind, AdaptiveWindow):
        return WINDOW, np.array([[kind.bound, kind.longest], [0.0, 0.0]]), sampling_period_s
    if isinstance(kind, Levant):
        return LEVANT, np.array([[kind.acceleration, 0.0], [0.0, 0.0]]), sampling_period_s
    if isinstance(kind, Difference):
        return DIFFERENCE, np.array([[float(kind.samples), 0.0], [0.0, 0.0]]), sampling_period_s
    both = coefficients(kind, sampling_period_s)
    numbers = np.zeros((2, max(map(len, both)) + 1))
    for row, values in zip(numbers, both, strict=True):
        row[: len(values)] = values
    return FILTER, numbers, sampling_period_s


def _logged(setup: Setup, draws: TrialDraws, command: Floats, position: Floats) -> tuple[Floats, Floats, Floats]:
    """Return time stamps, command and position as they are logged in a lab."""
    rows = len(position)
    time = setup.loop.sampling_period_s * np.arange(rows, dtype=np.float64)
    if draws.repeated is not None:
        position = np.where(draws.repeated[:rows], np.append(position[:1], position[:-1]), position)
    if draws.lost is None:
        return time, command, position
    kept = ~draws.lost[:rows]
    stamps = time[: kept.sum()] if setup.hidden.lost_rows_hidden else time[kept]
    return stamps, command[kept], position[kept]
