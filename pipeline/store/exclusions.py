"""Trials that are excluded by hand: kept as they are, used for nothing, and named in every report.

They stand in ``processed/exclusions.parquet``, sealed as all tables are. A trial is known by the content of its log: it
stays excluded when that is ingested again, renamed, merged or repaired, and a log with other content is another trial.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from pipeline.base.disk import remove, sync_folder
from pipeline.base.errors import StoreError
from pipeline.base.inventory import missing
from pipeline.base.provenance import stamp
from pipeline.records.findings import Record
from pipeline.records.table_files import read_table, write_table
from pipeline.records.tables import TABLES, to_arrow
from pipeline.store.storage import EXCLUSIONS_FILE

Key = tuple[str, str | None]
"""What a trial is known by: SHA-256 of its log, and which trial of the log it is."""


class Exclusion(Record):
    """A trial that is excluded by hand: where it belongs, its log, why, and since when (UTC, ISO 8601)."""

    trial_id: str
    label: str | None
    device: str
    experiment: str
    source_path: str
    source_sha256: str
    exclusion_reason: str
    excluded_since: str

    @property
    def key(self) -> Key:
        """What the trial is known by."""
        return self.source_sha256, self.label


OF_TRIALS = tuple(name for name in Exclusion.model_fields if name in TABLES["trials"])
"""What an exclusion takes from the row of its trial."""


def read_exclusions(processed: Path) -> dict[Key, Exclusion]:
    """Return the exclusions of a store in the order in which they were made, of trials no longer stored, too.

    Raises
    ------
    StoreError
        If the file is damaged or was deleted: what is excluded is then not known, and nothing may be computed.
    """
    file = processed / EXCLUSIONS_FILE
    if not file.exists() and EXCLUSIONS_FILE in missing(processed):
        raise StoreError(
            f"{file}: was deleted, so that nobody knows which trials are excluded. Put it back, or let `pipeline check "
            "--repair` forget it: all trials are then in use."
        )
    found = [Exclusion(**row) for row in read_table(file).to_pylist()] if file.exists() else []
    return {one.key: one for one in found}


def write_exclusions(processed: Path, exclusions: Iterable[Exclusion]) -> None:
    """Store what is excluded, in one step; where nothing is, the file goes. For who holds the lock of the store."""
    rows = [one.model_dump() for one in exclusions]
    file = processed / EXCLUSIONS_FILE
    if rows:
        columns = {name: [row[name] for row in rows] for name in TABLES["exclusions"]}
        write_table(file, to_arrow("exclusions", columns, metadata=stamp()))
    elif file.exists():
        remove(file)
        sync_folder(processed)


def split_trials(trials: pa.Table, exclusions: Mapping[Key, Exclusion]) -> tuple[pa.Table, tuple[Exclusion, ...]]:
    """Return the rows of a trials table that are in use, and the exclusions of the others, in order of trial ids."""
    keys = list(zip(*(trials.column(name).to_pylist() for name in ("source_sha256", "label")), strict=True))
    if exclusions.keys().isdisjoint(keys):
        return trials, ()
    out = pa.array([key in exclusions for key in keys], pa.bool_())
    rows = trials.filter(out).select(OF_TRIALS).sort_by("trial_id").to_pylist()
    found = tuple(exclusions[row["source_sha256"], row["label"]].model_copy(update=row) for row in rows)
    return trials.filter(pc.invert(out)), found
