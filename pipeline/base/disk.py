"""Atomic files, named by the hash of their content. A file appears completely or not at all, even after a power
failure.

A new file is written under a temporary name, synced and renamed. Then its folder is synced. The file is invisible
before the rename and durable after it. A file with the hash of its content in its name needs no other checksum. Two
writers of equal content write the same file.

Only one command at a time writes to `processed/`. It locks the file ``processed/.lock``. The kernel releases the lock
when the process ends for any reason. The lock file itself remains. Readers need no lock, because stored files are
always complete. This works on Linux, macOS and Windows, on local disks and on NFS 4 or newer.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import socket
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, TypeVar

from pipeline.base.errors import StoreError

Item = TypeVar("Item")
Result = TypeVar("Result")

TEMPORARY_ENDING = ".tmp"
"""File extension of an incomplete file, which readers ignore."""

_TEMPORARY = f".*.{'[0-9a-f]' * 16}{TEMPORARY_ENDING}"
"""Name pattern of incomplete files."""

_ABANDONED_S = 7 * 86400.0
"""Age of a temporary file above which it counts as abandoned [s]. Even a large map is written within hours."""

_LONGEST_NAME = 200
"""Largest number of bytes of the final name in the temporary name. File systems allow 255."""

_SYNCS = 16
"""Number of files that are synced together. 500 files took 2.5 s in sequence on ext4, and 0.1 s with 16 together."""

_OPEN = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
_NEW = _OPEN | os.O_EXCL | getattr(os, "O_BINARY", 0)

_CONTENT = re.compile(r"(?:.*-)?([0-9a-f]{64})\.[^.]+", re.DOTALL)

READABLE = 0o666
"""Mode bits of a file that is not executable."""

READ_ONLY = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
"""Error numbers of write operations in a read-only folder."""


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents, and sync them."""
    if not folder.is_dir():
        make_folder(folder.parent)
        with suppress(FileExistsError):  # another process may have created it in the meantime
            os.mkdir(folder, readable_in(folder.parent, 0o777))
        sync_folder(folder.parent)


def readable_in(folder: Path, mode: int = READABLE) -> int:
    """Return the mode of a new file or folder that is readable only by users who may enter its parent folder."""
    around = os.stat(folder).st_mode & 0o777
    return mode & (around | 0o600 | around >> 2 & 0o111)


def sync_file(file: Path) -> None:
    """Sync the content of a file, so that it is durable."""
    descriptor = os.open(file, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that added, renamed and removed names are durable.

    Windows cannot open folders. On Windows, the journal of the file system keeps the order.
    """
    if hasattr(os, "O_DIRECTORY"):
        sync_file(folder)


def map_in_threads(work: Callable[[Item], Result], items: Sequence[Item], at_once: int = _SYNCS) -> list[Result]:
    """Apply an I/O-bound function to each item in a thread pool. The results are in the order of the items."""
    if len(items) < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(min(at_once, len(items))) as pool:
        return list(pool.map(work, items))


def remove_all(files: Iterable[Path]) -> None:
    """Remove those of the files that exist, and sync their folders."""
    folders = set()
    for file in files:
        with suppress(FileNotFoundError):
            os.unlink(file)
        folders.add(file.parent)
    for folder in sorted(folders):
        if folder.is_dir():
            sync_folder(folder)


@dataclass
class NewFile:
    """Stream and path of a file during writing. The path is temporary until the file is complete."""

    stream: BinaryIO
    path: Path


@contextmanager
def new_file(
    folder: Path, stem: str = "", ending: str = "", *, name: str | None = None, mode: int | None = None
) -> Iterator[NewFile]:
    """Open a file that becomes visible if the block ends without an exception, and is removed otherwise.

    Abandoned temporary files in the same folder are also removed.

    Parameters
    ----------
    folder : Path
        Folder of the file, which is created if necessary.
    stem, ending : str
        Parts of the name ``<stem><SHA-256><ending>``.
    name : str, optional
        Full name of a file without a hash.
    mode : int, optional
        Permissions, limited by the ``umask``. By default, all users who may read the folder may read the file.
    """
    make_folder(folder)
    remove_temporary(folder, _ABANDONED_S)
    label = os.fsdecode(os.fsencode(name or f"{stem}new")[-_LONGEST_NAME:])
    # several threads may write the same file
    path = folder / f".{label}.{secrets.token_hex(8)}{TEMPORARY_ENDING}"
    number = os.open(path, _NEW, readable_in(folder) if mode is None else mode)
    new = NewFile(os.fdopen(number, "wb", 1 << 20), path)
    try:
        with naming(folder / (name or f"{stem}{ending}")), new.stream:
            yield new
            new.stream.flush()
            os.fsync(number)
        new.path = folder / (name or f"{stem}{file_hash(path)}{ending}")
        os.replace(path, new.path)
    except BaseException:
        with suppress(FileNotFoundError):
            os.unlink(path)
        raise
    sync_folder(folder)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a new file that becomes ``path`` if the block ends without an exception, and is removed otherwise."""
    with new_file(path.parent, name=path.name) as new:
        yield new.stream


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path of a file to errors of calls that know only the descriptor of the file, such as the error of a full
    disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = os.fspath(path)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8). A reader sees either the complete file or nothing."""
    with replacing(path) as stream:
        stream.write(text.encode())


def file_hash(file: Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits."""
    with open(file, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_in_name(name: str) -> str | None:
    """Return the SHA-256 in the name of a file, or None if the name contains none."""
    found = _CONTENT.fullmatch(name)
    return found[1] if found else None


def write_result(folder: Path, stem: str, ending: str, data: bytes, mode: int | None = None) -> Path:
    """Store a result as ``<stem>-<SHA-256><ending>``, and remove former results with the same stem."""
    with new_file(folder, f"{stem}-", ending, mode=mode) as new:
        new.stream.write(data)
    remove_all(file for file in result_files(folder, stem, ending) if file != new.path)
    return new.path


def result_files(folder: Path, stem: str, ending: str) -> list[Path]:
    """Return the files that store a result.

    There is usually one such file, and there are two while the result is being replaced.
    """
    try:
        names = sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return []
    long = len(stem) + 65 + len(ending)
    return [folder / n for n in names if len(n) == long and n.startswith(f"{stem}-") and n.endswith(ending)]


def read_result(folder: Path, stem: str, ending: str) -> bytes | None:
    """Return a stored result, or None if it is missing or damaged and must be recomputed."""
    for file in result_files(folder, stem, ending):
        with suppress(FileNotFoundError):
            data = file.read_bytes()
            if hashlib.sha256(data).hexdigest() == hash_in_name(file.name):
                return data
    return None


def shared_mode(like: Sequence[os.stat_result], folder: Path) -> int:
    """Return the permission mode common to several files, for a new file with data from all of them.

    A user who may not read one of the files may not read the new file. A file of a different group gives no rights to
    its group.
    """
    mode = READABLE
    there = os.stat(folder) if like else None
    for status in like:
        group = there.st_gid if there and there.st_mode & stat.S_ISGID else getattr(os, "getegid", int)()
        mode &= status.st_mode if status.st_gid == group else status.st_mode & ~0o060
    return mode


def readers_of(mode: int) -> int:
    """Return the mode of a file that is to have the same readers as a file with the given mode."""
    return 0o600 | (0o060 if mode & 0o040 else 0) | (0o006 if mode & 0o004 else 0)


@contextmanager
def if_writable() -> Iterator[None]:
    """Skip the writes of a block if the folder is read-only, because their content can be recomputed."""
    try:
        yield
    except OSError as error:
        if error.errno not in READ_ONLY:
            raise


def remove_temporary(folder: Path, age_s: float = 0.0, deep: bool = False) -> None:
    """Remove leftovers of interrupted writers from a folder, if possible, and from its subfolders if `deep` is true.

    Use an age of 0 only if no other process can write there.
    """
    for file in (folder.rglob if deep else folder.glob)(_TEMPORARY):
        with suppress(OSError):
            status = os.lstat(file)
            if stat.S_ISREG(status.st_mode) and time.time() - status.st_mtime >= age_s:
                os.unlink(file)


LOCK_FILE = ".lock"

WAIT_S = 60.0
"""Default waiting time for the lock [s]. An ingest of thousands of logs takes seconds. Thus, two commands that a script
starts together both succeed, and a command that does not end is reported within a minute."""

_GRACE_S = 0.05
"""Longest time [s] that a command waits for the lock without a message. Most other commands finish writing within this
time."""

_LONGEST_NOTE = 4096
"""Number of bytes that are read from a lock file. Its note has about 100."""

_LOCKED = 1
"""Number of bytes at the beginning of the lock file that only the locking process can read on Windows."""

_UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL, errno.ENOSYS)


