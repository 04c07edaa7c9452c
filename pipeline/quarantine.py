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

from pipeline.errors import LogError, StoreError, UsageError
from pipeline.models import Record
from pipeline.profile_layout import format_of
from pipeline.profile_text import TextLayout
from pipeline.provenance import digest
from pipeline.readers.plain_text import plain_text
from pipeline.tables import replacing, write_text

LARGEST_COPY = 64 << 20
"""Bytes up to which a refused file is copied; a log is well below 1 MB, what is larger was hardly one."""

RECORD_FILE = "reason.json"

EXCERPT_ROWS = 3
"""Lines shown before and behind the row at fault."""

NO_JSON = "is no JSON"
"""Words of a refusal whose row is a line of a JSON file, not a record."""

LONGEST_LINE = 500
"""Characters of a line that are shown."""


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


def record_id(record: QuarantineRecord) -> str:
    """Return the id of a record: the name of its folder."""
    return digest(record.path)


def find_record(processed: Path, wanted: str) -> QuarantineRecord:
    """Return the record of a source by its id or path.

    Parameters
    ----------
    processed : Path
    wanted : str
        Id, or path of the source: absolute, or from the current folder.

    Raises
    ------
    UsageError
        If nothing of this id or path is in quarantine.
    """
    path = os.path.abspath(wanted)
    for record in list_quarantine(processed):
        if wanted == record_id(record) or path == record.path:
            return record
    raise UsageError(f"{wanted}: is not in quarantine. `pipeline quarantine list` shows ids and paths of what is.")


def excerpt(processed: Path, record: QuarantineRecord, around: int = EXCERPT_ROWS) -> list[tuple[int, str]]:
    """Return the lines of a refused text file around the row at fault (its first ones where there is none).

    Parameters
    ----------
    processed : Path
    record : QuarantineRecord
    around : int
        Lines before and behind.

    Returns
    -------
    list of (int, str)
        Line number, counted from 1, and text; empty where no copy was kept or rows of the file are no lines.
    """
    folder, name = _folder_of(processed, record.path), Path(record.path).name
    copy = next((folder / kept for kept in (f"{name}.refused", name) if (folder / kept).is_file()), None)
    if copy is None:
        return []
    data = copy.read_bytes()
    kind = format_of(name, data)
    # elsewhere a row is a record, a sample or a message
    if kind not in ("delimited", "native") and not (kind == "json" and NO_JSON in record.reason):
        return []
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    try:
        text, _ = plain_text(TextLayout(encoding=encoding), name, data)
    except LogError:
        text = data.decode("latin-1")
    if "\0" in text:
        return []
    lines = text.split("\n")
    lines = lines[:-1] if text.endswith("\n") else lines
    row = record.row or 1
    first = max(row - around, 1)
    return [(number, lines[number - 1][:LONGEST_LINE]) for number in range(first, min(row + around, len(lines)) + 1)]


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
