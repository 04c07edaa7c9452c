"""Modes of a general loop's responses: each state at each sample as a sum of powers of the poles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats, Integers

Complexes = NDArray[np.complex128]

TOGETHER = 4096
"""Points that are computed together: their states fit a cache."""


_GONE = 1e-30
"""Pole of a motion that ends at once."""

_CANCELLED = 1e3
"""Sizes of all modes over that of their sum from which on they cancel too many digits: rounding grows as the square."""


@dataclass(frozen=True, eq=False)
class Modes:
    """z_k = sum over i of state[:, :, i] pole[:, i]^k for n points.

    Parameters
    ----------
    pole : complex128, shape (n, modes)
    state : complex128, shape (n, states, modes)
        What each mode has of the loop's state at sample 0; nan where modes lie so close together that they cancel.
    """

    pole: Complexes
    state: Complexes

    def part(self, which: Integers) -> Modes:
        """Return the modes of some points."""
        return Modes(self.pole[which], self.state[which])

    @property
    def rate(self) -> Floats:
        """Decay per sample, -ln |pole|; shape (n, modes)."""
        return -np.log(np.maximum(np.abs(self.pole), _GONE))

    def grown(self, sample: Floats) -> Complexes:
        """Return pole^sample, shape (n, modes), of samples of shape (n,)."""
        return np.asarray(np.exp(sample[:, None] * (1j * np.angle(self.pole) - self.rate)))

    def at(self, sample: Floats) -> Floats:
        """Return the state at samples of shape (n,); shape (states, n)."""
        return np.ascontiguousarray((self.state @ self.grown(sample)[:, :, None])[:, :, 0].real.T)


def modes(loop: Loop, alpha: Floats, beta: Floats, signal: str) -> Modes:
    """Return the modes of responses; those of the latest points are kept, as several costs ask for them.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
    signal : {"step", "impulse"}

    Returns
    -------
    Modes
        Of n points; the states are those of `loop.matrix` (position error, its history, delayed commands, device).

    """
    return _modes(loop, alpha.tobytes(), beta.tobytes(), signal)


@lru_cache(maxsize=1)
def _modes(loop: Loop, alpha: bytes, beta: bytes, signal: str) -> Modes:
    a, b = np.frombuffer(alpha), np.frombuffer(beta)
    pole, vectors = (part.astype(np.complex128) for part in np.linalg.eig(loop.matrix(a, b)))
    start = loop.starts(a, signal)
    apart = np.isfinite(np.linalg.slogdet(vectors)[1])
    vectors[~apart] = np.eye(loop.states)
    amplitude = np.linalg.solve(vectors, start[:, :, None])[:, :, 0]
    # the vectors have length 1; written so that what is no number is not apart
    apart &= np.abs(amplitude).sum(axis=1) <= _CANCELLED * np.linalg.norm(start, axis=1)
    amplitude[~apart] = np.nan
    return Modes(pole, vectors * amplitude[:, None, :])
