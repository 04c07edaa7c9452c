"""Layout of `processed/`, and functions that read trials and corrections.

    trials/<device>/<experiment>/<SHA-256>.parquet           a batch: one row per trial, its samples as lists
    stages/<device>/<experiment>/<stage>-<SHA-256>.parquet   estimates, costs, boundary
    corrections/<SHA-256>.parquet                            manual exclusions, moves and deletions
    quarantine/                                              refused logs, with the reasons

Each file is complete and named by the hash of its content. The metadata of a replacement list the replaced files.
Readers need no lock, because they skip replaced files, and list the folder again if it has changed during reading. They
thus see each trial exactly once.
"""

from __future__ import annotations

import os
import re
import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import file_hash, hash_in_name, result_files
from pipeline.base.errors import StoreError
from pipeline.base.wording import counted
from pipeline.records.findings import Record
from pipeline.records.table_files import damaged_file, metadata_of, open_table, read_table
from pipeline.records.tables import LOCATION, OF_TRIALS, TABLES, arrow_schema
from pipeline.records.trials import Booleans, Integers
from pipeline.store.names import folder_for, name_of_folder
from pipeline.store.trial_index import INDEXED, MIN_INDEXED_FILES, FileRows, indexed_rows

Result = TypeVar("Result")

TABLE = ".parquet"

VERSION_COLUMNS = ("source_path", "trial_id", "source_sha256", "profile_sha256", "source_mtime_ns")
"""Columns that identify a trial and its version."""

ATTEMPTS = 50
"""Maximum number of read attempts. A read is repeated if files were merged during it. A merge takes longer than listing
the files, so one repetition is nearly always enough.
"""

_PAUSE_S = 0.02
"""Pause before the next attempt [s]. A writer that removes many files can finish in this time."""


def trials_folder(processed: Path, *names: str) -> Path:
    """Return the folder with the trials of a device, or of one of its experiments."""
    folder = processed / "trials"
    for name in names:
        folder = folder_for(folder, name)
    return folder


def stage_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return the folder with the results of an experiment. It has the same name as the folder of its trials."""
    return processed / "stages" / trials_folder(processed, device, experiment).relative_to(processed / "trials")


def stage_file(processed: Path, device: str, experiment: str, stage: str) -> Path | None:
    """Return the file with the result of a stage for an experiment, or None if there is none."""
    return next(iter(result_files(stage_folder(processed, device, experiment), stage, TABLE)), None)


def list_devices(processed: Path) -> list[str]:
    """Return the sorted names of the devices that have trials."""
    return sorted({device for device, _ in _places(processed)})


def list_experiments(processed: Path, device: str) -> list[str]:
    """Return the experiments of a device that have trials, in natural order (2 before 10)."""
    return sorted({experiment for of, experiment in _places(processed, device) if of == device}, key=natural_key)


def _places(processed: Path, *device: str) -> set[tuple[str, str]]:
    """Return the device and the experiment of all trials, or of the trials of a device, after corrections."""
    if any(one.changes_place for one in read_corrections(processed).values()):
        table = read_trials(processed, device[0] if device else None, columns=["device", "experiment"])
        return set(zip(*(table.column(name).to_pylist() for name in table.column_names), strict=True))
    folders = {file.parent for file in trials_files(processed, *device)}
    return {(name_of_folder(folder.parent.name), name_of_folder(folder.name)) for folder in folders}


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key that orders numbers in names by value."""
    parts = re.findall(r"[0-9]+|[^0-9]", name)
    return tuple((0, int(part)) if part.isdecimal() and part.isascii() else (1, part) for part in parts)


def trials_files(processed: Path, *names: str) -> list[Path]:
    """Return the sorted files of all trials, of the trials of a device, or of one experiment."""
    return [Path(path) for path in _listing(trials_folder(processed, *names))]


def _listing(folder: Path) -> list[str]:
    """Return the sorted Parquet files below a folder. A changed file has a different name."""
    files, folders = list[str](), [os.fspath(folder)]
    while folders:
        try:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    if entry.is_dir():
                        folders.append(entry.path)
                    elif entry.name.endswith(TABLE) and not entry.name.startswith("."):
                        files.append(entry.path)
        except OSError:
            continue  # not a folder, a removed folder, or a folder without read permission
    return sorted(files)


def read_steadily(folder: Path, read: Callable[[], Result]) -> Result:
    """Return the result of a function that reads below a folder. Without a lock, read again if files were moved.

    Raises
    ------
    StoreError
        If reading fails although no file was moved, or if other processes write to the folder permanently.
    """
    for _ in range(ATTEMPTS):
        before = _listing(folder)
        try:
            result = read()
        except (StoreError, FileNotFoundError) as error:
            if _listing(folder) == before:
                if isinstance(error, StoreError):
                    raise
                raise damaged_file(Path(error.filename or folder), error.strerror) from error
        else:
            # Listing a folder is not atomic, so a batch that is merged during the listing may be missing from both
            # lists.
            if _listing(folder) == before:
                return result
        time.sleep(_PAUSE_S)
    raise StoreError(f"{folder}: changed during each of {ATTEMPTS} attempts to read it. Wait until other commands end.")


