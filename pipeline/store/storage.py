"""Layout of `processed/`: where each table lies, and how trials and their samples are read back.

    trials/<device>/<experiment>/<batch>.parquet    one row per log; its presence commits the batch
    samples/<device>/<experiment>/<batch>.parquet   the samples of that batch, trial after trial
    stages/<device>/<experiment>/<stage>.parquet    estimates, costs, boundary
    quarantine/                                     logs that were refused, with the reason

A samples file is written before the trials file that names it, so a trial that can be seen can be read. Readers take no
lock: they look at the folder again after reading and start anew where it changed meanwhile (`read_trials`), and look up
samples again that were merged into another file (`load_batch`).
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar
from urllib.parse import quote, unquote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.errors import REMEDY, StoreError
from pipeline.records.batch import Booleans, Integers, TrialBatch, pad
from pipeline.records.tables import TABLES, arrow_schema, damaged_file, read_table

_OPTIONAL = ("force", "velocity")
"""Columns of samples that a log may lack."""

Result = TypeVar("Result")

_SAMPLES = ("time_s", "command", "position", *_OPTIONAL)


def folder_name(name: str) -> str:
    """Turn a device or experiment name into a safe folder name; `name_of_folder` turns it back.

    Readers of folders of Parquet files leave out those that begin with a dot or an underscore, and take "a=b" for a
    column: these signs are written as %2E, %5F and %3D there.
    """
    safe = quote(name, safe=" +,@")
    return f"%{ord(safe[0]):02X}{safe[1:]}" if safe.startswith((".", "_")) else safe


def name_of_folder(folder: str) -> str:
    """Return the device or experiment name that `folder_name` made a folder name of."""
    return unquote(folder)


def trials_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the trials tables of an experiment."""
    return processed / "trials" / folder_name(device) / folder_name(experiment)


