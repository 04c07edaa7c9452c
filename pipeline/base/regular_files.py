"""Opens files that may be anything: pipes, devices and folders are never read; tells files that are gone."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO


def open_regular(path: Path, within: str | None = None) -> BinaryIO:
    """Open a file to be read, without waiting and only if it is a regular one.

    A pipe would keep a reader waiting for ever, and a device does what its driver does.

    Parameters
    ----------
    path : Path
    within : str, optional
        Real path of a folder that a link must not lead out of (`real_file`); by default links are followed.

    Raises
    ------
    OSError
        If it cannot be opened, is no regular file, or a link that leads elsewhere.
    """
    # a pipe, which may have come since `find_sources` looked, is opened at once by the first flag; files ignore it
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    if within is not None:
        # what became a link since it was looked at is not followed either
        flags |= getattr(os, "O_NOFOLLOW", 0)
    handle = os.open(path if within is None else real_file(path, within), flags)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "no regular file")
        return os.fdopen(handle, "rb")
    except OSError:
        os.close(handle)
        raise


class OutsideError(OSError):
    """A link leads out of the folder that was given."""


def real_file(path: Path, within: str) -> str:
    """Return what a path stands for: itself, or what a link leads to, which must lie below a folder.

    Parameters
    ----------
    path : Path
    within : str
        Real path of the folder.

    Raises
    ------
    OutsideError
        If it is a link to something elsewhere.
    OSError
        If it cannot be looked at.
    """
    if not os.path.islink(path):
        return os.fspath(path)
    real = os.path.realpath(path, strict=True)
    if not real.startswith(os.path.join(within, "")):
        raise OutsideError(errno.ELOOP, f"is a link to {real}, outside of {within}")
    return real


def is_gone(path: Path) -> bool:
    """Return whether nothing bears a path any more; what may not be looked at is not gone, as far as one can tell."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False
