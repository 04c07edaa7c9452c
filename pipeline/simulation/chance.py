"""What chance decides in simulated trials: noise, delays, samples that the sensor holds, rows the log lacks."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.records.batch import Booleans, Floats, Integers
from pipeline.simulation.setup import Setup

_WORD = 2**32 - 1


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
