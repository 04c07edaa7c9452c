"""Holds every stored file against the hash that it is named by, and saves what can be saved of damaged ones.

Results and theory are computed again when they are needed. Of a damaged file of trials the logs are read again where
they are as they were; of the others those trials are kept whose group of rows can still be read. What is lost is named.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import READABLE, content_of, make_folder, remove_all, said_content, sync_folder, write_text
from pipeline.base.errors import LogError, StoreError, UsageError
from pipeline.base.file_names import path_of_text
from pipeline.base.lock import WAIT_S, writing
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import RECORD, quarantine_folder
from pipeline.intake.reading import load_source
from pipeline.intake.sources import find_sources
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.profiles.profile_model import Profile
from pipeline.records.findings import Record
from pipeline.store.batch_files import NewBatch
from pipeline.store.gone import Gone, gone
from pipeline.store.storage import FILE, TABLE, read_versions

DAMAGED_FOLDER = "damaged"
"""Folder below `processed` for damaged files that cannot be made again; nothing there is ever removed."""

_IDENTITY = ("trial_id", "source_path", "source_sha256", "profile")

Remedy = Literal["save", "remove", "set aside"]
"""What is done with a damaged file: its trials read again or kept, and the file set aside; removed, since it is made
again; set aside, where nobody can tell what it said."""


class LostTrial(Record):
    """A trial that cannot be saved: its id and log, as far as they can be read."""

    trial_id: str
    source_path: str


class Damage(Record):
    """A damaged file, and what becomes of its trials.

    Parameters
    ----------
    file : str
        Below `processed`.
    fault : str
    remedy : {"save", "remove", "set aside"}
    trials, read_again, kept : int
        Trials that the file is known to hold, and those of them that are read again from their logs, or kept.
    lost : tuple of LostTrial
    """

    file: str
    fault: str
    remedy: Remedy
    trials: int = 0
    read_again: int = 0
    kept: int = 0
    lost: tuple[LostTrial, ...] = ()

    @property
    def mended(self) -> bool:
        """Whether all that it said is there again, or will be made again."""
        return self.remedy == "remove" or (self.remedy == "save" and not self.lost)


class CheckReport(Record):
    """What a check found: files that were looked at, damaged ones, whether these were repaired, and what is gone."""

    files: int
    bytes: int
    damage: tuple[Damage, ...]
    repaired: bool = False
    gone: tuple[Gone, ...] = ()


def check(
    processed: Path,
    repair: bool = False,
    profile: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    wait_s: float = WAIT_S,
    say: Callable[[str], None] | None = None,
) -> CheckReport:
    """Hold every stored file against its hash; with `repair` save what can be saved.

    Parameters
    ----------
    processed : Path
    repair : bool
    profile : str, optional
        Profile beside the shipped ones that logs are read again by.
    progress : callable, optional
        Called with (files done, files found).
    wait_s, say
        As for `lock.writing`.

    Raises
    ------
    StoreError
        If the folder cannot be read, or written to.
    """
    files, lost = list(_files(processed)), gone(processed)
    faults: dict[Path, str] = {}
    size = 0
    for done, file in enumerate(files, 1):
        with suppress(FileNotFoundError):  # merged meanwhile
            try:
                size += file.stat().st_size
                if content_of(file) != said_content(file.name):
                    faults[file] = "its content is not that of its name"
            except PermissionError as error:
                faults[file] = str(error.strerror)
        if progress:
            progress(done, len(files))
    trials = [file for file in faults if file.relative_to(processed).parts[0] == "trials"]
    damage = [_of_others(processed, file, fault) for file, fault in faults.items() if file not in trials]
    profiles = {p.name: p for p in (*shipped_profiles(), *([load_profile(profile)] if profile else []))}
    stored = _stored(processed, trials)
    salvages = [_Salvage(processed, file, profiles, stored) for file in trials]
    try:
        if repair and faults:
            with writing(processed, wait_s, say):
                for one in damage:
                    _set_aside(processed, processed / one.file, one.remedy)
                for salvage in salvages:
                    salvage.keep()
            again: dict[str, set[Path]] = defaultdict(set)
            for salvage in salvages:
                for name, logs in salvage.again.items():
                    again[name] |= set(logs.values())
            for name, paths in again.items():
                own = profile if profile is not None and load_profile(profile).name == name else name
                ingest(sorted(paths), processed, own, wait_s=wait_s)
        damage += [one.told(faults[one.file], _stored(processed, trials) if repair else None) for one in salvages]
    except OSError as error:
        raise StoreError(f"{processed}: cannot be written ({error}). Make room, and repair again.") from error
    damage.sort(key=lambda one: one.file)
    return CheckReport(files=len(files), bytes=size, damage=tuple(damage), repaired=repair, gone=lost)


def _files(processed: Path) -> Iterator[Path]:
    """Yield every file that is named by its content, or should be."""
    for tree in ("trials", "stages", "theory", "corrections"):
        yield from sorted(file for file in (processed / tree).rglob("*") if _is_stored(file))
    yield from sorted(quarantine_folder(processed).glob(f"*/{RECORD}-*"))
    yield from sorted(processed.glob("accuracy-*.json"))


def _is_stored(file: Path) -> bool:
    return file.is_file() and not file.name.startswith(".")


def _of_others(processed: Path, file: Path, fault: str) -> Damage:
    tree = file.relative_to(processed).parts[0]
    remedy: Remedy = "set aside" if tree in ("corrections", "quarantine") else "remove"
    return Damage(file=file.relative_to(processed).as_posix(), fault=fault, remedy=remedy)


def _set_aside(processed: Path, file: Path, remedy: Remedy) -> None:
    if remedy == "remove":
        remove_all([file])
        return
    # each *.parquet below the store is readable
    place = processed / DAMAGED_FOLDER / file.relative_to(processed).with_name(f"{file.name}.damaged")
    make_folder(place.parent)
    os.replace(file, place)
    sync_folder(place.parent)
    sync_folder(file.parent)


def _groups(file: Path, columns: list[str] | None) -> Iterator[pa.Table | int]:
    """Yield each group of rows of a damaged file that can be read, or how many rows one has that cannot."""
    try:
        stored = pq.ParquetFile(file, page_checksum_verification=True)
    except (pa.ArrowException, OSError, ValueError):
        return
    with stored:
        for number in range(stored.num_row_groups):
            try:
                yield stored.read_row_group(number, columns, use_threads=False)
            except (pa.ArrowException, OSError, ValueError):
                yield int(stored.metadata.row_group(number).num_rows)


def _stored(processed: Path, without: Sequence[Path]) -> set[str]:
    """Return the paths of the logs that are stored, but those in some files."""
    table, files, _ = read_versions(processed, None, None, ["source_path"], {})
    rows = zip(table.column("source_path").to_pylist(), table.column(FILE).to_pylist(), strict=True)
    return {path for path, index in rows if files[index] not in without}


class _Salvage:
    """What is done about a damaged file of trials, none of which is stored elsewhere.

    First what can be read of it is kept, if its log is not as it was any more; then it is set aside, so that the other
    logs are new to an ingest. Killed in between it has lost nothing: the next ingest reads these logs.
    """

    def __init__(self, processed: Path, file: Path, profiles: Mapping[str, Profile], stored: set[str]) -> None:
        self.processed, self.file, self.stored = processed, file, stored
        parts: dict[str, list[str]] = {name: [] for name in _IDENTITY}
        for name, values in parts.items():
            for group in _groups(file, [name]):
                values += [""] * group if isinstance(group, int) else group.column(0).to_pylist()
        self.rows = [dict(zip(parts, row, strict=True)) for row in zip(*parts.values(), strict=True)]
        self.again: dict[str, dict[str, Path]] = defaultdict(dict)
        """Logs that are where they were with the same content, by the profile that read them and their stored path."""
        for row in self.rows:
            path = path_of_text(row["source_path"])
            if row["profile"] in profiles and row["source_path"] not in stored:
                with suppress(LogError, UsageError, OSError, ValueError):
                    (source,) = find_sources([path], (profiles[row["profile"]],))
                    if load_source(source)[1] == row["source_sha256"]:
                        self.again[row["profile"]][row["source_path"]] = path
        known = stored.union(*self.again.values())
        self.kept = {path for group in self._readable(known) for path in group.column("source_path").to_pylist()}

    def _readable(self, without: Collection[str]) -> Iterator[pa.Table]:
        """Yield the trials that can be read, but those of some logs."""
        for group in _groups(self.file, None):
            if not isinstance(group, int):
                wanted = [path not in without for path in group.column("source_path").to_pylist()]
                if any(wanted):
                    yield group.filter(pa.array(wanted))

    def keep(self) -> None:
        """Store what can be read and not be read again; set the file aside."""
        with ExitStack() as stack:
            new: NewBatch | None = None
            for trials in self._readable(self.stored.union(*self.again.values())):
                row = trials.select(["device", "experiment", "motion"]).slice(0, 1).to_pylist()[0]
                if new is None:
                    mode = self.file.stat().st_mode & READABLE
                    new = NewBatch(self.processed, row["device"], row["experiment"], row["motion"], mode)
                    stack.callback(new.discard)
                new.write(trials)
            if new is not None:
                new.publish()
        _set_aside(self.processed, self.file, "set aside")

    def told(self, fault: str, stored: set[str] | None) -> Damage:
        """Return what became of the trials by what is stored now; without it what would become of them."""
        again = self.stored.union(*self.again.values()) - self.kept
        there = stored if stored is not None else again | self.kept
        lost = [row for row in self.rows if row["source_path"] not in there]
        found = Damage(
            file=self.file.relative_to(self.processed).as_posix(),
            fault=fault,
            remedy="save" if self.rows else "set aside",
            trials=len(self.rows),
            read_again=sum(row["source_path"] in again & there for row in self.rows),
            kept=sum(row["source_path"] in self.kept for row in self.rows),
            lost=tuple(LostTrial(trial_id=row["trial_id"], source_path=row["source_path"]) for row in lost),
        )
        if stored is not None and lost:
            text = json.dumps([one.model_dump() for one in found.lost], indent=1)
            list_of = self.processed / DAMAGED_FOLDER / f"{found.file.removesuffix(TABLE)}.lost.json"
            write_text(list_of, text + "\n")
        return found
