"""Layout of `processed/`, and how trials are read back.

    trials/<device>/<experiment>/<SHA-256>.parquet           a batch: one row a trial, its samples as lists
    stages/<device>/<experiment>/<stage>-<SHA-256>.parquet   estimates, costs, boundary
    corrections/<SHA-256>.parquet                            what was excluded, moved or deleted by hand
    quarantine/                                              logs that were refused, with the reason

Each file is whole by itself and bears the hash of its content. One that takes the place of others names them in its
metadata, so that readers, which take no lock, see each trial once: they leave out files that are replaced, and look at
the folder again where it changed while they read.
"""

from __future__ import annotations

import os
import re
import shlex
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import kept_files
from pipeline.base.errors import StoreError
from pipeline.records.batch import Booleans
from pipeline.records.table_files import damaged_file, metadata_of, open_table
from pipeline.records.tables import LOCATION, OF_TRIALS, arrow_schema
from pipeline.store.corrections import applied, moved_from, read_corrections
from pipeline.store.names import name_of_folder, place_of

Result = TypeVar("Result")

TABLE = ".parquet"

VERSION_COLUMNS = (
    "source_path",
    "trial_id",
    "source_sha256",
    "profile_sha256",
    "version",
    "source_mtime_ns",
    "formerly",
)
"""Columns that tell versions of a trial apart."""

FILE = "file_index"
"""Column that `read_versions` adds: index of the file."""

ATTEMPTS = 50
"""Times that reading starts anew because files were merged meanwhile; a merge takes longer than listing files, so that
one suffices nearly always."""

_PAUSE_S = 0.02
"""Wait before a new attempt [s], for a writer that removes many files."""


def trials_folder(processed: Path, *names: str) -> Path:
    """Return the folder with the trials of a device, or of one of its experiments."""
    return _folder(processed, "trials", *names)


def stage_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the results of an experiment."""
    return _folder(processed, "stages", device, experiment)


def stage_file(processed: Path, device: str, experiment: str, stage: str) -> Path | None:
    """Return the file that holds the result of a stage for an experiment, None where there is none."""
    return next(iter(kept_files(stage_folder(processed, device, experiment), stage, TABLE)), None)


def list_devices(processed: Path) -> list[str]:
    """Return the names of devices that have trials, sorted."""
    return sorted({device for device, _ in _places(processed)})


def list_experiments(processed: Path, device: str) -> list[str]:
    """Return the experiments of a device that have trials, sorted as people sort them (2 before 10)."""
    return sorted({experiment for of, experiment in _places(processed, device) if of == device}, key=natural_key)


def _places(processed: Path, device: str | None = None) -> set[tuple[str, str]]:
    """Return device and experiment of all trials, or of those of a device, as corrections have them."""
    if any(one.changes_place for one in read_corrections(processed).values()):
        table = read_trials(processed, device, columns=["device", "experiment"])
        return set(zip(*(table.column(name).to_pylist() for name in table.column_names), strict=True))
    root = trials_folder(processed) if device is None else trials_folder(processed, device)
    files = root.glob(f"*/*/*{TABLE}" if device is None else f"*/*{TABLE}")
    folders = {file.parent for file in files}
    return {(name_of_folder(folder.parent.name), name_of_folder(folder.name)) for folder in folders}


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that orders numbers inside names by value."""
    parts = re.findall(r"[0-9]+|[^0-9]", name)
    return tuple((0, int(part)) if part.isdecimal() and part.isascii() else (1, part) for part in parts)


def trials_files(processed: Path, device: str | None = None, experiment: str | None = None) -> list[Path]:
    """Return the files of trials: all, of a device, or of one experiment; sorted."""
    return sorted(Path(path) for path in _listing(_root(processed, device, experiment)))


def _root(processed: Path, device: str | None, experiment: str | None) -> str:
    return os.fspath(trials_folder(processed, *(name for name in (device, experiment) if name is not None)))


def _folder(processed: Path, tree: str, *names: str) -> Path:
    """Return a folder of one of the trees, all of which have the folder names of that of the trials."""
    trials = place = processed / "trials"
    for name in names:
        place = place_of(place, name)
    return processed / tree / place.relative_to(trials)