def read_trials(
    processed: Path,
    device: str | None = None,
    experiment: str | None = None,
    columns: list[str] | None = None,
    damaged: dict[Path, str] | None = None,
) -> pa.Table:
    """Return all trials, or those of a device or experiment, without samples and ordered by file name.

    A trial stored in several files is returned once. If two writers stored a log with different content, the newer
    content is returned. Corrections are applied, so that moved trials appear in their new place and deleted trials do
    not appear.

    Parameters
    ----------
    processed : Path
    device, experiment : str, optional
    columns : list of str, optional
        Columns from `tables.OF_TRIALS`. By default, all columns.
    damaged : dict of Path to str, optional
        Dictionary to which damaged files and their faults are added. Files that it already contains are skipped. By
        default, a damaged file raises an error.

    Raises
    ------
    StoreError
        If a file is damaged, or if other processes write to the folder permanently.
    """
    wanted = list(OF_TRIALS) if columns is None else columns
    corrections = {}
    try:
        corrections = {key: one for key, one in read_corrections(processed).items() if one.changes_place}
    except StoreError as error:
        if damaged is None:
            raise
        damaged[processed / "corrections"] = str(error)
    needed = list(dict.fromkeys([*wanted, *VERSION_COLUMNS, *(("device", "experiment") if corrections else ())]))
    tables = []
    place = tuple(name for name in (device, experiment) if name is not None)
    for names in [place, *moved_from(corrections.values(), place)]:
        rows = read_rows(processed, needed, damaged, *names)
        current = rows.current
        # Filtering with pyarrow would import modules, and this takes longer than reading.
        tables.append(rows.table if current.all() else rows.table.filter(pa.array(current)))
    return apply_corrections(pa.concat_tables(tables), corrections, place).select(wanted)


class Rows(NamedTuple):
    """All rows of trial files, including outdated rows.

    Parameters
    ----------
    table : pyarrow.Table
    file : int64, shape (rows,)
        Index of the file of each row.
    files : list of Path
    replaced : list of Path
        Files that were skipped because another file replaces them.
    """

    table: pa.Table
    file: Integers
    files: list[Path]
    replaced: list[Path]

    def column(self, name: str) -> list[Any]:
        """Return the values of a column."""
        values: list[Any] = self.table.column(name).to_pylist()
        return values

    @property
    def current(self) -> Booleans:
        """Mask of the valid rows: one row for each trial. If a log has several contents, the newest content is
        valid."""
        paths, trials = self.column("source_path"), self.column("trial_id")
        if len(set(paths)) == len(set(trials)) == len(trials):
            return np.ones(len(trials), dtype=np.bool_)
        versions = list(zip(*map(self.column, ("source_mtime_ns", "source_sha256", "profile_sha256")), strict=True))
        newest: dict[str, tuple[int, str, str]] = {}
        for path, version in zip(paths, versions, strict=True):
            newest[path] = max(version, newest.get(path, version))
        order = sorted(range(len(trials)), key=versions.__getitem__)
        mask = np.zeros(len(trials), dtype=np.bool_)
        mask[list({trials[row]: row for row in order if versions[row] == newest[paths[row]]}.values())] = True
        return mask


def read_rows(processed: Path, columns: Sequence[str], damaged: dict[Path, str] | None = None, *names: str) -> Rows:
    """Return columns of all rows of the files of `trials_files`. The parameters are those of `read_trials`."""
    broken: dict[Path, str] = {}

    def part_of(file: Path, columns: Sequence[str]) -> FileRows | None:
        try:
            return _file_rows(processed, file, columns)
        except StoreError as error:
            broken[file] = str(error)
            return None

    def read() -> Rows:
        broken.clear()
        files = trials_files(processed, *names)
        readable = [file for file in files if file not in (damaged or {})]
        if not names and len(readable) >= MIN_INDEXED_FILES and set(INDEXED).issuperset(columns):
            parts = indexed_rows(processed, readable, part_of)
        else:
            parts = {file: part for file in readable if (part := part_of(file, columns)) is not None}
        replaces = {stem for part in parts.values() for stem in part.replaces.split()}
        counting = [file for file in parts if file.stem not in replaces]
        kept = [parts[file].table.select(list(columns)) for file in counting]
        of = np.repeat(np.arange(len(kept)), np.array([len(table) for table in kept], dtype=np.int64))
        replaced = [file for file in files if file.stem in replaces]
        return Rows(pa.concat_tables([_schema(tuple(columns)).empty_table(), *kept]), of, counting, replaced)

    rows = read_steadily(trials_folder(processed, *names), read)
    if broken and damaged is None:
        raise StoreError(next(iter(broken.values())))
    (damaged if damaged is not None else {}).update(broken)
    return rows


