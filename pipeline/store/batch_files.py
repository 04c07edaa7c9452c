"""Writes batches of trials: one file each, whole by itself; merges small ones, and drops what newer versions replaced.

What stands in the place of other files holds all their trials but superseded ones, and names them; they are removed
when it is on the disk. So a trial is there at any moment, and whoever reads meanwhile sees it once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import READABLE, NewFile, content_of, readers_of, remove_all, remove_temporary, said_content
from pipeline.base.provenance import stamp
from pipeline.records.batch import Booleans
from pipeline.records.models import Motion
from pipeline.records.table_files import WRITING, damaged_file, metadata_of, open_table
from pipeline.records.tables import arrow_schema
from pipeline.store.storage import (
    FILE,
    TABLE,
    VERSION_COLUMNS,
    newest_versions,
    read_versions,
    trials_folder,
)

GROUP_TRIALS, GROUP_BYTES = 64, 8 << 20
"""Trials of a group of rows, and bytes of their samples, at most: one trial is read by reading its group."""

READING_BYTES = 24
"""Bytes of a sample in memory: time, command, position."""

_REPEATED = [
    *(field.name for field in arrow_schema("trials") if pa.types.is_string(field.type)),
    *("time_s.list.element", "position.list.element"),
]
"""Columns of words, times and quantised positions, which repeat; a dictionary of others takes time for nothing."""

MOST_SMALL = 8
"""Batches of like size that an experiment may have. The eighth makes one batch of them, which is of the next size: a
trial is rewritten once for each factor of eight, and n batches of one trial become some 7 log8 n."""

LARGE_TRIALS, LARGE_BYTES = 2048, 256 << 20
"""Trials, or bytes of the file, from which on an ingest leaves a batch alone."""


class NewBatch:
    """A batch of one device, experiment and motion that grows group by group and is then made visible.

    Parameters
    ----------
    processed : Path
    device, experiment : str
    motion : {"translation", "rotation"}
    mode : int
        Who may read it: who may read all logs that it holds trials of.
    replaces : collection of Path
        Files in the place of which it stands.
    """

    def __init__(
        self,
        processed: Path,
        device: str,
        experiment: str,
        motion: Motion,
        mode: int = READABLE,
        replaces: Collection[Path] = (),
    ) -> None:
        names = " ".join(sorted(file.stem for file in replaces))
        metadata = stamp(device=device, experiment=experiment, motion=motion, replaces=names)
        self.schema = arrow_schema("trials", rotation=motion == "rotation", metadata=metadata)
        self._file = NewFile(trials_folder(processed, device, experiment), "batch", mode)
        self._writer = pq.ParquetWriter(self._file.stream, self.schema, use_dictionary=_REPEATED, **WRITING)
        self._waiting: list[pa.Table] = []
        self._size = np.zeros(2, dtype=np.int64)
        """Trials that wait, and bytes of their samples."""

    def write(self, trials: pa.Table) -> None:
        """Append trials, at most a group of them; they come to the disk in groups."""
        size = np.array([trials.num_rows, READING_BYTES * trials.column("rows").to_numpy().sum()])
        if (self._size + size > (GROUP_TRIALS, GROUP_BYTES)).any():
            self._write_group()
        self._waiting.append(trials)
        self._size = self._size + size

    def _write_group(self) -> None:
        if self._waiting:
            group = pa.concat_tables(self._waiting).replace_schema_metadata(self.schema.metadata)
            self._writer.write_table(group.cast(self.schema) if group.schema != self.schema else group)
        self._waiting, self._size = [], np.zeros(2, dtype=np.int64)

    def publish(self) -> Path:
        """Make the batch visible and return its file."""
        self._write_group()
        self._writer.close()
        return self._file.publish(ending=TABLE)

    def discard(self) -> None:
        """Remove what was written, if it was not made visible."""
        self._file.discard()
        if self._writer.is_open:
            # the end of a file that nobody wants
            self._writer.is_open = False


def rewrite(processed: Path, files: Sequence[Path], kept: Mapping[Path, Booleans] | None = None) -> Path | None:
    """Write the trials of some files of an experiment and motion into one that stands in their place.

    Parameters
    ----------
    processed : Path
    files : sequence of Path
    kept : mapping of Path to bool, shape (trials,), optional
        Which trials of a file are kept; by default all.

    Returns
    -------
    Path or None
        The new file; None where nothing is kept.

    Raises
    ------
    StoreError
        If a file is damaged; then nothing is changed.
    """
    masks = kept or {}
    for file in files:
        if said_content(file.name) not in (None, content_of(file)):
            raise damaged_file(file, "its content is not that of its name")
    path = None
    if any(file not in masks or masks[file].any() for file in files):
        told = metadata_of(pq.read_schema(files[0]))
        place = told["pipeline.device"], told["pipeline.experiment"], cast(Motion, told["pipeline.motion"])
        mode = READABLE
        for file in files:
            mode &= readers_of(file.stat().st_mode)
        new = NewBatch(processed, *place, mode, files)
        try:
            for file in files:
                copy(file, masks.get(file), new)
            path = new.publish()
        finally:
            new.discard()
    remove_all(file for file in files if file != path)
    return path


def copy(file: Path, kept: Booleans | None, new: NewBatch) -> None:
    """Append trials of a file to a batch, by default all; group by group, so that memory does not grow with it."""
    first = 0
    with open_table(file) as stored:
        for number in range(stored.num_row_groups):
            rows = stored.metadata.row_group(number).num_rows
            some = None if kept is None else kept[first : first + rows]
            first += rows
            if some is None or some.any():
                group = stored.read_row_group(number, use_threads=False)
                new.write(group if some is None or some.all() else group.filter(pa.array(some)))


def tidy(
    processed: Path,
    removed: Collection[tuple[str, str, str]] = (),
    read: tuple[pa.Table, Sequence[Path], Sequence[Path]] | None = None,
) -> None:
    """Remove what interrupted writers left, replaced files, and former versions of trials; hold the lock.

    Damaged files are left alone; `check` tells of them.

    Parameters
    ----------
    processed : Path
    removed : collection of (source_path, trial_id, profile_sha256)
        Trials that go although no newer version is stored: what stood there is now that of another log.
    read : optional
        What `read_versions` has read of all since the lock was taken.
    """
    for name in ("trials", "quarantine", "corrections"):
        remove_temporary(processed / name, deep=True)
    table, files, replaced = read or read_versions(processed, None, None, list(VERSION_COLUMNS), {})
    remove_all(replaced)
    keep = newest_versions(table)
    if removed:
        names = ("source_path", "trial_id", "profile_sha256")
        keys = zip(*(table.column(name).to_pylist() for name in names), strict=True)
        keep &= np.array([key not in removed for key in keys], dtype=np.bool_)
    if keep.all():
        return
    owner = table.column(FILE).to_numpy()
    masks = {files[index]: keep[owner == index] for index in np.unique(owner).tolist()}
    pending = {file for file, mask in masks.items() if not mask.all()}
    for tied in _tied(table, files, keep):
        rewrite(processed, tied, masks)
        pending -= set(tied)
    for file in sorted(pending):
        rewrite(processed, [file], masks)


def _tied(table: pa.Table, files: Sequence[Path], keep: Booleans) -> list[list[Path]]:
    """Return files that hold the very same version of a trial, those of an experiment together.

    Two writers on an object store may have merged the same files. Which of the results goes, each might decide in
    another way; one that stands in the place of both loses nothing.
    """
    versions = list(zip(*(table.column(name).to_pylist() for name in ("trial_id", "version")), strict=True))
    owner = table.column(FILE).to_pylist()
    kept = {versions[row]: owner[row] for row in np.flatnonzero(keep).tolist()}
    found: dict[Path, set[Path]] = defaultdict(set)
    for row in np.flatnonzero(~keep).tolist():
        if versions[row] in kept and kept[versions[row]] != owner[row]:
            found[files[owner[row]].parent] |= {files[owner[row]], files[kept[versions[row]]]}
    return [sorted(group) for group in found.values()]


@dataclass(frozen=True)
class _Batch:
    """A file of trials, and what it may be merged by."""

    file: Path
    trials: int
    bytes: int
    kind: tuple[str, int]
    """Motion, and who may read it."""


def _batches(folder: Path) -> list[_Batch]:
    found = []
    for file in sorted(folder.glob(f"*{TABLE}")):
        with open_table(file) as stored:
            status = file.stat()
            kind = metadata_of(stored.schema_arrow).get("pipeline.motion", ""), readers_of(status.st_mode)
            found.append(_Batch(file, stored.metadata.num_rows, status.st_size, kind))
    return found


def merge_small(processed: Path, folder: Path) -> None:
    """Merge small batches of like size, if an experiment has many; the caller holds the lock."""
    while len(list(folder.glob(f"*{TABLE}"))) >= MOST_SMALL:
        tiers: dict[tuple[Any, int], list[_Batch]] = defaultdict(list)
        for batch in _batches(folder):
            if batch.trials < LARGE_TRIALS and batch.bytes < LARGE_BYTES:
                tiers[batch.kind, int(np.log(batch.trials) / np.log(MOST_SMALL) + 1e-9)].append(batch)
        full = next((batches for batches in tiers.values() if len(batches) >= MOST_SMALL), None)
        if full is None:
            return
        rewrite(processed, [batch.file for batch in full])
