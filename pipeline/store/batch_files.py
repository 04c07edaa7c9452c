"""Functions that write batch files, merge small ones, and remove outdated trials. A file contains trials of a single
experiment. The metadata of a replacement list the replaced files, which are deleted once the replacement is on disk. A
reader skips replaced files, so it sees each trial exactly once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import (
    READABLE,
    file_hash,
    hash_in_name,
    make_folder,
    map_in_threads,
    new_file,
    readers_of,
    remove_all,
    remove_temporary,
)
from pipeline.base.errors import StoreError
from pipeline.base.provenance import stamp
from pipeline.records.findings import Motion
from pipeline.records.table_files import WRITING, damaged_file, metadata_of, open_table
from pipeline.records.tables import arrow_schema
from pipeline.records.trials import Booleans
from pipeline.store.storage import TABLE, VERSION_COLUMNS, Rows, read_rows, row_parts, trials_folder

GROUP_TRIALS, GROUP_BYTES = 64, 8 << 20
"""Largest number of trials in a row group, and of bytes of their samples. To read a trial, its entire group must be
read."""

READING_BYTES = 24
"""Size of a sample in memory [byte]. A sample consists of time, command and position."""

_REPEATED = [
    *(field.name for field in arrow_schema("trials") if pa.types.is_string(field.type)),
    *("time_s.list.element", "position.list.element"),
]
"""Columns with repeated values (text, times, quantised positions). A dictionary encoding saves space."""

MOST_SMALL = 8
"""Number of batches of similar size that are merged into one batch of the next size.

