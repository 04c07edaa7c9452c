"""The few calls of the operating system that change stored files, in an order that survives a loss of power.

A new file is written under a temporary name, synced, renamed, and its folder synced. After that its name and content
are on the disk; before the rename nobody sees it. A removal is on the disk when `sync_folder` returns. POSIX promises
no order between two folders without that call, and no name of a new folder without a sync of the folder around it.
Many small files are synced together (`publish_all`): a journal then writes once for all that wait.
"""

from __future__ import annotations

import errno
import io
import os
import re
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TypeVar, cast

TEMPORARY_ENDING = ".tmp"
"""Ending of a file that is not complete; readers look for other endings."""

_TEMPORARY = re.compile(rf"\..*\.[0-9a-f]{{16}}{re.escape(TEMPORARY_ENDING)}", re.DOTALL)
"""Name of a file that is not complete."""

_ABANDONED_S = 7 * 86400.0
"""Age of a temporary file that nobody completes any more [s]: most are written at once, a map within hours."""

_LONGEST_NAME = 200
"""Bytes of the final name that are kept in the temporary one: file systems allow 255."""

_BUFFER = 1 << 20
"""Bytes collected before they are written: Parquet writes its headers in pieces of some bytes."""

_SYNCS = 16
"""Syncs that wait at a time: one after the other 500 took 2.5 s on ext4, 16 at a time 0.1 s, 64 no less."""

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)

Item = TypeVar("Item")

_READABLE = 0o666
"""Bits of a mode that a file without a program in it may have."""


def make_folder(folder: Path) -> None:
    """Create a folder and the missing ones around it, so that all of them survive a loss of power."""
    make_folders([folder])


def make_folders(folders: Iterable[Path]) -> None:
    """Do what `make_folder` does for many folders, with one sync for each folder around them."""
    parents: dict[Path, None] = {}
    for folder in folders:
        missing = []
        here = folder
        while not os.path.isdir(here):
            missing.append(here)
            if here.parent == here:
                break
            here = here.parent
        for new in reversed(missing):
            with suppress(FileExistsError):  # another process may have made it meanwhile
                os.mkdir(new, readable_in(new.parent, 0o777))
            parents[new.parent] = None
    _for_each(sync_folder, list(parents))


def readable_in(folder: Path, mode: int = _READABLE) -> int:
    """Return the mode of what is made in a folder: who may not enter that may not read this, wherever it is moved."""
    try:
        around = os.stat(folder).st_mode & 0o777
    except FileNotFoundError:
        return mode
    return mode & (around | 0o600 | around >> 2 & 0o111)


def _for_each(work: Callable[[Item], None], items: Sequence[Item]) -> None:
    """Call a function that waits for the disk with each item, `_SYNCS` at a time."""
    if len(items) < 2:
        for item in items:
            work(item)
        return
    with ThreadPoolExecutor(min(_SYNCS, len(items))) as pool:
        list(pool.map(work, items))


