"""Logs that were refused: a copy and the reason, one folder per source below ``processed/quarantine``.

A source has at most one record: refusing it again replaces the record, accepting it removes the record. The
source itself is never touched.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from pipeline.errors import StoreError
from pipeline.models import Record
from pipeline.provenance import digest
from pipeline.tables import replacing, write_text

LARGEST_COPY = 64 << 20
"""Bytes up to which a refused file is copied; a log is well below 1 MB, what is larger was hardly one."""

RECORD_FILE = "reason.json"


class QuarantineRecord(Record):
    """Why a source was refused, and how to see whether it has changed since.

    Parameters
    ----------
    path : str
        Absolute path of the source (of the first file of a pair).
    size, mtime_ns : int
        Of all its files together [byte], and the newest modification [ns].
    sha256 : str or None
        Of its content; None where it could not be read or was too large to be a log.
    row : int or None
        Line at fault, counted from 1.
    reason : str
    profile, profile_sha256 : str or None
        Profile that claimed it; None where none did.
    """

    path: str
    size: int
    mtime_ns: int
    sha256: str | None
    row: int | None
    reason: str
    profile: str | None
    profile_sha256: str | None


def quarantine_folder(processed: Path) -> Path:
    """Return the folder of all refused logs."""
    return processed / "quarantine"


def list_quarantine(processed: Path) -> list[QuarantineRecord]:
    """Return the records of all refused logs, sorted by path.

    Raises
    ------
    StoreError
        If a record is damaged.
    """
    records = []
    for file in sorted(quarantine_folder(processed).glob(f"*/{RECORD_FILE}")):
        try:
            records.append(QuarantineRecord.model_validate_json(file.read_bytes()))
        except ValidationError as error:
            raise StoreError(
                f"{file}: is no quarantine record ({error.error_count()} errors). Remove its folder and ingest again."
            ) from error
    return sorted(records, key=lambda record: record.path)


def refuse(processed: Path, record: QuarantineRecord, files: Iterable[Path]) -> None:
    """Keep a copy of each file (up to 64 MiB) and the reason; the record appears last."""
    folder = _folder_of(processed, record.path)
    folder.mkdir(parents=True, exist_ok=True)
    kept = {RECORD_FILE}
    for file in files:
        # neither may a copy be taken for the record, nor for a table: each *.parquet here is readable
        ambiguous = file.name == RECORD_FILE or file.name.lower().endswith(".parquet")
        name = f"{file.name}.refused" if ambiguous else file.name
        if _copy(file, folder / name):
            kept.add(name)
    write_text(folder / RECORD_FILE, record.model_dump_json(indent=2) + "\n")
    for old in folder.iterdir():
        if old.name not in kept:
            old.unlink(missing_ok=True)


def release(processed: Path, path: str) -> None:
    """Remove the record of a source, if there is one: it was repaired and is now stored."""
    folder = _folder_of(processed, path)
    if folder.is_dir():
        # first the record: what is left after an interruption is no record any more
        (folder / RECORD_FILE).unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)


def _folder_of(processed: Path, path: str) -> Path:
    return quarantine_folder(processed) / digest(path)


def _copy(source: Path, target: Path) -> bool:
    """Copy a file and return whether it is there; one that cannot be read or is too large is left out."""
    if not source.is_file():  # opening a pipe would wait for ever
        return False
    try:
        stream = source.open("rb")
    except OSError:  # the record says that it cannot be read
        return False
    with stream:
        if os.fstat(stream.fileno()).st_size > LARGEST_COPY:
            return False
        with replacing(target) as copy:
            shutil.copyfileobj(stream, copy, 1 << 20)
    return True
