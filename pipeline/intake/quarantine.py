"""Logs that were refused: a copy and the reason, one folder per source below ``processed/quarantine``.

A source has at most one record: refusing it again replaces the record, accepting it removes the record. The
source itself is never touched.
"""

from __future__ import annotations

import io
import os
import shutil
from itertools import islice
from pathlib import Path

from pipeline.base.disk import NewFile, each, kept_files, remove_all, said_content, shared_mode, write_kept
from pipeline.base.errors import OTHER_COLUMNS, REMEDY, Code, LogError, StoreError, UsageError
from pipeline.base.file_names import path_of_text, path_text, storable
from pipeline.base.provenance import digest
from pipeline.base.provenance import sha256 as sha256_of
from pipeline.base.regular_files import open_regular
from pipeline.intake.sources import Source
from pipeline.records.findings import Record

LARGEST_COPY = 64 << 20
"""Bytes up to which a refused file is copied; a log is well below 1 MB, what is larger was hardly one."""

RECORD = "reason"
"""Begin of the name of a record."""

EXCERPT_ROWS, LONGEST_SHOWN = 3, 160
"""Lines shown before and behind the row at fault, and characters of each."""

REFUSED_TOGETHER = 64
"""Refused logs that go into quarantine at once; each holds a file or two open until then, of 256 that macOS allows."""

LONGEST_COPY_NAME = 100
"""Bytes of a file name that its copy keeps: a file system allows 255, with the endings of temporary files."""


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
        Row at fault, counted from 1: the line of a text file, else record, sample or message.
    reason : str
    profile, profile_sha256 : str or None
        Profile that claimed it; None where none did.
    code : str or None
        The reason for programs, one of `errors.Code`; None in records of earlier versions.
    profile_line : str or None
        Line of a profile by which it might be read.
    """

    path: str
    size: int
    mtime_ns: int
    sha256: str | None
    row: int | None
    reason: str
    profile: str | None
    profile_sha256: str | None
    code: Code | None = None
    profile_line: str | None = None

    def knows_less(self, other: QuarantineRecord | None) -> bool:
        """Return whether its profile does not fit the file at all, while another one, which did, said what is wrong."""
        if other is None or (self.size, self.mtime_ns) != (other.size, other.mtime_ns):
            return False
        return other.profile != self.profile and self.code in OTHER_COLUMNS and other.code not in OTHER_COLUMNS


def quarantine_folder(processed: Path) -> Path:
    """Return the folder of all refused logs."""
    return processed / "quarantine"


def list_quarantine(processed: Path, damaged: dict[Path, str] | None = None) -> list[QuarantineRecord]:
    """Return the records of all refused logs, sorted by path.

    Parameters
    ----------
    processed : Path
    damaged : dict of Path to str, optional
        Gets the damaged records, and why; without it they are an error.

    Raises
    ------
    StoreError
        If a record is damaged.
    OSError
        If the folder may not be read.
    """
    records = []
    try:
        names = sorted(os.listdir(quarantine_folder(processed)))
    except FileNotFoundError:
        return []
    for name in names:
        for file in kept_files(quarantine_folder(processed) / name, RECORD, ".json")[:1]:
            try:
                records.append(_read_record(file))
            except FileNotFoundError:  # its log was accepted meanwhile
                continue
            except StoreError as error:
                if damaged is None:
                    raise
                damaged[file] = str(error)
    return sorted(records, key=lambda record: record.path)


def _read_record(file: Path) -> QuarantineRecord:
    data = file.read_bytes()
    if sha256_of(data) != said_content(file.name):
        raise StoreError(f"{file}: is no quarantine record (its content is not that of its name). {REMEDY}")
    return QuarantineRecord.model_validate_json(data)


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
    path = wanted if path_of_text(wanted) != Path(wanted) else path_text(os.path.abspath(wanted))
    for record in list_quarantine(processed):
        if wanted == record_id(record) or path == record.path:
            return record
    raise UsageError(f"{wanted}: is not in quarantine. `pipeline quarantine` shows ids and paths of what is.")


def record_of(source: Source, sha256: str | None, error: LogError, profile_sha256: str | None) -> QuarantineRecord:
    """Return the record of a refused source."""
    return QuarantineRecord(
        path=source.key,
        size=source.size,
        mtime_ns=source.mtime_ns,
        sha256=sha256,
        row=error.row,
        reason=storable(error.reason),
        profile=source.profile.name if source.profile else None,
        profile_sha256=profile_sha256,
        code=error.code,
        profile_line=None if error.profile_line is None else storable(error.profile_line),
    )


class Keeper:
    """Collects refused sources and puts them into quarantine together; what is collected is kept by `flush`."""

    def __init__(self, processed: Path) -> None:
        self.processed = processed
        self.kept = 0
        self._refused: list[tuple[Source, QuarantineRecord]] = []

    def add(self, source: Source, record: QuarantineRecord) -> None:
        """Take a source and its record."""
        self._refused.append((source, record))
        if len(self._refused) >= REFUSED_TOGETHER:
            self.flush()

    def flush(self) -> None:
        """Put into quarantine what was collected: files that are synced together take a twentieth of the time."""
        each(lambda one: _refuse(self.processed, *one), self._refused)
        self.kept += len(self._refused)
        self._refused.clear()


def _refuse(processed: Path, source: Source, record: QuarantineRecord) -> None:
    """Keep a copy of each file (up to 64 MiB), and the record, which appears last.

    Copy and record may be read by whom the source may be read by.
    """
    folder = quarantine_folder(processed) / digest(record.path)
    former = set(folder.iterdir()) if folder.is_dir() else set()
    like = []
    for file in source.files:
        content = _content(file, source.within)
        if content is not None:
            data, status = content
            like.append(status)
            new = NewFile(folder, file.name, shared_mode([status], folder))
            try:
                new.stream.write(data)
                former.discard(new.publish(_copy_name(file)))
            finally:
                new.discard()
    text = record.model_dump_json() + "\n"
    # without a copy the record quotes nothing but what whoever ingests may say
    former.discard(write_kept(folder, RECORD, ".json", text.encode(), shared_mode(like, folder)))
    remove_all(sorted(former))


def release(processed: Path, path: str) -> None:
    """Remove the record of a source, if there is one: it was repaired and is now stored."""
    folder = quarantine_folder(processed) / digest(path)
    if folder.is_dir():
        # first the record: what is left after an interruption is no record any more
        remove_all(kept_files(folder, RECORD, ".json"))
        shutil.rmtree(folder, ignore_errors=True)


def _copy_name(file: Path) -> str:
    """Return the name of a copy: the file's own where it is short, printable and cannot be taken for anything else."""
    name = file.name
    plain = name.isprintable() and len(os.fsencode(name)) <= LONGEST_COPY_NAME
    # neither may a copy be taken for the record, nor for a table: each *.parquet here is readable
    own = name.startswith((".", f"{RECORD}-")) or name.lower().endswith((".parquet", ".tmp"))
    if plain and not own:
        return name
    return f"{name}.refused" if plain else f"{digest(path_text(name))}.refused"


