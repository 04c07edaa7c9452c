"""What was stored and is gone: trials that stored results rest on, and corrections that they were computed with."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.errors import StoreError
from pipeline.base.wording import counted
from pipeline.records.findings import Record
from pipeline.records.table_files import read_metadata
from pipeline.store.corrections import read_corrections
from pipeline.store.names import name_of_folder
from pipeline.store.storage import TABLE, read_rows

FIRST_STAGE = "response"
"""Stage that has a row for each trial in use."""

MOST = 3
"""Ids that are named in a sentence."""


class Gone(Record):
    """Ids of trials of an experiment that are in no file any more, and of those whose exclusion is in none."""

    device: str
    experiment: str
    trials: tuple[str, ...]
    exclusions: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """What is gone, and what to do."""
        said = [
            f"{counted(len(ids), name)} ({', '.join(ids[:MOST])}{', ...' * (len(ids) > MOST)})"
            for name, ids in (("trial", self.trials), ("exclusion", self.exclusions))
            if ids
        ]
        return (
            f"Experiment {self.experiment} of {self.device}: {' and '.join(said)} that stored results were computed "
            "with are in no file of the store any more. Bring the files back from a backup, or ingest the logs and "
            "exclude the trials again."
        )


def gone(processed: Path, device: str | None = None) -> tuple[Gone, ...]:
    """Return what stored results were computed with and no file holds any more, of all devices or of one.

    Trials that a later ingest may have replaced by as many others are not told.
    """
    found = []
    damaged: dict[Path, str] = {}
    stored = read_rows(processed, ["trial_id"], damaged)
    known = set(stored.column("trial_id"))
    written = np.array([file.stat().st_mtime_ns for file in stored.files], dtype=np.int64)[stored.file]
    try:
        corrections = read_corrections(processed)
    except StoreError:  # damaged, and named as such
        return ()
    for file in sorted((processed / "stages").glob(f"*/*/{FIRST_STAGE}-*{TABLE}")):
        of, experiment = map(name_of_folder, file.parts[-3:-1])
        if device not in (None, of):
            continue
        with suppress(OSError, pa.ArrowException):
            ids = pq.read_table(file, columns=["trial_id"]).column("trial_id").to_pylist()
            lost = sorted({*ids} - known - corrections.keys())
            excluded = sorted({*read_metadata(file).get("pipeline.excluded", "").split()} - corrections.keys())
            if damaged or len(lost) <= np.count_nonzero(written > file.stat().st_mtime_ns):
                lost = []
            if lost or excluded:
                found.append(Gone(device=of, experiment=experiment, trials=tuple(lost), exclusions=tuple(excluded)))
    return tuple(found)
