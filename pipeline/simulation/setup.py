"""Define the conditions of all trials of an experiment: loop, step, duration, travel limits and undocumented faults.

The module also draws the random quantities of each trial: noise, delays, repeated sensor samples and missing rows.
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
"""Largest number of samples of a trial. Such a trial takes a few GB of memory."""

NOTHING_HIDDEN = SimulationParts()
"""Default without hidden faults. The device behaves as stated, and its logs are complete."""


@dataclass(frozen=True)
class Setup:
    """Conditions of all trials of an experiment.

    Parameters
    ----------
    loop : Loop
        Loop as stated. The controller differentiates with its sampling period. With jitter, its delay is not used.
    step : float
        External step F_0 [N, Nm], which is commanded from ``edge_row`` on.
    rows, edge_row : int
        Number of samples of a trial that stays within its travel, and the row k0 in which the step begins.
    centre, travel : float
        Steady-state position, and the largest permitted distance of the true position from it [m, rad].
    hidden : SimulationParts
        Faults that neither theory nor estimates account for.
    stop : float
        Distance of the rigid stops from ``centre`` [m, rad]. At a stop, the device rests without a rebound until the
        force turns inwards. If the start is at or beyond a stop, the stop is moved outwards, like the travel limit.

    Raises
    ------
    ParameterError
        If a delay of the jitter is negative, or if the step is not within the rows.

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
            raise ParameterError(f"jitter of {self.loop.jitter_samples} samples: expected no negative delay.")
        if not 0 <= self.edge_row < self.rows:
            raise ParameterError(
                f"the step in row {self.edge_row} is not within the {self.rows} rows of the log; "
                "a trial must last longer than its baseline."
            )

    def with_loop(self, **changes: Any) -> Setup:
        """Return the same conditions with changed fields of the loop, such as ``sensor`` or ``jitter_samples``."""
        return replace(self, loop=replace(self.loop, **changes))

    @property
    def mean_delay_samples(self) -> float:
        """Delay of a command [samples]. With jitter, it is the mean of the delays that are drawn."""
        drawn = self.loop.jitter_samples or (self.loop.delay_samples,)
        return sum(drawn) / len(drawn)

    @property
    def true_period_s(self) -> float:
        """True time between two samples [s]."""
        return self.loop.sampling_period_s * (1 + self.hidden.clock_error)

    @property
    def true_gain(self) -> float:
        """Force at the actuator per unit of command, including the undocumented error of the gain."""
        return self.loop.force_gain * (1 + self.hidden.gain_error)

    @property
    def constant_force(self) -> float:
        """Sum of the stated and the undocumented force on the motor in addition to the command [N, Nm]."""
        return self.loop.constant_force + self.hidden.constant_force

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of parts of the loop, limits and hidden faults that a spectral radius cannot include."""
        present = {
            "force_limit": self.loop.force_limit is not None,
            "one_sided_wall": self.hidden.one_sided_wall,
            "held_samples": self.hidden.held_samples > 0,
        }
        return (*self.loop.left_out, *(name for name, is_present in present.items() if is_present))


def setup_of(device: Device, experiment: Experiment) -> Setup:
    """Return the conditions of an experiment as described in its device file.

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
    """Return the conditions without noise, quantisation, jitter, friction and hidden faults, as in linear theory.

    The limits of force and travel are kept.
    """
    loop = replace(setup.loop, sensor=Sensor(), jitter_samples=(), friction=None, constant_force=0.0)
    return replace(setup, loop=loop, hidden=NOTHING_HIDDEN)


@dataclass(frozen=True, eq=False)
class TrialDraws:
    """Random draws for each row of a trial, shape (rows,). A draw is None if its quantity is not random.

    ``noise`` [m, rad] is added before the sensor rounds. ``delays`` [samples] are the delays of the commands. In
    ``held`` samples, the sensor repeats its last value. In ``repeated`` rows, the log repeats the last position. The
    ``lost`` rows are missing from the log.
    """

    noise: Floats | None
    delays: Integers | None
    held: Booleans | None
    repeated: Booleans | None
    lost: Booleans | None


@dataclass(frozen=True)
class RandomStream:
    """Random streams of a trial. A stream is determined by all fields and by the drawn quantity."""

    seed: int
    stream: str
    stiffness: float
    damping: float
    repetition: int

    def generator(self, what: int) -> np.random.Generator:
        """Return the random generator of a drawn quantity."""
        name = int.from_bytes(hashlib.sha256(self.stream.encode()).digest()[:8])
        # + 0.0: the trials with -0.0 and 0.0 are the same
        bits = (np.array([self.stiffness, self.damping]) + 0.0).view(np.uint64).tolist()
        words = _words(self.seed, name, *bits, self.repetition)
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words, spawn_key=(what,))))


def _words(*numbers: int) -> NDArray[np.uint32]:
    """Convert integers to seed words of numpy, lowest word first. Passing plain integers takes twice as long."""
    words = []
    for number in numbers:
        words.append(number & _WORD)
        while number := number >> _WORD.bit_length():
            words.append(number & _WORD)
    return np.array(words, dtype=np.uint32)


def draw(setup: Setup, stream: RandomStream) -> TrialDraws:
    """Draw all random quantities of a trial."""
    rows, hidden = setup.rows, setup.hidden

    def some(what: int, share: float) -> Booleans | None:
        if share == 0:
            return None
        chosen: Booleans = stream.generator(what).random(rows) < share
        chosen[0] = False  # the first row determines the rest position of the wall
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
