"""Step responses of one experiment side by side, as arrays: what every measured quantity is computed from.

What is computed and reused together are groups of like length: padded to the longest of all, one long log would make
all others as long. The length to which a trial is padded is its own: sums over padded rows are rounded the same,
whatever other trials are there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.provenance import digest_all

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

SAMPLED = ("time", "command", "position", "force", "velocity")
"""Fields of a batch with a value a sample; the last two only where a log has them."""

NO_STEP_ROW = -1
"""Stands for the command edge of a trial that declares none."""

_OPTIONAL = (*SAMPLED, "step_row", "integrated")

_CONDITIONS = ("stiffness", "damping", "step", "sampling_period_s")


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
    integrated : bool, shape (n,), optional
        Whether positions are integrals of a sensor's velocity, so that their grid is none of a sensor; None for none.
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
    integrated: Booleans | None = None

    def __len__(self) -> int:
        return len(self.trial_id)

    @cached_property
    def valid(self) -> Booleans:
        """Where there is a sample and not padding, shape (n, N)."""
        return np.arange(self.position.shape[1])[None, :] < self.rows[:, None]

    @cached_property
    def digests(self) -> tuple[str, ...]:
        """Hash of name, conditions and samples of each trial: the same for equal values, however they are stored."""
        return tuple(self._digest(trial) for trial in range(len(self)))

    def _digest(self, trial: int) -> str:
        joined = sha256(self.trial_id[trial].encode())
        declared = NO_STEP_ROW if self.step_row is None else int(self.step_row[trial])
        joined.update(np.array([getattr(self, name)[trial] for name in _CONDITIONS]).data)
        joined.update(np.array([self.rows[trial], declared], dtype=np.int64).data)
        if self.integrated is not None and self.integrated[trial]:
            joined.update(b"integrated")
        for name in SAMPLED:
            values = getattr(self, name)
            if values is not None and not np.isnan(own := values[trial, : self.rows[trial]]).all():
                joined.update(name.encode())
                joined.update(np.ascontiguousarray(own).data)
        return joined.hexdigest()[:16]

    @cached_property
    def displacement(self) -> Floats:
        """Position relative to the first one, where the wall rests, shape (n, N) [m, rad]."""
        return self.position - self.position[:, :1]

    def select(self, which: Booleans | Integers | slice) -> TrialBatch:
        """Return the trials picked by a mask, by indices, in that order, or by a slice, which shares the arrays."""
        if isinstance(which, slice):
            return self._taken(self.trial_id[which], which)
        index = np.arange(len(self))[which]
        return self._taken(tuple(self.trial_id[i] for i in index), index)

    def relative_to(self, level: Floats) -> TrialBatch:
        """Return the trials with commands, and measured forces, that count from a level, shape (n,) [N, Nm]."""
        force = None if self.force is None else self.force - level[:, None]
        return replace(self, command=self.command - level[:, None], force=force)

    def portions(self, trials: int = 64) -> Iterator[tuple[slice, TrialBatch]]:
        """Cut the batch into portions of at most so many trials, which share its arrays; each with its place.

        What is computed of some trials stays in a processor's cache, where that of all of them would not: an array of
        64 takes 0.5 MB at 1,000 rows.
        """
        for first in range(0, max(len(self), 1), trials):
            some = slice(first, min(first + trials, len(self)))
            yield some, self.select(some)

    def window(self, first: int, rows: int) -> TrialBatch:
        """Return the same rows of all trials, none of which may be padding."""
        sampled = {name: values for name in SAMPLED if (values := getattr(self, name)) is not None}
        return replace(
            self,
            rows=np.full(len(self), rows, dtype=np.int64),
            step_row=None if self.step_row is None else np.where(self.step_row < 0, NO_STEP_ROW, self.step_row - first),
            **{name: values[:, first : first + rows] for name, values in sampled.items()},
        )

    @classmethod
    def joined(cls, parts: Sequence[TrialBatch]) -> TrialBatch:
        """Return the trials of several batches, one at least, as one, padded to the longest."""
        declared = [np.full(len(p), NO_STEP_ROW) if p.step_row is None else p.step_row for p in parts]
        integrated = [np.zeros(len(p), dtype=np.bool_) if p.integrated is None else p.integrated for p in parts]
        return cls(
            integrated=None if all(part.integrated is None for part in parts) else np.concatenate(integrated),
            trial_id=tuple(name for part in parts for name in part.trial_id),
            step_row=None if all(part.step_row is None for part in parts) else np.concatenate(declared),
            **{name: np.concatenate([getattr(p, name) for p in parts]) for name in (*_CONDITIONS, "rows")},
            # only force and velocity may be missing
            **{name: _padded([getattr(part, name) for part in parts], parts) for name in SAMPLED},  # type: ignore[arg-type]
        )

    def _taken(self, trial_id: tuple[str, ...], which: Integers | slice) -> TrialBatch:
        return TrialBatch(
            trial_id,
            *(getattr(self, name)[which] for name in (*_CONDITIONS, "rows")),
            *(None if (values := getattr(self, name)) is None else values[which] for name in _OPTIONAL),
        )


def _padded(values: Sequence[Floats | None], parts: Sequence[TrialBatch]) -> Floats | None:
    """Samples of several batches in one array, NaN where there are none; None where none has any."""
    if all(one is None for one in values):
        return None
    wide = np.full((sum(map(len, parts)), max(part.position.shape[1] for part in parts)), np.nan)
    row = 0
    for one, part in zip(values, parts, strict=True):
        if one is not None:
            wide[row : row + len(part), : one.shape[1]] = one
        row += len(part)
    return wide


LENGTHS = 8
"""Classes of length within a factor of two: padding adds an eighth at most."""

READINGS = 1 << 20
"""Most readings of a group: an array of theirs takes 8 MB, and the rounds of a fit over its rows cost the same for few
trials as for many."""


def padded_length(rows: Integers) -> Integers:
    """Return the length to which trials of some rows are padded, which no other trial changes.

    >>> padded_length(np.array([1, 400, 5_000_000])).tolist()
    [1, 416, 5242880]
    """
    grid = np.maximum((1 << np.floor(np.log2(np.maximum(rows, 1))).astype(np.int64)) // LENGTHS, 1)
    length: Integers = -(-rows // grid) * grid
    return length


def group_trials(rows: Integers) -> list[Integers]:
    """Return the indices of the trials of each group, shortest trials first.

    Parameters
    ----------
    rows : int64, shape (n,)
        Number of samples of each trial.
    """
    length = padded_length(rows)
    groups = []
    for each in np.unique(length).tolist():
        index = np.flatnonzero(length == each)
        parts = -(-len(index) // max(READINGS // max(each, 1), 1))
        groups += np.array_split(index, parts)
    return groups


@dataclass(frozen=True, eq=False)
class TrialGroups:
    """All samples of an experiment.

    Parameters
    ----------
    places : tuple of int64
        Place of each trial of each group in the order of the experiment: by damping, stiffness and name.
    parts : tuple of TrialBatch
        The trials of each group.
    """

    places: tuple[Integers, ...]
    parts: tuple[TrialBatch, ...]

    def __len__(self) -> int:
        return sum(map(len, self.places))

    @cached_property
    def digest(self) -> str:
        """Hash of the samples of all trials."""
        return digest_all(self.of_trials("digests"))

    def of_trials(self, name: str) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """Return a field with one value a trial (``rows``, ``step``, ...) in the order of the experiment."""
        return self.in_order([np.asarray(getattr(part, name)) for part in self.parts])

    def in_order(self, values: Sequence[np.ndarray[Any, Any]]) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
        """Return values of the trials of each group in the order of the experiment."""
        return np.concatenate(values)[np.argsort(np.concatenate(self.places), kind="stable")]

    @cached_property
    def _where(self) -> tuple[Integers, Integers]:
        """Group of each trial, and its row there, in the order of the experiment."""
        group, row = np.empty((2, len(self)), dtype=np.int64)
        for number, places in enumerate(self.places):
            group[places], row[places] = number, np.arange(len(places))
        return group, row

    def cut(self, which: Integers, first: Integers, rows: Integers) -> TrialBatch:
        """Return windows of some trials, one at least, as one batch whose rows count from the start of the window.

        Parameters
        ----------
        which : int64, shape (m,)
            Places of trials in the order of the experiment.
        first, rows : int64, shape (m,)
            First row of each window and number of rows, both inside the log.
        """
        group, row = (found[which].tolist() for found in self._where)
        windows = zip(group, row, first.tolist(), rows.tolist(), strict=True)
        return TrialBatch.joined([self.parts[g].select(slice(r, r + 1)).window(f, n) for g, r, f, n in windows])

    def pick(self, which: Integers) -> Iterator[tuple[Integers, TrialBatch]]:
        """Pick trials by their places, in batches of like length, each with the indices into ``which``."""
        group, row = (found[which].tolist() for found in self._where)
        of = [(self.parts[g], r) for g, r in zip(group, row, strict=True)]
        rows = np.array([part.rows[r] for part, r in of], dtype=np.int64)
        for index in group_trials(rows):
            yield index, TrialBatch.joined([part.select(slice(r, r + 1)) for part, r in (of[i] for i in index)])
