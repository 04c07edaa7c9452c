"""What is stored of each source, by the table of trials alone: which logs are known, and which files need no look."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.base.file_names import path_of_text
from pipeline.base.regular_files import is_gone
from pipeline.intake.bags import ENDINGS
from pipeline.intake.sources import Source, told_by_name
from pipeline.intake.trialstore import Accepted, trial_id
from pipeline.store.storage import each_once, newest_versions, read_versions


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
    whole: bool

    def keys(self, path: str) -> set[tuple[str, str, str]]:
        """Return its trials as `batch_files.drop` takes them."""
        return {(path, trial, self.profile_sha256) for trial in self.trials}


def stored_source(accepted: Sequence[Accepted]) -> StoredSource:
    """Return what will be stored of a source."""
    row, source = accepted[0].row, accepted[0].source
    devices = tuple(one.log.header.device for one in accepted)
    told = (row["source_sha256"], row["profile_sha256"], row["profile"], source.size, source.mtime_ns)
    return StoredSource(*told, devices, tuple(one.row["trial_id"] for one in accepted), True)


SEEN = (
    *("source_path", "source_sha256", "source_size", "source_mtime_ns", "source_trials"),
    *("claims", "version", "formerly"),
)
"""Columns that tell whether anything is new; with groups of 64 rows each column costs a tenth of the time."""

MORE = ("device", "experiment", "sampling_period_s", "profile", "profile_sha256", "trial_id")
"""Columns that are read when something is."""


class StoredSources(Mapping[str, StoredSource]):
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
        self._look(SEEN)
        if not each_once(self.table):
            self.complete()

    def _look(self, columns: Sequence[str]) -> None:
        self.table, self.files, self.replaced = read_versions(self.processed, None, None, list(columns), self.damaged)
        self._index()

    def complete(self) -> None:
        """Read all columns."""
        if MORE[0] in self.table.column_names:
            return
        more, files, _ = read_versions(self.processed, None, None, list(MORE), self.damaged)
        if files != self.files or more.num_rows != self.table.num_rows:  # what is damaged in these alone is left out
            self._look((*SEEN, *MORE))
            return
        for name in MORE:
            self.table = self.table.append_column(more.schema.field(name), more.column(name))
        self._index()

    def _index(self) -> None:
        self._newest = np.ones(self.table.num_rows, dtype=np.bool_)
        if MORE[0] in self.table.column_names:
            self._newest = newest_versions(self.table)
        self._columns: dict[str, list[Any]] = {}
        paths, trials = self._column("source_path"), self.table.column("source_trials").to_numpy()
        rows = np.flatnonzero(self._newest).tolist()
        self._last: dict[str, int] = {paths[row]: row for row in rows}
        self._whole = self._newest & (trials == 1)
        # of sources with several trials alone: a list for each of 100,000 takes longer than all else
        self._several: dict[str, list[int]] = {}
        if len(self._last) < len(rows):
            for row in rows:
                self._several.setdefault(paths[row], []).append(row)
            for own in self._several.values():
                self._whole[own] = len(own) >= trials[own[-1]]

    @property
    def latest(self) -> int:
        """Highest version."""
        return int(np.max(self.table.column("version").to_numpy(), initial=0))

    @property
    def states(self) -> dict[str, tuple[int, int]]:
        """Size [byte] and time [ns] of each source that is one file, stored as a whole, of a profile that is sure."""
        names = ("source_path", "source_size", "source_mtime_ns", "claims")
        rows = zip(*map(self._column, names), self._whole.tolist(), strict=True)
        return {
            path: (size, time)
            for path, size, time, claims, whole in rows
            if whole and claims == self.claims and not path.endswith(ENDINGS)
        }

    def __getitem__(self, path: str) -> StoredSource:
        self.complete()
        last = self._last[path]
        rows = self._several.get(path, (last,))
        names = ("source_sha256", "profile_sha256", "profile", "source_size", "source_mtime_ns")
        sha256, profile_sha256, profile, size, mtime_ns = (self._column(name)[last] for name in names)
        devices, trials = (tuple(self._column(name)[row] for row in rows) for name in ("device", "trial_id"))
        return StoredSource(sha256, profile_sha256, profile, size, mtime_ns, devices, trials, bool(self._whole[last]))

    def __iter__(self) -> Iterator[str]:
        return iter(self._last)

    def __len__(self) -> int:
        return len(self._last)

    def _column(self, name: str) -> list[Any]:
        if name not in self._columns:
            self._columns[name] = self.table.column(name).to_pylist()
        return self._columns[name]

    def places(self, but: set[str]) -> Places:
        """Return where contents and trials are stored as a whole, but those of some sources."""
        self.complete()
        found = Places({}, {})
        rows = zip(*map(self._column, ("source_path", "source_sha256", "trial_id")), self._whole.tolist(), strict=True)
        for path, content, trial, whole in rows:
            if whole and path not in but:
                found.contents[content] = found.trials[trial] = path
        return found


class Places(NamedTuple):
    """Path under which each content (by its SHA-256) and each trial (by its id) is stored."""

    contents: dict[str, str]
    trials: dict[str, str]

    def find(self, source: Source, sha256: str) -> str | None:
        """Return the path under which a log is stored that is this one: content, and what its name tells."""
        told = None if source.profile is None else told_by_name(source.profile, source.path)
        return self.contents.get(sha256) if told is None else self.trials.get(trial_id(sha256, None, told))

    def add(self, path: str, sha256: str, trials: Sequence[str]) -> None:
        """Note where a log is stored now."""
        self.contents[sha256] = path
        self.trials.update(dict.fromkeys(trials, path))


def gone_of(stored: StoredSources, present: set[str]) -> dict[tuple[str, str], list[str]]:
    """Return the paths of stored sources that are not there any more, by content and profile."""
    found: dict[tuple[str, str], list[str]] = {}
    for path in stored:
        if path not in present and is_gone(path_of_text(path)):
            one = stored[path]
            found.setdefault((one.sha256, one.profile_sha256), []).append(path)
    return found