A trial is rewritten once for each factor of eight in size, and n batches of one trial become about 7 log8 n batches.
"""

OPEN_FILES = 8
"""Number of files written in parallel. Each recording may be a separate experiment, and the number of open files is
limited."""

LARGE_TRIALS, LARGE_BYTES = 2048, 256 << 20
"""Largest number of trials, and largest size of the file [byte], of a batch that ingest merges."""


Key = tuple[str, str, str]
KEY_COLUMNS = ("source_path", "trial_id", "profile_sha256")
"""Columns that identify a trial as it was read: its id, the path of its log, and the SHA-256 of the profile."""


class ExperimentKey(NamedTuple):
    """Properties that all trials of a file share. `mode` grants read access to users who may read all of its logs."""

    device: str
    experiment: str
    motion: Motion
    mode: int = READABLE


def key_of_file(file: Path) -> ExperimentKey:
    """Return the properties that all trials of a file share."""
    with open_table(file) as stored:
        metadata = metadata_of(stored.schema_arrow)
    motion = cast(Motion, metadata["pipeline.motion"])
    return ExperimentKey(
        metadata["pipeline.device"], metadata["pipeline.experiment"], motion, readers_of(file.stat().st_mode)
    )


def write_batch(
    processed: Path, place: ExperimentKey, parts: Iterable[pa.Table], replaces: Collection[Path] = ()
) -> Path | None:
    """Write trials into one file that replaces other files, and remove the replaced files.

    Parameters
    ----------
    processed : Path
    place : ExperimentKey
    parts : iterable of pyarrow.Table
        Trials in tables of at most one row group. The tables are written one by one to limit memory.
    replaces : collection of Path

    Returns
    -------
    Path or None
        The new file, or None if there are no trials.
    """
    names = " ".join(sorted(file.stem for file in replaces))
    metadata = stamp(device=place.device, experiment=place.experiment, motion=place.motion, replaces=names)
    schema = arrow_schema("trials", motion=place.motion, metadata=metadata)
    groups, path = _groups(parts), None
    if (first := next(groups, None)) is not None:
        folder = trials_folder(processed, place.device, place.experiment)
        with (
            new_file(folder, ending=TABLE, mode=place.mode) as new,
            pq.ParquetWriter(new.stream, schema, use_dictionary=_REPEATED, **WRITING) as writer,
        ):
            for group in chain([first], groups):
                writer.write_table(group.cast(schema) if group.schema != schema else group)
        path = new.path
    remove_all(file for file in replaces if file != path)
    return path


def _groups(parts: Iterable[pa.Table]) -> Iterator[pa.Table]:
    waiting, size = list[pa.Table](), np.zeros(2, dtype=np.int64)
    for part in parts:
        more = np.array([part.num_rows, READING_BYTES * part.column("rows").to_numpy().sum()])
        if waiting and (size + more > (GROUP_TRIALS, GROUP_BYTES)).any():
            yield pa.concat_tables(waiting)
            waiting, size = [], 0 * size
        waiting.append(part.replace_schema_metadata(None))
        size = size + more
    if waiting:
        yield pa.concat_tables(waiting)


def trials_of(file: Path, kept: Booleans | None = None) -> Iterator[pa.Table]:
    """Yield the trials of a file with their samples, group by group. By default, all trials are read."""
    return (part for _, part in row_parts(file, None if kept is None else np.flatnonzero(kept)))


def find_damaged(files: Iterable[Path]) -> dict[Path, str]:
    """Return the files whose content does not match the hash in their name, each with its fault and the remedy."""
    bad = [file for file in files if hash_in_name(file.name) not in (None, file_hash(file))]
    return {file: str(damaged_file(file, "its content does not match the hash in its name")) for file in bad}


def rewrite(processed: Path, files: Sequence[Path], kept: Mapping[Path, Booleans] | None = None) -> Path | None:
    """Write trials of several files into one file, which replaces them. By default, all trials are kept.

    The files must have the same experiment and motion.
    ------
    StoreError
        If a file is damaged. In this case, no file is changed.
    """
    for text in find_damaged(files).values():
        raise StoreError(text)
    places = [key_of_file(file) for file in files]
    mode = READABLE
    for place in places:
        mode &= place.mode
    parts = chain.from_iterable(trials_of(file, (kept or {}).get(file)) for file in files)
    return write_batch(processed, places[0]._replace(mode=mode), parts, files)


def remaining_rows(rows: Rows, keep: Booleans) -> dict[Path, Booleans]:
    """Return a mask of the remaining rows for each file from which rows are removed."""
    return {rows.files[index]: keep[rows.file == index] for index in np.unique(rows.file[~keep]).tolist()}


def rows_without(processed: Path, dropped: Collection[Key], damaged: dict[Path, str]) -> dict[Path, Booleans]:
    """Return a mask of the remaining rows for each file with dropped trials. Damaged files are reported and skipped."""
    rows = read_rows(processed, KEY_COLUMNS, damaged)
    keys = zip(*map(rows.column, KEY_COLUMNS), strict=True)
    kept = remaining_rows(rows, np.array([key not in dropped for key in keys], dtype=np.bool_))
    damaged |= (bad := find_damaged(kept))
    return {file: mask for file, mask in kept.items() if file not in bad}


def store(
    processed: Path,
    batches: Mapping[ExperimentKey, Iterable[pa.Table]],
    dropped: Collection[Key],
    outdated: Collection[Key],
    damaged: dict[Path, str],
) -> set[Path]:
    """Store trials in one file for each key, drop the trials that they replace, and return the changed folders.

    If a trial stays under the same key, the file with the new trials replaces it. A trial whose key changes is dropped
    first, because it can be read again from its log. Outdated contents are dropped last. A reader that finds two
    contents of a log takes the newer one.
    """
    absorbed, later = defaultdict[ExperimentKey, list[Path]](list), list[Path]()
    first = rows_without(processed, dropped, damaged) if dropped else {}
    kept = rows_without(processed, {*dropped, *outdated}, damaged) if outdated else first
    for file in kept:
        if (place := key_of_file(file)) in batches:
            absorbed[place].append(file)
        elif file in first:
            rewrite(processed, [file], kept)
        else:
            later.append(file)
    for place in batches:  # in sequence, because the name of a folder depends on existing folders
        make_folder(trials_folder(processed, place.device, place.experiment))

    def write(place: ExperimentKey) -> Path | None:
        former = chain.from_iterable(trials_of(file, kept[file]) for file in absorbed[place])
        return write_batch(processed, place, chain(batches[place], former), absorbed[place])

    folders = {path.parent for path in map_in_threads(write, list(batches), OPEN_FILES) if path is not None}
    for file in later:
        rewrite(processed, [file], kept)
    return folders


def remove_incomplete(processed: Path) -> None:
    """Remove incomplete files of interrupted writers. The caller must have locked the store."""
    for name in ("trials", "quarantine", "corrections"):
        remove_temporary(processed / name, deep=True)


def remove_superseded(processed: Path, damaged: dict[Path, str]) -> None:
    """Remove replaced files and unused trials. The caller must have locked the store.

    Two writers on an object store may have stored or merged the same trials. If each of them then removed a different
    file, a trial could be lost. Therefore, all files that share trials are replaced by one new file. Damaged files are
    added to `damaged` and skipped.
    """
    rows = read_rows(processed, VERSION_COLUMNS, damaged)
    remove_all(rows.replaced)
    keep = rows.current
    masks, trials = remaining_rows(rows, keep), rows.column("trial_id")
    twice = {trials[row] for row in np.flatnonzero(~keep).tolist()}
    sharing = {rows.files[of] for trial, of in zip(trials, rows.file.tolist(), strict=True) if trial in twice}
    if bad := find_damaged({*masks, *sharing}):
        damaged |= bad
        remove_superseded(processed, damaged)
        return
    together = defaultdict[tuple[Path, str], list[Path]](list)
    for file in sorted({*masks, *sharing}):
        together[file.parent, key_of_file(file).motion].append(file)
    for files in together.values():
        rewrite(processed, files, masks)


def merge_small(processed: Path, folder: Path) -> None:
    """Merge small batches of similar size if an experiment has many of them. The caller must have locked the store."""
    while len(files := sorted(folder.glob(f"*{TABLE}"))) >= MOST_SMALL:
        tiers = defaultdict[tuple[ExperimentKey, int], list[Path]](list)
        for file in files:
            trials = pq.read_metadata(file).num_rows
            if trials < LARGE_TRIALS and file.stat().st_size < LARGE_BYTES:
                tiers[key_of_file(file), int(np.log(trials) / np.log(MOST_SMALL) + 1e-9)].append(file)
        full = next((alike for alike in tiers.values() if len(alike) >= MOST_SMALL), None)
        if full is None:
            return
        rewrite(processed, full)
