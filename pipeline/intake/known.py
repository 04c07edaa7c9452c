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
from pipeline.store.batch_files import drop
from pipeline.store.storage import VERSION_COLUMNS, newest_versions, read_versions


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
        columns = ["source_size", "source_trials", "device", "experiment", "sampling_period_s", "profile", "claims"]
        self.table, self.files, self.replaced = read_versions(
            processed, None, None, [*columns, *VERSION_COLUMNS], damaged
        )
        self.processed, self.claims = processed, claims
        self._newest = newest_versions(self.table)
        self._columns: dict[str, list[Any]] = {}
        paths = self._column("source_path")
        rows = np.flatnonzero(self._newest).tolist()
        self._last: dict[str, int] = {paths[row]: row for row in rows}
        # of sources with several trials alone: a list for each of 100,000 takes longer than all else
        self._several: dict[str, list[int]] = {}
        if len(self._last) < len(rows):
            for row in rows:
                self._several.setdefault(paths[row], []).append(row)

    @property
    def latest(self) -> int:
        """Highest version."""
        return int(np.max(self.table.column("version").to_numpy(), initial=0))

    def tidy(self) -> bool:
        """Drop former versions that an interrupted writer left; return whether there were any."""
        if self._newest.all():
            return False
        drop(self.processed, self.table, self.files, ())
        return True

    @property
    def states(self) -> dict[str, tuple[int, int]]:
        """Size [byte] and time [ns] of each source that is one file, stored as a whole, of a profile that is sure."""
        names = ("claims", "source_size", "source_mtime_ns", "source_trials")
        claims, sizes, times, trials = map(self._column, names)
        return {
            path: (sizes[row], times[row])
            for path, row in self._last.items()
            if claims[row] == self.claims
            and (trials[row] == 1 or self._is_whole(path, row))
            and not path.endswith(ENDINGS)
        }

    def __getitem__(self, path: str) -> StoredSource:
        last = self._last[path]
        rows = self._several.get(path, (last,))
        names = ("source_sha256", "profile_sha256", "profile", "source_size", "source_mtime_ns")
        sha256, profile_sha256, profile, size, mtime_ns = (self._column(name)[last] for name in names)
        devices, trials = (tuple(self._column(name)[row] for row in rows) for name in ("device", "trial_id"))
        whole = self._is_whole(path, last)
        return StoredSource(sha256, profile_sha256, profile, size, mtime_ns, devices, trials, whole)

    def __iter__(self) -> Iterator[str]:
        return iter(self._last)

    def __len__(self) -> int:
        return len(self._last)

    def _is_whole(self, path: str, last: int) -> bool:
        trials: int = self._column("source_trials")[last]
        return trials == 1 or len(self._several.get(path, (last,))) >= trials

    def _column(self, name: str) -> list[Any]:
        if name not in self._columns:
            self._columns[name] = self.table.column(name).to_pylist()
        return self._columns[name]

    def places(self, but: set[str]) -> Places:
        """Return where contents and trials are stored as a whole, but those of some sources."""
        contents, trials = self._column("source_sha256"), self._column("trial_id")
        known = {path: row for path, row in self._last.items() if path not in but and self._is_whole(path, row)}
        rows = {row: path for path, row in known.items()}
        several = {row: path for path, own in self._several.items() if path in known for row in own}
        return Places(
            {contents[row]: path for path, row in known.items()},
            {trials[row]: path for row, path in (rows | several).items()},
        )


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