def _listing(folder: str) -> dict[str, tuple[int, int, int]]:
    """Return inode, size [byte] and time [ns] of each Parquet file below a folder: another file has another."""
    found: dict[str, tuple[int, int, int]] = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    found |= _listing(entry.path)
                elif entry.name.endswith(TABLE):
                    status = entry.stat()
                    found[entry.path] = (status.st_ino, status.st_size, status.st_mtime_ns)
    except FileNotFoundError:  # nothing stored yet, or removed since it was listed
        pass
    return found


def steadily(folder: Path, read: Callable[[], Result]) -> Result:
    """Return what a function reads below a folder without a lock; where files moved meanwhile, it is called again.

    Raises
    ------
    StoreError
        If it fails although nothing moved, or others write there all the time.
    """
    root = os.fspath(folder)
    for _ in range(ATTEMPTS):
        before = _listing(root)
        try:
            result = read()
        except (StoreError, FileNotFoundError) as error:
            if _listing(root) == before:
                if isinstance(error, StoreError):
                    raise
                raise damaged_file(Path(error.filename or root), error.strerror) from error
        else:
            # a folder is not listed in one moment: what was merged meanwhile may be missing in both places
            if _listing(root) == before:
                return result
        time.sleep(_PAUSE_S)
    raise StoreError(f"{root}: changed during each of {ATTEMPTS} attempts to read it. Wait for other commands.")


def read_trials(
    processed: Path,
    device: str | None = None,
    experiment: str | None = None,
    columns: list[str] | None = None,
    damaged: dict[Path, str] | None = None,
) -> pa.Table:
    """Return the trials, but for their samples: all, of a device, or of one experiment; in order of file name.

    Where one source path was stored in several versions, only the trials of the newest version are returned; a trial
    that stands in several files is returned once. Trials that were moved or deleted by hand count as they were
    corrected.

    Parameters
    ----------
    processed : Path
    device, experiment : str, optional
    columns : list of str, optional
        Of `tables.OF_TRIALS`; by default all.
    damaged : dict of Path to str, optional
        Gets the files that are damaged, and why; without it they are an error.

    Raises
    ------
    StoreError
        If a file is damaged, or others write there all the time.
    """
    wanted = list(OF_TRIALS) if columns is None else columns
    corrections = {}
    try:
        corrections = {key: one for key, one in read_corrections(processed).items() if one.changes_place}
    except StoreError as error:
        if damaged is None:
            raise
        damaged[processed / "corrections"] = str(error)
    needed = [*wanted, *VERSION_COLUMNS, *(("device", "experiment") if corrections else ())]
    tables = []
    places: list[tuple[str | None, str | None]] = [(device, experiment)]
    for of, one in [*places, *moved_from(corrections.values(), device, experiment)]:
        table, _, _ = read_versions(processed, of, one, list(dict.fromkeys(needed)), damaged)
        tables.append(table.filter(pa.array(newest_versions(table))))
    return applied(pa.concat_tables(tables), corrections, device, experiment).select(wanted)


def read_versions(
    processed: Path,
    device: str | None,
    experiment: str | None,
    columns: list[str],
    damaged: dict[Path, str] | None = None,
) -> tuple[pa.Table, list[Path], list[Path]]:
    """Return all rows of files of trials, superseded ones too, and these files; of `damaged` and replaced ones none.

    Returns
    -------
    table : pyarrow.Table
        The columns, and the index (`FILE`) of the file of each row.
    files, replaced : list of Path
        All files, and those of them in whose place another one stands.

    Raises
    ------
    StoreError
        If a file is damaged, or others write there all the time.
    """
    root = trials_folder(processed, *(name for name in (device, experiment) if name is not None))
    broken: dict[Path, str] = {}

    def read() -> tuple[list[Path], list[pa.Table], set[str]]:
        broken.clear()
        files, replaced = list(map(Path, sorted(_listing(os.fspath(root))))), set[str]()
        tables = [_rows(file, processed, columns, replaced, None if damaged is None else broken) for file in files]
        return files, tables, replaced

    files, tables, names = steadily(root, read)
    replaced = [file for file in files if file.name in names]
    tables = [table.slice(0, 0) if file in replaced else table for file, table in zip(files, tables, strict=True)]
    if damaged is not None:
        damaged |= broken
    index = np.repeat(np.arange(len(files)), [table.num_rows for table in tables])
    table = pa.concat_tables(tables) if tables else _schema(columns).empty_table()
    return table.append_column(FILE, pa.array(index, pa.int64())), files, replaced


