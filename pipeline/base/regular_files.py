"""Opens files that may be anything: pipes, devices and folders are never read; tells files that are gone."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO


def open_regular(path: Path) -> BinaryIO:
    """Open a file to be read, without waiting and only if it is a regular one.

    A pipe would keep a reader waiting for ever, and a device does what its driver does. Links are followed: sources are
    only read.

    Raises
    ------
    OSError
        If it cannot be opened, or is no regular file.
    """
    # a pipe, which may have come since `find_sources` looked, is opened at once by the first flag; files ignore it
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "no regular file")
        return os.fdopen(handle, "rb")
    except OSError:
        os.close(handle)
        raise


def is_gone(path: Path) -> bool:
    """Return whether nothing bears a path any more; what may not be looked at is not gone, as far as one can tell."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False
