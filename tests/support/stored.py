"""What must hold of a store at any moment: each file is readable, and each trial is there once, as in its log."""

import hashlib
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import writing
from pipeline.records.table_files import parquet_bytes
from pipeline.store.batch_files import remove_incomplete, remove_superseded, rewrite
from pipeline.store.objects import publish
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials, trials_files


def merge_all(processed: Path) -> None:
    """Make one file of all batches of an experiment, a motion and a mode, as ingests do of those of like size."""
    with writing(processed, 0):
        remove_incomplete(processed)
        remove_superseded(processed, {})
        kinds: dict[tuple[Path, str, int], list[Path]] = {}
        for file in trials_files(processed):
            motion = pq.read_schema(file).metadata[b"pipeline.motion"].decode()
            kinds.setdefault((file.parent, motion, file.stat().st_mode & 0o777), []).append(file)
        for files in kinds.values():
            if len(files) > 1:
                rewrite(processed, files)
                publish(processed)


def replace_table(file: Path, table: pa.Table) -> Path:
    """Put a table in the place of a stored one, as whoever stored it would have; returns its file."""
    data = parquet_bytes(table)
    new = file.with_name(f"{file.stem[:-64]}{hashlib.sha256(data).hexdigest()}.parquet")
    file.unlink()
    new.write_bytes(data)
    return new


def flip(file: Path, at: int) -> None:
    """Change a byte of a file."""
    data = bytearray(file.read_bytes())
    data[at] ^= 0x55
    file.write_bytes(data)


def stored_rows(processed: Path) -> Counter[str]:
    """How often each trial stands in the trials files, whatever readers make of it."""
    rows: Counter[str] = Counter()
    for file in sorted(processed.glob("trials/**/*.parquet")):
        rows.update(pq.read_table(file).column("trial_id").to_pylist())
    return rows


def check_whole(processed: Path, logs: dict[str, float], former: dict[str, set[float]] | None = None) -> set[str]:
    """Everything that is visible is readable, stands there once, and is what the logs say; returns the stored paths.

    ``logs`` and ``former`` are the stiffness of each log, and those that it had before.
    """
    for file in processed.rglob("*.parquet"):
        pq.read_table(file, page_checksum_verification=True).validate(full=True)
    trials = read_trials(processed)
    paths = trials.column("source_path").to_pylist()
    assert len(set(paths)) == len(paths)
    loaded = load_trials(processed, trials)
    assert len(loaded) == trials.num_rows
    for trial in loaded:
        assert trial.trial_id
        assert trial.damping == 2
        np.testing.assert_array_equal(trial.command[:3], trial.stiffness + np.arange(3))
    found = dict(zip(paths, trials.column("stiffness").to_pylist(), strict=True))
    allowed = {path: {logs.get(path, k)} | (former or {}).get(path, set()) for path, k in found.items()}
    assert {path: k for path, k in found.items() if k not in allowed[path]} == {}
    return set(paths)


def trials_of(stages):
    """All trials of an experiment with their samples."""
    return load_trials(stages.processed, stages.trials)
