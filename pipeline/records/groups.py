"""Trials of one experiment in groups of like length: what is computed and reused together.

Padded to the longest of all, one long log would make all others as long. The length to which a trial is padded is its
own: sums over padded rows are rounded the same, whatever other trials are there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.base.provenance import digest_all
from pipeline.records.batch import Integers, TrialBatch

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
