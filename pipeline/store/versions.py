"""Which version of a source is stored, and the removal of former ones."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.base.disk import remove_temporary
from pipeline.base.seal import read_annex
from pipeline.records.tables import read_table, write_table
from pipeline.store.batch_files import remove_batches
from pipeline.store.storage import FILE, VERSION_COLUMNS, newest_versions, read_versions


@dataclass(frozen=True)
class StoredSource:
    """What is stored of a source.

    Parameters
    ----------
    sha256, size, mtime_ns, profile_sha256
        Content, size [byte], modification time [ns] and profile when it was read.
    trials : frozenset of str
        Ids of its trials.
    whole : bool
        Whether these are all that the source holds: an interrupted run may have written some of them.
    """

    sha256: str
    size: int
    mtime_ns: int
    profile_sha256: str
    trials: frozenset[str]
    whole: bool

    def keys(self, path: str) -> set[tuple[str, str, str]]:
        """Return its trials as `drop_superseded` takes them."""
        return {(path, trial, self.profile_sha256) for trial in self.trials}


def stored_sources(processed: Path, damaged: dict[Path, str] | None = None) -> dict[str, StoredSource]:
    """Return what is stored of each source, by its path; `damaged` as for `storage.read_trials`."""
    columns = ["source_trials", "source_size", *VERSION_COLUMNS]
    table, _ = read_versions(processed, None, None, columns, damaged)
    newest = newest_versions(table)
    names = ("source_path", "trial_id", "source_sha256", "source_size", "source_mtime_ns", "profile_sha256")
    trials: dict[str, set[str]] = defaultdict(set)
    values: dict[str, tuple[str, int, int, str, int]] = {}
    columns_of = (table.column(name).to_pylist() for name in (*names, "source_trials"))
    for keep, path, trial, *rest in zip(newest.tolist(), *columns_of, strict=True):
        if not keep:
            continue
        trials[path].add(trial)
        values[path] = tuple(rest)
    return {
        path: StoredSource(sha256, size, mtime_ns, profile, frozenset(trials[path]), len(trials[path]) >= count)
        for path, (sha256, size, mtime_ns, profile, count) in values.items()
    }


def why_ingested(former: StoredSource | None, sha256: str, profile_sha256: str) -> str:
    """Return why a source with this content and profile is stored anew, by what was stored of it before."""
    if former is None:
        return "new"
    if former.sha256 != sha256:
        return "content changed"
    return "profile changed" if former.profile_sha256 != profile_sha256 else "stored in part, by an interrupted run"


def repair(processed: Path) -> None:
    """Finish what an interrupted writer left: remove its incomplete files and the superseded trials; hold the lock.

    Damaged files are left alone; `check` tells of them.
    """
    for name in ("trials", "samples", "quarantine"):
        remove_temporary(processed / name)
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
