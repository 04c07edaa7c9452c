"""A socket in the file system, for a computer that several people use: only its owner reaches the server."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.base.errors import UsageError


@contextmanager
def listening(path: Path) -> Iterator[socket.socket]:
    """Listen at a path that only its owner may use; it is removed at the end.

    Raises
    ------
    UsageError
        If something else lies there, another server listens there, or the system has no such sockets.
    """
    if not hasattr(socket, "AF_UNIX"):
        raise UsageError("--unix-socket: this system has none. Serve on 127.0.0.1.")
    _remove_left(path)
    with socket.socket(socket.AF_UNIX) as listener:
        mask = os.umask(0o177)  # before the bind: nobody else may connect in between
        try:
            listener.bind(str(path))
        except OSError as error:
            raise UsageError(
                f"--unix-socket {path}: {error}. Choose a shorter path in a folder of your own."
            ) from error
        finally:
            os.umask(mask)
        try:
            yield listener
        finally:
            with suppress(OSError):
                path.unlink()


def _remove_left(path: Path) -> None:
    """Remove the socket of a server that was killed."""
    try:
        kind = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(kind):
        raise UsageError(f"--unix-socket {path}: a file lies there. Choose another path.")
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            path.unlink()
            return
    raise UsageError(f"--unix-socket {path}: another server listens there.")
