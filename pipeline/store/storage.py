"""Layout of `processed/`: where each table lies, and how trials and their samples are read back.

    trials/<device>/<experiment>/<batch>.parquet    one row per log; its presence commits the batch
    samples/<device>/<experiment>/<batch>.parquet   the samples of that batch, trial after trial
    stages/<device>/<experiment>/<stage>.parquet    estimates, costs, boundary
    quarantine/                                     logs that were refused, with the reason

A samples file is written before the trials file that names it, so a trial that can be seen can be read. Readers take no
lock: they look at the folder again after reading and start anew where it changed meanwhile (`read_trials`), and look up
samples again that were merged into another file (`samples.load_batch`).
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.errors import StoreError
from pipeline.records.batch import Booleans
from pipeline.records.table_files import damaged_file, read_table
from pipeline.records.tables import TABLES, arrow_schema
from pipeline.store.names import name_of_folder, place_of

Result = TypeVar("Result")

EXCLUSIONS_FILE = "exclusions.parquet"
"""File of the trials that are excluded by hand."""


def trials_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the trials tables of an experiment."""
    return _folder(processed, "trials", device, experiment)


def samples_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the samples tables of an experiment."""
    return _folder(processed, "samples", device, experiment)


def partner_of(file: Path) -> Path:
    """Return the other file of a batch: the trials file of a samples file, and the reverse."""
    tree = file.parents[2]
    other = {"trials": "samples", "samples": "trials"}[tree.name]
    return tree.parent / other / file.relative_to(tree)


def stage_file(processed: Path, device: str, experiment: str, stage: str) -> Path:
    """Return the file that holds the result of a stage for an experiment."""
    return _folder(processed, "stages", device, experiment) / f"{stage}.parquet"


def list_devices(processed: Path) -> list[str]:
    """Return the names of devices that have trials, sorted."""
    folder = processed / "trials"
    if not folder.is_dir():
        return []
    return sorted(name_of_folder(p.name) for p in folder.iterdir() if p.is_dir() and any(p.glob("*/*.parquet")))


def list_experiments(processed: Path, device: str) -> list[str]:
    """Return the experiments of a device that have trials, sorted as people sort them (2 before 10)."""
    folder = place_of(processed / "trials", device)
    if not folder.is_dir():
        return []
    names = [name_of_folder(p.name) for p in folder.iterdir() if p.is_dir() and any(p.glob("*.parquet"))]
    return sorted(names, key=natural_key)


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that orders numbers inside names by value."""
    parts: list[tuple[int, int | str]] = []
    digits = ""
    for character in name:
        if character.isascii() and character.isdigit():
            digits += character
            continue
        if digits:
            parts.append((0, int(digits)))
            digits = ""
        parts.append((1, character))
    if digits:
        parts.append((0, int(digits)))
    return tuple(parts)


def trials_files(processed: Path, device: str | None = None, experiment: str | None = None) -> list[Path]:
    """Return the trials files: all, of a device, or of one experiment; sorted."""
    return sorted(Path(path) for path in _listing(_trials_root(processed, device, experiment)))


def batch_number(file: Path) -> int:
    """Return the number of a batch by the name of its file; the higher one is the newer."""
    digits, dash, _ = file.name.partition("-")
    return int(digits) if dash and digits.isdecimal() else 0


def _trials_root(processed: Path, device: str | None, experiment: str | None) -> str:
    names = (name for name in (device, experiment) if name is not None)
    return os.fspath(_folder(processed, "trials", *names))


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
                elif entry.name.endswith(".parquet"):
                    status = entry.stat()
                    found[entry.path] = (status.st_ino, status.st_size, status.st_mtime_ns)
    except FileNotFoundError:  # nothing stored yet, or removed since it was listed
        pass
    return found


def steadily(processed: Path, read: Callable[[], Result]) -> Result:
    """Return what a function reads of a store without a lock; where files moved meanwhile, it is called again.

    Raises
    ------
    StoreError
        If it fails although nothing moved, or others write there all the time.
    """
    root = _trials_root(processed, None, None)
    for _ in range(ATTEMPTS):
        before = _listing(root)
        try:
            return read()
        except (StoreError, FileNotFoundError):
            if _listing(root) == before:
                raise
        time.sleep(_PAUSE_S)
    raise StoreError(f"{root}: changed during each of {ATTEMPTS} attempts to read it. Wait for other commands.")


def samples_metadata(file: Path) -> pq.FileMetaData:
    """Return the metadata of a samples file: its rows and groups of rows.

    Raises
    ------
    StoreError
        If it is missing or damaged.
    """
    try:
        return pq.read_metadata(file)
    except (pa.ArrowException, OSError) as error:
        raise damaged_file(file, error) from error