def _rows(
    file: Path, processed: Path, columns: list[str], replaced: set[str], damaged: dict[Path, str] | None
) -> pa.Table:
    """Return columns of a file of trials; `replaced` gets the names of those in whose place it stands."""
    schema = _schema(columns)
    try:
        with open_table(file) as stored:
            replaced.update(replaced_by(stored.schema_arrow))
            table = stored.read([name for name in columns if name not in LOCATION], use_threads=False)
    except StoreError as error:
        if damaged is None:
            raise
        damaged[file] = str(error)
        return schema.empty_table()
    name = file.relative_to(processed).as_posix()
    place: dict[str, Any] = {}
    if not set(LOCATION).isdisjoint(columns):
        place = {"sample_file": pa.array([name] * table.num_rows), "sample_row": pa.array(np.arange(table.num_rows))}
    # the types are checked; a cast would import what takes longer than reading
    found = [place[name] if name in LOCATION else table.column(name) for name in columns]
    return pa.Table.from_arrays(found, schema=schema)


def replaced_by(schema: pa.Schema) -> list[str]:
    """Return the names of the files that a file of this schema stands in the place of."""
    return [f"{sha256}{TABLE}" for sha256 in metadata_of(schema).get("pipeline.replaces", "").split()]


def _schema(columns: list[str]) -> pa.Schema:
    whole = arrow_schema("trials", also=LOCATION)
    return pa.schema([whole.field(name) for name in columns])


def each_once(table: pa.Table) -> bool:
    """Return whether no two rows of `read_versions` have one path or content, and none was renamed."""
    alone = all(len(set(table.column(name).to_pylist())) == len(table) for name in ("source_path", "source_sha256"))
    return alone and table.column("formerly").null_count == len(table)


def newest_versions(table: pa.Table) -> Booleans:
    """Return which rows of `read_versions` are the newest of their source path, each trial once.

    A log that stands under two paths, as while one is renamed, is returned under the one that was stored later.
    """
    if each_once(table):
        return np.ones(table.num_rows, dtype=np.bool_)
    names = ("source_path", "source_sha256", "trial_id", "profile_sha256", "formerly")
    paths, sources, trials, profiles, before = (table.column(name).to_pylist() for name in names)
    order = np.lexsort([table.column(name).to_numpy() for name in ("source_mtime_ns", "version")]).tolist()
    newest: dict[str, tuple[str, str] | None] = {}
    for row in order:
        newest[paths[row]] = (sources[row], profiles[row])
        if before[row] is not None and newest.get(before[row]) == newest[paths[row]]:
            newest[before[row]] = None  # renamed
    # of a trial that stands under two paths the newer counts
    kept = {trials[row]: row for row in order if newest[paths[row]] == (sources[row], profiles[row])}
    mask = np.zeros(table.num_rows, dtype=np.bool_)
    mask[list(kept.values())] = True
    return mask


def check_version(processed: Path) -> None:
    """Refuse a store that an earlier version wrote, with the command that rebuilds it.

    Raises
    ------
    StoreError
        If it is one.
    """
    if not (processed / "samples").is_dir():
        return
    sources: list[str] = []
    for file in sorted((processed / "trials").rglob(f"*{TABLE}"))[:ATTEMPTS]:
        with suppress(pa.ArrowException, OSError, KeyError):
            sources += map(str, pq.read_table(file, columns=["source_path"]).column(0).to_pylist())
    logs = os.path.commonpath([os.path.dirname(path) for path in sources]) if sources else "LOGS"
    raise StoreError(
        f"{processed}: was written by an earlier version, with samples in files of their own. Rebuild it beside: "
        f"`pipeline ingest {shlex.quote(logs)} --processed {shlex.quote(f'{processed}-new')}`; then remove the old one."
    )