def _file_rows(processed: Path, file: Path, columns: Sequence[str]) -> FileRows:
    own = [name for name in columns if name not in LOCATION]
    with open_table(file) as stored:
        replaces = metadata_of(stored.schema_arrow).get("pipeline.replaces", "")
        table = stored.read(own, use_threads=False)
    arrays = dict(zip(own, table.columns, strict=True))
    if len(own) < len(columns):
        name = file.relative_to(processed).as_posix()
        arrays |= {"sample_file": pa.array([name] * len(table)), "sample_row": pa.array(np.arange(len(table)))}
    # The types have been checked. A cast would import modules, and this takes longer than reading.
    return FileRows(pa.Table.from_arrays([arrays[name] for name in columns], schema=_schema(tuple(columns))), replaces)


@cache
def _schema(columns: tuple[str, ...]) -> pa.Schema:
    whole = arrow_schema("trials", also=LOCATION)
    return pa.schema([whole.field(name) for name in columns])


APART = 0.01
"""Relative tolerance between sampling periods of one experiment.

A clock is accurate to 1e-4, and the limit of a stiff wall is proportional to 1/T.
"""


def same_period(one: float, other: float) -> bool:
    """Return True if two sampling periods [s] may belong to the same experiment."""
    return abs(one - other) <= APART * max(one, other)


def row_parts(
    file: Path, rows: Integers | None = None, columns: list[str] | None = None
) -> Iterator[tuple[Integers, pa.Table]]:
    """Yield rows of a file, one row group at a time to save memory. By default, all rows are read."""
    with open_table(file) as stored:
        ends = np.cumsum([0, *(stored.metadata.row_group(number).num_rows for number in range(stored.num_row_groups))])
        rows = np.arange(ends[-1]) if rows is None else rows
        order = np.argsort(rows)
        cuts = np.searchsorted(rows[order], ends)
        for number, (begin, end) in enumerate(pairwise(cuts.tolist())):
            if end > begin:
                which = order[begin:end]
                group = stored.read_row_group(number, columns, use_threads=False)
                yield which, group.take(rows[which] - ends[number]) if end - begin < len(group) else group


def check_version(processed: Path) -> None:
    """Raise an error if the store was written by a different version. The message has the command that rebuilds the
    store.

    Raises
    ------
    StoreError
        If the store was written by a different version.
    """
    folders = set[str]()
    for file in trials_files(processed)[:ATTEMPTS]:
        with suppress(pa.ArrowException, OSError, KeyError):  # damaged files are reported elsewhere
            if pq.read_schema(file).names == list(TABLES["trials"]):
                return
            if hash_in_name(file.name) in (None, file_hash(file)):
                paths = pq.read_table(file, columns=["source_path"]).column("source_path").to_pylist()
                folders |= set(map(os.path.dirname, paths))
    if folders:
        raise StoreError(
            f"{processed}: was written by a different version. Rebuild the store in a new folder with `pipeline ingest "
            f"{shlex.quote(os.path.commonpath(folders))} --processed {shlex.quote(f'{processed}-new')}`. Then remove "
            "the old folder."
        )


