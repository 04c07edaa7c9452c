"""Logs that were refused: a copy and the reason, one folder per source below ``processed/quarantine``.

A source has at most one record: refusing it again replaces the record, accepting it removes the record. The
source itself is never touched.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from pipeline.base.disk import NewFile, make_folders, publish_all, remove
from pipeline.base.errors import OTHER_COLUMNS, REMEDY, Code, LogError, StoreError, UsageError
from pipeline.base.file_names import path_of_text, path_text, storable
from pipeline.base.json_seal import sealed_json, unsealed_json
from pipeline.base.provenance import digest
from pipeline.base.regular_files import open_regular
from pipeline.intake.excerpt import NOTHING, Excerpt, excerpt_of
from pipeline.intake.sources import Source
from pipeline.records.findings import Record

LARGEST_COPY = 64 << 20
"""Bytes up to which a refused file is copied; a log is well below 1 MB, what is larger was hardly one."""

RECORD_FILE = "reason.json"

REFUSED_TOGETHER = 64
"""Refused logs that go into quarantine at once; each holds a file or two open until then, of 256 that macOS allows."""

LONGEST_COPY_NAME = 100
"""Bytes of a file name that its copy keeps: a file system allows 255, with the endings of temporary files."""

_TEXTS = ("native", "delimited", "json")
"""Formats whose files have lines."""


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
    byte : int or None
        Offset of the row in the file, counted from 0; None where rows are no lines, or the file is packed.
    excerpt : tuple of (int, str)
        Lines around the row: number, counted from 1, and text with control characters escaped.
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
    byte: int | None = None
    excerpt: tuple[tuple[int, str], ...] = ()

    def same_refusal(self, other: QuarantineRecord | None) -> bool:
        """Return whether another record says the same of the same content; byte and excerpt follow from these."""
        place = {"byte": None, "excerpt": ()}
        return other is not None and self.model_copy(update=place) == other.model_copy(update=place)

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
        file = quarantine_folder(processed) / name / RECORD_FILE
        try:
            records.append(read_record(file))
        except (FileNotFoundError, NotADirectoryError):  # its log was accepted meanwhile, or it is no record
            continue
        except StoreError as error:
            if damaged is None:
                raise
            damaged[file] = str(error)
    return sorted(records, key=lambda record: record.path)


def read_record(file: Path) -> QuarantineRecord:
    """Return the record in a file.

    Raises
    ------
    StoreError
        If it is damaged.
    OSError
        If it is not there.
    """
    try:
        return QuarantineRecord.model_validate(unsealed_json(file.read_bytes()))
    except ValueError as error:
        text = f"{error.error_count()} errors" if isinstance(error, ValidationError) else str(error)
        raise StoreError(f"{file}: is no quarantine record ({text}). {REMEDY}") from error


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
    raise UsageError(f"{wanted}: is not in quarantine. `pipeline quarantine list` shows ids and paths of what is.")


def record_of(source: Source, sha256: str | None, error: LogError, profile_sha256: str | None) -> QuarantineRecord:
    """Return the record of a refused source, without byte and excerpt."""
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


@dataclass(frozen=True)
class Refused:
    """A source that is refused, and its record without byte and excerpt, which are taken from its content."""

    source: Source
    record: QuarantineRecord


class Keeper:
    """Collects refused sources and puts them into quarantine together; what is collected is kept by `flush`."""

    def __init__(self, processed: Path) -> None:
        self.processed = processed
        self.kept = 0
        self._refused: list[Refused] = []

    def add(self, source: Source, record: QuarantineRecord) -> None:
        """Take a source and its record."""
        self._refused.append(Refused(source, record))
        if len(self._refused) >= REFUSED_TOGETHER:
            self.flush()

    def flush(self) -> None:
        """Put into quarantine what was collected."""
        if self._refused:
            refuse(self.processed, self._refused)
            self.kept += len(self._refused)
            self._refused.clear()


def refuse(processed: Path, refused: Sequence[Refused]) -> None:
    """Keep a copy of each file (up to 64 MiB) and the reason, with the lines around it; the records appear last.

    Copy and record may be read by whom the source may be read by. All are on the disk when this returns: files that
    are synced together take a twentieth of the time of one after the other.
    """
    folders = [_folder_of(processed, one.record.path) for one in refused]
    former = [set(os.listdir(folder)) if folder.is_dir() else set() for folder in folders]
    make_folders(folders)
    new: list[NewFile] = []
    copies: list[tuple[NewFile, str]] = []
    records: list[tuple[NewFile, str]] = []
    try:
        for folder, one, stale in zip(folders, refused, former, strict=True):
            copied, record = _prepared(folder, one, new)
            copies += copied
            records.append((record, RECORD_FILE))
            stale -= {RECORD_FILE, *(name for _, name in copied)}
        publish_all(copies, records)
    finally:
        for file in new:
            file.discard()
    for folder, stale in zip(folders, former, strict=True):
        for name in stale:
            remove(folder / name)


def _prepared(folder: Path, refused: Refused, new: list[NewFile]) -> tuple[list[tuple[NewFile, str]], NewFile]:
    """Write the copies and the record of a source under temporary names, which `new` is told of."""
    copies: list[tuple[NewFile, str]] = []
    like: list[os.stat_result] = []
    found: Excerpt | None = None
    for file in refused.source.files:
        content = _content(file, refused.source.within)
        if content is None:
            continue
        data, status = content
        like.append(status)
        copy = NewFile(folder, file.name, (status,))
        new.append(copy)
        copy.stream.write(data)
        copies.append((copy, _copy_name(file)))
        found = found or _excerpt(refused, storable(file.name), data)
    found = found or NOTHING
    whole = refused.record.model_copy(update={"byte": found.byte, "excerpt": found.lines})
    record = NewFile(folder, RECORD_FILE, like)
    new.append(record)
    record.stream.write(sealed_json(whole.model_dump_json() + "\n").encode())
    return copies, record


def release(processed: Path, path: str) -> None:
    """Remove the record of a source, if there is one: it was repaired and is now stored."""
    folder = _folder_of(processed, path)
    if folder.is_dir():
        # first the record: what is left after an interruption is no record any more
        (folder / RECORD_FILE).unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)


def _folder_of(processed: Path, path: str) -> Path:
    return quarantine_folder(processed) / digest(path)


def _copy_name(file: Path) -> str:
    """Return the name of a copy: the file's own where it is short, printable and cannot be taken for anything else."""
    name = file.name
    plain = name.isprintable() and len(os.fsencode(name)) <= LONGEST_COPY_NAME
    # neither may a copy be taken for the record, nor for a table: each *.parquet here is readable
    ambiguous = name == RECORD_FILE or name.startswith(".") or name.lower().endswith((".parquet", ".tmp"))
    if plain and not ambiguous:
        return name
    return f"{name}.refused" if plain else f"{digest(path_text(name))}.refused"


def _excerpt(refused: Refused, name: str, data: bytes) -> Excerpt:
    """Return the lines around the row at fault, where rows of the format are lines."""
    record, profile = refused.record, refused.source.profile
    kind = profile.format if profile else None
    if kind not in _TEXTS or (kind == "json" and record.code != "syntax" and record.row is not None):
        # in JSON a row is a record, but for what is no JSON
        return NOTHING
    return excerpt_of(name, data, record.row, kind, profile.encoding if profile else "utf-8")


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