@contextmanager
def writing(processed: Path, wait_s: float = WAIT_S, say: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold the lock of a store, and create its folder if necessary.

    Parameters
    ----------
    processed : Path
    wait_s : float
        Time to wait for another process [s]. If it is 0, the call fails immediately.
    say : callable, optional
        Function that is called with one line when waiting begins.

    Raises
    ------
    StoreError
        If another process still holds the lock after that time, the file system has no locks, or the block fails to
        write. Data that are already stored remain valid.
    """
    file = -1
    try:
        make_folder(processed)
        file = os.open(processed / LOCK_FILE, _OPEN, readable_in(processed))
        _take(file, processed, wait_s, say)
        since = datetime.now(UTC).isoformat(timespec="seconds")
        note = f"process {os.getpid()} on {socket.gethostname()} (since {since})"
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, b" " * _LOCKED + note.encode())
        yield
        os.ftruncate(file, 0)
    except OSError as error:
        raise StoreError(
            f"{processed}: cannot be written ({error}). Stored data are complete. Free disk space or correct the "
            "permissions, and run the command again."
        ) from error
    finally:
        if file >= 0:
            os.close(file)  # releases the lock


def _take(file: int, processed: Path, wait_s: float, say: Callable[[str], None] | None) -> None:
    """Lock a file. The lock is released when the file is closed or its process ends."""
    from filelock import lock_descriptor  # imported only here, which saves 0.07 s in commands that only read

    began, announced = time.monotonic(), False
    try:
        while not lock_descriptor(file, blocking=False):
            waited = time.monotonic() - began
            if say and not announced and waited >= _GRACE_S:
                say(f"{processed}: {_noted(file)} is writing there; waiting up to {wait_s:g} s")
                announced = True
            if waited >= max(wait_s, _GRACE_S):
                raise StoreError(
                    f"{processed}: {_noted(file)} is writing there; waited {wait_s:g} s. Only one command may write at "
                    "a time. Run the command again when the other one has ended."
                )
            time.sleep(_GRACE_S / 5)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
        raise StoreError(
            f"this file system has no locks ({error.strerror}), so two commands could overwrite each other's data. "
            "Choose a folder on a local disk (--processed)."
        ) from error


def _noted(file: int) -> str:
    """Return the note in the lock file about the process that writes."""
    os.lseek(file, _LOCKED, os.SEEK_SET)
    return os.read(file, _LONGEST_NOTE).decode("utf-8", "replace").strip() or "another process"