def read_trials(
    processed: Path,
    device: str | None = None,
    experiment: str | None = None,
    columns: list[str] | None = None,
    damaged: dict[Path, str] | None = None,
) -> pa.Table:
    """Return the trials table: of everything, of a device, or of one experiment; in order of file name.

    Where one source path was stored in several versions, only the trials of the newest version are returned; a trial
    that stands in two files while batches are merged is returned once.

    Parameters
    ----------
    processed : Path
    device, experiment : str, optional
    columns : list of str, optional
        By default all.
    damaged : dict of Path to str, optional
        Gets the files that are damaged, and why; without it they are an error.

    Raises
    ------
    StoreError
        If a file is damaged, or others write there all the time.
    """
    wanted = list(TABLES["trials"]) if columns is None else columns
    table, _ = read_versions(processed, device, experiment, list(dict.fromkeys((*wanted, *VERSION_COLUMNS))), damaged)
    return table.filter(pa.array(newest_versions(table))).select(wanted)


VERSION_COLUMNS = ("source_path", "trial_id", "source_sha256", "profile_sha256", "source_mtime_ns", "extra")
"""Columns that tell versions of a trial apart."""

FORMERLY = "formerly"
"""Key in ``extra`` of a trial whose log was renamed: the path under which it stood before."""

BATCH = "batch_number"
"""Column that `read_versions` adds."""

FILE = "batch_file"
"""Column that `read_versions` adds: index of the trials file."""

ATTEMPTS = 50
"""Times that reading starts anew because files were merged meanwhile; a merge takes longer than listing files, so that
one suffices nearly always."""

_PAUSE_S = 0.02
"""Wait before a new attempt [s], for a writer that removes many files."""


def read_versions(
    processed: Path,
    device: str | None,
    experiment: str | None,
    columns: list[str],
    damaged: dict[Path, str] | None = None,
) -> tuple[pa.Table, list[Path]]:
    """Return all rows of trials files, superseded ones too, and these files; of `damaged` ones none.

    Returns
    -------
    table : pyarrow.Table
        The columns, and the number (`BATCH`) and index (`FILE`) of the file of each row.
    files : list of Path

    Raises
    ------
    StoreError
        If a file is damaged, or others write there all the time.
    """
    root = _trials_root(processed, device, experiment)
    whole = arrow_schema("trials")
    schema = pa.schema([whole.field(name) for name in columns])
    for _ in range(ATTEMPTS):
        before = _listing(root)
        files = [Path(path) for path in sorted(before)]
        try:
            broken: dict[Path, str] = {}
            tables = [_rows(file, schema, None if damaged is None else broken) for file in files]
        except StoreError:
            if _listing(root) == before:
                raise
        else:
            # a folder is not listed in one moment: what was merged meanwhile may be missing in both places
            if _listing(root) == before:
                break
        time.sleep(_PAUSE_S)
    else:
        raise StoreError(f"{root}: changed during each of {ATTEMPTS} attempts to read it. Wait for other commands.")
    if damaged is not None:
        damaged |= broken
    rows = np.array([table.num_rows for table in tables], dtype=np.int64)
    index = np.repeat(np.arange(len(files), dtype=np.int64), rows)
    numbers = np.array([batch_number(file) for file in files], dtype=np.int64)[index]
    table = pa.concat_tables(tables) if tables else schema.empty_table()
    return table.append_column(BATCH, pa.array(numbers)).append_column(FILE, pa.array(index)), files


def _rows(file: Path, schema: pa.Schema, damaged: dict[Path, str] | None) -> pa.Table:
    try:
        # the types are checked; a cast would import what takes longer than reading
        return pa.Table.from_arrays(read_table(file, schema.names).select(schema.names).columns, schema=schema)
    except StoreError as error:
        if damaged is None:
            raise
        damaged[file] = str(error)
        return schema.empty_table()


def newest_versions(table: pa.Table) -> Booleans:
    """Return which rows of `read_versions` are the newest of their source path, each trial once.

    Newer is the higher batch number; among files without one, the later modification of the source. A log that was
    renamed is returned under its present path (`FORMERLY`), also where its former trials are not removed yet.
    """
    paths, sources = (table.column(name).to_pylist() for name in ("source_path", "source_sha256"))
    if len(set(paths)) == len(set(sources)) == len(paths):
        return np.ones(table.num_rows, dtype=np.bool_)
    trials, profiles = (table.column(name).to_pylist() for name in ("trial_id", "profile_sha256"))
    stamps, numbers = (table.column(name).to_numpy() for name in ("source_mtime_ns", BATCH))
    order = np.lexsort((np.arange(len(paths)), stamps, numbers)).tolist()
    extra = table.column("extra").to_pylist()
    newest: dict[str, tuple[str, str]] = {}
    for row in order:
        newest[paths[row]] = sources[row], profiles[row]
        former = str(json.loads(extra[row]).get(FORMERLY)) if FORMERLY in extra[row] else ""
        if newest.get(former, ("", ""))[0] == sources[row] and former != paths[row]:
            del newest[former]
    kept = {trials[row]: row for row in order if newest.get(paths[row]) == (sources[row], profiles[row])}
    mask = np.zeros(table.num_rows, dtype=np.bool_)
    mask[list(kept.values())] = True
    return mask
