"""One writer at a time in `processed/`: a lock that the kernel lets go when its holder ends, in whatever way.

The lock is held on the file ``processed/.lock``, which stays there; it is free when nobody holds it. Readers need none:
what is stored is whole at any moment. Works on Linux, macOS and Windows, on local disks and on NFS from version 4.
"""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from pipeline.base.disk import make_folder, readable_in
from pipeline.base.errors import StoreError

LOCK_FILE = ".lock"

WAIT_S = 60.0
"""How long a command waits by default [s]: an ingest of thousands of logs takes seconds, so that two commands started
by scripts at the same moment both succeed; one that hangs is told within a minute."""

_GRACE_S = 0.05
"""Wait without a word [s]: most writers are done by then."""

_LONGEST_NOTE = 4096
"""Bytes read of a lock file; a holder's note has some 100."""

_LOCKED = 1
"""Bytes at the begin of the file that Windows lets nobody but the holder read."""

_NO_LINK = getattr(os, "O_NOFOLLOW", 0)

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
        Gets one line when waiting begins.

    Raises
    ------
    StoreError
        If another process still holds the lock after that time, the file system has no locks, or the block fails to
        write; what was stored stays valid.
    """
    file = -1
    try:
        make_folder(processed)
        file = os.open(processed / LOCK_FILE, os.O_RDWR | os.O_CREAT | _NO_LINK, readable_in(processed, 0o666))
        if not _taken(file, _GRACE_S):
            if say is not None:
                say(f"{processed}: {_noted(file)} writes there; waiting up to {wait_s:g} s")
            if not _taken(file, wait_s):
                raise StoreError(
                    f"{processed}: {_noted(file)} writes there; waited {wait_s:g} s. Only one command may "
                    "write at a time: run the command again when it has ended."
                )
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
            os.close(file)  # lets the lock go


def _taken(file: int, within_s: float) -> bool:
    """Return whether the lock is had within a time; it goes when the file is closed, or its process ends."""
    from filelock import lock_descriptor  # 0.07 s that commands which only read need not wait for

    end = time.monotonic() + within_s
    try:
        while not lock_descriptor(file, blocking=False):
            if time.monotonic() >= end:
                return False
            time.sleep(_GRACE_S / 5)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
        raise StoreError(
            f"this file system has no locks ({error.strerror}), so that two commands could damage each other's work. "
            "Choose a folder on a local disk (--processed)."
        ) from error
    return True


def _noted(file: int) -> str:
    """Return who writes, as the holder noted it."""
    os.lseek(file, _LOCKED, os.SEEK_SET)
    return os.read(file, _LONGEST_NOTE).decode("utf-8", "replace").strip() or "another process"
