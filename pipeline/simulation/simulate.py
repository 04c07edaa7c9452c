"""Hybrid simulator of the virtual wall: sampled controller, delayed command, exact motion between samples.

Per sample k: the true position is disturbed by noise and rounded to the sensor's quantum; the wall force
``K (x_k - x_0) + B (x_k - x_{k-1})/T`` is subtracted from the external step; the command is clipped to the
force limit and reaches the plant some samples later. Between two changes of its input the plant moves
exactly. All trials of a batch advance together; each has its own random streams, so batching changes no bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import exp, floor, inf
from typing import Protocol

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.plant import Flow, flow
from pipeline.records.batch import Floats, Integers, TrialBatch
from pipeline.records.models import Device, Experiment

START_MARGIN = 1.1
"""Smallest travel limit relative to the distance of the start: noise must not end a trial where it starts."""


class Plant(Protocol):
    """What a device needs to be to be simulated: a state, and its motion under a constant force."""

    def rest(self, trials: int) -> Floats:
        """Return the state at rest, shape (states, trials); row 0 is the displacement from the start."""

    def advance(self, state: Floats, force: Floats, time_s: float) -> Floats:
        """Return the state after a time [s] under a constant force [N, Nm], shape (trials,)."""


@dataclass(frozen=True)
class MassSpringDamper:
    """Linear device of mass m [kg, kg m^2], viscous damping b and stiffness k; k is relaxed at the start.

    Source: Hulin 2017, eq. 3.3.
    """

    mass: float
    damping: float = 0.0
    stiffness: float = 0.0

    def rest(self, trials: int) -> Floats:
        """Return displacement and velocity of zero, shape (2, trials)."""
        return np.zeros((2, trials))

    def advance(self, state: Floats, force: Floats, time_s: float) -> Floats:
        """Return displacement and velocity after a time under a constant force, exactly."""
        motion = self.motion(time_s)
        acceleration = force / self.mass
        position, velocity = state
        (xx, xv), (vx, vv) = motion.transition
        return np.stack(
            (
                xx * position + xv * velocity + motion.gain[0] * acceleration,
                vx * position + vv * velocity + motion.gain[1] * acceleration,
            )
        )

    def motion(self, time_s: float) -> Flow:
        """Return the exact flow over a time [s] for the input force/m."""
        return _flow(self.stiffness / self.mass, self.damping / self.mass, time_s)


@lru_cache(maxsize=64)
def _flow(gamma: float, delta: float, time_s: float) -> Flow:
    return flow(gamma, delta, time_s)


@dataclass(frozen=True)
class Setup:
    """Everything that the trials of one experiment share.

    Parameters
    ----------
    plant : Plant
    sampling_period_s : float
        T [s].
    step : float
        External step F_0 [N, Nm], commanded from ``edge_row`` on.
    rows, edge_row : int
        Number of samples of a trial that stays within its travel, and the row k0 of the step.
    delay_samples : float
        Total delay d of the command in samples, may be fractional; not used where there is jitter.
    jitter_samples : tuple of int
        Delays that are drawn from, uniformly, for each command; empty for a constant delay.
    centre, travel : float
        Steady-state position and largest true distance from it [m, rad].
    quantum, noise : float
        Sensor quantum and standard deviation of the noise before rounding [m, rad].
    force_limit : float or None
        Largest absolute command [N, Nm].
    velocity_filter_s : float
        Time constant of the low-pass of the velocity [s], 0 for the plain difference.
    stop : float
        Distance of rigid stops from ``centre`` [m, rad]: the device stands there, without a rebound, until the
        force turns inwards. A start at or beyond a stop moves it outwards as it does the travel limit.
    """

    plant: Plant
    sampling_period_s: float
    step: float
    rows: int
    edge_row: int
    delay_samples: float
    jitter_samples: tuple[int, ...] = ()
    centre: float = 0.0
    travel: float = float("inf")
    quantum: float = 0.0
    noise: float = 0.0
    force_limit: float | None = None
    velocity_filter_s: float = 0.0
    stop: float = inf

    def __post_init__(self) -> None:
        if self.delay_samples < 0 or any(d < 0 for d in self.jitter_samples):
            raise ParameterError(
                f"delay of {self.delay_samples} samples, jitter {self.jitter_samples}: none may be negative."
            )
        if not 0 <= self.edge_row < self.rows:
            raise ParameterError(
                f"the step in row {self.edge_row} lies outside the log of {self.rows} rows; "
                "a trial must last longer than its baseline."
            )
        if not (0 <= self.quantum < inf and 0 <= self.noise < inf):
            raise ParameterError(f"quantum {self.quantum} and noise {self.noise} must be finite and not negative.")

    @property
    def filter_share(self) -> float:
        """Share of a new velocity difference that the low-pass takes over per sample, 1 without a filter."""
        constant = self.velocity_filter_s
        return 1.0 - exp(-self.sampling_period_s / constant) if constant > 0 else 1.0


def setup_of(device: Device, experiment: Experiment) -> Setup:
    """Return the setup of an experiment as its device file describes it, with sensor, jitter and limits."""
    period = device.sampling_period_s
    return Setup(
        plant=MassSpringDamper(experiment.mass, experiment.damping, experiment.stiffness),
        sampling_period_s=period,
        step=device.step,
        rows=round(device.duration_s / period),
        edge_row=round(device.baseline_s / period),
        delay_samples=experiment.delay_samples,
        jitter_samples=experiment.jitter_samples,
        centre=device.centre,
        travel=device.limits.travel,
        quantum=device.sensor.quantum,
        noise=device.sensor.noise,
        force_limit=device.limits.force,
    )


def idealise(setup: Setup) -> Setup:
    """Return the setup without noise, quantum and jitter: the loop of theory, with its travel limit."""
    return replace(setup, quantum=0.0, noise=0.0, jitter_samples=())


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
    """Simulate step responses, one per pair (K, B), from rest at ``centre - F_0/K`` (``centre`` for K = 0).

    Parameters
    ----------
    setup : Setup
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K >= 0 [N/m, Nm/rad] and damping B [Ns/m, Nms/rad], B may be negative.
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
        If K is negative, or K or B is not finite, or the seed is negative, or the disturbance has another shape.

    Notes
    -----
    A start at or beyond the travel limit (F_0/K >= travel) widens the limit to a little more than that
    distance: the response moves inwards first, and would otherwise end before it began.

    Source: Hulin 2017, sec. 3.1 and 6.1.1, eq. 6.1.
    """
    K, B = np.asarray(stiffness, dtype=np.float64), np.asarray(damping, dtype=np.float64)
    if not (np.isfinite(K).all() and np.isfinite(B).all() and (K >= 0).all()):
        raise ParameterError("simulated stiffness must be finite and not negative, damping finite.")
    if seed < 0:
        raise ParameterError(f"seed {seed}: expected 0 or a positive whole number.")
    trials, T = len(K), setup.sampling_period_s
    start = setup.centre - setup.step * np.divide(1.0, K, out=np.zeros(trials), where=K > 0)  # eq. 6.1
    if disturbance is not None and disturbance.shape != (setup.rows, trials):
        raise ParameterError(f"disturbance of shape {disturbance.shape}: expected (rows, n) = {(setup.rows, trials)}.")
    noise, delays = _draw(setup, K, B, seed, stream, repetition)
    route = _route(setup, delays)
    farthest = START_MARGIN * np.abs(start - setup.centre)
    travel, stop = np.maximum(setup.travel, farthest), np.maximum(setup.stop, farthest)
    share = setup.filter_share
    filtered = share < 1

    position = np.full((setup.rows, trials), np.nan)
    command = np.full((setup.rows + 1, trials), np.nan)  # row 0: what the plant feels before the first arrival
    command[0] = 0.0
    rows = np.full(trials, setup.rows, dtype=np.int64)
    inside = np.ones(trials, dtype=np.bool_)
    state = setup.plant.rest(trials)
    velocity: Floats = np.zeros(trials)
    everyone = np.arange(trials)
    for k in range(setup.rows):
        true = start + state[0]
        position[k] = _measure(true if noise is None else true + noise[k], setup.quantum)
        difference = (position[k] - position[max(k - 1, 0)]) / T
        velocity = velocity + share * (difference - velocity) if filtered else difference
        wall = K * (position[k] - position[0]) + B * velocity
        command[k + 1] = (setup.step if k >= setup.edge_row else 0.0) - wall
        if setup.force_limit is not None:
            np.clip(command[k + 1], -setup.force_limit, setup.force_limit, out=command[k + 1])
        left = inside & (np.abs(true - setup.centre) > travel)
        if left.any():
            rows[left] = k + 1
            inside &= ~left
            state[:, left] = 0.0  # parked at rest, so that an unstable trial cannot overflow after its end
            if not inside.any():
                break
        for time_s, slot in route(k):
            force = command[slot] if isinstance(slot, int) else command[slot, everyone]
            if disturbance is not None:
                force = force + disturbance[k]
            state = setup.plant.advance(state, np.where(inside, force, 0.0), time_s)
        if setup.stop < inf:
            reached = np.clip(state[0], setup.centre - stop - start, setup.centre + stop - start)
            state[1, state[0] != reached] = 0.0
            state[0] = reached
    longest = int(rows.max(initial=0))
    padding = np.arange(longest)[None, :] >= rows[:, None]
    time = np.where(padding, np.nan, T * np.arange(longest))
    return TrialBatch(
        trial_id=tuple(str(i) for i in range(trials)),
        stiffness=K,
        damping=B,
        step=np.full(trials, setup.step),
        sampling_period_s=np.full(trials, T),
        rows=rows,
        time=time,
        command=np.where(padding, np.nan, command[1 : longest + 1].T),
        position=np.where(padding, np.nan, position[:longest].T),
    )


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


def _route(setup: Setup, delays: Integers | None) -> Callable[[int], Sequence[tuple[float, int | Integers]]]:
    """Return, for a row, the parts of its interval: duration [s] and slot (row + 1) of its command."""
    T = setup.sampling_period_s
    if delays is not None:
        slots = in_force(delays) + 1
        return lambda row: [(T, slots[row])]
    whole = floor(setup.delay_samples)
    part = setup.delay_samples - whole
    if part == 0:
        return lambda row: [(T, max(row - whole + 1, 0))]
    return lambda row: [(part * T, max(row - whole, 0)), ((1 - part) * T, max(row - whole + 1, 0))]


def _measure(position: Floats, quantum: float) -> Floats:
    return np.rint(position / quantum) * quantum if quantum > 0 else position


def _draw(
    setup: Setup, K: Floats, B: Floats, seed: int, stream: str, repetition: int
) -> tuple[Floats | None, Integers | None]:
    """Return sensor noise [m, rad] and command delays [samples], shape (rows, n); None for none."""
    if setup.noise == 0 and not setup.jitter_samples:
        return None, None
    name = int.from_bytes(hashlib.sha256(stream.encode()).digest()[:8])
    choices = np.array(setup.jitter_samples, dtype=np.int64)
    noise, delays = np.zeros((setup.rows, len(K))), np.zeros((setup.rows, len(K)), dtype=np.int64)
    bits = np.stack((K + 0.0, B + 0.0), axis=1).view(np.uint64).tolist()  # + 0.0: -0.0 is the same trial as 0.0
    for trial, (stiffness_bits, damping_bits) in enumerate(bits):
        entropy = [seed, name, stiffness_bits, damping_bits, repetition]
        if setup.noise > 0:
            generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy, spawn_key=(0,))))
            noise[:, trial] = setup.noise * generator.standard_normal(setup.rows)
        if len(choices):
            generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy, spawn_key=(1,))))
            delays[:, trial] = choices[generator.integers(0, len(choices), setup.rows)]
    return (noise if setup.noise > 0 else None), (delays if len(choices) else None)


def spectral_radius(plant: MassSpringDamper, setup: Setup, stiffness: Floats, damping: Floats) -> Floats:
    """Return the spectral radius of the ideal loop (constant delay ``setup.delay_samples``), shape (n,).

    Parameters
    ----------
    plant : MassSpringDamper
    setup : Setup
        Sampling period, delay and velocity filter are used.
    stiffness, damping : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad] and damping B [Ns/m, Nms/rad].

    Returns
    -------
    float64, shape (n,)
        Below 1 where the loop is stable. Without any stiffness (K = k = 0) z = 1 is a pole for every B; it
        is left out, so that the radius tells whether the velocity decays.

    Notes
    -----
    State of the simulated loop: displacement, velocity, last position, filtered velocity, delayed commands.

    Source: Hulin 2017, eq. 3.18, in physical units and with a fractional delay.
    """
    T, trials = setup.sampling_period_s, len(stiffness)
    whole = floor(setup.delay_samples)
    part = setup.delay_samples - whole
    share = setup.filter_share
    early, late = plant.motion(part * T), plant.motion((1 - part) * T)
    size = 5 + whole  # the last entry is the command of row k - whole - 1
    speed = np.zeros((trials, size))
    speed[:, 0], speed[:, 2], speed[:, 3] = share / T, -share / T, 1 - share
    wall = -damping[:, None] * speed
    wall[:, 0] -= stiffness
    loop = np.zeros((trials, size, size))
    loop[:, :2, :2] = late.transition @ early.transition
    loop[:, :2, -1] += late.transition @ early.gain / plant.mass
    if whole == 0:
        loop[:, :2, :] += late.gain[:, None] / plant.mass * wall[:, None, :]
    else:
        loop[:, :2, -2] += late.gain / plant.mass
    loop[:, 2, 0] = 1.0
    loop[:, 3, :] = speed
    loop[:, 4, :] = wall
    for entry in range(5, size):
        loop[:, entry, entry - 1] = 1.0
    poles = np.linalg.eigvals(loop)
    free = (stiffness == 0) & (plant.stiffness == 0)
    nearest = np.argmin(np.abs(poles - 1.0), axis=1)
    magnitude = np.abs(poles)
    magnitude[free, nearest[free]] = 0.0
    result: Floats = magnitude.max(axis=1)
    return result
