"""Atomic files, named by the hash of their content: they appear whole or not at all, even after a power failure.

A new file is written under a temporary name, synced and renamed; then its folder is synced. The file is invisible
before the rename and durable after it. A file with the hash of its content in its name needs no other checksum, and two
writers of the same content write the same file.

One command at a time writes in `processed/`. It locks the file ``processed/.lock``; the kernel releases the lock when
the process ends, however it ends. The file itself remains. Readers need no lock, because stored files are always
complete. Works on Linux, macOS and Windows, on local disks and on NFS 4 or newer.
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
"""File extension of an incomplete file; readers ignore it."""

_TEMPORARY = f".*.{'[0-9a-f]' * 16}{TEMPORARY_ENDING}"
"""Name pattern of incomplete files."""

_ABANDONED_S = 7 * 86400.0
"""Age above which a temporary file counts as abandoned [s]: even a large map is written within hours."""

_LONGEST_NAME = 200
"""Number of bytes of the final name in the temporary one: file systems allow 255."""

_SYNCS = 16
"""Number of files synced at the same time: 500 files took 2.5 s in sequence on ext4, and 0.1 s with 16 at a time."""

_OPEN = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
_NEW = _OPEN | os.O_EXCL | getattr(os, "O_BINARY", 0)

_CONTENT = re.compile(r"(?:.*-)?([0-9a-f]{64})\.[^.]+", re.DOTALL)

READABLE = 0o666
"""Mode bits of a file that is not executable."""

READ_ONLY = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
"""Error numbers of a read-only folder."""


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents, durably."""
    if not folder.is_dir():
        make_folder(folder.parent)
        with suppress(FileExistsError):  # another process may have created it in the meantime
            os.mkdir(folder, readable_in(folder.parent, 0o777))
        sync_folder(folder.parent)


def readable_in(folder: Path, mode: int = READABLE) -> int:
    """Return the mode of a new file or folder: readable only by users who may enter the folder it is created in."""
    around = os.stat(folder).st_mode & 0o777
    return mode & (around | 0o600 | around >> 2 & 0o111)


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that added, renamed and removed names are durable.

    Windows cannot open folders; there the journal of the file system keeps the order.
    """
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def map_in_threads(work: Callable[[Item], Result], items: Sequence[Item], at_once: int = _SYNCS) -> list[Result]:
    """Apply an I/O-bound function to each item in a thread pool; results are in the order of the items."""
    if len(items) < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(min(at_once, len(items))) as pool:
        return list(pool.map(work, items))


def remove_all(files: Iterable[Path]) -> None:
    """Remove those of the files that exist, durably."""
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
    """A file being written: its stream, and its path, which is temporary until the file is complete."""

    stream: BinaryIO
    path: Path


@contextmanager
def new_file(
    folder: Path, stem: str = "", ending: str = "", *, name: str | None = None, mode: int | None = None
) -> Iterator[NewFile]:
    """Open a file that becomes visible when the block ends without an exception, and is removed otherwise.

    Abandoned temporary files in its folder are removed, too.

    Parameters
    ----------
    folder : Path
        Folder of the file, created if necessary.
    stem, ending : str
        Parts of its name, ``<stem><SHA-256><ending>``.
    name : str, optional
        Its full name, if it has no hash.
    mode : int, optional
        Permissions, limited by the ``umask``; by default all users who may read the folder may read the file.
    """
    make_folder(folder)
    remove_temporary(folder, _ABANDONED_S)
    label = os.fsdecode(os.fsencode(name or f"{stem}new")[-_LONGEST_NAME:])
    # threads may write one file at a time
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
    """Open a new file that becomes ``path`` when the block ends without an exception, and is removed otherwise."""
    with new_file(path.parent, name=path.name) as new:
        yield new.stream


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the file's path to errors of calls that only have its descriptor, such as a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = os.fspath(path)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8) so that a reader sees all of it or nothing."""
    with replacing(path) as stream:
        stream.write(text.encode())


