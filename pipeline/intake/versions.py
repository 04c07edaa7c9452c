"""Which version of a source is stored, and the removal of former ones."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Set
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from pipeline.base.disk import TEMPORARY_ENDING, remove, remove_temporary
from pipeline.base.seal import read_annex
from pipeline.intake.rerun import NOTE_FILE
from pipeline.records.table_files import read_table, write_table
from pipeline.store.batch_files import remove_batches
from pipeline.store.storage import FILE, VERSION_COLUMNS, newest_versions, read_versions

_CONTENT = ("source_sha256", "profile_sha256")


class StoredSource(NamedTuple):
    """What is stored of a source.

    Parameters
    ----------
    sha256, profile_sha256, size, mtime_ns
        Content, profile, size [byte] and modification time [ns] when it was read.
    trials : frozenset of str
        Ids of its trials.
    whole : bool
        Whether these are all that the source holds: an interrupted run may have written some of them.
    devices : frozenset of str
    profile : str
        Name of the profile.
    """

    sha256: str
    profile_sha256: str
    size: int
    mtime_ns: int
    trials: frozenset[str]
    whole: bool
    devices: frozenset[str]
    profile: str

    def keys(self, path: str) -> set[tuple[str, str, str]]:
        """Return its trials as `drop_superseded` takes them."""
        return {(path, trial, self.profile_sha256) for trial in self.trials}


class StoredSources(Mapping[str, StoredSource]):
    """What is stored of each source, by its path; a record is made when it is asked for, of 100,000 hardly any.

    `damaged` is as for `storage.read_trials`.
    """

    def __init__(self, processed: Path, damaged: dict[Path, str] | None = None) -> None:
        columns = ["source_trials", "source_size", "device", "profile", *VERSION_COLUMNS]
        self._table, _ = read_versions(processed, None, None, columns, damaged)
        self._columns: dict[str, list[Any]] = {}
        paths = self._column("source_path")
        rows = np.flatnonzero(newest_versions(self._table)).tolist()
        self._last: dict[str, int] = {paths[row]: row for row in rows}
        # of sources with several trials alone: a list for each of 100,000 takes longer than all else
        self._several: dict[str, list[int]] = {}
        if len(self._last) < len(rows):
            for row in rows:
                self._several.setdefault(paths[row], []).append(row)

    def __getitem__(self, path: str) -> StoredSource:
        last = self._last[path]
        names = (*_CONTENT, "source_size", "source_mtime_ns")
        sha256, profile_sha256, size, mtime_ns = (self._column(name)[last] for name in names)
        rows = self._several.get(path, (last,))
        trials, devices = (frozenset(self._column(name)[row] for row in rows) for name in ("trial_id", "device"))
        profile: str = self._column("profile")[last]
        return StoredSource(
            sha256, profile_sha256, size, mtime_ns, trials, self._is_whole(path, last), devices, profile
        )

    def __iter__(self) -> Iterator[str]:
        return iter(self._last)

    def __len__(self) -> int:
        return len(self._last)

    def whole(self, but: Set[str], identity: Callable[[str, str, str], str]) -> tuple[dict[str, str], dict[str, str]]:
        """Return path and profile's hash of all sources but some that are stored as a whole, by what they are.

        ``identity`` is called with the hashes of content and profile, and the path.
        """
        contents, profiles = map(self._column, _CONTENT)
        rows = {path: row for path, row in self._last.items() if path not in but and self._is_whole(path, row)}
        ones = {identity(contents[row], profiles[row], path): (path, profiles[row]) for path, row in rows.items()}
        return {one: path for one, (path, _) in ones.items()}, {one: profile for one, (_, profile) in ones.items()}

    def _is_whole(self, path: str, last: int) -> bool:
        trials: int = self._column("source_trials")[last]
        return trials == 1 or len(self._several.get(path, (last,))) >= trials

    def _column(self, name: str) -> list[Any]:
        if name not in self._columns:
            self._columns[name] = self._table.column(name).to_pylist()
        return self._columns[name]


def why_ingested(former: StoredSource | None, sha256: str, profile_sha256: str) -> str:
    """Return why a source with this content and profile is stored anew, by what was stored of it before."""
    if former is None:
        return "new"
    if former.sha256 != sha256:
        return "content changed"
    return "profile changed" if former.profile_sha256 != profile_sha256 else "stored in part, by an interrupted run"


def repair(processed: Path, superseded: bool = True) -> None:
    """Finish what an interrupted writer left: remove its incomplete files and the superseded trials; hold the lock.

    Damaged files are left alone; `check` tells of them.

    Parameters
    ----------
    processed : Path
    superseded : bool
        Whether there may be superseded trials: not where the store is as an ingest left it that came to its end.
    """
    for name in ("trials", "samples", "quarantine"):
        remove_temporary(processed / name)
    for note in processed.glob(f".{NOTE_FILE}.*{TEMPORARY_ENDING}"):
        remove(note)
    if superseded:
        table, files = read_versions(processed, None, None, list(VERSION_COLUMNS), {})
        _drop(processed, files, table.column(FILE).to_numpy(), ~newest_versions(table))


def drop_superseded(processed: Path, replaced: Collection[tuple[str, str, str]]) -> None:
    """Remove former versions of trials whose source or profile has changed; hold the lock.

    Parameters
    ----------
    processed : Path
    replaced : collection of (source_path, trial_id, profile_sha256)
        Rows to remove; samples that share a file with others stay behind, nothing names them.
    """
    if not replaced:
        return
    names = ("source_path", "trial_id", "profile_sha256")
    table, files = read_versions(processed, None, None, list(VERSION_COLUMNS), {})
    keys = zip(*(table.column(name).to_pylist() for name in names), strict=True)
    _drop(processed, files, table.column(FILE).to_numpy(), np.array([key in replaced for key in keys], dtype=np.bool_))


def _drop(processed: Path, files: list[Path], owner: np.ndarray, dropped: np.ndarray) -> None:
    """Rewrite the trials files that hold rows to be dropped, and remove those of which nothing is left."""
    for index in np.unique(owner[dropped]).tolist():
        keep = ~dropped[owner == index]
        if keep.any():
            with open(files[index], "rb") as stream:
                annex = read_annex(stream)
            write_table(files[index], read_table(files[index]).filter(pa.array(keep)), annex)
        else:
            remove_batches(processed, [files[index]])