class Exclusion(Record):
    """A manual exclusion of a trial: device, experiment, log, reason, and time of the exclusion (UTC, ISO 8601). The
    trial id is a hash of the content of the log, the label of the trial, and the conditions in the file name.
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
    """All corrections of a trial. Device and experiment are those stated in the log of the trial."""

    exclusion_reason: str = ""
    excluded_since: str = ""
    moved_device: str | None = None
    moved_experiment: str | None = None
    deleted: bool = False
    corrected_ns: int = 0

    @property
    def changes_place(self) -> bool:
        """True if the trial is no longer used in the experiment that its log states."""
        return self.deleted or self.place != (self.device, self.experiment)

    @property
    def place(self) -> tuple[str, str]:
        """Device and experiment to which the trial belongs after corrections."""
        return self.moved_device or self.device, self.moved_experiment or self.experiment

    @property
    def at_place(self) -> Exclusion:
        """The exclusion, with the device and experiment after corrections."""
        own = {name: getattr(self, name) for name in Exclusion.model_fields}
        return Exclusion(**own | dict(zip(("device", "experiment"), self.place, strict=True)))


IDENTITY = tuple(name for name in Exclusion.model_fields if name in TABLES["trials"])
"""Fields that a correction copies from the row of its trial."""


def corrections_files(processed: Path) -> list[Path]:
    """Return the files of corrections. There are several files if corrections were written at the same time."""
    return sorted((processed / "corrections").glob("*.parquet"))


def read_corrections(processed: Path) -> dict[str, Correction]:
    """Return the corrections of a store in chronological order. The samples of these trials may already have been
    removed from the store.

    If several files correct the same trial, the newest correction is returned.

    Raises
    ------
    StoreError
        If a file is damaged. The corrections are then unknown, and no result may be computed.
    """
    tables = read_steadily(processed / "corrections", lambda: [read_table(f) for f in corrections_files(processed)])
    rows = [Correction(**row) for table in tables for row in table.to_pylist()]
    return {one.trial_id: one for one in sorted(rows, key=lambda one: one.corrected_ns)}


def read_exclusions(processed: Path) -> dict[str, Exclusion]:
    """Return the exclusions of a store, in the order and with the errors of `read_corrections`."""
    known = read_corrections(processed).items()
    return {key: one.at_place for key, one in known if one.exclusion_reason and not one.deleted}


def split_trials(trials: pa.Table, exclusions: Mapping[str, Exclusion]) -> tuple[pa.Table, tuple[Exclusion, ...]]:
    """Return the rows of a trials table that are used, and the exclusions of the other trials, sorted by trial id."""
    keys = trials.column("trial_id").to_pylist()
    if exclusions.keys().isdisjoint(keys):
        return trials, ()
    out = pa.array([key in exclusions for key in keys], pa.bool_())
    rows = trials.filter(out).select(IDENTITY).sort_by("trial_id").to_pylist()
    known = ((row, exclusions[row["trial_id"]]) for row in rows)
    found = tuple(
        Exclusion(**row, exclusion_reason=one.exclusion_reason, excluded_since=one.excluded_since) for row, one in known
    )
    return trials.filter(pa.array([key not in exclusions for key in keys], pa.bool_())), found


def moved_from(corrections: Iterable[Correction], place: tuple[str, ...]) -> set[tuple[str, str]]:
    """Return the original device and experiment of trials that were moved to a device or to one of its experiments."""
    own = len(place)
    moved = ((one.device, one.experiment) for one in corrections if own and one.place[:own] == place)
    return {stored for stored in moved if stored[:own] != place}


def apply_corrections(trials: pa.Table, corrections: Mapping[str, Correction], place: tuple[str, ...]) -> pa.Table:
    """Return the trials of a device or experiment after corrections. Deleted trials are left out."""
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
        (one is None or not one.deleted) and names[: len(place)] == place
        for names, one in zip(places, found, strict=True)
    ]
    return trials.filter(pa.array(keep, pa.bool_()))


FIRST_STAGE = "response"
"""Name of the stage that has a row for each used trial."""

MOST = 3
"""Largest number of ids listed in a sentence."""


def missing_inputs(processed: Path, device: str | None = None) -> tuple[str, ...]:
    """Return a warning for each experiment whose stored results are based on trials or corrections that no longer
    exist.

    Either all devices or a single device are checked. If a later ingest may have replaced trials by the same number of
    trials, they are not reported.
    """
    found = list[str]()
    damaged: dict[Path, str] = {}
    stored = read_rows(processed, ["trial_id"], damaged)
    known = set(stored.column("trial_id"))
    written = np.array([file.stat().st_mtime_ns for file in stored.files], dtype=np.int64)[stored.file]
    try:
        corrections = read_corrections(processed)
    except StoreError:  # damaged files are reported elsewhere
        return ()
    for file in sorted((processed / "stages").glob(f"*/*/{FIRST_STAGE}-*{TABLE}")):
        of, experiment = map(name_of_folder, file.parts[-3:-1])
        if device not in (None, of):
            continue
        with suppress(OSError, StoreError), open_table(file) as table:  # a damaged stage is recomputed
            ids = table.read(["trial_id"], use_threads=False).column("trial_id").to_pylist()
            lost = sorted({*ids} - known - corrections.keys())
            out = metadata_of(table.schema_arrow).get("pipeline.excluded", "").split()
            excluded = sorted({*out} - corrections.keys())
            if damaged or len(lost) <= np.count_nonzero(written > file.stat().st_mtime_ns):
                lost = []
            lost_inputs = " and ".join(
                f"{counted(len(ids), name)} ({', '.join(ids[:MOST])}{', ...' * (len(ids) > MOST)})"
                for name, ids in (("trial", lost), ("exclusion", excluded))
                if ids
            )
            if lost_inputs:
                found.append(
                    f"Experiment {experiment} of {of}: stored results are based on {lost_inputs} that the store no "
                    "longer contains. Restore the files from a backup, or ingest the logs and exclude the trials "
                    "again."
                )
    return tuple(found)
