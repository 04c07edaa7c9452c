"""Layout of `processed/`: where each table lies, and how trials and their samples are read back.

    trials/<device>/<experiment>/<batch>.parquet    one row per log; its presence commits the batch
    samples/<device>/<experiment>/<batch>.parquet   the samples of that batch, trial after trial
    stages/<device>/<experiment>/<stage>.parquet    estimates, costs, boundary
    quarantine/                                     logs that were refused, with the reason

A samples file is written before the trials file that names it, so a trial that can be seen can be read.
"""

from __future__ import annotations

import json
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.batch import Integers, TrialBatch, pad
from pipeline.errors import StoreError
from pipeline.tables import arrow_schema, read_table

_OPTIONAL = ("force", "velocity")
"""Columns of samples that a log may lack."""


def folder_name(name: str) -> str:
    """Turn a device or experiment name into a safe folder name; `name_of_folder` turns it back."""
    safe = quote(name, safe=" +=,@")
    return "%2E" + safe[1:] if safe.startswith(".") else safe


def name_of_folder(folder: str) -> str:
    """Return the device or experiment name that `folder_name` made a folder name of."""
    return unquote(folder)


def trials_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the trials tables of an experiment."""
    return processed / "trials" / folder_name(device) / folder_name(experiment)


def samples_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the samples tables of an experiment."""
    return processed / "samples" / folder_name(device) / folder_name(experiment)


def stage_file(processed: Path, device: str, experiment: str, stage: str) -> Path:
    """Return the file that holds the result of a stage for an experiment."""
    return processed / "stages" / folder_name(device) / folder_name(experiment) / f"{stage}.parquet"


def list_devices(processed: Path) -> list[str]:
    """Return the names of devices that have trials, sorted."""
    folder = processed / "trials"
    return sorted(name_of_folder(p.name) for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []


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


def read_trials(processed: Path, device: str | None = None, experiment: str | None = None) -> pa.Table:
    """Return the trials table: of everything, of a device, or of one experiment; in order of file name.

    Where one source path was stored in several versions, only the trials of the newest version are returned.
    """
    root = processed / "trials"
    if device is not None:
        root = root / folder_name(device)
    if experiment is not None:
        root = root / folder_name(experiment)
    files = sorted(root.rglob("*.parquet")) if root.is_dir() else []
    tables = [read_table(file) for file in files]
    schema = arrow_schema("trials")
    if not tables:
        return schema.empty_table()
    table = pa.concat_tables([t.cast(schema) for t in tables])
    return _newest_versions(table)


def _newest_versions(table: pa.Table) -> pa.Table:
    paths, trials, sources, profiles = (
        table.column(name).to_pylist() for name in ("source_path", "trial_id", "source_sha256", "profile_sha256")
    )
    stamps = table.column("source_mtime_ns").to_numpy()
    order = np.lexsort((np.arange(len(paths)), stamps)).tolist()
    newest = {paths[row]: (sources[row], profiles[row]) for row in order}
    kept = {(paths[row], trials[row]): row for row in order if newest[paths[row]] == (sources[row], profiles[row])}
    if len(kept) == len(paths):
        return table
    return table.take(pa.array(sorted(kept.values())))


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
        If a samples file is missing or shorter than its trials say.
    """
    order = pc.sort_indices(trials, [("damping", "ascending"), ("stiffness", "ascending"), ("trial_id", "ascending")])
    trials = trials.take(order)
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("time_s", "command", "position", *_OPTIONAL)}
    start: dict[str, int] = {}
    total = 0
    for file in sorted(set(trials.column("sample_file").to_pylist())):
        path = processed / file
        if not path.is_file():
            raise StoreError(
                f"{path}: samples file is missing, but its trials are stored. "
                "Remove the trials file of the same name below trials/ and ingest the logs again."
            )
        samples = read_table(path, list(columns))
        start[file] = total
        total += samples.num_rows
        for name, parts in columns.items():
            parts.append(samples.column(name).to_numpy())
    rows = trials.column("rows").to_numpy().astype(np.int64)
    offset = np.array([start[f] for f in trials.column("sample_file").to_pylist()], dtype=np.int64)
    first = trials.column("first_row").to_numpy().astype(np.int64) + offset
    if len(rows) and int((first + rows).max()) > total:
        raise StoreError(f"{processed}: a samples file is shorter than its trials say; ingest the logs again.")
    padded = {
        name: pad(np.concatenate(parts) if parts else np.empty(0), first, rows) for name, parts in columns.items()
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


def _declared_step_rows(extra: list[str]) -> Integers | None:
    """Rows of the command edge that profiles or logs declare (``step_row``), -1 for the others."""
    declared = [json.loads(text).get("step_row") if "step_row" in text else None for text in extra]
    if not any(declared):
        return None
    return np.array([-1 if row is None else int(row) for row in declared], dtype=np.int64)
