"""The velocity that damps the wall: difference of positions over one or more samples, or a filter of it."""

from __future__ import annotations

import numpy as np

from pipeline.loop.many_digits import as_floats, many_digits
from pipeline.loop.velocity_filter import filter_in_z, per_sample
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import Difference, VelocityFilter

DIGITS = 40
"""In which a filter is written in powers of 1/z: a low cut-off cancels many of them."""


def coefficients(kind: VelocityFilter | None, sampling_period_s: float) -> tuple[Floats, Floats]:
    """Return b and a of the filter b(z)/a(z) that acts on (x_k - x_{k-1})/T, in powers of 1/z, a[0] = 1."""
    with many_digits(DIGITS):
        b, a = filter_in_z(per_sample(kind, sampling_period_s))
        return as_floats(b), as_floats(a)


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
