"""The velocity that damps the wall: difference of positions over one or more samples, or a filter of it."""

from __future__ import annotations

from math import comb, pi, tan

import numpy as np

from pipeline.records.batch import Floats
from pipeline.records.loop_parts import Butterworth, Coefficients, Difference, VelocityFilter


def coefficients(kind: VelocityFilter | None, sampling_period_s: float) -> tuple[Floats, Floats]:
    """Return b and a of the filter b(z)/a(z) that acts on (x_k - x_{k-1})/T, in powers of 1/z, a[0] = 1.

    Notes
    -----
    A Butterworth filter has its poles on the circle about 0 whose radius is the cut-off, prewarped so that the bilinear
    transform brings it back to its place: 1/s becomes (1 + 1/z)/(1 - 1/z) / tan(pi f T) in units of the cut-off.
    """
    if kind is None:
        return np.ones(1), np.ones(1)
    if isinstance(kind, Difference):
        return np.full(kind.samples, 1 / kind.samples), np.ones(1)
    if isinstance(kind, Coefficients):
        return np.array(kind.b) / kind.a[0], np.array(kind.a) / kind.a[0]
    return _butterworth(kind, sampling_period_s)


def _butterworth(kind: Butterworth, sampling_period_s: float) -> tuple[Floats, Floats]:
    n, warped = kind.order, tan(pi * kind.cutoff_hz * sampling_period_s)
    poles = warped * np.exp(1j * pi * (2 * np.arange(n) + n + 1) / (2 * n))
    a = np.real(np.poly((1 + poles) / (1 - poles)))
    # the zeros lie at -1, the gain at rest is 1
    gain = np.real(np.prod(warped / (1 - poles)))
    return gain * np.array([comb(n, i) for i in range(n + 1)], dtype=np.float64), a


class Velocity:
    """Velocity of many trials, sample after sample.

    Parameters
    ----------
    kind : VelocityFilter or None
        None for the backward difference.
    sampling_period_s : float
        T as the controller takes it [s].
    trials : int
    """

    def __init__(self, kind: VelocityFilter | None, sampling_period_s: float, trials: int) -> None:
        self.period = sampling_period_s
        self.samples = kind.samples if isinstance(kind, Difference) else 1
        b, a = (np.ones(1), np.ones(1)) if isinstance(kind, Difference) else coefficients(kind, sampling_period_s)
        order = max(len(a), len(b)) - 1
        self._b, self._a = np.pad(b, (0, order + 1 - len(b))), np.pad(a, (0, order + 1 - len(a)))
        self._memory = np.zeros((order + 1, trials))
        self._filtered = order > 0 or bool(b[0] != 1)

    def after(self, position: Floats, row: int) -> Floats:
        """Return the velocity of a row from the positions so far, shape (rows, n); rows in order, each once."""
        difference: Floats = (position[row] - position[max(row - self.samples, 0)]) / self.period
        if self.samples > 1:
            return difference / self.samples
        if not self._filtered:
            return difference
        result: Floats = self._b[0] * difference + self._memory[0]
        # transposed direct form: the last row of the memory stays zero
        for i in range(len(self._memory) - 1):
            self._memory[i] = self._memory[i + 1] + self._b[i + 1] * difference - self._a[i + 1] * result
        return result
