"""Paths from users: converted to text that every output can store, opened only if regular files, checked for output.

On Linux a file name is any sequence of bytes. Python represents bytes that are not UTF-8 as lone surrogates, which
neither JSON nor Parquet can store. JSON, HDF5 and MATLAB files may contain lone surrogates, too. A path may also name
a pipe or a device.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote_to_bytes, urlsplit

from pipeline.base.errors import PipelineError, UsageError

_SCHEME = "file:"


def storable(text: str) -> str:
    r"""Return a text with lone surrogates written as ``\udcff``, so that it can be encoded as UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def path_text(path: Path | str) -> str:
    r"""Return a path as text: unchanged, or as ``file:`` URI of the absolute path if its bytes are not UTF-8.

    Examples
    --------
    >>> path_text("/logs/K100.csv")
    '/logs/K100.csv'
    >>> path_text("/logs/K100\udcff.csv")
    'file:///logs/K100%FF.csv'
    """
    text = os.fspath(path)
    try:
        text.encode()
    except UnicodeEncodeError:
        return Path(os.path.abspath(text)).as_uri()
    return text


def path_of_text(text: str) -> Path:
    r"""Return the path of a text from `path_text`.

    Examples
    --------
    >>> path_of_text("file:///logs/K100%FF.csv").name
    'K100\udcff.csv'
    """
    return Path(os.fsdecode(unquote_to_bytes(urlsplit(text).path))) if text.startswith(_SCHEME) else Path(text)


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading, without waiting and only if it is a regular file.

    Reading a pipe could wait forever, and reading a device may have side effects.

    Raises
    ------
    OSError
        If it cannot be opened or is not a regular file.
    """
    # the first flag opens a pipe, which may have appeared since `find_sources`, without waiting; files ignore it
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "no regular file")
    return os.fdopen(handle, "rb")


def is_gone(path: Path) -> bool:
    """Return True if the path no longer exists. An unreadable path counts as existing."""
    try:
        os.lstat(path)
    except OSError as error:
        return isinstance(error, FileNotFoundError | NotADirectoryError)
    return False


def check_output(path: Path, option: str, *, document_beside: bool = False) -> None:
    """Check that the output file of an option can be written. Nothing is created.

    Parameters
    ----------
    path : Path
        File that the command will write; folders above it may be missing.
    option : str
        Name of the option, for the message; empty if the command has none.
    document_beside : bool
        Whether a JSON document of the same name is written next to it, which would overwrite a file that ends in .json.

    Raises
    ------
    UsageError
        If it is a folder, or ends in .json like the document next to it.
    PipelineError
        If no file can be created in its folder.
    """
    place = f"{option} {path}".strip()
    if path.is_dir():
        raise UsageError(f"{place}: is a folder; expected a file. Add a file name, such as {path / 'report.html'}.")
    if document_beside and path.suffix.lower() == ".json":
        raise UsageError(
            f"{place}: expected the name of the page, found that of the JSON document, which is written "
            f"next to it and would replace it. Give {path.with_suffix('.html')}."
        )
    # the nearest existing parent decides; a missing current folder raises the error below
    folder = next((above for above in path.parents if above.exists()), Path("."))
    try:
        with tempfile.TemporaryFile(dir=folder):  # an unnamed file: permissions alone are not sufficient
            pass
    except OSError as error:
        raise PipelineError(
            f"{place}: cannot be written, since {folder} takes no files ({error.strerror or error}). Choose "
            "another place, or correct the permissions."
        ) from error