def _content(file: Path, within: str | None) -> tuple[bytes, os.stat_result] | None:
    """Return a file's content and status; None for one that cannot be read or is too large to be copied."""
    try:
        with open_regular(file, within) as stream:
            status = os.fstat(stream.fileno())
            # at once: whatever fails here is the source's fault, which must not end the ingest of all others
            data = stream.read(LARGEST_COPY + 1) if status.st_size <= LARGEST_COPY else None
    except OSError:  # the record says that it cannot be read
        return None
    return None if data is None or len(data) > LARGEST_COPY else (data, status)


def excerpt_of(processed: Path, record: QuarantineRecord) -> list[tuple[int, str]]:
    """Return number and text of the lines around the row at fault, safe to print; nothing of a file without lines."""
    from pipeline.readers.formats.delimited import unpacked  # which loads what computes with Arrow

    folder = quarantine_folder(processed) / digest(record.path)
    copies = [file for file in sorted(folder.glob("*")) if not file.name.startswith(f"{RECORD}-")]
    if ".json" in record.path.lower() and record.code != "syntax":
        return []  # its row is that of a record
    try:
        data = unpacked(copies[0].name, copies[0].read_bytes()) if copies else b""
    except LogError:
        return []
    marks = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
    try:
        text = data.decode(marks.get(data[:2], "utf-8-sig"))
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if "\0" in text:
        return []
    at = record.row or 1
    lines = islice(enumerate(io.StringIO(text, newline=None), 1), max(at - 1 - EXCERPT_ROWS, 0), at + EXCERPT_ROWS)
    return [(number, _printable(line.rstrip("\n")[:LONGEST_SHOWN])) for number, line in lines]


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() or c == "\t" else c.encode("unicode_escape").decode() for c in text)
