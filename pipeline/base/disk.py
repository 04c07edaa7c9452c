"""The few calls of the operating system that change stored files, in an order that survives a loss of power.

A new file is written under a temporary name, synced, renamed, and its folder synced. After that its name and content
are on the disk; before the rename nobody sees it. A removal is on the disk when `sync_folder` returns. POSIX promises
no order between two folders without that call, and no name of a new folder without a sync of the folder around it.
"""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, cast

TEMPORARY_ENDING = ".tmp"
"""Ending of a file that is not complete; readers look for other endings."""

_LONGEST_NAME = 100
"""Characters of the final name that are kept in the temporary one: file systems allow 255 bytes."""

_BUFFER = 1 << 20
"""Bytes collected before they are written: Parquet writes its headers in pieces of some bytes."""


def make_folder(folder: Path) -> None:
    """Create a folder and the missing ones around it, so that all of them survive a loss of power."""
    missing = []
    here = folder
    while not os.path.isdir(here):
        missing.append(here)
        if here.parent == here:
            break
        here = here.parent
    for new in reversed(missing):
        with suppress(FileExistsError):  # another process may have made it meanwhile
            os.mkdir(new)
        sync_folder(new.parent)


def sync_folder(folder: Path) -> None:
    """Return when names that came into a folder, or went from it, are on the disk."""
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

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)

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
        Part of the temporary name: two new files in one folder need two labels. The process makes it its own.
    """

    def __init__(self, folder: Path, label: str) -> None:
        make_folder(folder)
        self._folder = folder
        self._temporary = folder / f".{label[-_LONGEST_NAME:]}.{os.getpid()}{TEMPORARY_ENDING}"
        self._raw = _Descriptor(self._temporary)
        self.stream: BinaryIO = cast(BinaryIO, io.BufferedWriter(self._raw, _BUFFER))

    def publish(self, name: str) -> Path:
        """Give the complete file its name, in place of a former one; return its path when all is on the disk."""
        self.stream.flush()
        with naming(self._temporary):
            os.fsync(self._raw.number)
        self._raw.close()
        path = self._folder / name
        os.replace(self._temporary, path)
        sync_folder(self._folder)
        return path

    def discard(self) -> None:
        """Remove what was written, if it was not published."""
        # what the buffer still holds is not wanted: closing the raw stream first drops it
        self._raw.close()
        with suppress(ValueError):
            self.stream.close()
        remove(self._temporary)


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
    """Open a new file that becomes ``path`` when the block ends well, and is removed when it does not."""
    new = NewFile(path.parent, path.name)
    try:
        yield new.stream
        new.publish(path.name)
    finally:
        new.discard()


def remove_temporary(folder: Path) -> None:
    """Remove what interrupted writers left below a folder; only for who alone may write there."""
    for here, _, names in os.walk(folder):
        for name in names:
            if name.startswith(".") and name.endswith(TEMPORARY_ENDING):
                remove(Path(here, name))
