"""Quarantine of refused sources. There is one record for each source, with the reason and a remedy.

Each record is in a separate folder below ``processed/quarantine``. If a source is refused again, its record is
replaced. If the source is accepted, the record is removed. The source itself is never changed or copied.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from pipeline.base.disk import map_in_threads, read_result, result_files, write_result
from pipeline.base.errors import OTHER_COLUMNS, REMEDY, LogError, StoreError, UsageError
from pipeline.base.paths import path_of_text, path_text, storable
from pipeline.base.provenance import digest
from pipeline.intake.sources import Source
from pipeline.records.findings import Record

RECORD = "reason"
"""Prefix of the file name of a record."""


class QuarantineRecord(Record):
    """Reason why a source was refused, with properties by which a later change of the source is detected.

    Parameters
    ----------
    path : str
        Absolute path of the source. For a pair of files, the path of the first file.
    size, mtime_ns : int
        Total size of its files [byte], and time of the newest modification [ns].
    sha256 : str or None
        Hash of its content. None if it could not be read or was too large to be a log.
    row : int or None
        Faulty row, counted from 1. A row is a line of a text file, otherwise a record, sample or message.
    reason : str
    profile, profile_sha256 : str or None
        Profile that claimed the source, or None.
    code : str
        Machine-readable reason, one of `errors.CURES`.
    profile_line : str or None
        Line of the profile with which the source might be readable.
    """

    path: str
    size: int
    mtime_ns: int
    sha256: str | None
    row: int | None
    reason: str
    profile: str | None
    profile_sha256: str | None
    code: str
    profile_line: str | None = None

    def is_less_specific(self, other: QuarantineRecord | None) -> bool:
        """Return True if this profile does not match the columns of the file, while the profile of the other record
        found a fault in the log."""
        if other is None or (self.size, self.mtime_ns) != (other.size, other.mtime_ns):
            return False
        return other.profile != self.profile and self.code in OTHER_COLUMNS and other.code not in OTHER_COLUMNS


FOLDER = "quarantine"
"""Folder below `processed` with the records of all refused logs."""


def list_quarantine(processed: Path, damaged: dict[Path, str] | None = None) -> list[QuarantineRecord]:
    """Return the records of all refused logs, sorted by path.

    Parameters
    ----------
    processed : Path
    damaged : dict of Path to str, optional
        Receives the damaged records and their faults. By default, a damaged record raises an error.

    Raises
    ------
    StoreError
        If a record is damaged.
    OSError
        If the folder cannot be read.
    """
    records = []
    try:
        folders = sorted((processed / FOLDER).iterdir())
    except FileNotFoundError:
        return []
    for folder in folders:
        if (data := read_result(folder, RECORD, ".json")) is not None:
            records.append(QuarantineRecord.model_validate_json(data))
            continue
        for file in result_files(folder, RECORD, ".json")[:1]:  # a log accepted in the meantime has no record
            fault = f"{file}: not a quarantine record (its content does not match its name). {REMEDY}"
            if damaged is None:
                raise StoreError(fault)
            damaged[file] = fault
    return sorted(records, key=lambda record: record.path)


def record_id(record: QuarantineRecord) -> str:
    """Return the id of a record, which is the name of its folder."""
    return digest(record.path)


def find_record(processed: Path, wanted: str) -> QuarantineRecord:
    """Return the record of a source, given its id or path.

    Parameters
    ----------
    processed : Path
    wanted : str
        Id, or path of the source, which may be relative to the current folder.

    Raises
    ------
    UsageError
        If no log with this id or path is in quarantine.
    """
    path = wanted if path_of_text(wanted) != Path(wanted) else path_text(os.path.abspath(wanted))
    for record in list_quarantine(processed):
        if wanted == record_id(record) or path == record.path:
            return record
    raise UsageError(f"{wanted}: is not in quarantine. `pipeline quarantine` lists the ids and paths of refused logs.")


def record_of(source: Source, sha256: str | None, error: LogError) -> QuarantineRecord:
    """Return the record of a refused source."""
    return QuarantineRecord(
        path=source.key,
        size=source.size,
        mtime_ns=source.mtime_ns,
        sha256=sha256,
        row=error.row,
        reason=storable(error.reason),
        profile=source.profile.name if source.profile else None,
        profile_sha256=source.profile_sha256,
        code=error.code,
        profile_line=None if error.profile_line is None else storable(error.profile_line),
    )


Refused = tuple[Source, QuarantineRecord]


def quarantine_sources(processed: Path, refused: Sequence[Refused]) -> None:
    """Put refused sources into quarantine. The files of all records are synced together, which is twenty times as fast
    as syncing them one by one.

    A record quotes its log. Therefore, the record gets the same read permissions as the log.
    """

    def write(one: Refused) -> None:
        source, record = one
        text = record.model_dump_json() + "\n"
        write_result(processed / FOLDER / record_id(record), RECORD, ".json", text.encode(), source.mode)

    map_in_threads(write, refused)


def remove_from_quarantine(processed: Path, path: str) -> None:
    """Remove the record of a source that was repaired and is now stored, if there is one."""
    shutil.rmtree(processed / FOLDER / digest(path), ignore_errors=True)