def file_hash(file: Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits."""
    with open(file, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_in_name(name: str) -> str | None:
    """Return the SHA-256 of the content in the name of a file; None if there is none."""
    found = _CONTENT.fullmatch(name)
    return found[1] if found else None


def write_result(folder: Path, stem: str, ending: str, data: bytes, mode: int | None = None) -> Path:
    """Store a result as ``<stem>-<SHA-256><ending>``, replacing former ones with the same stem."""
    with new_file(folder, f"{stem}-", ending, mode=mode) as new:
        new.stream.write(data)
    remove_all(file for file in result_files(folder, stem, ending) if file != new.path)
    return new.path


def result_files(folder: Path, stem: str, ending: str) -> list[Path]:
    """Return the files that store a result: usually one, two while it is being replaced."""
    try:
        names = sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return []
    long = len(stem) + 65 + len(ending)
    return [folder / n for n in names if len(n) == long and n.startswith(f"{stem}-") and n.endswith(ending)]


def read_result(folder: Path, stem: str, ending: str) -> bytes | None:
    """Return a stored result, or None if it is missing or damaged and has to be recomputed."""
    for file in result_files(folder, stem, ending):
        with suppress(FileNotFoundError):
            data = file.read_bytes()
            if hashlib.sha256(data).hexdigest() == hash_in_name(file.name):
                return data
    return None


def shared_mode(like: Sequence[os.stat_result], folder: Path) -> int:
    """Return the permission mode common to several files, for a new file with data from all of them.

    A user who may not read one of them may not read the new one: a file of another group gives its group no rights.
    """
    mode = READABLE
    there = os.stat(folder) if like else None
    for status in like:
        group = there.st_gid if there and there.st_mode & stat.S_ISGID else getattr(os, "getegid", int)()
        mode &= status.st_mode if status.st_gid == group else status.st_mode & ~0o060
    return mode


def readers_of(mode: int) -> int:
    """Return the mode of a file with the same readers as a file of another mode."""
    return 0o600 | (0o060 if mode & 0o040 else 0) | (0o006 if mode & 0o004 else 0)


@contextmanager
def if_writable() -> Iterator[None]:
    """Skip the writes of a block if the folder is read-only: their content can be recomputed."""
    try:
        yield
    except OSError as error:
        if error.errno not in READ_ONLY:
            raise


def remove_temporary(folder: Path, age_s: float = 0.0, deep: bool = False) -> None:
    """Remove, if possible, the leftovers of interrupted writers from a folder, and its subfolders if `deep`.

    Use age 0 only if no other process may write there.
    """
    for file in (folder.rglob if deep else folder.glob)(_TEMPORARY):
        with suppress(OSError):
            status = os.lstat(file)
            if stat.S_ISREG(status.st_mode) and time.time() - status.st_mtime >= age_s:
                os.unlink(file)


LOCK_FILE = ".lock"

WAIT_S = 60.0
"""How long a command waits for the lock by default [s]: an ingest of thousands of logs takes seconds, so two commands
that a script starts together both succeed, and a command that hangs is reported within a minute."""

_GRACE_S = 0.05
"""Waiting time without a message [s]: most writers are done by then."""

_LONGEST_NOTE = 4096
"""Number of bytes read from a lock file; the note in it has about 100."""

_LOCKED = 1
"""Number of bytes at the beginning of the lock file that only the locking process can read on Windows."""

_UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL, errno.ENOSYS)


@contextmanager
def writing(processed: Path, wait_s: float = WAIT_S, say: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold the lock of a store; make its folder if needed.

    Parameters
    ----------
    processed : Path
    wait_s : float
        How long to wait for another holder [s]; 0 refuses at once.
    say : callable, optional
        Called with one line when waiting begins.

    Raises
    ------
    StoreError
        If another process still holds the lock after that time, the file system has no locks, or the block fails to
        write; data already stored remain valid.
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
            f"{processed}: cannot be written ({error}). What is stored is whole; make room or correct the permissions, "
            "and run the command again."
        ) from error
    finally:
        if file >= 0:
            os.close(file)  # releases the lock


def _take(file: int, processed: Path, wait_s: float, say: Callable[[str], None] | None) -> None:
    """Take the lock on a file, which is released when the file is closed or its process ends."""
    from filelock import lock_descriptor  # saves 0.07 s in commands that only read

    began, announced = time.monotonic(), False
    try:
        while not lock_descriptor(file, blocking=False):
            waited = time.monotonic() - began
            if say and not announced and waited >= _GRACE_S:
                say(f"{processed}: {_noted(file)} writes there; waiting up to {wait_s:g} s")
                announced = True
            if waited >= max(wait_s, _GRACE_S):
                raise StoreError(
                    f"{processed}: {_noted(file)} writes there; waited {wait_s:g} s. Only one command may "
                    "write at a time: run the command again when it has ended."
                )
            time.sleep(_GRACE_S / 5)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
        raise StoreError(
            f"this file system has no locks ({error.strerror}), so that two commands could damage each other's work. "
            "Choose a folder on a local disk (--processed)."
        ) from error


def _noted(file: int) -> str:
    """Return the note in the lock file on the process that writes."""
    os.lseek(file, _LOCKED, os.SEEK_SET)
    return os.read(file, _LONGEST_NOTE).decode("utf-8", "replace").strip() or "another process"
