"""Check of every stored file against the hash in its name, and recovery of damaged files.

Damaged results and theory are removed, and recomputed when they are needed. The logs of a damaged trial file are read
again if they exist; otherwise, trials in readable row groups are kept. Lost trials are listed.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Literal

import pyarrow as pa

from pipeline.base.disk import (
    READABLE,
    file_hash,
    hash_in_name,
    make_folder,
    remove_all,
    sync_folder,
    write_text,
    writing,
)
from pipeline.base.errors import ProfileError, StoreError
from pipeline.base.paths import path_of_text
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import FOLDER, RECORD
from pipeline.records.findings import Record
from pipeline.records.table_files import open_table
from pipeline.store.batch_files import GROUP_TRIALS, ExperimentKey, write_batch
from pipeline.store.storage import TABLE, missing_inputs, read_rows

DAMAGED_FOLDER = "damaged"
"""Folder below `processed` for damaged files that cannot be recomputed. Files in this folder are never removed."""

_UNREADABLE = (pa.ArrowException, OSError, ValueError)

Remedy = Literal["save", "remove", "set aside"]
"""Remedy for a damaged file.

"save" means that the trials of the file are read again or copied, and that the file is set aside. "remove" means that
its content is recomputed. "set aside" means that its content is lost.
"""


class Damage(Record):
    """A damaged file, and the treatment of its trials.

    Parameters
    ----------
    file : str
        Path below `processed`.
    fault : str
    remedy : {"save", "remove", "set aside"}
    trials, read_again, kept : int
        Number of trials known to be in the file, of trials that are (or can be) read again from their logs, and of
        trials recovered from the file.
    lost : tuple of dict
        ``trial_id`` and ``source_path``, if readable, of the trials that cannot be recovered.
    """

    file: str
    fault: str
    remedy: Remedy
    trials: int = 0
    read_again: int = 0
    kept: int = 0
    lost: tuple[dict[str, str], ...] = ()

    @property
    def mended(self) -> bool:
        """True if the complete content is available again or will be recomputed."""
        return self.remedy == "remove" or (self.remedy == "save" and not self.lost)


class CheckReport(Record):
    """Result of a check: numbers of files and bytes read, damaged files, True if they were repaired, and missing
    trials."""

    files: int
    bytes: int
    damage: tuple[Damage, ...]
    repaired: bool = False
    gone: tuple[str, ...] = ()


def check(
    processed: Path,
    repair: bool = False,
    progress: Callable[[int, int], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> CheckReport:
    """Check every stored file against its hash. With `repair`, recover what can be recovered.

    If a repair is killed, no data are lost, and the next repair continues.

    Parameters
    ----------
    processed : Path
    repair : bool
    progress : callable, optional
        Called with (files done, files found).
    say
        As for `disk.writing`.

    Raises
    ------
    StoreError
        If the folder cannot be read or written.
    """
    files, lost = list(_files(processed)), missing_inputs(processed)
    faults: dict[Path, str] = {}
    size = 0
    for done, file in enumerate(files, 1):
        with suppress(FileNotFoundError):  # merged in the meantime
            try:
                size += file.stat().st_size
                if file_hash(file) != hash_in_name(file.name):
                    faults[file] = "its content does not match the hash in its name"
            except PermissionError as error:
                faults[file] = str(error.strerror)
        if progress:
            progress(done, len(files))
    trials = {file: _rows_of(file) for file in faults if file.relative_to(processed).parts[0] == "trials"}
    if repair and trials:
        _read_again(processed, [row for rows in trials.values() for row in rows if _is_there(row)], faults, say)
    with writing(processed, say=say) if repair and faults else nullcontext():
        damage = [_of_trials(processed, file, rows, faults, repair) for file, rows in trials.items()]
        damage += [_of_others(processed, file, faults, repair) for file in faults.keys() - trials.keys()]
    damage.sort(key=lambda one: one.file)
    return CheckReport(files=len(files), bytes=size, damage=tuple(damage), repaired=repair, gone=lost)


def _files(processed: Path) -> Iterator[Path]:
    """Yield every file whose name should contain the hash of its content."""
    for tree in ("trials", "stages", "theory", "corrections"):
        yield from sorted(f for f in (processed / tree).rglob("*") if f.is_file() and not f.name.startswith("."))
    yield from sorted((processed / FOLDER).glob(f"*/{RECORD}-*"))
    yield from sorted(processed.glob("accuracy-*.json"))


def _of_others(processed: Path, file: Path, faults: dict[Path, str], repair: bool) -> Damage:
    """Remove a damaged file without trials, or set it aside."""
    name = file.relative_to(processed)
    remedy: Remedy = "set aside" if name.parts[0] in ("corrections", "quarantine") else "remove"
    if repair and remedy == "remove":
        remove_all([file])
    elif repair:
        _set_aside(processed, file)
    return Damage(file=name.as_posix(), fault=faults[file], remedy=remedy)


def _set_aside(processed: Path, file: Path) -> None:
    # Readers find every *.parquet file below the store, so the file gets a different extension.
    place = processed / DAMAGED_FOLDER / file.relative_to(processed).with_name(f"{file.name}.damaged")
    make_folder(place.parent)
    os.replace(file, place)
    sync_folder(place.parent)
    sync_folder(file.parent)


def _groups(file: Path) -> Iterator[pa.Table]:
    """Yield the readable row groups of a damaged file."""
    with suppress(StoreError), open_table(file) as stored:
        for number in range(stored.num_row_groups):
            with suppress(*_UNREADABLE):
                yield stored.read_row_group(number, use_threads=False)


def _rows_of(file: Path) -> list[dict[str, str]]:
    """Return the id, log and profile of each trial of a damaged file. The result is empty if these columns are
    unreadable."""
    columns: dict[str, list[str]] = {name: [] for name in ("trial_id", "source_path", "profile")}
    with suppress(StoreError), open_table(file) as stored:
        for number in range(stored.num_row_groups):
            for name, values in columns.items():
                rows, found = min(stored.metadata.row_group(number).num_rows, GROUP_TRIALS), list[str]()
                with suppress(*_UNREADABLE):
                    found = stored.read_row_group(number, [name], use_threads=False).column(name).to_pylist()
                values += found if len(found) == rows and all(found) else [""] * rows
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _read_again(
    processed: Path, rows: list[dict[str, str]], faults: dict[Path, str], say: Callable[[str], None] | None
) -> None:
    """Ingest the logs of damaged files again, from their paths and with the profiles that read them first."""
    for profile in sorted({row["profile"] for row in rows}):
        logs = {path_of_text(row["source_path"]) for row in rows if row["profile"] == profile}
        with suppress(ProfileError):  # without the profile file of the lab, these logs are not read again
            ingest(sorted(logs), processed, profile or None, say=say, damaged=faults)


def _is_there(row: dict[str, str]) -> bool:
    return bool(row["source_path"]) and path_of_text(row["source_path"]).exists()


def _of_trials(
    processed: Path, file: Path, rows: list[dict[str, str]], faults: dict[Path, str], repair: bool
) -> Damage:
    """Store readable trials of a damaged file whose logs are missing, set the file aside, and list the lost trials.

    Without `repair`, no file is changed, and the result is only reported.
    """
    # If all logs were read again, the same file was written, and is now complete.
    there = {other: text for other, text in faults.items() if other.exists()}
    damaged = {other: text for other, text in there.items() if file_hash(other) != hash_in_name(other.name)}
    stored = set(read_rows(processed, ["source_path"], damaged).column("source_path"))
    if not repair:
        stored |= {row["source_path"] for row in rows if _is_there(row)}
    places, kept = defaultdict[ExperimentKey, list[pa.Table]](list), set[str]()
    for group in _groups(file) if file in damaged else ():
        new = group.filter(pa.array([path not in stored for path in group.column("source_path").to_pylist()]))
        if new.num_rows:
            device, experiment, motion = (new.column(name)[0].as_py() for name in ("device", "experiment", "motion"))
            places[ExperimentKey(device, experiment, motion, file.stat().st_mode & READABLE)].append(new)
            kept |= set(new.column("trial_id").to_pylist())
    gone = (row for row in rows if row["source_path"] not in stored and row["trial_id"] not in kept)
    lost = tuple({key: row[key] for key in ("trial_id", "source_path")} for row in gone)
    found = Damage(
        file=file.relative_to(processed).as_posix(),
        fault=faults[file],
        remedy="save" if rows else "set aside",
        trials=len(rows),
        read_again=sum(row["source_path"] in stored for row in rows),
        kept=len(kept),
        lost=lost,
    )
    if repair:
        written = [write_batch(processed, place, parts) for place, parts in places.items()]
        if file in damaged and file not in written:
            _set_aside(processed, file)
        if lost:
            path = processed / DAMAGED_FOLDER / f"{found.file.removesuffix(TABLE)}.lost.json"
            write_text(path, json.dumps(lost, indent=1) + "\n")
    return found
