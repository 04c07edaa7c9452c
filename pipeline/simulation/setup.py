"""What the trials of one experiment share: device, delay, sensor, velocity filter, limits, and what nobody stated.

And what chance decides in them: noise, delays, samples that the sensor holds, rows the log lacks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.device.parts import SimulationParts, VelocityFilter
from pipeline.loop.motion import Mechanism
from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.records.models import Device, Experiment

_WORD = 2**32 - 1

MOST_ROWS = 10_000_000
"""Samples of a trial, with which it takes some GB."""

NOTHING_HIDDEN = SimulationParts()
"""All as stated and complete."""


@dataclass(frozen=True)
class Setup:
    """Everything that the trials of one experiment share.

    Parameters
    ----------
    plant : Mechanism
    sampling_period_s : float
        T as stated, by which the controller differentiates [s]; ``hidden`` may hold that the true one differs.
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
        Largest absolute command that is rendered [N, Nm].
    velocity : VelocityFilter or None
        Filter of the velocity, None for the plain difference.
    force_gain : float
        Force at the actuator per unit of command.
    hidden : SimulationParts
        What theory and estimates do not know.
    stop : float
        Distance of rigid stops from ``centre`` [m, rad]: the device stands there, without a rebound, until the
        force turns inwards. A start at or beyond a stop moves it outwards as it does the travel limit.
    """

    plant: Mechanism
    sampling_period_s: float
    step: float
    rows: int
    edge_row: int
    delay_samples: float
    jitter_samples: tuple[int, ...] = ()
    centre: float = 0.0
    travel: float = inf
    quantum: float = 0.0
    noise: float = 0.0
    force_limit: float | None = None
    velocity: VelocityFilter | None = None
    force_gain: float = 1.0
    hidden: SimulationParts = NOTHING_HIDDEN
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
    def mean_delay_samples(self) -> float:
        """Delay of a command, where it jitters the mean of those that are drawn [samples]."""
        drawn = self.jitter_samples or (self.delay_samples,)
        return sum(drawn) / len(drawn)

    @property
    def true_period_s(self) -> float:
        """Sampling period by which the device moves between two rows [s]."""
        return self.sampling_period_s * (1 + self.hidden.clock_error)

    @property
    def true_gain(self) -> float:
        """Force at the actuator per unit of command, with the error that nobody knows of."""
        return self.force_gain * (1 + self.hidden.gain_error)


def setup_of(device: Device, experiment: Experiment) -> Setup:
    """Return the setup of an experiment as its device file describes it.

    Raises
    ------
    ParameterError
        If a trial would have more samples than `MOST_ROWS`.
    """
    period, parts = device.sampling_period_s, device.loop_of(experiment)
    if device.duration_s / period > MOST_ROWS:
        raise ParameterError(
            f"device {device.name!r}: duration_s = {device.duration_s:g} has {device.duration_s / period:.3g} sampling "
            f"periods of {period:g} s; expected at most {MOST_ROWS:g}."
        )
    return Setup(
        plant=Mechanism.of(experiment.mass, experiment.damping, experiment.stiffness, parts),
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
        velocity=parts.velocity,
        force_gain=parts.force_gain,
        hidden=device.simulation_of(experiment),
    )


def idealise(setup: Setup) -> Setup:
    """Return the loop of linear theory, with its limits: without noise, quantum, jitter, friction, and all hidden."""
    plant = replace(setup.plant, friction=None)
    return replace(setup, plant=plant, quantum=0.0, noise=0.0, jitter_samples=(), hidden=NOTHING_HIDDEN)


@dataclass(frozen=True, eq=False)
class Chance:
    """Draws of each row and trial, shape (rows, n); None where there is nothing to draw.

    ``noise`` [m, rad] comes before the sensor's rounding, ``delays`` [samples] are those of the commands. In ``held``
    samples the sensor repeats its last value, in ``repeated`` rows the log does; ``lost`` rows are missing in the log.
    """

    noise: Floats | None
    delays: Integers | None
    held: Booleans | None
    repeated: Booleans | None
    lost: Booleans | None


@dataclass(frozen=True)
class Streams:
    """Random streams of the trials of one call, each named by seed, stream, K, B, repetition and what is drawn."""

    seed: int
    stream: str
    stiffness: Floats
    damping: Floats
    repetition: int

    def draw(self, what: int, values: Callable[[np.random.Generator], NDArray[Any]]) -> NDArray[Any]:
        """Return what a function draws from each trial's generator, a trial a column."""
        name = int.from_bytes(hashlib.sha256(self.stream.encode()).digest()[:8])
        # + 0.0: -0.0 is the same trial as 0.0
        bits = np.stack((self.stiffness + 0.0, self.damping + 0.0), axis=1).view(np.uint64).tolist()
        entropy = (_words(self.seed, name, *pair, self.repetition) for pair in bits)
        sequences = (np.random.SeedSequence(words, spawn_key=(what,)) for words in entropy)
        drawn = [values(np.random.Generator(np.random.PCG64(sequence))) for sequence in sequences]
        return np.ascontiguousarray(np.stack(drawn, axis=1))


def _words(*numbers: int) -> NDArray[np.uint32]:
    """Return whole numbers as numpy's seeds take them, lowest word first: plain numbers take twice as long."""
    words = []
    for number in numbers:
        words.append(number & _WORD)
        while number := number >> _WORD.bit_length():
            words.append(number & _WORD)
    return np.array(words, dtype=np.uint32)


def draw(setup: Setup, streams: Streams) -> Chance:
    """Return all that chance decides in the trials of one call."""
    rows, hidden = setup.rows, setup.hidden
    if not len(streams.stiffness):
        return Chance(None, None, None, None, None)

    def some(what: int, share: float) -> Booleans | None:
        if share == 0:
            return None
        chosen: Booleans = streams.draw(what, lambda generator: generator.random(rows)) < share
        chosen[0] = False  # the first row says where the wall rests
        return chosen

    noise = delays = None
    if setup.noise > 0:
        noise = setup.noise * streams.draw(0, lambda generator: generator.standard_normal(rows))
    if setup.jitter_samples:
        choices = np.array(setup.jitter_samples, dtype=np.int64)
        delays = choices[streams.draw(1, lambda generator: generator.integers(0, len(choices), rows))]
    return Chance(noise, delays, some(2, hidden.held_samples), some(3, hidden.repeated_rows), some(4, hidden.lost_rows))
