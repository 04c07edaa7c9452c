"""Merges batches: a few at the end of an ingest, all of an experiment by `pipeline compact`.

The merged batch is visible before those that it replaces are removed. Between the two each trial stands in two files,
and `storage.read_trials` returns it once; after an interruption there the next writer removes the former ones
(`versions.repair`). Samples are copied group by group, so that memory does not grow with an experiment.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import remove, sync_folder
from pipeline.base.errors import StoreError
from pipeline.base.json_seal import DamageError
from pipeline.base.lock import WAIT_S, writing
from pipeline.base.seal import verify
from pipeline.intake.versions import repair
from pipeline.records.findings import Record
from pipeline.records.models import Motion
from pipeline.records.table_files import GROUP_ROWS, damaged_file, read_table
from pipeline.records.tables import TABLES
from pipeline.store.batch_files import NewBatch, next_number, remove_batches, trials_copy
from pipeline.store.storage import (
    list_devices,
    list_experiments,
    partner_of,
    read_versions,
    samples_metadata,
    steadily,
    trials_files,
)
from pipeline.store.working_copy import bring, publish, remove_objects, unused_objects

MOST_SMALL = 8
"""Small batches of like size that an experiment may have. The eighth makes one batch of them, which is of the next
size: a trial is rewritten once for each factor of eight, and n batches of one trial become some 8 log8 n."""

LARGE_ROWS = 1 << 18
"""Rows from which on an ingest leaves a batch alone, some 260 logs of 1,000 rows. One more log rewrites eight batches
just below this size at most: 2 million rows, 13 MB of a usual course, and 50 MB where nothing can be packed."""


class ExperimentMerge(Record):
    """Batches of an experiment that are merged into one, and the bytes of their files before and after.

    ``bytes_after`` is None where nothing was written.
    """

    device: str
    experiment: str
    batches: int
    trials: int
    bytes_before: int
    bytes_after: int | None


class CompactReport(Record):
    """What `compact` did, or would do: merged experiments, and samples files that no trial names."""

    merged: tuple[ExperimentMerge, ...]
    orphans: tuple[str, ...]
    orphan_bytes: int


@dataclass(frozen=True)
class _Batch:
    """A visible batch: its trials file, its samples files, and rows that these hold of it."""

    trials: Path
    motion: Motion
    samples: tuple[Path, ...]
    rows: int

    @property
    def bytes(self) -> int:
        """Size of its files."""
        return sum(path.stat().st_size for path in (self.trials, *self.samples) if path.is_file())


def compact(
    processed: Path, dry_run: bool = False, wait_s: float = WAIT_S, say: Callable[[str], None] | None = None
) -> CompactReport:
    """Merge all batches of each experiment into one, and remove samples that no trial names.

    Each file is held against its checksums before it is merged. An experiment with a damaged one is left as it is, and
    named when all others are done.

    Parameters
    ----------
    processed : Path
    dry_run : bool
        Only say what would be done.
    wait_s : float
        How long to wait for another command that writes to `processed` [s].
    say : callable, optional
        Gets a line when waiting begins.

    Returns
    -------
    CompactReport

    Raises
    ------
    StoreError
        If a file is damaged or cannot be written, or another command writes there. What could be read is stored still.
    """
    if dry_run:
        return steadily(processed, lambda: _compacted(processed, dry_run=True))
    try:
        with writing(processed, wait_s, say):
            repair(processed)
            return _compacted(processed, dry_run=False)
    except OSError as error:
        raise StoreError(
            f"{processed}: cannot be written ({error}). All trials are still stored; make room (as much as the largest "
            "experiment takes) or correct the permissions and run the command again."
        ) from error


def _compacted(processed: Path, dry_run: bool) -> CompactReport:
    merged: list[ExperimentMerge] = []
    faults = []
    for device in list_devices(processed):
        for experiment in list_experiments(processed, device):
            try:
                for batches in _by_motion(_batches(processed, device, experiment)):
                    # a lone batch with samples of removed trials is written anew without them
                    if len(batches) > 1 or _has_gaps(processed, batches[0]):
                        merged.append(_merge_reported(processed, device, experiment, batches, dry_run))
                        if not dry_run:
                            publish(processed)
            except StoreError as error:
                faults.append(str(error))
    if faults:
        raise StoreError("\n".join(faults))
    orphans = find_orphans(processed)
    unused = unused_objects(processed)
    size = sum(orphan.stat().st_size for orphan in orphans) + sum(unused.values())
    if not dry_run:
        remove_objects(processed, unused)
        for orphan in orphans:
            remove(orphan)
        for folder in sorted({orphan.parent for orphan in orphans}):
            sync_folder(folder)
    names = (*(orphan.relative_to(processed).as_posix() for orphan in orphans), *unused)
    return CompactReport(merged=tuple(merged), orphans=names, orphan_bytes=size)


def merge_small(processed: Path, device: str, experiment: str) -> None:
    """Merge small batches of like size, if an experiment has many; the caller holds the lock."""
    while len(trials_files(processed, device, experiment)) >= MOST_SMALL:
        tiers: dict[tuple[Motion, int], list[_Batch]] = defaultdict(list)
        for batch in _batches(processed, device, experiment):
            if batch.rows < LARGE_ROWS:
                tiers[batch.motion, _tier(batch.rows)].append(batch)
        full = next((batches for batches in tiers.values() if len(batches) >= MOST_SMALL), None)
        if full is None:
            return
        _merge(processed, device, experiment, full)


def find_orphans(processed: Path) -> list[Path]:
    """Return the samples files that no trials file names and that hold nothing else: an interrupted writer left them.

    One whose trials are stored nowhere else is none: its trials file was lost, or not yet written.
    """
    # listed first: what a writer makes visible meanwhile is no orphan
    files = sorted((processed / "samples").rglob("*.parquet"))
    alone = [file for file in files if not partner_of(file).exists() and file.exists()]
    if not alone:
        return []
    table, _ = read_versions(processed, None, None, ["sample_file", "trial_id", "source_path"], {})
    named = set(table.column("sample_file").unique().to_pylist())
    alone = [file for file in alone if file.relative_to(processed).as_posix() not in named]
    return [file for file in alone if _holds_nothing_else(file, table)]


def _holds_nothing_else(samples: Path, stored: pa.Table) -> bool:
    try:
        # one of an earlier version does not tell what it holds
        return not verify(samples) or unseen_trials(samples, stored) is None
    except DamageError:
        return False


def unseen_trials(samples: Path, stored: pa.Table) -> pa.Table | None:
    """Return the trials of a samples file without a trials file that are not stored otherwise, None where none is."""
    copy = trials_copy(samples)
    if copy is None:
        return None
    unseen = pa.array(~np.logical_or(*(_among(copy, stored, name) for name in ("trial_id", "source_path"))))
    return copy.filter(unseen) if unseen.true_count else None


def _among(table: pa.Table, other: pa.Table, name: str) -> np.ndarray:
    """Return which values of a column stand in that of another table."""
    return np.isin(table.column(name).to_pylist(), other.column(name).to_pylist())


def _tier(rows: int) -> int:
    """Return the class of size of a batch: as many batches of a class as may not be make one of a higher class."""
    tier = 0
    while rows >= MOST_SMALL ** (tier + 1):
        tier += 1
    return tier


def _batches(processed: Path, device: str, experiment: str) -> list[_Batch]:
    found = []
    for file in trials_files(processed, device, experiment):
        table = read_table(file, ["motion", "sample_file", "rows"])
        motion = table.column("motion")[0].as_py()
        # `unique` would import what takes longer than all else here
        samples = tuple(processed / name for name in sorted(set(table.column("sample_file").to_pylist())))
        rows = int(np.sum(table.column("rows").to_numpy()))
        # one file, one motion: its metadata state the units
        found.append(_Batch(file, cast(Motion, motion), samples, rows))
    return found


def _by_motion(batches: Sequence[_Batch]) -> Iterator[list[_Batch]]:
    for motion in sorted({batch.motion for batch in batches}):
        yield [batch for batch in batches if batch.motion == motion]


def _has_gaps(processed: Path, batch: _Batch) -> bool:
    _bring(processed, [batch])
    stored = sum(int(samples_metadata(path).num_rows) for path in batch.samples)
    return stored > batch.rows


def _bring(processed: Path, batches: Sequence[_Batch]) -> None:
    bring(processed, [path.relative_to(processed).as_posix() for batch in batches for path in batch.samples])


def _merge_reported(
    processed: Path, device: str, experiment: str, batches: Sequence[_Batch], dry_run: bool
) -> ExperimentMerge:
    trials = sum(pq.read_metadata(batch.trials).num_rows for batch in batches)
    _bring(processed, batches)
    before = sum(batch.bytes for batch in batches)
    after = None
    if not dry_run:
        target = _merge(processed, device, experiment, batches)
        samples = processed / "samples" / target.relative_to(processed / "trials")
        after = target.stat().st_size + samples.stat().st_size
    return ExperimentMerge(
        device=device,
        experiment=experiment,
        batches=len(batches),
        trials=trials,
        bytes_before=before,
        bytes_after=after,
    )


def _merge(processed: Path, device: str, experiment: str, batches: Sequence[_Batch]) -> Path:
    new = NewBatch(processed, device, experiment, batches[0].motion)
    try:
        _bring(processed, batches)
        copier = _Copier(new)
        tables = []
        for file in (file for batch in batches for file in batch.samples):
            _verify(file)
        for batch in batches:
            table = read_table(batch.trials).replace_schema_metadata(None)
            for file in batch.samples:
                name = file.relative_to(processed).as_posix()
                own = [row for row, other in enumerate(table.column("sample_file").to_pylist()) if other == name]
                tables.append(copier.copy(file, table.take(pa.array(own))))
        copier.finish()
        trials = pa.concat_tables(tables)
        columns = {name: trials.column(name) for name in TABLES["trials"] if name != "sample_file"}
        path = new.publish(columns, next_number(processed))
        # nothing is removed before what replaces it was read from the disk
        _verify(path)
        _verify(partner_of(path))
    except BaseException:
        new.discard()
        raise
    remove_batches(processed, [batch.trials for batch in batches])
    return path


class _Copier:
    """Copies samples of trials from several files into one; small groups are joined."""

    def __init__(self, new: NewBatch) -> None:
        self.new = new
        self.pending: list[pa.Table] = []
        self.rows = 0

    def copy(self, file: Path, trials: pa.Table) -> pa.Table:
        """Append the samples of trials of a file; return the trials in order of rows, with their new first row."""
        trials = trials.sort_by("first_row")
        first = trials.column("first_row").to_numpy().astype(np.int64)
        rows = trials.column("rows").to_numpy().astype(np.int64)
        at = trials.schema.get_field_index("first_row")
        begin = self.new.rows + self.rows
        moved = trials.set_column(at, trials.schema.field(at), pa.array(begin + np.cumsum(rows) - rows))
        taken = 0
        for position, group in _groups(file):
            kept = _kept(position, group.num_rows, first, rows)
            if kept.any():
                self._append(group if kept.all() else group.filter(pa.array(kept)))
                taken += int(kept.sum())
        if taken != int(rows.sum()):
            raise damaged_file(file, "it is shorter than its trials say")
        return moved

    def finish(self) -> None:
        """Write what is left."""
        if self.pending:
            self.new.write(pa.concat_tables(self.pending))
        self.pending, self.rows = [], 0

    def _append(self, samples: pa.Table) -> None:
        self.pending.append(samples)
        self.rows += samples.num_rows
        if self.rows >= GROUP_ROWS:
            self.finish()


def _groups(file: Path) -> Iterator[tuple[int, pa.Table]]:
    """Yield each group of a samples file with the number of its first row."""
    position = 0
    try:
        with pq.ParquetFile(file, page_checksum_verification=True) as source:
            for group in range(source.num_row_groups):
                table = source.read_row_group(group, use_threads=False)
                yield position, table
                position += table.num_rows
    except (pa.ArrowException, OSError) as error:
        raise damaged_file(file, error) from error


def _verify(file: Path) -> None:
    try:
        verify(file)
    except (DamageError, OSError) as error:
        raise damaged_file(file, error) from error


def _kept(position: int, count: int, first: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return which of ``count`` rows of a file from ``position`` on belong to trials."""
    edges = np.zeros(count + 1, dtype=np.int64)
    begin = np.clip(first - position, 0, count)
    end = np.clip(first + rows - position, 0, count)
    np.add.at(edges, begin, 1)
    np.add.at(edges, end, -1)
    return np.cumsum(edges[:-1]) > 0