def sync_folder(folder: Path) -> None:
    """Return when names that came into a folder, or went from it, are on the disk.

    Windows opens no folders; there the journal of the file system keeps the order.
    """
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with naming(folder):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove a file, if it is there; on the disk only after `sync_folder` of its folder."""
    with suppress(FileNotFoundError):
        os.unlink(path)


def move(old: Path, new: Path) -> None:
    """Give a file another name, in a folder that is made if needed; on the disk when this returns."""
    make_folder(new.parent)
    os.replace(old, new)
    sync_folder(new.parent)
    sync_folder(old.parent)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name the file in errors of calls that only have its descriptor: which disk is full is told by its place."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = os.fspath(path)
        raise


class _Descriptor(io.RawIOBase):
    """A file descriptor as a stream, so that each write passes through ``os.write``."""

    def __init__(self, path: Path, number: int) -> None:
        super().__init__()
        self.path = path
        self.number = number

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        with naming(self.path):
            return os.write(self.number, cast(bytes, data))

    def fileno(self) -> int:
        return self.number

    def close(self) -> None:
        if not self.closed:
            try:
                super().close()
            finally:
                os.close(self.number)


class NewFile:
    """A file that nobody sees until it is complete.

    Parameters
    ----------
    folder : Path
        Where it will lie; made if needed.
    label : str
        Part of the temporary name, which no other file has: threads may write one file at a time.
    like : sequence of os.stat_result
        Of files that it holds parts of: who may not read one of these may not read this.
    """

    def __init__(self, folder: Path, label: str, like: Sequence[os.stat_result] = ()) -> None:
        make_folder(folder)
        self._folder = folder
        self._temporary = folder / f".{_short(label)}.{secrets.token_hex(8)}{TEMPORARY_ENDING}"
        # opened here: Python closes every stream that was begun, and tells from 3.13 on where that fails
        number = os.open(self._temporary, _NEW, 0o600 if like else readable_in(folder))
        self._raw = _Descriptor(self._temporary, number)
        if like and hasattr(os, "fchmod"):
            os.fchmod(self._raw.number, _shared_mode(like, os.fstat(self._raw.number)))
        self.stream: BinaryIO = cast(BinaryIO, io.BufferedWriter(self._raw, _BUFFER))

    def publish(self, name: str) -> Path:
        """Give the complete file its name, in place of a former one; return its path when all is on the disk."""
        (path,) = publish_all([(self, name)])
        return path

    def sync(self) -> None:
        """Return when the content is on the disk."""
        self.stream.flush()
        with naming(self._temporary):
            os.fsync(self._raw.number)
        self._raw.close()

    def named(self, name: str) -> Path:
        """Give the file its name; on the disk after `sync_folder`."""
        os.replace(self._temporary, self._folder / name)
        return self._folder / name

    def discard(self) -> None:
        """Remove what was written, if it was not published."""
        # what the buffer still holds is not wanted: closing the raw stream first drops it
        self._raw.close()
        with suppress(ValueError):
            self.stream.close()
        remove(self._temporary)


def _short(label: str) -> str:
    return os.fsdecode(os.fsencode(label)[-_LONGEST_NAME:])


def publish_all(*groups: Sequence[tuple[NewFile, str]]) -> list[Path]:
    """Give complete files their names; return their paths when all is on the disk.

    The names of one group are on the disk before the next group gets its own.
    """
    _for_each(NewFile.sync, [new for group in groups for new, _ in group])
    paths: list[Path] = []
    for group in groups:
        named = [new.named(name) for new, name in group]
        _for_each(sync_folder, list({path.parent: None for path in named}))
        paths += named
    return paths


def _shared_mode(like: Sequence[os.stat_result], own: os.stat_result) -> int:
    """Return the mode that files have in common; a group has no rights by a file of another group."""
    mode = _READABLE
    for status in like:
        mode &= status.st_mode if status.st_gid == own.st_gid else status.st_mode & ~0o060
    return mode


READ_ONLY = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
"""Errors by which an operating system says that a place may only be read."""


@contextmanager
def if_writable() -> Iterator[None]:
    """Leave out the writes of a block where the place may only be read: what they would keep can be made again."""
    try:
        yield
    except OSError as error:
        if error.errno not in READ_ONLY:
            raise


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a new file that becomes ``path`` when the block ends well, and is removed when it does not.

    What writers that were killed left in its folder is removed, too.
    """
    _remove_abandoned(path.parent)
    new = NewFile(path.parent, path.name)
    try:
        yield new.stream
        new.publish(path.name)
    finally:
        new.discard()


def _remove_abandoned(folder: Path) -> None:
    """Remove temporary files that no writer can have open; leave what cannot be removed."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if _TEMPORARY.fullmatch(entry.name):
                with suppress(OSError):
                    age_s = time.time() - entry.stat(follow_symlinks=False).st_mtime
                    if age_s > _ABANDONED_S and entry.is_file(follow_symlinks=False):
                        os.unlink(entry.path)


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8) so that a reader sees all of it or nothing."""
    with replacing(path) as stream:
        stream.write(text.encode())


def remove_temporary(folder: Path) -> None:
    """Remove what interrupted writers left below a folder; only for who alone may write there."""
    for here, _, names in os.walk(folder):
        for name in names:
            if name.startswith(".") and name.endswith(TEMPORARY_ENDING):
                remove(Path(here, name))
