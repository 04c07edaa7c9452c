"""All that a service keeps in one file, written beside a running server; and put back, at the same or other paths.

The file is a zip: three trees (`PLACES`) and, as its last entry, a list of all files with size, SHA-256 and time. The
database is copied by SQLite's own means; the lock of `processed/` keeps other writers of it away meanwhile.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import sqlite3
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.base.disk import TEMPORARY_ENDING, NewFile, make_folder, sync_folder
from pipeline.base.errors import StoreError, UsageError
from pipeline.base.lock import LOCK_FILE, writing
from pipeline.service.database import Database
from pipeline.service.settings import Settings

LIST = "backup.json"
KIND = "haptic-pipeline backup 1"
PIECE = 1 << 20
"""Bytes at a time."""

LONGEST_LIST = 1 << 30
"""Bytes of the list: some ten million files."""

DATABASE = "service/service.sqlite"


def places(settings: Settings) -> dict[str, Path]:
    """Return the three trees by their names in the archive."""
    return {"processed": settings.processed, "service": settings.data, "reports": settings.reports}


def backup(settings: Settings, file: Path) -> dict[str, Any]:
    """Write all that is kept into a file; return how many files and bytes it holds.

    Raises
    ------
    UsageError
        If nothing is stored, or the file would lie among what it holds.
    StoreError
        If another command writes for too long.
    """
    trees = places(settings)
    if not settings.processed.is_dir():
        raise UsageError(f"{settings.processed}: there is nothing to keep. Name the folder with --processed.")
    inside = [tree for tree in trees.values() if file.absolute().is_relative_to(tree.absolute())]
    if inside:
        raise UsageError(f"{file}: lies in {inside[0]}, which it would hold. Choose another folder.")
    listed: dict[str, tuple[int, str, int]] = {}
    with writing(settings.processed), tempfile.TemporaryDirectory() as temporary:
        copy = _copied(settings, Path(temporary))
        new = NewFile(file.absolute().parent, file.name, 0o600 if copy else None)
        try:
            with zipfile.ZipFile(new.stream, "w") as archive:
                for name, path in [*([(DATABASE, copy)] if copy else []), *_files(settings, copy)]:
                    try:
                        stream = path.open("rb")
                    except FileNotFoundError:  # a job has just replaced it, by a file of another name
                        continue
                    with stream:
                        listed[name] = _packed(archive, name, stream)
                archive.writestr(LIST, json.dumps({"kind": KIND, "files": listed}), zipfile.ZIP_DEFLATED)
            new.publish(file.name)
        finally:
            new.discard()
    return {"files": len(listed), "bytes": sum(size for size, _, _ in listed.values())}


def _copied(settings: Settings, folder: Path) -> Path | None:
    """Return a copy of the database as it is now, without logins; None where there is none."""
    if not (settings.data / "service.sqlite").is_file():
        return None
    copy = folder / "service.sqlite"
    descriptor = os.open(copy, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    os.close(descriptor)
    with (
        closing(sqlite3.connect(settings.data / "service.sqlite", timeout=30.0)) as source,
        closing(sqlite3.connect(copy, isolation_level=None)) as target,
    ):
        source.backup(target)
        target.execute("PRAGMA journal_mode = DELETE")  # one file, without a log beside it
        target.execute("DELETE FROM sessions")
    return copy


def _files(settings: Settings, database: Path | None) -> Iterator[tuple[str, Path]]:
    """Yield names and paths of all complete files; uploads that the database does not know were not acknowledged."""
    jobs = set[str]()
    if database:
        with closing(sqlite3.connect(database)) as connection:
            jobs = {job for (job,) in connection.execute("SELECT id FROM jobs WHERE kind = 'upload'")}
    for place, tree in places(settings).items():
        for here, folders, names in os.walk(tree):
            below = Path(here).relative_to(tree)
            if place == "service" and below == Path("logs"):
                folders[:] = [name for name in folders if name in jobs]
            for name in sorted(names):
                temporary = name == LOCK_FILE or name.endswith(TEMPORARY_ENDING)
                own = place == "service" and not below.parts  # the database, and what SQLite keeps beside it
                if not temporary and not own and Path(here, name).is_file():
                    yield "/".join((place, *below.parts, name)), Path(here, name)


def _packed(archive: zipfile.ZipFile, name: str, stream: BinaryIO) -> tuple[int, str, int]:
    """Write a file into an archive; return its size, hash and time of change [ns]."""
    sha256, size = hashlib.sha256(), 0
    with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as target:
        while piece := stream.read(PIECE):
            sha256.update(piece)
            size += target.write(piece)
    return size, sha256.hexdigest(), os.fstat(stream.fileno()).st_mtime_ns


def restore(settings: Settings, file: Path) -> dict[str, Any]:
    """Put what a file holds to the paths of a server that does not run; return how many files and bytes.

    Raises
    ------
    UsageError
        If one of the folders holds something, or the disk has not enough room.
    StoreError
        If the file is no backup, or damaged; nothing is left of it then.
    """
    trees = places(settings)
    for tree in trees.values():
        if tree.exists() and (not tree.is_dir() or any(tree.iterdir())):
            raise UsageError(f"{tree}: is not empty. Restore to other folders, or move this one away.")
    mark = f".restoring-{secrets.token_hex(4)}"
    new = {place: tree.absolute().with_name(f"{tree.absolute().name}{mark}") for place, tree in trees.items()}
    try:
        with zipfile.ZipFile(file) as archive:
            listed = _listed(archive, file)
            total = sum(size for size, _, _ in listed.values())
            for folder in new.values():
                make_folder(folder)
                if total > shutil.disk_usage(folder).free:
                    raise UsageError(f"{file}: {total} bytes do not fit on the disk of {folder.parent}.")
            for name, (size, sha256, changed) in listed.items():
                place, _, below = name.partition("/")
                _unpacked(archive, file, name, new[place] / below, (size, sha256, changed))
        for place, tree in trees.items():
            if tree.is_dir():
                tree.rmdir()
            new[place].rename(tree)
            sync_folder(tree.absolute().parent)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise StoreError(f"{file}: is no whole backup ({error}). Nothing was restored; take another one.") from error
    finally:
        for folder in new.values():
            shutil.rmtree(folder, ignore_errors=True)
    Database(settings.data).close()  # one of a former version is brought up to date
    return {"files": len(listed), "bytes": total}


def _listed(archive: zipfile.ZipFile, file: Path) -> dict[str, tuple[int, str, int]]:
    """Return the list of an archive; every name in it lies in one of the three trees, and is there once."""
    entries = archive.infolist()
    if not entries or entries[-1].filename != LIST or entries[-1].file_size > LONGEST_LIST:
        raise StoreError(f"{file}: is no backup of this program. `pipeline backup FILE` writes one.")
    try:
        document = json.loads(archive.read(entries[-1]))
        listed = {str(name): (int(a), str(b), int(c)) for name, (a, b, c) in document["files"].items()}
        right = document["kind"] == KIND
    except (ValueError, KeyError, TypeError, AttributeError):
        right = False
    if not right:
        raise StoreError(f"{file}: its list is none of this version. Restore it with the version that wrote it.")
    if [entry.filename for entry in entries[:-1]] != list(listed):
        raise StoreError(f"{file}: holds other files than it lists. Nothing was restored.")
    for name in listed:
        parts = name.split("/")
        if len(parts) < 2 or parts[0] not in ("processed", "service", "reports") or _leads_out(parts):
            raise StoreError(f"{file}: the name {name!r} leads out of the folders. Nothing was restored.")
    return listed


def _leads_out(parts: list[str]) -> bool:
    return any(part in ("", ".", "..") or set(part) & set("\\\0") or Path(part).is_absolute() for part in parts)


def _unpacked(archive: zipfile.ZipFile, file: Path, name: str, path: Path, expected: tuple[int, str, int]) -> None:
    """Write one file of an archive, as large as listed and no larger."""
    size, sha256, changed = expected
    found, seen = hashlib.sha256(), 0
    path.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(name) as source, path.open("xb") as target:
        while (piece := source.read(PIECE)) and seen <= size:
            found.update(piece)
            seen += target.write(piece)
        target.flush()
        os.fsync(target.fileno())
    if (seen, found.hexdigest()) != (size, sha256):
        raise StoreError(f"{file}: {name} is damaged. Nothing was restored; take another backup.")
    os.utime(path, ns=(changed, changed))