def samples_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the samples tables of an experiment."""
    return processed / "samples" / folder_name(device) / folder_name(experiment)


def partner_of(file: Path) -> Path:
    """Return the other file of a batch: the trials file of a samples file, and the reverse."""
    tree = file.parents[2]
    other = {"trials": "samples", "samples": "trials"}[tree.name]
    return tree.parent / other / file.relative_to(tree)


def stage_file(processed: Path, device: str, experiment: str, stage: str) -> Path:
    """Return the file that holds the result of a stage for an experiment."""
    return processed / "stages" / folder_name(device) / folder_name(experiment) / f"{stage}.parquet"


def list_devices(processed: Path) -> list[str]:
    """Return the names of devices that have trials, sorted."""
    folder = processed / "trials"
    if not folder.is_dir():
        return []
    return sorted(name_of_folder(p.name) for p in folder.iterdir() if p.is_dir() and any(p.glob("*/*.parquet")))


def list_experiments(processed: Path, device: str) -> list[str]:
    """Return the experiments of a device that have trials, sorted as people sort them (2 before 10)."""
    folder = processed / "trials" / folder_name(device)
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
    names = [folder_name(name) for name in (device, experiment) if name is not None]
    return os.path.join(processed, "trials", *names)


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


VERSION_COLUMNS = ("source_path", "trial_id", "source_sha256", "profile_sha256", "source_mtime_ns")
"""Columns that tell versions of a trial apart."""

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
        return read_table(file, schema.names).select(schema.names).cast(schema)
    except StoreError as error:
        if damaged is None:
            raise
        damaged[file] = str(error)
        return schema.empty_table()


def newest_versions(table: pa.Table) -> Booleans:
    """Return which rows of `read_versions` are the newest of their source path, each trial once.

    Newer is the higher batch number; among files without one, the later modification of the source. A log that stands
    under two paths, as while one is renamed, is returned under the newer.
    """
    paths, trials = (table.column(name).to_pylist() for name in ("source_path", "trial_id"))
    sources = table.column("source_sha256").to_pylist()
    if len(set(paths)) == len(set(sources)) == len(paths):
        return np.ones(table.num_rows, dtype=np.bool_)
    profiles = table.column("profile_sha256").to_pylist()
    stamps, numbers = (table.column(name).to_numpy() for name in ("source_mtime_ns", BATCH))
    order = np.lexsort((np.arange(len(paths)), stamps, numbers)).tolist()
    newest = {paths[row]: (sources[row], profiles[row]) for row in order}
    current = [row for row in order if newest[paths[row]] == (sources[row], profiles[row])]
    place = {sources[row]: paths[row] for row in current}
    kept = {trials[row]: row for row in current if place[sources[row]] == paths[row]}
    mask = np.zeros(table.num_rows, dtype=np.bool_)
    mask[list(kept.values())] = True
    return mask


def load_batch(processed: Path, trials: pa.Table) -> TrialBatch:
    """Read the samples of trials into padded arrays, ordered by damping, stiffness and trial id.

    Parameters
    ----------
    processed : Path
    trials : pyarrow.Table
        Rows of the trials table, as `read_trials` returns them.

    Raises
    ------
    StoreError
        If a samples file is missing or shorter than its trials say, or a trial was removed meanwhile.
    """
    trials = trials.sort_by([("damping", "ascending"), ("stiffness", "ascending"), ("trial_id", "ascending")])
    for _ in range(ATTEMPTS):
        files = sorted(set(trials.column("sample_file").to_pylist()))
        missing = next((processed / file for file in files if not (processed / file).is_file()), None)
        if missing is None:
            try:
                samples = [read_table(processed / file, list(_SAMPLES)) for file in files]
                break
            except StoreError:
                missing = next((processed / file for file in files if not (processed / file).is_file()), None)
                if missing is None:
                    raise
        located = _located(processed, trials)
        if located.equals(trials):
            raise StoreError(f"{missing}: samples file is missing, but its trials are stored. {REMEDY}")
        trials = located
    else:
        raise StoreError(f"{processed}: samples were moved during each of {ATTEMPTS} attempts to read them.")
    length = np.array([table.num_rows for table in samples], dtype=np.int64)
    index = {file: place for place, file in enumerate(files)}
    owner = np.array([index[file] for file in trials.column("sample_file").to_pylist()], dtype=np.int64)
    rows = trials.column("rows").to_numpy().astype(np.int64)
    first = trials.column("first_row").to_numpy().astype(np.int64)
    if (first + rows > length[owner]).any():
        raise StoreError(f"{processed}: a samples file is shorter than its trials say. {REMEDY}")
    first = first + (np.cumsum(length) - length)[owner]
    padded = {
        name: pad(np.concatenate([t.column(name).to_numpy() for t in samples]) if samples else np.empty(0), first, rows)
        for name in _SAMPLES
    }
    present = {name: None if np.isnan(padded[name]).all() else padded[name] for name in _OPTIONAL}
    return TrialBatch(
        trial_id=tuple(trials.column("trial_id").to_pylist()),
        stiffness=trials.column("stiffness").to_numpy(),
        damping=trials.column("damping").to_numpy(),
        step=trials.column("step").to_numpy(),
        sampling_period_s=trials.column("sampling_period_s").to_numpy(),
        rows=rows,
        time=padded["time_s"],
        command=padded["command"],
        position=padded["position"],
        **present,
        step_row=_declared_step_rows(trials.column("extra").to_pylist()),
    )


def _located(processed: Path, trials: pa.Table) -> pa.Table:
    """Return trials with the present place of their samples, which a merge of batches may have moved."""
    keys = ("source_path", "trial_id", "profile_sha256")
    present = read_trials(processed, columns=[*keys, "sample_file", "first_row"]).to_pydict()
    places = dict(
        zip(
            zip(*(present[key] for key in keys), strict=True),
            zip(present["sample_file"], present["first_row"], strict=True),
            strict=True,
        )
    )
    wanted = list(zip(*(trials.column(key).to_pylist() for key in keys), strict=True))
    gone = [key for key in wanted if key not in places]
    if gone:
        raise StoreError(
            f"{processed}: {len(gone)} trials were removed while they were read, the first of {gone[0][0]}: "
            "their source changed. Run the command again."
        )
    moved = {
        "sample_file": pa.array([places[key][0] for key in wanted]),
        "first_row": pa.array([places[key][1] for key in wanted], pa.int64()),
    }
    for name, values in moved.items():
        index = trials.schema.get_field_index(name)
        trials = trials.set_column(index, trials.schema.field(index), values)
    return trials


def _declared_step_rows(extra: list[str]) -> Integers | None:
    """Rows of the command edge that profiles or logs declare (``step_row``), -1 for the others."""
    declared = [json.loads(text).get("step_row") if "step_row" in text else None for text in extra]
    if not any(declared):
        return None
    return np.array([-1 if row is None else int(row) for row in declared], dtype=np.int64)
