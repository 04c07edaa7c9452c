"""What is stored of each source, by the table of trials alone: which logs are known, and which files need no look."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.base.errors import StoreError
from pipeline.intake.bags import ENDINGS
from pipeline.readers import Log
from pipeline.records.table_files import open_table
from pipeline.store.batch_files import Key
from pipeline.store.names import name_of_folder
from pipeline.store.storage import read_rows, trials_files

SEEN = ("source_path", "source_size", "source_mtime_ns", "source_trials", "claims")
"""Columns that tell whether anything is new; with groups of 64 rows each column costs a tenth of the time."""

MORE = ("source_sha256", "profile_sha256", "profile", "device", "trial_id")
"""Columns that are read of a file when a log of it is asked for."""


class StoredSource(NamedTuple):
    """What is stored of a source.

    Parameters
    ----------
    sha256, profile_sha256, profile : str
        Content, and the profile that read it.
    size, mtime_ns : int
        Size [byte] and modification time [ns] when it was read.
    devices, trials : tuple of str
        Device and id of each of its trials.
    whole : bool
        Whether these are all that the source holds: an interrupted run may have written some of them.
    """

    sha256: str
    profile_sha256: str
    profile: str
    size: int
    mtime_ns: int
    devices: tuple[str, ...]
    trials: tuple[str, ...]
    whole: bool = True

    def keys(self, path: str) -> set[Key]:
        """Return its trials as they were read."""
        return {(path, trial, self.profile_sha256) for trial in self.trials}


class StoredSources:
    """What is stored of each source, by its path; a record is made when it is asked for, of 100,000 hardly any.

    Parameters
    ----------
    processed : Path
    claims : str
        Hash of all profiles that may claim a file now.
    damaged : dict of Path to str
        As for `storage.read_trials`.
    """

    def __init__(self, processed: Path, claims: str, damaged: dict[Path, str]) -> None:
        self.processed, self.claims, self.damaged = processed, claims, damaged
        self.rows = read_rows(processed, SEEN, damaged)
        self.paths: list[str] = self.rows.column("source_path")
        self.size, self.time, self.held = (self.rows.table.column(name).to_numpy() for name in SEEN[1:4])
        self.last = dict(zip(self.paths, range(len(self.paths)), strict=True))
        self._several: dict[str, list[int]] = {}
        if len(self.last) < len(self.paths) or (self.held > 1).any():
            for row, path in enumerate(self.paths):
                self._several.setdefault(path, []).append(row)
        self._missing = {path: int(self.held[rows[-1]]) - len(rows) for path, rows in self._several.items()}
        self._details: dict[int, list[tuple[str, str, str, str, str]]] = {}
        self.doubled = min(self._missing.values(), default=0) < 0
        """Whether a log stands there with two contents."""

    @property
    def states(self) -> dict[str, tuple[int, int]]:
        """Size [byte] and time [ns] of each source that is one file, stored as a whole, of a profile that is sure."""
        states = zip(self.size.tolist(), self.time.tolist(), strict=True)
        sure = [claims == self.claims for claims in self.rows.column("claims")]
        found = dict(zip(compress(self.paths, sure), compress(states, sure), strict=True))
        unsure = [path for path, lost in self._missing.items() if lost]
        for path in (*unsure, *(path for path in found if path.endswith(ENDINGS))):
            found.pop(path, None)
        return found

    def is_whole(self, path: str) -> bool:
        """Return whether all trials of a stored source are there."""
        return not self._missing.get(path)

    def get(self, path: str) -> StoredSource | None:
        """Return what is stored under a path; of a file that is damaged nothing, so that its logs count as new."""
        if path not in self.last:
            return None
        rows = self._several.get(path, [self.last[path]])
        try:
            details = [self._detail(row) for row in rows]
        except (StoreError, FileNotFoundError) as error:
            self.damaged[self.rows.files[int(self.rows.file[rows[-1]])]] = str(error)
            return None
        sha256, profile_sha256, profile, _, _ = details[-1]
        told = sha256, profile_sha256, profile, int(self.size[rows[-1]]), int(self.time[rows[-1]])
        devices, trials = tuple(row[3] for row in details), tuple(row[4] for row in details)
        return StoredSource(*told, devices, trials, self.is_whole(path))

    def _detail(self, row: int) -> tuple[str, str, str, str, str]:
        """Return the values of `MORE`."""
        index = int(self.rows.file[row])
        if index not in self._details:
            with open_table(self.rows.files[index]) as stored:
                columns = stored.read(list(MORE), use_threads=False)
            self._details[index] = list(zip(*(columns.column(name).to_pylist() for name in MORE), strict=True))
        return self._details[index][row - int(np.searchsorted(self.rows.file, index))]

    def places(self, but: set[str]) -> dict[str, str]:
        """Return the path under which each trial is stored, but those of some sources and of such in part."""
        rows = read_rows(self.processed, ("trial_id", "source_path"), self.damaged)
        pairs = zip(rows.column("trial_id"), rows.column("source_path"), strict=True)
        return {trial: path for trial, path in pairs if path not in but and self.is_whole(path)}


APART = 0.01
"""Part by which sampling periods of one experiment may differ: a clock is off by 1e-4, and the limit of a stiff wall is
proportional to 1/T."""


def alike(one: float, other: float) -> bool:
    """Return whether two sampling periods [s] may be of one experiment."""
    return abs(one - other) <= APART * max(one, other)


@dataclass
class Periods:
    """Sampling period [s] of each experiment of a store, by device and name; the first log decides.

    A log whose period differs is of another loop, and of an experiment of its own.
    """

    processed: Path

    @cached_property
    def known(self) -> dict[tuple[str, str], float]:
        """What is stored, and what was taken since."""
        found: dict[tuple[str, str], float] = {}
        for file in trials_files(self.processed):
            place = name_of_folder(file.parent.parent.name), name_of_folder(file.parent.name)
            if place not in found:
                try:
                    with open_table(file) as stored:
                        found[place] = stored.read_row_group(0, ["sampling_period_s"]).column(0)[0].as_py()
                except (StoreError, FileNotFoundError):  # named by who reads more of it
                    continue
        return found

    def apart(self, logs: Iterable[Log]) -> list[Log]:
        """Return logs with the names of experiments of their own period; one that is renamed says so."""
        return [self._of_own_period(log) for log in logs]

    def _of_own_period(self, log: Log) -> Log:
        header, period = log.header, log.header.sampling_period_s
        common = self.known.setdefault((header.device, header.experiment), period)
        if alike(common, period):
            return log
        stem = f"{header.experiment}-T"
        of_device = [(name, known) for (device, name), known in self.known.items() if device == header.device]
        names = (name for name, known in of_device if name.startswith(stem) and alike(known, period))
        name = next(names, f"{stem}{1e3 * period:.4g}ms")
        self.known.setdefault((header.device, name), period)
        text = (
            f"the sampling period is {1e3 * period:.4g} ms; logs of experiment {header.experiment!r} have "
            f"{1e3 * common:.4g} ms. It is stored as experiment {name!r}: another period is another loop."
        )
        return replace(log, header=replace(header, experiment=name), warnings=(*log.warnings, text))
