"""What people correct by hand: trials that are excluded, count as of another experiment or device, or are deleted.

They stand in ``processed/corrections`` and are applied on reading, so that what is stored stays as the logs have it. A
trial is known by the content of its log: a correction stays when that is ingested again, merged or repaired, and a log
with other content is another trial. Each change writes a new file with all corrections in place of those that it read;
of two that were written at once both count, and of two of one trial the newer.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import pyarrow as pa

from pipeline.base.disk import new_file, remove_all
from pipeline.base.provenance import stamp
from pipeline.records.findings import Record
from pipeline.records.table_files import damaged_file, metadata_of, parquet_bytes, read_table
from pipeline.records.tables import TABLES, to_arrow


class Exclusion(Record):
    """A trial that is excluded by hand: where it belongs, its log, why, and since when (UTC, ISO 8601).

    It is known by its id, a hash of its log, of which trial of that it is, and of what the name tells.
    """

    trial_id: str
    label: str | None
    device: str
    experiment: str
    source_path: str
    source_sha256: str
    exclusion_reason: str
    excluded_since: str


class Correction(Exclusion):
    """All that was corrected of a trial; device and experiment are those of its log."""

    exclusion_reason: str = ""
    excluded_since: str = ""
    moved_device: str | None = None
    moved_experiment: str | None = None
    deleted: bool = False
    corrected_ns: int = 0

    @property
    def changes_place(self) -> bool:
        """Whether the trial counts where its log says no more."""
        return self.deleted or self.place != (self.device, self.experiment)

    @property
    def place(self) -> tuple[str, str]:
        """Device and experiment that the trial counts as one of."""
        return self.moved_device or self.device, self.moved_experiment or self.experiment


IDENTITY = tuple(name for name in Exclusion.model_fields if name in TABLES["trials"])
"""What a correction takes from the row of its trial."""


def corrections_files(processed: Path) -> list[Path]:
    """Return the files of corrections: one, but where two were written at once."""
    return sorted((processed / "corrections").glob("*.parquet"))


def read_corrections(processed: Path) -> dict[str, Correction]:
    """Return the corrections of a store in the order in which they were made, of trials no longer stored, too.

    Raises
    ------
    StoreError
        If a file is damaged: what is corrected is then not known, and nothing may be computed.
    """
    for _ in range(2):  # one may have taken the place of another while they were read
        files = corrections_files(processed)
        try:
            tables = {file: read_table(file) for file in files}
            break
        except FileNotFoundError as error:
            gone = error
    else:
        raise damaged_file(processed / "corrections", gone) from gone
    replaced = {name for t in tables.values() for name in metadata_of(t.schema).get("pipeline.replaces", "").split()}
    rows = [row for file, table in tables.items() if file.stem not in replaced for row in table.to_pylist()]
    found = [Correction(**row) for row in sorted(rows, key=lambda row: int(row["corrected_ns"]))]
    return {one.trial_id: one for one in found}


def write_corrections(processed: Path, new: Iterable[Correction]) -> None:
    """Store corrections beside those of other trials, in one step. For who holds the lock of the store."""
    known, former = read_corrections(processed), corrections_files(processed)
    now = max([time.time_ns(), *(one.corrected_ns + 1 for one in known.values())])
    known |= {one.trial_id: one.model_copy(update={"corrected_ns": now}) for one in new}
    rows = [one.model_dump() for one in known.values()]
    columns = {name: [row[name] for row in rows] for name in TABLES["corrections"]}
    metadata = stamp(replaces=" ".join(file.stem for file in former))
    with new_file(processed / "corrections", ending=".parquet") as file:
        file.stream.write(parquet_bytes(to_arrow("corrections", columns, metadata=metadata)))
    remove_all(old for old in former if old != file.path)


def carry(processed: Path, ids: Mapping[str, str]) -> None:
    """Let corrections of trials hold for those of another id, too: their logs were renamed."""
    known = read_corrections(processed)
    new = [known[old].model_copy(update={"trial_id": now}) for old, now in ids.items() if old in known]
    if new:
        write_corrections(processed, new)


def read_exclusions(processed: Path) -> dict[str, Exclusion]:
    """Return the exclusions of a store; order and errors as those of `read_corrections`."""
    found = {}
    for key, one in read_corrections(processed).items():
        if one.exclusion_reason and not one.deleted:
            values = one.model_dump(include=set(Exclusion.model_fields))
            found[key] = Exclusion(**values | dict(zip(("device", "experiment"), one.place, strict=True)))
    return found


def split_trials(trials: pa.Table, exclusions: Mapping[str, Exclusion]) -> tuple[pa.Table, tuple[Exclusion, ...]]:
    """Return the rows of a trials table that are in use, and the exclusions of the others, in order of trial ids."""
    keys = trials.column("trial_id").to_pylist()
    if exclusions.keys().isdisjoint(keys):
        return trials, ()
    out = pa.array([key in exclusions for key in keys], pa.bool_())
    rows = trials.filter(out).select(IDENTITY).sort_by("trial_id").to_pylist()
    found = tuple(exclusions[row["trial_id"]].model_copy(update=row) for row in rows)
    return trials.filter(pa.array([key not in exclusions for key in keys], pa.bool_())), found


def moved_from(
    corrections: Iterable[Correction], device: str | None, experiment: str | None
) -> dict[tuple[str, str], None]:
    """Return where trials are stored that count as of a device, or of one of its experiments, by hand."""
    if device is None:
        return {}
    wanted = (one for one in corrections if one.place[0] == device and experiment in (None, one.place[1]))
    return {(one.device, one.experiment): None for one in wanted if experiment is not None or one.device != device}


def applied(
    trials: pa.Table, corrections: Mapping[str, Correction], device: str | None, experiment: str | None
) -> pa.Table:
    """Return trials with device and experiment as corrected, those of a device or experiment, without deleted ones."""
    if not corrections:
        return trials
    found = [corrections.get(key) for key in trials.column("trial_id").to_pylist()]
    for at, name in enumerate(("device", "experiment")):
        values = trials.column(name).to_pylist()
        moved = [value if one is None else one.place[at] for value, one in zip(values, found, strict=True)]
        index = trials.schema.get_field_index(name)
        trials = trials.set_column(index, trials.schema.field(index), pa.array(moved, pa.string()))
    places = zip(*(trials.column(name).to_pylist() for name in ("device", "experiment")), strict=True)
    keep = [
        (one is None or not one.deleted) and device in (None, place[0]) and experiment in (None, place[1])
        for place, one in zip(places, found, strict=True)
    ]
    return trials.filter(pa.array(keep, pa.bool_()))
