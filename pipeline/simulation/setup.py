"""Common settings of the trials of one experiment: loop, step, length, travel limits, and undocumented faults.

In addition, the random quantities of each trial: noise, delays, repeated sensor samples, missing rows.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.device.loop import Loop
from pipeline.device.parts import Sensor, SimulationParts
from pipeline.records.models import Device, Experiment
from pipeline.records.trials import Booleans, Floats, Integers

_WORD = 2**32 - 1

MOST_ROWS = 10_000_000
"""Largest number of samples of a trial; it takes a few GB."""

NOTHING_HIDDEN = SimulationParts()
"""No hidden faults: everything as stated and complete."""


@dataclass(frozen=True)
class Setup:
    """Conditions of the trials of one experiment.

    Parameters
    ----------
    loop : Loop
        As stated: the controller differentiates by its sampling period. Its delay is not used if there is jitter.
    step : float
        External step F_0 [N, Nm], commanded from ``edge_row`` on.
    rows, edge_row : int
        Number of samples of a trial that stays within its travel, and the row k0 of the step.
    centre, travel : float
        Steady-state position and largest true distance from it [m, rad].
    hidden : SimulationParts
        Faults unknown to theory and estimates.
    stop : float
        Distance of rigid stops from ``centre`` [m, rad]: the device rests there, without a rebound, until the
        force turns inwards. A start at or beyond a stop moves it outwards as it does the travel limit.

    Raises
    ------
    ParameterError
        If a delay of the jitter is negative, or the step lies outside the rows.

    Examples
    --------
    >>> loop = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4)
    >>> Setup(loop, step=8.0, rows=400, edge_row=20).with_loop(jitter_samples=(3, 4)).mean_delay_samples
    3.5
    """

    loop: Loop
    step: float
    rows: int
    edge_row: int
    centre: float = 0.0
    travel: float = inf
    hidden: SimulationParts = NOTHING_HIDDEN
    stop: float = inf

    def __post_init__(self) -> None:
        if any(delay < 0 for delay in self.loop.jitter_samples):
            raise ParameterError(f"jitter of {self.loop.jitter_samples} samples: none may be negative.")
        if not 0 <= self.edge_row < self.rows:
            raise ParameterError(
                f"the step in row {self.edge_row} lies outside the log of {self.rows} rows; "
                "a trial must last longer than its baseline."
            )

    def with_loop(self, **changes: Any) -> Setup:
        """Return the same conditions with other entries of the loop, such as ``sensor`` or ``jitter_samples``."""
        return replace(self, loop=replace(self.loop, **changes))

    @property
    def mean_delay_samples(self) -> float:
        """Delay of a command [samples]; with jitter, the mean of the drawn delays."""
        drawn = self.loop.jitter_samples or (self.loop.delay_samples,)
        return sum(drawn) / len(drawn)

    @property
    def true_period_s(self) -> float:
        """True sampling period between two rows [s]."""
        return self.loop.sampling_period_s * (1 + self.hidden.clock_error)

    @property
    def true_gain(self) -> float:
        """Force at the actuator per unit of command, with its undocumented error."""
        return self.loop.force_gain * (1 + self.hidden.gain_error)

    @property
    def constant_force(self) -> float:
        """Force on the motor in addition to the command, stated or not [N, Nm]."""
        return self.loop.constant_force + self.hidden.constant_force

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of parts that a spectral radius cannot include: those of the loop, clipping, and hidden faults."""
        present = {
            "force_limit": self.loop.force_limit is not None,
            "one_sided_wall": self.hidden.one_sided_wall,
            "held_samples": self.hidden.held_samples > 0,
        }
        return (*self.loop.left_out, *(name for name, is_present in present.items() if is_present))


def setup_of(device: Device, experiment: Experiment) -> Setup:
    """Return the setup of an experiment as its device file describes it.

    Raises
    ------
    ParameterError
        If a trial would have more samples than `MOST_ROWS`.
    """
    period = device.sampling_period_s
    if device.duration_s / period > MOST_ROWS:
        raise ParameterError(
            f"device {device.name!r}: duration_s = {device.duration_s:g} has {device.duration_s / period:.3g} sampling "
            f"periods of {period:g} s; expected at most {MOST_ROWS:g}."
        )
    return Setup(
        loop=device.loop_for(experiment),
        step=device.step,
        rows=round(device.duration_s / period),
        edge_row=round(device.baseline_s / period),
        centre=device.centre,
        travel=device.limits.travel,
        hidden=device.simulation_of(experiment),
    )


def idealise(setup: Setup) -> Setup:
    """Return the loop of linear theory, with its limits: without noise, quantum, jitter, friction and hidden faults."""
    loop = replace(setup.loop, sensor=Sensor(), jitter_samples=(), friction=None, constant_force=0.0)
    return replace(setup, loop=loop, hidden=NOTHING_HIDDEN)


@dataclass(frozen=True, eq=False)
class TrialDraws:
    """Random draws for each row of a trial, shape (rows,); None if there is nothing to draw.

    ``noise`` [m, rad] comes before the sensor's rounding, ``delays`` [samples] are those of the commands. In ``held``
    samples the sensor repeats its last value, in ``repeated`` rows the log does; ``lost`` rows are missing in the log.
    """

    noise: Floats | None
    delays: Integers | None
    held: Booleans | None
    repeated: Booleans | None
    lost: Booleans | None


@dataclass(frozen=True)
class RandomStream:
    """Random streams of a trial, each determined by seed, stream, K, B, repetition and the drawn quantity."""

    seed: int
    stream: str
    stiffness: float
    damping: float
    repetition: int

    def generator(self, what: int) -> np.random.Generator:
        """Return the generator of a drawn quantity."""
        name = int.from_bytes(hashlib.sha256(self.stream.encode()).digest()[:8])
        # + 0.0: -0.0 is the same trial as 0.0
        bits = (np.array([self.stiffness, self.damping]) + 0.0).view(np.uint64).tolist()
        words = _words(self.seed, name, *bits, self.repetition)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words, spawn_key=(what,))))


def _words(*numbers: int) -> NDArray[np.uint32]:
    """Convert integers to seed words of numpy, lowest word first: passing plain integers takes twice as long."""
    words = []
    for number in numbers:
        words.append(number & _WORD)
        while number := number >> _WORD.bit_length():
            words.append(number & _WORD)
    return np.array(words, dtype=np.uint32)


def draw(setup: Setup, stream: RandomStream) -> TrialDraws:
    """Return all random quantities of a trial."""
    rows, hidden = setup.rows, setup.hidden

    def some(what: int, share: float) -> Booleans | None:
        if share == 0:
            return None
        chosen: Booleans = stream.generator(what).random(rows) < share
        chosen[0] = False  # the first row gives the rest position of the wall
        return chosen

    noise = delays = None
    if setup.loop.sensor.noise > 0:
        noise = setup.loop.sensor.noise * stream.generator(0).standard_normal(rows)
    if setup.loop.jitter_samples:
        choices = np.array(setup.loop.jitter_samples, dtype=np.int64)
        delays = choices[stream.generator(1).integers(0, len(choices), rows)]
    return TrialDraws(
        noise, delays, some(2, hidden.held_samples), some(3, hidden.repeated_rows), some(4, hidden.lost_rows)
    )
