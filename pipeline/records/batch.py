"""Step responses of one experiment side by side, as arrays: what every measured quantity is computed from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class TrialBatch:
    """Trials as rows, samples as columns; shorter trials are padded with NaN.

    Parameters
    ----------
    trial_id : sequence of str, length n
    stiffness, damping, step, sampling_period_s : float64, shape (n,)
        Virtual stiffness K [N/m, Nm/rad], virtual damping B [Ns/m, Nms/rad], external step F_0 [N, Nm],
        sampling period T [s].
    rows : int64, shape (n,)
        Number of samples of each trial.
    time, command, position : float64, shape (n, N)
        Time stamps [s], total commanded force before any delay [N, Nm], measured position [m, rad].
    force, velocity : float64, shape (n, N), optional
        Measured force [N, Nm] and velocity as logged [m/s, rad/s], NaN for trials without; None where no trial has it.
        Nothing is computed from a logged velocity: how it was made is not known (filters, lags).
    step_row : int64, shape (n,), optional
        Declared row of the command edge, -1 for trials whose log shows it; None where no trial declares one.
    """

    trial_id: tuple[str, ...]
    stiffness: Floats
    damping: Floats
    step: Floats
    sampling_period_s: Floats
    rows: Integers
    time: Floats
    command: Floats
    position: Floats
    force: Floats | None = None
    velocity: Floats | None = None
    step_row: Integers | None = None

    def __len__(self) -> int:
        return len(self.trial_id)

    @cached_property
    def valid(self) -> Booleans:
        """Where there is a sample and not padding, shape (n, N)."""
        return np.arange(self.position.shape[1])[None, :] < self.rows[:, None]

    @cached_property
    def digest(self) -> str:
        """Hash of all conditions and samples; equal values give equal hashes, however they are stored."""
        joined = sha256("\n".join(self.trial_id).encode())
        for item in fields(self)[1:]:
            values = getattr(self, item.name)
            joined.update(item.name.encode() if values is None else np.ascontiguousarray(values).data)
        return joined.hexdigest()[:16]

    @cached_property
    def displacement(self) -> Floats:
        """Position relative to the first one, where the wall rests, shape (n, N) [m, rad]."""
        return self.position - self.position[:, :1]

    def select(self, which: Booleans | Integers) -> TrialBatch:
        """Return the trials picked by a mask or by indices, in that order."""
        index = np.arange(len(self))[which]
        return self._taken(tuple(self.trial_id[i] for i in index), index)

    def portions(self, trials: int) -> Iterator[tuple[slice, TrialBatch]]:
        """Cut the batch into portions of at most so many trials, which share its arrays; each with its place.

        What is computed of some trials stays in a processor's cache, where that of all of them would not.
        """
        for first in range(0, max(len(self), 1), trials):
            some = slice(first, min(first + trials, len(self)))
            yield some, self._taken(self.trial_id[some], some)

    def _taken(self, trial_id: tuple[str, ...], which: Integers | slice) -> TrialBatch:
        return TrialBatch(
            trial_id,
            *(getattr(self, name)[which] for name in ("stiffness", "damping", "step", "sampling_period_s", "rows")),
            *(getattr(self, name)[which] for name in ("time", "command", "position")),
            *(
                None if (values := getattr(self, name)) is None else values[which]
                for name in ("force", "velocity", "step_row")
            ),
        )


def pad(values: Floats, first: Integers, rows: Integers) -> Floats:
    """Cut a long column into trials: row i holds ``values[first[i] : first[i] + rows[i]]``, then NaN.

    Parameters
    ----------
    values : float64, shape (m,)
    first, rows : int64, shape (n,)
        Start and length of each trial in ``values``.
    """
    longest = int(rows.max(initial=0))
    offset = np.arange(longest)
    inside = offset[None, :] < rows[:, None]
    taken = values[np.minimum(first[:, None] + offset[None, :], max(len(values) - 1, 0))]
    return np.where(inside, taken, np.nan)
